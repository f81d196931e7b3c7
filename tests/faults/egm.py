"""The fault matrix of an arm behind a controller that speaks EGM: trials on the virtual IRC5.

What a trial requires of every fault: the joints come to rest within their limits, every reference on the wire is within
the limits of position and speed, nothing moves when the operator has put things in order, and a reset and enable lead
back. A case says what else: the state of the platform, and words in its messages.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtcp.api import Robot, RtcpError
from rtcp.config import default_config, load
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ipc.session import read_session
from rtcp.telemetry.harness import Harness
from rtcp.telemetry.trial import CONTINUES as GOES_ON
from rtcp.virtual.request_socket import RequestClient, RequestRefused, ServerAway
from tests.e2e.conftest import Platform, kill
from tests.faults import egm_wire
from tests.faults.cases import CONTINUES, FAULT, HOLDING, MOVING, STOPS

CONFIG = load(default_config().parent / "abb_irb120.yaml")
PORT = 6511
START = (0.0, 0.2, 0.4, 0.0, 0.4, 0.0)
SWING = (0.35, 0.25, -0.25, 0.35, 0.35, 0.35)
"""rad."""
SPEED, CHECK_RAD, MOVED_RAD = 0.4, 0.02, 0.003
STILL_S, WATCH_S, PATIENCE_S = 0.3, 1.0, 20.0
ENDED = "loop ended"
"""The reaction where the loop's process is killed: its controller stops by CommTimeout."""
Request = Mapping[str, Any]
LIMITS = egm_wire.Limits(
    [math.degrees(joint.position.min) for joint in CONFIG.joints],
    [math.degrees(joint.position.max) for joint in CONFIG.joints],
    [math.degrees(joint.velocity) for joint in CONFIG.joints],
)


@dataclass(frozen=True)
class Case:
    """A fault, and the required reaction."""

    name: str
    requests: Sequence[Request] = ()
    """Requests to the virtual controller."""
    ends_in: tuple[str, ...] = (FAULT,)
    words: str = ""
    """Text in a message of the platform before recovery."""
    refused: str = ""
    """Text in the refusal of an enable before recovery; empty: not tried."""
    process: str = ""
    """Process that gets `signal`: segment (the virtual controller), loop or gateway."""
    signal: signal.Signals = signal.SIGKILL
    hand: bool = False
    """Whether the controller is in Hand, its enabling device held."""
    workloads: tuple[str, ...] = (HOLDING, MOVING)


def _fault(kind: str, direction: str = "to_pc", **more: Any) -> Request:
    return {"do": "fault", "fault": kind, "direction": direction, **more}


def _open(circuit: str) -> Request:
    return {"do": "stop", "circuit": circuit}


