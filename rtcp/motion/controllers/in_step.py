"""A trajectory in step with those of other arms: all begin at the same instant and brake on the same time scale.

No arm leads. All follow the same path time, a function of CLOCK_MONOTONIC: from the common instant it runs with the
clock; from the instant at which the group brakes, its rate falls from 1 to 0 along one curve. The braking time is a
table in the plan, the same for all arms, so all come to rest at the same point of their paths. An arm whose cycles
were late catches up slowly.
"""

from __future__ import annotations

from math import isfinite
from typing import Final

from rtcp.ipc.commands import Command, RunInStep
from rtcp.ipc.events import MotionEnded, OutOfStep, PartnerLeft, PartnerNotReady, PartnerSilent, PartnerStopped
from rtcp.ipc.layout import PLAN_ROWS
from rtcp.ipc.refusals import (
    BrakesOutOfRange,
    BrakeStepOutOfRange,
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
from rtcp.motion.planning.plan import COLUMNS, LONGEST_S
from rtcp.motion.state import ArmState, Phase, Setpoint
from rtcp.motion.step_group import StepPhase

LONGEST_WAIT_S: Final = 10.0
"""Upper bound on the time between the command and the common instant, s."""
LONGEST_BRAKE_S: Final = 3.0
"""Upper bound on the braking time of a group, s: its operator must see that it stops."""
SHORTEST_BRAKE_STEP_S: Final = 0.001
"""Lower bound on the interval of the table of braking times, s: a table has at most some thousand entries."""
_GAIN: Final = 10.0
"""Gain of the correction towards the clock, 1/s."""
_CORRECTION: Final = 0.05
"""Upper bound on a correction, as a share of the speed; the planner leaves room for it."""
_CORRECTION_RATE: Final = 0.2
"""Rate of change of a correction, 1/s."""
_STEEPEST: Final = 1.6
"""Steepest slope allowed on the braking curve, 1 / its duration; the curve's own is 1.5."""
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
        """Run a plan from the common instant; the arm must be at its first waypoint, which has time 0."""
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
        if command.brakes < 1:
            return WrongRowCount(command.brakes, PLAN_ROWS)
        if not SHORTEST_BRAKE_STEP_S <= command.brake_step_s <= LONGEST_S:
            return BrakeStepOutOfRange(command.brake_step_s, SHORTEST_BRAKE_STEP_S, LONGEST_S)
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
        """Announce the braking of the group and brake with it; before the common instant, cancel the motion."""
        if self.phase is Phase.MOVE:
            if self._group.phase is StepPhase.ARMED:
                self.hold()
            else:
                self._brake_at(state.now_ns + self._group.notice_ns)

    def hold(self) -> None:
        """End the motion at the current setpoints."""
        super().hold()
        self._group.leave()

    def brake(self, state: ArmState) -> None:
        """Bring each joint to rest as fast as its limits allow; partners see that this arm left its path."""
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
            # Two arms were stopped at the same time: the earlier instant counts.
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
        """Return why the motion cannot begin: at the common instant every partner must have accepted it."""
        group = self._group
        silent = group.silent(group.mask, now_ns)
        if silent >= 0:
            return PartnerNotReady(silent)
        absent = group.not_armed() if now_ns >= self._start_ns else group.refused()
        return PartnerNotReady(absent) if absent >= 0 else None

    def _lost(self, now_ns: int) -> MotionEnded | None:
        """Brake if a partner requires it; return the reason, or None."""
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
        """Start the group's braking at an instant; the plan's table has its duration."""
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
        """Return the common path time at an instant, s."""
        group = self._group
        if self.phase is not Phase.STOP or at_ns < group.brake_ns:
            return 1e-9 * (at_ns - self._start_ns)
        x = 1e-9 * (at_ns - group.brake_ns) / self._brake_s
        if x >= 1.0:
            return self._brake_from_s + 0.5 * self._brake_s
        # Integral of the rate 1 - 3 x^2 + 2 x^3.
        return self._brake_from_s + self._brake_s * x * (1.0 + x * x * (0.5 * x - 1.0))

    def _corrected(self, lag_s: float, speed: float) -> float:
        """Return the rate of the path time that corrects this arm's lag or lead."""
        wanted = min(max(_GAIN * lag_s, -_CORRECTION), _CORRECTION)
        most = _CORRECTION_RATE * self.period_s
        self._correction += min(max(wanted - self._correction, -most), most)
        # After a late cycle the curve is further down; no joint can follow such a step.
        steepest = (_STEEPEST / self._brake_s if self.phase is Phase.STOP else 0.0) * self.period_s + most
        wanted = 0.0 if speed <= 0.0 and lag_s < _EXACT_S else speed + self._correction
        return max(min(max(wanted, self._speed - steepest), self._speed + steepest), 0.0)
