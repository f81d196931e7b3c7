"""Drives every device of the ESI files below a folder to OP, and counts by vendor.

    python benchmarks/esi_op.py DIR [--only WORD] [--batch 8] [--json FILE]

Each device hangs on the software segment by its description, gets the file that `rtcp device new` makes of it, and is
configured and brought to OP by the master over a real socket. Several at a time; those of a batch that does not get
there are tried in halves, and at last alone: then the reason counts. Devices without a product code are no slaves.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.esi import print_table, read_files, vendor
from rtcp.config.device_file import file_text
from rtcp.config.loader import load_device
from rtcp.config.model import ConfigError, SlaveConfig
from rtcp.esi.model import EsiError
from rtcp.esi.modules import assemble

PERIOD_NS = 5_000_000
PATIENCE_S = 90.0
"""For a batch: then it has failed."""


@dataclass(frozen=True)
class Candidate:
    """A device of a file."""

    vendor: str
    file: str
    name: str
    product: int
    revision: int
    text: str
    """Its device file."""


def candidates(folder: Path, only: str, reasons: dict[str, str]) -> Iterator[Candidate]:
    """Yield each device once; those that make no file are in `reasons`."""
    seen = set()
    for file in read_files(folder)[0]:
        for device in file.devices:
            identity = device.identity
            key = identity.vendor_id, identity.product_code, identity.revision
            label = f"{file.path}: {device.name} 0x{identity.product_code:X} 0x{identity.revision:X}"
            if key in seen or not identity.product_code or only not in label:
                continue
            seen.add(key)
            try:
                text = file_text(assemble(device, file.modules) if device.slots else device)
            except EsiError as error:
                reasons[label] = str(error)
                text = ""
            yield Candidate(vendor(file), file.path, label, identity.product_code, identity.revision, text)


def reach_op(batch: Sequence[Candidate]) -> str:
    """Return an empty text where all devices of a batch come to OP, else what came instead."""
    with tempfile.TemporaryDirectory(prefix="rtcp-esi-") as made:
        folder = Path(made)
        entries = []
        for number, device in enumerate(batch):
            (folder / f"{number}.yaml").write_text(device.text)
            chosen = f"product: 0x{device.product:X}, revision: 0x{device.revision:X}"
            entries.append(f"  - {{esi: {json.dumps(device.file)}, {chosen}, options: {{sync_error_limit: 0}}}}\n")
        (folder / "segment.yaml").write_text("slaves:\n" + "".join(entries))
        segment = subprocess.Popen(
            [sys.executable, "-m", "rtcp.virtual", "--config", str(folder / "segment.yaml")],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert segment.stdout is not None
        try:
            if not (line := segment.stdout.readline()):
                return f"segment: {segment.communicate()[1].strip()[-400:]}"
            question = json.dumps({"pid": json.loads(line)["pid"], "folder": made, "count": len(batch)})
            done = subprocess.run(
                [sys.executable, __file__, "--child", question],
                capture_output=True, text=True, check=False, timeout=PATIENCE_S,
            )  # fmt: skip
            return done.stdout.strip() if done.returncode == 0 else f"master: {done.stderr.strip()[-400:]}"
        except subprocess.TimeoutExpired:
            return f"master: no end within {PATIENCE_S:g} s"
        finally:
            segment.kill()
            segment.communicate()


def child(question: dict[str, object]) -> str:
    """Be the master of one batch, in a process of its own; return what keeps a slave from OP."""
    from rtcp.fieldbus import BusError
    from rtcp.fieldbus.soem import SoemBus
    from tests.fieldbus.master_child import INTERFACE, Cycle, to_op

    folder, count = Path(str(question["folder"])), int(str(question["count"]))
    try:
        slaves = [SlaveConfig(f"s{n}", load_device(folder / f"{n}.yaml")) for n in range(count)]
        with SoemBus(INTERFACE, namespace_pid=int(str(question["pid"]))) as bus:
            to_op(bus, Cycle(bus.configure(slaves, PERIOD_NS), PERIOD_NS))
            states = [state.words() for state in bus.read_states()]
        return "" if states == ["OP"] * count else f"states: {', '.join(states)}"
    except (BusError, ConfigError) as error:
        return str(error).replace("\n", "; ")


def failures(batch: Sequence[Candidate]) -> Iterator[tuple[Candidate, str]]:
    """Yield the devices of a batch that do not come to OP, each with its reason."""
    reason = reach_op(batch)
    if reason and len(batch) == 1:
        yield batch[0], reason
    elif reason:
        middle = len(batch) // 2
        yield from failures(batch[:middle])
        yield from failures(batch[middle:])


def main() -> None:
    """Count the devices."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--only", default="", help="only devices with this in file or name")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--every", type=int, default=1, help="only every n-th device")
    parser.add_argument("--json", type=Path, help="also write the reasons to this file")
    parser.add_argument("--child", type=json.loads, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        print(child(given.child))
        return
    reasons: dict[str, str] = {}
    devices = list(candidates(given.folder, given.only, reasons))[:: given.every]
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    ready = [device for device in devices if device.text]
    for start in range(0, len(ready), given.batch):
        reasons |= {device.name: why for device, why in failures(ready[start : start + given.batch])}
        print(f"\r{min(start + given.batch, len(ready))} of {len(ready)}", end="", file=sys.stderr, flush=True)
    for device in devices:
        rows[device.vendor]["devices"] += 1
        rows[device.vendor]["OP"] += device.name not in reasons
    print(file=sys.stderr)
    print_table(("devices", "OP"), rows)
    for name, why in reasons.items():
        print(f"{name}: {why}", file=sys.stderr)
    if given.json is not None:
        given.json.write_text(json.dumps(reasons, indent=1))


if __name__ == "__main__":
    main()
