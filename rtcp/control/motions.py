"""The modes of motion and which of them is active."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.ipc.codes import MotionMode
from rtcp.motion.controllers.jog import JogController
from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.controllers.line import LineController
from rtcp.motion.controllers.stream import StreamController
from rtcp.motion.controllers.torque import TorqueController
from rtcp.motion.controllers.trajectory import TrajectoryController
from rtcp.motion.controllers.velocity import VelocityController
from rtcp.motion.drive_writers import DriveMode
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Controller, Phase

DRIVE_MODES = {"csp": DriveMode.CSP, "csv": DriveMode.CSV, "cst": DriveMode.CST}


class Motions:
    """All modes of an arm.

    Args:
        config: the arm.
        limits: its limits as they are now.
        trajectory_guard: what the modes ask whether they would be cut.
        period_s: the cycle, s.
    """

    def __init__(self, config: ArmConfig, limits: Limits, trajectory_guard: TrajectoryGuard, period_s: float) -> None:
        self.generator = JointMoveController(period_s, limits.velocity, limits.acceleration, limits.jerk)
        self.trajectory = TrajectoryController(limits, period_s)
        self.stream = StreamController(limits, period_s)
        self.velocity = VelocityController(limits, period_s)
        self.torque = TorqueController(config.joints, limits, period_s, config.arm)
        self.line = (
            None if config.arm is None else LineController(config.arm, limits, period_s, config.cartesian.singularity)
        )
        self.jog = None if config.arm is None else JogController(config, config.arm, limits, trajectory_guard, period_s)
        self.active: Controller = self.generator
        self.mode = MotionMode[config.motion.upper()]
        """What the arm takes commands for."""
        self.drive_mode = DRIVE_MODES[config.mode]
        """What moves, lines and jogs reach the drives in."""
        self.has_geometry = config.arm is not None

    def select(self, mode: MotionMode) -> None:
        """Take commands for `mode` from now on; at standstill."""
        self.mode = mode
        self.rest()

    def drive_mode_of(self, mode: MotionMode) -> DriveMode:
        """Return the drives' mode that a motion mode needs."""
        if mode is MotionMode.VELOCITY:
            return DriveMode.CSV
        return DriveMode.CST if mode is MotionMode.TORQUE else self.drive_mode

    def rest(self) -> None:
        """Hold where the set-points are; at standstill."""
        self.generator.hold()
        if self.jog is not None:
            # A jog that a fault ended in its midst would never be begun anew by the stick.
            self.jog.hold()
        self.active = self.generator

    def stop(self, state: ArmState) -> None:
        """Let what moves come to rest."""
        if self.active.phase is Phase.MOVE:
            self.active.stop(state)
