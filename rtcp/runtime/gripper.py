"""A gripper with a drive of its own in the cycle: beside the arm, whose modes and guards do not know it."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.devices.cia402 import Cia402Drive, DriveGoal, DriveState
from rtcp.fieldbus.bus import ProcessData
from rtcp.motion.gripper import GripperMotion

_RANGE_MARGIN_RAD = 0.02
"""So far beyond its range it may stand and still be enabled, to be brought back to the edge."""


class DrivenGripper:
    """The gripper's drive in CSP: enabled and disabled with the arm's, on its way by itself.

    `decode` and `encode` beside the arm's; `follow` or `command` in each cycle in which the arm follows or commands.
    """

    def __init__(self, slot: int, drive: Cia402Drive, motion: GripperMotion) -> None:
        """Make it of its driver, the index of its slave and its motion; see `gripper_of`."""
        self.slot = slot
        self.drive = drive
        self.motion = motion

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

    def lead(self, goal: DriveGoal) -> None:
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

    def grip(self, close: bool) -> bool:
        """Close or open; return False, and do nothing, where its drive is not enabled."""
        return self.enabled and self.motion.grip(close)

    def stop(self) -> None:
        """Come to rest on the way."""
        self.motion.stop()


def gripper_of(config: ArmConfig) -> DrivenGripper | None:
    """Return the gripper with a drive, or None where there is none or one on an output.

    Raises:
        DeviceError: its device's description cannot serve.
    """
    gripper = config.gripper
    if gripper is None or gripper.joint is None or gripper.open_position is None or gripper.closed_position is None:
        return None
    joint = gripper.joint
    slot = next(slot for slot, slave in enumerate(config.slaves) if slave.name == joint.slave)
    zero = config.zero_offsets[-1] if config.zero_offsets else 0.0
    drive = Cia402Drive(config.slaves[slot], speed_limit=joint.velocity, zero=zero)
    period_s = config.cycle.period_us * 1e-6
    motion = GripperMotion(joint, gripper.open_position, gripper.closed_position, period_s)
    return DrivenGripper(slot, drive, motion)
