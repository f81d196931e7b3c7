"""Base class of the drives of joints, in SI units, and the factory of a joint's driver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import ClassVar, Final

from mypy_extensions import mypyc_attr

from rtcp.config.model import ArmConfig, DriveWaitsConfig, Joint, SlaveConfig
from rtcp.devices.driver import DeviceError, Driver, integer_range, make_driver
from rtcp.fieldbus.pdo import ImageLayout
from rtcp.ipc.states import DriveState, Missing

CSP, CSV, CST = 8, 9, 10
"""Modes of operation, object 0x6060 (CiA 402-2, clause 10.1)."""
_WINDOW_S: Final = 0.02
"""Window of the velocity measurement for drives that do not report it: 1 count of 1e-4 rad is 0.005 rad/s."""
OFFSETS: Final = ("velocity_offset", "torque_offset")
"""Output channels of feed-forward, 0x60B1 and 0x60B2."""


class TargetState(Enum):
    """Target state of a drive."""

    DISABLED = "disabled"
    QUICK_STOPPED = "stopped by quick stop"
    """Ramps down by itself and holds (0x605A = 6) until DISABLED is requested; a drive without torque stays without."""
    ENABLED = "enabled"
    TORQUE_OFF = "without torque at once"
    """Disable voltage from every state: no ramp, the brake closes on whatever moves."""
    RESET = "free of faults"
    """Resets a fault and stops at `switch on disabled`."""


class DriveOffsets:
    """What the drive adds to the outputs of its loops: `velocity`, rad/s, and `torque`, Nm; 0 until set.

    The torque that is sent changes by `change`, Nm, in a cycle at most, but to 0 where the drive must not add it.

    Args:
        image: outputs of the drive.
        names: the channels that feed-forward drives; another one keeps its value.
    """

    __slots__ = ("_channels", "_fields", "_sent", "change", "torque", "velocity")

    def __init__(self, image: ImageLayout, names: Sequence[str] = OFFSETS) -> None:
        self.velocity = self.torque = self.change = self._sent = 0.0
        found = [image.find(name) if name in names else None for name in OFFSETS]
        self._fields = [-1 if channel is None else image.channels.index(channel) for channel in found]
        self._channels = [(0.0, 0, 0) if channel is None else (1.0 / channel.factor, *integer_range(channel))
                          for channel in found]  # fmt: skip

    def clear(self) -> None:
        """Set both to 0, and begin anew with the torque."""
        self.velocity = self.torque = self._sent = 0.0

    def write(self, fields: list[int], acts: bool, at_once: bool) -> None:
        """Write them into the fields of the outputs.

        Args:
            fields: of the outputs.
            acts: whether the drive adds them as it is meant to; otherwise they become 0.
            at_once: the torque becomes 0 in this cycle, because the drive has no torque or adds it to one that is sent.
        """
        self._put(fields, 0, self.velocity if acts else 0.0)
        before, wanted = self._sent, self.torque if acts and math.isfinite(self.torque) else 0.0
        self._sent = 0.0 if at_once else min(max(wanted, before - self.change), before + self.change)
        self._put(fields, 1, self._sent)

    def _put(self, fields: list[int], which: int, value: float) -> None:
        at = self._fields[which]
        if at >= 0:
            scale, low, high = self._channels[which]
            fields[at] = int(min(max(value * scale, low), high)) if math.isfinite(value) else 0


@mypyc_attr(allow_interpreted_subclasses=True)
class Drive(Driver):
    """A drive in SI units: `decode`, `advance`, set targets, `encode`.

    Attributes that `decode` sets: `position` (rad), `velocity` (rad/s), `torque` (Nm; 0 where it is not measured),
    `state`, `missing`, `mode_display`, `temperature` (C; not a number where it is not measured), and `statusword`,
    0 for a drive without one.
    Attributes that `encode` takes: `mode`, `target_position` (rad), `target_velocity` (rad/s, CSV), `target_torque`
    (Nm, CST), `speed_limit` (rad/s). `zero` (rad) is what the drive itself shows where the joint is at 0; `position`
    and `target_position` count from it.

    Args:
        slave: the name and description of what is on the bus.
        period_s: the cycle, s.
        speed_limit: rad/s; fixed once it is enabled.
        zero: what the drive shows where the joint is at 0, rad.

    Raises:
        DeviceError: the description lacks a channel, or one has a type or a factor that cannot serve.
    """

    HAS_STATUSWORD: ClassVar[bool] = False

    def __init__(self, slave: SlaveConfig, period_s: float, *, speed_limit: float = 0.0, zero: float = 0.0) -> None:
        super().__init__(slave, period_s)
        self.position = self.velocity = self.torque = 0.0
        self.resolution = self.velocity_resolution = 0.0
        """One count of the position, rad, and of a measured velocity, rad/s; 0: unknown."""
        self.still = 0.01
        """Speed below which it stands, rad/s, or m/s of an axis in m."""
        self.temperature = math.nan
        self.statusword = self.mode_display = 0
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self.missing = Missing.NOTHING
        """Manual action required at a robot controller before it follows targets."""
        self.mode = CSP
        self.speed_limit = speed_limit
        self.deceleration = math.inf
        """Deceleration of a quick stop ramped by this driver, rad/s^2."""
        self.low, self.high = -math.inf, math.inf
        """Ends of that ramp, rad."""
        self.reset_pulse_s = DriveWaitsConfig.reset_pulse_ms * 1e-3
        """Time for which the fault reset bit is set, s."""
        self.slave: SharedSlave | None = None
        """Set if other axes of its slave move joints too: its outputs are a part of the slave's."""
        self.offsets: DriveOffsets | None = None
        """Feed-forward, if the drive takes it and it is configured."""
        self._zero = zero
        self.target_position = self.target_velocity = self.target_torque = 0.0
        self._past: list[float] = []
        self._past_at = 0

    @property
    def zero(self) -> float:
        """Position of the drive at joint position 0, rad. A change moves `position`; the sent targets stay."""
        return self._zero

    @zero.setter
    def zero(self, zero: float) -> None:
        moved = self._zero - zero
        self._zero = zero
        self.position += moved
        self.target_position += moved

    def supports(self, mode: int) -> bool:
        """Whether targets of a mode (CSP, CSV, CST) reach the joint."""
        raise NotImplementedError

    def advance(self, target: TargetState) -> bool:
        """Take the next step towards `target` by the actual state; return whether it is reached."""
        raise NotImplementedError

    def latch(self) -> None:
        """Set the target position to the actual one, the other targets to zero: on enabling, on entering CSP."""
        self.target_position = self.position
        self.target_velocity = self.target_torque = 0.0

    def replace_position(self, position: float) -> None:
        """Use `position`, rad, in place of the sample of this cycle."""
        self.position = position
        if self._past:
            self._past[self._past_at - 1] = position + self._zero

    @property
    def measures_velocity(self) -> bool:
        """Whether `velocity` is measured by the drive, and not computed here from its positions."""
        return not self._past

    def _measured_velocity(self, position: float) -> float:
        """Return the mean velocity over 20 ms, rad/s; `position`: of this cycle, rad."""
        past = self._past
        if not past:
            past += [position] * max(round(_WINDOW_S / self.period_s), 1)
        at = self._past_at
        moved = position - past[at]
        past[at] = position
        self._past_at = at + 1 if at + 1 < len(past) else 0
        return moved / (len(past) * self.period_s)


