"""The layout of the blackboard: one file in memory, mapped by the loop, its readers and commanders.

| offset | what | written by |
|---|---|---|
| 0 | header: magic, sizes, period, loop's pid | loop, once |
| 128 | lease: id, renewed at, duration, holder's name | commanders, under a file lock |
| 256 | command head; 264: commands taken; 272: number of the last answer | commander; loop; loop |
| 280 | setpoint head; 288: setpoints taken; 296: open stream | commander; loop; loop |
| 304 | stops: requested at, handled, answer of each kind | any process; loop; loop |
| 384 | published records; published events | loop |
| 512 | request and answer of the service thread | commander; service thread |
| 1024 | slave states | service thread |
| 3072 | slave health: lost, recovered, temperature, error counters | service thread |
| 15360 | answer to the last command | loop |
| 16384 | service text, events, commands, setpoints, plans, schema, cycle records | loop and commanders |

Nothing here imports numpy: the loop's process could not join a user namespace with its threads.
"""

from __future__ import annotations

import math
import mmap
import struct
import threading
from collections.abc import Sequence
from typing import Final

from rtcp.config.model import MOST_AXES
from rtcp.ipc.message import PAYLOAD_SIZE

MAGIC = 0x5254_4350_0000_000C
HEADER = struct.Struct("<QIIIIIiQIi")
"""magic, length of the schema, record size, records, commands, events, reserved, period ns, loop pid, reserved"""

LEASE_ID_AT: Final = 128
"""0: free. Written last when the lease is taken."""
LEASE_RENEWED_AT: Final = 136
"""CLOCK_MONOTONIC, ns"""
LEASE_DURATION_AT: Final = 144
"""ns"""
LEASE_HOLDER_AT: Final = 152
LEASE_HOLDER_SIZE: Final = 64

COMMAND_HEAD_AT: Final = 256
COMMAND_TAKEN_AT: Final = 264
ANSWER_NUMBER_AT: Final = 272
"""Number of the command that the answer belongs to; written last."""
SETPOINT_HEAD_AT: Final = 280
SETPOINT_TAKEN_AT: Final = 288
STREAM_AT: Final = 296
"""Number of the stream whose setpoints the loop tracks; 0: none, or it has ended."""
STOPS_AT: Final = 304
"""Three words for each kind of stop (`rtcp.ipc.stops`): CLOCK_MONOTONIC, ns, of the last request; of the last request
that the loop has handled; the answer to it (0: accepted, else 1 + the state that refuses it)."""
STOP_SIZE: Final = 24
ANSWER_AT: Final = 15360
ANSWER = struct.Struct("<Q")
"""number of the refusal's kind (0: accepted); its fields follow (`rtcp.ipc.message`)"""

RECORDS_HEAD_AT: Final = 384
EVENTS_HEAD_AT: Final = 392

PLAN_IN_USE_AT: Final = 408
"""Slot of the plan that the loop reads from, plus 1; 0: none."""

SERVICE_STATE_AT: Final = 512
"""0 idle, 1 requested, 2 answered"""
SERVICE_LENGTH_AT: Final = 520
SERVICE_TEXT_AT: Final = 16384
SERVICE_TEXT_SIZE: Final = 8192

SLAVES_AT: Final = 1024
"""A word a slave: AL status (state, error bit; 0: no answer), AL status code << 16."""
SLAVES_MAX: Final = 256

HEALTH_AT = SLAVES_AT + SLAVES_MAX * 8
PORTS: Final = 4
HEALTH_SIZE = 8 * (1 + PORTS)
"""A word of a slave: times it left OP | times it came back << 16 | its temperature << 32 (C, float32; NaN: unknown);
then one for each port: damaged frames received | damaged frames forwarded << 24 | lost links << 48."""
TEMPERATURE = struct.Struct("<f")

EVENTS_AT = SERVICE_TEXT_AT + SERVICE_TEXT_SIZE
EVENT = struct.Struct("<QqqQ")
"""number, CLOCK_REALTIME ns, CLOCK_MONOTONIC ns, number of the event's kind; its fields follow (`rtcp.ipc.message`)"""
EVENT_SIZE = EVENT.size + PAYLOAD_SIZE
EVENTS: Final = 2048
"""Slaves whose emergencies change all the time, seven of them, fill it in 9 minutes: until then a fault stays in it."""

COMMANDS_AT = EVENTS_AT + EVENTS * EVENT_SIZE
COMMAND = struct.Struct("<QQQQ")
"""number, lease id, CLOCK_MONOTONIC ns of its request, number of its kind; its fields follow (`rtcp.ipc.message`)"""
COMMAND_SIZE = COMMAND.size + PAYLOAD_SIZE
COMMANDS: Final = 64

