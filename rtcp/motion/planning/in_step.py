"""Plans of motions in step: paths of several arms over one time, and the braking time of the group at each point.

Braking takes the rate u of the path time from 1 to 0 within T along 1 - 3 x^2 + 2 x^3, x = t / T. A joint with the path
p(s) then has the acceleration p'' u^2 + p' du/dt. T is the shortest time that every joint of every arm can follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from math import ceil
from typing import Final

import numpy as np
import numpy.typing as npt
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from kinematics.model import JOINTS
from rtcp.config.model import Point
from rtcp.motion.controllers.in_step import LONGEST_BRAKE_S
from rtcp.motion.guards.neighbours import Body, certain
from rtcp.motion.joint_motion import find_trajectory
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import cubic, quintic
from rtcp.motion.planning.plan import (
    ACCELERATIONS,
    CUBIC,
    KIND,
    LONGEST_S,
    POSITIONS,
    VELOCITIES,
    PlanRefused,
    PlanTooFast,
)
from rtcp.motion.planning.trajectories import SHORTEST_S

SPEED_SHARE: Final = 0.93
"""Shares of a joint's speed and acceleration limits for a motion in step: a late arm needs the rest to catch up, and
braking takes more while the path itself slows down."""
ACCELERATION_SHARE: Final = 0.7
_MOST_SPEED, _MOST_ACCELERATION = 0.95, 0.88
"""Upper bounds for plans made elsewhere, as shares of the limits: times 1.05, and its square, they are within them."""
_BRAKE_SHARE: Final = 0.88
"""Share of the limits for the braking curve, which arms may follow more steeply (`rtcp.motion.controllers.in_step`)."""
_SAMPLE_S: Final = 0.02
_MOST_SAMPLES: Final = 1000
_LONGEST_IN_STEP_S: Final = 3600.0
_MOST_BRAKES: Final = 500
_SHORTEST_S, _LONGEST_S, _RATIO = 0.04, LONGEST_BRAKE_S, 1.08
_SHAPE: Final = np.linspace(0.0, 1.0, 33)
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Way:
    """The move of one arm: its limits, start and target, rad."""

    limits: Limits
    q_now: Sequence[float]
    q: Sequence[float]


@dataclass(frozen=True)
class Brakes:
    """Braking time of the group, s, at every `step_s` of the path."""

    step_s: float
    times: tuple[float, ...]


def plan_moves(moves: Mapping[str, Way], speed: float | None) -> dict[str, tuple[Point, ...]]:
    """Return the points of a synchronized joint move of several arms.

    Args:
        moves: by the names of the arms.
        speed: of the fastest joint, rad/s; None: the limits.

    Raises:
        PlanRefused: a target is outside a limit, or no motion is found.
    """
    for name, move in moves.items():
        if len(move.q) != len(move.q_now):
            raise PlanRefused(f"{name}: found {len(move.q)} joint positions, allowed are {len(move.q_now)}")
        for i, wanted in enumerate(move.q):
            least, most = move.limits.low[i], move.limits.high[i]
            if not least <= wanted <= most:
                raise PlanRefused(
                    f"{name}: joint {i + 1}: found {wanted:.6g} rad, allowed is {least:.6g} to {most:.6g} rad"
                )
    if speed is not None and not speed > 0.0:
        raise PlanRefused(f"speed: found {speed:g} rad/s, allowed is a number greater than 0")
    begin = [q for move in moves.values() for q in move.q_now]
    fastest = [v * SPEED_SHARE for move in moves.values() for v in move.limits.velocity]
    joints = len(begin)
    otg, inp, trajectory = Ruckig(joints, 0.001), InputParameter(joints), Trajectory(joints)
    inp.current_position, inp.target_position = begin, [q for move in moves.values() for q in move.q]
    inp.max_velocity = fastest if speed is None else [min(v, speed) for v in fastest]
    inp.max_acceleration = [a * ACCELERATION_SHARE for move in moves.values() for a in move.limits.acceleration]
    inp.synchronization = Synchronization.Phase
    if not find_trajectory(otg, inp, [jerk for move in moves.values() for jerk in move.limits.jerk], trajectory):
        raise PlanRefused("no motion of all joints is found: choose another speed or target")
    duration = trajectory.duration
    if duration > LONGEST_S:
        raise PlanRefused(f"the motion would take {duration:g} s, allowed are {LONGEST_S:g} s: choose a higher speed")
    count = min(max(ceil(duration / _SAMPLE_S), 1), _MOST_SAMPLES)
    samples = [(duration * k / count, trajectory.at_time(duration * k / count)) for k in range(count + 1)]
    if duration < SHORTEST_S:  # all arms are at their targets
        samples = [(0.0, samples[0][1]), (_SAMPLE_S, samples[-1][1])]
    points, at = {}, 0
    for name, move in moves.items():
        end = at + len(move.q)
        low, high = move.limits.low, move.limits.high
        points[name] = tuple(
            # The generator's sums may exceed a range by rounding.
            Point(t, tuple(map(_clamp, q[at:end], low, high)), tuple(v[at:end]), tuple(a[at:end]))
            for t, (q, v, a) in samples
        )
        at = end
    return points


def check_apart(
    paths: Mapping[str, Curve],
    bodies: Mapping[str, Body],
    rests: Mapping[str, Sequence[float]],
    clearance: float,
    delay_s: float,
) -> None:
    """Check the clearance between any two arms along the whole motion, as the guards in the loops will.

    Args:
        paths: of the arms that move.
        bodies: of all arms of the cell whose geometry is known.
        rests: positions of the arms that do not move, rad.
        clearance: required distance, m.
        delay_s: time before an arm stops with its partner.

    Raises:
        PlanRefused: with the arms that would come too near, and the time.
    """
    duration = max(path.duration_s for path in paths.values())
    if duration > _LONGEST_IN_STEP_S:
        raise PlanRefused(
            f"the motion would take {duration:g} s, in step {_LONGEST_IN_STEP_S:g} s are allowed: choose a higher speed"
        )
    count = ceil(duration / _SAMPLE_S) + 1
    times: Array = _SAMPLE_S * np.arange(count, dtype=np.float64)
    ways: dict[str, tuple[Array, Array]] = {name: path.at(times)[:2] for name, path in paths.items()}
    for name, q in rests.items():
        ways[name] = (np.tile(np.asarray(q, dtype=np.float64), (count, 1)), np.zeros((count, len(q))))
    for a, b in combinations([name for name in bodies if name in ways], 2):
        if a not in paths and b not in paths:
            continue
        first, second = bodies[a], bodies[b]
        (qs, vs), (ps, ws) = ways[a], ways[b]
        moved = _moved(first, qs) + _moved(second, ps)
        stops = _stops(first, vs, delay_s) + _stops(second, ws, delay_s)
        between = 0.5 * np.diff(moved, append=moved[-1])
        k = 0
        while k < count:
            kept, here, _ = certain(
                first, qs[k].tolist(), vs[k].tolist(), second, ps[k].tolist(), ws[k].tolist(), (delay_s, delay_s)
            )
            if kept - between[k] <= clearance:
                raise PlanRefused(
                    f"after {times[k]:.2f} s the bodies of {a} and {b} would be {max(here, 0.0):.3f} m apart; with "
                    f"their stops they could come nearer than {clearance:g} m: choose another way, or move more slowly"
                )
            # Skip to the first sample at which the motion since, and the stops, may have used up the distance.
            later = slice(k + 1, k + 1 + _MOST_SAMPLES)
            near = here - (moved[later] - moved[k]) - stops[later] - between[later] <= clearance
            k += 1 + (int(np.argmax(near)) if near.any() else len(near))


def _moved(body: Body, q: Array) -> Array:
    """Return at each row the upper bound on a point's motion since the first row, m."""
    steps = np.abs(np.diff(q[:, :JOINTS], axis=0)) @ np.array(body.reach)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _stops(body: Body, velocity: Array, delay_s: float) -> Array:
    """Return `Body.travel` at each row of joint velocities, m."""
    speed = np.abs(velocity[:, :JOINTS])
    travelled: Array = (speed * (delay_s + 0.5 * speed / np.array(body.acceleration[:JOINTS]))) @ np.array(body.reach)
    return travelled


