"""What a running loop publishes: each cycle record and event once, read from shared memory."""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from rtcp.config.find import load_messages
from rtcp.config.model import PluginError
from rtcp.ipc.commands import Halt
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import ServiceEvent
from rtcp.ipc.names import Names
from rtcp.ipc.observer import ERROR, INFORMATION, WARNING, BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
from rtcp.ipc.session import SessionError, read_session
from rtcp.ipc.terminals import named, terminals_of
from rtcp.ipc.tool_motion import ToolMotion

Records: TypeAlias = npt.NDArray[np.void]
"""Cycle records, oldest first: a structured array with a field a signal (`docs/recording.md`)."""
LogLine = tuple[int, str, int]
"""Instant (CLOCK_MONOTONIC, ns), text and level of `foxglove.Log`."""
_RECENT = 32
"""Events among which `last_event` finds one: notes of slaves may follow it."""


class Feed:
    """Reads a blackboard from now on.

    Args:
        directory: the runtime directory; None: that of this process' environment.

    Attributes:
        config: configuration of the running platform.
        period_ns: of a cycle.
        schema: of the records: name, type, unit and meaning of each field; those of the tool (`rtcp.ipc.tool_motion`)
            are computed here.
        channels: named terminals of IO boxes, and channels of other slaves.

    Raises:
        NotRunning: no platform runs there.
    """

    def __init__(self, directory: Path | None = None) -> None:
        directory = runtime_directory() if directory is None else directory
        try:
            session = read_session(directory)
            self.config = session.config
            self._observer = Observer(blackboard_file(directory))
        except (BlackboardError, SessionError) as error:
            raise _not_running(directory, str(error)) from error
        self.period_ns = self._observer.period_ns
        self._tool = ToolMotion(self.config.models, self._observer.schema)
        self.schema = self._tool.schema
        self.channels = named(*terminals_of(self.config, self.schema))
        self._loop = select.poll()
        try:
            self._process = os.pidfd_open(self._observer.loop_pid)
        except OSError as error:
            self._observer.close()
            message = f"the loop (process {self._observer.loop_pid}) has ended"
            raise _not_running(directory, message) from error
        self._loop.register(self._process, select.POLLIN)
        with contextlib.suppress(PluginError):
            load_messages()
        self._names = Names(self.config, session.partners)
        self._at, self._event = self._observer.head, self._observer.last_event
        self._gaps: list[LogLine] = []
        self._due_ns = 0

    def halt(self) -> int:
        """Request that every motion stops; return the instant of the request, ns.

        The request goes through shared memory: it passes the gateway, and needs neither a lease nor a file descriptor.
        """
        return self._observer.stop(Halt)

    def has_taken(self, requested_ns: int) -> bool:
        """Return whether the loop has taken a halt."""
        return self._observer.stop_answer(Halt, requested_ns) is not None

    def close(self) -> None:
        """Release the shared memory."""
        os.close(self._process)
        self._observer.close()

    @property
    def holder(self) -> str:
        """Who commands the arm; empty: nobody."""
        return self._observer.holder()

    def ended(self, wait_s: float) -> bool:
        """Wait, and return early and true when the loop's process has ended."""
        return bool(self._loop.poll(wait_s * 1e3))

    def wait(self, timeout_s: float) -> bool:
        """Wait for the next cycle record; return whether there is one. It costs the loop nothing.

        Sleeps until the next record is due. The end of the loop is detected by `ended`.
        """
        until = time.monotonic() + timeout_s
        rest_s = max(self.period_ns * 0.1e-9, 20e-6)
        while self._observer.head == self._at:
            remaining = until - time.monotonic()
            if remaining <= 0.0:
                return False
            due = self._due_ns * 1e-9 - time.monotonic()
            time.sleep(min(max(due, rest_s), remaining))
        self._due_ns = time.monotonic_ns() + self.period_ns - round(rest_s * 1e9)
        return True

    def records(self) -> tuple[Records, int]:
        """Return the new cycle records, and how many were overwritten before they were read."""
        records, missing = self._observer.since(self._at)
        first, self._at = self._at + 1, self._at + len(records) + missing
        if missing:
            instant = int(records["time_ns"][0]) if len(records) else time.monotonic_ns()
            self._gaps.append(_gap("cycles", first, self._at, missing, instant))
        return self._tool.add(records), missing

    def latest(self) -> Records | None:
        """Return the newest cycle record, shape (1,), whether it was read before or not; None before the first."""
        latest = self._observer.latest()
        return None if latest is None else self._tool.add(latest)

    def last_event(self) -> str:
        """Return the newest event in words, also one from before; empty before the first. Of slaves, problems only."""
        for record in reversed(self._observer.events_since(self._observer.last_event - _RECENT)):
            if not isinstance(record.event, ServiceEvent) or record.event.is_problem:
                return self._names.message(record.event)
        return ""

    def messages(self) -> Iterator[LogLine]:
        """Yield new events, and a warning for all that was overwritten before it was read."""
        gaps, self._gaps = self._gaps, []
        yield from gaps
        for event in self._observer.events_since(self._event):
            if lost := event.number - self._event - 1:
                yield _gap("events", self._event + 1, event.number - 1, lost, event.monotonic_ns)
            self._event = event.number
            is_problem = isinstance(event.event, ServiceEvent) and event.event.is_problem
            level = WARNING if is_problem else INFORMATION
            level = ERROR if type(event.event) in self._names.faults else level
            yield event.monotonic_ns, self._names.message(event.event), level


def _not_running(directory: Path, why: str) -> RtcpError:
    return RtcpError("not running", f"no platform runs in {directory} ({why}): start one with `rtcp start`")


def _gap(kind: str, first: int, last: int, count: int, monotonic_ns: int) -> LogLine:
    text = f"{count} of the {kind} from {first} to {last} are missing: they were not read in time"
    return monotonic_ns, text, WARNING
