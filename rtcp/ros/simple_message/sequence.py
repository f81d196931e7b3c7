"""Converts a motion client's points, by their sequence numbers and times, to orders for the arm. Never blocks.

Only the sequence number marks the begin of a trajectory and, when downloading, its end (REP-I0006). The reference
client ignores reply codes and continues to send after a refusal or a stop: these points are ignored up to the next
begin (`docs/simple_message.md`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TypeAlias

from rtcp.fieldbus.simple_message import messages
from rtcp.ros.simple_message.arm import ArmState, Point

BUFFER_POINTS = 4096
"""Most points that wait for execution."""
AT_START_RAD = math.radians(0.1)
"""Largest distance of a joint, rad, at which a first point is the commanded position; its time is then ignored."""
REALTIME_PAUSE_S = 0.5
"""Time without real-time points after a stop or a refusal before new ones are executed, s: no number marks a begin."""


class PointIgnored(Exception):
    """A point after a stop or a refusal: answered with FAILURE and not logged."""


class PointRefused(Exception):
    """A point that is not executed, with the reason; later points are ignored up to the next begin."""


@dataclass(frozen=True)
class Begin:
    """Begin a trajectory with an open end, which replaces the present motion."""

    point: Point


@dataclass(frozen=True)
class Append:
    """Append a point to the open trajectory."""

    point: Point


@dataclass(frozen=True)
class Finish:
    """End the open trajectory: it has no more points."""


@dataclass(frozen=True)
class Execute:
    """Execute a whole trajectory, which replaces the present motion."""

    points: tuple[Point, ...]


@dataclass(frozen=True)
class Target:
    """Move to a real-time point, which replaces the present motion."""

    positions: messages.Joints


@dataclass(frozen=True)
class Halt:
    """Stop any motion now."""


Order: TypeAlias = Begin | Append | Finish | Execute | Target | Halt


class _Mode(Enum):
    IDLE = 0
    STREAMING = 1
    DOWNLOADING = 2
    IGNORING = 3


_BEGINNINGS = {
    0: _Mode.STREAMING,
    messages.SpecialSequence.START_TRAJECTORY_STREAMING: _Mode.STREAMING,
    messages.SpecialSequence.START_TRAJECTORY_DOWNLOAD: _Mode.DOWNLOADING,
}


class PointSequence:
    """The sequence of points of one client."""

    def __init__(self) -> None:
        self._ignore_targets_until = -math.inf
        self._commanded: messages.Joints = ()
        """Commanded position of the arm at the begin, rad."""
        self._begin(_Mode.IDLE)

    def _begin(self, mode: _Mode) -> None:
        self._mode = mode
        self._next: tuple[int, ...] = ()
        """Sequence numbers that continue the trajectory."""
        self._last: messages.TrajectoryPoint | None = None
        self._first: Point | None = None
        self._offset = 0.0
        """Client time at the begin of the trajectory, s."""
        self._time = 0.0
        """Time of the last point, s from the begin."""
        self._downloaded: list[Point] = []

    def ignore(self, now: float) -> None:
        """Ignore points up to the next begin, as the arm has stopped or refused; `now`: s."""
        self._begin(_Mode.IGNORING)
        self._ignore_targets_until = now + REALTIME_PAUSE_S

    def receive(
        self, message: messages.JointPosition | messages.TrajectoryPoint, state: ArmState | None, now: float
    ) -> list[Order]:
        """Return the orders of a point.

        Args:
            message: the point.
            state: state of the arm.
            now: instant of a monotonic clock, s.

        Raises:
            PointRefused: it is not executed, with the reason.
            PointIgnored: it belongs to a motion that was stopped or refused before.
        """
        if message.sequence == messages.SpecialSequence.STOP_TRAJECTORY:
            self.ignore(now)
            return [Halt()]
        try:
            return (
                self._target(message, state, now)
                if isinstance(message, messages.JointPosition)
                else self._point(message, state)
            )
        except PointRefused:
            self.ignore(now)
            raise

    def _target(self, message: messages.JointPosition, state: ArmState | None, now: float) -> list[Order]:
        if now < self._ignore_targets_until:
            self._ignore_targets_until = now + REALTIME_PAUSE_S
            raise PointIgnored
        self._begin(_Mode.IDLE)
        self._commanded = _commanded_by(state)
        return [Target(self._checked(message, "position", message.positions))]

    def _point(self, message: messages.TrajectoryPoint, state: ArmState | None) -> list[Order]:
        number = message.sequence
        is_mark = number < 0 and _is_bare(message)
        if number in _BEGINNINGS and number not in self._next:
            self._begin(_BEGINNINGS[number])
            self._commanded = _commanded_by(state)
            if is_mark:
                self._next = (0, 1)
                return []
            return self._add(message)
        if self._mode is _Mode.IGNORING:
            raise PointIgnored
        if message == self._last:
            return []  # a repetition, as the client did not read the reply
        if number == messages.SpecialSequence.END_TRAJECTORY and self._mode is not _Mode.IDLE:
            # The reference client sends a trajectory of one point as begin and as end.
            is_repeated = self._last is not None and message == replace(self._last, sequence=number)
            added = [] if is_mark or is_repeated else self._add(message)
            return [*added, *self._end(message)]
        if number not in self._next:
            expected = " or ".join(map(str, self._next)) or "0 (a trajectory) or -1 (a download)"
            raise PointRefused(f"sequence {number} came where {expected} follows: the motion is aborted")
        return self._add(message)

    def _add(self, message: messages.TrajectoryPoint) -> list[Order]:
        """Add the next point of the trajectory."""
        point = self._point_of(message)
        is_first, self._first = self._first is None, self._first or point
        if [each is None for each in point] != [each is None for each in self._first]:
            raise PointRefused(f"sequence {message.sequence}: its fields are not those of the first point")
        self._last, self._time = message, point.time
        self._next = (max(message.sequence, 0) + 1,)
        if self._mode is _Mode.STREAMING:
            return [Begin(point) if is_first else Append(point)]
        if len(self._downloaded) == BUFFER_POINTS:
            raise PointRefused(f"the trajectory is too long: more than {BUFFER_POINTS} points")
        self._downloaded.append(point)
        return []

    def _end(self, message: messages.TrajectoryPoint) -> list[Order]:
        mode, points, first = self._mode, tuple(self._downloaded), self._first
        if first is None:
            raise PointRefused("the trajectory ends without a point")
        self._begin(_Mode.IDLE)
        self._last = message
        if mode is _Mode.STREAMING:
            return [Finish()]
        return [Execute(points)] if points[-1].time > 0.0 else []  # else the arm is already at its only point

    def _point_of(self, message: messages.TrajectoryPoint) -> Point:
        """Return the point with its time from the start of the trajectory."""
        velocities: messages.Joints = ()
        accelerations: messages.Joints = ()
        if isinstance(message, messages.JointTrajPt):
            time = self._time + message.duration
        else:
            time, velocities, accelerations = message.time - self._offset, message.velocities, message.accelerations
        if isinstance(message, messages.JointTrajPtFull):
            if message.robot_id != 0:
                raise PointRefused(f"robot_id {message.robot_id}: this is robot 0, the only one")
            valid = message.valid_fields
            if not valid & messages.ValidFields.TIME or not valid & messages.ValidFields.POSITION:
                raise PointRefused(f"valid_fields {valid:d}: a point needs a time (1) and positions (2)")
            velocities = velocities if valid & messages.ValidFields.VELOCITY else ()
            accelerations = accelerations if valid & messages.ValidFields.ACCELERATION else ()
        elif isinstance(message, messages.JointPoint) and len(message.positions) != len(self._commanded):
            raise PointRefused(f"found {len(message.positions)} joints, and the arm has {len(self._commanded)}")
        positions = self._checked(message, "position", message.positions)
        if accelerations and not velocities:
            raise PointRefused(f"sequence {message.sequence}: it has accelerations and no velocities")
        if not math.isfinite(time):
            raise PointRefused(f"sequence {message.sequence}: a time of {time} s is not finite")
        if self._first is None and self._is_at_start(positions):
            self._offset, time = (0.0 if isinstance(message, messages.JointTrajPt) else time), 0.0
            positions = self._commanded
        elif time <= self._time:
            raise PointRefused(
                f"sequence {message.sequence}: its time, {time:g} s, is not later than {self._time:g} s: "
                + ("the arm is not there" if self._first is None else "that of the point before")
            )
        return Point(
            time,
            positions,
            self._checked(message, "velocity", velocities) if velocities else None,
            self._checked(message, "acceleration", accelerations) if accelerations else None,
        )

    def _is_at_start(self, positions: messages.Joints) -> bool:
        pairs = zip(positions, self._commanded, strict=True)
        return all(abs(wanted - commanded) <= AT_START_RAD for wanted, commanded in pairs)

    def _checked(
        self, message: messages.JointPosition | messages.TrajectoryPoint, name: str, values: Sequence[float]
    ) -> messages.Joints:
        """Return the values of the arm's joints in a message; the others of ten must be 0."""
        count = len(self._commanded)
        for joint, value in enumerate(values, start=1):
            if not math.isfinite(value):
                raise PointRefused(f"sequence {message.sequence}, joint {joint}: the {name} {value} is not finite")
            if joint > count and value:
                raise PointRefused(
                    f"sequence {message.sequence}, joint {joint}: found the {name} {value:g}, and the arm has {count} "
                    "joints"
                )
        if len(values) < count:
            raise PointRefused(f"found {len(values)} joints, and the arm has {count}")
        return tuple(values[:count])


def _is_bare(message: messages.TrajectoryPoint) -> bool:
    """Whether it is only an end mark: its time and positions are 0."""
    time = message.duration if isinstance(message, messages.JointTrajPt) else message.time
    return time == 0.0 and not any(message.positions)


def _commanded_by(state: ArmState | None) -> messages.Joints:
    """Return the commanded position, rad; raises PointRefused where the arm cannot move."""
    if state is None:
        raise PointRefused("the platform is not there: start it with `rtcp start`")
    for field, value, problem in (
        (state.status.e_stopped, messages.TriState.TRUE, "an emergency stop is active: release it, then `rtcp reset`"),
        (
            state.status.in_error,
            messages.TriState.TRUE,
            "the arm is in a fault: `rtcp status` names it, `rtcp reset` leaves it",
        ),
        (state.status.drives_powered, messages.TriState.FALSE, "the drives are disabled: `rtcp enable`"),
    ):
        if field is value:
            raise PointRefused(problem)
    return state.commanded
