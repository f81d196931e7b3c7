"""What inverse kinematics answers with: solutions with their branch, and reasons where there are none."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Literal, NamedTuple, TypeAlias

Six: TypeAlias = tuple[float, float, float, float, float, float]


def six(values: Iterable[float]) -> Six:
    """Six numbers as the tuple that they are."""
    q1, q2, q3, q4, q5, q6 = values
    return q1, q2, q3, q4, q5, q6


class Branch(NamedTuple):
    """Which of the up to eight solutions one is. Each word changes only at the singularity of the same name.

    shoulder: "front" where the wrist centre has x >= 0 in frame 1, "back" where x < 0.
    elbow: "up" where cos(alpha_2) det J >= 0, else "down"; J is the derivative of the wrist centre by joints 1 to 3.
        With axes 2 and 3 parallel this is the side of the line from axis 2 to the wrist centre that the elbow lies on,
        seen with x of frame 1 to the right and z up: "up" is to the left of it for a front solution and to the right
        for a back one, which is above it unless the wrist centre is between the axes 1 and 2.
    wrist: "no-flip" where sin(q5 + offset) >= 0, "flip" where it is negative.

    Where axes 2 and 3 are not parallel two solutions may bear the same name, and "front" may become "back" without a
    singularity: there the words are no more than the signs above.
    """

    shoulder: Literal["front", "back"]
    elbow: Literal["up", "down"]
    wrist: Literal["no-flip", "flip"]

    def __str__(self) -> str:
        return "/".join(self)


class Singularity(enum.Flag):
    """At which singularities a solution is, to round-off.

    SHOULDER: the wrist centre is on axis 1, so that joint 1 is free; with a lateral offset, as near to it as it comes.
    ELBOW: the arm is stretched or folded; with axes 2 and 3 not parallel, joints 1 to 3 lose a direction.
    WRIST: axes 4 and 6 are in one line, so that joint 4 is free; in an oblique wrist, axes 4 to 6 are in one plane.
    """

    NONE = 0
    SHOULDER = 1
    ELBOW = 2
    WRIST = 4


class Solution(NamedTuple):
    """One configuration that reaches the pose.

    q: rad, each joint in the turn of 2 pi that its limits allow, else in (-pi, pi]. branch: None for an arm without a
    spherical wrist, whose solutions have no names. outside: the joints, counted from 0, outside their limits.
    """

    q: Six
    branch: Branch | None
    within_limits: bool
    outside: tuple[int, ...]
    singularity: Singularity


class Solutions(NamedTuple):
    """All solutions of a pose; `reason` says in a sentence why there are none, and is None where there are."""

    solutions: tuple[Solution, ...]
    reason: str | None


class Near(NamedTuple):
    """The solution that continues a motion, or why there is none.

    q: rad, inside the limits, or None. reason: a sentence, empty where q was found. out_of_reach: m from the wanted
    wrist centre to the nearest point that it can be brought to, 0 where it is in reach. limited: the joint, counted
    from 0, whose limit is in the way, else -1.
    """

    q: Six | None
    reason: str
    singularity: Singularity
    out_of_reach: float
    limited: int


# Between the solvers of this package: bits for branches and singularities, since enums cost more than the arithmetic,
# and plain tuples.
BACK, DOWN, FLIP = 1, 2, 4
SHOULDER, ELBOW, WRIST = 1, 2, 4
BRANCHES = tuple(
    Branch("back" if bits & BACK else "front", "down" if bits & DOWN else "up", "flip" if bits & FLIP else "no-flip")
    for bits in range(8)
)
SINGULARITIES = tuple(Singularity(bits) for bits in range(8))

# Three angles theta = q + offset (rad), of joints 1 to 3 or 4 to 6; bits of the branch; bits of the singularity.
Angles: TypeAlias = tuple[float, float, float, int, int]

# m. Nearer to an edge of the workspace than ON_EDGE is on it: there the round-off of the pose decides. A wrist centre
# that is beyond it by less than SLACK is brought back; one that is nearer than that to an axis leaves its joint free.
ON_EDGE = 1e-14
SLACK = 1e-10

# The square (m^2) of what the wrist centre of a solution may be beside the wanted one.
CONFIRMED = (5e-10) ** 2
