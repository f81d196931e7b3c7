"""CPU, memory and network of the machine before and while the platform runs, and of each process in each activity."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil

from rtcp.api import Robot, TimedOut
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_processes
from rtcp.telemetry.experiments.experiment import SPEED_RAD_S, Experiment, Row, Setup

SOURCE_PERCENT = 30.0
"""CPU load of the thesis' quad core computer, %; its slaves were hardware, so the virtual segment does not count."""
SOURCE_CORES = 4
SOURCE_MACHINE_PERCENT = (20.0, 30.0)
"""CPU load of the thesis' whole machine (Jetson Nano) before and while the program ran, %; 10 and 20 on a PC."""
_REACH_RAD = 0.2
_JOG_RAD_S, _JOG_INTERVAL_S, _JOG_TURN_S = 0.05, 0.05, 2.0
_MB = 1e6


class Machine(NamedTuple):
    """Load of the whole machine: CPU, %; memory in use, MB; sent and received by the network interfaces, kB/s.

    The network interfaces are those of the host and, while there is one, those of the virtual bus.
    """

    cpu_percent: float
    memory_mb: float
    sent_kb_s: float
    received_kb_s: float


class MachineMeter:
    """Measures the machine from its construction on.

    Args:
        loop: pid of the platform's loop, whose namespace has the interfaces of a virtual bus; None: no platform.
    """

    def __init__(self, loop: int | None = None) -> None:
        processes = ("self",) if loop is None else ("self", str(loop))
        self._interfaces = [Path("/proc") / process / "net" / "dev" for process in processes]
        self._bytes = traffic(*(file.read_text() for file in self._interfaces))
        self._begun, self._times = time.monotonic(), psutil.cpu_times()

    def read(self) -> Machine:
        """Return the means since the begin, and the memory in use now."""
        seconds, now = time.monotonic() - self._begun, psutil.cpu_times()
        exchanged = traffic(*(file.read_text() for file in self._interfaces))
        passed = {name: getattr(now, name) - getattr(self._times, name) for name in now._fields}
        # Time of guests is a part of user and nice.
        all_s = sum(spent for name, spent in passed.items() if not name.startswith("guest"))
        idle_s = passed["idle"] + passed.get("iowait", 0.0)
        memory = psutil.virtual_memory()
        sent, received = (
            (after - before) / seconds * 1e-3 for before, after in zip(self._bytes, exchanged, strict=True)
        )
        return Machine(100.0 * (1.0 - idle_s / (all_s or 1.0)), (memory.total - memory.available) / _MB, sent, received)


def traffic(*namespaces: str) -> tuple[int, int]:
    """Return the bytes sent and received by all interfaces but the loopback one.

    Args:
        namespaces: the text of `/proc/PID/net/dev` of each namespace; an interface that is in two of them counts once.
    """
    counters: dict[str, list[str]] = {}
    for line in (line for text in namespaces for line in text.splitlines()[2:]):
        name, numbers = line.split(":")
        counters[name.strip()] = numbers.split()
    counters.pop("lo", None)
    return sum(int(numbers[8]) for numbers in counters.values()), sum(int(numbers[0]) for numbers in counters.values())