SETPOINTS_AT = COMMANDS_AT + COMMANDS * COMMAND_SIZE
SETPOINT = struct.Struct(f"<QQQd{3 * MOST_AXES}d")
"""number, number of the stream, `SETPOINT_...` bits, time stamp, s; positions, rad, velocities, rad/s, accelerations,
rad/s^2, `MOST_AXES` each"""
SETPOINTS: Final = 256
SETPOINT_HAS_VELOCITY, SETPOINT_HAS_ACCELERATION, SETPOINT_ENDS = 1, 2, 4
"""Bits of a setpoint. One with the last bit has no numbers: it brings the arm to rest and ends the stream."""

PLAN_ROWS, PLAN_COLUMNS = 4096, 2 + 3 * MOST_AXES
"""A plan: rows of doubles, each a waypoint of a trajectory or a straight piece (`rtcp.motion.planning.plan`)."""
_ROW = struct.Struct(f"<{PLAN_COLUMNS}d")
PLAN_SIZE = PLAN_ROWS * PLAN_COLUMNS * 8
PLANS: Final = 2
"""Slots: one is written while the plan in the other runs."""
PLANS_AT = (SETPOINTS_AT + SETPOINTS * SETPOINT.size + 4095) & ~4095

SCHEMA_AT = (PLANS_AT + PLANS * PLAN_SIZE + 4095) & ~4095
SCHEMA_SIZE = 1 << 18
"""The schema of the cycle records (`rtcp.ipc.schema`), a message definition: written once, by the loop."""

RECORDS_AT = (SCHEMA_AT + SCHEMA_SIZE + 4095) & ~4095
RECORDS = 1 << 15
"""Length of the ring for cycles of 366 us and longer; shorter cycles have a longer one, see `records_for`."""
RING_S: Final = 12.0
"""Least duration of a ring, s: the time recorded before a fault, and the time to read it."""


def records_for(period_ns: int) -> int:
    """Return how many cycle records the ring of a cycle has: a power of two, `RING_S` seconds at least."""
    return max(RECORDS, 1 << (math.ceil(RING_S * 1e9 / period_ns) - 1).bit_length())


def file_size(record_size: int, records: int) -> int:
    """Return the size of a whole blackboard."""
    return RECORDS_AT + records * record_size


class AtomicWords:
    """64-bit unsigned words of a mapped file, by byte offset (a multiple of 8), each read and written by one access.

    `struct` does not do that: `pack_into` clears the buffer first, and "<Q" goes byte by byte, so that another process
    could see a lease of 0 or half of a counter.
    """

    def __init__(self, memory: mmap.mmap) -> None:
        self._view = memoryview(memory)
        self.plain = self._view.cast("Q")
        """The words by their index: for every cycle."""
        self._lock = threading.Lock()

    def __getitem__(self, at: int) -> int:
        return self.plain[at >> 3]

    def __setitem__(self, at: int, value: int) -> None:
        self.plain[at >> 3] = value

    def acquire(self, at: int) -> int:
        """Return a word; what is read afterwards is at least as new, also on weakly ordered CPUs (aarch64)."""
        value = self.plain[at >> 3]
        self.fence()
        return value

    def release(self, at: int, value: int) -> None:
        """Write a word; who acquires the value sees all that was written before, and all reads before are done."""
        self.fence()
        self.plain[at >> 3] = value

    def fence(self) -> None:
        """Order the reads and writes before against those after, also on weakly ordered CPUs, by locking twice."""
        lock = self._lock
        lock.acquire()
        lock.release()
        lock.acquire()
        lock.release()

    def close(self) -> None:
        """Release the views; the file can be unmapped only afterwards."""
        self.plain.release()
        self._view.release()


class PlanTooLong(ValueError):
    """The plan has more rows than a slot holds."""


def plan_slot(memory: mmap.mmap, slot: int) -> memoryview[float]:
    """Return the doubles of a slot of the plan area, row by row."""
    at = PLANS_AT + slot * PLAN_SIZE
    return memoryview(memory)[at : at + PLAN_SIZE].cast("d")


def write_plan(memory: mmap.mmap, words: AtomicWords, rows: Sequence[Sequence[float]]) -> int:
    """Write a plan into the slot that the loop does not read from, and return that slot. Only under the lease.

    Raises:
        PlanTooLong: with the number of rows and how many fit.
    """
    slot = 0 if words[PLAN_IN_USE_AT] != 1 else PLANS - 1
    write_rows(memory, words, slot, 0, rows)
    return slot


def write_rows(memory: mmap.mmap, words: AtomicWords, slot: int, first: int, rows: Sequence[Sequence[float]]) -> None:
    """Write rows of a plan from number `first` on; a slot is a ring of them. Raises PlanTooLong as `write_plan`."""
    if len(rows) > PLAN_ROWS:
        raise PlanTooLong(f"the plan has {len(rows)} rows, at most {PLAN_ROWS} fit: give fewer points")
    for number, row in enumerate(rows, first):
        at = PLANS_AT + slot * PLAN_SIZE + number % PLAN_ROWS * PLAN_COLUMNS * 8
        _ROW.pack_into(memory, at, *row, *[0.0] * (PLAN_COLUMNS - len(row)))
    words.fence()
