"""Commands that set the arm in motion, handed to their controllers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, fields
from functools import partial

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.behaviour import Behaviour
from rtcp.control.operator import Operator
from rtcp.control.verdict import DONE, Verdict
from rtcp.ipc import commands, refusals, states
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Command, JogFrame, MotionMode, Refusal
from rtcp.ipc.machine import State
from rtcp.ipc.states import DriveMode

AUTOMATIC = (MotionMode.JOINT, MotionMode.CARTESIAN)
"""Modes that take moves, trajectories, lines, streams and jogs alike."""

_REFUSALS: dict[type[refusals.Refusal], Refusal] = {
    refusals.NotFinite: Refusal.NOT_A_NUMBER,
    refusals.StampNotFinite: Refusal.NOT_A_NUMBER,
    refusals.PositionOutOfRange: Refusal.POSITION_LIMIT,
    refusals.SpeedOutOfRange: Refusal.SPEED,
    refusals.TargetInBox: Refusal.ZONE,
    refusals.NoTrajectory: Refusal.NO_PLAN,
    refusals.WrongRowCount: Refusal.BAD_PLAN,
    refusals.DamagedRow: Refusal.BAD_PLAN,
    refusals.PlanStartsElsewhere: Refusal.PLAN_START,
    refusals.PathStartsElsewhere: Refusal.PLAN_START,
    refusals.PlanStartsMoving: Refusal.PLAN_SPEED,
    refusals.ApproachImpossible: Refusal.PLAN_LEAD,
    refusals.PathNeedsRest: Refusal.PLAN_MOVING,
    refusals.StreamPointDropped: Refusal.STREAM_DROPPED,
    refusals.JogSpeedOutOfRange: Refusal.JOG_SPEED,
    refusals.JointSpeedOutOfRange: Refusal.JOINT_SPEED,
    refusals.TorqueOutOfRange: Refusal.TORQUE_LIMIT,
    refusals.FractionOutOfRange: Refusal.IMPEDANCE,
    refusals.HoldTimeOutOfRange: Refusal.HOLD_TIME,
    refusals.NoGeometry: Refusal.NO_GEOMETRY,
}


def _in_numbers(refusal: refusals.Refusal) -> Verdict:
    """Return the code of a refusal, where it is, the value and the limit."""
    values = astuple(refusal)
    names = [field.name for field in fields(refusal)]
    if not names or names[0] not in ("axis", "row", "box", "direction"):
        values = (-1, *values)
    at, value, limit = [*values, 0.0, 0.0][:3]
    return _REFUSALS[type(refusal)], at, value, limit


class MotionOrders:
    """What `Orders` hands on.

    Args:
        config: the arm.
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
        self._joints = len(arm.drives)
        n = self._joints
        self.answers: dict[Command, Callable[[int, Sequence[float]], Verdict]] = {
            Command.MOVE: partial(
                self._begin, AUTOMATIC, lambda x: commands.MoveJoints(tuple(x[:n]), x[-1], x[-2] != 1.0)
            ),
            Command.TRAJECTORY: partial(self._begin, AUTOMATIC, lambda x: commands.RunTrajectory(*_whole(x))),
            Command.LINE: partial(self._begin, AUTOMATIC, lambda x: commands.RunLines(*_whole(x))),
            Command.STREAM: partial(self._begin, AUTOMATIC, lambda x: commands.StreamPosition(tuple(x[:n]), x[-1])),
            Command.JOG: self._jog,
            Command.VELOCITY: partial(
                self._begin, (MotionMode.VELOCITY,), lambda x: commands.MoveAtVelocity(tuple(x[:n]), x[-1])
            ),
            Command.TORQUE: partial(
                self._begin,
                (MotionMode.TORQUE,),
                lambda x: commands.ApplyTorque(tuple(x[:n]), x[-3], x[-2], x[-1]),
            ),
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

    def _begin(
        self,
        allowed: tuple[MotionMode, ...],
        typed: Callable[[Sequence[float]], commands.Command],
        lease: int,
        numbers: Sequence[float],
    ) -> Verdict:
        if hindrance := self._hindered(*allowed):
            return hindrance
        command, arm, behaviour = typed(numbers), self._arm, self._behaviour
        controller = arm.motions.controllers.get(type(command))
        if controller is None:
            return (Refusal.NO_GEOMETRY,)
        continues = behaviour.state is State.MOVING and arm.motions.active is controller and behaviour.lease == lease
        refusal = controller.accept(command, arm.state, continues)
        if refusal is not None:
            return _in_numbers(refusal)
        if isinstance(command, (commands.RunTrajectory, commands.RunLines)):
            self._blackboard.use_plan(command.slot)
        arm.motions.active = controller
        if not continues:
            behaviour.begin_motion(lease)
        return DONE

    def _jog(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if numbers[-2] not in tuple(JogFrame):
            return self._hindered(*AUTOMATIC) or (Refusal.JOG_FRAME, -1, numbers[-2])
        frame = states.JogFrame(int(numbers[-2]))
        return self._begin(AUTOMATIC, lambda x: commands.Jog(tuple(x[: self._joints]), frame, x[-1]), lease, numbers)

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


def _whole(numbers: Sequence[float]) -> tuple[int, int]:
    """Return slot and rows; -1 for what is no whole number."""
    slot, rows = (int(x) if x == x // 1 else -1 for x in numbers[:2])
    return slot, rows
