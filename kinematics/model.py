"""The model of an arm: rows of modified Denavit-Hartenberg parameters, joint limits, link masses, a tool, bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from kinematics.pose import IDENTITY, Pose, Vector, orthonormality_error, require_finite

JOINTS: Final = 6

# Sines and cosines below this count as zero: the cosine of pi / 2 is 6e-17 in doubles.
_ROUND_OFF: Final = 1e-15


@dataclass(frozen=True)
class DhRow:
    """One row of modified (Craig) parameters: T(i-1, i) = Rx(alpha) Tx(a) Rz(q + offset) Tz(d).

    `alpha` (rad) and `a` (m) are alpha_{i-1} and a_{i-1}; `d` in m; `offset` in rad, theta_i = q_i + offset.
    Raises ValueError naming a parameter that is not finite. Source: Craig, Introduction to Robotics, section 3.4.
    """

    alpha: float
    a: float
    d: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        require_finite((self.alpha, self.a, self.d, self.offset), ("alpha", "a", "d", "offset"))


@dataclass(frozen=True)
class JointLimit:
    """Closed range of a joint, rad, and its speed limit, rad/s (infinite when unknown).

    Raises ValueError when a bound is not finite, lower is not below upper, or the speed is not positive.
    """

    lower: float
    upper: float
    velocity: float = math.inf

    def __post_init__(self) -> None:
        require_finite((self.lower, self.upper), ("lower", "upper"))
        if not self.lower < self.upper:
            raise ValueError(f"lower {self.lower} is not below upper {self.upper}")
        if not self.velocity > 0.0:
            raise ValueError(f"velocity is {self.velocity}; a positive number is required")


@dataclass(frozen=True)
class LinkMass:
    """Mass, kg, and centre of mass, m in the joint's frame, of a link.

    Raises ValueError for a centre of other than three numbers, a value that is not finite, and a negative mass.
    """

    mass: float
    centre: Vector

    def __post_init__(self) -> None:
        if len(self.centre) != 3:
            raise ValueError(f"centre has {len(self.centre)} numbers; 3 are required")
        require_finite((self.mass, *self.centre), ("mass", "centre x", "centre y", "centre z"))
        if self.mass < 0.0:
            raise ValueError(f"mass is {self.mass}; it must not be negative")


@dataclass(frozen=True)
class Capsule:
    """A body: all that is nearer than `radius` to the segment from `start` to `end`, m in the frame of its link.

    Link 0 is the base, link i moves with frame i. Raises ValueError for a link other than 0 to 6, a point that is not
    three finite numbers and a radius that is not positive and finite.
    """

    link: int
    start: Vector
    end: Vector
    radius: float

    def __post_init__(self) -> None:
        if not 0 <= self.link <= JOINTS:
            raise ValueError(f"link is {self.link}; 0 (the base) to {JOINTS} are allowed")
        for name in ("start", "end"):
            point = getattr(self, name)
            if len(point) != 3:
                raise ValueError(f"{name} has {len(point)} numbers; 3 are required")
            require_finite(point, (f"{name} x", f"{name} y", f"{name} z"))
        if not 0.0 < self.radius < math.inf:
            raise ValueError(f"radius is {self.radius}; a positive number is required")


@dataclass(frozen=True)
class ArmModel:
    """A six-joint arm, base to tool.

    rows, limits, joint_names: six entries each. links: six, or none when the masses are unknown; the last one includes
    the mass of the tool. tool: transform from frame 6 (the flange) to the tool. bodies: shape of the arm; empty:
    unknown. tool_bodies: shape of the tool; None: unknown, or part of `bodies` (`kinematics.capsules`).

    Raises ValueError for a wrong count, a tool pose that is not finite or whose rotation is not orthonormal, and joint
    names that are empty or repeated.
    """

    name: str
    rows: tuple[DhRow, ...]
    limits: tuple[JointLimit, ...]
    links: tuple[LinkMass, ...] = ()
    tool: Pose = IDENTITY
    joint_names: tuple[str, ...] = tuple(f"joint{number}" for number in range(1, JOINTS + 1))
    bodies: tuple[Capsule, ...] = ()
    tool_name: str = "tool"
    tool_bodies: tuple[Capsule, ...] | None = None

    def __post_init__(self) -> None:
        for field in ("rows", "limits", "joint_names"):
            count = len(getattr(self, field))
            if count != JOINTS:
                raise ValueError(f"{field} has {count} entries; {JOINTS} are required")
        if len(self.links) not in (0, JOINTS):
            raise ValueError(f"links has {len(self.links)} entries; {JOINTS} or none are required")
        if not all(self.joint_names) or len(set(self.joint_names)) != JOINTS:
            raise ValueError(f"joint_names {self.joint_names} must be {JOINTS} different names")
        self.tool.require_finite()
        error = orthonormality_error(self.tool.rotation)
        if error > 1e-9:
            raise ValueError(f"the tool's rotation is invalid: R R^T differs from 1 by {error:.3g}")

    @cached_property
    def constants(self) -> tuple[tuple[float, float, float, float, float], ...]:
        """(sin alpha, cos alpha, a, d, offset) of each row."""
        return tuple((*_sine_cosine(row.alpha), row.a, row.d, row.offset) for row in self.rows)


def _sine_cosine(angle: float) -> tuple[float, float]:
    """Sine and cosine of an angle (rad); multiples of pi / 2 give exact zeros and ones."""
    sine, cosine = math.sin(angle), math.cos(angle)
    if abs(sine) < _ROUND_OFF:
        return 0.0, math.copysign(1.0, cosine)
    if abs(cosine) < _ROUND_OFF:
        return math.copysign(1.0, sine), 0.0
    return sine, cosine
