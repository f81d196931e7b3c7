"""The ordinary thread beside the cycle: transition to OP, polls of the slave watcher, emergencies, SDO requests.

It shares plain attributes with the cycle, each with one writer, and the ring of events, which both append to under a
lock. It releases the interpreter lock while it waits.
"""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from rtcp.control.sdo_requests import SdoRequests
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import SlaveState
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.port_errors import REPORT_INTERVAL_S
from rtcp.fieldbus.recovery import MonitoredSlave
from rtcp.fieldbus.supervision import SlaveWatcher
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import EmergencyMessage, ErrorReported, Event, MessagesLeftOut, RobotReady, WaitingForRobot
from rtcp.realtime.scheduling import cpu_hint, thread_beside

_PUBLISH_S = 0.1
"""Interval at which slave states and counters are published and emergencies are read, s."""
_LOCK_S = 15.0
"""Time for the cycle to lock onto the reference clock at the start, s."""
_SPEAKS_S = 1.0
"""Longest wait for a robot controller at the start, s; then the start counts as done, whatever is missing."""
_MOST_COMPLAINTS, _MOST_EMERGENCIES = 8, 4
"""Limits on the number of different messages in 10 s: on failures of the bus, and on the emergencies of one slave."""


def _nothing() -> None:
    pass


def _always() -> bool:
    return True


