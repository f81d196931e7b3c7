"""The loop's end of the blackboard: it writes cycle records and events, and takes commands.

Writers and readers share no lock. A record carries its number at both ends, the first written last: a reader that
finds two different numbers, or another than it expects, knows that the record is torn or overwritten.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import struct
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from rtcp.ipc.commands import COMMANDS as COMMAND_KINDS
from rtcp.ipc.commands import Command
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
    LEASE_ID_AT,
    LEASE_RENEWED_AT,
    MAGIC,
    PLAN_IN_USE_AT,
    PLANS,
    PORTS,
    RECORDS_AT,
    RECORDS_HEAD_AT,
    SCHEMA_AT,
    SCHEMA_SIZE,
    SETPOINT,
    SETPOINT_HEAD_AT,
    SETPOINT_TAKEN_AT,
    SETPOINTS,
    SETPOINTS_AT,
    SLAVES_AT,
    SLAVES_MAX,
    STOP_SIZE,
    STOPS_AT,
    STREAM_AT,
    TEMPERATURE,
    AtomicWords,
    file_size,
    plan_slot,
    records_for,
)
from rtcp.ipc.message import MalformedMessage
from rtcp.ipc.refusals import Malformed, Refusal, Superseded, WrongState
from rtcp.ipc.schema import RecordSchema, SchemaError
from rtcp.ipc.stops import STOPS

_OP: Final = 8
"""AL state OP (ETG.1000.6, table 9)."""
_HOTTEST: Final = 1e6  # C
_U16, _U24, _I63 = 0xFFFF, 0xFF_FFFF, (1 << 63) - 1
_AL_STATE = 0x0F


class BlackboardTooLarge(Exception):
    """The file system lacks room for the blackboard: the message says where and how many bytes."""


class Blackboard:
    """The mapped file. The loop's process alone writes it, except for lease, commands, setpoints and plans.

    Args:
        path: file to make, on a memory file system; an older one is replaced.
        schema: of the cycle records.
        period_ns: of the cycle.
        is_resident: whether its memory is taken in full at once, as a cycle in real time needs it.

    Raises:
        SchemaError: the schema is longer than `SCHEMA_SIZE`.
        BlackboardTooLarge: its file system has too little room.
    """

    def __init__(self, path: Path, schema: RecordSchema, period_ns: int, is_resident: bool = True) -> None:
        records, text = records_for(period_ns), schema.definition()
        if len(text) > SCHEMA_SIZE:
            raise SchemaError(f"the schema of the cycle record has {len(text)} bytes, at most {SCHEMA_SIZE} fit")
        size = file_size(schema.size, records)
        self.path = path
        self.schema = schema
        # A new file: processes that still map the old one keep reading its whole content.
        fresh = path.with_name(path.name + f".{os.getpid()}")
        fresh.unlink(missing_ok=True)
        descriptor = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        try:
            if is_resident:
                # A page that is missing later would end the process in the cycle.
                os.posix_fallocate(descriptor, 0, size)
            else:
                room = os.fstatvfs(descriptor)
                if room.f_bavail * room.f_frsize < size:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.ftruncate(descriptor, size)
            self._map = mmap.mmap(descriptor, size)
        except OSError as error:
            fresh.unlink()
            wanted = f"{size / 1e6:.1f} MB ({records} cycle records of {schema.size} bytes)"
            raise BlackboardTooLarge(f"{path}: {wanted} cannot be had: {error.strerror}") from error
        finally:
            os.close(descriptor)
        HEADER.pack_into(
            self._map, 0, MAGIC, len(text), schema.size, records, COMMANDS, EVENTS, 0, period_ns, os.getpid(), 0
        )
        self._map[SCHEMA_AT : SCHEMA_AT + len(text)] = text
        os.replace(fresh, path)
        self._record_size = schema.size
        self._ring_mask = records - 1
        # The record without its first number, which is published last.
        self._pack_record = struct.Struct("<" + schema.format[2:]).pack_into
        self._words = AtomicWords(self._map)
        self._plans = [plan_slot(self._map, slot) for slot in range(PLANS)]
        self._records = 0
        self._events = 0
        self._taken = self._setpoints_taken = 0
        self._stops = [0] * len(STOPS)
        """Instant of the last request of each kind of stop that was taken, ns."""
        self._stopped_ns = 0
        """Instant of the last stop of any kind, ns."""
        self.stream = 0
        """Number of the open stream; 0: none."""
        self._event_lock = threading.Lock()
        for position in range(1, SLAVES_MAX + 1):
            self.health(position, 0, 0, math.nan, [(0, 0, 0)] * PORTS)
        if is_resident:
            # Every page is touched now, so that none is faulted in by the cycle.
            for page in range(0, size, mmap.PAGESIZE):
                self._map[page] = self._map[page]

    def publish(self, values: Sequence[float]) -> None:
        """Append a cycle record: the numbers of the schema's fields but the first, which is the record's own."""
        number = self._records + 1
        at = RECORDS_AT + (number & self._ring_mask) * self._record_size
        words, fence = self._words.plain, self._words.fence
        words[at >> 3] = 0
        fence()
        self._pack_record(self._map, at + 8, *values, number)
        fence()
        words[at >> 3] = number
        self._words.release(RECORDS_HEAD_AT, number)
        self._records = number

    def event(self, event: Event) -> None:
        """Append an event; any thread of the loop's process may call it; a lock serializes them."""
        with self._event_lock:
            number = self._events + 1
            at = EVENTS_AT + (number % EVENTS) * EVENT_SIZE
            # Its number comes last: a reader of the event that was here finds another number afterwards.
            self._words[at] = 0
            self._words.fence()
            EVENT.pack_into(self._map, at, 0, time.time_ns(), time.monotonic_ns(), event.number)
            event.pack_into(self._map, at + EVENT.size)
            self._words.release(at, number)
            self._words.release(EVENTS_HEAD_AT, number)
            self._events = number

    def slave(self, position: int, al_status: int, al_status_code: int) -> None:
        """Note the state of the slave at `position` (from 1)."""
        if 1 <= position <= SLAVES_MAX:
            self._words[SLAVES_AT + (position - 1) * 8] = al_status | al_status_code << 16

    def in_op(self, position: int) -> bool:
        """Whether the slave at `position` was in OP when last noted; always true beyond `SLAVES_MAX`."""
        at = SLAVES_AT + (position - 1) * 8
        return position > SLAVES_MAX or self._words[at] & _AL_STATE == _OP

    def health(
        self, position: int, lost: int, recovered: int, temperature: float, ports: Iterable[tuple[int, int, int]]
    ) -> None:
        """Note how often the slave at `position` left OP and came back, its temperature, C, and its ports' counters.

        Counters of a port: damaged frames received, damaged frames forwarded, lost links.
        """
        if 1 <= position <= SLAVES_MAX:
            at = HEALTH_AT + (position - 1) * HEALTH_SIZE
            # A drive may send any value, also one that neither float32 nor JSON can hold.
            known = temperature if abs(temperature) < _HOTTEST else math.nan
            temperature_bits = int.from_bytes(TEMPERATURE.pack(known), "little")
            self._words[at] = min(lost, _U16) | min(recovered, _U16) << 16 | temperature_bits << 32
            for number, (rx, forwarded, links) in zip(range(1, 1 + PORTS), ports, strict=True):
                self._words[at + 8 * number] = min(rx, _U24) | min(forwarded, _U24) << 24 | min(links, _U16) << 48

    def lease(self) -> tuple[int, int, int]:
        """Return the lease's id (0: free), the instant it was renewed (ns) and its duration (ns)."""
        words = self._words
        lease = words.acquire(LEASE_ID_AT)
        renewed, duration = words[LEASE_RENEWED_AT], words[LEASE_DURATION_AT]
        words.fence()
        # Another commander that acquires the lease meanwhile writes an id of 0 first.
        return lease if words[LEASE_ID_AT] == lease else 0, renewed, duration

    def command_waits(self) -> bool:
        """Whether there is a stop, or a command in the ring, that was not read."""
        words, stops, at = self._words.plain, self._stops, STOPS_AT >> 3
        return (
            words[COMMAND_HEAD_AT >> 3] != self._taken
            or words[at] != stops[0]
            or words[at + 3] != stops[1]
            or words[at + 6] != stops[2]
        )

    def take_command(self) -> tuple[int, int, Command | Malformed | Superseded]:
        """Read the next command: its number for `answer`, the lease id, the command. Only when `command_waits`.

        A stop overtakes the ring; its number is negative. Instead of a command that cannot be read, or that was
        requested before a stop, return its refusal.
        """
        for index, kind in enumerate(STOPS):
            requested_ns = self._words[STOPS_AT + index * STOP_SIZE]
            if requested_ns != self._stops[index]:
                self._stops[index] = requested_ns
                self._stopped_ns = max(self._stopped_ns, requested_ns)
                return -1 - index, 0, kind()
        at = COMMANDS_AT + ((self._taken + 1) % COMMANDS) * COMMAND_SIZE
        self._words.acquire(COMMAND_HEAD_AT)
        number, lease, requested_ns, kind = COMMAND.unpack_from(self._map, at)
        command: Command | Malformed | Superseded
        try:
            command = COMMAND_KINDS.unpack_from(kind, self._map, at + COMMAND.size)
            if requested_ns <= self._stopped_ns and command.superseded_by_stop:
                command = Superseded(command.number)
        except MalformedMessage:
            command = Malformed(kind & _I63)
        self._taken += 1
        # From here on the commander may overwrite the entry.
        self._words.release(COMMAND_TAKEN_AT, self._taken)
        return number, lease, command

    def setpoint_waits(self) -> bool:
        """Whether the ring holds a setpoint that was not read."""
        return self._words[SETPOINT_HEAD_AT] != self._setpoints_taken

    def take_setpoint(self) -> tuple[int, int, float, tuple[float, ...]]:
        """Read the next setpoint: its stream, `SETPOINT_...` bits, stamp, s, and 3 x `MOST_AXES` numbers."""
        self._setpoints_taken += 1
        at = SETPOINTS_AT + (self._setpoints_taken % SETPOINTS) * SETPOINT.size
        self._words.acquire(SETPOINT_HEAD_AT)
        _, stream, bits, stamp_s, *numbers = SETPOINT.unpack_from(self._map, at)
        self._words.release(SETPOINT_TAKEN_AT, self._setpoints_taken)
        return stream, bits, stamp_s, tuple(numbers)

    def open_stream(self, stream: int) -> None:
        """Publish the number of the open stream, whose setpoints the loop tracks; 0: none."""
        self.stream = stream
        self._words[STREAM_AT] = stream

    def answer(self, number: int, refusal: Refusal | None = None) -> None:
        """Answer the command `number`; None: accepted."""
        if number < 0:
            index, words = -1 - number, self._words
            at = STOPS_AT + index * STOP_SIZE
            words[at + 16] = 1 + refusal.state if isinstance(refusal, WrongState) else 0
            words.release(at + 8, self._stops[index])
            return
        if refusal is None:
            ANSWER.pack_into(self._map, ANSWER_AT, 0)
        else:
            ANSWER.pack_into(self._map, ANSWER_AT, refusal.number)
            refusal.pack_into(self._map, ANSWER_AT + ANSWER.size)
        # The number is written last: a reader that sees its own number sees the whole answer.
        self._words.release(ANSWER_NUMBER_AT, number)

    @property
    def memory(self) -> mmap.mmap:
        """The mapped file, for the part that the service thread writes."""
        return self._map

    @property
    def words(self) -> AtomicWords:
        """The mapped file as 64-bit words."""
        return self._words

    def plan(self, slot: int) -> memoryview[float]:
        """Return the doubles of a slot of the plan area, row by row."""
        return self._plans[slot]

    def use_plan(self, slot: int) -> None:
        """Note the slot that the loop reads, so that the next plan is written to the other; -1: none."""
        self._words[PLAN_IN_USE_AT] = slot + 1

    def close(self) -> None:
        """Unmap; the file stays, so that readers still get the last records and events."""
        for view in self._plans:
            view.release()
        self._words.close()
        self._map.close()
