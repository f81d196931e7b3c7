"""The limits of the joints inside their drives: a guard that does not depend on this software.

A device's file names the objects (`limits`); their values follow from the joint in the arm's file. They lie a little
beyond what this platform itself keeps to, so that its own guards and its supervision act first. Limits that the file
does not name stay as the drive holds them, and are compared with what the joints need (`AxisNeeds`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from math import inf
from typing import Final

from kinematics.gravity import worst_torques
from rtcp.config.model import (
    JOINTS,
    UNLIMITED_TORQUE,
    ArmConfig,
    AxisNeeds,
    DeviceDescription,
    Joint,
    LimitObject,
    SlaveConfig,
    StartupSdo,
    integer_range,
)

BEYOND_RANGE_RAD: Final = 0.05
"""How far the drive's position limits lie outside the joint's range, rad: a joint that sagged out of it is led back."""
BEYOND_RANGE_M: Final = 0.005
"""The same of an external axis in metres, m."""
BEYOND_SUPERVISION: Final = 1.5
"""The drive's speed limit, multiple of the supervision's threshold."""
SLOWEST_QUICK_STOP_S: Final = 2.0
"""Time for which the platform waits for a quick stop whose deceleration no start-up SDO sets, s."""
_CHANNELS: Final = {
    "position": ("target_position", "position"),
    "velocity": ("target_velocity", "velocity"),
    "torque": ("target_torque", "torque"),
}
"""Channels whose factor an object has that states none, by quantity."""


def channel_factor(device: DeviceDescription, quantity: str, axis: int) -> float | None:
    """Return the SI units per count of `position`, `velocity` or `torque` of an axis; None: no channel states them."""
    factors = {
        channel.name: channel.factor
        for pdo in (*device.tpdo, *device.rpdo)
        for channel in pdo.channels
        if pdo.axis_of(channel) == axis
    }
    return next((factors[name] for name in _CHANNELS[quantity] if name in factors), None)


def factor_of(device: DeviceDescription, entry: LimitObject) -> float | None:
    """Return the SI units per count of an object; None: neither the object nor a channel of the axis states one."""
    if entry.factor is not None:
        return entry.factor
    return channel_factor(device, entry.limit.partition("_")[0], entry.axis)


def joint_limits(config: ArmConfig, slave: SlaveConfig, joint: Joint, zero: float) -> Iterator[StartupSdo]:
    """Yield the limits of a joint as objects of its drive, wide enough for all that `absolute` allows while it runs.

    Args:
        config: the arm.
        slave: the drive of the joint.
        joint: the joint.
        zero: position of the drive at joint position 0, rad.
    """
    widest, supervision = joint.absolute.position or joint.position, config.supervision
    metres = any(axis.name == joint.name and axis.unit == "m" for axis in config.external_axes)
    beyond = BEYOND_RANGE_M if metres else BEYOND_RANGE_RAD
    low, high = widest.min - beyond + zero, widest.max + beyond + zero
    threshold = (joint.absolute.velocity or joint.velocity) * (supervision.absolute.speed or supervision.speed)
    velocity = threshold * BEYOND_SUPERVISION
    for entry in slave.device.limits:
        factor = factor_of(slave.device, entry)
        if entry.axis != joint.axis or factor is None or (entry.limit == "torque" and joint.drive_torque is None):
            continue
        # A drive that turns the other way has its ends exchanged.
        ends = sorted((low / factor, high / factor))
        values = {
            "position_min": ends[0],
            "position_max": ends[1],
            "velocity": abs(velocity / factor),
            "torque": abs((joint.drive_torque or 0.0) / factor),
        }
        least, most = integer_range(entry.type)
        counts = min(max(round(values[entry.limit]), least), most)
        name = f"{entry.limit} of {joint.name}"
        yield StartupSdo(entry.index, entry.sub_index, entry.type, counts, name, optional=True)


def with_limits(config: ArmConfig) -> tuple[SlaveConfig, ...]:
    """Return the slaves of an arm with the limits of their joints, for the bus to write, and with what these need."""
    zeros = config.zero_offsets or (0.0,) * len(config.axes)
    joints = list(zip(config.axes, zeros, strict=True))
    needs = list(_needs(config, zeros))
    return tuple(
        replace(
            slave,
            limits=tuple(
                sdo
                for joint, zero in joints
                if joint.slave == slave.name
                for sdo in joint_limits(config, slave, joint, zero)
            ),
            needs=tuple(need for (joint, _), need in zip(joints, needs, strict=True) if joint.slave == slave.name),
        )
        for slave in config.slaves
    )


def _needs(config: ArmConfig, zeros: Sequence[float]) -> Iterator[AxisNeeds]:
    """Yield what each axis needs of its drive's own settings."""
    weights = [0.0] * len(config.axes)
    ranges = tuple((joint.position.min, joint.position.max) for joint in config.joints)
    for model in config.models:
        if model.links and len(ranges) == JOINTS:
            weights[: len(ranges)] = map(max, weights, worst_torques(model, ranges))
    quick = tuple(key.name for key in fields(config.stops) if getattr(config.stops, key.name) == "quick_stop")
    external = {axis.name: axis for axis in config.external_axes}
    for joint, zero, weight in zip(config.axes, zeros, weights, strict=True):
        measured, axis = joint.torque < UNLIMITED_TORQUE, external.get(joint.name)
        yield AxisNeeds(
            joint.name,
            joint.axis,
            (joint.position.min + zero, joint.position.max + zero),
            joint.velocity,
            config.supervision.following_error if axis is None else inf,
            weight,
            joint.torque * config.supervision.torque if measured else inf,
            joint.velocity / SLOWEST_QUICK_STOP_S,
            quick,
            ("profile_velocity",) if axis else config.feed_forward.channels if joint in config.joints else (),
            0.0 if axis is None else axis.acceleration,
            "rad" if axis is None else axis.unit,
        )
