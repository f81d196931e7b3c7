"""Executes the orders of a motion client on the arm: each at once, the newest replaces the present motion."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence

from rtcp.api import RtcpError
from rtcp.fieldbus.simple_message.messages import Joints
from rtcp.ros.simple_message import sequence
from rtcp.ros.simple_message.arm import Arm, OpenTrajectory, Point

LEAD_S = 0.2
"""Motion buffered before a streamed trajectory begins, s: the client sends 130 to 180 points/s at most."""
QUIET_S = 0.1
"""Time without a point after which it begins earlier, s: a short trajectory may have no end mark."""
_TARGETS_UNDER_WAY = 2
"""Most pending calls of real-time points: the present one and the one that replaces it."""
log = logging.getLogger(__name__)


class _Stream:
    """Points of a streamed trajectory that were not yet sent to the arm."""

    def __init__(self, series: int) -> None:
        self.series = series
        self.points: list[Point] = []
        self.begin = 0.0
        """Client time of the last standstill, s, from which the times of points count."""
        self.is_finished = False
        self.is_running = False
        self.changed = asyncio.Event()
        """Set when a point or the last one was received, or the arm has run out of points."""

    def add(self, point: Point) -> None:
        """Append a point."""
        if len(self.points) == sequence.BUFFER_POINTS:
            raise sequence.PointRefused(f"the buffer is full: {sequence.BUFFER_POINTS} points wait to be executed")
        self.points.append(point)
        self.changed.set()

    def take(self) -> list[Point]:
        """Remove and return all points, with times from `begin`."""
        points = [point._replace(time=point.time - self.begin) for point in self.points]
        self.points.clear()
        return points

    async def buffered(self) -> None:
        """Return when `LEAD_S` of motion is buffered, or no point has come for `QUIET_S`."""
        while not self.is_finished:
            self.changed.clear()
            span = self.points[-1].time - self.begin
            if span >= LEAD_S:
                return
            try:
                # A single first point at the arm's position is not yet a motion.
                await asyncio.wait_for(self.changed.wait(), QUIET_S if span > 0.0 else None)
            except asyncio.TimeoutError:
                return


class MotionExecutor:
    """Executes orders, of one client at a time.

    Args:
        arm: the arm.
        refused: called with the reason when the arm has refused a motion or ended it with an error, and stops.
    """

    def __init__(self, arm: Arm, refused: Callable[[str], None]) -> None:
        self._arm = arm
        self._refused = refused
        self._motions: set[asyncio.Task[None]] = set()
        self._series = 0
        """Number of the newest motion, or series of real-time points; the ends of older ones are ignored."""
        self._stream: _Stream | None = None
        self._target: Joints | None = None
        """Real-time point that is not yet part of a call."""
        self._is_targeting = False
        self._moves = 0
        """Number of pending calls of real-time points."""
        self._halts: set[asyncio.Task[None]] = set()
        self._releases: set[asyncio.Task[None]] = set()
        self._has_moved = False

    @property
    def is_releasing(self) -> bool:
        """Whether the arm stops because a client was lost; it accepts no orders meanwhile."""
        return bool(self._releases)

    @property
    def has_moved(self) -> bool:
        """Whether the arm executes or executed a motion of this client; a refused motion does not count."""
        return self._has_moved or bool(self._motions)

    def begin_client(self) -> None:
        """Begin with the orders of another client."""
        self._has_moved = False

    def carry_out(self, order: sequence.Order) -> None:
        """Begin an order; returns at once. Raises PointRefused where the buffer is full."""
        match order:
            case sequence.Begin(point):
                self._supersede()
                self._stream = _Stream(self._series)
                self._add(self._stream, point)
            case sequence.Append(point) if self._stream:
                self._add(self._stream, point)
            case sequence.Finish() if self._stream:
                self._stream.is_finished = True
                self._stream.changed.set()
            case sequence.Execute(points):
                self._supersede()
                self._start(self._run(points))
            case sequence.Target(positions):
                if not self._is_targeting:
                    self._supersede()
                    self._is_targeting = True
                self._target = positions
                self._move_to_target()
            case sequence.Halt():
                self.halt()

    def halt(self) -> None:
        """Stop any motion now, of any commander."""
        self._supersede()
        for motion in self._motions:
            motion.cancel()
        if not self._halts:
            self._keep(self._halts, self._try(self._arm.halt))

    def halt_own(self) -> None:
        """Stop this client's motion; another commander's motion continues."""
        self._supersede()
        if self._motions and not self._arm.is_held_by_others:
            self.halt()

    def release(self) -> None:
        """Stop the arm and disable the drives: the client was lost."""
        self._supersede()
        for motion in self._motions:
            motion.cancel()
        self._keep(self._releases, self._try(self._arm.halt, self._arm.disable))

    async def released(self) -> None:
        """Return when every release has finished."""
        while self._releases:
            await asyncio.wait(self._releases)

    def _supersede(self) -> None:
        self._series += 1
        self._stream = self._target = None
        self._is_targeting = False

    def _start(self, motion: Coroutine[None, None, None], series: int | None = None) -> asyncio.Task[None]:
        """Run a part of the newest motion, or of the motion `series`."""
        series, task = self._series if series is None else series, asyncio.create_task(motion)
        self._motions.add(task)

        def ended(task: asyncio.Task[None]) -> None:
            self._motions.discard(task)
            error = None if task.cancelled() else task.exception()
            self._has_moved |= not (isinstance(error, RtcpError) and error.kind == "refused")
            if error is None:
                return
            if not isinstance(error, RtcpError | sequence.PointRefused):
                log.error("a motion met a defect", exc_info=error)
            if series == self._series:
                self.halt_own()
                self._refused(str(error))

        task.add_done_callback(ended)
        return task

    @staticmethod
    def _keep(tasks: set[asyncio.Task[None]], action: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(action)
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    @staticmethod
    async def _try(*actions: Callable[[], Coroutine[None, None, None]]) -> None:
        for action in actions:
            try:
                await action()
            except RtcpError as error:
                log.warning("%s", error)
            except Exception:
                log.exception("the arm could not be stopped")  # the drives are disabled nevertheless

    async def _standstill(self) -> None:
        """Return when no stop is in progress."""
        while self._halts:
            await asyncio.wait(self._halts)

    async def _run(self, points: Sequence[Point]) -> None:
        await self._standstill()
        await self._arm.run_trajectory(points)

    # -- real-time points ---------------------------------------------------------------------------------------------

    def _move_to_target(self) -> None:
        # A call ends soon after another replaces it, which limits the calls to the arm's rate.
        if self._target is not None and self._moves < _TARGETS_UNDER_WAY:
            positions, self._target = self._target, None
            self._moves += 1
            self._start(self._move(positions)).add_done_callback(self._moved)

    def _moved(self, _: asyncio.Task[None]) -> None:
        self._moves -= 1
        self._move_to_target()

    async def _move(self, positions: Joints) -> None:
        await self._standstill()
        await self._arm.move_joints(positions)

    # -- streamed trajectories ----------------------------------------------------------------------------------------

    def _add(self, stream: _Stream, point: Point) -> None:
        stream.add(point)
        if not stream.is_running:
            stream.is_running = True
            self._start(self._run_stream(stream))

    async def _run_stream(self, stream: _Stream) -> None:
        """Run the points; if the arm runs out of them and more come, begin again from its position at rest."""
        await self._standstill()
        while stream is self._stream and stream.points:
            await stream.buffered()
            last = stream.points[-1].time
            points = stream.take()
            if stream is self._stream and points[-1].time > 0.0:
                opened = await self._arm.open_trajectory(points)
                self._has_moved = True
                await self._feed(stream, opened, last)
        stream.is_running = False

    async def _feed(self, stream: _Stream, trajectory: OpenTrajectory, last: float) -> None:
        """Append points until the trajectory has ended; `last`: time of the last point, s."""
        ended = self._start(trajectory.wait(), stream.series)
        ended.add_done_callback(lambda _: stream.changed.set())
        while not ended.done() and stream is self._stream:
            if stream.points:
                points, newest = list(stream.points), stream.points[-1].time
                try:
                    await trajectory.append(stream.take())
                    last = newest
                except RtcpError:
                    if not ended.done():
                        raise
                    stream.points[:0] = points  # too late for this trajectory
            elif stream.is_finished:
                await trajectory.finish()
                await asyncio.wait({ended})
            else:
                stream.changed.clear()
                await stream.changed.wait()
        stream.begin = last
