"""Plans of blended paths: lines, arcs and joint moves in one trajectory without a rest at each stop.

Every leg is a curve of the joints over its nominal time, with the tool (in a joint move the fastest joint) at the
commanded speed. A corner with a radius is replaced by a quintic of the joints within that radius of the tool; position,
velocity and acceleration are continuous for any two legs. The time law (`time_law`) then determines the rate of the
nominal time, and the rows for `TrajectoryController` are sampled densely enough for quintics between them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import atan2, ceil, dist, inf, pi, tau
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.interpolate import BPoly, CubicSpline, PPoly

from kinematics.forward import forward, forward_batch
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import jacobian
from kinematics.model import ArmModel
from kinematics.pose import Pose, Vector
from rtcp.config.model import MOST_POINTS, CartesianConfig, Point, Stop
from rtcp.motion.planning.interpolation import quaternion, rotation, turn_between, turned_by
from rtcp.motion.planning.lines import (
    NO_WAY_M,
    NO_WAY_RAD,
    OF_LIMIT,
    SAMPLE_M,
    SAMPLE_RAD,
    PoseAt,
    check_branch,
    check_singular,
    follow,
    goal_of,
    speed_of,
    straight,
)
from rtcp.motion.planning.plan import LONGEST_S, AlreadyThere, Plan, PlanRefused, PlanTooFast, ZoneAt
from rtcp.motion.planning.time_law import LONGEST_WINDOW_S, Array, Bounds, TimeLaw
from rtcp.motion.planning.trajectories import plan_trajectory

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

_FLAT: Final = 1e-4
"""Sine below which three points of an arc count as on a line."""
_LONGEST_TURN: Final = 100.0 * tau
_NEAR_M, _NEAR_SHARE = 0.001, 0.05
"""Smallest distance between the three places of an arc, m and as a share of the largest: below, rounding determines
the circle."""
_ARC_SAMPLE_RAD: Final = 0.1
"""Largest angle of an arc between two samples."""
_LEAST_BLEND_M: Final = 1e-4
_MOST_SAMPLES_OF_LEGS: Final = 50_000
_MOST_STOPS: Final = 1000
_FIRST_ROWS: Final = 1000
"""Limit on the number of rows before their refinement."""
_SHRINK, _SHRINKS = 0.7, 8
"""Factor on the radius of a blend that leaves its ball around the corner, and limit on such attempts."""
_IN_BALL: Final = 1.02
"""Farthest distance of a blend from its corner, relative to that of its ends, up to which it is within its ball."""
_BLEND_SAMPLES: Final = 17
_FITS, _SHORTEST = 5, 0.3
"""Number of adaptations of a blend's nominal time, and its least share of the corner's."""
_PITCH_M, _PITCH_RAD = 0.001, 0.005
"""Largest motion of the tool, and of a joint, between two evaluations of the bounds."""
_LEAST_SAMPLES, _MOST_SAMPLES = 24, 200_000
_OF_JERK: Final = 0.6
"""Share of a joint's jerk for changes of the rate; the rest is for the curvature of the path. Their sum is not bounded:
a change of the rate in a bend may exceed the limit by some tenths."""
_MOST_RATE, _MOST_ACCELERATION, _MOST_JERK = 1.5, 1e3, 1e5
"""Bounds of the rate and its derivatives, 1, 1/s, 1/s^2, where nothing else bounds them."""
_ROW_S, _LEAST_ROW_S = 0.1, 0.002
"""Interval of the first rows, and least interval of refined ones, s."""
_ROW_RAD, _ROW_RAD_S = 2e-6, 2e-4
"""Tolerances of the quintics between rows, which determine the density of the rows."""
_STRETCH, _STRETCHES = 1.02, 20
"""Factor on the duration of a plan that exceeds a limit, and limit on such attempts."""


@dataclass(frozen=True)
class _Leg:
    """The path between two corners; `curve(x, nu)` gives the joints, (k, n), or a derivative, at nominal times, s.

    speed: of the tool, m/s; None: by the joints.
    """

    where: str
    curve: Callable[..., Array]
    duration_s: float
    speed: float | None
    length_m: float
    end: tuple[float, ...]
    blend: float
    reach_s: float
    """Upper bound on a blend's extent from an end, s of nominal time: on an arc the tool returns to its corner."""
    samples: int = 0


