"""SDO beside the cycle: the own mailbox client against pysoem's `sdo_read` that releases the interpreter's lock.

    python benchmarks/sdo.py --seconds 10

Seven virtual slaves, a cycle of 1 ms in the main thread, SDO reads of slave 2 in a second one; the slave answers at
once, after 50 ms, or never. Prints wake-up and exchange times, and for how long a read blocks the second thread.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pysoem import pysoem

from rtcp.config.loader import load
from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.soem import SoemBus
from rtcp.realtime.scheduling import share_interpreter_quickly
from rtcp.virtual.faults.control import SegmentClient

PERIOD_NS = 1_000_000
ARM = Path(__file__).parents[1] / "config" / "assistive_arm.yaml"
MODELS = ("diewu-io", *("cubemars-orh70",) * 3, "cubemars-orh60", "cubemars-orh50", "cubemars-orh40")
NAMED = (0x603F, 0)


@contextmanager
def segment() -> Iterator[tuple[int, Path]]:
    with tempfile.TemporaryDirectory(prefix="rtcp-sdo-") as directory:
        file, control = Path(directory) / "segment.yaml", Path(directory) / "segment.sock"
        file.write_text("slaves:\n" + "".join(f"  - model: {model}\n" for model in MODELS))
        command = [sys.executable, "-m", "rtcp.virtual", "--config", str(file), "--control", str(control)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())["pid"], control
            process.terminate()


def measure(bus: SoemBus, slaves: list[SlaveConfig], read: Callable[[], object], seconds: float) -> dict[str, float]:
    data = bus.configure(slaves, PERIOD_NS)
    wakes: list[int] = []
    exchanges: list[int] = []
    calls: list[float] = []
    done = threading.Event()

    def beside() -> None:
        bus.request_state(AlState.OP)
        bus.wait_for_state(AlState.OP, 5.0)
        wakes.clear(), exchanges.clear()
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            began = time.monotonic()
            with suppress(BusError, pysoem.SdoError, pysoem.MailboxError, pysoem.PacketError, pysoem.WkcError):
                read()
            calls.append(time.monotonic() - began)
            time.sleep(0.002)
        done.set()

    thread = threading.Thread(target=beside)
    thread.start()
    missed = data.missed
    due = time.monotonic_ns() + PERIOD_NS
    while not done.is_set():
        time.sleep(max(due - time.monotonic_ns(), 0) * 1e-9)
        woken = time.monotonic_ns()
        data.send()
        data.receive()
        wakes.append(woken - due)
        exchanges.append(time.monotonic_ns() - woken)
        due = max(due + PERIOD_NS, time.monotonic_ns())
    thread.join()

    def quantile(values: list[int], share: float) -> float:
        return round(sorted(values)[int(share * (len(values) - 1))] / 1000, 1)

    times = {"wake": wakes, "exchange": exchanges}
    found = {f"{name} p{100 * share:g} us": quantile(values, share) for name, values in times.items()
             for share in (0.5, 0.99, 1.0)}  # fmt: skip
    return {**found, "missed": data.missed - missed, "reads": len(calls), "longest read s": round(max(calls), 3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--child", nargs=4, metavar=("PID", "CONTROL", "CLIENT", "MS"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is None:
        for delay in ("0", "50", "60000"):
            for client in ("own", "pysoem"):
                with segment() as (pid, control):
                    child = [sys.executable, __file__, "--seconds", str(given.seconds)]
                    subprocess.run([*child, "--child", str(pid), str(control), client, delay], check=True)
        return
    pid, control, client, delay = given.child
    share_interpreter_quickly()
    with SoemBus("ecat0", 0.5, namespace_pid=int(pid)) as bus:
        started = threading.Event()

        def read() -> object:
            if delay != "0" and not started.is_set():
                started.set()
                with SegmentClient(Path(control)) as faults:
                    faults.fault({"fault": "sdo_late", "slave": 2, "ms": int(delay)})
            if client == "own":
                return bus.sdo(2).read(*NAMED)
            return bus._master.slaves[1].sdo_read(*NAMED, release_gil=True)

        print(
            client, f"answer after {delay} ms:", measure(bus, list(load(ARM).slaves), read, given.seconds), flush=True
        )


if __name__ == "__main__":
    main()
