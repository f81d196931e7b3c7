"""Plans of trajectories: timed joint points, joined by polynomials whose extremes are all inside the limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import ceil, copysign, inf, isfinite, sqrt
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
_SLOWER: Final = (1.0, 1.02, 1.05, 1.1, 1.15)
"""Factors of the times of positions alone, tried in this order."""
_ROUNDED: Final = (1.0, 1.002)
"""As `_SLOWER`, of points with velocities, which a planner may have rounded."""
_SLOWER_UNTIMED: Final = tuple(1.1**k for k in range(40))
"""As `_SLOWER`, of points without times."""
_FITTED: Final = 1e-6
"""Tolerance of an acceleration that follows from two points, of its limit: rounding of positions counts more there."""
_SAME_S: Final = 1e-9
"""Time between two changes of acceleration below which they are one, s."""
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
    start_tolerance: float = 0.0,
) -> Plan:
    """Return the plan of a trajectory for `TrajectoryController`.

    Points with only positions are joined by quintics with the velocities and accelerations of the cubic spline through
    them; points with velocities by cubics; with accelerations by quintics. All points are of one kind. Where such a
    polynomial would exceed a limit of velocity or acceleration, constant accelerations join the two points instead
    (`_least_acceleration`), which adds rows to the plan: a motion that is sampled at the limits is taken as it is. The
    plan starts at rest at `q_now` (a first point at time 0 must be there within `start_tolerance`; an approach leads to
    a later one) and ends at rest.

    Where all times are 0, also that of a single point, the plan has times of its own: the joints move at the given
    speeds, else at their limits, and as much slower as the curve through the points needs.

    Args:
        points: at least one, at most `MOST_POINTS`, times rising by `SHORTEST_S` at least, or all 0.
        limits: position, velocity and acceleration of every joint, checked at the extremes of each polynomial.
        q_now: commanded position, rad, shape (n,).
        names: of the joints, for messages.
        zone_at: called every `ZONE_STEP_RAD` of joint motion.
        moving: the plan replaces a motion, which will have passed `q_now`: a first point at time 0 followed by others
            is dropped, and the loop plans the approach to the next.
        start_tolerance: largest distance of a first point at time 0 from `q_now`, rad; at least `AT_START_RAD`.

    Returns:
        The plan; `slowed` is below 1 where the curve through the points exceeds a limit that the points keep, as the
        spline through positions alone does at a change of acceleration: then all times are a little longer.

    Raises:
        PlanRefused: with the point, the joint, the value and its limit.
    """
    names = list(names) or [f"joint{i + 1}" for i in range(len(q_now))]
    timed = len(points) == 0 or any(point.t != 0.0 for point in points)
    _check_points(points, names, timed=timed)
    for number, point in enumerate(points, 1):
        _check_waypoint(point.q, f"point {number}", limits, names)
    if len(points) > 1 and points[0].t <= _AT_ONCE_S and not moving:
        tolerance = max(start_tolerance, AT_START_RAD)
        if timed:
            _check_start(points[0].q, q_now, tolerance, names)
        # Without times a first point elsewhere is one to which the arm is led.
        if all(abs(planned - now) <= tolerance for planned, now in zip(points[0].q, q_now, strict=True)):
            points = (replace(points[0], q=tuple(q_now)), *points[1:])
    factors: tuple[float, ...]
    if timed:
        factors = _SLOWER if points[0].v is None else _ROUNDED
    else:
        points, factors = _with_times(points, limits, q_now, names, moving), _SLOWER_UNTIMED
    refused: PlanTooFast | None = None
    for factor in factors:
        try:
            plan = _planned([_slower(point, factor) for point in points], limits, q_now, names, zone_at, moving)
        except PlanTooFast as error:
            refused = refused or error
        else:
            return replace(plan, slowed=1.0 / factor)
    assert refused is not None
    raise refused


def _check_start(q: Sequence[float], q_now: Sequence[float], tolerance: float, names: Sequence[str]) -> None:
    """Refuse a first point at time 0 that is not at `q_now`."""
    for name, planned, now in zip(names, q, q_now, strict=True):
        if not abs(planned - now) <= tolerance:
            raise PlanRefused(
                f"point 1: at time 0 s {name} must be where it is, at {now:.4f} rad (within {tolerance:g} rad), "
                f"found {planned:.4f} rad; give the point a later time and the arm is led there"
            )


def _slower(point: Point, factor: float) -> Point:
    if factor == 1.0:
        return point
    v, a = point.v and tuple(v / factor for v in point.v), point.a and tuple(a / factor**2 for a in point.a)
    return Point(point.t * factor, point.q, v, a)


def _with_times(
    points: Sequence[Point], limits: Limits, q_now: Sequence[float], names: Sequence[str], moving: bool
) -> list[Point]:
    """Return points without times as positions alone, with the times of one trapezoid of speed from rest to rest.

    The points' polyline has a length in seconds, that of the joints at their speeds; on it the speed rises to 1 as fast
    as the joints may accelerate.
    """
    for number, point in enumerate(points, 1):
        _check_speeds("moves at", "rad/s", point.v or (), limits.velocity, f"point {number}", names)
    at_start = len(points) > 1 and all(abs(q - now) <= AT_START_RAD for q, now in zip(points[0].q, q_now, strict=True))
    todo = points[1:] if at_start else points
    lengths, rise = [], inf
    for before, after in pairwise((Point(0.0, tuple(q_now)), *todo)):
        distances = [abs(b - a) for a, b in zip(before.q, after.q, strict=True)]
        given = [max(map(abs, speeds)) for speeds in zip(before.v or after.v or (), after.v or (), strict=True)]
        speeds = [speed or most for speed, most in zip(given or limits.velocity, limits.velocity, strict=True)]
        length = max(SHORTEST_S, *(d / speed for d, speed in zip(distances, speeds, strict=True)))
        rates = zip(distances, limits.acceleration, strict=True)
        rise = min(rise, *(most * length / d for d, most in rates if d > 0.0), inf)
        lengths.append(length)
    total, rise = sum(lengths), min(rise, 1.0 / SHORTEST_S)
    top = min(1.0, sqrt(total * rise))
    ramp = top * top / (2.0 * rise)
    duration, done = total / top + top / rise, 0.0
    timed = [] if moving else [Point(0.0, tuple(q_now))]
    for length, point in zip(lengths, todo, strict=True):
        done += length
        if done <= ramp:
            t = sqrt(2.0 * done / rise)
        elif done <= total - ramp:
            t = top / rise + (done - ramp) / top
        else:
            t = duration - sqrt(max(2.0 * (total - done) / rise, 0.0))
        timed.append(Point(max(t, (timed[-1].t if timed else 0.0) + SHORTEST_S), point.q))
    return timed


def _planned(
    points: Sequence[Point],
    limits: Limits,
    q_now: Sequence[float],
    names: Sequence[str],
    zone_at: ZoneAt | None,
    moving: bool,
) -> Plan:
    if moving and len(points) > 1 and points[0].t <= _AT_ONCE_S:
        points = points[1:]
    waypoints = _waypoints(points, q_now)
    first, last = waypoints[0], waypoints[-1]
    _check_ends(first, last, len(points), names)
    if first.t > _AT_ONCE_S and not moving:
        _check_approach(first, limits, q_now, names, zone_at)
    knots = [first]
    for number, (before, after) in enumerate(pairwise(waypoints), 1):
        knots += _joined(before, after, f"between points {number} and {number + 1}", limits, names, zone_at)
    if len(knots) > MOST_POINTS:
        raise PlanTooFast(
            f"the motion needs {len(knots)} rows at its limits, at most {MOST_POINTS} fit: give it more time"
        )
    return Plan(tuple(_row(knot) for knot in knots), last.t, 0.0, 1.0, last.q)


def _check_points(points: Sequence[Point], names: Sequence[str], first: int = 1, timed: bool = True) -> None:
    if not points:
        raise PlanRefused("the trajectory has no points, at least one is needed")
    if len(points) > MOST_POINTS:
        raise PlanRefused(f"the trajectory has {len(points)} points, at most {MOST_POINTS} are allowed")
    for at, point in enumerate(points):
        number = first + at
        if not isfinite(point.t) or not 0.0 <= point.t <= LONGEST_S:
            raise PlanRefused(f"point {number}: its time is {point.t} s, allowed is 0 to {LONGEST_S:g} s")
        if timed and at and point.t < points[at - 1].t + SHORTEST_S * (1.0 - _ROUNDING):
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


def _check_ends(first: _Knot, last: _Knot, count: int, names: Sequence[str]) -> None:
    if first.t <= _AT_ONCE_S:
        for name, speed in zip(names, first.v, strict=True):
            if abs(speed) > _STILL:
                raise PlanRefused(f"point 1: at time 0 s {name} must be at rest, found {speed:g} rad/s")
    for name, speed in zip(names, last.v, strict=True):
        if abs(speed) > _STILL:
            raise PlanRefused(f"point {count}: the last point must be at rest, {name} has {speed:g} rad/s")


def _check_waypoint(position: Sequence[float], where: str, limits: Limits, names: Sequence[str]) -> None:
    for name, q, low, high in zip(names, position, limits.low, limits.high, strict=False):
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
    _check_speeds("moves at", "rad/s", waypoint.v, limits.velocity, where, names)
    _check_speeds("accelerates with", "rad/s^2", waypoint.a, limits.acceleration, where, names)


def _check_speeds(
    verb: str, unit: str, values: Sequence[float], allowed: Sequence[float], where: str, names: Sequence[str]
) -> None:
    for name, number, most in zip(names, values, allowed, strict=False):
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
            raise _out_of_range(where, name, extreme[0], before.t + extreme[1] * length, limits, i)
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


def _joined(
    before: _Knot, after: _Knot, where: str, limits: Limits, names: Sequence[str], zone_at: ZoneAt | None
) -> list[_Knot]:
    """Return the knots that lead to `after`: itself, after those at which accelerations change. Raises PlanRefused."""
    try:
        _check_piece(before, after, where, limits, names, zone_at)
    except PlanTooFast:
        profiles = [
            _least_acceleration(q, v, to_q, to_v, after.t - before.t, most, limit)
            for q, v, to_q, to_v, most, limit in zip(
                before.q, before.v, after.q, after.v, limits.velocity, limits.acceleration, strict=True
            )
        ]
        if not all(profiles):
            raise
        return _with_changes(before, after, profiles, where, limits, names, zone_at)
    return [after]


def _with_changes(
    before: _Knot,
    after: _Knot,
    profiles: Sequence[Sequence[tuple[float, float]]],
    where: str,
    limits: Limits,
    names: Sequence[str],
    zone_at: ZoneAt | None,
) -> list[_Knot]:
    """Return the knots of a piece in which each joint has the accelerations of its profile, as cubics between them."""
    length, times = after.t - before.t, [0.0]
    for change in sorted(begin for profile in profiles for begin, _ in profile):
        if times[-1] + _SAME_S < change < length - _SAME_S:
            times.append(change)
    knots = [_Knot(before.t + t, *_after(before, profiles, t), before.a, CUBIC) for t in times[1:]]
    knots.append(_Knot(after.t, after.q, after.v, after.a, CUBIC))
    for i, name in enumerate(names):
        for start, end in pairwise((before, *knots)):
            curve = cubic(start.q[i], start.v[i], end.q[i], end.v[i], end.t - start.t)
            if (extreme := beyond(curve, limits.low[i] - _ROUNDING, limits.high[i] + _ROUNDING)) is not None:
                raise _out_of_range(where, name, extreme[0], start.t + extreme[1] * (end.t - start.t), limits, i)
    if zone_at is not None:
        steps = _steps(length, limits)
        for k in range(steps + 1):
            _check_zone(_after(before, profiles, length * k / steps)[0], before.t + length * k / steps, where, zone_at)
    return knots


def _after(
    before: _Knot, profiles: Sequence[Sequence[tuple[float, float]]], time_s: float
) -> tuple[list[float], list[float]]:
    """Return position and velocity of each joint, `time_s` after `before`."""
    positions, velocities = [], []
    for position, velocity, profile in zip(before.q, before.v, profiles, strict=True):
        q, v = position, velocity
        ends = [*(begin for begin, _ in profile[1:]), time_s]
        for (begin, acceleration), end in zip(profile, ends, strict=True):
            lasts = min(end, time_s) - begin
            if lasts <= 0.0:
                break
            q, v = q + lasts * (v + 0.5 * lasts * acceleration), v + lasts * acceleration
        positions.append(q)
        velocities.append(v)
    return positions, velocities


def _least_acceleration(
    q0: float, v0: float, q1: float, v1: float, duration: float, most: float, limit: float
) -> list[tuple[float, float]]:
    """Return the motion of a joint between two states with the least acceleration: (begin in s, rad/s^2), in order.

    It has one acceleration, and then its opposite: with B its first one, h the duration and
    e = q1 - q0 - (v0 + v1) h/2, B^2 h^2 - 4 e B - (v1 - v0)^2 = 0. Where the joint would become faster than `most`,
    rad/s, it moves at `most` in between. Empty: it needs more than `limit`, rad/s^2, or is too fast at an end.
    """
    change, distance = v1 - v0, q1 - q0
    if max(abs(v0), abs(v1)) > most * (1.0 + _ROUNDING):
        return []
    excess = distance - 0.5 * (v0 + v1) * duration
    first = (2.0 * excess + copysign(sqrt(4.0 * excess**2 + (change * duration) ** 2), excess)) / duration**2
    if abs(first) <= _STILL:
        return [(0.0, first)]
    switch = 0.5 * (duration + change / first)
    sign = copysign(1.0, first)
    if sign * (v0 + first * switch) <= most * (1.0 + _ROUNDING):
        return [(0.0, first), (switch, -first)] if abs(first) <= limit * (1.0 + _FITTED) else []
    room = most * duration - sign * distance
    if room <= 0.0:
        return []
    up, down = most - sign * v0, most - sign * v1
    size = (up**2 + down**2) / (2.0 * room)
    if size > limit * (1.0 + _FITTED):
        return []
    return [(0.0, sign * size), (up / size, 0.0), (duration - down / size, -sign * size)]


def _out_of_range(where: str, name: str, q: float, at_s: float, limits: Limits, i: int) -> PlanRefused:
    return PlanRefused(
        f"{where}: {name} would be at {q:.6g} rad at {at_s:.3f} s, allowed is "
        f"{limits.low[i]:g} to {limits.high[i]:g} rad"
    )


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
            _check_waypoint(knot.q, where, self._limits, self._names)
            if waiting is not None:
                self._check_way(last, knot, where)
                break
            if last is not None:
                _check_piece(last, knot, f"before {where}", self._limits, self._names, self._zone_at)
            elif knot.t <= _AT_ONCE_S:
                _check_start(knot.q, self._q_now, AT_START_RAD, self._names)
                _check_ends(knot, _Knot(0.0, knot.q, [0.0] * len(knot.q), knot.a, CUBIC), 2, self._names)
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
