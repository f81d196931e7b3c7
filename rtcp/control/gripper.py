"""A gripper with a drive of its own in the cycle, beside the arm, whose controllers and guards do not know it."""

from __future__ import annotations

from typing import Any

from rtcp.config.model import ArmConfig, Joint, SupervisionConfig
from rtcp.control.part import Part, PartContext
from rtcp.devices.cia402 import Cia402Drive, DriveState, drive_of
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.events import EmergencyStop, FollowingError, GripperAtRest, OverSpeed
from rtcp.ipc.schema import GRIPPER_FIELDS
from rtcp.motion.controllers.gripper import GripperMotion

_RANGE_MARGIN_RAD = 0.02
"""So far outside its range it may stand and still be enabled, to return to the edge."""

TRACKED_RAD = 0.03
"""No joint that stood turns so far between two frames: a position further away is not tracked while enabling. More than
a joint may stand outside its range."""


class DrivenGripper(Part):
    """The drive of the gripper in CSP: enabled and disabled with the arm, moved by itself.

    `track_actual` or `command` in each cycle in which the arm does so.
    """

    def __init__(
        self, slot: int, drive: Cia402Drive, motion: GripperMotion, supervision: GripperSupervision, axis: int
    ) -> None:
        """Take the index of its slave, its driver, its motion, its supervision and its axis; see `make_gripper`."""
        super().__init__("gripper", GRIPPER_FIELDS)
        self.slot = slot
        self.drive = drive
        self.motion = motion
        self.supervision = supervision
        self._axis = axis
        self._moved = False
        self.lease = 0
        """Lease of the commander that set it in motion; 0: the joystick, which needs none."""

    def decode(self, data: ProcessData) -> None:
        """Read the inputs of the drive."""
        self.drive.decode(data.input(self.slot))

    def encode(self, data: ProcessData) -> None:
        """Write the outputs of the drive."""
        data.set_output(self.slot, self.drive.encode())

    def update(self, context: PartContext) -> None:
        """Report where it came to rest."""
        at_rest = self.came_to_rest()
        if at_rest is not None and context.all_enabled:
            context.publish(at_rest)

    def publish(self, values: list[Any]) -> None:
        """Write what its drive measures and is sent."""
        drive, at = self.drive, self.at
        values[at : at + len(GRIPPER_FIELDS)] = (
            drive.position, drive.velocity, drive.torque, drive.target_position, drive.statusword,
        )  # fmt: skip

    @property
    def enabled(self) -> bool:
        """Whether its drive is enabled and in CSP."""
        drive = self.drive
        return drive.state is DriveState.OPERATION_ENABLED and drive.mode_display == drive.mode

    @property
    def outside(self) -> bool:
        """Whether it stands so far outside its range that it must not be enabled."""
        return abs(self.motion.clamped(self.drive.position) - self.drive.position) > _RANGE_MARGIN_RAD

    @property
    def off_target(self) -> bool:
        """Whether `track_actual` would move the setpoint further than a gripper can have turned."""
        drive = self.drive
        return drive.state is not DriveState.OPERATION_ENABLED and not (
            abs(drive.position - self.motion.position) <= TRACKED_RAD
        )

    def track_actual(self) -> None:
        """Let the setpoint follow a drive without torque; an enabled one keeps its own, at rest."""
        drive, motion = self.drive, self.motion
        if drive.state is not DriveState.OPERATION_ENABLED:
            motion.latch(drive.position)
        elif motion.moving:
            motion.latch(motion.position)
        drive.target_position = motion.position

    def command(self) -> None:
        """Write the target of this cycle."""
        drive = self.drive
        drive.target_position = self.motion.update(drive.torque)

    def grip(self, close: bool, lease: int = 0) -> bool:
        """Close or open, for the commander of `lease`; return False, and do nothing, where its drive is not enabled."""
        if not (self.enabled and self.motion.grip(close)):
            return False
        self.lease = lease
        # Where it already is where it shall be, it comes to rest before the cycle has ended.
        self._moved = True
        return True

    def came_to_rest(self) -> GripperAtRest | None:
        """Return where it rests if it moved, or was commanded to, since the last call; called once a cycle."""
        before, self._moved = self._moved, self.motion.moving
        if not before or self._moved:
            return None
        return GripperAtRest(self._axis, self.motion.position, self.motion.gripped)

    def beyond_limits(self) -> EmergencyStop | None:
        """Return what was measured beyond its limit for too long, or None."""
        return self.supervision.check(self.drive, self.motion)

    def stop(self) -> None:
        """Stop on the way."""
        self.motion.stop()


class GripperSupervision:
    """Checks the speed and the following error of a gripper.

    An object in its grip shows as torque, and as a following error where it is soft: that ends its motion and is no
    reason to stop the arm.

    Args:
        config: factors, and how many cycles in a row are too many.
        joint: the gripper's.
        axis: its number.
    """

    def __init__(self, config: SupervisionConfig, joint: Joint, axis: int) -> None:
        self._axis = axis
        self._cycles = config.cycles
        self._speed = config.speed * joint.velocity
        self._error = config.following_error
        self._fast = self._off = 0

    def check(self, drive: Cia402Drive, motion: GripperMotion) -> EmergencyStop | None:
        """Check the measurements of a cycle; return what was beyond its limit for too long, or None."""
        # A comparison with NaN is false: it counts as beyond.
        self._fast = 0 if abs(drive.velocity) <= self._speed else self._fast + 1
        if self._fast >= self._cycles:
            return OverSpeed(self._axis, drive.velocity, self._speed)
        error = drive.position - motion.position
        self._off = 0 if motion.gripped or abs(error) <= self._error else self._off + 1
        if self._off >= self._cycles:
            return FollowingError(self._axis, error, self._error)
        return None

    def reset(self) -> None:
        """Reset the counters."""
        self._fast = self._off = 0


def make_gripper(config: ArmConfig) -> DrivenGripper | None:
    """Return the gripper with a drive, or None where there is none or one on an output.

    Raises:
        DeviceError: its device's description cannot serve.
    """
    gripper = config.gripper
    if gripper is None or gripper.joint is None or gripper.open_position is None or gripper.closed_position is None:
        return None
    joint = gripper.joint
    slot, drive = drive_of(config, joint, config.zero_offsets[-1] if config.zero_offsets else 0.0)
    period_s = config.cycle.period_us * 1e-6
    motion = GripperMotion(joint, gripper.open_position, gripper.closed_position, period_s)
    axis = len(config.joints)
    return DrivenGripper(slot, drive, motion, GripperSupervision(config.supervision, joint, axis), axis)