@dataclass(frozen=True)
class _Piece:
    """A part of a leg, or a blend: its curve from `start` on, for a nominal time, and the tool's speed at both ends.

    is_blend: between two legs of the tool; it may run faster than nominal to keep the tool's speed.
    """

    curve: Callable[..., Array]
    start_s: float
    duration_s: float
    speeds: tuple[float, float] | None
    is_blend: bool = False


def plan_path(
    model: ArmModel,
    limits: Limits,
    cartesian: CartesianConfig,
    q_now: Sequence[float],
    stops: Sequence[Stop],
    *,
    speed: float | None = None,
    zone_at: ZoneAt | None = None,
) -> Plan:
    """Return the plan of a path for `TrajectoryController`, at rest at its ends and at each stop without a blend.

    Args:
        model: the arm.
        limits: of the joints; a path that would exceed them is slowed down.
        cartesian: speeds, accelerations and jerks of the tool, and its least distances to singularities.
        q_now: commanded position, at rest, rad, shape (6,).
        stops: at least one; a stop at the arm's present position is skipped.
        speed: for lines and arcs without their own, m/s; None: that of `cartesian`.
        zone_at: called along the whole path.

    Raises:
        PlanRefused: with the stop, the value and its limit.
    """
    if not stops:
        raise PlanRefused("the path has no stops, at least one is needed")
    if len(stops) > _MOST_STOPS:
        raise PlanRefused(
            f"the path has {len(stops)} stops, with arcs, blends or joint moves at most {_MOST_STOPS} are allowed"
        )
    for number, stop in enumerate(stops, 1):
        if 0.0 < stop.blend < _LEAST_BLEND_M:
            raise PlanRefused(
                f"stop {number}: found a blend of {stop.blend:g} m, allowed is 0 or at least {_LEAST_BLEND_M:g} m"
            )
    legs = _legs(model, limits, cartesian, q_now, stops, speed, zone_at)
    if not legs:
        raise AlreadyThere("the arm is already where the path leads, there is nothing to move")
    points: list[Point] = [_standstill(0.0, tuple(q_now))]
    slowed = 1.0
    for section in _sections(model, cartesian, legs):
        path = _Path(section)
        bounds, part = path.bounds(model, limits, cartesian)
        slowed = min(slowed, part)
        points += _rows(path, TimeLaw(bounds), points[-1].t)
        if len(points) > MOST_POINTS:
            raise PlanRefused(
                f"the path needs more than {MOST_POINTS} rows: run it in several parts, or with fewer stops"
            )
    names = model.joint_names
    for _ in range(_STRETCHES):
        try:
            plan = plan_trajectory(points, limits, q_now, names=names, zone_at=zone_at)
        except PlanTooFast:
            # A limit is exceeded between two samples, or by an effect that the bounds along the path neglect.
            points = [_slower(point) for point in points]
            slowed /= _STRETCH
            continue
        return replace(plan, length_m=sum(leg.length_m for leg in legs), slowed=slowed)
    raise PlanRefused("no time law was found that keeps the joints' limits: choose another path")


def _legs(
    model: ArmModel,
    limits: Limits,
    cartesian: CartesianConfig,
    q_now: Sequence[float],
    stops: Sequence[Stop],
    speed: float | None,
    zone_at: ZoneAt | None,
) -> list[_Leg]:
    inverse = InverseKinematics(model)
    legs: list[_Leg] = []
    samples = 0
    q, here = tuple(q_now), forward(model, q_now)
    for number, stop in enumerate(stops, 1):
        kind = "the move" if stop.by_joints else "the line" if stop.via is None else "the arc"
        where = f"{kind} to stop {number}" if len(stops) > 1 else kind
        goal = goal_of(model, stop, where)
        if stop.by_joints:
            leg = _by_joints(inverse, limits, q, stop, goal, where)
        else:
            pose_at, extent, angle = (
                (straight(here, goal), _extent(here, goal), 0.0)
                if stop.via is None
                else _arc(here, stop.via, goal, stop.angle, where)
            )
            leg = _of_tool(inverse, limits, cartesian, q, pose_at, extent, angle, stop, speed, where, zone_at)
        if leg is not None:
            legs.append(leg)
            q, here = leg.end, forward(model, leg.end)
        elif legs:
            legs[-1] = replace(legs[-1], blend=stop.blend)
        if not stop.by_joints and stop.angle is None:
            check_branch(stop, q, where, model)
        samples += 0 if leg is None else leg.samples
        if samples > _MOST_SAMPLES_OF_LEGS:
            raise PlanRefused(f"{where}: the path is too long to be planned whole: run it in several parts")
    return legs


