"""One trial of fault injection: the arm runs a workload, a fault is injected, and the reaction is measured."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.api import Robot, RtcpError, State
from rtcp.config.model import ArmConfig
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ipc.stop_reactions import StopReaction, bounds, watchdog_bounds
from rtcp.telemetry.harness import CLIENT_NAME, Harness, TrialFailed

CONTINUES = frozenset({State.HOLDING, State.MOVING, State.STOPPING})
"""States of a machine without a fault."""
LARGEST_STEP = 1.0 + 1e-6
"""Largest step of a target, as a fraction of its speed limit's step in a cycle; above 1 is round-off."""
START = (0.0, 0.2, 1.57, 0.0, 0.4, 0.0)
"""Joint positions at the begin of a trial, rad: away from limits and singularities, for jogs in each direction."""
_SWING = (0.35, 0.25, -0.25, 0.35, 0.35, 0.35)
"""Amplitude of a moving arm around `START`, rad."""
_SPEED, _JOG_M_S, _REVERSE_S = 0.4, 0.06, 1.2
_MOVING_RAD_S = 0.03
_JOG_INTERVAL_S, _JOG_HOLD_S = 0.05, 0.25
_JOYSTICK_HOLD_S, _NEUTRAL = 0.5, 63
_WATCH_INTERVAL_S = 0.005
_MESSAGE_S = 0.3
"""Time after a stop in which messages about the fault still arrive, s."""
_RESET_GIVEN_UP_S = 10.0
_UNEXPECTED_S, _MOVED_RAD = 0.4, 0.003
"""Time after clearing a fault in which no joint may move or get torque, s; least motion, rad."""
_CHECK_RAD = 0.02
"""Move of every joint that proves the arm's recovery, rad."""