MOTORS, PROGRAM, CLEARANCE = "the motors are off", "program is stopped", "the controller reports a fault"
SILENT = "no message comes from the robot controller"
CASES = (
    Case("controller: killed", process="segment", words=SILENT),
    Case("controller: stopped for 2 s", process="segment", signal=signal.SIGSTOP, words=SILENT),
    Case("messages to the PC: none", [_fault("silent")], words=SILENT, refused=SILENT),
    Case("messages to the PC: 1 in 5 lost", [_fault("lost", value=0.2)], (CONTINUES,)),
    Case("messages to the PC: 9 in 10 lost", [_fault("lost", value=0.9)]),
    Case("messages to the PC: all twice", [_fault("doubled", value=1.0)], (CONTINUES,)),
    Case("messages to the PC: 1 in 5 an old one", [_fault("old", value=0.2)], (CONTINUES,)),
    Case("messages to the PC: 40 ms late", [_fault("late", value=10)], (CONTINUES,)),
    Case("replies: none", [_fault("silent", "from_pc")]),
    Case("replies: 1 in 5 lost", [_fault("lost", "from_pc", value=0.2)], (CONTINUES,)),
    Case("replies: all twice", [_fault("doubled", "from_pc", value=1.0)], (CONTINUES,)),
    Case("replies: 1 in 5 an old one", [_fault("old", "from_pc", value=0.2)], (CONTINUES,)),
    Case("replies: 40 ms late", [_fault("late", "from_pc", value=10)], (CONTINUES,)),
    Case("loop: killed", process="loop", ends_in=(ENDED,)),
    Case("gateway: killed", process="gateway", ends_in=(STOPS,), workloads=(MOVING,)),
    Case("emergency stop", [_open("emergency")], words=MOTORS, refused=MOTORS),
    Case("automatic stop", [_open("automatic")], words=MOTORS, refused=MOTORS),
    Case("motors off", [{"do": "motors_off"}], words=MOTORS, refused=MOTORS),
    Case("Hand: enabling device released", [{"do": "enabling", "position": "released"}], words=MOTORS, refused=MOTORS,
         hand=True),
    Case("Hand: enabling device pressed through", [{"do": "enabling", "position": "through"}], words=MOTORS,
         refused=MOTORS, hand=True),
    Case("mode switch turned to Hand", [{"do": "mode", "mode": "hand"}], words=MOTORS, refused=MOTORS),
    Case("RAPID stopped", [_fault("rapid_stop")], words=PROGRAM, refused=PROGRAM),
    Case("convergence ends EGMRunJoint", [_fault("convergence")], words="left Operation Enabled"),
    Case("MCI error", [_fault("mci_error")], words=CLEARANCE, refused="remains in fault"),
    Case("collision", [_fault("collision")], words=CLEARANCE, refused="remains in fault"),
    Case("session begins anew", [_fault("seqno_restart")], words="left Operation Enabled"),
    Case("utilization 150 %", [_fault("utilization", value=150)], (CONTINUES,)),
)  # fmt: skip


class Trials:
    """A platform on the virtual IRC5, its operator, and what observes both."""

    def __init__(self) -> None:
        self.platform = Platform()
        self.platform.environment["RTCP_CONFIG"] = str(default_config().parent / "abb_irb120.yaml")
        self.records = self.torn = 0
        self._start()

    def _start(self) -> None:
        self.platform.rtcp("start", "--detach")
        directory = self.platform.directory
        control = read_session(directory).segment_control
        assert control is not None
        self.harness = Harness(directory, CONFIG)
        self.operator = RequestClient(Path(control), "virtual controller")

    def restart(self) -> None:
        """Restart all processes after one was killed."""
        self._leave()
        self.platform.rtcp("stop", check=None)
        self._start()

    def _leave(self) -> None:
        self.records += self.harness.records
        self.torn += self.harness.torn
        self.operator.close()
        with contextlib.suppress(OSError):
            self.harness.__exit__(None, None, None)

    def close(self) -> None:
        """Stop everything."""
        self._leave()
        self.platform.end()

    # -- the controller ------------------------------------------------------------------------------------------------

    def ask(self, **request: Any) -> Any:
        """Send an operator's command to the controller."""
        return self.operator.ask(request)

    def joints(self) -> list[float]:
        """Return the true joint positions, rad."""
        return [math.radians(q) for q in next(iter(self.ask(do="status")["units"].values()))["position_deg"]]

    def put_in_order(self, hand: bool = False) -> None:
        """End all faults and stops, switch the motors on and start RAPID."""
        self.ask(do="clear")
        for circuit in ("emergency", "automatic", "general", "superior"):
            self.ask(do="release", circuit=circuit)
        if hand is not (self.ask(do="status")["mode"] == "hand"):
            self.ask(do="mode", mode="hand" if hand else "auto")
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.ask(do="motors_on")
                if hand and self.ask(do="status")["motors"] != "on":
                    self.ask(do="enabling", position="released")
                    self.ask(do="enabling", position="middle")
                self.ask(do="start_rapid")
            except RequestRefused:
                assert time.monotonic() < end, self.ask(do="status")
                time.sleep(0.05)
            else:
                break
        self.harness.wait_for(lambda: not self.missing(), PATIENCE_S)

    def missing(self) -> bool:
        """Whether a drive cannot be enabled yet, by the platform's status."""
        self.harness.read_cycles()
        latest = self.harness.observer.latest()
        return latest is None or int(latest[0]["drive_state"].min()) < 3

    def standstill(self) -> float:
        """Wait until every joint has not moved for `STILL_S`; return when the last one stopped, s of `monotonic`."""
        last, since = self.joints(), time.monotonic()
        end = since + PATIENCE_S
        while time.monotonic() - since < STILL_S:
            self.harness.read_cycles()
            now = self.joints()
            if max(abs(a - b) for a, b in zip(now, last, strict=True)) > 1e-5:
                last, since = now, time.monotonic()
            assert time.monotonic() < end, "a joint still moves"
            time.sleep(0.005)
        return since

    @contextlib.contextmanager
    def capture(self, path: Path) -> Iterator[None]:
        """Write the datagrams on the wire to a file meanwhile."""
        pid = self.platform.pids()["segment"]
        command = [sys.executable, egm_wire.__file__, str(pid), str(PORT), str(path)]
        tap = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert tap.stdout is not None
        assert tap.stdout.readline() == "ready\n"
        try:
            yield
        finally:
            tap.send_signal(signal.SIGTERM)
            tap.communicate()
            assert tap.returncode == 0


