"""What a motion is described by: timed joint points, or the ends of straight lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, MaxLen, MinLen

from rtcp.config.geometry import Angle

Numbers = Annotated[tuple[Angle, ...], MinLen(1), MaxLen(6)]
Coordinates = Annotated[tuple[Angle, ...], MinLen(6), MaxLen(6)]


@dataclass(frozen=True)
class Point:
    """A point of a trajectory: time, s, and position, rad; velocity, rad/s, and acceleration, rad/s^2, if given."""

    t: Annotated[float, Ge(0)]
    q: Numbers
    v: Numbers | None = None
    a: Numbers | None = None


@dataclass(frozen=True)
class Stop:
    """The end of a straight line: a pose (x, y, z, rx, ry, rz; m and rad) or the joints that have it; speed, m/s.

    `speed` None: that of the whole path.
    """

    pose: Coordinates | None = None
    q: Coordinates | None = None
    speed: Annotated[float, Gt(0)] | None = None