class Workload:
    """The arm's activity when a fault is injected; here it holds. A subclass commands from a separate thread."""

    name = "holding"
    mode = "joint"
    """Required control mode."""
    moves = False

    def __init__(self, harness: Harness) -> None:
        self._harness = harness
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.refusal = ""
        """Refusal that ended it; empty while it runs and after `end`."""

    def begin(self) -> None:
        """Begin; return at once, or when the arm moves.

        Raises:
            TrialFailed: it is refused, or the arm does not move.
        """
        harness = self._harness
        if self.mode != "joint":
            try:
                harness.robot.mode(self.mode)
            except RtcpError as error:
                raise TrialFailed(f"{self.name} cannot begin: {error.message}") from error
        if not self.moves:
            return
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        began = harness.wait_for(lambda: harness.speed() > _MOVING_RAD_S or bool(self.refusal), 10.0)
        if not began or self.refusal:
            raise TrialFailed(f"{self.name} did not begin: {self.refusal or 'nothing moved for 10 s'}")
        harness.wait_for(self._ended.is_set, 0.3)  # past the ramp

    def end(self) -> None:
        """End, and wait until the thread's connection is closed."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=70.0)

    def _connect(self) -> Robot:
        return Robot(f"{CLIENT_NAME}, {self.name}", control_socket(self._harness.directory))

    def _run(self) -> None:
        with contextlib.suppress(OSError), self._connect() as robot:
            try:
                self._command(robot)
            except RtcpError as error:
                self.refusal = error.message

    def _command(self, robot: Robot) -> None:
        """Command the arm until `_ended`."""


class Moving(Workload):
    """The arm swings around `START` in joint mode."""

    name = "moving"
    moves = True

    def _command(self, robot: Robot) -> None:
        sign = 1.0
        while not self._ended.is_set():
            target = [start + sign * by for start, by in zip(START, _SWING, strict=True)]
            robot.move_joints(target, _SPEED)
            sign = -sign

    def end(self) -> None:
        """End the current move too."""
        self._ended.set()
        with contextlib.suppress(RtcpError, OSError), self._connect() as robot:
            robot.halt()
        super().end()


class Jogging(Workload):
    """The tool is jogged back and forth along x of the base."""

    name = "jogging"
    moves = True

    def _command(self, robot: Robot) -> None:
        begun = time.monotonic()
        while not self._ended.is_set():
            sign = 1.0 if (time.monotonic() - begun) % (2 * _REVERSE_S) < _REVERSE_S else -1.0
            speeds = [sign * _JOG_M_S, 0.0, 0.0, 0.0, 0.0, 0.0]
            robot.jog(speeds, "base", _JOG_HOLD_S)
            self._ended.wait(_JOG_INTERVAL_S)


class Joystick(Workload):
    """The joystick, forced at the virtual IO box, moves the tool back and forth."""

    name = "joystick"
    mode = "joystick"
    moves = True

    def _command(self, robot: Robot) -> None:
        # The arm waits for a neutral joystick before it tracks it.
        robot.joystick(byte=_NEUTRAL, hold_s=_JOYSTICK_HOLD_S)
        self._ended.wait(_JOYSTICK_HOLD_S / 2)
        begun = time.monotonic()
        while not self._ended.is_set():
            forward = (time.monotonic() - begun) % (2 * _REVERSE_S) < _REVERSE_S
            robot.joystick("forward" if forward else "backward", hold_s=_JOYSTICK_HOLD_S)
            self._ended.wait(_JOYSTICK_HOLD_S / 3)


WORKLOADS: dict[str, type[Workload]] = {kind.name: kind for kind in (Workload, Moving, Jogging, Joystick)}


@dataclass(frozen=True)
class TrialResult:
    """Measurements of a trial."""

    fault: str
    workload: str
    state: State
    """The machine's state after the fault, before it was cleared."""
    standstill_s: float | None
    """Time from the fault until every joint was truly at standstill; None where the arm continued."""
    travel: float
    """True travel of a joint until standstill as a fraction of `stopping_bounds`; 0 where the arm continued."""
    largest_step: float
    """Largest step of a target with enabled drives, as a fraction of its speed limit's step in a cycle."""
    wrong_cycles: int
    """Cycles without the expected working counter."""
    messages: tuple[str, ...]
    """The platform's messages from the fault until it was cleared."""
    early_reset_refusal: str
    """Refusal of a reset before the fault was cleared; empty where none was tried or it succeeded."""
    unexpected: str
    """Joints that moved or got torque after the fault was cleared and before a reset; must be empty."""
    resets: int
    """Resets needed after the fault was cleared."""
    refusal: str
    """Refusal of enabling and moving the arm again; empty after success."""
    recovery_s: float
    """Time from clearing the fault until the arm held again."""

    @property
    def continued(self) -> bool:
        """Whether the machine had no fault."""
        return self.state in CONTINUES

    @property
    def recovered(self) -> bool:
        """Whether the arm was enabled and moved again."""
        return not self.refusal

    @property
    def violations(self) -> list[str]:
        """A message for each violation of a bound that holds for any fault."""
        messages = []
        if self.largest_step > LARGEST_STEP:
            messages.append(f"a target stepped {self.largest_step:.4f} of what its speed limit allows")
        if self.travel > 1.0:
            messages.append(f"a joint travelled {self.travel:.2f} of its stopping bound")
        if self.unexpected:
            messages.append(f"without a reset {self.unexpected}")
        if self.refusal:
            messages.append(f"the arm did not recover: {self.refusal}")
        return messages

    @property
    def message(self) -> str:
        """The first message."""
        return self.messages[0] if self.messages else ""


def named(faults: Sequence[Mapping[str, Any]]) -> str:
    """Return faults in the syntax of the command line."""
    words = []
    for fault in faults:
        own = " ".join(f"{key}={value}" for key, value in fault.items() if key != "fault")
        words.append(f"{fault['fault']} {own}".strip())
    return " + ".join(words)


def stopping_bounds(config: ArmConfig) -> list[float]:
    """Return the largest travel of each joint (rad) from any fault until standstill.

    Full speed during the tolerated lost cycles, then the longer of the two stops; or the drive's own watchdog.
    """
    hold, stop, quick = (
        bounds(config, reaction)
        for reaction in (StopReaction.HOLD, StopReaction.CONTROLLED_STOP, StopReaction.QUICK_STOP)
    )
    watchdog = watchdog_bounds(config)
    return [
        max(h.way_rad + max(c.way_rad, q.way_rad), w.way_rad)
        for h, c, q, w in zip(hold, stop, quick, watchdog, strict=True)
    ]