class Swinging:
    """Moves the arm around `START` from a thread of its own until it is refused or ended."""

    def __init__(self, trials: Trials) -> None:
        self._ended = threading.Event()
        self._socket = control_socket(trials.platform.directory)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert trials.harness.wait_for(lambda: trials.harness.speed() > 0.1, PATIENCE_S), "nothing moved"

    def _run(self) -> None:
        sign = 1.0
        with contextlib.suppress(RtcpError, OSError), Robot("a trial", self._socket) as robot:
            while not self._ended.is_set():
                robot.move_joints([q + sign * by for q, by in zip(START, SWING, strict=True)], SPEED)
                sign = -sign

    def end(self) -> None:
        """End after the move under way."""
        self._ended.set()
        self._thread.join(timeout=PATIENCE_S)


@dataclass
class Result:
    """What a trial measured."""

    reaction: str = "-"
    standstill_s: float | None = None
    """Time from the fault until the last joint rests; None if the arm continues or the time is unknown."""
    travel_rad: float = 0.0
    largest_speed: float = 0.0
    """Largest speed reference on the wire, as a fraction of its limit."""
    messages: Sequence[str] = ()
    resets: int = 0
    recovery_s: float = 0.0


def run_case(trials: Trials, case: Case, workload: str) -> tuple[Result, list[str]]:
    """Run a case; return its measurements and a message for each violation."""
    violations, result = [], Result()
    tap = trials.platform.directory / "egm.tap"
    with trials.capture(tap):
        try:
            violations += _run(trials, case, workload, result)
        except (AssertionError, RtcpError, RequestRefused, ServerAway) as error:
            violations.append(f"the trial ended: {type(error).__name__}: {error}")
            trials.restart()
    wire = egm_wire.check(tap, LIMITS, CONFIG.cycle.period_us * 1e-6)
    result.largest_speed = wire.largest_speed
    violations += wire.violations[:3]
    return result, violations


