"""Drives every device of the ESI files below a folder to OP, and counts by vendor.

    python benchmarks/esi_op.py DIR [--only WORD] [--batch 16] [--json FILE]
                                [--slaveinfo PROGRAM] [--simple-test PROGRAM]

Each device hangs on the software segment by its description and gets the file that `rtcp device new` makes of it, with
some value for each figure that it asks for. The master configures it and brings it to OP over a real socket, where its
process data are exchanged. Several at a time; one that a message names is tried again alone: then the reason counts.
Where a message names none, the batch is halved.
Devices without a product code are no slaves; a device that stands in several files counts once.

SOEM's own programs, compiled from its sources, find the same slaves on the same segment without our master (as root):
slaveinfo reads them and brings them to SAFE-OP (the bits that it finds are compared with those of the default
assignment), simple_test brings them to OP. FILE receives the reasons as they come;
where it exists, the run goes on from there.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.esi import print_table, read_files, vendor
from rtcp.config.device_file import file_text
from rtcp.config.loader import load_device
from rtcp.config.model import ConfigError, SlaveConfig
from rtcp.esi.model import EsiError
from rtcp.esi.modules import assemble
from rtcp.fieldbus import BusError
from rtcp.fieldbus.soem import SoemBus
from rtcp.virtual.server import run
from tests.fieldbus.master_child import INTERFACE, Cycle, to_op
from tests.required import filled

PERIOD_NS = 5_000_000
PATIENCE_S = 60.0
"""For a batch, on a machine with nothing else to do: then it has failed."""
FORK = multiprocessing.get_context("fork")
_NAMED = re.compile(r"\(s(\d+)\)|slaves\[(\d+)\]|/(\d+)\.yaml")
"""How messages of the master, the segment and the reader of configurations name a device of a batch."""
_SLAVE = re.compile(r"^Slave:(\d+)\n.*?size: (\d+)bits\n.*?size: (\d+)bits\n State: (\d+)$", re.MULTILINE | re.DOTALL)
_STATE = re.compile(r"^Slave (\d+) State= ?(.*)$", re.MULTILINE)
_COMPLAINT = re.compile(r"^.*\bslave:(\d+) .*$", re.MULTILINE)
"""What SOEM's programs print of a slave: a summary, a state that is not the one wanted, an error."""
SAFEOP = "4"


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
    bits: tuple[int, int] = (0, 0)
    """Outputs and inputs of the default assignment."""


Verdicts = dict[int, str]
"""By place in a batch: why the device failed, empty where it did not. Of those left out nothing is known."""
Drive = Callable[[int, Path, Sequence[Candidate]], Verdicts]
"""Receives the process that holds the segment's network, the folder of the device files and the devices."""


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
                whole = assemble(device, file.modules) if device.slots else device
                text = filled(file_text(whole))
                outputs, inputs = (sum(pdo.bits for pdo in whole.assigned(out)) for out in (True, False))
            except EsiError as error:
                reasons[label] = str(error)
                text, outputs, inputs = "", 0, 0
            yield Candidate(
                vendor(file), file.path, label, identity.product_code, identity.revision, text, (outputs, inputs)
            )


def try_batch(batch: Sequence[Candidate], drive: Drive) -> Verdicts:
    """Put the devices of a batch on a segment of their own and drive them."""
    with tempfile.TemporaryDirectory(prefix="rtcp-esi-") as made:
        folder = Path(made)
        entries = []
        for number, device in enumerate(batch):
            (folder / f"{number}.yaml").write_text(device.text)
            chosen = f"product: 0x{device.product:X}, revision: 0x{device.revision:X}"
            entries.append(f"  - {{esi: {json.dumps(device.file)}, {chosen}, options: {{sync_error_limit: 0}}}}\n")
        (folder / "segment.yaml").write_text("slaves:\n" + "".join(entries))
        with forked(partial(segment, folder / "segment.yaml")) as ready:
            answer = ready(patience())
            if not isinstance(answer, int):
                return read_message(f"segment: {answer}", len(batch))
            return drive(answer, folder, batch)


