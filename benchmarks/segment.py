"""How fast the virtual segment answers: round trips of a real pysoem master; 7 to 64 slaves, compiled and as source.

64 slaves are one IO box and 63 drives; those of an ESI file (`esi`) are couplers, terminals of 2 and 4 bits, boxes with
four sync managers of process data and, one in four, drives with the behaviour `cia402`.

    python benchmarks/segment.py [--seconds 5] [--rounds 3] [--peer "simulator -i {interface} ..."] [--json]

The segment runs as users run it, in a process and a network namespace of its own; the master is pysoem with its socket
set to non-blocking, which polls for the answer. With two CPUs master and segment get one each. `--peer` measures
another segment of 7 slaves on a veth pair in the same way, under SCHED_OTHER and SCHED_FIFO. All alternate, round after
round.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path

import pysoem

from kinematics.compiled import BUILD, PURE

AF_PACKET_LINK = "socket:"
RECEIVE_TIMEOUT_US = 2000
SETTLE_CYCLES = 300
CLONE_NEWNET = 0x40000000
MASTER_END, PEER_END = "ecat0", "peer0"
PEER_STARTS_S = 1.0
CASES = (
    (7, 1000, 0, 0), (7, 1000, 1, 0), (7, 500, 0, 0), (7, 500, 1, 0), (32, 2000, 0, 0), (64, 2000, 0, 0),
    (64, 2000, 1, 0), (64, 2000, 0, 1), (64, 2000, 1, 1),
)  # fmt: skip
"""Slaves, period in us, whether the segment polls, whether the slaves are those of an ESI file."""
VENDOR = Path(__file__).resolve().parents[1] / "tests" / "virtual" / "vendor.xml"
DESCRIBED = ("0x10", "0x11", "0x12", "0x20, behaviour: cia402", "0x11", "0x12", "0x30", "0x20, behaviour: cia402")


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
    described: bool = False


def write_config(path: Path, slaves: int, described: bool) -> None:
    if described:
        entries = [f"  - {{esi: {VENDOR}, product: {DESCRIBED[n % len(DESCRIBED)]}}}" for n in range(slaves)]
        path.write_text("slaves:\n" + "\n".join(entries) + "\n", encoding="utf-8")
        return
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
    except (pysoem.SdoError, pysoem.MailboxError, pysoem.PacketError, pysoem.WkcError):
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


def measure(slaves: int, period_us: int, polling: bool, described: bool, seconds: float) -> Result:
    master_cpu, segment_cpu = choose_cpus()
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "segment.yaml"
        write_config(config, slaves, described)
        command = [sys.executable, "-m", "rtcp.virtual", "--config", str(config)]
        if polling:
            command += ["--poll"]
        if segment_cpu is not None:
            command += ["--cpu", str(segment_cpu)]
            os.sched_setaffinity(0, {master_cpu})
        segment = subprocess.Popen(command, stdout=subprocess.PIPE)
        try:
            assert segment.stdout is not None
            ready = json.loads(segment.stdout.readline())
            join_network(ready["pid"])
            return replace(exchange(ready["pid"], slaves, period_us, polling, seconds), described=described)
        finally:
            segment.terminate()
            segment.wait(10)


def measure_peer(command: str, slaves: int, period_us: int, fifo: bool, seconds: float) -> Result:
    """Measure another segment: `command` answers at the interface that stands for {interface} in it."""
    from pyroute2 import IPRoute

    if ctypes.CDLL(None, use_errno=True).unshare(CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "a network namespace of its own needs root")
    with IPRoute() as links:
        links.link("add", ifname=MASTER_END, kind="veth", peer={"ifname": PEER_END})
        for name in (MASTER_END, PEER_END):
            # No frame but EtherCAT on the cable.
            Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1")
            links.link("set", index=links.link_lookup(ifname=name)[0], state="up")
    master_cpu, peer_cpu = choose_cpus()
    peer = subprocess.Popen(shlex.split(command.format(interface=PEER_END)), stdout=subprocess.DEVNULL)
    try:
        if peer_cpu is not None:
            os.sched_setaffinity(peer.pid, {peer_cpu})
            os.sched_setaffinity(0, {master_cpu})
        if fifo:
            os.sched_setscheduler(peer.pid, os.SCHED_FIFO, os.sched_param(70))
        time.sleep(PEER_STARTS_S)
        return exchange(peer.pid, slaves, period_us, False, seconds)
    finally:
        peer.terminate()
        peer.wait(10)


def choose_cpus() -> tuple[int, int | None]:
    """Return the master's CPU and the segment's; None where there is one CPU only."""
    cpus = sorted(os.sched_getaffinity(0))
    return cpus[0], cpus[-1] if len(cpus) > 1 else None


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
    # SOEM counts slaves that share a byte wrongly: what comes most often while it settles is right.
    settling: Counter[int] = Counter()
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
            settling[counter] += counter > 0 and cycle > SETTLE_CYCLES // 2
            continue
        if counter == settling.most_common(1)[0][0]:
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each measurement lasts")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--peer", help="command of another segment, with {interface} where it is to answer")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument("--one", nargs=4, metavar=("SLAVES", "PERIOD_US", "POLL", "ESI"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        slaves, period_us, polling, described = map(int, arguments.one)
        if arguments.peer:
            result = measure_peer(arguments.peer, slaves, period_us, bool(polling), arguments.seconds)
        else:
            result = measure(slaves, period_us, bool(polling), bool(described), arguments.seconds)
        print(json.dumps(asdict(result)))
        return
    table: dict[tuple[str, int, int, str], list[Result]] = {}
    for _ in range(arguments.rounds):
        for slaves, period_us, polling, described in CASES:
            for pure, who in (("", "ours"), ("1", "as source")):
                key = (who, slaves, period_us, ("esi, " if described else "") + ("polling" if polling else "blocking"))
                one = measure_in_process(arguments, slaves, period_us, polling, described, pure, "")
                table.setdefault(key, []).append(one)
        if arguments.peer:
            for fifo in (0, 1):
                key = ("the peer", 7, 1000, "SCHED_FIFO" if fifo else "SCHED_OTHER")
                table.setdefault(key, []).append(measure_in_process(arguments, 7, 1000, fifo, 0, "", arguments.peer))
    if arguments.json:
        print(json.dumps([{"who": who, **asdict(r)} for (who, *_), found in table.items() for r in found], indent=2))
        return
    state = BUILD.reason or "compiled"
    print(f"{platform.machine()}, Linux {platform.release()}, {date.today().isoformat()}; ours: {state}")
    print("            slaves  period us  mode          p50 us (over the rounds)   p99 us  lost  CPU %")
    for (who, slaves, period_us, mode), found in sorted(table.items(), key=lambda item: item[0][1:3] + item[0][:1]):
        p50, spread = statistics.median(r.p50_us for r in found), sorted(r.p50_us for r in found)
        print(f"{who:10}  {slaves:6}  {period_us:9}  {mode:12}  {p50:6.1f} ({spread[0]:.1f} to {spread[-1]:.1f})"
              f"{statistics.median(r.p99_us for r in found):17.1f}  {sum(r.lost for r in found):4}"
              f"  {statistics.median(r.segment_cpu_percent for r in found):5.0f}")  # fmt: skip


def measure_in_process(
    given: argparse.Namespace, slaves: int, period_us: int, flag: int, described: int, pure: str, peer: str
) -> Result:
    """Measure once, in a process of its own: joining a namespace cannot be undone."""
    command = [sys.executable, __file__, "--seconds", str(given.seconds), *(("--peer", peer) if peer else ())]
    command += ["--one", str(slaves), str(period_us), str(flag), str(described)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env={**os.environ, PURE: pure})
    return Result(**json.loads(done.stdout))


if __name__ == "__main__":
    main()
