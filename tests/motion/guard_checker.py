"""The guards and an independent checker of the limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import isfinite

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, Box, KeepOut
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import ArmState, Setpoint
from rtcp.testing.sessions.oracle import Shape
from tests.arm_geometry import box_gaps, depth, own_gap, points

ROUNDING_RAD = 1e-6
ROUNDING_M = 1e-8


class GuardChecker:
    """A guard and its targets; every cycle is compared with the limits in force at its beginning."""

    def __init__(self, config: ArmConfig, start: Sequence[float], dt: float) -> None:
        self.config, self.dt = config, dt
        self.limits = Limits(config)
        self.guard = TrajectoryGuard(config, self.limits, dt)
        self.state = ArmState(len(config.joints))
        self.state.commanded = list(start)
        self.guard.latch(self.state)
        self.mean = [0.0] * len(start)
        self.target = Setpoint(len(start))
        self._depths = self.depths()

    def depths(self) -> list[float]:
        """Return how far the tool is beyond its box, bodies too near to each other and to each box, m, and cones, rad.

        Negative where all is well.
        """
        if self.config.arm is None:
            return []
        q = self.state.commanded
        depths = [-1.0 if self.limits.box is None else -depth(points(q)[0], self.limits.box), -own_gap(q)]
        tilts = [SHAPE.tilt(q, cone.axis, cone[1:4]) - cone.angle for cone in self.limits.cones]
        return depths + [-gap for box in self.limits.keep_out for gap in box_gaps(q, box)] + tilts

    def request(
        self, position: Iterable[float], tolerates_saturation: bool, velocity: Iterable[float] | None = None
    ) -> GuardResult:
        """One cycle with a target, checked."""
        state, limits, dt = self.state, self.limits, self.dt
        target = self.target
        target.position = list(position)
        here = list(state.commanded)
        target.velocity = [(q - p) / dt for q, p in zip(target.position, here, strict=True)]
        if velocity is not None:
            target.velocity = list(velocity)
        verdict = self.guard.apply(state, target, tolerates_saturation)
        for i in range(len(here)):
            q, u = state.commanded[i], limits.acceleration[i] * dt
            mean = (q - here[i]) / dt
            assert all(map(isfinite, (q, state.commanded_velocity[i], state.commanded_acceleration[i])))
            assert limits.low[i] - ROUNDING_RAD <= q <= limits.high[i] + ROUNDING_RAD, (i, q)
            assert abs(mean) <= limits.velocity[i] * (1 + 1e-6) + 1e-10, (i, mean)
            assert abs(state.commanded_velocity[i]) <= limits.velocity[i] * (1 + 1e-6), (i, state.commanded_velocity[i])
            assert abs(mean - self.mean[i]) <= u * (1 + 1e-4) + 1e-10, (i, mean, self.mean[i])
            assert abs(state.commanded_velocity[i] - mean) <= u * (1 + 1e-4) + 1e-10, (
                i,
                state.commanded_velocity[i],
                mean,
            )
            assert abs(state.commanded_acceleration[i]) <= limits.acceleration[i] * (1 + 1e-4), (
                i,
                state.commanded_acceleration[i],
            )
            if verdict is GuardResult.STOPPING:
                assert abs(state.commanded_acceleration[i] - (mean - self.mean[i]) / dt) < 1e-6 / dt
            self.mean[i] = mean
        now = self.depths()
        for was, deep in zip(self._depths, now, strict=True):
            assert deep <= max(0.0, was) + ROUNDING_M, (was, deep)
        self._depths = now
        return verdict

    def stop(self) -> int:
        """Run the guard's own stop to rest whatever the targets; return its cycles."""
        longest = max(v / a for v, a in zip(self.limits.velocity, self.limits.acceleration, strict=True))
        for cycle in range(int(longest / self.dt) + 3):
            if not self.guard.stopping:
                assert not any(self.state.commanded_velocity)
                return cycle
            self.request([float("nan")] * len(self.mean), tolerates_saturation=False)
        raise AssertionError("the stop does not end")

    def change(self, new: Values) -> bool:
        """Change the limits as one transaction, as the loop does."""
        if self.guard.refusal_of(self.state, new) is not None:
            return False
        self.limits.apply(new)
        self._depths = self.depths()
        return True


ARM = load(default_config())
"""The arm as delivered, boxes and all."""
assert ARM.arm is not None
MODEL = ARM.arm
"""Its geometry."""
SHAPE = Shape([MODEL], 0, ARM.cartesian.clearance)
"""Its shape, by code that the product does not use."""
_RANGE = replace(ARM.joints[1].position, min=-0.3, max=0.2)
_SHORT = replace(ARM.joints[1], acceleration=0.7, velocity=1.5, position=_RANGE)
JOINTS_ONLY = replace(ARM, joints=(ARM.joints[0], _SHORT), arm=None)
"""Two joints without a geometry; one is too fast for its short range."""


def with_boxes(box: Sequence[float] | None, *keep_out: Sequence[float]) -> ArmConfig:
    """Return the arm with other boxes: lower corner, upper corner."""
    cartesian = replace(
        ARM.cartesian,
        box=None if box is None else Box(tuple(box[:3]), tuple(box[3:])),
        keep_out=tuple(
            KeepOut(f"box{n}", tuple(corners[:3]), tuple(corners[3:])) for n, corners in enumerate(keep_out)
        ),
    )
    return replace(ARM, cartesian=cartesian)
