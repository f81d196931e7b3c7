"""A gripper with a drive: a group of one joint in CSP, beside the arm and independent of its controllers."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

from rtcp.config.model import ArmConfig, FeedForwardConfig
from rtcp.control.joint_group import JointGroup
from rtcp.control.part import PartContext
from rtcp.devices.drive import drive_of
from rtcp.ipc.events import GripperAtRest
from rtcp.ipc.schema import GRIPPER_FIELDS
from rtcp.ipc.states import DriveState
from rtcp.motion.controllers.gripper import GripperMotion
from rtcp.motion.guards.trajectory_guard import GuardResult


class DrivenGripper(JointGroup):
    """The drive of the gripper: enabled and disabled with the arm, moved independently.

    An object in its grip causes torque, and a following error where it is soft: that ends the grip's motion but must
    not stop the arm. So its torque is not supervised, and its following error only while it grips nothing.

    Args:
        config: configuration with the gripper's joint alone.
        motion: motion of that joint.
        axis: axis number of that joint.

    Raises:
        DeviceError: its device's description is not suitable.
    """

    def __init__(self, config: ArmConfig, motion: GripperMotion, axis: int) -> None:
        zero = config.zero_offsets[axis] if config.zero_offsets else 0.0
        supervision = replace(config.supervision, torque=inf, acceleration=inf)
        # Feed-forward is the arm's: offsets that are mapped here keep their safe values.
        config = replace(config, supervision=supervision, feed_forward=FeedForwardConfig())
        super().__init__("gripper", GRIPPER_FIELDS, config, [drive_of(config, config.joints[0], zero)], axis)
        self.drive = self.drives[0]
        self.motion = motion
        self._error_limit = self.supervision.following_error
        self._moved = False
        self.lease = 0
        """Lease of the commander of its motion; 0: the joystick, which needs none."""

    def update(self, context: PartContext) -> None:
        """Report its position when it has come to rest after a motion or a command."""
        super().update(context)
        before, self._moved = self._moved, self.motion.moving
        if before and not self._moved and context.all_enabled:
            context.publish(GripperAtRest(self.first, self.state.commanded[0], self.motion.gripped))

    def publish(self, values: list[Any]) -> None:
        """Write actual and commanded values of its drive."""
        drive, at = self.drive, self.at
        values[at : at + len(GRIPPER_FIELDS)] = (
            drive.position, drive.velocity, drive.torque, drive.target_position, drive.state,
            drive.statusword,
        )  # fmt: skip

    def grip(self, close: bool, lease: int = 0) -> bool:
        """Close or open, for the commander of `lease`; return False, without effect, where its drive is not enabled."""
        drive = self.drive
        enabled = drive.state is DriveState.OPERATION_ENABLED and drive.mode_display == drive.mode
        if not (enabled and self.motion.grip(self.state, close)):
            return False
        self.lease = lease
        # Already at its target it comes to rest within this cycle.
        self._moved = True
        return True

    def command(self) -> GuardResult:
        """Write the target of this cycle: motion -> limiter. The next setpoint starts from the limited target."""
        motion, drive, commanded = self.motion, self.drive, self.state.commanded
        motion.update(self.state)
        drive.target_position = commanded[0]
        self.output_limiter.check(self.drives)
        commanded[0] = drive.target_position
        self.supervision.following_error = inf if motion.gripped else self._error_limit
        return GuardResult.PASS

    @property
    def at_rest(self) -> bool:
        """Whether its setpoint stands still."""
        return not self.motion.moving

    def stop(self) -> None:
        """Stop on the way."""
        self.motion.stop(self.state)

    def hold(self) -> None:
        """Hold at the last setpoint and forget the grip."""
        self.motion.hold(self.state)
        self.motion.gripped = False

    def latch(self) -> None:
        """Let the setpoint be at rest."""
        self.motion.hold(self.state)


def make_gripper(config: ArmConfig) -> DrivenGripper | None:
    """Return the gripper with a drive; None: no gripper, or one on an output.

    Raises:
        DeviceError: its device's description is not suitable.
    """
    gripper = config.gripper
    if gripper is None or gripper.joint is None or gripper.open_position is None or gripper.closed_position is None:
        return None
    joint = gripper.joint
    motion = GripperMotion(joint, gripper.open_position, gripper.closed_position, config.cycle.period_us * 1e-6)
    return DrivenGripper(replace(config, joints=(joint,)), motion, len(config.joints))
