"""Cycle records and messages as channels, and the MCAP files that have them: one writer for recorder and black box."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import foxglove
import numpy as np
import numpy.typing as npt
from foxglove.mcap import MCAPWriteOptions

from rtcp.ipc.cdr import CdrTemplate
from rtcp.ipc.observer import INFORMATION
from rtcp.ipc.schema import RecordSchema

ABOUT = "rtcp/about"
"""Metadata of a file."""
CYCLE, LOG = "/cycle", "/log"
_INTEGER, _TEXT = {"type": "integer"}, {"type": "string"}
_TIME = {"type": "object", "properties": {"sec": _INTEGER, "nsec": _INTEGER}}
_LOG_SCHEMA = {
    "type": "object", "title": "foxglove.Log",
    "properties": {"timestamp": _TIME, "level": _INTEGER, "message": _TEXT, "name": _TEXT},
}  # fmt: skip


class CycleChannels:
    """Publishes cycle records as `/cycle` and messages as `/log` into a context, to which files and live views listen.

    Args:
        schema: of the published records.
        offset_ns: CLOCK_REALTIME less CLOCK_MONOTONIC, ns: constant for a recording, so that setting the clock
            leaves no gap.
        context: to publish into; None: a new one.
    """

    def __init__(self, schema: RecordSchema, offset_ns: int, context: foxglove.Context | None = None) -> None:
        self.context = context or foxglove.Context()
        self._offset_ns = offset_ns
        self._cycle = self._ros_channel(CYCLE, "rtcp_msgs/msg/Cycle", schema.definition().decode())
        self._cycle_template = CdrTemplate().record(schema)
        self._log = self._json_channel(LOG, _LOG_SCHEMA)

    def _ros_channel(self, topic: str, name: str, definition: str) -> foxglove.Channel:
        schema = foxglove.Schema(name=name, encoding="ros2msg", data=definition.encode())
        return foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=self.context)

    def _json_channel(self, topic: str, schema: Mapping[str, Any]) -> foxglove.Channel:
        return foxglove.Channel(topic, schema=dict(schema), message_encoding="json", context=self.context)

    def wall_ns(self, monotonic_ns: int) -> int:
        """Convert an instant of CLOCK_MONOTONIC to the time of these channels, ns."""
        return monotonic_ns + self._offset_ns

    def publish(self, records: npt.NDArray[np.void]) -> None:
        """Publish cycle records, oldest first; a channel without a listener costs nothing."""
        if len(records) and self._cycle.has_sinks():
            messages = self._cycle_template.fill(len(records), records)
            send(self._cycle, (records["time_ns"] + self._offset_ns).tolist(), messages)

    def log(self, time_ns: int, message: str, level: int = INFORMATION) -> None:
        """Publish a message; `level` as in `foxglove.Log`: 2 information, 3 warning, 4 error."""
        sec, nsec = divmod(time_ns, 1_000_000_000)
        entry = {"timestamp": {"sec": sec, "nsec": nsec}, "level": level, "message": message, "name": "rtcp"}
        self._log.log(entry, log_time=time_ns)


def send(channel: foxglove.Channel, instants: Sequence[int], messages: Sequence[bytes]) -> None:
    """Publish messages with their times, CLOCK_REALTIME ns."""
    log: Callable[..., None] = channel.log
    for instant, message in zip(instants, messages, strict=True):
        log(message, log_time=instant)


def check_linked(file: IO[Any]) -> None:
    """Raise OSError if the file has been removed: nobody could read it."""
    if os.fstat(file.fileno()).st_nlink == 0:
        raise OSError(errno.ENOENT, "it has been removed")


class McapFile(io.RawIOBase):
    """A new MCAP file that records a context from now on; all methods raise OSError.

    The writer returns to the beginning of a chunk when it ends one. `commit` writes whole chunks to the disk: the file
    can be read at any time, after a kill and on a full disk.

    Args:
        path: of the file, which does not exist yet.
        context: of the channels.
        about: metadata of the file.
    """

    def __init__(self, path: Path, context: foxglove.Context, about: dict[str, str]) -> None:
        super().__init__()
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115
        self._pending, self._written = io.BytesIO(), 0
        options = MCAPWriteOptions(profile="ros2", compression_level=1, compression_threads=0)
        self._writer = foxglove.open_mcap(self, context=context, writer_options=options)
        self._writer.write_metadata(ABOUT, about)
        self.attach = self._writer.attach

    def write(self, data: Any) -> int:
        """Buffer bytes of the writer until `commit`."""
        return self._pending.write(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the write position, not to before the bytes that are on the disk."""
        return self._written + self._pending.seek(offset - self._written if whence == os.SEEK_SET else offset, whence)

    def commit(self) -> None:
        """End the chunk and write all since the last commit; on failure the file stays as it was."""
        self._writer.flush()
        self._write_out()

    def complete(self, durable: bool = False) -> None:
        """Write the index and close the file; `durable`: return when all of it is on the disk."""
        self._writer.close()
        with self._file:
            self._write_out()
            if durable:
                os.fsync(self._file.fileno())

    def _write_out(self) -> None:
        check_linked(self._file)
        left = data = memoryview(self._pending.getvalue())
        try:
            while left:
                left = left[self._file.write(left) or 0 :]
        except OSError:
            self._file.truncate(self._written)
            raise
        self._written += len(data)
        self._pending = io.BytesIO()