def patience() -> float:
    """Return for how many seconds a batch may take while the machine has other work."""
    return PATIENCE_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@contextmanager
def forked(work: Callable[[Connection], None]) -> Iterator[Callable[[float], object]]:
    """Do `work` in a process of its own, which begins with everything loaded; yield what waits for what it sends."""
    ours, theirs = FORK.Pipe()
    process = FORK.Process(target=work, args=(theirs,))
    process.start()
    theirs.close()

    def answer(patience_s: float) -> object:
        try:
            return ours.recv() if ours.poll(patience_s) else f"no end within {patience_s:g} s"
        except EOFError:
            return "its process ended"

    try:
        yield answer
    finally:
        process.kill()
        process.join()
        process.close()
        ours.close()


def segment(path: Path, connection: Connection) -> None:
    """Be the segment of a batch; send the process that holds its network, or why there is none."""
    try:
        run(path, None, False, None, lambda message: connection.send(message["pid"]))
    except Exception as error:
        connection.send(str(error))


def read_message(text: str, count: int) -> Verdicts:
    """Return whom a message names; where there is but one device, it is this one; without a message, all are well."""
    if not text or count == 1:
        return dict.fromkeys(range(count), text)
    return {int(found[found.lastindex or 0]): text for found in _NAMED.finditer(text)}


def by_master(pid: int, folder: Path, batch: Sequence[Candidate]) -> Verdicts:
    """Drive the slaves to OP by our master."""
    with forked(partial(master, pid, folder, len(batch))) as answer:
        return read_message(str(answer(patience())), len(batch))


def master(pid: int, folder: Path, count: int, connection: Connection) -> None:
    """Be the master of a batch; send what keeps a slave from OP."""
    try:
        slaves = [SlaveConfig(f"s{n}", load_device(folder / f"{n}.yaml")) for n in range(count)]
        with SoemBus(INTERFACE, namespace_pid=pid) as bus:
            data = bus.configure(slaves, PERIOD_NS)
            cycle = Cycle(data, PERIOD_NS)
            to_op(bus, cycle)
            cycle.for_cycles(20)
            states = [state.words() for state in bus.read_states()]
        message = "; ".join(f"slave {n + 1} (s{n}) is in {state}" for n, state in enumerate(states) if state != "OP")
        if data.expected_wkc and data.expected_wkc not in cycle.wkcs[-20:]:
            message = message or f"working counter {max(cycle.wkcs[-20:])}, expected {data.expected_wkc}"
    except (BusError, ConfigError) as error:
        message = str(error).replace("\n", "; ")
    except Exception as error:
        message = f"master: {error!r}"
    connection.send(message)


def by_program(
    program: Path,
    read: Callable[[str, Sequence[Candidate]], Verdicts],
    pid: int,
    folder: Path,
    batch: Sequence[Candidate],
) -> Verdicts:
    """Let one of SOEM's programs drive the slaves; it is stopped once it begins to exchange process data."""
    command = ["nsenter", "-t", str(pid), "-n", "stdbuf", "-oL", str(program), INTERFACE]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    assert running.stdout is not None
    timer = threading.Timer(patience(), running.kill)
    timer.start()
    lines = []
    for line in running.stdout:
        lines.append(line)
        if line.startswith("Operational state reached"):
            break
    timer.cancel()
    running.kill()
    running.communicate()
    return read("".join(lines), batch)


