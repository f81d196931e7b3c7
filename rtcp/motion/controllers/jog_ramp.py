"""The tool velocity on its way to the one that is asked for, under Cartesian acceleration and jerk."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

from rtcp.config.model import CartesianConfig


class JogRamp:
    """`velocity`: vx, vy, vz (m/s), wx, wy, wz (rad/s) along the base's axes; `step` leads it to what is wanted.

    The six change in one proportion, so that from rest and to rest the tool keeps its direction.

    Args:
        config: accelerations and jerks.
    """

    def __init__(self, config: CartesianConfig) -> None:
        self._linear, self._angular = 1.0 / config.acceleration, 1.0 / config.angular_acceleration
        self._rise = max(config.acceleration / config.jerk, config.angular_acceleration / config.angular_jerk)
        self._weight = (self._linear / self._angular) ** 2
        self.velocity = [0.0] * 6
        self.acceleration = [0.0] * 6

    def begin(self, velocity: Sequence[float]) -> None:
        """Begin with a velocity, without acceleration."""
        self.velocity[:] = velocity
        for i in range(6):
            self.acceleration[i] = 0.0

    def step(self, wanted: Sequence[float], dt: float) -> None:
        """Go one cycle towards `wanted`."""
        v, acc = self.velocity, self.acceleration
        if v == wanted:
            for i in range(6):
                acc[i] = 0.0
            return
        a, b, c = wanted[0] - v[0], wanted[1] - v[1], wanted[2] - v[2]
        d, e, f = wanted[3] - v[3], wanted[4] - v[4], wanted[5] - v[5]
        time = max(sqrt(a * a + b * b + c * c) * self._linear, sqrt(d * d + e * e + f * f) * self._angular)
        rise = dt / self._rise
        if time <= 2.0 * dt * rise:
            v[:] = wanted
            for i in range(6):
                acc[i] = 0.0
            return
        # With constant jerk the acceleration has to fall as the root of what is left.
        full = sqrt(1.6 * time / self._rise)
        full = (1.0 if full > 1.0 else full) / time
        if full * dt > 0.5:
            full = 0.5 / dt
        a, b, c = a * full - acc[0], b * full - acc[1], c * full - acc[2]
        d, e, f = d * full - acc[3], e * full - acc[4], f * full - acc[5]
        change = max(sqrt(a * a + b * b + c * c) * self._linear, sqrt(d * d + e * e + f * f) * self._angular)
        part = rise / change if change > rise else 1.0
        for i, more in enumerate((a, b, c, d, e, f)):
            acc[i] += part * more
            v[i] += acc[i] * dt

    def held(self, velocity: Sequence[float]) -> None:
        """Take what has become of the velocity; an acceleration against what was cut is given up."""
        v, acc, weight = self.velocity, self.acceleration, self._weight
        a, b, c = velocity[0] - v[0], velocity[1] - v[1], velocity[2] - v[2]
        d, e, f = velocity[3] - v[3], velocity[4] - v[4], velocity[5] - v[5]
        v[:] = velocity
        size = a * a + b * b + c * c + (d * d + e * e + f * f) / weight
        if size < 1e-24:
            return
        along = a * acc[0] + b * acc[1] + c * acc[2] + (d * acc[3] + e * acc[4] + f * acc[5]) / weight
        if along < 0.0:
            part = along / size
            for i, more in enumerate((a, b, c, d, e, f)):
                acc[i] -= part * more
