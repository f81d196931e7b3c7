"""A trajectory in step with those of other arms: all begin at one instant, and brake on one time scale.

No arm is the leader. Each follows the same time of the path, which is a function of CLOCK_MONOTONIC: from the common
instant on it passes as the clock does; from the instant at which the group brakes its speed falls from 1 to 0 along
one curve. How long that takes is a table that came with the plan, the same for all arms, so that all come to rest at
the same point of their paths. An arm whose cycles were late makes up for it slowly.
"""

from __future__ import annotations

from math import isfinite
from typing import Final

from rtcp.ipc.commands import Command, RunInStep
from rtcp.ipc.events import MotionEnded, OutOfStep, PartnerLeft, PartnerNotReady, PartnerSilent, PartnerStopped
from rtcp.ipc.layout import PLAN_ROWS
from rtcp.ipc.refusals import (
    BrakesOutOfRange,
    DamagedRow,
    Refusal,
    SpeedOverridden,
    StartOutOfReach,
    WrongRowCount,
    WrongState,
)
from rtcp.ipc.states import State
from rtcp.motion.controllers.controller import ControllerSetup
from rtcp.motion.controllers.trajectory import TrajectoryController
from rtcp.motion.planning.plan import COLUMNS
from rtcp.motion.state import ArmState, Phase, Setpoint
from rtcp.motion.step_group import StepPhase

LONGEST_WAIT_S: Final = 10.0
"""How far ahead a motion may be commanded to begin."""
LONGEST_BRAKE_S: Final = 3.0
"""Longest that a group takes to brake, s: whoever halts it must see that it stops."""
_GAIN: Final = 10.0
"""1/s: how fast the path's time returns to that of the clock."""
_CORRECTION: Final = 0.05
"""Share of the speed that a correction adds or takes away at most; the planner leaves room for it."""
_CORRECTION_RATE: Final = 0.2
"""1/s: how fast a correction changes."""
_STEEPEST: Final = 1.6
"""Of the curve of the brakes, 1 / its duration; 1.5 is its slope in the middle."""
_MOST_LAG_S: Final = 0.1
_EXACT_S: Final = 1e-5


