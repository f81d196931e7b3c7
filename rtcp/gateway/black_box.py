"""The black box: at every fault it writes the last seconds of the blackboard's ring to the disk.

It only reads what the loop publishes: the cycle does nothing for it. Waiting and writing happen in a thread of its own,
so that the gateway goes on answering.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtcp.ipc.events import ResetDone
from rtcp.ipc.layout import EVENTS
from rtcp.ipc.names import Names
from rtcp.ipc.observer import EventRecord, Observer
from rtcp.ipc.recording import About, FaultRecording, Moment, RecordingError, listed, versions, write
from rtcp.ipc.session import Session
from rtcp.ipc.states import State
from rtcp.ipc.tool_motion import ToolMotion

SILENT_S = 1.0
"""Time without a record after which the loop counts as hanging, s."""
_WATCHDOG = "the drives' watchdog stops them"
_ENDED = f"ended unexpectedly; {_WATCHDOG}"
_IN_FAULT = frozenset({State.FAULT, State.EMERGENCY_STOP, State.RESETTING})
log = logging.getLogger("rtcp.blackbox")
BEFORE_S = 10.0
AFTER_S = 1.0
"""A recording's time before and after the fault's instant, s."""


@dataclass(frozen=True)
class FaultRecord:
    """The beginning of a fault: by an event of the loop, or (number 0) by its silence or end."""

    time_ns: int
    """CLOCK_REALTIME, for display."""
    monotonic_ns: int
    """CLOCK_MONOTONIC, for all comparisons."""
    what: str
    number: int = 0
    code: int = 0
    """Number of the kind of the event."""
    later: bool = False
    """Whether another fault was present already."""


class RecordingTrigger:
    """Assigns events to recordings: within one fault at most one begins in 10 s.

    Events in between are deferred: the newest of them begins the next recording, whose ten seconds before it hold the
    others. The instants of the events are compared, not those of their arrival: a restarted gateway assigns old events
    as before. They are of CLOCK_MONOTONIC, because the wall clock may be set.

    Args:
        names: names of the arm, for texts and kinds of fault.
    """

    def __init__(self, names: Names) -> None:
        self._names = names
        self.on = False
        """Whether a fault is present."""
        self._deferred: FaultRecord | None = None
        self._ends_ns = self._next_ns = 0
        """End of the newest recording, and earliest begin of the next; CLOCK_MONOTONIC."""

    def begun(self, events: Sequence[EventRecord], now_ns: int) -> list[FaultRecord]:
        """Return the new and deferred faults that begin a recording; `now_ns`: CLOCK_MONOTONIC."""
        faults: list[FaultRecord] = []
        for event in events:
            faults += self._due(event.monotonic_ns)
            if isinstance(event.event, ResetDone):
                faults += self.release_deferred()
                self.on = False
            elif type(event.event) in self._names.faults:
                text = self._names.message(event.event)
                fault = FaultRecord(event.time_ns, event.monotonic_ns, text, event.number, event.event.number)
                faults += self.add(fault)
        return faults + self._due(now_ns)

    def release_deferred(self) -> list[FaultRecord]:
        """Return the deferred fault, whose recording begins now; empty: there is none."""
        if self._deferred is None:
            return []
        fault, self._deferred = self._deferred, None
        self._begin(fault, max(self._next_ns, fault.monotonic_ns))
        return [fault]

    def add(self, fault: FaultRecord) -> list[FaultRecord]:
        """Return the faults whose recordings begin with a fault: its own, and one that was deferred."""
        fault = replace(fault, later=self.on)
        if not self.on:
            self.on = True
            before = self.release_deferred()
            self._begin(fault, fault.monotonic_ns)
            return [*before, fault]
        # A silence is detected after it has begun: no recording that began before covers it.
        if fault.monotonic_ns > self._ends_ns or not fault.number:
            self._deferred = fault
        return self._due(fault.monotonic_ns)

    def _due(self, now_ns: int) -> list[FaultRecord]:
        return self.release_deferred() if now_ns >= self._next_ns else []

    def _begin(self, fault: FaultRecord, begun_ns: int) -> None:
        self._ends_ns = fault.monotonic_ns + round(AFTER_S * 1e9)
        self._next_ns = begun_ns + round(BEFORE_S * 1e9)


class BlackBox:
    """Monitors one platform and records its faults.

    Args:
        observer: the blackboard; it is read in another thread too.
        session: the running platform.
        directory: of the files.
        report: called with messages on files written, and on failures; from any thread.
    """

    def __init__(self, observer: Observer, session: Session, directory: Path, report: Callable[[str], None]) -> None:
        self._observer = observer
        self._session = session
        self._directory = directory
        self._report = report
        self._names = Names(session.config, session.partners)
        self._events = RecordingTrigger(self._names)
        self._event = 0
        self._since = 0.0
        """When the present fault was detected, s."""
        self._head, self._head_at = observer.head, time.monotonic()
        self._silent = False
        self._dead = self._end_wanted = False
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="blackbox")
        self._over = threading.Event()
        """Set at the end: recordings no longer wait for the time after a fault."""
        if faults := self._begun():
            self._writer.submit(self._record_missed, faults)

    # -- when -------------------------------------------------------------------------------------------------------

    def poll(self) -> None:
        """Check for faults that have begun; called several times in 0.1 s."""
        if self._over.is_set():
            return
        for fault in self._begun():
            self._writer.submit(self._record, fault)
        now = time.monotonic()
        self._check_silence(now)
        if self._events.on and now - self._since > AFTER_S and not (self._silent or self._machine_in_fault()):
            # Some of these events lead to a state that ends without a reset.
            self._events.on = False

    def end_is_wanted(self) -> None:
        """Note an intentional stop: from now on neither silence nor end of the loop is a fault."""
        self._end_wanted = True

    def loop_has_ended(self) -> None:
        """Record an end of the loop's process that was not requested."""
        if self._dead:
            return
        self.poll()
        self._dead = True
        if not self._end_wanted:
            self._process_fault(time.monotonic_ns(), _ENDED)

    def loop_had_ended(self) -> None:
        """Record that the loop's process ended while no gateway ran."""
        self._dead = True
        latest = self._observer.latest()
        if latest is not None:
            sentence = f"the loop (process {self._observer.loop_pid}) {_ENDED}"
            last_ns = int(latest["time_ns"][0])
            self._writer.submit(self._record_missed, [FaultRecord(_wall(last_ns), last_ns, sentence)])

    def finish(self) -> None:
        """Write all pending recordings, then return; may be called again."""
        self.poll()
        for fault in self._events.release_deferred():
            self._writer.submit(self._record, fault)
        self._over.set()
        self._writer.shutdown()

    def _begun(self) -> list[FaultRecord]:
        """Return the faults that events have begun since the last call."""
        events = self._observer.events_since(self._event)
        self._event = events[-1].number if events else self._event
        if faults := self._events.begun(events, time.monotonic_ns()):
            self._since = time.monotonic()
        return faults

    def _check_silence(self, now: float) -> None:
        head = self._observer.head
        if head != self._head:
            self._head, self._head_at = head, now
            if self._silent:
                self._silent = False
                self._since = now  # a fault of its own appears a little later
                self._say(f"the loop (process {self._observer.loop_pid}) publishes again")
        elif now - self._head_at > SILENT_S and not (self._silent or self._dead or self._end_wanted):
            self._silent = True
            since_ns = time.monotonic_ns() - round((now - self._head_at) * 1e9)
            self._process_fault(since_ns, f"has published nothing for {SILENT_S:g} s; {_WATCHDOG}")

    def _machine_in_fault(self) -> bool:
        latest = self._observer.latest()
        return latest is not None and State(int(latest["state"][0])) in _IN_FAULT

    def _process_fault(self, monotonic_ns: int, predicate: str) -> None:
        sentence = f"the loop (process {self._observer.loop_pid}) {predicate}"
        self._say(sentence)
        if self._over.is_set():
            return
        fault = FaultRecord(_wall(monotonic_ns), monotonic_ns, sentence)
        # No events follow the end of the loop: it needs no separation from others.
        begun = [fault] if self._dead else self._events.add(fault)
        self._since = time.monotonic()
        for fault in begun:
            self._writer.submit(self._record, fault)

    def _say(self, sentence: str) -> None:
        log.error("%s", sentence)
        self._report(sentence)

    # -- contents, in the writer's thread ---------------------------------------------------------------------------

    def _record_missed(self, faults: Sequence[FaultRecord]) -> None:
        """Record faults from before this gateway's start, unless they are recorded or have left the ring."""
        try:
            abouts = [entry.about for entry in listed(self._directory) if entry.about is not None]
            mine = [about for about in abouts if about.began_ns == self._session.began_ns]
            done = {(about.event, "" if about.event else about.what) for about in mine}
            missing = [fault for fault in faults if (fault.number, "" if fault.number else fault.what) not in done]
            if not missing:
                return
            ring, _ = self._observer.since(0)
        except RecordingError as error:
            self._say(f"black box: {error}")
            return
        except Exception as error:
            self._defect("what no gateway saw was not recorded", error)
            return
        for fault in missing:
            if len(ring) and int(ring["time_ns"][0]) > fault.monotonic_ns:
                log.info("black box: a fault that no gateway saw has left the ring: %s", fault.what)
            else:
                self._record(fault)

    def _record(self, fault: FaultRecord) -> None:
        try:
            # At once: a short cycle's ring is soon overwritten.
            before, _ = self._observer.since(0)
            ends_ns = fault.monotonic_ns + round(AFTER_S * 1e9)
            self._over.wait(0.0 if self._dead else max((ends_ns - time.monotonic_ns()) * 1e-9, 0.0))
            after, _ = self._observer.since(int(before["number"][-1]) if len(before) else 0)
            recording = self._recording(fault, before, after, min(ends_ns, time.monotonic_ns()))
            number, path = write(self._directory, recording)
        except RecordingError as error:
            self._say(f"black box: {error}")
        except Exception as error:
            # The recording of this fault is lost and reported; the next one is tried again.
            self._defect("a fault was not recorded", error)
        else:
            sentence = f"black box: this fault is number {number} (`rtcp faults show {number}`)"
            log.info("%s: %s", sentence, path)
            self._report(sentence)

    def _defect(self, failure: str, error: Exception) -> None:
        log.exception("black box")
        self._say(f"black box: {failure}, by a defect: {type(error).__name__} {error}")

    def _recording(
        self, fault: FaultRecord, before: npt.NDArray[np.void], after: npt.NDArray[np.void], ends_ns: int
    ) -> FaultRecording:
        records = np.concatenate([before, after])
        at = _place(records, fault, len(before) - 1)
        instants, silent_s = records["time_ns"], 0.0
        if len(records):
            kept = np.abs(instants - instants[at] - (AFTER_S - BEFORE_S) * 5e8) <= (BEFORE_S + AFTER_S) * 5e8
            at -= int(np.count_nonzero(~kept[:at]))
            silent_s = _silent_s(records, int(np.argmax(kept)))
            records = records[kept]
        timeline, notes = self._timeline(fault, ends_ns)
        session = self._session
        config = session.config
        joints = tuple(joint.name for joint in config.joints)
        about = About(
            number=0,
            time_ns=fault.time_ns,
            what=fault.what,
            before=_state(records, at - 1 if fault.number else at),
            arm=config.name,
            bus=session.bus,
            period_ns=self._observer.period_ns,
            joints=joints,
            versions=versions(),
            began_ns=session.began_ns,
            event=fault.number,
            at=at,
            notes=(*_lacking(records, at, silent_s), *notes),
            timeline=timeline,
        )
        tool = ToolMotion(config.models, self._observer.schema)
        return FaultRecording(about, tool.add(records), tool.schema)

    def _timeline(self, fault: FaultRecord, ends_ns: int) -> tuple[tuple[Moment, ...], list[str]]:
        """Return the messages in the recording's time, and notes on lost ones."""
        events = self._observer.events_since(0)
        # Relative to the fault: the wall clock may be set meanwhile.
        texts = [(event.monotonic_ns - fault.monotonic_ns, self._names.message(event.event)) for event in events]
        texts += [(0, fault.what)] if not fault.number else []
        begins_ns, ends_ns = -round(BEFORE_S * 1e9), ends_ns - fault.monotonic_ns
        notes = []
        if events and events[0].number > 1 and (away_ns := events[0].monotonic_ns - fault.monotonic_ns) > begins_ns:
            notes.append(f"more than {EVENTS} events came: those before {away_ns * 1e-9:+.1f} s are lost")
        kept = sorted((text for text in texts if begins_ns <= text[0] <= ends_ns), key=lambda text: text[0])
        return tuple(Moment(fault.time_ns + away_ns, message) for away_ns, message in kept), notes


