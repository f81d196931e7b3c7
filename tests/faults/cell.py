"""The fault matrix of a cell of two virtual IRB 120: faults of the right one at rest, in motion and in step."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from rtcp.api import Robot, RtcpError, State
from rtcp.api.cell import Cell
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, irc5_control
from rtcp.ipc.session import is_running, read_processes
from rtcp.virtual.request_socket import RequestClient, RequestRefused, ServerAway
from tests.cell.running import ABB_HOME, CONFIG, Records, RunningCell, put_in_order

LEFT, RIGHT = "left", "right"
AT_REST, IN_MOTION, IN_STEP = "at rest", "in motion", "in step"
WORKLOADS = (AT_REST, IN_MOTION, IN_STEP)
HELD = "holds"
GOES_ON = "goes on"
FAULT = "fault"
ENDED = "loop ended"
TARGET: Final = {LEFT: [0.5, 0.2, 0.1, 0.0, 0.5, 0.3], RIGHT: [-0.5, 0.1, -0.1, 0.1, 0.6, 0.0]}
SPEED, PATIENCE_S = 0.2, 20.0
MOVED_RAD: Final = 0.003


@dataclass(frozen=True)
class Case:
    """A fault of the right arm, and the required reaction of both."""

    name: str
    requests: Sequence[Mapping[str, Any]] = ()
    """Requests to its virtual controller."""
    process: str = ""
    """Its process that gets `signal`: segment (the virtual controller), loop or gateway."""
    signal: signal.Signals = signal.SIGKILL
    command: str = ""
    """Command of another client to it."""
    right: str = FAULT


CASES = (
    Case("halt at one arm", command="halt", right=HELD),
    Case("disable at one arm", command="disable", right="ready"),
    Case("gateway killed", process="gateway", right=HELD),
    Case("loop killed", process="loop", right=ENDED),
    Case("loop suspended for 2 s", process="loop", signal=signal.SIGSTOP),
    Case("controller killed", process="segment"),
    Case("bus: no message for good", [{"do": "fault", "fault": "silent", "direction": "to_pc"}]),
    Case("emergency stop at its controller", [{"do": "stop", "circuit": "emergency"}]),
    Case("motors off", [{"do": "motors_off"}]),
    Case("RAPID stopped", [{"do": "fault", "fault": "rapid_stop"}]),
    Case("collision", [{"do": "fault", "fault": "collision"}]),
)


@dataclass
class Result:
    """What a trial measured."""

    left: str = "-"
    right: str = "-"
    reaction_ms: float | None = None
    """From the fault until the left arm's setpoints slow down or stand; None: they do not."""
    standstill_s: float | None = None
    apart_ms: float | None = None
    """Difference of the paths' times at rest."""
    message: str = ""
    recovery_s: float = 0.0
    problems: list[str] = field(default_factory=list)


class Trials:
    """The running cell; restarted after a process was killed."""

    def __init__(self) -> None:
        self.cell = RunningCell((CONFIG / "cell.yaml").read_text())

    def close(self) -> None:
        """Stop it."""
        self.cell.end()

    def operator(self) -> RequestClient:
        """Return a connection to the right arm's controller."""
        return RequestClient(irc5_control(self.cell.of(RIGHT)), server="virtual IRC5")

    def state(self, name: str) -> str:
        """Return the state of an arm by its newest record, in words."""
        directory = self.cell.of(name)
        if not is_running(read_processes(directory).loop):
            return ENDED
        with contextlib.closing(Observer(blackboard_file(directory))) as observer:
            record = observer.latest()
        assert record is not None
        state = State(int(record["state"][0]))
        if state in (State.HOLDING, State.STOPPED_BY_LIMIT):
            return HELD
        return state.words if state is not State.MOVING else GOES_ON

    def until(self, name: str, *states: str, seconds: float = PATIENCE_S) -> str:
        """Wait until an arm is in one of these states; return its state."""
        end = time.monotonic() + seconds
        while (now := self.state(name)) not in states and time.monotonic() < end:
            time.sleep(0.02)
        return now

    def recover(self, killed: bool) -> None:
        """Recover, reset, enable and go home; restart killed processes."""
        if killed:
            for name in (LEFT, RIGHT):
                self.cell.platform.rtcp("--name", name, "stop", check=None)
            file = str(self.cell.file)
            self.cell.platform.rtcp("cell", "start", "--detach", "--config", file)
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                with self.operator() as operator:
                    put_in_order(operator)
                with self.cell.connect() as cell:
                    cell.reset()
                    for name, status in cell.status().items():
                        if status.state is State.READY:
                            cell.arms[name].enable()
                    cell.move_joints(dict.fromkeys(cell.arms, ABB_HOME), SPEED * 2)
                    return
            except (RtcpError, RequestRefused):
                # The controller accepts references again after a moment.
                if time.monotonic() > end:
                    raise
                time.sleep(0.2)


