"""The layout of the blackboard: one file in memory, mapped by the loop and by whoever reads or commands it.

| offset | what | written by |
|---|---|---|
| 0 | header: magic, sizes, period, loop's pid | loop, once |
| 128 | lease: id, renewed at, duration, holder's name | commanders, under a file lock |
| 256 | command head; 264: commands taken; 272: answer to the last | commander; loop; loop |
| 384 | published records; published events; published texts | loop |
| 512 | request and answer of the service thread | commander; service thread |
| 1024 | slave states | service thread |
| 3072 | slave health: lost, recovered, error counters | service thread |
| 8192 | service text, texts, events, commands, plans, cycle records | loop and commanders |

Nothing here imports numpy: its threads would keep the loop's process from joining a user namespace.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

MAGIC = 0x5254_4350_0000_0004
HEADER = struct.Struct("<QIIIIIIQIi")
"""magic, joints, record size, records, commands, events, texts, period ns, loop pid, reserved"""

LEASE_ID_AT = 128
"""0: free. Written last when the lease is taken."""
LEASE_RENEWED_AT = 136
"""CLOCK_MONOTONIC, ns"""
LEASE_DURATION_AT = 144
"""ns"""
LEASE_HOLDER_AT = 152
LEASE_HOLDER_SIZE = 64

COMMAND_HEAD_AT = 256
COMMAND_TAKEN_AT = 264
ANSWER_NUMBER_AT = 272
"""Number of the command that the answer belongs to; written last."""
ANSWER_AT = 280
ANSWER = struct.Struct("<Iidd")
"""refusal (0: accepted), axis, value, limit"""

RECORDS_HEAD_AT = 384
EVENTS_HEAD_AT = 392
TEXTS_HEAD_AT = 400

PLAN_IN_USE_AT = 408
"""Slot of the plan that the loop reads from, plus 1; 0: none."""

SERVICE_STATE_AT = 512
"""0 idle, 1 asked, 2 answered"""
SERVICE_LENGTH_AT = 520
SERVICE_TEXT_AT = 8192
SERVICE_TEXT_SIZE = 8192

SLAVES_AT = 1024
"""A word a slave: AL status (state, error bit; 0: no answer), AL status code << 16."""
SLAVES_MAX = 256

HEALTH_AT = SLAVES_AT + SLAVES_MAX * 8
"""Two words a slave: how often it left OP | how often it came back << 16 | lost links << 32; damaged frames that came
in over its cables | damaged frames forwarded << 32."""
HEALTH_SIZE = 16

TEXTS_AT = SERVICE_TEXT_AT + SERVICE_TEXT_SIZE
TEXT = struct.Struct("<QqH502s")
"""number, CLOCK_REALTIME ns, length, UTF-8 text"""
TEXTS = 64

EVENTS_AT = TEXTS_AT + TEXTS * TEXT.size
EVENT = struct.Struct("<QqqIidd")
"""number, CLOCK_REALTIME ns, CLOCK_MONOTONIC ns, code, axis, value, limit"""
EVENTS = 256

COMMANDS_AT = EVENTS_AT + EVENTS * EVENT.size
COMMAND_NUMBERS = 12
COMMAND = struct.Struct(f"<QQI4x{COMMAND_NUMBERS}d")
"""number, lease id, kind, numbers: the joints' first, what else there is from the end (`rtcp.control.orders`)"""
COMMANDS = 64

PLAN_ROWS, PLAN_COLUMNS = 4096, 20
"""A plan: rows of 20 doubles, each a waypoint of a trajectory or a straight piece (`rtcp.motion.planning.plan`)."""
PLAN_SIZE = PLAN_ROWS * PLAN_COLUMNS * 8
PLANS = 2
"""Two places: one is written while the plan in the other runs."""
PLANS_AT = (COMMANDS_AT + COMMANDS * COMMAND.size + 4095) & ~4095

RECORDS_AT = (PLANS_AT + PLANS * PLAN_SIZE + 4095) & ~4095
RECORDS = 1 << 15
"""The ring of a cycle of 366 us and longer; a shorter one has a longer ring, see `records_for`."""
RING_S = 12.0
"""Seconds that every ring holds: those that are written down before a fault, and until they have been read."""

SCALARS = (
    ("number", "Q"),
    ("cycle", "Q"),
    ("time_ns", "q"),
    ("dc_time_ns", "q"),
    ("state", "B"),
    ("mode", "B"),
    ("motion", "B"),
    ("stick_mode", "B"),
    ("flags", "H"),
    ("wkc", "h"),
    ("wkc_expected", "h"),
    ("missed", "I"),
    ("lost", "I"),
    ("wakeup_ns", "i"),
    ("exchange_ns", "i"),
    ("compute_ns", "i"),
    ("dc_offset_ns", "i"),
    ("dc_filtered_ns", "i"),
    ("inputs", "I"),
    ("outputs", "I"),
    ("counter", "i"),
    ("fault", "I"),
    ("limit", "I"),
    ("held", "I"),
    ("enables", "I"),
    ("moves", "I"),
    ("elapsed_s", "f"),
    ("duration_s", "f"),
)
"""Fields of a cycle record that are one number: name and struct code. `number` is written last."""

PER_JOINT = (("position", "d"), ("velocity", "d"), ("torque", "d"), ("target", "d"), ("statusword", "H"))
"""Fields of a cycle record that are one number a joint, SI."""

FLAG_DC_LOCKED = 1
FLAG_ALL_OP = 2
FLAG_ENABLED = 4
FLAG_SWITCHING = 8
FLAG_EMERGENCY_STOP = 16
"""The emergency stop's input is pressed."""
FLAG_MOTION_ALLOWED = 32
"""The enabling switch is pressed, or there is none."""
FLAG_ARM_HAS_STICK = 64


def records_for(period_ns: int) -> int:
    """Return how many cycle records the ring of a cycle has: a power of two, `RING_S` seconds at least."""
    return max(RECORDS, 1 << (math.ceil(RING_S * 1e9 / period_ns) - 1).bit_length())


@dataclass(frozen=True)
class RecordLayout:
    """The cycle record for a number of joints, as a struct; readers make a numpy type of it (`observer`)."""

    joints: int

    @property
    def format(self) -> str:
        """The struct format, without padding; the record's number again at the end."""
        per_joint = "".join(f"{self.joints}{code}" for _, code in PER_JOINT)
        return "<" + "".join(code for _, code in SCALARS) + per_joint + "Q"

    @property
    def size(self) -> int:
        """Size of a record in the ring: a multiple of 64 bytes."""
        return (struct.calcsize(self.format) + 63) & ~63

    def file_size(self, records: int) -> int:
        """Size of a whole blackboard with so many records."""
        return RECORDS_AT + records * self.size
