"""The limits of an arm as they are now: read by modes and guards every cycle, changed as one transaction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isfinite
from typing import Final, TypeAlias

from rtcp.config.model import MOST_AXES, ArmConfig
from rtcp.ipc.refusals import ImpossibleLimit, LimitsExcludeJoint, LimitWidened, Refusal
from rtcp.motion.planning.plan import COLUMNS

LEAST_PART: Final = 1e-3
"""Of a configured speed, acceleration, jerk or torque: less of it is no limit, but an arm that does not move."""

Corners: TypeAlias = tuple[float, float, float, float, float, float]
"""A box along the base's axes, m: x, y, z of its lower corner, then of its upper one."""


@dataclass(frozen=True)
class Values:
    """One set of limits: rad, rad/s, rad/s^2, rad/s^3, Nm, one number a joint; m for the boxes."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]
    torque: tuple[float, ...]
    box: Corners | None = None
    keep_out: tuple[Corners, ...] = ()

    @classmethod
    def configured(cls, config: ArmConfig) -> Values:
        """Return the limits of a configuration."""
        joints, cartesian = config.joints, config.cartesian
        return cls(
            low=tuple(joint.position.min for joint in joints),
            high=tuple(joint.position.max for joint in joints),
            velocity=tuple(joint.velocity for joint in joints),
            acceleration=tuple(joint.acceleration for joint in joints),
            jerk=tuple(joint.jerk for joint in joints),
            torque=tuple(joint.torque for joint in joints),
            box=None if cartesian.box is None else corners(cartesian.box.min, cartesian.box.max),
            keep_out=tuple(corners(box.min, box.max) for box in cartesian.keep_out),
        )


def corners(low: tuple[float, ...], high: tuple[float, ...]) -> Corners:
    """Return a box as six numbers."""
    (a, b, c), (d, e, f) = low, high
    return a, b, c, d, e, f


FIELDS: Final = ("low", "high", "velocity", "acceleration", "jerk", "torque")
"""Fields of `Values` with a number a joint."""
_CORNERS: Final = ("min.x", "min.y", "min.z", "max.x", "max.y", "max.z")


@dataclass(frozen=True)
class WrongLimit:
    """A refused limit: not finite, outside its allowed range, or a lower end that is not below the upper one."""

    axis: int
    """Number of the joint, from 0; -1: a box."""
    box: int
    """Number of a keep-out box; -1: the box that the tool stays in."""
    name: str
    """Field of `Values`, or `min.x` to `max.z` of a box."""
    found: float
    low: float
    high: float
    """Allowed is from low to high; where there is no room: less than high, the other end."""
    no_room: bool = False

    @property
    def refusal(self) -> Refusal:
        """The refusal of the loop."""
        if self.no_room:
            return ImpossibleLimit(self.axis, self.high, self.found)
        below = self.found < self.low
        bound = self.low if below else self.high
        if isfinite(self.found) and (self.axis < 0 or below == (self.name == "low")):
            return LimitWidened(self.axis, self.found, bound)
        return ImpossibleLimit(self.axis, self.found, bound)


def wrong_limits(widest: Values, new: Values) -> Iterator[WrongLimit]:
    """Yield every number of `new` that cannot come into force for an arm configured as `widest`, of as many parts."""
    for axis, (lower, upper) in enumerate(zip(new.low, new.high, strict=True)):
        low, high = widest.low[axis], widest.high[axis]
        for name in FIELDS:
            found, most = getattr(new, name)[axis], getattr(widest, name)[axis]
            ends = (low, high) if name in ("low", "high") else (LEAST_PART * most, most)
            if not ends[0] <= found <= ends[1]:
                yield WrongLimit(axis, -1, name, found, *ends)
        if low <= upper <= lower <= high:
            yield WrongLimit(axis, -1, "low", lower, low, upper, no_room=True)
    for box, (now, bounds) in enumerate(zip((new.box, *new.keep_out), (widest.box, *widest.keep_out), strict=True), -1):
        for at, found in enumerate(now or ()):
            bound = None if bounds is None else bounds[at]
            inward = (at < 3) is (box < 0)
            least, most = -inf if bound is None or not inward else bound, inf if bound is None or inward else bound
            if not (isfinite(found) and least <= found <= most):
                yield WrongLimit(-1, box, _CORNERS[at], found, least, most)
            elif now is not None and at < 3 and not found < now[at + 3]:
                yield WrongLimit(-1, box, _CORNERS[at], found, -inf, now[at + 3], no_room=True)


def rows(values: Values) -> list[list[float]]:
    """Return limits as rows of the plan area, numbers in front, for `read`.

    Row 0: number of joints, 1 or 0 for a box or none, number of keep-out boxes. Then a row a joint: low, high,
    velocity, acceleration, jerk, torque. Then the corners of each box, the one that the tool stays in first.
    """
    boxes = (*(() if values.box is None else (values.box,)), *values.keep_out)
    numbers = (values.low, values.high, values.velocity, values.acceleration, values.jerk, values.torque)
    head = [float(len(values.low)), float(values.box is not None), float(len(values.keep_out))]
    return [head, *(list(joint) for joint in zip(*numbers, strict=True)), *(list(box) for box in boxes)]


def read(plan: memoryview[float], count: int) -> Values | None:
    """Return the limits in `count` rows of the plan area, whatever their numbers; None where the rows do not fit.

    Args:
        plan: doubles, `COLUMNS` a row.
        count: rows that were written.
    """
    if not 0 < count <= len(plan) // COLUMNS:
        return None
    n, with_box, boxes = plan[0], plan[1], plan[2]
    if n not in range(1, MOST_AXES + 1) or with_box not in (0.0, 1.0) or count != 1 + n + with_box + boxes:
        return None
    first = 1 + int(n)
    rows = [[plan[at * COLUMNS + column] for column in range(6)] for at in range(1, count)]
    joints = rows[: first - 1]
    found: list[Corners] = []
    for a, b, c, d, e, f in rows[first - 1 :]:
        found.append((a, b, c, d, e, f))
    low, high, velocity, acceleration, jerk, torque = zip(*joints, strict=True)
    box = found.pop(0) if with_box else None
    return Values(low, high, velocity, acceleration, jerk, torque, box, tuple(found))


class Limits:
    """The limits in force. The lists are changed in place, so that a reference to one stays valid.

    Args:
        config: the arm; its limits are the widest allowed ones.
    """

    def __init__(self, config: ArmConfig) -> None:
        self.widest = Values.configured(config)
        self.low = list(self.widest.low)
        self.high = list(self.widest.high)
        self.velocity = list(self.widest.velocity)
        self.acceleration = list(self.widest.acceleration)
        self.jerk = list(self.widest.jerk)
        self.torque = list(self.widest.torque)
        self.box = self.widest.box
        self.keep_out = self.widest.keep_out

    def apply(self, new: Values) -> None:
        """Put `new` into force; `check` comes before it."""
        self.low[:], self.high[:] = new.low, new.high
        self.velocity[:], self.acceleration[:] = new.velocity, new.acceleration
        self.jerk[:], self.torque[:] = new.jerk, new.torque
        self.box, self.keep_out = new.box, new.keep_out

    def check(self, new: Values, position: list[float], velocity: list[float]) -> Refusal | None:
        """Return why `new` cannot come into force for an arm at `position` (rad) with `velocity` (rad/s), or None.

        The boxes are compared with those of the configuration only, not with the arm (`TrajectoryGuard.refusal_of`).
        """
        widest = self.widest
        for given, count in ((len(new.low), len(widest.low)), (len(new.keep_out), len(widest.keep_out))):
            if given != count:
                return ImpossibleLimit(-1, float(given), float(count))
        if widest.box is not None and new.box is None:
            return LimitWidened(-1, 0.0, 0.0)
        for wrong in wrong_limits(widest, new):
            return wrong.refusal
        for axis, (q, v) in enumerate(zip(position, velocity, strict=True)):
            refused = self._excluded(new, axis, q, v)
            if refused is not None:
                return refused
        return None

    def _excluded(self, new: Values, axis: int, q: float, v: float) -> Refusal | None:
        low, high = new.low[axis], new.high[axis]
        rest = q + 0.5 * v * abs(v) / new.acceleration[axis]
        if abs(v) > new.velocity[axis] < self.velocity[axis]:
            return ImpossibleLimit(axis, new.velocity[axis], abs(v))
        # What is not narrowed needs no room: the guards see to it, to a rounding.
        if low <= self.low[axis] and high >= self.high[axis] and new.acceleration[axis] >= self.acceleration[axis]:
            return None
        if not low <= min(q, rest) <= max(q, rest) <= high:
            return LimitsExcludeJoint(axis, rest, high if rest > high or q > high else low)
        return None