def run_trial(
    harness: Harness, faults: Sequence[Mapping[str, Any]], workload: str, watch_s: float, *, reset_first: bool = False
) -> TrialResult:
    """Run a trial with an arm that holds or can be enabled.

    Args:
        harness: the platform.
        faults: injected in this order, each a mapping as in `rtcp.virtual.faults.registry`.
        workload: one of `WORKLOADS`.
        watch_s: time of observation of a machine that continues, s.
        reset_first: whether to reset while the fault is active, which must not lead to an enabled arm.

    Raises:
        TrialFailed: the arm does not reach the start, does not begin to move, or does not come to standstill.
    """
    if refusal := harness.move(START):
        raise TrialFailed(f"the arm cannot be moved to the start of a trial: {refusal}")
    running = WORKLOADS[workload](harness)
    try:
        running.begin()
        return _inject(harness, faults, running, watch_s, reset_first)
    finally:
        with contextlib.suppress(RtcpError):
            running.end()


def _inject(
    harness: Harness, faults: Sequence[Mapping[str, Any]], workload: Workload, watch_s: float, reset_first: bool
) -> TrialResult:
    harness.read_cycles()
    harness.largest_step, wrong = 0.0, harness.wrong
    moment = harness.moment()
    begun_ns, start = time.monotonic_ns(), harness.joint_positions()
    for fault in faults:
        harness.inject(fault)
    # Undetected bit errors have no effect until one hits a relevant value; until then the arm moves as commanded.
    strikes_late = any("bits" in fault for fault in faults)
    end = time.monotonic() + watch_s
    while harness.state() in CONTINUES and time.monotonic() < end:
        if strikes_late:
            begun_ns, start = time.monotonic_ns(), harness.joint_positions()
        harness.wait(_WATCH_INTERVAL_S)
    state = harness.state()
    standstill_s, travel = None, 0.0
    # Between two moves an arm holds only for a moment.
    rests = workload.moves and not harness.wait_for(lambda: harness.state() is not State.HOLDING, _MESSAGE_S)
    if state not in CONTINUES or rests:
        standstill_s = max(0.0, (harness.wait_standstill() - begun_ns) * 1e-9)
        allowed = stopping_bounds(harness.config)
        travel = max(abs(q - s) / most for q, s, most in zip(harness.joint_positions(), start, allowed, strict=True))
        harness.wait(_MESSAGE_S)
    early_reset_refusal = ""
    if reset_first and state not in CONTINUES:
        try:
            harness.robot.reset()
        except RtcpError as error:
            early_reset_refusal = error.message
        # On a slow host the wait for the reset may end before the machine gives it up.
        harness.wait_for(lambda: harness.state() is not State.RESETTING, _RESET_GIVEN_UP_S)
        state = harness.state()
    messages = tuple(harness.messages_since(moment))
    with contextlib.suppress(RtcpError):
        workload.end()
    unexpected = _clear(harness, watched=state not in CONTINUES)
    cleared = time.monotonic()
    resets, refusal = harness.enable()
    recovery_s = time.monotonic() - cleared
    harness.read_cycles()
    largest_step = harness.largest_step
    if not refusal:
        refusal = harness.move([q + _CHECK_RAD for q in START])
    return TrialResult(
        named(faults), workload.name, state, standstill_s, travel, largest_step, harness.wrong - wrong, messages,
        early_reset_refusal, unexpected, resets, refusal, recovery_s,
    )  # fmt: skip


def _clear(harness: Harness, *, watched: bool) -> str:
    """Clear all faults; with a machine in a fault, return the joints that moved or got torque without a command."""
    before, state = harness.drives(), harness.state()
    harness.segment.clear()
    if not watched:
        return ""
    harness.wait(_UNEXPECTED_S)
    changes = []
    for joint, then, now in zip(harness.config.joints, before, harness.drives(), strict=True):
        if (moved := abs(now["position_rad"] - then["position_rad"])) > _MOVED_RAD:
            changes.append(f"{joint.name} moved by {moved:.4f} rad")
        if now["torque_on"] and not then["torque_on"]:
            changes.append(f"{joint.name} got torque")
    if harness.state() is not state:
        changes.append(f"the machine went from {state.name} to {harness.state().name}")
    return "; ".join(changes)