def _extent(start: Pose, end: Pose) -> tuple[float, float]:
    return dist(start.position, end.position), turn_between(quaternion(start.rotation), quaternion(end.rotation))[1]


def _by_joints(
    inverse: InverseKinematics, limits: Limits, q: tuple[float, ...], stop: Stop, goal: Pose, where: str
) -> _Leg | None:
    fastest = max(limits.velocity)
    if stop.speed is not None and not 0.0 < stop.speed <= fastest:
        raise PlanRefused(
            f"{where}: found a speed of {stop.speed:g} rad/s, allowed is more than 0 and at most {fastest:g} rad/s"
        )
    if stop.q is not None:
        end = tuple(stop.q)
    else:
        near = inverse.solve_near(goal, q)
        if near.q is None:
            raise PlanRefused(f"{where}: {near.reason}")
        end = near.q
    for name, at, low, high in zip(inverse.model.joint_names, end, limits.low, limits.high, strict=True):
        if not low <= at <= high:
            raise PlanRefused(f"{where}: {name} would be at {at:.4f} rad, allowed is {low:g} to {high:g} rad")
    distances = [b - a for a, b in zip(q, end, strict=True)]
    duration = max(
        abs(distance) / min(OF_LIMIT * most, inf if stop.speed is None else stop.speed)
        for distance, most in zip(distances, limits.velocity, strict=True)
    )
    if duration <= 1e-6:
        return None
    _check_duration(duration, where)
    curve = PPoly(np.array([[[distance / duration for distance in distances]], [list(q)]]), [0.0, duration])
    length = dist(forward(inverse.model, q).position, forward(inverse.model, end).position)
    return _Leg(where, curve, duration, None, length, end, stop.blend, 0.5 * duration)


def _arc(
    start: Pose, via: Sequence[float], end: Pose, angle: float | None, where: str
) -> tuple[PoseAt, tuple[float, float], float]:
    """Return the poses of the arc from a pose through a point to a pose, the tool's motion and rotation, its angle.

    A given angle is travelled on the circle through the three places, with constant tool orientation.
    """
    a, b, c = (np.array(place, dtype=np.float64) for place in (start.position, via, end.position))
    u, w = b - a, c - a
    normal = np.cross(u, w)
    sides = [float(np.linalg.norm(side)) for side in (u, w, c - b)]
    across = float(np.linalg.norm(normal))
    if not (min(sides) >= max(_NEAR_M, _NEAR_SHARE * max(sides)) and across > _FLAT * sides[0] * sides[1]):
        raise PlanRefused(
            f"{where}: its start, its via and its end are on one line or not three places at least 1 mm apart: choose "
            "a via off the line and, for a circle, an end farther from its start"
        )
    # the centre of the circle through three points
    to_centre = (np.cross(normal, u) * float(w @ w) + np.cross(w, normal) * float(u @ u)) / (2.0 * across * across)
    centre, radius = a + to_centre, float(np.linalg.norm(to_centre))
    first = -to_centre / radius
    second = np.cross(normal / across, first)
    if angle is None:
        out = c - centre
        swept = atan2(float(out @ second), float(out @ first)) % tau
        axis, tool_turn = turn_between(quaternion(start.rotation), quaternion(end.rotation))
    else:
        if not 0.0 < abs(angle) <= _LONGEST_TURN:
            raise PlanRefused(f"{where}: found an angle of {angle:g} rad, allowed is up to {_LONGEST_TURN:g}, not 0")
        swept, axis, tool_turn = angle, (0.0, 0.0, 1.0), 0.0
    turned = rotation(quaternion(start.rotation))

    def pose_at(x: float) -> Pose:
        place = centre + radius * (np.cos(x * swept) * first + np.sin(x * swept) * second)
        at: Vector = (float(place[0]), float(place[1]), float(place[2]))
        return Pose(at, turned_by(turned, axis, x * tool_turn) if tool_turn else turned)

    return pose_at, (radius * abs(swept), tool_turn), abs(swept)


