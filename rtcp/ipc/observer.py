"""The observer's end of the blackboard: it reads cycle records and events, and commands the loop under a lease."""

from __future__ import annotations

import contextlib
import fcntl
import json
import mmap
import os
import struct
import time
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.ipc import stops
from rtcp.ipc.commands import Command
from rtcp.ipc.events import EVENTS as EVENT_KINDS
from rtcp.ipc.events import Event
from rtcp.ipc.layout import (
    ANSWER,
    ANSWER_AT,
    ANSWER_NUMBER_AT,
    COMMAND,
    COMMAND_HEAD_AT,
    COMMAND_SIZE,
    COMMAND_TAKEN_AT,
    COMMANDS,
    COMMANDS_AT,
    EVENT,
    EVENT_SIZE,
    EVENTS,
    EVENTS_AT,
    EVENTS_HEAD_AT,
    HEADER,
    HEALTH_AT,
    HEALTH_SIZE,
    LEASE_DURATION_AT,
    LEASE_HOLDER_AT,
    LEASE_HOLDER_SIZE,
    LEASE_ID_AT,
    LEASE_RENEWED_AT,
    MAGIC,
    PORTS,
    RECORDS_AT,
    RECORDS_HEAD_AT,
    SCHEMA_AT,
    SCHEMA_SIZE,
    SERVICE_LENGTH_AT,
    SERVICE_STATE_AT,
    SERVICE_TEXT_AT,
    SERVICE_TEXT_SIZE,
    SETPOINT,
    SETPOINT_HEAD_AT,
    SETPOINT_TAKEN_AT,
    SETPOINTS,
    SETPOINTS_AT,
    SLAVES_AT,
    STREAM_AT,
    TEMPERATURE,
    AtomicWords,
    file_size,
    records_for,
    write_plan,
    write_rows,
)
from rtcp.ipc.message import MalformedMessage
from rtcp.ipc.refusals import REFUSALS, Refusal
from rtcp.ipc.schema import RecordSchema, SchemaError

INFORMATION, WARNING, ERROR = 2, 3, 4
"""Levels of a message, as in `foxglove.Log`."""
NUMBER_AGAIN, PADDING = "_number_again", "_padding"
"""Follow the fields of a record in the ring; no field's name begins with an underscore."""


def numpy_fields(schema: RecordSchema) -> list[Any]:
    """Return the fields as numpy describes them."""
    return [(field.name, np.dtype(field.type).newbyteorder("<"), field.shape) for field in schema.fields]


def record_type(schema: RecordSchema) -> np.dtype[np.void]:
    """Return the numpy type of a cycle record in the ring: the schema's fields, padded to its size."""
    padding = schema.size - struct.calcsize(schema.format)
    return np.dtype([*numpy_fields(schema), (NUMBER_AGAIN, "<u8"), (PADDING, "u1", (padding,))])


class BlackboardError(Exception):
    """The blackboard is missing, damaged, of another version, or its loop hangs; the message is a sentence."""


class LeaseRefused(Exception):
    """Another commander holds the lease; `holder` names it."""

    def __init__(self, holder: str) -> None:
        super().__init__(f"the arm is commanded by {holder}: wait until it has finished, or stop it")
        self.holder = holder


@dataclass(frozen=True)
class EventRecord:
    """An event of the loop, and when it happened."""

    number: int
    time_ns: int
    """CLOCK_REALTIME, for display: this clock may be set forwards and back."""
    monotonic_ns: int
    """CLOCK_MONOTONIC, as in the cycle records."""
    event: Event


@dataclass(frozen=True)
class Health:
    """Counters of a slave since the start: times that it left OP and came back, errors of its ports."""

    lost: int
    recovered: int
    temperature: float
    """C; NaN: unknown."""
    rx: tuple[int, ...]
    """Damaged frames received at each port."""
    forwarded: tuple[int, ...]
    """Damaged frames received at each port that a slave before had counted."""
    links: tuple[int, ...]
    """Lost links of each port."""


@dataclass(frozen=True)
class Answer:
    """The loop's answer to a command; no refusal: it was accepted."""

    refusal: Refusal | None


_LOCK_ATTEMPTS, _LOCK_WAIT_S = 50, 0.002
_NEARLY_OVERWRITTEN = 64
"""Oldest records of the ring that are not read, since the loop may overwrite them meanwhile."""


