"""The black box: at every fault the last seconds of the blackboard's ring go to the disk.

It reads what the loop publishes anyway: the cycle does nothing for it. Waiting and writing happen in a thread of its
own, so that the gateway goes on answering.
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
from rtcp.ipc.layout import EVENTS, TEXTS
from rtcp.ipc.names import Names
from rtcp.ipc.observer import EventRecord, Observer
from rtcp.ipc.recording import About, FaultRecording, Moment, RecordingError, listed, versions, write
from rtcp.ipc.session import Session
from rtcp.ipc.states import State
from rtcp.ipc.tool_motion import ToolMotion

SILENT_S = 1.0
"""A loop that has published nothing for so long hangs."""
_WATCHDOG = "the drives' watchdog stops them"
_ENDED = f"ended unexpectedly; {_WATCHDOG}"
_IN_FAULT = frozenset({State.FAULT, State.EMERGENCY_STOP, State.RESETTING})
log = logging.getLogger("rtcp.blackbox")
BEFORE_S = 10.0
AFTER_S = 1.0
"""A recording's time before and after the fault's instant."""


@dataclass(frozen=True)
class FaultRecord:
    """What has begun: by an event of the loop, or (number 0) by its silence or end."""

    time_ns: int
    """CLOCK_REALTIME, for people."""
    monotonic_ns: int
    """CLOCK_MONOTONIC: it decides."""
    what: str
    number: int = 0
    code: int = 0
    """Number of the kind of the event."""
    later: bool = False
    """It came while a fault was on already."""


class RecordingTrigger:
    """Divides events into recordings: within one fault at most one begins in 10 s.

    What comes in between is put off: the newest event of it begins a recording then, and the others are in the ten
    seconds before that. The events' own instants decide, so that a gateway that finds old ones divides them as the one
    before it did: those of CLOCK_MONOTONIC, because the wall clock may be set by hours just then.

    Args:
        names: of the arm, for the texts and for what is a fault.
    """

    def __init__(self, names: Names) -> None:
        self._names = names
        self.on = False
        """A fault is on."""
        self._later: FaultRecord | None = None
        self._ends_ns = self._next_ns = 0
        """When the newest recording ends, and from when on another may begin; CLOCK_MONOTONIC."""

    def begun(self, events: Sequence[EventRecord], now_ns: int) -> list[FaultRecord]:
        """Return what begins a recording, of new events and of what was put off; `now_ns`: CLOCK_MONOTONIC."""
        found: list[FaultRecord] = []
        for event in events:
            found += self._due(event.monotonic_ns)
            if isinstance(event.event, ResetDone):
                found += self.put_off()
                self.on = False
            elif type(event.event) in self._names.faults:
                what = self._names.message(event.event)
                found += self.met(
                    FaultRecord(event.time_ns, event.monotonic_ns, what, event.number, event.event.number)
                )
        return found + self._due(now_ns)

    def put_off(self) -> list[FaultRecord]:
        """Return what was put off: it begins its recording now."""
        if self._later is None:
            return []
        fault, self._later = self._later, None
        self._begin(fault, max(self._next_ns, fault.monotonic_ns))
        return [fault]

    def met(self, fault: FaultRecord) -> list[FaultRecord]:
        """Return what a fault begins: its own recording, or that of what was put off."""
        fault = replace(fault, later=self.on)
        if not self.on:
            self.on = True
            before = self.put_off()
            self._begin(fault, fault.monotonic_ns)
            return [*before, fault]
        # A silence shows only after it has begun: no recording that began before has it.
        if fault.monotonic_ns > self._ends_ns or not fault.number:
            self._later = fault
        return self._due(fault.monotonic_ns)

    def _due(self, now_ns: int) -> list[FaultRecord]:
        return self.put_off() if now_ns >= self._next_ns else []

    def _begin(self, fault: FaultRecord, begun_ns: int) -> None:
        self._ends_ns = fault.monotonic_ns + round(AFTER_S * 1e9)
        self._next_ns = begun_ns + round(BEFORE_S * 1e9)


class BlackBox:
    """Watches one platform and writes its faults.

    Args:
        observer: the blackboard; it is read in another thread too.
        session: what was started.
        directory: where the files go.
        report: called with messages on what was written or could not be; from any thread.
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
        """When the fault that is on was seen."""
        self._head, self._head_at = observer.head, time.monotonic()
        self._silent = False
        self._dead = self._end_wanted = False
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="blackbox")
        self._over = threading.Event()
        """Nobody is there to wait for what follows a fault."""
        if faults := self._begun():
            self._writer.submit(self._make_up_for, faults)

    # -- when -------------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Look for faults that have begun; a few times in each tenth of a second."""
        if self._over.is_set():
            return
        for fault in self._begun():
            self._writer.submit(self._record, fault)
        now = time.monotonic()
        self._listen(now)
        if self._events.on and now - self._since > AFTER_S and not (self._silent or self._machine_in_fault()):
            # Not every event of this kind leads to a state that only a reset ends.
            self._events.on = False

    def end_is_wanted(self) -> None:
        """The loop is told to end: from here on neither its silence nor its end is a fault."""
        self._end_wanted = True

    def loop_has_ended(self) -> None:
        """Record that the loop's process has ended without having been told to."""
        if self._dead:
            return
        self.look()
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
            self._writer.submit(self._make_up_for, [FaultRecord(_wall(last_ns), last_ns, sentence)])

    def finish(self) -> None:
        """Write what is still to be written and return when it is; a second time is harmless."""
        self.look()
        for fault in self._events.put_off():
            self._writer.submit(self._record, fault)
        self._over.set()
        self._writer.shutdown()

    def _begun(self) -> list[FaultRecord]:
        """Return the faults that events have begun since the last look."""
        events = self._observer.events_since(self._event)
        self._event = events[-1].number if events else self._event
        if found := self._events.begun(events, time.monotonic_ns()):
            self._since = time.monotonic()
        return found

    def _listen(self, now: float) -> None:
        head = self._observer.head
        if head != self._head:
            self._head, self._head_at = head, now
            if self._silent:
                self._silent = False
                self._since = now  # a fault that it finds itself in shows a little later
                self._say(f"the loop (process {self._observer.loop_pid}) publishes again")
        elif now - self._head_at > SILENT_S and not (self._silent or self._dead or self._end_wanted):
            self._silent = True
            since_ns = time.monotonic_ns() - round((now - self._head_at) * 1e9)
            self._process_fault(since_ns, f"has published nothing for {SILENT_S:g} s; {_WATCHDOG}")

    def _machine_in_fault(self) -> bool:
        latest = self._observer.latest()
        return latest is not None and State(int(latest["state"][0])) in _IN_FAULT

    def _process_fault(self, monotonic_ns: int, what: str) -> None:
        sentence = f"the loop (process {self._observer.loop_pid}) {what}"
        self._say(sentence)
        if self._over.is_set():
            return
        fault = FaultRecord(_wall(monotonic_ns), monotonic_ns, sentence)
        # Nothing comes after its end that would have to be kept apart from it.
        begun = [fault] if self._dead else self._events.met(fault)
        self._since = time.monotonic()
        for one in begun:
            self._writer.submit(self._record, one)

    def _say(self, sentence: str) -> None:
        log.error("%s", sentence)
        self._report(sentence)

    # -- what; in the writer's thread -------------------------------------------------------------------------------

    def _make_up_for(self, faults: Sequence[FaultRecord]) -> None:
        """Record faults that began before this gateway did, unless that was done or they have left the ring."""
        try:
            abouts = [one.about for one in listed(self._directory) if one.about is not None]
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
            # At once: a short cycle's ring is soon written over.
            before, _ = self._observer.since(0)
            ends_ns = fault.monotonic_ns + round(AFTER_S * 1e9)
            self._over.wait(0.0 if self._dead else max((ends_ns - time.monotonic_ns()) * 1e-9, 0.0))
            after, _ = self._observer.since(int(before["number"][-1]) if len(before) else 0)
            recording = self._recording(fault, before, after, min(ends_ns, time.monotonic_ns()))
            number, path = write(self._directory, recording)
        except RecordingError as error:
            self._say(f"black box: {error}")
        except Exception as error:
            # One fault's recording is lost, and said to be; the next is tried again.
            self._defect("a fault was not recorded", error)
        else:
            sentence = f"black box: this fault is number {number} (`rtcp faults show {number}`)"
            log.info("%s: %s", sentence, path)
            self._report(sentence)

    def _defect(self, what: str, error: Exception) -> None:
        log.exception("black box")
        self._say(f"black box: {what}, by a defect: {type(error).__name__} {error}")

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
        records = tool.add(records)
        return FaultRecording(about, {name: records[name] for name in tool.schema.names}, tool.schema)

    def _timeline(self, fault: FaultRecord, ends_ns: int) -> tuple[tuple[Moment, ...], list[str]]:
        """Return what was said in the recording's time, and what of that is lost."""
        events, texts = self._observer.events_since(0), self._observer.texts_since(0)
        # Counted from the fault, however the wall clock is set meanwhile. A text has its wall time alone.
        said = [(event.monotonic_ns - fault.monotonic_ns, self._names.message(event.event)) for event in events]
        said += [(text.time_ns - fault.time_ns, text.sentence) for text in texts]
        said += [(0, fault.what)] if not fault.number else []
        begins_ns, ends_ns = -round(BEFORE_S * 1e9), ends_ns - fault.monotonic_ns
        notes = []
        oldest = [("events", EVENTS, one.number, one.monotonic_ns - fault.monotonic_ns) for one in events[:1]]
        oldest += [("messages", TEXTS, one.number, one.time_ns - fault.time_ns) for one in texts[:1]]
        for name, room, number, away_ns in oldest:
            if number > 1 and away_ns > begins_ns:
                notes.append(f"more than {room} {name} came: those before {away_ns * 1e-9:+.1f} s are lost")
        kept = sorted((one for one in said if begins_ns <= one[0] <= ends_ns), key=lambda one: one[0])
        return tuple(Moment(fault.time_ns + away_ns, message) for away_ns, message in kept), notes


