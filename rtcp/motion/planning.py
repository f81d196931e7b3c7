"""Plans for trajectories and straight lines, checked whole before anything moves. Outside the cycle; no numpy.

Both functions return a `Plan`, whose `rows` (`rtcp.motion.rows`) go into the plan area as they are, or raise
`PlanRefused` with a sentence. `zone_at(q)` answers for six joint angles which box the arm would be in, as a text, or
None where it is free; without it no zone is looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

ZoneAt = Callable[[Sequence[float]], "str | None"]


class PlanRefused(ValueError):
    """The plan cannot be carried out; the message is a sentence with the place, what was found and what is allowed."""


@dataclass(frozen=True)
class Point:
    """A point of a trajectory: time, s, and position, rad; velocity, rad/s, and acceleration, rad/s^2, if given."""

    t: float
    q: tuple[float, ...]
    v: tuple[float, ...] | None = None
    a: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Stop:
    """The end of a straight line: a pose (x, y, z, rx, ry, rz; m and rad) or the joints that have it; speed, m/s.

    `speed` None: that of the whole path.
    """

    pose: tuple[float, ...] | None = None
    q: tuple[float, ...] | None = None
    speed: float | None = None


@dataclass(frozen=True)
class Plan:
    """What the loop is given.

    rows: of 20 doubles each, `len(rows)` is the count of the command. duration_s: from the start to rest. length_m: of
    the lines, 0 for a trajectory. slowed: 1 where the lines keep the speed asked for, less where a joint's limits made
    them slower. end: the joints' position at the end, rad.
    """

    rows: tuple[tuple[float, ...], ...]
    duration_s: float
    length_m: float
    slowed: float
    end: tuple[float, ...]


def plan_trajectory(
    points: Sequence[Point],
    limits: Limits,
    q_now: Sequence[float],
    *,
    period_s: float = 0.0005,
    names: Sequence[str] = (),
    zone_at: ZoneAt | None = None,
) -> Plan:
    """Return the plan of a trajectory for `TrajectoryMode`.

    Points with positions only are joined by quintics that have the velocities and accelerations of the cubic spline;
    with velocities too by cubics; with accelerations too by quintics. It begins (time 0: there; later: led there) and
    ends at rest.

    Args:
        points: at least one, at most `MOST_POINTS`, times rising by 1 ms at least.
        limits: position, velocity and acceleration of every joint, kept over the whole of each piece: the extremes of its
            polynomials are looked at, no samples.
        q_now: where the arm is commanded, at rest, rad, shape (n,).
        period_s: the cycle, s.
        names: of the joints, for the sentences.
        zone_at: looked at every `ZONE_STEP_RAD` of any joint's way.

    Raises:
        PlanRefused: with the point, the joint, what was found and what is allowed.
    """
    joints = len(q_now)
    names = list(names) or [f"joint{i + 1}" for i in range(joints)]
    _check_points(points, names, q_now)
    knots = _knots(points, q_now)
    lead_s = 0.0
    if points[0].t > 0.0:
        lead_s = check_lead(knots[0], limits, q_now, names)
    for index in range(1, len(knots)):
        check_piece(knots[index - 1], knots[index], index, limits, names)
    if zone_at is not None:
        _check_zones(knots, zone_at)
    del period_s
    late = max(lead_s - points[0].t, 0.0)
    rows = tuple(_row(knot) for knot in knots)
    return Plan(rows, points[-1].t + late, 0.0, 1.0, points[-1].q)