class InStepController(TrajectoryController):
    """Accepts `RunInStep`."""

    name = "in_step"
    pausable = False
    commands = (RunInStep,)

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        self._group = setup.group
        self._start_ns = self._brake_ns = 0
        self._brakes: memoryview[float] | None = None
        self._brake_step_s = 1.0
        self._brake_from_s = self._brake_s = 0.0
        self._correction = 0.0
        self._speed = 1.0

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Run a plan from the common instant on; the arm has to be at its first waypoint, whose time is 0."""
        assert isinstance(command, RunInStep)
        group = self._group
        if continues or self.phase:
            return WrongState(command.number, State.MOVING)
        if self.speed_override.fraction < 1.0:
            return SpeedOverridden(self.speed_override.fraction)
        ahead_s = 1e-9 * (command.start_ns - state.now_ns)
        if not 0.0 < ahead_s <= LONGEST_WAIT_S:
            return StartOutOfReach(ahead_s, LONGEST_WAIT_S)
        rows = -(-command.brakes // COLUMNS)
        if command.brakes < 1 or not isfinite(command.brake_step_s) or command.brake_step_s <= 0.0:
            return WrongRowCount(command.brakes, PLAN_ROWS)
        if command.rows + rows > PLAN_ROWS:
            return WrongRowCount(command.rows + rows, PLAN_ROWS)
        plan = self.rows_of(command.slot, command.rows, PLAN_ROWS)
        if isinstance(plan, Refusal):
            return plan
        if plan[0] != 0.0:
            return DamagedRow(0, plan[0])
        refusal = group.refusal(command.motion, command.partners, state.now_ns)
        if refusal is not None:
            return refusal
        brakes = plan[command.rows * COLUMNS : command.rows * COLUMNS + command.brakes]
        for value in (min(brakes), max(brakes), sum(brakes)):
            if not value > 0.0 or not isfinite(value):
                return BrakesOutOfRange(value, LONGEST_BRAKE_S)
        if max(brakes) > LONGEST_BRAKE_S:
            return BrakesOutOfRange(max(brakes), LONGEST_BRAKE_S)
        refusal = self.take(command.slot, command.rows, False, state)
        if refusal is not None:
            return refusal
        self._start_ns = command.start_ns
        self._brakes = brakes
        self._brake_step_s = command.brake_step_s
        self._correction = 0.0
        group.join(command.motion, command.partners, command.start_ns)
        return None

    def stop(self, state: ArmState) -> None:
        """Announce that the group brakes, and brake with it; before the common instant do not begin."""
        if self.phase is Phase.MOVE:
            if self._group.phase is StepPhase.ARMED:
                self.hold()
            else:
                self._brake_at(state.now_ns + self._group.notice_ns)

    def hold(self) -> None:
        """End the motion where the setpoints are."""
        super().hold()
        self._group.leave()

    def brake(self, state: ArmState) -> None:
        """Bring each joint to rest as fast as its limits allow; partners see that this arm has left its path."""
        super().brake(state)
        self._group.leave()

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        group, now = self._group, state.now_ns
        if group.phase is StepPhase.ARMED:
            if (refused := self._wait(now)) is not None:
                self.ended = refused
                self.hold()
                return self.rest(state)
            if now < self._start_ns:
                return self.rest(state)
            group.phase = StepPhase.MOVING
            self.elapsed_s = min(1e-9 * (now - self._start_ns), 2.0 * self.period_s)
            self._speed = 1.0
        if self.phase is Phase.MOVE:
            if (ended := self._lost(now)) is not None:
                self.ended = ended
        elif group.braking() >= 0 and group.brake_ns != self._brake_ns:
            # Two were stopped at once: all keep to the instant that comes first.
            self._brake_at(group.brake_ns)
        here_s = self._reference(now)
        lag_s = here_s - self.elapsed_s
        if not -_MOST_LAG_S < lag_s < _MOST_LAG_S:
            return self.give_up(state, OutOfStep(lag_s))
        ahead_s = self._reference(now + round(self.period_s * 1e9))
        speed = self._speed = self._corrected(lag_s, (ahead_s - here_s) / self.period_s)
        self.elapsed_s = group.path_s = min(self.elapsed_s + speed * self.period_s, self.duration_s)
        if (damaged := self._go_to(self.elapsed_s)) is not None:
            return self.give_up(state, damaged)
        velocity = self._velocity
        for i in self._joints:
            velocity[i] *= speed
        if self.elapsed_s >= self.duration_s:
            if (damaged_end := self._arrive()) is not None:
                return self.give_up(state, damaged_end)
            group.phase = StepPhase.DONE
        elif speed == 0.0 and group.phase is StepPhase.BRAKING and now > group.brake_ns:
            self.hold()
        target = self.setpoint
        target.position, target.velocity = self._position, velocity
        return target

    def _wait(self, now_ns: int) -> MotionEnded | None:
        """Return why the motion does not begin; at the common instant all partners must have accepted it."""
        group = self._group
        silent = group.silent(group.mask, now_ns)
        if silent >= 0:
            return PartnerNotReady(silent)
        absent = group.not_armed() if now_ns >= self._start_ns else group.refused()
        return PartnerNotReady(absent) if absent >= 0 else None

    def _lost(self, now_ns: int) -> MotionEnded | None:
        """Return why this arm has to brake on account of a partner, and begin to, or None."""
        group = self._group
        index = group.braking()
        if index >= 0:
            self._brake_at(group.brake_ns)
            return PartnerStopped(index)
        index = group.silent(group.mask, now_ns)
        if index >= 0:
            self._brake_at(now_ns)
            return PartnerSilent(index)
        index = group.not_armed()
        if index >= 0:
            self._brake_at(now_ns)
            return PartnerLeft(index)
        return None

    def _brake_at(self, instant_ns: int) -> None:
        """Let the group's speed fall from an instant on; how long that takes is looked up in the plan."""
        group = self._group
        group.brake_ns, group.phase, self.phase = instant_ns, StepPhase.BRAKING, Phase.STOP
        self._brake_ns = instant_ns
        self._brake_from_s = from_s = 1e-9 * (instant_ns - self._start_ns)
        brakes = self._brakes
        assert brakes is not None
        last = len(brakes) - 1
        at = min(max(int(from_s / self._brake_step_s), 0), last)
        self._brake_s = max(brakes[at], brakes[min(at + 1, last)])

    def _reference(self, at_ns: int) -> float:
        """Return the common time of the path at an instant, s."""
        group = self._group
        if self.phase is not Phase.STOP or at_ns < group.brake_ns:
            return 1e-9 * (at_ns - self._start_ns)
        x = 1e-9 * (at_ns - group.brake_ns) / self._brake_s
        if x >= 1.0:
            return self._brake_from_s + 0.5 * self._brake_s
        # The integral of the speed 1 - 3 x^2 + 2 x^3.
        return self._brake_from_s + self._brake_s * x * (1.0 + x * x * (0.5 * x - 1.0))

    def _corrected(self, lag_s: float, speed: float) -> float:
        """Return the speed of the path that makes up for what this arm is behind, or ahead."""
        wanted = min(max(_GAIN * lag_s, -_CORRECTION), _CORRECTION)
        most = _CORRECTION_RATE * self.period_s
        self._correction += min(max(wanted - self._correction, -most), most)
        # A cycle that comes late finds the curve further down: no joint follows that at once.
        steepest = (_STEEPEST / self._brake_s if self.phase is Phase.STOP else 0.0) * self.period_s + most
        wanted = 0.0 if speed <= 0.0 and lag_s < _EXACT_S else speed + self._correction
        return max(min(max(wanted, self._speed - steepest), self._speed + steepest), 0.0)