def read_slaveinfo(text: str, batch: Sequence[Candidate]) -> Verdicts:
    """Return the slaves of which slaveinfo prints an error, another state than SAFE-OP, or other sizes."""
    verdicts = {}
    for found in _SLAVE.finditer(text):
        place, bits = int(found[1]) - 1, (int(found[2]), int(found[3]))
        verdicts[place] = "" if found[4] == SAFEOP else f"state {found[4]}"
        if not verdicts[place] and bits != batch[place].bits:
            verdicts[place] = "bits of outputs and inputs: {}, {} by the default assignment".format(
                *("{} and {}".format(*pair) for pair in (bits, batch[place].bits))
            )
    for pattern in (_COMPLAINT, _STATE):
        verdicts |= {int(found[1]) - 1: found[0].strip() for found in pattern.finditer(text)}
    return verdicts or read_message(text[-400:].strip() or "it printed nothing", len(batch))


def read_simple_test(text: str, batch: Sequence[Candidate]) -> Verdicts:
    """Return the slaves that simple_test could not bring to OP."""
    if "Operational state reached" in text:
        return dict.fromkeys(range(len(batch)), "")
    failed = {int(found[1]) - 1: found[0].strip() for found in _STATE.finditer(text)}
    if not failed:
        return read_message(text[-400:].strip() or "it printed nothing", len(batch))
    return dict.fromkeys(range(len(batch)), "") | failed


def judge(devices: Sequence[Candidate], size: int, drive: Drive, reasons: dict[str, str]) -> Iterator[int]:
    """Drive the devices that `reasons` lacks and add them to it, why they failed or nothing; yield how many are left.

    What fails among others is tried again alone: a neighbour may be the cause.
    """
    waiting = [device for device in devices if device.name not in reasons]
    batches = [waiting[start : start + size] for start in range(0, len(waiting), size)][::-1]
    while batches:
        batch = batches.pop()
        verdicts = try_batch(batch, drive)
        if len(batch) > 1:
            batches += [[batch[n]] for n, why in verdicts.items() if why]
            unknown = [device for n, device in enumerate(batch) if n not in verdicts]
            middle = len(unknown) // 2 if len(unknown) == len(batch) else 0
            batches += [part for part in (unknown[middle:], unknown[:middle]) if part]
        reasons |= {batch[n].name: why for n, why in verdicts.items() if len(batch) == 1 or not why}
        yield sum(map(len, batches))


def main() -> None:
    """Count the devices."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="only devices with this in file or name")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--every", type=int, default=1, help="only every n-th device")
    parser.add_argument("--json", type=Path, help="file of the reasons, from which a run goes on")
    parser.add_argument("--slaveinfo", type=Path, help="SOEM's slaveinfo, compiled")
    parser.add_argument("--simple-test", type=Path, help="SOEM's simple_test, compiled")
    given = parser.parse_args()
    # So that the processes of a batch end with this one.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    drives: dict[str, Drive] = {"OP": by_master}
    if given.slaveinfo is not None:
        drives["slaveinfo"] = partial(by_program, given.slaveinfo, read_slaveinfo)
    if given.simple_test is not None:
        drives["SOEM OP"] = partial(by_program, given.simple_test, read_simple_test)
    gc.freeze()
    saved = json.loads(given.json.read_text()) if given.json is not None and given.json.exists() else {}
    unmade: dict[str, str] = {}
    devices = list(candidates(given.folder, given.only, unmade))[:: given.every]
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for device in devices:
        rows[device.vendor]["devices"] += 1
    for column, drive in drives.items():
        # Failures are tried again: a machine that stands still makes some.
        reasons = saved[column] = {name: why for name, why in saved.get(column, {}).items() if not why}
        if column == "OP":
            reasons |= unmade
        for left in judge(devices, given.batch, drive, reasons):
            print(f"\r{column}: {left} of {len(devices)} left ", end="", file=sys.stderr, flush=True)
            if given.json is not None:
                given.json.write_text(json.dumps(saved, indent=1))
        print(file=sys.stderr)
        for device in devices:
            rows[device.vendor][column] += not reasons[device.name]
            if reasons[device.name]:
                print(f"{column}: {device.name}: {reasons[device.name]}", file=sys.stderr)
    print_table(("devices", *drives), rows)


if __name__ == "__main__":
    main()