class ResourcesExperiment(Experiment):
    """CPU and memory of the platform's processes, and the load of the machine before it was started and with it.

    Args:
        seconds: duration of each activity, s.
    """

    name = "resources"
    title = "CPU, memory and network of the machine, and by process"

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        rows: list[Row] = []
        memory: dict[str, float] = {}
        meter = MachineMeter()
        time.sleep(self._seconds)
        machine = {"before": meter.read()}
        with setup.platform() as robot:
            loop = read_processes(runtime_directory()).loop
            activities: Mapping[str, Callable[[float], None]] = {
                "holding": lambda until: time.sleep(until - time.monotonic()),
                "moving": lambda until: _move(robot, until),
                "jogging": lambda until: _jog(robot, until),
                "recording": lambda until: memory.update(self._record(setup, robot, until)),
            }
            for name, do in activities.items():
                meter = MachineMeter(loop)
                cores, resident = self._measure(robot, do)
                machine[name] = meter.read()
                memory |= resident
                platform = sum(share for process, share in cores.items() if process != "segment")
                setup.report(f"{name}: {100 * platform:.1f} % of a core")
                rows += [Row(f"{name}: {process}", "% of a core", 100 * share) for process, share in cores.items()]
                most = SOURCE_PERCENT if name != "recording" else None
                rows.append(
                    Row(
                        f"{name}: platform", "% of four cores", 100 * platform / SOURCE_CORES, SOURCE_PERCENT, most=most
                    )
                )
            rows += [Row(f"{process}: resident", "MB", size) for process, size in memory.items()]
        rows += _machine_rows(machine)
        self._draw(setup, rows, machine)
        return rows

    def _measure(self, robot: Robot, do: Callable[[float], None]) -> tuple[dict[str, float], dict[str, float]]:
        """Return, for each process, its share of a core and its resident memory, MB, during an activity."""
        processes = dict(_processes())
        before = {name: process.cpu_times() for name, process in processes.items()}
        begun = time.monotonic()
        do(begun + self._seconds)
        seconds = time.monotonic() - begun
        cores = {}
        for name, process in processes.items():
            then, now = before[name], process.cpu_times()
            cores[name] = (now.user + now.system - then.user - then.system) / seconds
            ended = now.children_user + now.children_system - then.children_user - then.children_system
            if ended:
                cores["recorder"] = ended / seconds  # a child of the gateway, started and ended meanwhile
        memory = {name: process.memory_info().rss / _MB for name, process in processes.items()}
        return cores, memory

    def _record(self, setup: Setup, robot: Robot, until: float) -> dict[str, float]:
        with setup.recording(robot) as path:
            time.sleep(max(0.0, until - time.monotonic()))
            # The arm's configuration may have started another recorder.
            pid = next(status.pid for status in robot.record_status() if str(path.absolute()) in status.files)
            return {"recorder": psutil.Process(pid).memory_info().rss / _MB}

    @staticmethod
    def _draw(setup: Setup, rows: list[Row], machine: Mapping[str, Machine]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(12.0, 5.0), layout="constrained")
        processes, *others = figure.subplots(1, 4, width_ratios=(3, 1, 1, 1))
        shares = [row for row in rows if row.unit == "% of a core"]
        processes.barh([row.figure for row in shares], [row.here for row in shares])
        processes.invert_yaxis()
        processes.set(xlabel="process, % of a core")
        names = list(machine)
        network = [load.sent_kb_s + load.received_kb_s for load in machine.values()]
        for axes, label, values in zip(
            others,
            ("machine, CPU, %", "machine, memory in use, MB", "machine, network, kB/s"),
            ([load.cpu_percent for load in machine.values()], [load.memory_mb for load in machine.values()], network),
            strict=True,
        ):
            axes.bar(names, values, color=["0.6", *["tab:blue"] * (len(names) - 1)])
            axes.set(ylabel=label)
            axes.tick_params(axis="x", rotation=60)
        for axes in (processes, *others):
            axes.grid(alpha=0.3, axis="x" if axes is processes else "y")
        setup.draw("resources", figure)


def _machine_rows(machine: Mapping[str, Machine]) -> Iterator[Row]:
    """Return the load of the machine before the platform was started, and in each activity."""
    before, running = SOURCE_MACHINE_PERCENT
    for name, load in machine.items():
        yield Row(f"machine, {name}: CPU", "%", load.cpu_percent, before if name == "before" else running)
        yield Row(f"machine, {name}: memory in use", "MB", load.memory_mb)
        yield Row(f"machine, {name}: network, sent", "kB/s", load.sent_kb_s)
        yield Row(f"machine, {name}: network, received", "kB/s", load.received_kb_s)


def _processes() -> Iterator[tuple[str, psutil.Process]]:
    pids = read_processes(runtime_directory())
    for name in ("loop", "gateway", "segment"):
        if pid := getattr(pids, name):
            yield name, psutil.Process(pid)


def _move(robot: Robot, until: float) -> None:
    here = robot.status().positions
    there = [q + (_REACH_RAD if q < 0 else -_REACH_RAD) for q in here]
    while time.monotonic() < until:
        robot.move_joints(there, speed=SPEED_RAD_S)
        robot.move_joints(here, speed=SPEED_RAD_S)


def _jog(robot: Robot, until: float) -> None:
    here = robot.status().positions
    while (now := time.monotonic()) < until:
        sign = 1.0 if now % (2 * _JOG_TURN_S) < _JOG_TURN_S else -1.0
        with suppress(TimedOut):  # late on a busy host, without effect: the next one follows
            robot.jog([sign * _JOG_RAD_S] * len(here), frame="joints")
        time.sleep(_JOG_INTERVAL_S)
    robot.move_joints(here, speed=SPEED_RAD_S)