def _of_tool(
    inverse: InverseKinematics,
    limits: Limits,
    cartesian: CartesianConfig,
    q: tuple[float, ...],
    pose_at: PoseAt,
    extent: tuple[float, float],
    swept: float,
    stop: Stop,
    speed: float | None,
    where: str,
    zone_at: ZoneAt | None,
) -> _Leg | None:
    fast = speed_of(stop, speed, cartesian, where)
    length, angle = extent
    if length <= NO_WAY_M and angle <= NO_WAY_RAD:
        return None
    duration = max(length / fast, angle / cartesian.angular_speed)
    _check_duration(duration, where)
    least = ceil(swept / _ARC_SAMPLE_RAD)
    if length / SAMPLE_M + angle / SAMPLE_RAD + least > _MOST_SAMPLES_OF_LEGS:
        raise PlanRefused(f"{where}: it is too long to be planned whole: run it in several parts")
    joints = follow(inverse, limits, cartesian, pose_at, extent, q, where, zone_at, least)
    curve = CubicSpline(np.linspace(0.0, duration, len(joints)), np.array(joints))
    reach = 0.5 * duration * min(1.0, pi / swept if swept else 1.0)
    return _Leg(where, curve, duration, fast, length, joints[-1], stop.blend, reach, len(joints))


def _check_duration(duration: float, where: str) -> None:
    if not duration <= LONGEST_S:
        raise PlanRefused(f"{where}: it would take {duration:g} s, at most {LONGEST_S:g} s are allowed: move faster")


def _sections(model: ArmModel, cartesian: CartesianConfig, legs: Sequence[_Leg]) -> list[list[_Piece]]:
    """Return the pieces of each section, from one rest to the next: the legs, shortened by their blends, and blends."""
    sections: list[list[_Piece]] = [[]]
    begin = 0.0
    for leg, following in zip(legs, [*legs[1:], None], strict=True):
        speeds = None if leg.speed is None else (leg.speed, leg.speed)
        if following is None or leg.blend <= 0.0:
            sections[-1].append(_Piece(leg.curve, begin, leg.duration_s - begin, speeds))
            sections.append([])
            begin = 0.0
            continue
        leave, blend, begin_next = _blend(model, cartesian, leg, following, begin)
        sections[-1] += [_Piece(leg.curve, begin, leave - begin, speeds), blend]
        begin = begin_next
    return sections[:-1]


def _blend(
    model: ArmModel, cartesian: CartesianConfig, leg: _Leg, following: _Leg, begin: float
) -> tuple[float, _Piece, float]:
    """Return the end time on a leg, the blend, and the start time on the next leg."""
    corner = forward(model, leg.end).position
    radius = leg.blend
    of_tool = leg.speed is not None and following.speed is not None
    for _ in range(_SHRINKS):
        leave = _within(model, leg, corner, radius, leg.duration_s)
        enter = _within(model, following, corner, radius, 0.0)
        ends = [[leg.curve(leave, nu) for nu in range(3)], [following.curve(enter, nu) for nu in range(3)]]
        speed = 0.5 * (_tool_speed(model, leg, leave) + _tool_speed(model, following, enter))
        whole = duration = leg.duration_s - leave + enter
        for _ in range(_FITS):
            curve = BPoly.from_derivatives([0.0, duration], ends)
            joints = curve(np.linspace(0.0, duration, _BLEND_SAMPLES))
            places = [forward(model, q).position for q in joints.tolist()]
            # Its length divided by the mean speed of its ends: with this duration the curve bends least.
            length = sum(map(dist, places[1:], places[:-1]))
            duration = min(max(length / speed if speed else inf, _SHORTEST * whole), whole)
        far = max(dist(places[0], corner), dist(places[-1], corner))
        if all(dist(place, corner) <= _IN_BALL * far + NO_WAY_M for place in places):
            if of_tool:
                for q in joints.tolist():
                    check_singular(model, q, cartesian, f"the blend at the end of {leg.where}")
            speeds = (leg.speed, following.speed) if leg.speed is not None and following.speed is not None else None
            return leave, _Piece(curve, 0.0, float(curve.x[-1]), speeds, of_tool), enter
        radius *= _SHRINK
    raise PlanRefused(
        f"{leg.where}: its corner cannot be blended within {leg.blend:g} m: choose another radius, or a rest"
    )


