"""CPU and memory of each process while the arm holds, moves, jogs and is recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping

import psutil

from rtcp.api import Robot
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_processes
from rtcp.telemetry.experiments.experiment import SPEED_RAD_S, Experiment, Row, Setup

SOURCE_PERCENT = 30.0
"""CPU load of the thesis' quad core computer, %; its slaves were hardware, so the virtual segment does not count."""
SOURCE_CORES = 4
_REACH_RAD = 0.2
_JOG_RAD_S, _JOG_INTERVAL_S, _JOG_TURN_S = 0.05, 0.05, 2.0
_MB = 1e6


class ResourcesExperiment(Experiment):
    """CPU and memory of the platform's processes.

    Args:
        seconds: duration of each activity, s.
    """

    name = "resources"
    title = "CPU and memory by process"

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        rows: list[Row] = []
        memory: dict[str, float] = {}
        with setup.platform() as robot:
            activities: Mapping[str, Callable[[float], None]] = {
                "holding": lambda until: time.sleep(until - time.monotonic()),
                "moving": lambda until: _move(robot, until),
                "jogging": lambda until: _jog(robot, until),
                "recording": lambda until: memory.update(self._record(setup, robot, until)),
            }
            for name, do in activities.items():
                cores, resident = self._measure(robot, do)
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
        self._draw(setup, rows)
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
    def _draw(setup: Setup, rows: list[Row]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.0, 4.0), layout="constrained")
        axes = figure.add_subplot()
        shares = [row for row in rows if row.unit == "% of a core"]
        axes.barh([row.figure for row in shares], [row.here for row in shares])
        axes.invert_yaxis()
        axes.set(xlabel="% of a core")
        axes.grid(alpha=0.3, axis="x")
        setup.draw("resources", figure)


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
        robot.jog([sign * _JOG_RAD_S] * len(here), frame="joints")
        time.sleep(_JOG_INTERVAL_S)
    robot.move_joints(here, speed=SPEED_RAD_S)
