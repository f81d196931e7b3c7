"""The limits of an arm as they are now: read by modes and guards every cycle, changed as one transaction."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import hypot, inf, isfinite
from typing import Final, NamedTuple, TypeAlias

from rtcp.config import model
from rtcp.config.model import MOST_AXES, MOST_CONES, SUPERVISION, ArmConfig
from rtcp.ipc.refusals import ImpossibleLimit, LimitsExcludeJoint, LimitWidened, Refusal
from rtcp.ipc.schema import FIRST_CONE
from rtcp.motion.planning.plan import COLUMNS

LEAST_PART: Final = 1e-3
"""Of a configured speed, acceleration, jerk or torque: less of it is no limit, but an arm that does not move."""

Corners: TypeAlias = tuple[float, float, float, float, float, float]
"""A box along the base's axes, m: x, y, z of its lower corner, then of its upper one."""


LEAST_ANGLE: Final = 0.05
"""Least angle of a cone, rad."""


class Cone(NamedTuple):
    """An axis of the tool (0 to 2: x, y, z) stays within `angle`, rad, of the unit vector (x, y, z) of the base."""

    axis: int
    x: float
    y: float
    z: float
    angle: float


@dataclass(frozen=True)
class Values:
    """One set of limits: rad, rad/s, rad/s^2, rad/s^3, Nm, one number a joint; m for the boxes, rad for the cones."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]
    torque: tuple[float, ...]
    box: Corners | None = None
    keep_out: tuple[Corners, ...] = ()
    cones: tuple[Cone, ...] = ()
    supervision: tuple[float, float, float] = (1.5, 1.01, 0.15)
    """Thresholds of measured values: multiples of `velocity` and of `torque`, and the following error, rad."""

    @classmethod
    def configured(cls, config: ArmConfig) -> Values:
        """Return the limits of a configuration."""
        joints, cartesian, supervision = config.joints, config.cartesian, config.supervision
        return cls(
            low=tuple(joint.position.min for joint in joints),
            high=tuple(joint.position.max for joint in joints),
            velocity=tuple(joint.velocity for joint in joints),
            acceleration=tuple(joint.acceleration for joint in joints),
            jerk=tuple(joint.jerk for joint in joints),
            torque=tuple(joint.torque for joint in joints),
            box=None if cartesian.box is None else corners(cartesian.box.min, cartesian.box.max),
            keep_out=tuple(corners(box.min, box.max) for box in cartesian.keep_out),
            cones=tuple(_cone(cone) for cone in cartesian.cones),
            supervision=(supervision.speed, supervision.torque, supervision.following_error),
        )

    @classmethod
    def absolute(cls, config: ArmConfig) -> Values:
        """Return how far the limits of a configuration may be widened while the platform runs."""
        joints, supervision = config.joints, config.supervision
        ranges = [joint.absolute.position or joint.position for joint in joints]
        wide = supervision.absolute
        return replace(
            cls.configured(config),
            low=tuple(position.min for position in ranges),
            high=tuple(position.max for position in ranges),
            velocity=tuple(joint.absolute.velocity or joint.velocity for joint in joints),
            torque=tuple(joint.absolute.torque or joint.torque for joint in joints),
            supervision=(
                wide.speed or supervision.speed,
                wide.torque or supervision.torque,
                wide.following_error or supervision.following_error,
            ),
        )

    def or_wider(self, other: Values) -> Values:
        """Return these limits, and in their place those of `other` that `absolute` can widen and that are wider."""
        return replace(
            self,
            low=tuple(map(min, self.low, other.low)),
            high=tuple(map(max, self.high, other.high)),
            velocity=tuple(map(max, self.velocity, other.velocity)),
            torque=tuple(map(max, self.torque, other.torque)),
            supervision=_three(map(max, self.supervision, other.supervision)),
        )


def corners(low: tuple[float, ...], high: tuple[float, ...]) -> Corners:
    """Return a box as six numbers."""
    (a, b, c), (d, e, f) = low, high
    return a, b, c, d, e, f


def _three(numbers: Iterable[float]) -> tuple[float, float, float]:
    a, b, c = numbers
    return a, b, c


def _cone(config: model.Cone) -> Cone:
    x, y, z = config.direction
    length = hypot(x, y, z)
    return Cone("xyz".index(config.axis), x / length, y / length, z / length, config.angle)


WIDENABLE: Final = frozenset({"low", "high", "velocity", "torque", *SUPERVISION})
"""Names of the limits that a key `absolute` can widen: fields of `Values` and thresholds."""
_LEAST_SUPERVISION: Final = (1.0, 1.0, 1e-3)
"""Least value of each threshold: nothing below the limits themselves counts as beyond them."""
FIELDS: Final = ("low", "high", "velocity", "acceleration", "jerk", "torque")
"""Fields of `Values` with a number a joint."""
_CORNERS: Final = ("min.x", "min.y", "min.z", "max.x", "max.y", "max.z")


@dataclass(frozen=True)
class WrongLimit:
    """A refused limit: not finite, outside its allowed range, or a lower end that is not below the upper one."""

    axis: int
    """Number of the joint, from 0; -1: a box or a cone; -2: a threshold of the supervision."""
    box: int
    """Number of a keep-out box; -1: the box that the tool stays in; `FIRST_CONE` and more: a cone."""
    name: str
    """Field of `Values`, `min.x` to `max.z` of a box, `angle` of a cone, or one of `SUPERVISION`."""
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
        if isfinite(self.found) and (self.name in _CORNERS or below == (self.name == "low")):
            return LimitWidened(self.axis, self.found, bound)
        return ImpossibleLimit(self.axis, self.found, bound)


def wrong_limits(widest: Values, new: Values) -> Iterator[WrongLimit]:
    """Yield every number of `new` that cannot come into force where `widest` is allowed, of as many parts."""
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
    for name, found, least, most in zip(
        SUPERVISION, new.supervision, _LEAST_SUPERVISION, widest.supervision, strict=True
    ):
        if not least <= found <= most:
            yield WrongLimit(-2, -1, name, found, least, most)
    for number, (cone, wider) in enumerate(zip(new.cones, widest.cones, strict=True), FIRST_CONE):
        if not LEAST_ANGLE <= cone.angle <= wider.angle:
            yield WrongLimit(-1, number, "angle", cone.angle, LEAST_ANGLE, wider.angle)


def rows(values: Values) -> list[list[float]]:
    """Return limits as rows of the plan area, numbers in front, for `read`.

    Row 0: number of joints, 1 or 0 for a box or none, number of keep-out boxes, number of cones, then the thresholds
    of the supervision. Then a row a joint: low, high, velocity, acceleration, jerk, torque. Then the corners of each
    box, the one that the tool stays in first. Then the axis, the direction and the angle of each cone.
    """
    boxes = (*(() if values.box is None else (values.box,)), *values.keep_out)
    numbers = (values.low, values.high, values.velocity, values.acceleration, values.jerk, values.torque)
    head = [float(len(values.low)), float(values.box is not None), float(len(values.keep_out))]
    head += [float(len(values.cones)), *values.supervision]
    joints = [list(joint) for joint in zip(*numbers, strict=True)]
    return [head, *joints, *(list(box) for box in boxes), *([float(x) for x in cone] for cone in values.cones)]


def read(plan: memoryview[float], count: int) -> Values | None:
    """Return the limits in `count` rows of the plan area, whatever their numbers; None where the rows do not fit.

    Args:
        plan: doubles, `COLUMNS` a row.
        count: rows that were written.
    """
    if not 0 < count <= len(plan) // COLUMNS:
        return None
    n, with_box, boxes, cones = plan[0], plan[1], plan[2], plan[3]
    if n not in range(1, MOST_AXES + 1) or with_box not in (0.0, 1.0) or cones not in range(MOST_CONES + 1):
        return None
    if boxes not in range(count) or count != 1 + n + with_box + boxes + cones:
        return None
    first, last = int(n), count - 1 - int(cones)
    rows = [[plan[at * COLUMNS + column] for column in range(6)] for at in range(1, count)]
    joints = rows[:first]
    found: list[Corners] = []
    for a, b, c, d, e, f in rows[first:last]:
        found.append((a, b, c, d, e, f))
    oriented = []
    for axis, x, y, z, angle, _ in rows[last:]:
        if axis not in (0.0, 1.0, 2.0):
            return None
        oriented.append(Cone(int(axis), x, y, z, angle))
    low, high, velocity, acceleration, jerk, torque = zip(*joints, strict=True)
    box = found.pop(0) if with_box else None
    return Values(
        low, high, velocity, acceleration, jerk, torque, box, tuple(found), tuple(oriented), (plan[4], plan[5], plan[6])
    )


class Limits:
    """The limits in force. The lists are changed in place, so that a reference to one stays valid.

    Args:
        config: the arm; its limits are the widest allowed ones, but for a change that widens on purpose.
    """

    def __init__(self, config: ArmConfig) -> None:
        self.widest = Values.configured(config)
        self.absolute = Values.absolute(config)
        self.low = list(self.widest.low)
        self.high = list(self.widest.high)
        self.velocity = list(self.widest.velocity)
        self.acceleration = list(self.widest.acceleration)
        self.jerk = list(self.widest.jerk)
        self.torque = list(self.widest.torque)
        self.box = self.widest.box
        self.keep_out = self.widest.keep_out
        self.cones = self.widest.cones
        self.supervision = self.widest.supervision

    def apply(self, new: Values) -> None:
        """Put `new` into force; `check` comes before it."""
        self.low[:], self.high[:] = new.low, new.high
        self.velocity[:], self.acceleration[:] = new.velocity, new.acceleration
        self.jerk[:], self.torque[:] = new.jerk, new.torque
        self.box, self.keep_out, self.cones = new.box, new.keep_out, new.cones
        self.supervision = new.supervision

    @property
    def now(self) -> Values:
        """The limits in force."""
        joints = {name: tuple(getattr(self, name)) for name in FIELDS}
        return Values(**joints, box=self.box, keep_out=self.keep_out, cones=self.cones, supervision=self.supervision)

    def allowed(self, *, widen: bool) -> Values:
        """Return the widest limits of a change; one that does not widen may keep what an earlier one has widened."""
        return self.absolute if widen else self.widest.or_wider(self.now)

    def check(
        self, new: Values, position: list[float], velocity: list[float], *, widen: bool = False
    ) -> Refusal | None:
        """Return why `new` cannot come into force for an arm at `position` (rad) with `velocity` (rad/s), or None.

        Boxes and cones are compared with those of the configuration only (see also `TrajectoryGuard.refusal_of`).
        """
        widest = self.widest
        for given, count in (
            (len(new.low), len(widest.low)),
            (len(new.keep_out), len(widest.keep_out)),
            (len(new.cones), len(widest.cones)),
        ):
            if given != count:
                return ImpossibleLimit(-1, float(given), float(count))
        for cone, wider in zip(new.cones, widest.cones, strict=True):
            if cone != wider._replace(angle=cone.angle):
                return ImpossibleLimit(-1, cone.angle, wider.angle)
        if widest.box is not None and new.box is None:
            return LimitWidened(-1, 0.0, 0.0)
        for wrong in wrong_limits(self.allowed(widen=widen), new):
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