class Workload:
    """Both arms move, each by itself or in step; from threads, until they are ended."""

    def __init__(self, trials: Trials, kind: str) -> None:
        self.errors: dict[str, RtcpError] = {}
        self._threads: list[threading.Thread] = []
        self._cell: Cell | None = None
        if kind == IN_STEP:
            self._threads = [threading.Thread(target=self._in_step, args=(trials,))]
        elif kind == IN_MOTION:
            self._threads = [threading.Thread(target=self._alone, args=(trials, name)) for name in (LEFT, RIGHT)]
        for thread in self._threads:
            thread.start()

    def _in_step(self, trials: Trials) -> None:
        try:
            with trials.cell.connect() as cell:
                cell.move_joints(TARGET, SPEED)
        except RtcpError as error:
            self.errors["cell"] = error

    def _alone(self, trials: Trials, name: str) -> None:
        try:
            with Robot("a trial", control_socket(trials.cell.of(name))) as robot:
                robot.move_joints(TARGET[name], SPEED)
        except RtcpError as error:
            self.errors[name] = error

    def join(self) -> None:
        """Wait for the end."""
        for thread in self._threads:
            thread.join(PATIENCE_S)


def run_case(trials: Trials, case: Case, kind: str) -> Result:
    """Run a case; `problems` of the result are violations."""
    result = Result()
    records = Records(trials.cell)
    workload = Workload(trials, kind)
    try:
        if kind != AT_REST:
            records.await_speed(0.15)
        began_ns = _strike(trials, case)
        _observe(trials, case, kind, result, records, began_ns)
        workload.join()
        began = time.monotonic()
        trials.recover(case.process != "" and case.signal is signal.SIGKILL)
        result.recovery_s = time.monotonic() - began
    except (AssertionError, RtcpError, RequestRefused, ServerAway) as error:
        result.problems.append(f"the trial ended: {type(error).__name__}: {error}")
        trials.recover(killed=True)
    return result


def _strike(trials: Trials, case: Case) -> int:
    """Cause the fault; return its instant."""
    if case.requests:
        with trials.operator() as operator:
            began_ns = time.monotonic_ns()
            for request in case.requests:
                operator.ask(dict(request))
        return began_ns
    if case.command:
        with Robot("somebody", control_socket(trials.cell.of(RIGHT))) as robot:
            began_ns = time.monotonic_ns()
            getattr(robot, case.command)()
        return began_ns
    pid = getattr(read_processes(trials.cell.of(RIGHT)), case.process)
    began_ns = time.monotonic_ns()
    os.kill(pid, case.signal)
    return began_ns


def _observe(trials: Trials, case: Case, kind: str, result: Result, records: Records, began_ns: int) -> None:
    """Observe the reactions of both arms."""
    result.right = trials.until(RIGHT, case.right, seconds=3.0 if case.right != HELD or kind == AT_REST else PATIENCE_S)
    if case.signal is signal.SIGSTOP:
        time.sleep(2.0)
        os.kill(read_processes(trials.cell.of(RIGHT)).loop, signal.SIGCONT)
        result.right = trials.until(RIGHT, case.right)
    result.left = trials.until(LEFT, HELD)
    if result.right != case.right:
        result.problems.append(f"the right arm: {result.right}, required is {case.right}")
    if result.left != HELD:
        result.problems.append(f"the left arm: {result.left}")
    with Robot("a trial", control_socket(trials.cell.of(LEFT))) as robot:
        events = robot.events()
    result.message = next((event.message for event in reversed(events) if event.name.startswith("partner")), "-")
    if kind != IN_STEP:
        result.message = "-"
    rows = records.read()[LEFT]
    rows = rows[rows["time_ns"] >= began_ns]
    speed = np.abs(rows["commanded_velocity"]).max(axis=1)
    full = speed[0] if len(speed) else 0.0
    if kind == IN_STEP:
        paths = records.paths()
        phases = {name: int(record["step_phase"][0]) for name, record in records.newest().items()}
        ends = [event.name for event in events][-6:]
        if not {"partner_stopped", "partner_left", "partner_silent"} & set(ends):
            result.problems.append(f"the left arm did not stop with its partner: {ends}")
        braking = np.flatnonzero(rows["step_phase"] >= 3)
        if len(braking):
            result.reaction_ms = 1e-6 * float(rows["time_ns"][braking[0]] - began_ns)
        if case.command or case.process == "gateway":
            result.apart_ms = 1e3 * abs(paths[LEFT] - paths[RIGHT])
            if result.apart_ms > 2.0:  # a loop that the host delayed comes to rest a little further on
                result.problems.append(f"the paths are {result.apart_ms:.2f} ms apart at rest: {phases}")
    elif kind == AT_REST and full > 0.0:
        result.problems.append("the left arm moved")
    stands = np.flatnonzero(speed > 0.0)
    if kind != AT_REST and len(stands):
        result.standstill_s = 1e-9 * float(rows["time_ns"][stands[-1]] - began_ns)


HEADS = (
    "fault of the right arm", "while", "right", "left", "left brakes, ms", "stands, s", "paths apart, ms",
    "the left arm says", "recovery, s",
)  # fmt: skip


def columns(case: Case, kind: str, result: Result) -> list[str]:
    """Return the row of a table."""

    def shown(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    says = "; ".join([result.message, *(f"WRONG: {problem}" for problem in result.problems)])
    return [
        case.name, kind, result.right, result.left, shown(result.reaction_ms, 1), shown(result.standstill_s, 2),
        shown(result.apart_ms, 3), says, shown(result.recovery_s, 1),
    ]  # fmt: skip
