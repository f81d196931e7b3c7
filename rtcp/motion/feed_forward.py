"""Feed-forward: what a drive adds to the output of its own loops in CSP and CSV (CiA 402-2, objects 0x60B1, 0x60B2)."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Final, Protocol

from rtcp.config.model import ArmConfig
from rtcp.ipc.states import DriveMode
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState
from rtcp.motion.tool_in_use import Gravity

_RISE_S: Final = 0.5
"""Shortest time in which a torque offset changes by the joint's torque limit, s: at first the drive's own loop carries
the weight, and hands it over without a jerk."""


class Offsets(Protocol):
    """The offsets of a drive, in SI units; `change`: largest change of the torque in a cycle."""

    velocity: float
    torque: float
    change: float


class FeedForward:
    """Computes the offsets of the drives that take them, once a cycle in which the drives follow setpoints.

    The velocity offset is the setpoint's velocity, in CSP alone: in CSV the target velocity contains it. The torque
    offset is the weight at the setpoint and the joint's inertia times the setpoint's acceleration. Both are bounded by
    the limits in force.

    Args:
        config: which fractions of them are sent, and the joints' inertia.
        limits: in force.
        gravity: weight of the joints.
        offsets: of each joint's drive; None: the drive takes none.
    """

    def __init__(self, config: ArmConfig, limits: Limits, gravity: Gravity, offsets: Sequence[Offsets | None]) -> None:
        settings, joints = config.feed_forward, config.joints
        self._velocity, self._weight = settings.velocity, settings.gravity
        self._inertia = [settings.acceleration * joint.inertia for joint in joints]
        self._limits, self._gravity = limits, gravity
        self._offsets = [(i, each) for i, each in enumerate(offsets) if each is not None]
        self._rise = config.cycle.period_us * 1e-6 / _RISE_S
        self._nothing = [0.0] * len(joints)

    def update(self, state: ArmState, mode: DriveMode) -> None:
        """Set the offsets for the setpoints of this cycle."""
        limits = self._limits
        csp, known = mode is DriveMode.CSP, self._weight != 0.0 and mode is not DriveMode.CST
        weight = self._gravity.torques(state.commanded) if known else self._nothing
        for i, offsets in self._offsets:
            speed = self._velocity * state.commanded_velocity[i] if csp else 0.0
            offsets.velocity = _within(speed, limits.velocity[i])
            bound = limits.torque[i]
            torque = self._weight * weight[i] + self._inertia[i] * state.commanded_acceleration[i]
            offsets.torque = 0.0 if mode is DriveMode.CST else _within(torque, bound)
            offsets.change = bound * self._rise


def _within(value: float, bound: float) -> float:
    """Return the nearest value from -`bound` to `bound`; 0 of what is no number."""
    return 0.0 if isnan(value) else min(max(value, -bound), bound)
