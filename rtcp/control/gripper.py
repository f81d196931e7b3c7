"""A gripper with a drive of its own in the cycle: beside the arm, whose modes and guards do not know it."""

from __future__ import annotations

from rtcp.config.model import ArmConfig, Joint, SupervisionConfig
from rtcp.devices.cia402 import Cia402Drive, DriveState, TargetState, drive_of
from rtcp.fieldbus.bus import ProcessData
from rtcp.motion.controllers.gripper import GripperMotion
from rtcp.motion.guards.supervision import FOLLOWING_ERROR, SPEED, Found

_RANGE_MARGIN_RAD = 0.02
"""So far beyond its range it may stand and still be enabled, to be brought back to the edge."""

FOLLOWED_RAD = 0.03
"""No joint that stood turns so far between two frames: where a drive says so while it is enabled, it is not followed.
More than what a joint may stand beyond its range, which it is not followed out of."""


class DrivenGripper:
    """The gripper's drive in CSP: enabled and disabled with the arm's, on its way by itself.

    `decode` and `encode` beside the arm's; `follow` or `command` in each cycle in which the arm follows or commands.
    """

    def __init__(self, slot: int, drive: Cia402Drive, motion: GripperMotion, watch: GripperWatch) -> None:
        """Make it of the index of its slave, its driver, its motion and what watches it; see `gripper_of`."""
        self.slot = slot
        self.drive = drive
        self.motion = motion
        self.watch = watch
        self._moved = False
        self.lease = 0
        """Lease of the commander that set it in motion; 0: the stick's, which needs none."""

    def decode(self, data: ProcessData) -> None:
        """Take the drive's inputs."""
        self.drive.decode(data.input(self.slot))

    def encode(self, data: ProcessData) -> None:
        """Hand over the drive's outputs."""
        data.set_output(self.slot, self.drive.encode())

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
        """Whether `follow` would take the set-point further than a gripper can have turned since it was followed."""
        drive = self.drive
        return drive.state is not DriveState.OPERATION_ENABLED and not (
            abs(drive.position - self.motion.position) <= FOLLOWED_RAD
        )

    def lead(self, goal: TargetState) -> None:
        """Lead the drive one step towards `goal`."""
        self.drive.advance(goal)

    def follow(self) -> None:
        """Let the set-point follow a drive that does not follow it; an enabled one keeps what it has, at rest."""
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

    def came_to_rest(self) -> bool:
        """Whether its set-point moved, or was told to, since the last call and stands now; called once a cycle."""
        before, self._moved = self._moved, self.motion.moving
        return before and not self._moved

    def look(self) -> Found | None:
        """Look at the cycle's measurements; return what has been beyond its limit for too long, or None."""
        return self.watch.look(self.drive, self.motion)

    def stop(self) -> None:
        """Come to rest on the way."""
        self.motion.stop()


class GripperWatch:
    """What is measured of a gripper against its limit: speed, and how far it is from where it was commanded.

    What it holds shows as torque, and as a distance where it is soft: its motion ends there, no stop does.

    Args:
        config: factors, and how many cycles in a row are too many.
        joint: the gripper's.
        axis: the joint's number, for the sentence.
    """

    def __init__(self, config: SupervisionConfig, joint: Joint, axis: int) -> None:
        self._axis = axis
        self._cycles = config.cycles
        self._speed = config.speed * joint.velocity
        self._error = config.following_error
        self._fast = self._off = 0

    def look(self, drive: Cia402Drive, motion: GripperMotion) -> Found | None:
        """Look at one cycle's measurements; return what has been beyond its limit for too long, or None."""
        # A comparison with NaN is false: it counts as beyond.
        self._fast = 0 if abs(drive.velocity) <= self._speed else self._fast + 1
        if self._fast >= self._cycles:
            return Found(SPEED, self._axis, drive.velocity, self._speed)
        error = drive.position - motion.position
        self._off = 0 if motion.gripped or abs(error) <= self._error else self._off + 1
        if self._off >= self._cycles:
            return Found(FOLLOWING_ERROR, self._axis, error, self._error)
        return None

    def reset(self) -> None:
        """Begin to count anew."""
        self._fast = self._off = 0


def gripper_of(config: ArmConfig) -> DrivenGripper | None:
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
    return DrivenGripper(slot, drive, motion, GripperWatch(config.supervision, joint, len(config.joints)))
