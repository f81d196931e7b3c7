"""What an arm is: six rows of modified Denavit-Hartenberg parameters, joint limits, link masses, a tool."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from kinematics.pose import IDENTITY, Pose, Vector, orthonormality_error, require_finite

JOINTS = 6

# Sines and cosines below this are zero: the cosine of pi / 2 is 6e-17 in doubles and was meant to be none.
ROUND_OFF = 1e-15


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
    """The closed interval that a joint may move in, rad, and its largest speed, rad/s (infinite: not known).

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
            raise ValueError(f"velocity is {self.velocity}: a positive number is needed")


@dataclass(frozen=True)
class LinkMass:
    """Mass (kg) and centre of mass (m, in frame i, which moves with joint i) of link i; ValueError for bad numbers."""

    mass: float
    centre: Vector

    def __post_init__(self) -> None:
        if len(self.centre) != 3:
            raise ValueError(f"centre has {len(self.centre)} numbers: 3 are needed")
        require_finite((self.mass, *self.centre), ("mass", "centre x", "centre y", "centre z"))
        if self.mass < 0.0:
            raise ValueError(f"mass is {self.mass}: it cannot be negative")


@dataclass(frozen=True)
class ArmModel:
    """A six-joint arm, base to tool.

    `rows` and `limits` have six entries; `links` six, or none when the masses are not known; `tool` is the transform
    from frame 6 (the flange) to the tool. Raises ValueError naming what is wrong: a wrong count, a number that is not
    finite, a tool whose rotation is none, a joint name that is empty or given twice.
    """

    name: str
    rows: tuple[DhRow, ...]
    limits: tuple[JointLimit, ...]
    links: tuple[LinkMass, ...] = ()
    tool: Pose = IDENTITY
    joint_names: tuple[str, ...] = tuple(f"joint{number}" for number in range(1, JOINTS + 1))

    def __post_init__(self) -> None:
        for what in ("rows", "limits", "joint_names"):
            count = len(getattr(self, what))
            if count != JOINTS:
                raise ValueError(f"{what} has {count} entries: {JOINTS} are needed")
        if len(self.links) not in (0, JOINTS):
            raise ValueError(f"links has {len(self.links)} entries: {JOINTS} are needed, or none")
        if not all(self.joint_names) or len(set(self.joint_names)) != JOINTS:
            raise ValueError(f"joint_names {self.joint_names} must be {JOINTS} different names")
        self.tool.require_finite()
        error = orthonormality_error(self.tool.rotation)
        if error > 1e-9:
            raise ValueError(f"the tool's rotation is none: R R^T differs from 1 by {error:.3g}")

    @cached_property
    def constants(self) -> tuple[tuple[float, float, float, float, float], ...]:
        """(sin alpha, cos alpha, a, d, offset) of each row: what forward kinematics multiplies with."""
        return tuple((*turn(row.alpha), row.a, row.d, row.offset) for row in self.rows)


def turn(angle: float) -> tuple[float, float]:
    """Sine and cosine of an angle of the table (rad); quarter turns give exact zeros and ones."""
    sine, cosine = math.sin(angle), math.cos(angle)
    if abs(sine) < ROUND_OFF:
        return 0.0, math.copysign(1.0, cosine)
    if abs(cosine) < ROUND_OFF:
        return math.copysign(1.0, sine), 0.0
    return sine, cosine
