"""Plans of trajectories: timed joint points, joined by polynomials whose extremes are all inside the limits."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, isfinite
from typing import TYPE_CHECKING, Final

from rtcp.config.model import MOST_AXES, MOST_POINTS, Point
from rtcp.motion.controllers.trajectory import AT_START_RAD, Approach
from rtcp.motion.planning.interpolation import (
    Coefficients,
    beyond,
    cubic,
    derivative,
    quintic,
    spline_accelerations,
    spline_velocities,
    value,
)
from rtcp.motion.planning.plan import CUBIC, LONGEST_S, QUINTIC, Plan, PlanRefused, PlanTooFast, ZoneAt

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

SHORTEST_S: Final = 1e-3
"""Least time between two points."""
ZONE_STEP_RAD: Final = 0.01
"""Largest joint motion between two checks of the zones."""
_ROUNDING: Final = 1e-9
_STILL: Final = 1e-9
_AT_ONCE_S: Final = 1e-12


def plan_trajectory(
    points: Sequence[Point],
    limits: Limits,
    q_now: Sequence[float],
    *,
    names: Sequence[str] = (),
    zone_at: ZoneAt | None = None,
    moving: bool = False,
) -> Plan:
    """Return the plan of a trajectory for `TrajectoryController`.

    Points with only positions are joined by quintics with the velocities and accelerations of the cubic spline through
    them; points with velocities by cubics; with accelerations by quintics. All points are of one kind. The plan starts
    at rest at `q_now` (a first point at time 0 must be there within `AT_START_RAD`; an approach leads to a later one)
    and ends at rest.

    Args:
        points: at least one, at most `MOST_POINTS`, times rising by `SHORTEST_S` at least.
        limits: position, velocity and acceleration of every joint, checked at the extremes of each polynomial.
        q_now: commanded position, rad, shape (n,).
        names: of the joints, for messages.
        zone_at: called every `ZONE_STEP_RAD` of joint motion.
        moving: the plan replaces a motion, which will have passed `q_now`: a first point at time 0 followed by others
            is dropped, and the loop plans the approach to the next.

    Raises:
        PlanRefused: with the point, the joint, the value and its limit.
    """
    joints = len(q_now)
    names = list(names) or [f"joint{i + 1}" for i in range(joints)]
    _check_points(points, names)
    if moving and len(points) > 1 and points[0].t <= _AT_ONCE_S:
        points = points[1:]
    waypoints = _waypoints(points, q_now)
    first, last = waypoints[0], waypoints[-1]
    _check_ends(first, last, len(points), q_now, names)
    for number, waypoint in enumerate(waypoints, 1):
        _check_waypoint(waypoint, f"point {number}", limits, names)
    if first.t > _AT_ONCE_S and not moving:
        _check_approach(first, limits, q_now, names, zone_at)
    for number, (before, after) in enumerate(pairwise(waypoints), 1):
        _check_piece(before, after, f"between points {number} and {number + 1}", limits, names, zone_at)
    return Plan(tuple(_row(waypoint) for waypoint in waypoints), last.t, 0.0, 1.0, last.q)


def _check_points(points: Sequence[Point], names: Sequence[str], first: int = 1) -> None:
    if not points:
        raise PlanRefused("the trajectory has no points, at least one is needed")
    if len(points) > MOST_POINTS:
        raise PlanRefused(f"the trajectory has {len(points)} points, at most {MOST_POINTS} are allowed")
    for at, point in enumerate(points):
        number = first + at
        if not isfinite(point.t) or not 0.0 <= point.t <= LONGEST_S:
            raise PlanRefused(f"point {number}: its time is {point.t} s, allowed is 0 to {LONGEST_S:g} s")
        if at and point.t < points[at - 1].t + SHORTEST_S * (1.0 - _ROUNDING):
            raise PlanRefused(
                f"point {number}: its time is {point.t:g} s after {points[at - 1].t:g} s, "
                f"times must rise by at least {SHORTEST_S:g} s"
            )
        for quantity, unit, numbers in (
            ("position", "rad", point.q),
            ("velocity", "rad/s", point.v),
            ("acceleration", "rad/s^2", point.a),
        ):
            if numbers is None:
                continue
            if len(numbers) != len(names):
                raise PlanRefused(
                    f"point {number}: it has {len(numbers)} numbers for the {quantity}, {len(names)} are needed"
                )
            for name, number_given in zip(names, numbers, strict=True):
                if not isfinite(number_given):
                    raise PlanRefused(
                        f"point {number}: the {quantity} of {name} is {number_given} {unit}, a number is needed"
                    )
        if (point.v is None) != (points[0].v is None) or (point.a is None) != (points[0].a is None):
            raise PlanRefused(f"point {number}: velocities and accelerations must be given for all points or for none")
        if point.a is not None and point.v is None:
            raise PlanRefused(f"point {number}: an acceleration needs a velocity too")


class _Knot:
    """A point with all its numbers, and the kind of the piece before it."""

    __slots__ = ("a", "kind", "q", "t", "v")

    def __init__(self, t: float, q: Sequence[float], v: Sequence[float], a: Sequence[float], kind: float) -> None:
        self.t, self.kind = t, kind
        self.q, self.v, self.a = tuple(q), tuple(v), tuple(a)


def _waypoints(points: Sequence[Point], q_now: Sequence[float]) -> list[_Knot]:
    zero = (0.0,) * len(q_now)
    if points[0].v is not None:
        kind = CUBIC if points[0].a is None else QUINTIC
        return [_Knot(p.t, p.q, p.v or zero, p.a or zero, kind) for p in points]
    # An approach does not rest at the first point: the spline starts at the arm's position.
    led = points[0].t > _AT_ONCE_S
    times = [0.0] * led + [p.t for p in points]
    columns = []
    for i in range(len(q_now)):
        values = [q_now[i]] * led + [p.q[i] for p in points]
        velocities = spline_velocities(times, values)
        columns.append((velocities[led:], spline_accelerations(times, values, velocities)[led:]))
    return [
        _Knot(p.t, p.q, [v[at] for v, _ in columns], [a[at] for _, a in columns], QUINTIC)
        for at, p in enumerate(points)
    ]  # fmt: skip


def _check_ends(first: _Knot, last: _Knot, count: int, q_now: Sequence[float], names: Sequence[str]) -> None:
    if first.t <= _AT_ONCE_S:
        if count == 1:
            raise PlanRefused("point 1: it is the only one and its time is 0 s, so that there is nothing to move to")
        for name, planned, now in zip(names, first.q, q_now, strict=True):
            if not abs(planned - now) <= AT_START_RAD:
                raise PlanRefused(
                    f"point 1: at time 0 s {name} must be where it is, at {now:.4f} rad (within {AT_START_RAD:g} rad), "
                    f"found {planned:.4f} rad; give the point a later time and the arm is led there"
                )
        for name, speed in zip(names, first.v, strict=True):
            if abs(speed) > _STILL:
                raise PlanRefused(f"point 1: at time 0 s {name} must be at rest, found {speed:g} rad/s")
    for name, speed in zip(names, last.v, strict=True):
        if abs(speed) > _STILL:
            raise PlanRefused(f"point {count}: the last point must be at rest, {name} has {speed:g} rad/s")


def _check_waypoint(waypoint: _Knot, where: str, limits: Limits, names: Sequence[str]) -> None:
    for i, name in enumerate(names):
        q, low, high = waypoint.q[i], limits.low[i], limits.high[i]
        if not low <= q <= high:
            raise PlanRefused(f"{where}: {name} is at {q:.6g} rad, allowed is {low:g} to {high:g} rad")


def _check_approach(
    first: _Knot, limits: Limits, q_now: Sequence[float], names: Sequence[str], zone_at: ZoneAt | None
) -> None:
    """Check the approach to the first point that `TrajectoryController` will plan from rest."""
    approach, still = Approach(limits), [0.0] * len(q_now)
    _check_derivatives(first, "point 1", limits, names)
    refused = approach.plan(q_now, still, still, _row(first))
    if refused is not None and refused.axis >= 0:
        raise PlanRefused(
            f"point 1: on the way there {names[refused.axis]} would be at {refused.extreme:.6g} rad, allowed is "
            f"{limits.low[refused.axis]:g} to {limits.high[refused.axis]:g} rad"
        )
    if refused is not None:
        raise PlanRefused(f"point 1: no way from where the arm is to this point at {first.t:g} s was found")
    if approach.duration_s > first.t * (1.0 + _ROUNDING) + 1e-6:
        least = f"the way there from where the arm is takes {approach.duration_s:.3f} s at least"
        raise PlanRefused(f"point 1: its time is {first.t:g} s, {least}")
    if zone_at is not None:
        steps = _steps(approach.duration_s, limits)
        for k in range(steps + 1):
            at = approach.duration_s * k / steps
            _check_zone(approach.at(at)[0], at, "on the way to point 1", zone_at)


def _check_derivatives(waypoint: _Knot, where: str, limits: Limits, names: Sequence[str]) -> None:
    for verb, unit, values, allowed in (
        ("moves at", "rad/s", waypoint.v, limits.velocity),
        ("accelerates with", "rad/s^2", waypoint.a, limits.acceleration),
    ):
        for name, number, most in zip(names, values, allowed, strict=True):
            if abs(number) > most * (1.0 + _ROUNDING):
                raise PlanTooFast(f"{where}: {name} {verb} {number:.4g} {unit}, allowed is at most {most:g} {unit}")


def _steps(duration: float, limits: Limits) -> int:
    """Return the number of parts of a piece in which no joint moves by more than `ZONE_STEP_RAD`."""
    fastest: float = max(limits.velocity)
    return max(2, ceil(fastest * duration / ZONE_STEP_RAD))


def _polynomial(before: _Knot, after: _Knot, i: int) -> Coefficients:
    length = after.t - before.t
    if after.kind == CUBIC:
        return cubic(before.q[i], before.v[i], after.q[i], after.v[i], length)
    return quintic(before.q[i], before.v[i], before.a[i], after.q[i], after.v[i], after.a[i], length)


def _check_piece(
    before: _Knot, after: _Knot, where: str, limits: Limits, names: Sequence[str], zone_at: ZoneAt | None
) -> None:
    length = after.t - before.t
    pieces = [_polynomial(before, after, i) for i in range(len(names))]
    for i, (name, position) in enumerate(zip(names, pieces, strict=True)):
        velocity = derivative(position)
        low, high = limits.low[i] - _ROUNDING, limits.high[i] + _ROUNDING
        if (extreme := beyond(position, low, high)) is not None:
            at = before.t + extreme[1] * length
            raise PlanRefused(
                f"{where}: {name} would be at {extreme[0]:.6g} rad at {at:.3f} s, allowed is "
                f"{limits.low[i]:g} to {limits.high[i]:g} rad"
            )
        for verb, unit, curve, most, scale in (
            ("move at", "rad/s", velocity, limits.velocity[i], length),
            ("accelerate with", "rad/s^2", derivative(velocity), limits.acceleration[i], length * length),
        ):
            bound = most * scale * (1.0 + _ROUNDING)
            if (extreme := beyond(curve, -bound, bound)) is not None:
                at = before.t + extreme[1] * length
                raise PlanTooFast(
                    f"{where}: {name} would {verb} {extreme[0] / scale:.4g} {unit} at {at:.3f} s, "
                    f"allowed is at most {most:g} {unit}"
                )
    if zone_at is not None:
        steps = _steps(length, limits)
        for k in range(steps + 1):
            x = k / steps
            _check_zone([value(piece, x) for piece in pieces], before.t + x * length, where, zone_at)


def _check_zone(q: Sequence[float], at_s: float, where: str, zone_at: ZoneAt) -> None:
    if (box := zone_at(q)) is not None:
        raise PlanRefused(f"{where}: the arm would be in {box} at {at_s:.3f} s")


def _row(waypoint: _Knot) -> tuple[float, ...]:
    padding = (0.0,) * (MOST_AXES - len(waypoint.q))
    return (waypoint.t, *waypoint.q, *padding, *waypoint.v, *padding, *waypoint.a, *padding, waypoint.kind)


class OpenPlan:
    """A trajectory with an open end: returns rows for each new point, checked as in `plan_trajectory`.

    The velocity of a point with only a position follows from the slopes before and after it (0 if they differ in sign),
    so the last point waits for the next one. An exception changes nothing.

    Args:
        limits, names, zone_at: as of `plan_trajectory`.
        q_now: commanded position, rad.
        moving: as of `plan_trajectory`.
    """

    def __init__(
        self,
        limits: Limits,
        q_now: Sequence[float],
        *,
        names: Sequence[str],
        zone_at: ZoneAt | None = None,
        moving: bool = False,
    ) -> None:
        self._limits, self._q_now, self._names, self._zone_at, self._moving = limits, q_now, names, zone_at, moving
        self._last: _Knot | None = None
        self._waiting: Point | None = None
        self._last_point: Point | None = None
        self.times: list[float] = []
        """Times of all rows, s."""

    @property
    def end(self) -> tuple[float, ...]:
        """Joint positions at the last row, rad."""
        return tuple(self._q_now) if self._last is None else self._last.q

    @property
    def waits(self) -> bool:
        """Whether the last point waits for its velocity."""
        return self._waiting is not None

    def append(self, points: Sequence[Point], rest: bool = False) -> list[tuple[float, ...]]:
        """Return the next rows; with `rest` the rows of all points, ending at rest at the last.

        Raises:
            PlanRefused: with the point, the joint, the value and its limit.
        """
        number = len(self.times) + self.waits + 1
        if self._last is None and self._moving and len(points) > 1 and points[0].t <= _AT_ONCE_S:
            points = points[1:]
        known = [] if self._last_point is None else [self._last_point]
        if [*known, *points]:
            _check_points([*known, *points], self._names, number - len(known))
        todo = [*([] if self._waiting is None else [self._waiting]), *points]
        last, rows, waiting = self._last, [], None
        for at, point in enumerate(todo):
            ahead = todo[at + 1] if at + 1 < len(todo) else None
            if ahead is None and point.v is None and not rest and last is not None:
                waiting = point
            knot = self._knot(last, point, ahead)
            where = f"point {number - self.waits + at}"
            _check_waypoint(knot, where, self._limits, self._names)
            if waiting is not None:
                self._check_way(last, knot, where)
                break
            if last is not None:
                _check_piece(last, knot, f"before {where}", self._limits, self._names, self._zone_at)
            elif knot.t <= _AT_ONCE_S:
                _check_ends(knot, _Knot(0.0, knot.q, [0.0] * len(knot.q), knot.a, CUBIC), 2, self._q_now, self._names)
            elif not self._moving:
                _check_approach(knot, self._limits, self._q_now, self._names, self._zone_at)
            rows.append(_row(knot))
            last = knot
        if rest and last is not None:
            for name, speed in zip(self._names, last.v, strict=True):
                if abs(speed) > _STILL:
                    raise PlanRefused(f"the last point must be at rest, {name} has {speed:g} rad/s")
        self._last, self._waiting = last, waiting
        self._last_point = todo[-1] if todo else self._last_point
        self.times += [row[0] for row in rows]
        return rows

    def _check_way(self, before: _Knot | None, after: _Knot, where: str) -> None:
        """Refuse at once a point that no velocity makes reachable, without waiting for the next point."""
        if before is None:
            return
        h = after.t - before.t
        for name, here, there, most in zip(self._names, before.q, after.q, self._limits.velocity, strict=True):
            if abs(there - here) > most * h * (1.0 + _ROUNDING):
                speed = f"{name} would move at {(there - here) / h:.4g} rad/s on the mean"
                raise PlanTooFast(f"before {where}: {speed}, allowed is at most {most:g} rad/s")

    def _knot(self, before: _Knot | None, point: Point, ahead: Point | None) -> _Knot:
        zero = (0.0,) * len(point.q)
        if point.v is not None:
            return _Knot(point.t, point.q, point.v, point.a or zero, CUBIC if point.a is None else QUINTIC)
        from_s, from_q = (0.0, self._q_now) if before is None else (before.t, before.q)
        h = point.t - from_s
        if ahead is None or h <= _AT_ONCE_S:
            return _Knot(point.t, point.q, zero, zero, CUBIC)
        k = ahead.t - point.t
        velocities = []
        for was, here, then in zip(from_q, point.q, ahead.q, strict=True):
            slope, next_slope = (here - was) / h, (then - here) / k
            # Fritsch and Butland 1984: no overshoot between points.
            weights = (2 * k + h, k + 2 * h)
            same_sign = slope * next_slope > 0.0
            velocities.append(sum(weights) / (weights[0] / slope + weights[1] / next_slope) if same_sign else 0.0)
        return _Knot(point.t, point.q, velocities, zero, CUBIC)