class BusService(threading.Thread):
    """Watches the slaves and does slow work for the cycle.

    Args:
        master: the bus, started.
        blackboard: receives slave states and events, provides requests.
        drive_addresses: position on the cable and axis of each joint's drive.
        op_timeout_s: longest time for the slaves from SAFE-OP to OP, s.
        cycle_cpu: CPU of the cycle, which this thread avoids.
        cycle_priority: priority of the cycle; this thread has the next lower one.
        watch_s: pause between two polls, s.
    """

    def __init__(
        self,
        master: Master,
        blackboard: Blackboard,
        drive_addresses: Sequence[tuple[int, int]],
        op_timeout_s: float,
        cycle_cpu: int,
        cycle_priority: int,
        watch_s: float = 0.01,
    ) -> None:
        super().__init__(name="service", daemon=True)
        self._master = master
        self._bus = bus = master.supervised
        self._blackboard = blackboard
        self._sdo_requests = None if bus is None else SdoRequests(bus, blackboard)
        self._waiting_for = ""
        self._watcher: SlaveWatcher | None = None
        self._drive_addresses = drive_addresses
        self._op_timeout_s = op_timeout_s
        self._cycle_cpu = cycle_cpu
        self._cycle_priority = cycle_priority
        self._watch_s = watch_s
        self._publish_polls = max(round(_PUBLISH_S / watch_s), 1)
        self._op_wanted = False
        self._began_s = math.inf
        """When the thread began, CLOCK_MONOTONIC; a poll takes long where no slave answers."""
        self._is_reported = False
        self._nodes = len(master.config.slaves)
        self._asked = 0
        """Number of the cycle's last request: odd to park, even to recover."""
        self._done = 0
        self._errors: deque[tuple[str, BaseException]] = deque(maxlen=_MOST_COMPLAINTS)
        self._explain = [False] * len(drive_addresses)
        self._complaints = LogThrottle(blackboard.event, _MOST_COMPLAINTS)
        self._emergencies: dict[tuple[int, bool], LogThrottle] = {}
        self._end = threading.Event()
        self.all_op = False
        """Whether every slave has been in OP since the start or the last `recover`; read by the cycle."""
        self.lost_slave = 0
        """Position of a slave that has left OP; 0: none. It stays until `recover`, even if the slave returns."""
        self.refused: tuple[str, ...] = ()
        """Sentences on why OP was not reached at the start; they end the cycle."""
        self.clock_followed: Callable[[], bool] = _always
        """Whether the cycle follows the reference clock; slaves that were lost wait in SAFE-OP for it."""
        self.temperature: Callable[[int], float] = lambda position: math.nan
        """Temperature of the drive at a position, its warmest axis, C."""
        self.on_op: Callable[[], None] = _nothing
        """Called once, from this thread, when all slaves are in OP for the first time."""
        self.look_around: Callable[[], None] = _nothing
        """Called in every poll, from this thread: opens the blackboards of partners."""
        self.on_refused: Callable[[], None] = _nothing
        """Called once, from this thread, when the start has failed or the thread cannot go on."""

    # -- requests of the cycle: a plain store each --------------------------------------------------------------

    def want_op(self) -> None:
        """Request OP; may be called every cycle."""
        self._op_wanted = True

    def recover(self) -> None:
        """Request the recovery of slaves that left OP; supersedes `park`."""
        self._asked = (self._asked | 1) + 1
        self.all_op = False

    def park(self) -> None:
        """Request PRE-OP of all slaves, at the end of an emergency stop, until the next `recover`."""
        self._asked = (self._asked + 1) | 1
        self.all_op = False

    def explain_drive(self, axis: int) -> None:
        """Request a report of the drive's error code; several drives may fail at once."""
        self._explain[axis] = True

    def explain_error(self, subject: str, error: BaseException) -> None:
        """Request a report of an exception raised in the cycle by `subject`."""
        self._errors.append((subject, error))

    def finish(self) -> None:
        """End the thread and wait for it."""
        self._end.set()
        if self.is_alive():
            self.join(timeout=3.0)

    # -- the thread ---------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Poll until `finish`. A defect in here ends the loop, which must not run without supervision."""
        try:
            self._run_polls()
        except Exception as error:
            sentence = f"the service thread met a defect ({type(error).__name__}: {error}): the loop ends"
            self._blackboard.event(ErrorReported(sentence))
            self.refused = (sentence,)
            self.on_refused()
            raise

    def _run_polls(self) -> None:
        thread_beside(self._cycle_cpu, self._cycle_priority - 1)
        self._began_s = time.monotonic()
        poll = 0
        while not self._end.wait(self._watch_s):
            poll += 1
            # Each part separately: an error in one does not stop the others.
            self._report_errors()
            self.look_around()
            for part in (self._watch, self._serve_sdo_requests, self._read_emergencies):
                try:
                    part(poll)
                except BusError as error:
                    self._complain(error)
        self._attempt_publishing()

    def _attempt_publishing(self) -> None:
        try:
            self._publish_states(() if self._bus is None else self._bus.read_states())
        except BusError as error:
            self._complain(error)

    def _report_errors(self) -> None:
        while self._errors:
            subject, error = self._errors.popleft()
            frames = traceback.extract_tb(error.__traceback__)
            where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
            try:
                message = str(error)
            except Exception:  # that of another package
                message = "(it has no text)"
            self._blackboard.event(ErrorReported(f"{subject}: {type(error).__name__}: {message}{where}"))

    def _complain(self, error: BusError) -> None:
        """Report a failure, throttled: without the interface every poll fails."""
        for sentence in error.sentences:
            self._complaints.report(ErrorReported(sentence))

    def _watch(self, poll: int) -> None:
        if self._bus is None:
            self._watch_controller()
            return
        watcher = self._watcher
        if watcher is None:
            if not self.refused:
                self._start(poll)
            return
        request = self._asked
        parked = request & 1 == 1
        if request != self._done:
            self._done = request
            self.all_op = False
            if parked:
                watcher.park()
            else:
                self.lost_slave = 0
                # After a reset the next fault is reported in full, without throttling.
                self._emergencies.clear()
                watcher.resume()
        watcher.op_allowed = self.clock_followed()
        was_well = watcher.all_op
        left = watcher.turn()
        if left and self.all_op:
            self.lost_slave = left
            self.all_op = False
        elif watcher.all_op and not (self.lost_slave or parked):
            self.all_op = True
        if self._asked != request:
            # The cycle has made another request since: the result of this poll is out of date.
            self.all_op = False
        if poll % self._publish_polls == 0 or not (was_well and watcher.all_op):
            self._publish_health(watcher)

    def _watch_controller(self) -> None:
        """Watch a bus without slaves: it is usable once it is connected; an event says what a person has to do."""
        self.all_op = self._master.connected
        if (missing := self._master.waiting_for()) != self._waiting_for:
            self._waiting_for = missing
            self._blackboard.event(WaitingForRobot(missing) if missing else RobotReady())
        if not self._is_reported and (self.all_op or time.monotonic() - self._began_s > _SPEAKS_S):
            self._is_reported = True
            for position in range(1, self._nodes + 1):
                self._blackboard.slave(position, AlState.OP, 0)
            self.on_op()
        for axis, wanted in enumerate(self._explain):
            if wanted:
                self._explain[axis] = False
                if words := self._master.explain(axis):
                    self._complaints.report(ErrorReported(words))

    def _start(self, poll: int) -> None:
        bus = self._bus
        assert bus is not None
        if self._op_wanted:
            bus.request_state(AlState.OP)
            self.refused = bus.wait_for_state(AlState.OP, self._op_timeout_s)
            self._publish_states(bus.read_states())
            if not self.refused:
                self._watcher = bus.watcher(self._blackboard.event)
                self.all_op = True
                self.on_op()
        elif time.monotonic() - self._began_s > _LOCK_S:
            self.refused = (
                f"the cycle did not lock onto the reference clock within {_LOCK_S:g} s: the frames come too unevenly "
                f"or do not come back (see `rtcp status`, bus.send_phase){cpu_hint(self._cycle_cpu)}",
            )
        elif poll % self._publish_polls == 0:
            self._publish_states(bus.read_states())
        if self.refused:
            self.on_refused()

    def _serve_sdo_requests(self, poll: int) -> None:
        if self._sdo_requests is None:
            return
        if True in self._explain and not self._sdo_requests.explaining:
            axis = self._explain.index(True)
            self._explain[axis] = False
            self._sdo_requests.explain(axis, *self._drive_addresses[axis])
        self._sdo_requests.take_steps()

    def _read_emergencies(self, poll: int) -> None:
        if poll % self._publish_polls:
            return
        for throttle in (self._complaints, *self._emergencies.values()):
            throttle.report_due()
        if self._bus is None or (self._watcher is not None and self._watcher.silent):
            return
        for emergency in self._bus.emergencies():
            kind = emergency.slave, emergency.is_problem
            if kind not in self._emergencies:
                self._emergencies[kind] = LogThrottle(self._blackboard.event, _MOST_EMERGENCIES, emergency.slave)
            self._emergencies[kind].report(emergency)

    def _publish_states(self, states: Iterable[SlaveState | MonitoredSlave]) -> None:
        for slave in states:
            self._blackboard.slave(slave.position, slave.al_status, slave.code)

    def _publish_health(self, watcher: SlaveWatcher) -> None:
        self._publish_states(watcher.slaves)
        for slave, errors in zip(watcher.slaves, watcher.errors.of, strict=True):
            ports = zip(errors.rx, errors.forwarded, errors.links, strict=True)
            temperature = self.temperature(slave.position) if slave.state == AlState.OP else math.nan
            self._blackboard.health(slave.position, slave.lost, slave.recovered, temperature, ports)


