"""The guard's own stop: how far it can carry the arm, and whether it touches a box or the arm itself.

From the mean speeds w of a cycle on, each joint's speed falls by u = a dt a cycle; where less than u is left, to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, sqrt
from typing import Final

from kinematics.forward import frames
from kinematics.pose import Pose
from rtcp.motion.guards.zones import INNER_BOX, ITSELF, Gap, Zones

_MOST_SAMPLES: Final = 16
"""A way that needs more, beside a box at full speed, counts as touching it: a cycle has no time for all of them."""
_ROUNDING_M: Final = 1e-12
_INSIDE_SAMPLES: Final = 8


def fastest_stoppable(stopping_distance: float, u: float, dt: float) -> float:
    """Return the greatest mean speed of a cycle after which the stop ends within `stopping_distance`.

    With n = floor(w / u) the cycle and its stop travel ((n + 1) w - u n (n + 1) / 2) dt, which is solved for w.

    Args:
        stopping_distance: rad; nothing is left of it below 0.
        u: what the speed falls by in a cycle, rad/s.
        dt: the cycle, s.
    """
    if stopping_distance <= 0.0:
        return 0.0
    n = int(0.5 * (sqrt(1.0 + 8.0 * stopping_distance / (u * dt)) - 1.0))
    return stopping_distance / ((n + 1) * dt) + 0.5 * n * u


def travel(
    mean: Sequence[float], acceleration: Sequence[float], reach: Sequence[float], dt: float
) -> tuple[float, float]:
    """Return how far what has this reach moves at most, m: in a cycle with these mean speeds, and with its stop."""
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
    """Return the box or pair (`zones`) that a cycle and its stop would touch, with a signed distance (m), or None.

    Between two samples a point is no farther from its chord than `_Stop.bend`: bodies that a plane parts with so much
    to spare, at both ends, do not touch. What overlaps may only come apart. In one cycle, of less than the bodies'
    thickness, it is enough that they come apart: what may lie between is no more than a cycle's bend.

    Args:
        zones: the boxes and the arm.
        before: `frames` of what is commanded now.
        poses: `frames` of `q`.
        q: what is to be commanded, rad.
        mean: mean speeds of the cycle that leads there, rad/s.
        acceleration: of each joint, rad/s^2.
        dt: the cycle, s.
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
    left, pair_left = stop.left(0.0)
    for _ in range(_MOST_SAMPLES):
        if time >= stop.duration or _beyond(gaps, left, pair_left):
            return None
        length = min(length or stop.stride(gaps), stop.duration - time)
        once = length < 1.5 * dt
        ahead, pair_ahead = stop.left(time + length)
        there = frames(zones.model, stop.at(time + length))
        after, bad = _next(zones, gaps, there, stop.bend(length), left - ahead, pair_left - pair_ahead, once)
        if bad is None:
            gaps, time, left, pair_left, length = after, time + length, ahead, pair_ahead, 0.0
        elif once or bad.distance < 0.0:
            return bad.zone, bad.distance
        else:
            length = max(int(0.5 * length / dt), 1) * dt
    nearest = min(gaps)
    return nearest.zone, nearest.distance


def _beyond(gaps: Sequence[Gap], left: float, pair_left: float) -> bool:
    """Return whether all gaps are wider than what is left to travel."""
    return all([gap.distance > gap.share * (left if gap.zone < ITSELF else pair_left) for gap in gaps])  # noqa: C419 no generator


def _next(
    zones: Zones,
    gaps: Sequence[Gap],
    poses: Sequence[Pose],
    bend: float,
    length: float,
    pair_length: float,
    once: bool,
) -> tuple[list[Gap], Gap | None]:
    """Return the gaps at the next sample, at most `length` (m) along the way, and the first that is not free.

    Where all are free the bodies there are `zones.before`.
    """
    after: list[Gap] = []
    zones.after.place(poses)
    for gap in gaps:
        near = gap.distance
        distance = zones.remeasure(gap, poses)
        new = Gap(distance, gap.zone, gap.body, gap.share, gap.bend)
        bent = gap.bend * bend
        if gap.zone == INNER_BOX:
            free, out, slow = near >= bend and distance >= bend, True, near < bent
        else:
            moved = gap.share * (length if gap.zone < ITSELF else pair_length)
            free = near + distance > moved or zones.parted(gap, bent)
            # Nor is it apart that something thin lies between: what was outside stays on the same side.
            slow = moved < zones.thickness(gap)
            out = free or near < -_ROUNDING_M or slow or zones.parted(gap, -_ROUNDING_M)
            slow = slow or near < bent
        if not free and not (out and distance >= near - _ROUNDING_M and (near < 0.0 or (once and slow))):
            return after, new
        after.append(new)
    zones.swap()
    return after, None


class _Stop:
    """The way of a stop from `q` (rad) with the mean speeds `mean` (rad/s); times from its beginning, s."""

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
        """No point's second derivative is greater, m/s^2."""

    def at(self, time: float) -> list[float]:
        """Return where the joints are."""
        q, dt = list(self._q), self._dt
        for i, speed, sign, rate, ends, _, _ in self._moving:
            t = time if time < ends else ends
            q[i] += sign * (speed - 0.5 * rate * (t + dt)) * t
        return q

    def left(self, time: float) -> tuple[float, float]:
        """Return how far any point still moves at most, and by how much a pair's distance still changes, m."""
        left, pair_left, dt = 0.0, 0.0, self._dt
        for _, speed, _, rate, ends, reach, pair_reach in self._moving:
            if time < ends:
                angle = (speed - 0.5 * rate * (ends + dt)) * ends - (speed - 0.5 * rate * (time + dt)) * time
                left += reach * angle
                pair_left += pair_reach * angle
        return left, pair_left

    def bend(self, length: float) -> float:
        """Return how far a point is from the chord of a piece so long (s) at most, m.

        A speed that jumps by up to u / 2 where a joint comes to rest counts as well: u length / 8.
        """
        return 0.125 * self._bound * length * (length + self._dt)

    def stride(self, gaps: Sequence[Gap]) -> float:
        """Return how far to go to the next sample, s: whole cycles, in which no point bends by half of its distance."""
        dt, least, most = self._dt, inf, self.duration
        for gap in gaps:
            if gap.distance < 0.0:
                most = self.duration / _INSIDE_SAMPLES
            else:
                least = min(least, gap.distance / gap.bend)
        # A joint whose axis goes through the tool moves no point: nothing bends.
        if least < inf and self._bound > 0.0:
            most = min(most, sqrt(0.25 * dt * dt + 4.0 * least / self._bound) - 0.5 * dt)
        return max(int(most / dt), 1) * dt