def _place(records: npt.NDArray[np.void], fault: FaultRecord, newest: int) -> int:
    """Return the index of the cycle in which the fault began, -1: no records; `newest`: the last at its detection."""
    if not len(records):
        return -1
    if not fault.number:
        return max(newest, 0)
    codes = records["fault"].astype(np.int64)
    begins = np.flatnonzero((codes == fault.code) & (np.concatenate([[0], codes[:-1]]) != fault.code))
    away = np.abs(records["time_ns"] - fault.monotonic_ns)
    # An event that is not the first fault of the machine's state has no such cycle: the clock decides.
    own = len(begins) and not fault.later
    return int(begins[np.argmin(away[begins])]) if own else int(np.argmin(away))


def _wall(monotonic_ns: int) -> int:
    """Convert an instant of CLOCK_MONOTONIC to CLOCK_REALTIME by their present difference, ns."""
    return monotonic_ns - time.monotonic_ns() + time.time_ns()


def _state(records: npt.NDArray[np.void], at: int) -> str:
    if not len(records):
        return "unknown"
    return State(int(records["state"][max(at, 0)])).words


def _silent_s(records: npt.NDArray[np.void], first: int) -> float:
    """Return the time without records before the first record that is kept, s; 0: the one before it is lost."""
    if not first or int(records["number"][first - 1]) + 1 != int(records["number"][first]):
        return 0.0
    return float(records["time_ns"][first] - records["time_ns"][first - 1]) * 1e-9


def _lacking(records: npt.NDArray[np.void], at: int, silent_s: float) -> list[str]:
    """Return notes on the cycles that a recording lacks; `silent_s`: time without records before its first, s."""
    if not len(records):
        return ["the ring holds no cycle of it"]
    notes, instants, numbers = [], records["time_ns"], records["number"].astype(np.int64)
    held_s = float(instants[at] - instants[0]) * 1e-9
    if held_s < BEFORE_S - 0.01:
        why = "the platform had just started" if numbers[0] == 1 else "older cycles had been overwritten"
        if silent_s > 1.0:
            why = f"the loop had published nothing for {silent_s:.1f} s before them"
        notes.append(f"{held_s:.1f} s before the fault instead of {BEFORE_S:g} s: {why}")
    after_s = float(instants[-1] - instants[at]) * 1e-9
    if after_s < AFTER_S - 0.01:
        notes.append(f"{after_s:.1f} s after the fault instead of {AFTER_S:g} s: then nothing was published any more")
    if lost := int(numbers[-1] - numbers[0]) + 1 - len(numbers):
        notes.append(f"{lost} cycles were overwritten before they were read, or torn")
    return notes
