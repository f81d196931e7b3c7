"""The ordinary thread beside the cycle: the way to OP, the slave watcher's turns, emergencies, SDO requests.

It shares a few plain attributes with the cycle (one writer each) and never holds the interpreter while it waits.
"""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

from rtcp.control.sdo_requests import SdoRequests
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import SlaveState
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.recovery import MonitoredSlave
from rtcp.fieldbus.supervision import SlaveWatcher
from rtcp.ipc.blackboard import Blackboard
from rtcp.realtime.scheduling import cpu_hint, thread_beside

_PUBLISH_S = 0.1
"""Interval at which slave states and counters are published and emergencies are read, s."""
_LOCK_S = 15.0
_SPEAKS_S = 1.0
"""Time for a robot controller to speak, s; after it the start is reported, and what it waits for."""
_MOST_COMPLAINTS, _MOST_EMERGENCIES = 8, 4
"""Different messages in 10 s: about failures of the bus, and about the emergencies of one slave."""
_ERROR_BIT = 0x10


def _nothing() -> None:
    pass


def _always() -> bool:
    return True


class BusService(threading.Thread):
    """Watches the slaves and does for the cycle what takes time.

    Args:
        master: the bus, started.
        blackboard: where slave states and sentences go and requests come from.
        drive_addresses: position on the cable and axis of each joint's drive.
        joint_names: their names.
        op_timeout_s: how long the slaves may take from SAFE-OP to OP.
        cycle_cpu: CPU of the cycle, which this thread keeps off.
        cycle_priority: the cycle's; this thread's is one below, above all other work.
        watch_s: how long it rests between two turns.
    """

    def __init__(
        self,
        master: Master,
        blackboard: Blackboard,
        drive_addresses: Sequence[tuple[int, int]],
        joint_names: Sequence[str],
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
        self._joint_names = joint_names
        self._op_timeout_s = op_timeout_s
        self._cycle_cpu = cycle_cpu
        self._cycle_priority = cycle_priority
        self._watch_s = watch_s
        self._publish_turns = max(round(_PUBLISH_S / watch_s), 1)
        self._op_wanted = False
        self._is_reported = False
        self._nodes = len(master.config.slaves)
        self._asked = 0
        """What the cycle asked last, counted up: odd to park, even to recover."""
        self._done = 0
        self._errors: deque[tuple[str, Exception]] = deque(maxlen=_MOST_COMPLAINTS)
        self._explain = [False] * len(joint_names)
        self._complaints = LogThrottle(blackboard.text, _MOST_COMPLAINTS, "failures of the bus")
        self._emergencies: dict[tuple[int, bool], LogThrottle] = {}
        self._end = threading.Event()
        self.all_op = False
        """Whether every slave is in OP, and was since the start or the last `recover`; read by the cycle."""
        self.lost_slave = 0
        """Position of a slave that has left OP; 0: none. It stays until `recover`, however soon the slave is back."""
        self.refused: tuple[str, ...] = ()
        """Why OP was not reached at the start; the cycle then ends."""
        self.clock_followed: Callable[[], bool] = _always
        """Whether the cycle follows the reference clock; slaves that were lost wait in SAFE-OP for it."""
        self.temperature: Callable[[int], float] = lambda position: math.nan
        """Temperature of the drive at a position, of the warmest of its axes, C."""
        self.on_op: Callable[[], None] = _nothing
        """Called once, from this thread, when all slaves are in OP for the first time."""
        self.look_around: Callable[[], None] = _nothing
        """Called in every turn, from this thread."""
        self.on_refused: Callable[[], None] = _nothing
        """Called once, from this thread, when the start has failed or the thread cannot go on."""

    # -- what the cycle asks: a plain store each ----------------------------------------------------------------

    def want_op(self) -> None:
        """Request OP; may be called every cycle."""
        self._op_wanted = True

    def recover(self) -> None:
        """Ask for the slaves that left OP to be brought back; of this and `park` the last one counts."""
        self._asked = (self._asked | 1) + 1
        self.all_op = False

    def park(self) -> None:
        """Ask for all slaves to be taken to PRE-OP, as an emergency stop ends; `recover` brings them back."""
        self._asked = (self._asked + 1) | 1
        self.all_op = False

    def explain_drive(self, axis: int) -> None:
        """Ask for the drive's error code to be read and put into words; several drives may fail at once."""
        self._explain[axis] = True

    def explain_error(self, what: str, error: Exception) -> None:
        """Ask for an exception that the cycle met to be put into words."""
        self._errors.append((what, error))

    def finish(self) -> None:
        """End the thread and wait for it."""
        self._end.set()
        if self.is_alive():
            self.join(timeout=3.0)

    # -- the thread ---------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Take turns until `finish`. A defect in here ends the loop, which must not run without supervision."""
        try:
            self._run_turns()
        except Exception as error:
            sentence = f"the service thread met a defect ({type(error).__name__}: {error}): the loop ends"
            self._blackboard.text(sentence)
            self.refused = (sentence,)
            self.on_refused()
            raise

    def _run_turns(self) -> None:
        thread_beside(self._cycle_cpu, self._cycle_priority - 1)
        turn = 0
        while not self._end.wait(self._watch_s):
            turn += 1
            # Each part by itself: an error in one does not stop the others.
            self._say_errors()
            self.look_around()
            for part in (self._watch, self._serve_sdo_requests, self._listen):
                try:
                    part(turn)
                except BusError as error:
                    self._complain(error)
        self._attempt_publishing()

    def _attempt_publishing(self) -> None:
        try:
            self._publish_states(() if self._bus is None else self._bus.read_states())
        except BusError as error:
            self._complain(error)

    def _say_errors(self) -> None:
        while self._errors:
            what, error = self._errors.popleft()
            frames = traceback.extract_tb(error.__traceback__)
            where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
            self._blackboard.text(f"{what}: {type(error).__name__}: {error}{where}")

    def _complain(self, error: BusError) -> None:
        """Report what failed; a failure in every turn, as without the interface, is reported at most every 10 s."""
        for sentence in error.sentences:
            self._complaints.report(sentence)

    def _watch(self, turn: int) -> None:
        if self._bus is None:
            self._watch_controller(turn)
            return
        watcher = self._watcher
        if watcher is None:
            if not self.refused:
                self._start(turn)
            return
        asked = self._asked
        parked = asked & 1 == 1
        if asked != self._done:
            self._done = asked
            self.all_op = False
            if parked:
                watcher.park()
            else:
                self.lost_slave = 0
                # After a reset the next fault is reported in full, however soon it comes.
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
        if self._asked != asked:
            # The cycle asked meanwhile: what was seen was before that.
            self.all_op = False
        if turn % self._publish_turns == 0 or not (was_well and watcher.all_op):
            self._publish_health(watcher)

    def _watch_controller(self, turn: int) -> None:
        """Follow a bus without slaves: it may be used as soon as it is open; people are told what is missing."""
        self.all_op = self._master.connected
        if (missing := self._master.waiting_for()) != self._waiting_for:
            self._waiting_for = missing
            text = f"waiting for the robot: {missing}" if missing else "the robot is ready"
            self._blackboard.text(text, is_problem=False)
        if not self._is_reported and (self.all_op or turn * self._watch_s > _SPEAKS_S):
            self._is_reported = True
            for position in range(1, self._nodes + 1):
                self._blackboard.slave(position, AlState.OP, 0)
            self.on_op()
        for axis, asked in enumerate(self._explain):
            if asked:
                self._explain[axis] = False
                if words := self._master.explain(axis):
                    self._complaints.report(words)

    def _start(self, turn: int) -> None:
        bus = self._bus
        assert bus is not None
        if self._op_wanted:
            bus.request_state(AlState.OP)
            self.refused = bus.wait_for_state(AlState.OP, self._op_timeout_s)
            self._publish_states(bus.read_states())
            if not self.refused:
                self._watcher = bus.watcher(self._blackboard.text)
                self.all_op = True
                self.on_op()
        elif turn * self._watch_s > _LOCK_S:
            self.refused = (
                f"the cycle did not lock onto the reference clock within {_LOCK_S:g} s: the frames come too unevenly "
                f"or do not come back (see `rtcp status`, bus.send_phase){cpu_hint(self._cycle_cpu)}",
            )
        elif turn % self._publish_turns == 0:
            self._publish_states(bus.read_states())
        if self.refused:
            self.on_refused()

    def _serve_sdo_requests(self, turn: int) -> None:
        if self._sdo_requests is None:
            return
        if True in self._explain and not self._sdo_requests.explaining:
            axis = self._explain.index(True)
            self._explain[axis] = False
            self._sdo_requests.explain(self._joint_names[axis], *self._drive_addresses[axis])
        self._sdo_requests.take_steps()

    def _listen(self, turn: int) -> None:
        if turn % self._publish_turns:
            return
        for throttle in (self._complaints, *self._emergencies.values()):
            throttle.report_due()
        if self._bus is None or (self._watcher is not None and self._watcher.silent):
            return
        for emergency in self._bus.emergencies():
            kind = emergency.position, emergency.is_problem
            if kind not in self._emergencies:
                report = partial(self._blackboard.text, is_problem=emergency.is_problem)
                what = f"emergency messages of slave {emergency.position}"
                self._emergencies[kind] = LogThrottle(report, _MOST_EMERGENCIES, what)
            self._emergencies[kind].report(emergency.sentence())

    def _publish_states(self, states: Iterable[SlaveState | MonitoredSlave]) -> None:
        for slave in states:
            self._blackboard.slave(slave.position, slave.state | (_ERROR_BIT if slave.error else 0), slave.code)

    def _publish_health(self, watcher: SlaveWatcher) -> None:
        self._publish_states(watcher.slaves)
        for slave, errors in zip(watcher.slaves, watcher.errors.of, strict=True):
            ports = zip(errors.rx, errors.forwarded, errors.links, strict=True)
            temperature = self.temperature(slave.position) if slave.state == AlState.OP else math.nan
            self._blackboard.health(slave.position, slave.lost, slave.recovered, temperature, ports)


REPORT_INTERVAL_S = 10.0
"""Least interval between two reports of the same message, s."""


@dataclass
class _Repeated:
    at: float
    again: int = 0


class LogThrottle:
    """Says a sentence at once the first time, and at most every 10 s how often it has come again.

    Args:
        report: takes the sentences.
        most: different messages that are reported in 10 s.
        what: how the sentence on those beyond names them, as `messages of slave 3`.
    """

    def __init__(self, report: Callable[[str], None], most: int, what: str) -> None:
        self._report = report
        self._most = most
        self._what = what
        self._recent: dict[str, _Repeated] = {}
        self._beyond = 0
        self._beyond_at = 0.0

    def report(self, sentence: str) -> None:
        """Say `sentence`, or count it."""
        now = time.monotonic()
        entry = self._recent.get(sentence)
        if entry is not None:
            entry.again += 1
        elif len(self._recent) < self._most:
            self._recent[sentence] = _Repeated(now)
            self._report(sentence)
        else:
            self._beyond_at = self._beyond_at if self._beyond else now
            self._beyond += 1

    def report_due(self) -> None:
        """Say what was counted and is due, and forget what did not come again; to be called now and then."""
        now = time.monotonic()
        for sentence, entry in tuple(self._recent.items()):
            if now - entry.at < REPORT_INTERVAL_S:
                continue
            if entry.again:
                self._report(f"{sentence} ({_times(entry.again)} again in {now - entry.at:.0f} s)")
                entry.at, entry.again = now, 0
            else:
                del self._recent[sentence]
        if self._beyond and now - self._beyond_at >= REPORT_INTERVAL_S:
            self._report(f"further {self._what} were left out: {self._beyond} in {now - self._beyond_at:.0f} s")
            self._beyond = 0


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