class Observer:
    """Reads and commands a blackboard.

    Args:
        path: the blackboard's file.

    Raises:
        BlackboardError: it cannot be opened or is of another version.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise BlackboardError(f"blackboard {path} cannot be opened: {error.strerror}") from error
        # Also where nobody closes the observer: of a simulation it would keep 20 MB.
        self._close_file = weakref.finalize(self, os.close, self._descriptor)
        size = os.fstat(self._descriptor).st_size
        if size < RECORDS_AT or size % 8:
            self._close_file()
            raise BlackboardError(f"blackboard {path} is cut short: {size} bytes, at least {RECORDS_AT} expected")
        self._map = mmap.mmap(self._descriptor, size)
        self._words = AtomicWords(self._map)
        magic, length, record_size, records, _, _, _, period, pid, _ = HEADER.unpack_from(self._map, 0)
        schema = None
        if magic == MAGIC and length <= SCHEMA_SIZE:
            with contextlib.suppress(SchemaError):
                schema = RecordSchema.from_definition(self._map[SCHEMA_AT : SCHEMA_AT + length])
        whole = schema is not None and period > 0 and records == records_for(period)
        if schema is None or not whole or record_size != schema.size or size != file_size(record_size, records):
            self.close()
            raise BlackboardError(f"blackboard {path} is not of this version (magic 0x{magic:X}): start anew")
        self.schema = schema
        self.period_ns = int(period)
        self.loop_pid = int(pid)
        self._dtype = record_type(schema)
        self.records = int(records)
        """Capacity of the ring, cycle records."""
        self._ring = np.frombuffer(self._map, dtype=self._dtype, count=self.records, offset=RECORDS_AT)

    def close(self) -> None:
        """Unmap the file and close it; may be called again."""
        if not self._close_file.alive:
            return
        if hasattr(self, "_ring"):
            del self._ring
        self._words.close()
        self._map.close()
        self._close_file()

    # -- records ------------------------------------------------------------------------------------------------

    @property
    def head(self) -> int:
        """Number of the last record published; 0 before the first."""
        return self._words.acquire(RECORDS_HEAD_AT)

    def latest(self) -> npt.NDArray[np.void] | None:
        """Return the last record, shape (1,), or None before the first."""
        for _ in range(100):
            records, _ = self.since(self.head - 1)
            if len(records):
                return records[-1:]
            if self.head == 0:
                return None
        return None

    def since(self, number: int) -> tuple[npt.NDArray[np.void], int]:
        """Return the records after `number`, oldest first, and how many of them were lost to this reader.

        Lost are those overwritten before they were read, and torn ones.
        """
        head = self.head
        first = max(number + 1, head - self.records + _NEARLY_OVERWRITTEN, 1)
        if head < first:
            return np.empty(0, dtype=self._dtype), 0
        numbers = np.arange(first, head + 1, dtype=np.uint64)
        copied = self._ring[(numbers % np.uint64(self.records)).astype(np.intp)]
        # Records that the writer has reached meanwhile may be torn although both numbers agree: they are dropped.
        self._words.fence()
        overtaken = self.head - self.records + 1
        whole = (copied["number"] == numbers) & (copied[NUMBER_AGAIN] == numbers) & (numbers > max(overtaken, 0))
        kept = copied[whole]
        return kept, int(head - max(number, 0)) - len(kept)

    # -- events ---------------------------------------------------------------------------------------------------

    @property
    def last_event(self) -> int:
        """Number of the last event; 0 before the first."""
        return self._words[EVENTS_HEAD_AT]

    def events_since(self, number: int) -> list[EventRecord]:
        """Return the events after `number`, oldest first."""
        words = self._words
        head = words.acquire(EVENTS_HEAD_AT)
        events = []
        for wanted in range(max(number + 1, head - EVENTS + 1, 1), head + 1):
            at = EVENTS_AT + (wanted % EVENTS) * EVENT_SIZE
            if words.acquire(at) != wanted:
                continue
            _, when, monotonic, kind = EVENT.unpack_from(self._map, at)
            # An event may be overwritten while it is read, or be of a kind that this process lacks.
            with contextlib.suppress(MalformedMessage):
                event = EVENT_KINDS.unpack_from(kind, self._map, at + EVENT.size)
                words.fence()
                if words[at] == wanted:
                    events.append(EventRecord(wanted, when, monotonic, event))
        return events

    def slaves(self, count: int) -> list[tuple[int, int]]:
        """Return AL status and AL status code of the first `count` slaves."""
        words = [self._words[SLAVES_AT + i * 8] for i in range(count)]
        return [(word & 0xFFFF, word >> 16 & 0xFFFF) for word in words]

    def health(self, count: int) -> list[Health]:
        """Return the counters of the first `count` slaves."""
        slaves = []
        for at in range(HEALTH_AT, HEALTH_AT + count * HEALTH_SIZE, HEALTH_SIZE):
            life, *ports = [self._words[at + 8 * word] for word in range(1 + PORTS)]
            counts = zip(*((word & 0xFF_FFFF, word >> 24 & 0xFF_FFFF, word >> 48) for word in ports), strict=True)
            (temperature,) = TEMPERATURE.unpack((life >> 32).to_bytes(4, "little"))
            slaves.append(Health(life & 0xFFFF, life >> 16 & 0xFFFF, temperature, *counts))
        return slaves

    # -- the lease ----------------------------------------------------------------------------------------------

    def holder(self) -> str:
        """Return the name of the lease's holder; empty: none, or it has expired."""
        if self._words[LEASE_ID_AT] == 0 or self._is_expired():
            return ""
        name = bytes(self._map[LEASE_HOLDER_AT : LEASE_HOLDER_AT + LEASE_HOLDER_SIZE])
        printable = "".join(letter for letter in name.decode(errors="replace") if letter.isprintable())
        return printable or "an unnamed commander"

    def _is_expired(self) -> bool:
        return time.monotonic_ns() - self._words[LEASE_RENEWED_AT] > self._words[LEASE_DURATION_AT]

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        for attempt in range(_LOCK_ATTEMPTS):
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if attempt == _LOCK_ATTEMPTS - 1:
                    held_s = _LOCK_ATTEMPTS * _LOCK_WAIT_S
                    message = f"another process has locked the lease for {held_s:g} s: it hangs or is suspended"
                    raise BlackboardError(message) from None
                time.sleep(_LOCK_WAIT_S)
        try:
            yield
        finally:
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)

    def acquire(self, name: str, duration_s: float) -> int:
        """Acquire the lease for `name`; return its id.

        Raises:
            LeaseRefused: while another holds it.
        """
        with self._locked():
            if holder := self.holder():
                raise LeaseRefused(holder)
            words, now = self._words, time.monotonic_ns()
            words[LEASE_ID_AT] = 0
            words.fence()
            encoded = name.encode()[:LEASE_HOLDER_SIZE].ljust(LEASE_HOLDER_SIZE, b"\0")
            self._map[LEASE_HOLDER_AT : LEASE_HOLDER_AT + LEASE_HOLDER_SIZE] = encoded
            words[LEASE_DURATION_AT] = int(duration_s * 1e9)
            words[LEASE_RENEWED_AT] = now
            words.release(LEASE_ID_AT, now)
            return now

    def renew(self, lease: int) -> bool:
        """Renew the lease; return False if it has expired or another has replaced it."""
        with self._locked():
            if self._words[LEASE_ID_AT] != lease or self._is_expired():
                return False
            self._words[LEASE_RENEWED_AT] = time.monotonic_ns()
            return True

    def release(self, lease: int) -> None:
        """Release the lease; no effect if another commander holds it."""
        with self._locked():
            if self._words[LEASE_ID_AT] == lease:
                self._words[LEASE_ID_AT] = 0

    # -- commands -----------------------------------------------------------------------------------------------

    @property
    def commands_sent(self) -> int:
        """Number of the last command in the ring; 0 before the first."""
        return self._words[COMMAND_HEAD_AT]

    @property
    def commands_taken(self) -> int:
        """Number of the last command that the loop has taken out of the ring."""
        return self._words[COMMAND_TAKEN_AT]

    def stop(self, kind: type[Command], requested_ns: int = 0) -> int:
        """Request a stop; return its instant. Any process may do this at any time (`rtcp.ipc.stops.request`)."""
        return stops.request(self._words, kind, requested_ns)

    def stop_answer(self, kind: type[Command], requested_ns: int) -> Answer | None:
        """Return the loop's answer to a stop, or None while there is none."""
        refusal = stops.refusal(self._words, kind, requested_ns)
        return (Answer(None) if refusal else None) if isinstance(refusal, bool) else Answer(refusal)

    def command(self, lease: int, command: Command, requested_ns: int = 0) -> int:
        """Put a command into the ring; return its number. The lease's holder is the only writer.

        Args:
            lease: of the commander.
            command: the command.
            requested_ns: when it was requested, CLOCK_MONOTONIC, ns; 0: now. The loop refuses it after a later stop.

        Raises:
            BlackboardError: the ring is full: the loop takes no commands any more.
        """
        number = self._words[COMMAND_HEAD_AT] + 1
        if number - self._words.acquire(COMMAND_TAKEN_AT) > COMMANDS:
            raise BlackboardError("the loop takes no commands: its process hangs or is gone")
        at = COMMANDS_AT + (number % COMMANDS) * COMMAND_SIZE
        COMMAND.pack_into(self._map, at, number, lease, requested_ns or time.monotonic_ns(), command.number)
        command.pack_into(self._map, at + COMMAND.size)
        self._words.release(COMMAND_HEAD_AT, number)
        return number

    def setpoint(self, stream: int, bits: int, stamp_s: float, numbers: Sequence[float]) -> bool:
        """Put a setpoint into its ring; return False where the stream has ended. The stream's owner is the only writer.

        Args:
            stream: its number.
            bits: `SETPOINT_...` of `rtcp.ipc.layout`.
            stamp_s: time stamp of the sender, s.
            numbers: 3 x `MOST_AXES`: positions, rad, velocities, rad/s, accelerations, rad/s^2.

        Raises:
            BlackboardError: the ring is full: setpoints arrive faster than the loop takes them, or it hangs.
            struct.error: an entry of `numbers` is not a number.
        """
        words = self._words
        if words[STREAM_AT] != stream:
            return False
        number = words[SETPOINT_HEAD_AT] + 1
        if number - words.acquire(SETPOINT_TAKEN_AT) > SETPOINTS:
            raise BlackboardError(f"{SETPOINTS} setpoints wait: they come faster than the loop takes them, or it hangs")
        at = SETPOINTS_AT + (number % SETPOINTS) * SETPOINT.size
        SETPOINT.pack_into(self._map, at, number, stream, bits, stamp_s, *numbers)
        words.release(SETPOINT_HEAD_AT, number)
        return True

    @property
    def open_stream(self) -> int:
        """Number of the stream whose setpoints the loop tracks; 0: none."""
        return self._words[STREAM_AT]

    @property
    def setpoints_taken(self) -> int:
        """How many setpoints the loop has taken since the start."""
        return self._words[SETPOINT_TAKEN_AT]

    def write_plan(self, rows: Sequence[Sequence[float]]) -> int:
        """Write a plan, rows of up to 20 numbers, for a command with the returned slot.

        Raises:
            PlanTooLong: it does not fit.
        """
        return write_plan(self._map, self._words, rows)

    def extend_plan(self, slot: int, first: int, rows: Sequence[Sequence[float]]) -> None:
        """Write more rows of the open plan in a slot, from number `first` on; raises PlanTooLong."""
        write_rows(self._map, self._words, slot, first, rows)

    def answer(self, number: int) -> Answer | None:
        """Return the loop's answer to the command `number`, or None while there is none."""
        if self._words.acquire(ANSWER_NUMBER_AT) != number:
            return None
        (kind,) = ANSWER.unpack_from(self._map, ANSWER_AT)
        return Answer(REFUSALS.unpack_from(kind, self._map, ANSWER_AT + ANSWER.size) if kind else None)

    # -- the service thread -------------------------------------------------------------------------------------

    def ask_service(self, request: dict[str, Any]) -> None:
        """Write a request for the service thread. The caller ensures one at a time."""
        text = json.dumps(request).encode()
        if len(text) > SERVICE_TEXT_SIZE:
            raise BlackboardError(f"the request is {len(text)} bytes long, at most {SERVICE_TEXT_SIZE} fit")
        self._map[SERVICE_TEXT_AT : SERVICE_TEXT_AT + len(text)] = text
        self._words[SERVICE_LENGTH_AT] = len(text)
        self._words.release(SERVICE_STATE_AT, 1)

    def service_answer(self) -> dict[str, Any] | None:
        """Return the service thread's answer, or None while there is none."""
        if self._words.acquire(SERVICE_STATE_AT) != 2:
            return None
        length = self._words[SERVICE_LENGTH_AT]
        answer: dict[str, Any] = json.loads(bytes(self._map[SERVICE_TEXT_AT : SERVICE_TEXT_AT + length]))
        self._words.release(SERVICE_STATE_AT, 0)
        return answer