def _tool_speed(model: ArmModel, leg: _Leg, x: float) -> float:
    """Return the tool's nominal speed at a nominal time, m/s."""
    rates = leg.curve(x, 1)
    rows = jacobian(model, leg.curve(x).tolist())
    return float(np.linalg.norm(np.array(rows[:3]) @ rates))


def _within(model: ArmModel, leg: _Leg, corner: Vector, radius: float, end: float) -> float:
    """Return the nominal time at which the tool is `radius` from the corner at an `end`; at most half of the leg.

    A blend takes half of a joint move in which the tool does not leave the radius.
    """

    def far(x: float) -> float:
        return dist(forward(model, leg.curve(x).tolist()).position, corner)

    out, near = end + (leg.reach_s if end == 0.0 else -leg.reach_s), end
    if far(out) <= radius:
        return out
    for _ in range(50):
        middle = 0.5 * (out + near)
        out, near = (out, middle) if far(middle) <= radius else (middle, near)
    return 0.5 * (out + near)


class _Path:
    """The pieces between two rests as one curve over the nominal time.

    Args:
        pieces: in their order.
    """

    def __init__(self, pieces: Sequence[_Piece]) -> None:
        self._pieces = pieces
        self._ends = np.cumsum([piece.duration_s for piece in pieces])
        self.duration_s = float(self._ends[-1])

    def at(self, x: Array, nu: int) -> Array:
        """Return the joints, (k, n), or a derivative of them, at nominal times, (k,), s."""
        pieces = np.minimum(np.searchsorted(self._ends, x), len(self._pieces) - 1)
        result: Array | None = None
        for number in np.unique(pieces):
            piece, here = self._pieces[number], pieces == number
            local = np.clip(x[here] - (self._ends[number] - piece.duration_s), 0.0, piece.duration_s) + piece.start_s
            values = piece.curve(local, nu)
            if result is None:
                result = np.empty((len(x), values.shape[1]))
            result[here] = values
        assert result is not None
        return result

    def bounds(self, model: ArmModel, limits: Limits, cartesian: CartesianConfig) -> tuple[Bounds, float]:
        """Return the bounds of the time law, and the share of the commanded speed that they leave to the tool.

        With x the nominal time, q(x) the joints and r = dx/dt the rate, the speed of a joint is q' r, its acceleration
        q'' r^2 + q' dr/dt, and its jerk q''' r^3 + ... + q' d2r/dt2.
        """
        grid = self._grid(limits, cartesian)
        pitch = float(grid[1])
        first, second, third = (np.abs(self.at(grid, nu)) for nu in (1, 2, 3))
        places, rotations = forward_batch(model, self.at(grid, 0))
        velocity = np.gradient(places, pitch, axis=0)
        speed = np.linalg.norm(velocity, axis=1)
        bow = np.linalg.norm(np.gradient(velocity, pitch, axis=0), axis=1)
        step = np.einsum("kji,kjl->kil", rotations[:-1], rotations[1:])
        spin = (
            0.5
            / pitch
            * np.linalg.norm(
                [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], axis=0
            )
        )
        spin = np.maximum(np.append(spin, 0.0), np.append(0.0, spin))
        wanted, of_tool = self._wanted(grid, speed, spin, cartesian)
        fastest, strongest, jerkiest = (
            np.array(limit) for limit in (limits.velocity, limits.acceleration, limits.jerk)
        )
        with np.errstate(divide="ignore"):
            rate = np.minimum(wanted, (OF_LIMIT * fastest / first).min(axis=1))
            rate = np.minimum(rate, np.sqrt((0.5 * OF_LIMIT * strongest / second).min(axis=1)))
            rate = np.minimum(rate, np.cbrt(((1.0 - _OF_JERK) * jerkiest / third).min(axis=1)))
            rate = np.where(of_tool, np.minimum(rate, np.sqrt(cartesian.acceleration / bow)), rate)
            remaining = np.maximum(OF_LIMIT * strongest - second * (rate * rate)[:, None], 0.0)
            acceleration, jerk = (remaining / first).min(axis=1), (_OF_JERK * jerkiest / first).min(axis=1)
            for bound, linear, angular in (
                (acceleration, cartesian.acceleration, cartesian.angular_acceleration),
                (jerk, cartesian.jerk, cartesian.angular_jerk),
            ):
                of_both = np.minimum(linear / speed, angular / spin)
                np.minimum(bound, np.where(of_tool, of_both, inf), out=bound)
        # The time law spreads a change of acceleration over this window at most.
        acceleration = np.minimum(acceleration, jerk * LONGEST_WINDOW_S)
        part = float((rate / wanted)[of_tool].min(initial=1.0))
        return Bounds(
            pitch,
            np.minimum(rate, _MOST_RATE),
            np.minimum(acceleration, _MOST_ACCELERATION),
            np.minimum(jerk, _MOST_JERK),
        ), min(part, 1.0)  # fmt: skip

    def _grid(self, limits: Limits, cartesian: CartesianConfig) -> Array:
        speed = max((max(piece.speeds) for piece in self._pieces if piece.speeds), default=0.0)
        pitch = min(
            _PITCH_M / speed if speed else inf,
            _PITCH_RAD / max(limits.velocity),
            min(piece.duration_s for piece in self._pieces if piece.duration_s > 1e-9) / _LEAST_SAMPLES,
        )
        count = min(ceil(self.duration_s / pitch), _MOST_SAMPLES)
        return np.linspace(0.0, self.duration_s, count + 1)

    def _wanted(self, grid: Array, speed: Array, spin: Array, cartesian: CartesianConfig) -> tuple[Array, Array]:
        """Return the rate for the commanded tool speed, and where the tool moves."""
        wanted, of_tool = np.ones(len(grid)), np.zeros(len(grid), dtype=bool)
        for piece, end in zip(self._pieces, self._ends, strict=True):
            if piece.speeds is None:
                continue
            here = (grid >= end - piece.duration_s) & (grid <= end)
            of_tool |= here
            if piece.is_blend:
                part = (grid[here] - (end - piece.duration_s)) / piece.duration_s
                fast = piece.speeds[0] + (piece.speeds[1] - piece.speeds[0]) * part
                with np.errstate(divide="ignore"):
                    wanted[here] = np.minimum(fast / speed[here], cartesian.angular_speed / spin[here])
        return wanted, of_tool