@dataclass
class _Repeated:
    at: float
    again: int = 0


class LogThrottle:
    """Reports the first of equal events at once, and at most every 10 s the number of repetitions.

    Args:
        report: receives the events.
        most: most different events that are reported in 10 s.
        slave: position of the slave that sent them; 0: failures of the bus.
    """

    def __init__(self, report: Callable[[Event], None], most: int, slave: int = 0) -> None:
        self._report = report
        self._most = most
        self._slave = slave
        self._recent: dict[ErrorReported | EmergencyMessage, _Repeated] = {}
        self._beyond = 0
        self._beyond_at = 0.0

    def report(self, event: ErrorReported | EmergencyMessage) -> None:
        """Report `event`, or count it."""
        now = time.monotonic()
        entry = self._recent.get(event)
        if entry is not None:
            entry.again += 1
        elif len(self._recent) < self._most:
            self._recent[event] = _Repeated(now)
            self._report(event)
        else:
            self._beyond_at = self._beyond_at if self._beyond else now
            self._beyond += 1

    def report_due(self) -> None:
        """Report repetitions that are due, and forget events that did not repeat; called periodically."""
        now = time.monotonic()
        for event, entry in tuple(self._recent.items()):
            if now - entry.at < REPORT_INTERVAL_S:
                continue
            if entry.again:
                self._report(replace(event, again=entry.again, seconds=now - entry.at))
                entry.at, entry.again = now, 0
            else:
                del self._recent[event]
        if self._beyond and now - self._beyond_at >= REPORT_INTERVAL_S:
            self._report(MessagesLeftOut(self._slave, self._beyond, now - self._beyond_at))
            self._beyond = 0
