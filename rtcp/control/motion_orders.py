"""Commands that set the arm in motion: checked, then handed to their mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.behaviour import Behaviour
from rtcp.control.operator import Operator
from rtcp.control.verdict import DONE, Verdict
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Command, JogFrame, MotionMode, Refusal
from rtcp.ipc.layout import PLAN_ROWS, PLANS
from rtcp.ipc.machine import State
from rtcp.motion.controllers.joint_move import LONGEST_S
from rtcp.motion.controllers.line import LineController
from rtcp.motion.controllers.trajectory import TrajectoryController
from rtcp.motion.drive_writers import DriveMode
from rtcp.motion.planning.rows import Wrong
from rtcp.motion.state import Controller, Phase

MOST_PIECES = 256
"""Straight pieces of a plan: all are looked at in the cycle in which it begins."""
AUTOMATIC = (MotionMode.JOINT, MotionMode.CARTESIAN)
"""Modes that take moves, trajectories, lines, streams and jogs alike."""
LONGEST_HOLD_S = 1.0
"""A speed, a torque or a jog counts for so long at most; then it has to be said again."""


_PLAN_REFUSALS = {
    Wrong.DAMAGED: Refusal.BAD_PLAN,
    Wrong.START: Refusal.PLAN_START,
    Wrong.START_SPEED: Refusal.PLAN_SPEED,
    Wrong.UNREACHABLE: Refusal.PLAN_LEAD,
    Wrong.MOVING: Refusal.PLAN_MOVING,
}


class MotionOrders:
    """What `Orders` hands on.

    Args:
        config: Cartesian speeds.
        arm: the joints.
        operator: knows whether motion is permitted.
        behaviour: the machine's state.
        blackboard: where plans are.
    """

    def __init__(
        self, config: ArmConfig, arm: Arm, operator: Operator, behaviour: Behaviour, blackboard: Blackboard
    ) -> None:
        self._arm = arm
        self._operator = operator
        self._behaviour = behaviour
        self._blackboard = blackboard
        self._numbers = [0.0] * len(arm.drives)
        cartesian = config.cartesian
        self._jog_bounds = (cartesian.speed,) * 3 + (cartesian.angular_speed,) * 3
        self.answers: dict[Command, Callable[[int, Sequence[float]], Verdict]] = {
            Command.MOVE: self._move,
            Command.TRAJECTORY: self._trajectory,
            Command.LINE: self._line,
            Command.STREAM: self._stream,
            Command.JOG: self._jog,
            Command.VELOCITY: self._velocity,
            Command.TORQUE: self._torque,
            Command.HOME: self._home,
        }

    def _hindered(self, *allowed: MotionMode) -> Verdict | None:
        """Return why no motion of this kind may begin now, or None."""
        motion = self._arm.motions.mode
        if motion not in allowed:
            return Refusal.OTHER_MOTION, int(motion), float(allowed[0])
        if not self._operator.permitted:
            return (Refusal.NOT_PERMITTED,)
        return None

    def _begin(self, lease: int, mode: Controller) -> Verdict:
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
        box = arm.trajectory_guard.zone_at(self._numbers)
        if box is not None:
            return Refusal.ZONE, box, 0.0
        generator = arm.motions.generator
        if not generator.move_to(arm.state, self._numbers, speed, each=each):
            return Refusal.NO_PLAN, -1, speed, LONGEST_S
        return self._begin(lease, generator)

    def _rows(self, numbers: Sequence[float], most: int) -> tuple[int, int] | None:
        slot, count = numbers[0], numbers[1]
        if slot not in range(PLANS) or count not in range(1, most + 1):
            return None
        return int(slot), int(count)

    def _carry_out(
        self, lease: int, numbers: Sequence[float], mode: TrajectoryController | LineController, most: int
    ) -> Verdict:
        if hindrance := self._hindered(*AUTOMATIC):
            return hindrance
        rows = self._rows(numbers, most)
        if rows is None:
            return Refusal.BAD_PLAN, -1, numbers[1], float(most)
        slot, count = rows
        refused = mode.start(self._arm.state, self._blackboard.plan(slot), count)
        if refused is not None:
            return _PLAN_REFUSALS[refused.wrong], refused.at, refused.value, refused.limit
        self._blackboard.use_plan(slot)
        return self._begin(lease, mode)

    def _trajectory(self, lease: int, numbers: Sequence[float]) -> Verdict:
        return self._carry_out(lease, numbers, self._arm.motions.trajectory, PLAN_ROWS)

    def _line(self, lease: int, numbers: Sequence[float]) -> Verdict:
        line = self._arm.motions.line
        return (Refusal.NO_GEOMETRY,) if line is None else self._carry_out(lease, numbers, line, MOST_PIECES)

    def _goes_on(self, mode: Controller) -> bool:
        return self._arm.motions.active is mode and mode.phase is Phase.MOVE and self._behaviour.state is State.MOVING

    def _stream(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if hindrance := self._hindered(*AUTOMATIC):
            return hindrance
        limits, arm, stream = self._arm.limits, self._arm, self._arm.motions.stream
        if wrong := self._in_range(numbers, limits.low, limits.high):
            return wrong
        if not isfinite(numbers[-1]):
            return Refusal.NOT_A_NUMBER, -1, numbers[-1]
        if not self._goes_on(stream):
            stream.start(arm.state)
        if not stream.feed(self._numbers, numbers[-1], self._behaviour.now_ns):
            return Refusal.STREAM_DROPPED, -1, stream.late_s
        return self._begin(lease, stream)

    def _jog(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if hindrance := self._hindered(*AUTOMATIC):
            return hindrance
        frame = numbers[-2]
        if frame not in tuple(JogFrame):
            return Refusal.JOG_FRAME, -1, frame
        if frame == JogFrame.JOINTS:
            return self._speeds(lease, numbers)
        jog, arm = self._arm.motions.jog, self._arm
        if jog is None:
            return (Refusal.NO_GEOMETRY,)
        if wrong := self._within(numbers, self._jog_bounds, Refusal.JOG_SPEED):
            return wrong
        if not self._goes_on(jog):
            jog.start(arm.state)
        until_ns = self._behaviour.now_ns + round(numbers[-1] * 1e9)
        jog.command(self._numbers, "tool" if frame == JogFrame.TOOL else "base", until_ns)
        return self._begin(lease, jog)

    def _velocity(self, lease: int, numbers: Sequence[float]) -> Verdict:
        return self._hindered(MotionMode.VELOCITY) or self._speeds(lease, numbers)

    def _speeds(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if wrong := self._within(numbers, self._arm.limits.velocity, Refusal.JOINT_SPEED):
            return wrong
        velocity = self._arm.motions.velocity
        if not self._goes_on(velocity):
            velocity.start(self._arm.state)
        velocity.command(self._numbers, numbers[-1], self._behaviour.now_ns)
        return self._begin(lease, velocity)

    def _within(self, numbers: Sequence[float], bounds: Sequence[float], refusal: Refusal) -> Verdict | None:
        """Copy the joints' numbers and return what is wrong with them, or with how long they are to count, or None."""
        hold_s = numbers[-1]
        if not 0.0 < hold_s <= LONGEST_HOLD_S:
            return Refusal.HOLD_TIME, -1, hold_s, LONGEST_HOLD_S
        for axis in range(len(self._numbers)):
            wanted, bound = numbers[axis], bounds[axis]
            if not isfinite(wanted):
                return Refusal.NOT_A_NUMBER, axis, wanted
            if not -bound <= wanted <= bound:
                return refusal, axis, wanted, bound
            self._numbers[axis] = wanted
        return None

    def _torque(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if hindrance := self._hindered(MotionMode.TORQUE):
            return hindrance
        if wrong := self._within(numbers, self._arm.limits.torque, Refusal.TORQUE_LIMIT):
            return wrong
        stiffness, damping = numbers[-3], numbers[-2]
        for share in (stiffness, damping):
            if not 0.0 <= share <= 1.0:
                return Refusal.IMPEDANCE, -1, share
        torque = self._arm.motions.torque
        if not self._goes_on(torque):
            torque.start(self._arm.state)
        torque.command(self._numbers, numbers[-1], self._behaviour.now_ns, stiffness, damping)
        return self._begin(lease, torque)

    def _home(self, lease: int, numbers: Sequence[float]) -> Verdict:
        arm, axis = self._arm, numbers[0]
        if axis not in range(len(arm.drives)):
            return Refusal.AXIS, -1, axis, float(len(arm.drives))
        if hindrance := self._hindered(*AUTOMATIC):
            return hindrance
        if arm.mode is not DriveMode.CSP:
            return Refusal.HOME_MODE, -1, float(arm.mode)
        self._behaviour.home(int(axis), lease)
        return DONE
