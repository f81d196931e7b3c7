"""Turns of 2 pi: which of an angle's representatives the limits of its joint allow."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, pi, remainder, tau

from kinematics.model import ArmModel
from kinematics.pose import Vector
from kinematics.solution import Six, six


class Turns:
    """The joint limits of an arm, for angles that are defined up to turns of 2 pi.

    A joint that round-off has brought beyond its limit is put on it: by 1e-10 rad at most, and less for an arm whose
    reach makes more of it than 1e-10 m.
    """

    def __init__(self, model: ArmModel) -> None:
        self.limits = tuple((limit.lower, limit.upper) for limit in model.limits)
        self._triples = {0: self.limits[:3], 3: self.limits[3:]}
        x, y, z = model.tool.position
        reach = sum(abs(row.a) + abs(row.d) for row in model.rows) + abs(x) + abs(y) + abs(z)
        self._slack = 1e-10 / max(1.0, reach)

    def into_limits(self, joint: int, one: float, two: float, three: float) -> tuple[Vector, tuple[int, ...]]:
        """Angles of `joint` (from 0) and the two after it, each brought into its limits by a turn, else into (-pi, pi].

        Second come the joints for which no turn does.
        """
        (l1, u1), (l2, u2), (l3, u3) = self._triples[joint]
        q1, q2, q3 = remainder(one, tau), remainder(two, tau), remainder(three, tau)
        outside: tuple[int, ...] = ()
        if not l1 <= q1 <= u1:
            q1, outside = self._turned(q1, joint, outside)
        if not l2 <= q2 <= u2:
            q2, outside = self._turned(q2, joint + 1, outside)
        if not l3 <= q3 <= u3:
            q3, outside = self._turned(q3, joint + 2, outside)
        return (q1, q2, q3), outside

    def allow(self, q: Six) -> bool:
        """Whether every joint is inside its limits."""
        return all(lower <= angle <= upper for angle, (lower, upper) in zip(q, self.limits, strict=True))

    def nearest_six(self, q: Six, near: Sequence[float]) -> Six:
        """Of each angle and its turns the nearest to `near` inside the limits; one that no turn brings there stays."""
        return six(
            angle if lower <= angle <= upper else self._brought(angle, lower, upper)
            for angle, (lower, upper) in zip(map(nearest_turn, q, near), self.limits, strict=True)
        )

    def _turned(self, angle: float, joint: int, outside: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
        """An angle of [-pi, pi] that is outside its limits, in a turn that is not, or noted in `outside`."""
        lower, upper = self.limits[joint]
        allowed = self._brought(angle, lower, upper)
        if lower <= allowed <= upper:
            return allowed, outside
        return (pi if angle == -pi else angle), (*outside, joint)

    def _brought(self, angle: float, lower: float, upper: float) -> float:
        """An angle that is outside, in the first turn that does not exceed the limit it did, if that is inside."""
        slack = self._slack
        if angle > upper:
            turned = angle - tau * ceil((angle - upper - slack) / tau)
        else:
            turned = angle + tau * ceil((lower - angle - slack) / tau)
        return min(max(turned, lower), upper) if lower - slack <= turned <= upper + slack else angle


def nearest_turn(angle: float, near: float) -> float:
    """The turn of an angle (rad) that is nearest to another."""
    return near + remainder(angle - near, tau)