def _run(trials: Trials, case: Case, workload: str, result: Result) -> list[str]:
    harness = trials.harness
    trials.put_in_order(case.hand)
    if refusal := harness.move(START):
        return [f"the arm cannot be moved to the start of a trial: {refusal}"]
    swinging = Swinging(trials) if workload == MOVING else None
    moment, before, began = harness.moment(), trials.joints(), time.monotonic()
    pid = trials.platform.pids()[case.process] if case.process else 0
    for request in case.requests:
        trials.ask(**request)
    if pid:
        (kill if case.signal is signal.SIGKILL else os.kill)(pid, case.signal)
    violations = []
    if case.process != "loop":
        if workload == MOVING and STOPS in case.ends_in:
            harness.wait_for(lambda: harness.state().name == "HOLDING", WATCH_S)
        harness.wait_for(lambda: harness.state() not in GOES_ON, WATCH_S)
    if case.signal is signal.SIGSTOP:
        harness.wait(2.0)
        os.kill(pid, signal.SIGCONT)
    state = harness.state()
    result.reaction = ENDED if case.process == "loop" else CONTINUES if state in GOES_ON else state.name.lower()
    if STOPS in case.ends_in and state.name == "HOLDING":
        result.reaction = STOPS
    if result.reaction != CONTINUES and case.process != "segment":
        result.standstill_s = trials.standstill() - began
        now = trials.joints()
        result.travel_rad = max(abs(a - b) for a, b in zip(now, before, strict=True))
        violations += [
            f"{joint.name} stands at {q:.4f} rad"
            for joint, q in zip(CONFIG.joints, now, strict=True)
            if not joint.position.min <= q <= joint.position.max
        ]
    if result.reaction != CONTINUES:
        harness.wait(STILL_S)  # the controller reports its missing conditions a little later
    result.messages = harness.messages_since(moment)
    if result.reaction not in case.ends_in:
        violations.append(f"it ended in {result.reaction}, not in {' or '.join(case.ends_in)}")
    if case.words not in " | ".join(result.messages):
        violations.append(f"no message has {case.words!r}")
    if case.refused:
        violations += _refusal(harness, case)
    if swinging is not None:
        swinging.end()
    began = time.monotonic()
    if pid and case.signal is signal.SIGKILL:
        trials.restart()
        harness = trials.harness
        trials.put_in_order()
    else:
        violations += _put_in_order(trials, watched=result.reaction not in (CONTINUES, STOPS))
        if harness.largest_step > 1.0 + 1e-6:
            violations.append(f"a target stepped {harness.largest_step:.3f} of what its speed limit allows")
    result.resets, refusal = harness.enable()
    result.recovery_s = time.monotonic() - began
    refusal = refusal or harness.move([q + CHECK_RAD for q in START])
    if refusal:
        violations.append(f"the arm did not recover: {refusal}")
    return violations


def _refusal(harness: Harness, case: Case) -> list[str]:
    """Try to enable before recovery."""
    try:
        harness.robot.reset()
        harness.robot.enable()
    except RtcpError as error:
        return [] if case.refused in error.message else [f"reset or enable was refused by: {error.message}"]
    return ["the arm could be enabled"]


def _put_in_order(trials: Trials, *, watched: bool) -> list[str]:
    """Recover; return a message for each joint that moved by that."""
    if not watched:
        trials.put_in_order()
        return []
    before, state = trials.joints(), trials.harness.state()
    trials.put_in_order()
    trials.harness.wait(0.4)
    violations = [
        f"{joint.name} moved by {abs(a - b):.4f} rad without a command"
        for joint, a, b in zip(CONFIG.joints, trials.joints(), before, strict=True)
        if abs(a - b) > MOVED_RAD
    ]
    if trials.harness.state() is not state:
        violations.append(f"the machine went from {state.name} to {trials.harness.state().name} by itself")
    return violations


HEADS = ("fault", "while", "reaction", "standstill, s", "travel, rad", "largest speed", "first message", "recovery")


def columns(case: Case, workload: str, result: Result, wrong: Sequence[str]) -> list[str]:
    """Return the row of a table."""
    standstill = "-" if result.standstill_s is None else f"{result.standstill_s:.2f}"
    recovery = f"{result.resets} reset{'s' if result.resets != 1 else ''}, {result.recovery_s:.1f} s"
    message = result.messages[0] if result.messages else ""
    return [
        case.name, workload, result.reaction.replace("_", " "), standstill, f"{result.travel_rad:.3f}",
        f"{result.largest_speed:.3f}", "; ".join([message, *(f"WRONG: {violation}" for violation in wrong)]),
        "none needed" if result.reaction == CONTINUES else recovery,
    ]  # fmt: skip