def _standstill(t: float, q: tuple[float, ...]) -> Point:
    still = (0.0,) * len(q)
    return Point(t, q, still, still)


def _slower(point: Point) -> Point:
    assert point.v is not None
    assert point.a is not None
    return Point(
        point.t * _STRETCH, point.q, tuple(v / _STRETCH for v in point.v), tuple(a / _STRETCH**2 for a in point.a)
    )


def _rows(path: _Path, law: TimeLaw, begin_s: float) -> list[Point]:
    """Return the points of a section after its first, dense enough for quintics between them."""
    times = np.linspace(0.0, law.duration_s, min(max(ceil(law.duration_s / _ROW_S), 2), _FIRST_ROWS) + 1)

    def at(when: Array) -> tuple[Array, Array, Array]:
        x, rate, change = law.at(when)
        first, second = path.at(x, 1), path.at(x, 2)
        return (
            path.at(x, 0),
            first * rate[:, None],
            second * np.square(rate)[:, None] + first * change[:, None],
        )

    while True:
        q, v, a = at(times)
        lengths = np.diff(times)
        step = lengths[:, None]
        middle = 0.5 * (q[1:] + q[:-1]) + 5 / 32 * step * (v[:-1] - v[1:]) + 1 / 64 * step**2 * (a[:-1] + a[1:])
        speed = 15 / 8 * np.diff(q, axis=0) / step - 7 / 16 * (v[:-1] + v[1:]) + 1 / 32 * step * np.diff(a, axis=0)
        exact_q, exact_v, _ = at(times[:-1] + 0.5 * lengths)
        wrong = (np.abs(middle - exact_q).max(axis=1) > _ROW_RAD) | (np.abs(speed - exact_v).max(axis=1) > _ROW_RAD_S)
        wrong &= lengths > 2.0 * _LEAST_ROW_S
        if not wrong.any() or len(times) > MOST_POINTS:
            break
        times = np.sort(np.append(times, (times[:-1] + 0.5 * lengths)[wrong]))
    points = [
        Point(begin_s + float(t), tuple(row_q), tuple(row_v), tuple(row_a))
        for t, row_q, row_v, row_a in zip(times[1:], q[1:].tolist(), v[1:].tolist(), a[1:].tolist(), strict=True)
    ]
    points[-1] = _standstill(points[-1].t, points[-1].q)
    return points