def _clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


class Curve:
    """The path of an arm from the rows of its plan, evaluated at many times at once.

    Args:
        rows: of the plan (`rtcp.motion.planning.plan`); the first at time 0.
        joints: of the arm.
    """

    def __init__(self, rows: Sequence[Sequence[float]], joints: int) -> None:
        self._times = np.array([row[0] for row in rows])
        pieces = []
        for before, after in pairwise(rows):
            length, numbers = after[0] - before[0], []
            for i in range(joints):
                ends = [(r[POSITIONS + i], r[VELOCITIES + i], r[ACCELERATIONS + i]) for r in (before, after)]
                (q, v, a), (to_q, to_v, to_a) = ends
                numbers.append(
                    cubic(q, v, to_q, to_v, length)
                    if after[KIND] == CUBIC
                    else quintic(q, v, a, to_q, to_v, to_a, length)
                )
            pieces.append(numbers)
        last = [[rows[-1][POSITIONS + i], 0.0, 0.0, 0.0, 0.0, 0.0] for i in range(joints)]
        self._pieces = np.array([*pieces, last])
        self._lengths = np.append(np.diff(self._times), 1.0)
        self.duration_s = float(self._times[-1])

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return position, first and second derivative by s, shape (*s.shape, joints); at rest beyond the end."""
        index = np.clip(np.searchsorted(self._times, s, side="right") - 1, 0, len(self._pieces) - 1)
        length = self._lengths[index][..., None]
        x = np.clip((s - self._times[index]) / self._lengths[index], 0.0, 1.0)[..., None]
        c0, c1, c2, c3, c4, c5 = np.moveaxis(self._pieces[index], -1, 0)
        position = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
        first = (c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) / length
        second = (2.0 * c2 + x * (6.0 * c3 + x * (12.0 * c4 + x * 20.0 * c5))) / length**2
        return position, first, second


def plan_brakes(paths: Mapping[str, Curve], limits: Mapping[str, Limits]) -> Brakes:
    """Return the braking time of the group at each point of its paths.

    Raises:
        PlanTooFast: the paths leave no room to brake, or none to catch up.
    """
    duration = max(path.duration_s for path in paths.values())
    step = max(_SAMPLE_S, duration / _MOST_BRAKES)
    begin: Array = step * np.arange(ceil(duration / step) + 1, dtype=np.float64)
    times = np.full(len(begin), np.inf)
    floor = np.full(len(begin), _SHORTEST_S)
    for name, path in paths.items():
        _, speed, change = path.at(begin)
        steepest = np.abs(change) / np.array(limits[name].acceleration)
        if steepest.max() > _MOST_ACCELERATION:
            raise PlanTooFast(
                f"{name}: joint {int(steepest.max(axis=0).argmax()) + 1} would take {steepest.max():.2f} of its "
                f"largest acceleration, in step {_MOST_ACCELERATION:g} are allowed: give the motion more time"
            )
        ratio = np.abs(speed) / np.array(limits[name].velocity)
        if ratio.max() > _MOST_SPEED:
            raise PlanTooFast(
                f"{name}: joint {int(ratio.max(axis=0).argmax()) + 1} would move at {ratio.max():.2f} of its largest "
                f"speed, in step {_MOST_SPEED:g} are allowed: give the motion more time"
            )
        floor = np.maximum(floor, np.sqrt(6.0 * (np.abs(speed) / np.array(limits[name].jerk)).max(axis=1)))
    x = _SHAPE
    passed, u, slope = x * (1.0 + x * x * (0.5 * x - 1.0)), 1.0 + x * x * (2.0 * x - 3.0), 6.0 * x * (x - 1.0)
    last = _SHORTEST_S
    while last < _LONGEST_S and (open_ := np.flatnonzero(np.isinf(times))).size:
        rows = open_[floor[open_] <= last]
        fits = np.ones(len(rows), dtype=bool)
        for name, path in paths.items():
            if not len(rows):
                break
            _, first, second = path.at(begin[rows][:, None] + last * passed)
            acceleration = second * (u * u)[None, :, None] + first * (slope / last)[None, :, None]
            bound = _BRAKE_SHARE * np.array(limits[name].acceleration)
            fits &= (np.abs(acceleration) <= bound).all(axis=(1, 2))
        times[rows[fits]] = last
        last *= _RATIO
    if np.isinf(times).any():
        at = float(begin[np.isinf(times)][0])
        raise PlanTooFast(
            f"at {at:.2f} s the arms could not brake together on their paths: the accelerations there are too near to "
            f"the limits; give the motion more time"
        )
    return Brakes(step, tuple(float(duration) for duration in times))
