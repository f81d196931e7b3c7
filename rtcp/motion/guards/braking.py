"""The guard's own stop: its length, and whether it touches a box, a cone or the arm itself.

From the mean speeds w of a cycle, each joint's speed falls by u = a dt per cycle; a rest below u falls to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, sqrt
from typing import Final

from kinematics.forward import frames
from kinematics.pose import Pose
from rtcp.motion.guards.zones import INNER_BOX, ITSELF, Gap, Zones, is_cone

_MOST_SAMPLES: Final = 16
"""Upper bound on the samples of a stop, for lack of time in a cycle; a stop that needs more counts as touching."""
_ROUNDING_M: Final = 1e-12
_INSIDE_SAMPLES: Final = 8


def fastest_stoppable(stopping_distance: float, u: float, dt: float) -> float:
    """Return the greatest mean speed of a cycle after which the stop ends within `stopping_distance`.

    With n = floor(w / u) the cycle and its stop travel ((n + 1) w - u n (n + 1) / 2) dt, solved for w.

    Args:
        stopping_distance: rad; below 0 counts as 0.
        u: decrease of the speed per cycle, rad/s.
        dt: cycle time, s.
    """
    if stopping_distance <= 0.0:
        return 0.0
    n = int(0.5 * (sqrt(1.0 + 8.0 * stopping_distance / (u * dt)) - 1.0))
    return stopping_distance / ((n + 1) * dt) + 0.5 * n * u


def travel(
    mean: Sequence[float], acceleration: Sequence[float], reach: Sequence[float], dt: float
) -> tuple[float, float]:
    """Return the upper bound on the motion of a point, m, in a cycle at these mean speeds, and including its stop."""
    step = stop = 0.0
    for i, w in enumerate(mean):
        if w:
            speed = w if w > 0.0 else -w
            swept = speed * reach[i]
            step += swept
            stop += swept * speed / acceleration[i]
    step *= dt
    return step, step + 0.5 * stop


def touched(
    zones: Zones,
    before: Sequence[Pose],
    poses: Sequence[Pose],
    q: Sequence[float],
    mean: Sequence[float],
    acceleration: Sequence[float],
    dt: float,
) -> tuple[int, float] | None:
    """Return the box, cone or pair that a cycle and its stop would touch, with a signed distance (m), or None.

    Between two samples a point is no farther from its chord than `_Stop.bend`: bodies do not touch if a plane separates
    them at both ends with that margin. Overlapping bodies may only move apart. In a single cycle that moves by less
    than the bodies' thickness moving apart is enough: in between they approach by no more than a cycle's bend.

    Args:
        zones: the boxes and the arm.
        before: `frames` of the commanded position.
        poses: `frames` of `q`.
        q: next setpoint, rad.
        mean: mean speeds of the cycle to `q`, rad/s.
        acceleration: of each joint, rad/s^2.
        dt: cycle time, s.
    """
    step, whole = travel(mean, acceleration, zones.reach, dt)
    pair_step, pair_whole = travel(mean, acceleration, zones.pair_reach, dt)
    gaps = zones.gaps(before, whole, pair_whole)
    if not gaps:
        return None
    stop = _Stop(q, mean, acceleration, zones, dt)
    gaps, bad = _next(zones, gaps, poses, stop.bend(dt), step, pair_step, True)
    if bad is not None:
        return bad.zone, bad.distance
    time, length = 0.0, 0.0
    remaining, pair_remaining = stop.remaining(0.0)
    for _ in range(_MOST_SAMPLES):
        if time >= stop.duration or _beyond(gaps, remaining, pair_remaining):
            return None
        length = min(length or stop.stride(gaps), stop.duration - time)
        once = length < 1.5 * dt
        ahead, pair_ahead = stop.remaining(time + length)
        there = frames(zones.model, stop.at(time + length))
        after, bad = _next(zones, gaps, there, stop.bend(length), remaining - ahead, pair_remaining - pair_ahead, once)
        if bad is None:
            gaps, time, remaining, pair_remaining, length = after, time + length, ahead, pair_ahead, 0.0
        elif once or bad.distance < 0.0:
            return bad.zone, bad.distance
        else:
            length = max(int(0.5 * length / dt), 1) * dt
    nearest = min(gaps)
    return nearest.zone, nearest.distance


def _beyond(gaps: Sequence[Gap], remaining: float, pair_remaining: float) -> bool:
    """Return whether all gaps exceed the remaining travel."""
    return all([gap.distance > gap.share * (remaining if gap.zone < ITSELF else pair_remaining) for gap in gaps])  # noqa: C419 no generator


def _next(
    zones: Zones,
    gaps: Sequence[Gap],
    poses: Sequence[Pose],
    bend: float,
    length: float,
    pair_length: float,
    once: bool,
) -> tuple[list[Gap], Gap | None]:
    """Return the gaps at the next sample, at most `length` (m) further, and the first that is not free.

    If all are free, `zones.before` has the bodies at that sample.
    """
    after: list[Gap] = []
    zones.after.place(poses)
    for gap in gaps:
        near = gap.distance
        distance = zones.remeasure(gap, poses)
        new = Gap(distance, gap.zone, gap.body, gap.share, gap.bend)
        bent = gap.bend * bend
        if is_cone(gap.zone):
            near, distance = zones.depth(gap.zone, near), zones.depth(gap.zone, distance)
        if gap.zone == INNER_BOX or is_cone(gap.zone):
            free, out, slow = near >= bent and distance >= bent, True, near < bent
        else:
            moved = gap.share * (length if gap.zone < ITSELF else pair_length)
            free = near + distance > moved or zones.parted(gap, bent)
            # Nor may a thin body have passed through: a body outside stays on its side.
            slow = moved < zones.thickness(gap)
            out = free or near < -_ROUNDING_M or slow or zones.parted(gap, -_ROUNDING_M)
            slow = slow or near < bent
        if not free and not (out and distance >= near - _ROUNDING_M and (near < 0.0 or (once and slow))):
            return after, new
        after.append(new)
    zones.swap()
    return after, None


class _Stop:
    """A stop from `q` (rad) with the mean speeds `mean` (rad/s); times in s from its start."""

    def __init__(
        self,
        q: Sequence[float],
        mean: Sequence[float],
        acceleration: Sequence[float],
        zones: Zones,
        dt: float,
    ) -> None:
        self._dt = dt
        self._q = q
        self._zones = zones
        self._moving = []
        self.duration = bound = speeds = swept = 0.0
        for i, w in enumerate(mean):
            if w:
                speed, rate = abs(w), acceleration[i]
                ends = int(speed / (rate * dt)) * dt
                reach = zones.reach[i]
                self._moving.append((i, speed, 1.0 if w > 0.0 else -1.0, rate, ends, reach, zones.pair_reach[i]))
                self.duration = max(self.duration, ends)
                bound += rate * reach
                speeds += speed
                swept += speed * reach
        self._bound = bound + speeds * swept
        """Upper bound on the second derivative of any point, m/s^2."""

    def at(self, time: float) -> list[float]:
        """Return the joint positions, rad."""
        q, dt = list(self._q), self._dt
        for i, speed, sign, rate, ends, _, _ in self._moving:
            t = time if time < ends else ends
            q[i] += sign * (speed - 0.5 * rate * (t + dt)) * t
        return q

    def remaining(self, time: float) -> tuple[float, float]:
        """Return upper bounds on the remaining motion of any point and change of a pair's distance, m."""
        remaining, pair_remaining, dt = 0.0, 0.0, self._dt
        for _, speed, _, rate, ends, reach, pair_reach in self._moving:
            if time < ends:
                angle = (speed - 0.5 * rate * (ends + dt)) * ends - (speed - 0.5 * rate * (time + dt)) * time
                remaining += reach * angle
                pair_remaining += pair_reach * angle
        return remaining, pair_remaining

    def bend(self, length: float) -> float:
        """Return the upper bound on a point's distance from its chord over `length` s, m.

        Includes the speed step of up to u / 2 of a joint that comes to rest: u length / 8.
        """
        return 0.125 * self._bound * length * (length + self._dt)

    def stride(self, gaps: Sequence[Gap]) -> float:
        """Return the time to the next sample, s: whole cycles in which no point bends by half of its distance."""
        dt, least, most = self._dt, inf, self.duration
        for gap in gaps:
            if gap.distance < 0.0:
                most = self.duration / _INSIDE_SAMPLES
            else:
                depth = self._zones.depth(gap.zone, gap.distance) if is_cone(gap.zone) else gap.distance
                least = min(least, depth / gap.bend)
        # A bound of 0: the moving joints' axes go through the tool, and no point moves.
        if least < inf and self._bound > 0.0:
            most = min(most, sqrt(0.25 * dt * dt + 4.0 * least / self._bound) - 0.5 * dt)
        return max(int(most / dt), 1) * dt