class SharedSlave:
    """The outputs of a slave with several drives, each of which has its own bits.

    Args:
        drives: its axes.
    """

    def __init__(self, drives: Sequence[Drive]) -> None:
        self._length = max(drive.output_bytes for drive in drives)
        self._parts = dict.fromkeys(drives, 0)
        for drive in drives:
            drive.slave = self

    def outputs(self, drive: Drive, own: bytes) -> bytes:
        """Return the slave's outputs: `own` of one drive, and the last encoded outputs of the others."""
        self._parts[drive] = int.from_bytes(own, "little")
        whole = 0
        for part in self._parts.values():
            whole |= part
        return whole.to_bytes(self._length, "little")


def share_slaves(pairs: Sequence[tuple[int, Drive]]) -> None:
    """Let drives of one slave share its outputs; `pairs`: the index of its slave and the driver of each drive."""
    for slot in {slot for slot, _ in pairs}:
        drives = [drive for number, drive in pairs if number == slot]
        if len(drives) > 1:
            SharedSlave(drives)


def slave_of(config: ArmConfig, joint: Joint) -> tuple[int, SlaveConfig]:
    """Return index and description of the slave that moves `joint`, with the channels of its axis alone."""
    slot = next(slot for slot, slave in enumerate(config.slaves) if slave.name == joint.slave)
    slave = config.slaves[slot]
    return slot, replace(slave, device=slave.device.of_axis(joint.axis))


def configure_drive(drive: Drive, config: ArmConfig, joint: Joint, zero: float) -> None:
    """Give a drive the limits of the joint that it moves, its zero as in `Drive`, and the waits of all drives."""
    drive.speed_limit = joint.velocity
    drive.deceleration = joint.acceleration
    drive.low, drive.high = joint.position.min, joint.position.max
    drive.reset_pulse_s = config.drive_waits.reset_pulse_ms * 1e-3
    drive.zero = zero


def drive_of(config: ArmConfig, joint: Joint, zero: float) -> tuple[int, Drive]:
    """Return the driver of the drive that moves `joint`, with the index of its slave; `zero` as in `Drive`.

    Raises:
        DeviceError: the description is not usable, or the device is not a drive.
    """
    slot, slave = slave_of(config, joint)
    drive = make_driver(slave, config.cycle.period_us * 1e-6)
    if not isinstance(drive, Drive):
        raise DeviceError(f"slave {slave.name} (kind {slave.device.kind}) is no drive: it cannot move {joint.name}")
    configure_drive(drive, config, joint, zero)
    if drive.HAS_STATUSWORD and any(map(drive.rpdo.find, config.feed_forward.channels)):
        drive.offsets = DriveOffsets(drive.rpdo, config.feed_forward.channels)
    return slot, drive
