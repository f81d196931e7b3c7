"""How fast the virtual segment answers: round trips of a real pysoem master, blocking and polling, 7 and 32 slaves.

    python benchmarks/segment.py [--seconds 5] [--json]

The segment runs as users run it, in a process and a network namespace of its own; the master is pysoem with its socket
set to non-blocking, which polls for the answer. With two CPUs master and segment get one each.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import pysoem

AF_PACKET_LINK = "socket:"
RECEIVE_TIMEOUT_US = 2000
SETTLE_CYCLES = 300
AIM_P50_US = 80.0


@dataclass(frozen=True)
class Result:
    slaves: int
    period_us: int
    polling: bool
    p50_us: float
    p99_us: float
    max_us: float
    lost: int
    segment_cpu_percent: float
    """CPU time of the segment's process, devices included, in percent of one CPU."""


def write_config(path: Path, slaves: int) -> None:
    models = ["diewu-io", *["cubemars-orh70"] * (slaves - 1)]
    drifts = [3.0, -12.0, 17.5, -20.0, 8.0, -5.5, 20.0]
    lines = [f"  - {{model: {m}, drift_ppm: {drifts[n % 7]}}}" for n, m in enumerate(models)]
    path.write_text("slaves:\n" + "\n".join(lines) + "\n", encoding="utf-8")


def join_network(pid: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    for kind in ("user", "net"):
        if os.stat(f"/proc/{pid}/ns/{kind}").st_ino == os.stat(f"/proc/self/ns/{kind}").st_ino:
            continue
        with open(f"/proc/{pid}/ns/{kind}", "rb") as namespace:
            if libc.setns(namespace.fileno(), 0):
                raise OSError(ctypes.get_errno(), f"cannot join the {kind} namespace of process {pid}")


def make_non_blocking(before: set[str]) -> None:
    for entry in set(os.listdir("/proc/self/fd")) - before:
        try:
            if os.readlink(f"/proc/self/fd/{entry}").startswith(AF_PACKET_LINK):
                os.set_blocking(int(entry), False)
        except OSError:
            continue  # the descriptor of the directory listing itself


def cpu_seconds(pid: int) -> float:
    """User and system time of a process, from fields 14 and 15 of its stat file."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def tolerates_stalls(slave: pysoem.CdefSlave) -> bool:
    """Switch the sync error off (0x10F1:02 = 0): a stall of this machine is to be measured and not to end it all."""
    try:
        slave.sdo_write(0x10F1, 2, bytes(2))
    except pysoem.SdoError:
        return False  # the IO box: it works without SYNC0
    return True


def to_op(master: pysoem.Master, period_ns: int) -> None:
    master.config_init()
    master.state_check(pysoem.PREOP_STATE, 2_000_000)
    synchronous = [slave for slave in master.slaves if tolerates_stalls(slave)]
    master.config_map()
    master.config_dc()
    if master.state_check(pysoem.SAFEOP_STATE, 2_000_000) != pysoem.SAFEOP_STATE:
        raise RuntimeError("the slaves did not reach SAFE-OP")
    for slave in synchronous:
        slave.dc_sync(True, period_ns, period_ns // 2)
    master.state = pysoem.OP_STATE
    master.write_state()


def measure(slaves: int, period_us: int, polling: bool, seconds: float) -> Result:
    cpus = sorted(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "segment.yaml"
        write_config(config, slaves)
        command = [sys.executable, "-m", "rtcp.virtual", "--config", str(config)]
        if polling:
            command += ["--poll"]
        if len(cpus) > 1:
            command += ["--cpu", str(cpus[-1])]
            os.sched_setaffinity(0, {cpus[0]})
        segment = subprocess.Popen(command, stdout=subprocess.PIPE)
        try:
            assert segment.stdout is not None
            ready = json.loads(segment.stdout.readline())
            join_network(ready["pid"])
            return exchange(ready["pid"], slaves, period_us, polling, seconds)
        finally:
            segment.terminate()
            segment.wait(10)


def exchange(pid: int, slaves: int, period_us: int, polling: bool, seconds: float) -> Result:
    master = pysoem.Master()
    before = set(os.listdir("/proc/self/fd"))
    master.open("ecat0")
    make_non_blocking(before)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80))
    except PermissionError:
        print("no right to SCHED_FIFO: the figures carry other processes' work", file=sys.stderr)
    period = period_us * 1000
    to_op(master, period)
    trips: list[int] = []
    lost = 0
    cycles = int(seconds * 1e9 / period)
    wake = time.monotonic_ns()
    # SYNC0 lies at half the reference slave's cycle: frames go out at its start.
    master.send_processdata()
    master.receive_processdata(RECEIVE_TIMEOUT_US)
    wake += period - master.dc_time % period
    started = 0.0
    for cycle in range(cycles + SETTLE_CYCLES):
        wake += period
        time.sleep(max(0, wake - time.monotonic_ns()) * 1e-9)
        begin = time.perf_counter_ns()
        master.send_processdata()
        counter = master.receive_processdata(min(RECEIVE_TIMEOUT_US, period_us // 2))
        end = time.perf_counter_ns()
        if cycle == SETTLE_CYCLES:
            started = cpu_seconds(pid)
        if cycle < SETTLE_CYCLES:
            continue
        if counter == master.expected_wkc:
            trips.append(end - begin)
        else:
            lost += 1
    used = cpu_seconds(pid) - started
    state = master.read_state()
    codes = sorted({pysoem.al_status_code_to_string(slave.al_status) for slave in master.slaves if slave.al_status})
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    if state != pysoem.OP_STATE:
        raise RuntimeError(f"the slaves left OP during the measurement: {codes}")
    trips.sort()
    return Result(
        slaves, period_us, polling, trips[len(trips) // 2] / 1000, trips[len(trips) * 99 // 100] / 1000,
        trips[-1] / 1000, lost, 100 * used / seconds,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each measurement lasts")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument("--one", nargs=3, metavar=("SLAVES", "PERIOD_US", "POLL"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        slaves, period_us, polling = map(int, arguments.one)
        print(json.dumps(asdict(measure(slaves, period_us, bool(polling), arguments.seconds))))
        return
    results = []
    # Joining a namespace cannot be undone: each measurement has a process of its own.
    for slaves, period_us in ((7, 1000), (7, 500), (32, 2000)):
        for polling in (0, 1):
            command = [sys.executable, __file__, "--seconds", str(arguments.seconds)]
            done = subprocess.run([*command, "--one", str(slaves), str(period_us), str(polling)],
                                  check=True, stdout=subprocess.PIPE)  # fmt: skip
            results.append(Result(**json.loads(done.stdout)))
    if arguments.json:
        print(json.dumps([asdict(result) for result in results], indent=2))
        return
    print("slaves  period us  mode      p50 us  p99 us  max us  lost  segment CPU %")
    for r in results:
        mode = "polling" if r.polling else "blocking"
        print(f"{r.slaves:6}  {r.period_us:9}  {mode:8}  {r.p50_us:6.1f}  {r.p99_us:6.1f}  {r.max_us:6.0f}  {r.lost:4}"
              f"  {r.segment_cpu_percent:13.0f}")  # fmt: skip
    print(f"aim: p50 of 7 slaves at 1000 us, blocking, at most {AIM_P50_US:.0f} us")


if __name__ == "__main__":
    main()
