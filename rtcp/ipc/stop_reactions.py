"""Stop reactions: the one of each event, and upper bounds on stopping time and distance.

Hold is the reaction to every cycle with a wrong working counter, up to `bus.lost_cycles`. For other events the
configuration has keys under `stops`; a fault without a key takes a quick stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from math import sqrt
from typing import NamedTuple

from rtcp.config.drive_limits import SLOWEST_QUICK_STOP_S
from rtcp.config.model import ArmConfig, Joint, StopsConfig
from rtcp.ipc.events import EVENTS, Event

_LATENCY_CYCLES = 3
"""Cycles from the detection of an event to the drive's reaction and its feedback: frame, SYNC0, frame."""
_DRIVE_S = 0.03
"""Upper bound on the time from the end of the drive's ramp, or of the setpoints, to rest, s."""
_QUICK_STOP_DECELERATION = 0x6085


class StopReaction(IntEnum):
    """How the arm is stopped; each is harder than the one before. Stop categories: IEC 60204-1, 9.2.2."""

    HOLD = 0
    """The last targets are sent again."""
    CONTROLLED_STOP = 1
    """Setpoints decelerate to standstill under the limits; drives stay enabled: stop category 2."""
    QUICK_STOP = 2
    """Each drive decelerates by itself at 0x6085 and holds (0x605A = 6): category 2, and 1 where the torque follows."""
    TORQUE_OFF = 3
    """Disable voltage; the brakes stop the arm: stop category 0."""

    @property
    def words(self) -> str:
        """Return the name in words."""
        return self.name.lower().replace("_", " ")


def reactions(stops: StopsConfig) -> dict[type[Event], StopReaction]:
    """Return the stop reaction to every event with a key under `stops`, and to every fault; default: a quick stop."""
    return {
        kind: StopReaction[getattr(stops, kind.stop_key).upper()] if kind.stop_key else StopReaction.QUICK_STOP
        for kind in EVENTS
        if kind.stop_key or kind.is_fault
    }


class Bound(NamedTuple):
    """Upper bound on stopping time and distance from full speed, from the cycle that detects the event."""

    time_s: float
    way_rad: float
    """Distance: rad of a joint or of the tool's rotation, m of the tool's path."""


def bounds(config: ArmConfig, reaction: StopReaction, braking: Sequence[float] = ()) -> tuple[Bound, ...]:
    """Return the bound of each joint.

    Args:
        config: limits of the joints, of the tool and of the bus, and the settings of the drives.
        reaction: of the stop. The bound of `HOLD` ends at the next reaction, not at standstill.
        braking: for `TORQUE_OFF`: least deceleration of each joint by its closed brake, less its weight, rad/s^2.

    Raises:
        ValueError: 0x6085 of a drive, or a brake, is not known.
    """
    period_s = config.cycle.period_us * 1e-6
    late_s = _LATENCY_CYCLES * period_s
    limits = []
    for at, joint in enumerate(config.joints):
        v = joint.velocity
        if reaction is StopReaction.HOLD:
            # In CSV a joint continues at the last speed; in CSP it stops sooner.
            lost_s = config.bus.lost_cycles * period_s
            limits.append(Bound(lost_s, v * (lost_s + late_s)))
        elif reaction is StopReaction.CONTROLLED_STOP:
            stop = _ramp(v, joint.acceleration, joint.jerk)
            limits.append(Bound(stop.time_s + late_s + _DRIVE_S, stop.way_rad + v * (late_s + _DRIVE_S)))
        else:
            rate = (
                _quick_stop_rate(config, joint) if reaction is StopReaction.QUICK_STOP else _brake(braking, at, joint)
            )
            delay_s = late_s + _DRIVE_S
            limits.append(Bound(v / rate + delay_s, 0.5 * v * v / rate + v * delay_s))
    return tuple(limits)


def watchdog_bounds(config: ArmConfig) -> tuple[Bound, ...]:
    """Return the bound of each joint when frames no longer reach its drive, from the first missing frame.

    Until its watchdog expires the drive keeps its last target; then it is in fault and ramps down (0x605E = 2).
    """
    limits = []
    for joint, stop in zip(config.joints, bounds(config, StopReaction.QUICK_STOP), strict=True):
        watchdog_s = 1e-3 * next(s.device.watchdog_ms for s in config.slaves if s.name == joint.slave)
        limits.append(Bound(watchdog_s + stop.time_s, joint.velocity * watchdog_s + stop.way_rad))
    return tuple(limits)


def quick_stop_s(config: ArmConfig) -> float:
    """Return the upper bound on the time of a quick stop of all axes, the gripper's among them, s."""
    try:
        return max(bound.time_s for bound in bounds(replace(config, joints=config.axes), StopReaction.QUICK_STOP))
    except ValueError:
        return SLOWEST_QUICK_STOP_S


def longest_s(config: ArmConfig) -> float:
    """Return the upper bound on the time of a controlled or quick stop of all axes and of the tool, s."""
    controlled = bounds(replace(config, joints=config.axes), StopReaction.CONTROLLED_STOP)
    tool = tool_bounds(config, config.cartesian.speed, config.cartesian.angular_speed)
    return max(quick_stop_s(config), *(bound.time_s for bound in (*controlled, *tool)))


def tool_bounds(config: ArmConfig, speed: float, angular_speed: float) -> tuple[Bound, Bound]:
    """Return the bounds of the tool's controlled stop from `speed`, m/s, and from `angular_speed`, rad/s."""
    limits = config.cartesian
    late_s = _LATENCY_CYCLES * config.cycle.period_us * 1e-6 + _DRIVE_S
    along = _ramp(speed, limits.acceleration, limits.jerk)
    about = _ramp(angular_speed, limits.angular_acceleration, limits.angular_jerk)
    return (
        Bound(along.time_s + late_s, along.way_rad + speed * late_s),
        Bound(about.time_s + late_s, about.way_rad + angular_speed * late_s),
    )


def _ramp(v: float, a: float, j: float) -> Bound:
    """Bound a jerk-limited stop from a speed of at most `v` and any acceleration of at most `a`.

    At worst the speed rises with `a` when the stop begins: that acceleration ends first, at speed `v`, and the rest is
    the stop from there, which is symmetrical.
    """
    rising = min(a, sqrt(2.0 * v * j)) / j
    steepest = min(a, sqrt(v * j))
    falling = v / steepest + steepest / j
    return Bound(rising + falling, v * rising + 0.5 * v * falling)


def _quick_stop_rate(config: ArmConfig, joint: Joint) -> float:
    """Return 0x6085 of the start-up SDOs of the joint's drive, rad/s^2; of a drive of kind `joint`: the limit."""
    device = next(slave.device for slave in config.slaves if slave.name == joint.slave)
    if device.kind == "joint":
        return joint.acceleration
    # The unit of a rate is that of a speed, per second.
    channels = (entry for pdo in device.of_axis(joint.axis).rpdo for entry in pdo.channels)
    scaling = device.scaling_of(joint.axis)
    factors = [entry.factor for entry in channels if entry.name == "target_velocity"]
    factors += [] if scaling is None else [scaling.velocity]
    rate = device.startup(_QUICK_STOP_DECELERATION, joint.axis)
    if rate is None or not factors:
        raise ValueError(f"{device.name}: 0x6085 is not among its start-up SDOs: how fast it stops is not known")
    return rate * abs(factors[0])


def _brake(braking: Sequence[float], at: int, joint: Joint) -> float:
    if at >= len(braking):
        raise ValueError(f"{joint.name}: what its brake can do is not known")
    return braking[at]
