"""Results of inverse kinematics: solutions with their branch and singularities, and angles wrapped into the limits."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence
from math import ceil, pi, remainder, tau
from typing import Final, Literal, NamedTuple, TypeAlias

from kinematics.model import ArmModel
from kinematics.pose import Vector

Six: TypeAlias = tuple[float, float, float, float, float, float]


def six(values: Iterable[float]) -> Six:
    """Six numbers as a tuple; raises ValueError for another count."""
    q1, q2, q3, q4, q5, q6 = values
    return q1, q2, q3, q4, q5, q6


class Branch(NamedTuple):
    """Name of one of the up to eight solutions of a pose. Each word changes only at the singularity of the same name.

    shoulder: "front" where the wrist centre has x >= 0 in frame 1, "back" where x < 0.
    elbow: "up" where cos(alpha_2) det J >= 0, else "down"; J is the derivative of the wrist centre by joints 1 to 3.
        With axes 2 and 3 parallel this is the side of the line from axis 2 to the wrist centre on which the elbow lies,
        seen with x of frame 1 to the right and z up: "up" is to the left of it for a front solution and to the right
        for a back one. That is above the line unless the wrist centre is between axes 1 and 2.
    wrist: "no-flip" where sin(q5 + offset) >= 0, "flip" where it is negative.

    Where axes 2 and 3 are not parallel two solutions may have the same name, and "front" may become "back" without a
    singularity: there the words state the signs above and nothing else.
    """

    shoulder: Literal["front", "back"]
    elbow: Literal["up", "down"]
    wrist: Literal["no-flip", "flip"]

    def __str__(self) -> str:
        return "/".join(self)


class Singularity(enum.Flag):
    """The singularities that a solution is on, to round-off.

    SHOULDER: the wrist centre is on axis 1, so that joint 1 is free; with a lateral offset, as near to it as possible.
    ELBOW: the arm is stretched or folded; with axes 2 and 3 not parallel, joints 1 to 3 lose a direction.
    WRIST: axes 4 and 6 are in one line, so that joint 4 is free; in an oblique wrist, axes 4 to 6 are in one plane.
    """

    NONE = 0
    SHOULDER = 1
    ELBOW = 2
    WRIST = 4


class Solution(NamedTuple):
    """One configuration that reaches the pose.

    q: six angles, rad, each inside its limits if a multiple of 2 pi brings it there, else in (-pi, pi]. branch: None
    for an arm without a spherical wrist. outside: the joints, counted from 0, outside their limits.
    """

    q: Six
    branch: Branch | None
    within_limits: bool
    outside: tuple[int, ...]
    singularity: Singularity


class Solutions(NamedTuple):
    """All solutions of a pose; `reason` is a sentence when there are none, else None."""

    solutions: tuple[Solution, ...]
    reason: str | None


class Near(NamedTuple):
    """The solution that continues a motion, or why there is none.

    q: six angles, rad, inside the limits; None: no solution. reason: why there is none, a sentence; empty when there is
    one. out_of_reach: distance, m, from the wanted wrist centre to the nearest point within reach; 0: within reach.
    limited: the joint, counted from 0, whose limit prevents a solution, else -1.
    """

    q: Six | None
    reason: str
    singularity: Singularity
    out_of_reach: float
    limited: int


# The solvers exchange branches and singularities as bits and plain tuples: enums cost more than the arithmetic.
BACK, DOWN, FLIP = 1, 2, 4
SHOULDER, ELBOW, WRIST = 1, 2, 4
BRANCHES = tuple(
    Branch("back" if bits & BACK else "front", "down" if bits & DOWN else "up", "flip" if bits & FLIP else "no-flip")
    for bits in range(8)
)
SINGULARITIES = tuple(Singularity(bits) for bits in range(8))

# Three angles theta = q + offset (rad), of joints 1 to 3 or 4 to 6; bits of the branch; bits of the singularity.
Angles: TypeAlias = tuple[float, float, float, int, int]

# m. A wrist centre nearer to an edge of the workspace than ON_EDGE is on it: the round-off of the pose decides. One
# that is beyond it by less than SLACK is moved onto it; one nearer than SLACK to an axis leaves that joint free.
ON_EDGE: Final = 1e-14
SLACK: Final = 1e-10

CONFIRMED = (5e-10) ** 2  # m^2: largest squared error of the wrist centre of a solution


class AngleWrap:
    """Brings angles, which are defined up to multiples of 2 pi, into the joint limits of an arm.

    A joint that round-off has moved beyond its limit is set to the limit: by 1e-10 rad at most, and by less if the
    reach of the arm exceeds 1 m, so that the tool moves by 1e-10 m at most.
    """

    def __init__(self, model: ArmModel) -> None:
        self.limits = tuple((limit.lower, limit.upper) for limit in model.limits)
        self._triples = {0: self.limits[:3], 3: self.limits[3:]}
        x, y, z = model.tool.position
        reach = sum(abs(row.a) + abs(row.d) for row in model.rows) + abs(x) + abs(y) + abs(z)
        self.slack = 1e-10 / max(1.0, reach)

    def into_limits(self, joint: int, one: float, two: float, three: float) -> tuple[Vector, tuple[int, ...]]:
        """Wrap three angles, rad, of `joint` (0 or 3) and the two after it, into their limits, else into (-pi, pi].

        Also return the joints, counted from 0, that are outside their limits.
        """
        (l1, u1), (l2, u2), (l3, u3) = self._triples[joint]
        q1, q2, q3 = remainder(one, tau), remainder(two, tau), remainder(three, tau)
        outside: tuple[int, ...] = ()
        if not l1 <= q1 <= u1:
            q1, outside = self._wrap(q1, joint, outside)
        if not l2 <= q2 <= u2:
            q2, outside = self._wrap(q2, joint + 1, outside)
        if not l3 <= q3 <= u3:
            q3, outside = self._wrap(q3, joint + 2, outside)
        return (q1, q2, q3), outside

    def allow(self, q: Six) -> bool:
        """Whether every joint is inside its limits."""
        return all(lower <= angle <= upper for angle, (lower, upper) in zip(q, self.limits, strict=True))

    def nearest(self, q: Six, near: Sequence[float]) -> Six:
        """Wrap each angle (rad) to the value nearest to `near` inside its limits, else to the nearest one outside."""
        return six(
            angle if lower <= angle <= upper else self._shifted(angle, lower, upper)
            for angle, (lower, upper) in zip(map(nearest_turn, q, near), self.limits, strict=True)
        )

    def _wrap(self, angle: float, joint: int, outside: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
        """An angle of [-pi, pi] outside its limits, shifted into them; otherwise its joint is added to `outside`."""
        lower, upper = self.limits[joint]
        allowed = self._shifted(angle, lower, upper)
        if lower <= allowed <= upper:
            return allowed, outside
        return (pi if angle == -pi else angle), (*outside, joint)

    def _shifted(self, angle: float, lower: float, upper: float) -> float:
        """An angle outside its limits, shifted inside by the fewest multiples of 2 pi, else unchanged."""
        slack = self.slack
        if angle > upper:
            shifted = angle - tau * ceil((angle - upper - slack) / tau)
        else:
            shifted = angle + tau * ceil((lower - angle - slack) / tau)
        return min(max(shifted, lower), upper) if lower - slack <= shifted <= upper + slack else angle


def nearest_turn(angle: float, near: float) -> float:
    """`angle` plus the multiple of 2 pi that brings it nearest to `near`, rad."""
    return near + remainder(angle - near, tau)