def _place(records: npt.NDArray[np.void], fault: FaultRecord, newest: int) -> int:
    """Return the index of the cycle in which the fault began, -1 without records; `newest` was the last one then."""
    if not len(records):
        return -1
    if not fault.number:
        return max(newest, 0)
    codes = records["fault"].astype(np.int64)
    begins = np.flatnonzero((codes == fault.code) & (np.concatenate([[0], codes[:-1]]) != fault.code))
    away = np.abs(records["time_ns"] - fault.monotonic_ns)
    # An event that is no fault of the machine's state, or not its first, has no such cycle: the clock tells.
    own = len(begins) and not fault.later
    return int(begins[np.argmin(away[begins])]) if own else int(np.argmin(away))


def _wall(monotonic_ns: int) -> int:
    """Return what the wall clock, as it is set now, showed at an instant of CLOCK_MONOTONIC."""
    return monotonic_ns - time.monotonic_ns() + time.time_ns()


def _state(records: npt.NDArray[np.void], at: int) -> str:
    if not len(records):
        return "unknown"
    return State(int(records["state"][max(at, 0)])).words


def _silent_s(records: npt.NDArray[np.void], first: int) -> float:
    """Return how long nothing was published before the first record that is kept; 0 where none is known before it."""
    if not first or int(records["number"][first - 1]) + 1 != int(records["number"][first]):
        return 0.0
    return float(records["time_ns"][first] - records["time_ns"][first - 1]) * 1e-9


def _lacking(records: npt.NDArray[np.void], at: int, silent_s: float) -> list[str]:
    """Return in sentences which cycles of the recording's time are not in it; `silent_s` passed before its first."""
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
