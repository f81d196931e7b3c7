"""A recording, or a span of it, in another format: CSV, MCAP or NumPy's npz."""

from __future__ import annotations

import os
import secrets
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from rtcp.ipc.recording import RecordingError
from rtcp.ipc.schema import arm_schema
from rtcp.telemetry.channels import Channels
from rtcp.telemetry.reading import Reader
from rtcp.telemetry.recorder import CSV_NAMES, CsvWriter, McapWriter


def export(reader: Reader, out: Path, replace: bool = False) -> int:
    """Write the recording of a reader to a file, whole or not at all, and return the number of records.

    CSV and MCAP are written part by part; npz, with `seconds` and each signal by its name, at once.

    Args:
        reader: an unread reader.
        out: path whose ending is the format: .csv, .mcap or .npz.
        replace: whether to replace an existing file.

    Raises:
        RecordingError: the recording is damaged or lacks data of the format; the file exists or cannot be written.
    """
    new = out.with_name(f".{out.stem}-{secrets.token_hex(4)}{out.suffix}")
    try:
        if out.exists() and (not replace or out.samefile(reader.path)):
            defect = "the file exists" + (", and is the recording itself" if replace else "")
            raise RecordingError("exists", out, defect)
        count = {".csv": _to_csv, ".mcap": _to_mcap, ".npz": _to_npz}[out.suffix](reader, new)
        os.replace(new, out)
    except OSError as error:
        raise RecordingError("refused", out, f"it cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)
    return count


def _to_csv(reader: Reader, new: Path) -> int:
    """Write CSV, with the recorder's columns where no signals were chosen and the recording has them."""
    columns: Sequence[str] = reader.names if reader.signals or not set(CSV_NAMES) <= set(reader.names) else ()
    writer, count = CsvWriter(reader.schema, columns), 0
    writer.open(new)
    try:
        for part in reader:
            writer.write(part.records, part.records)
            count += len(part.records)
    finally:
        writer.close()
    return count


def _to_mcap(reader: Reader, new: Path) -> int:
    if reader.config is None:
        defect = "it has no configuration of this version, which MCAP files carry: csv and npz can be written"
        raise RecordingError("signals", reader.path, defect)
    if lacking := [name for name in arm_schema(1).names if name not in reader.names]:
        defect = f"MCAP files need every signal, it lacks {', '.join(lacking)}: csv and npz can be written"
        raise RecordingError("signals", reader.path, defect, found=reader.names)
    channels = Channels(reader.config, reader.schema, reader.offset_ns)
    writer, count = McapWriter(channels, reader.config, channels.wall_ns(reader.first_ns)), 0
    writer.open(new)
    try:
        for part in reader:
            writer.write(part.records, part.records)
            for moment in part.log:
                channels.log(moment.time_ns, moment.message, moment.level)
            writer.flush()
            count += len(part.records)
    finally:
        writer.close()
    return count


def _to_npz(reader: Reader, new: Path) -> int:
    records = np.concatenate([part.records for part in reader])
    fields: dict[str, Any] = {name: records[name] for name in reader.names}
    np.savez(new, **fields, seconds=(records["time_ns"] - reader.first_ns) * 1e-9)
    return len(records)
