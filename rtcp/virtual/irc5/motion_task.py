"""RAPID's motion task of a unit, in simulated time: MoveAbsJ instructions run ahead of the motion. Degrees and s.

The program queues moves and blocks while the queue is full; the planner joins them with corner zones. The rate of the
path time is 1 at the programmed speed and ramps to 0 at stop points and stops.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from rtcp.virtual.irc5.config import RapidConfig
from rtcp.virtual.irc5.mechanical_unit import HAND_SPEED, MechanicalUnit
from rtcp.virtual.irc5.panel import STOPPING_TIME_S, Mode, Motors, Panel

SHORTEST_MOVE_S = 0.01
"""Lower bound on durations."""
AT_START = 0.1
"""Distance from the arm within which the first point of a path is skipped, degrees."""


class Move(NamedTuple):
    """A MoveAbsJ with `\\T`."""

    target: tuple[float, ...]
    duration: float
    fine: bool = False
    """True: it ends at rest, and RAPID waits for that; False: in a zone."""


class _Planned(NamedTuple):
    """A move from the end of the previous one, at constant speed."""

    start: Sequence[float]
    velocity: tuple[float, ...]
    duration: float
    """Programmed duration, or longer if a joint would be too fast."""
    zone: float
    """Time from its zone to its end, s: at most half the duration."""
    move: Move


class MotionTask:
    """`execute` passes moves to the program, `step` advances by one period."""

    def __init__(self, unit: MechanicalUnit, panel: Panel, config: RapidConfig) -> None:
        self.unit = unit
        self.queue: deque[Move] = deque()
        """Moves known to the planner and not begun."""
        self.stopping = False
        """True during StopMove: the queue is cleared at rest."""
        self.lost = False
        """True: a fault stops the arm and its task."""
        self._panel = panel
        self._config = config
        self._program: deque[Move] = deque()
        """Moves not reached by the program, because of a full queue or a pending fine point."""
        self._current: _Planned | None = None
        self._next: _Planned | None = None
        """The next move, joined to the current one by a corner of `_exit`."""
        self._stop_point = False
        """True: the current move ends at rest."""
        self._entry_velocity: tuple[float, ...] = ()
        self._entry = self._exit = 0.0
        """Half the duration of the corner at the start and at the end, s; 0: none."""
        self._time = self._rate = self._look_ahead_s = 0.0
        longest = unit.config.dead_time_s + config.position_delay_s[1]
        self._history: deque[tuple[float, ...]] = deque(maxlen=math.ceil(longest / unit.config.period_s) + 2)
        self._history.append(tuple(unit.planned))

    @property
    def runs(self) -> bool:
        """Whether the program is executed."""
        return self.unit.rapid_running and self._panel.motors is Motors.ON and not self.lost

    @property
    def is_ready(self) -> bool:
        """Whether the program waits for a point: the queue has room, and no fine point is pending."""
        fine = (self._current is not None and self._current.move.fine) or any(move.fine for move in self.queue)
        room = len(self.queue) < self._config.queue_moves
        return self.runs and room and not (self.stopping or self._program or fine)

    @property
    def moves_ahead(self) -> int:
        """Number of accepted, unfinished moves."""
        return len(self._program) + len(self.queue) + (self._current is not None)

    def execute(self, moves: Sequence[Move]) -> None:
        """Run these instructions; a target outside the joint ranges stops this unit's RAPID."""
        for move in moves:
            for i, (position, (low, high)) in enumerate(zip(move.target, self.unit.ranges, strict=True)):
                if not low <= position <= high:
                    allowed = f"allowed are {low:g} to {high:g}"
                    self.unit.fail(f"50027 joint out of range: joint {i + 1} to {position:g}, {allowed}")
                    return
        at_start = len(moves) > 1 and math.dist(moves[0].target, self.unit.planned) <= AT_START
        self._program.extend(moves[1:] if at_start else moves)

    def stop(self) -> None:
        """StopMove, ClearPath, StartMove."""
        self.stopping = True

    def step(self, dt: float) -> None:
        """Advance by one period."""
        while self._program and len(self.queue) < self._config.queue_moves:
            self.queue.append(self._program.popleft())
        if self._current is None and self.queue and self.runs and not self.stopping:
            self._look_ahead_s += dt
            if self._look_ahead_s >= self._config.start_delay_s or len(self.queue) >= self._config.queue_moves:
                self._current = self._plan(self.unit.planned, self.queue.popleft())
        if self._current is not None:
            self._advance(self._current, dt)
        if self.stopping and self._rate == 0.0:
            self._program.clear()
            self.queue.clear()
            self._end_path()
            self.stopping = False
        self.unit.follow(self.unit.planned if self._current is None else self._position(self._current, self._time), dt)
        self._history.append(tuple(self.unit.planned))

    def reported(self, delay_s: float) -> list[float]:
        """Return the joints of CJointT: the actual ones `delay_s` ago."""
        back = min((self.unit.config.dead_time_s + delay_s) / self.unit.config.period_s, len(self._history) - 1.0)
        older, share = math.ceil(back), math.ceil(back) - back
        rows = self._history[-1 - older], self._history[-max(older, 1)]
        return [old + share * (new - old) for old, new in zip(*rows, strict=True)]

    def _plan(self, start: Sequence[float], move: Move) -> _Planned:
        deltas = [there - here for here, there in zip(start, move.target, strict=True)]
        duration = max(move.duration, SHORTEST_MOVE_S)
        for delta, limit in zip(deltas, self.unit.speed_limits, strict=True):
            duration = max(duration, abs(delta) / limit)
        flange = self.unit.geometry.flange
        length = math.dist(flange(start).position, flange(move.target).position)
        share = 0.5 if length * 0.5 <= self._config.zone_mm else self._config.zone_mm / length
        return _Planned(tuple(start), tuple(delta / duration for delta in deltas), duration, share * duration, move)

    def _advance(self, current: _Planned, dt: float) -> None:
        ramp = min(self._config.ramp_s, current.duration)
        if self.runs and not self.stopping:
            self._rate = min(1.0, self._rate + dt / ramp)
        else:
            self._rate = max(0.0, self._rate - dt / self._stopping_time())
        remaining = current.duration - self._time
        # A stop needs half the ramp in path time: the latest time for the next move to arrive.
        if self._next is None and not self._stop_point and remaining - self._rate * dt <= max(current.zone, ramp / 2.0):
            self._end_of(current)
        if self._stop_point:
            self._rate = min(self._rate, math.sqrt(2.0 * remaining / ramp))
        if self._panel.mode is Mode.HAND:
            self._rate = min(self._rate, self._hand_rate(current, dt))
        self._time += self._rate * dt
        if self._time < current.duration:
            return
        if self._next is None:
            self.unit.planned = list(current.move.target)
            self._end_path()
        else:
            self._time -= current.duration
            self._entry, self._entry_velocity = self._exit, current.velocity
            self._current, self._next = self._next, None
            self.queue.popleft()

    def _end_of(self, current: _Planned) -> None:
        """Decide the end of a move: in the corner to the next one, or at rest without one."""
        if self.queue and not current.move.fine:
            self._next = self._plan(current.move.target, self.queue[0])
            self._exit = min(current.zone, self._next.zone)
            return
        self._stop_point = True
        if not current.move.fine:
            self.unit.counts["corner_path_failure"] += 1
            self.unit.events.append("50024 corner path failure: no next move in time, a stop point")

    def _end_path(self) -> None:
        self._current = self._next = None
        self._stop_point = False
        self._entry = self._time = self._rate = self._look_ahead_s = 0.0

    def _stopping_time(self) -> float:
        if self.lost:
            return STOPPING_TIME_S[0]
        return self._config.ramp_s if self._panel.motors is Motors.ON else STOPPING_TIME_S[self._panel.category]

    def _hand_rate(self, current: _Planned, dt: float) -> float:
        flange = self.unit.geometry.flange
        here = flange(self._position(current, self._time)).position
        span = min(dt, current.duration - self._time)
        distance = math.dist(here, flange(self._position(current, self._time + span)).position)
        return 1.0 if distance == 0.0 else HAND_SPEED * span / distance

    def _position(self, current: _Planned, time: float) -> list[float]:
        if time < self._entry:
            return _corner(current.start, self._entry_velocity, current.velocity, self._entry, time)
        remaining = current.duration - time
        if self._next is not None and remaining < self._exit:
            return _corner(current.move.target, current.velocity, self._next.velocity, self._exit, -remaining)
        return [start + speed * time for start, speed in zip(current.start, current.velocity, strict=True)]


def _corner(
    point: Sequence[float], before: Sequence[float], after: Sequence[float], half: float, time: float
) -> list[float]:
    """Return the position at `time`, -half to half around a point, at constant acceleration between two speeds."""
    share = (time + half) ** 2 / (4.0 * half)
    return [p + v * time + (w - v) * share for p, v, w in zip(point, before, after, strict=True)]
