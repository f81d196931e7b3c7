"""Jerk-limited joint moves to a configuration; a new target starts from the last setpoint."""

from __future__ import annotations

from math import isfinite

from rtcp.ipc.commands import Command, MoveJoints
from rtcp.ipc.refusals import NoTrajectory, Refusal, SpeedOutOfRange, TargetInBox
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import LONGEST_S
from rtcp.motion.state import ArmState, Setpoint


class JointMoveController(Controller):
    """Accepts `MoveJoints`."""

    name = "joint_move"
    pausable = True
    commands = (MoveJoints,)

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        self._guard = setup.trajectory_guard

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Move to the target; it replaces a move in progress without a stop."""
        assert isinstance(command, MoveJoints)
        fastest = max(self.limits.velocity)
        if not isfinite(command.speed) or not 0.0 < command.speed <= fastest:
            return SpeedOutOfRange(command.speed, fastest)
        if (refusal := self.not_in_range(command.q)) is not None:
            return refusal
        box = self._guard.zone_at(command.q)
        if box is not None:
            return TargetInBox(box)
        if not self.motion.move_to(state, command.q, command.speed, synchronized=command.synchronized):
            return NoTrajectory(command.speed, LONGEST_S)
        self.begin()
        return None

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        setpoint = self.follow_motion(state)
        self.elapsed_s, self.duration_s = self.motion.elapsed_s, self.motion.duration_s
        return setpoint
