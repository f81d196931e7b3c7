"""A stream of setpoints: written into shared memory, so that a sender waits for no answer."""

from __future__ import annotations

import contextlib
import os
import select
import struct
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rtcp.config.model import MOST_AXES
from rtcp.ipc.closing import Closing
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import Event, LeaseExpired, MotionEnded, PermissionWithdrawn, Stopped
from rtcp.ipc.layout import SETPOINT_ENDS, SETPOINT_HAS_ACCELERATION, SETPOINT_HAS_VELOCITY
from rtcp.ipc.names import Names
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.session import read_session

_ENDS = (MotionEnded, LeaseExpired, PermissionWithdrawn)
_NOTHING = (0.0,) * (3 * MOST_AXES)


class Stream(Closing):
    """Setpoints for the joints at any rate, each the newest: `with robot.open_stream() as stream: stream.send(q)`.

    The joints follow smoothly under their limits and come to rest where the stream pauses; without a setpoint for 0.2 s
    it has ended. A setpoint that cannot be followed ends it with a controlled stop: the next `send` raises why. Leaving
    the block brings the arm to rest. Use it from one thread.
    """

    def __init__(self, directory: Path, stream: int, lease: int, since: int) -> None:
        self._observer = Observer(blackboard_file(directory))
        self._loop = select.poll()
        try:
            self._process = os.pidfd_open(self._observer.loop_pid)
        except OSError:
            self._observer.close()
            raise self._loop_has_ended() from None
        self._loop.register(self._process, select.POLLIN)
        session = read_session(directory)
        config = session.config
        self._names = Names(config, session.partners)
        self._count = len(config.joints)
        self._padding = (0.0,) * (MOST_AXES - self._count)
        self._stream, self._lease, self._since = stream, lease, since
        self._renew_ns = round(config.lease_s * 0.2e9)
        self._renewed_ns = time.monotonic_ns()
        self._taken_before = self._observer.setpoints_taken
        self._is_closed, self._taken = False, 0
        self.sent = 0
        """How many setpoints were sent."""

    @classmethod
    def from_json(cls, answer: Mapping[str, Any]) -> Stream:
        """Read the answer of the method `open_stream`."""
        return cls(Path(answer["directory"]), answer["stream"], answer["lease"], answer["since"])

    @property
    def is_open(self) -> bool:
        """Whether the joints follow it."""
        return not self._is_closed and self._observer.open_stream == self._stream and not self._loop.poll(0)

    @property
    def taken(self) -> int:
        """How many of its setpoints the loop has taken; once it is closed, up to then."""
        return self._taken if self._is_closed else self._observer.setpoints_taken - self._taken_before

    def send(
        self,
        q: Sequence[float],
        velocity: Sequence[float] | None = None,
        acceleration: Sequence[float] | None = None,
        t: float | None = None,
    ) -> None:
        """Send a setpoint.

        Args:
            q: rad, one a joint, base to tool.
            velocity: of the target, rad/s; None: it is estimated from the setpoints before.
            acceleration: of the target, rad/s^2, beside its velocity; None: 0.
            t: time stamp, s, of any clock of the sender, rising; None: now.

        Raises:
            Invalid: not a number a joint, an acceleration without a velocity, or the stream was closed.
            Faulted: the stream has ended, `reason` and `fields` are the cause; or the loop has ended: a platform that
                was started since needs another stream.
        """
        if self._is_closed:
            raise RtcpError("invalid", "the stream is closed: open another one")
        if self._loop.poll(0):
            raise self._loop_has_ended()
        bits, n, padding = 0, self._count, self._padding
        values: Any
        for name, values, bit in (
            ("q", q, 0),
            ("velocity", velocity, SETPOINT_HAS_VELOCITY),
            ("acceleration", acceleration, SETPOINT_HAS_ACCELERATION),
        ):
            if values is None and bit:
                continue
            bits |= bit
            try:
                count = len(values)
            except TypeError:
                raise RtcpError(
                    "invalid", f"{name}: found {values!r:.40}, allowed are {n} numbers: one a joint"
                ) from None
            if count != n:
                raise RtcpError("invalid", f"{name}: found {count} numbers, allowed are {n}: one a joint")
        if bits == SETPOINT_HAS_ACCELERATION:
            raise RtcpError("invalid", "velocity: it is missing, and an acceleration is given")
        zero = _NOTHING[:n]
        v, a = zero if velocity is None else velocity, zero if acceleration is None else acceleration
        self._put(bits, time.monotonic_ns() * 1e-9 if t is None else t, (*q, *padding, *v, *padding, *a, *padding))
        self.sent += 1

    def _put(self, bits: int, t: float, numbers: Sequence[float]) -> None:
        now_ns = time.monotonic_ns()
        try:
            if now_ns - self._renewed_ns > self._renew_ns:
                self._renewed_ns = now_ns
                self._observer.renew(self._lease)
            followed = self._observer.setpoint(self._stream, bits, t, numbers)
        except (struct.error, TypeError, OverflowError) as error:
            raise RtcpError("invalid", f"a setpoint cannot be sent: {error}") from None
        except BlackboardError as error:
            raise RtcpError("fault", str(error)) from None
        if not followed:
            raise self._ended()

    def _loop_has_ended(self) -> RtcpError:
        loop = f"the loop (process {self._observer.loop_pid})"
        return RtcpError("fault", f"{loop} has ended: start the platform, then open another stream")

    def _ended(self) -> RtcpError:
        """Return the error for the end of the stream."""
        cause: Event | None = None
        for event in (record.event for record in self._observer.events_since(self._since)):
            # A stop is the reason only where there is no other event.
            if (
                isinstance(event, _ENDS)
                or type(event) in self._names.faults
                or (cause is None and type(event) is Stopped)
            ):
                cause = event
        if cause is None:
            return RtcpError("fault", "the stream has ended")
        return RtcpError("fault", f"the stream has ended: {self._names.message(cause)}", cause.name, cause.as_json())

    def close(self) -> None:
        """Bring the arm to rest and end the stream; a second time is harmless. It waits for nothing."""
        if not self._is_closed:
            self._taken = self.taken
            self._is_closed = True
            with contextlib.suppress(BlackboardError):  # of a loop that hangs, and reads nothing
                self._observer.setpoint(self._stream, SETPOINT_ENDS, 0.0, _NOTHING)
            os.close(self._process)
            self._observer.close()
