"""Commands that set the arm in motion: checked, then handed to their mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

from rtcp.motion.generator import LONGEST_S
from rtcp.motion.state import Mode
from rtcp.runtime.arm import Arm
from rtcp.runtime.behaviour import Behaviour
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.codes import Command, MotionMode, Refusal
from rtcp.runtime.layout import PLAN_ROWS, PLANS
from rtcp.runtime.machine import State
from rtcp.runtime.operator import Operator
from rtcp.runtime.verdict import DONE, Verdict

AUTOMATIC = (MotionMode.JOINT, MotionMode.CARTESIAN)
"""Modes that take moves, trajectories, lines, streams and jogs alike."""
LONGEST_HOLD_S = 1.0
"""A speed, a torque or a jog counts for so long at most; then it has to be said again."""


class MotionOrders:
    """What `Orders` hands on.

    Args:
        arm: the joints.
        operator: knows whether motion is permitted.
        behaviour: the machine's state.
        blackboard: where plans are.
    """

    def __init__(self, arm: Arm, operator: Operator, behaviour: Behaviour, blackboard: Blackboard) -> None:
        self._arm = arm
        self._operator = operator
        self._behaviour = behaviour
        self._blackboard = blackboard
        self._numbers = [0.0] * len(arm.drives)
        self.answers: dict[Command, Callable[[int, Sequence[float]], Verdict]] = {
            Command.MOVE: self._move,
            Command.TRAJECTORY: self._trajectory,
            Command.LINE: self._line,
            Command.STREAM: self._stream,
            Command.JOG: self._jog,
            Command.VELOCITY: self._velocity,
            Command.TORQUE: self._torque,
        }

    def _hindered(self, *allowed: MotionMode) -> Verdict | None:
        """Return why no motion of this kind may begin now, or None."""
        motion = self._arm.motions.mode
        if motion not in allowed:
            return Refusal.OTHER_MOTION, int(motion), float(allowed[0])
        if not self._operator.permitted:
            return (Refusal.NOT_PERMITTED,)
        return None

    def _begin(self, lease: int, mode: Mode) -> Verdict:
        behaviour = self._behaviour
        going_on = behaviour.state is State.MOVING and self._arm.motions.active is mode and behaviour.lease == lease
        self._arm.motions.active = mode
        if not going_on:
            behaviour.begin_motion(lease)
        return DONE

    def _in_range(self, numbers: Sequence[float], low: Sequence[float], high: Sequence[float]) -> Verdict | None:
        """Copy the joints' numbers and return what is wrong with them, or None."""
        target = self._numbers
        for axis in range(len(target)):
            wanted = numbers[axis]
            if not isfinite(wanted):
                return Refusal.NOT_A_NUMBER, axis, wanted
            if not low[axis] <= wanted <= high[axis]:
                return Refusal.POSITION_LIMIT, axis, wanted, high[axis] if wanted > high[axis] else low[axis]
            target[axis] = wanted
        return None

    def _move(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if hindrance := self._hindered(*AUTOMATIC):
            return hindrance
        arm, speed, each = self._arm, numbers[-1], numbers[-2] == 1.0
        limits = arm.limits
        fastest = max(limits.velocity)
        if not isfinite(speed) or not 0.0 < speed <= fastest:
            return Refusal.SPEED, -1, speed, fastest
        if wrong := self._in_range(numbers, limits.low, limits.high):
            return wrong
        box = arm.guards.zone_at(self._numbers)
        if box is not None:
            return Refusal.ZONE, box, 0.0
        generator = arm.motions.generator
        if not generator.move_to(arm.state, self._numbers, speed, each=each):
            return Refusal.NO_PLAN, -1, speed, LONGEST_S
        return self._begin(lease, generator)

    def _plan(self, numbers: Sequence[float]) -> tuple[int, int] | Verdict:
        slot, count = numbers[0], numbers[1]
        if slot not in range(PLANS):
            return Refusal.BAD_PLAN, -1, slot, float(PLANS - 1)
        if count not in range(1, PLAN_ROWS + 1):
            return Refusal.BAD_PLAN, -1, count, float(PLAN_ROWS)
        return int(slot), int(count)

    def _trajectory(self, lease: int, numbers: Sequence[float]) -> Verdict:
        raise NotImplementedError

    def _line(self, lease: int, numbers: Sequence[float]) -> Verdict:
        raise NotImplementedError

    def _stream(self, lease: int, numbers: Sequence[float]) -> Verdict:
        raise NotImplementedError

    def _jog(self, lease: int, numbers: Sequence[float]) -> Verdict:
        raise NotImplementedError

    def _velocity(self, lease: int, numbers: Sequence[float]) -> Verdict:
        raise NotImplementedError

    def _torque(self, lease: int, numbers: Sequence[float]) -> Verdict:
        raise NotImplementedError
