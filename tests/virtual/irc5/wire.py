"""The bytes of EGM by hand (protobuf's wire format, no library): what a PC sends, and what it reads."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.virtual.irc5.config import EgmConfig, ExternalJoint, Irc5Config, UnitConfig
from rtcp.virtual.irc5.controller import Controller

CORRECTION = 3
PERIOD = 0.004032
FREE = {"max_speed_deviation": 400.0, "cond_time_s": 1e6, "comm_timeout_s": 0.2}
"""Settings without speed limit and convergence, for tests of other things."""


def entry(number: int, value: bytes | float | int) -> bytes:
    """A field: bytes as a message, a float as double, an integer as varint."""
    if isinstance(value, bytes):
        return varint(number << 3 | 2) + varint(len(value)) + value
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    return varint(number << 3) + varint(value)


def varint(value: int) -> bytes:
    encoded = b""
    while value > 0x7F:
        encoded += bytes([value & 0x7F | 0x80])
        value >>= 7
    return encoded + bytes([value])


def doubles(number: int, values: Sequence[float]) -> bytes:
    return b"".join(entry(number, float(value)) for value in values)


def sensor(
    seqno: int, position: Sequence[float] | None = None, speed: Sequence[float] | None = None, mtype: int = CORRECTION
) -> bytes:
    """An EgmSensor; the seventh joint goes into externalJoints."""
    message = entry(1, entry(1, seqno) + entry(3, mtype))
    for number, joints in ((2, position), (3, speed)):
        if joints is not None:
            part = entry(1, doubles(1, joints[:6]))
            message += entry(number, part + (entry(3, doubles(1, joints[6:])) if len(joints) > 6 else b""))
    return message


def parse(message: bytes) -> dict[int, list[Any]]:
    """The fields of a message by number: doubles, integers, and bytes of messages."""
    fields: dict[int, list[Any]] = {}
    at = 0
    while at < len(message):
        tag, at = read_varint(message, at)
        value: Any
        if tag & 7 == 0:
            value, at = read_varint(message, at)
        elif tag & 7 == 1:
            value, at = struct.unpack_from("<d", message, at)[0], at + 8
        else:
            assert tag & 7 == 2
            size, at = read_varint(message, at)
            value, at = message[at : at + size], at + size
        fields.setdefault(tag >> 3, []).append(value)
    assert at == len(message)
    return fields


def read_varint(message: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (message[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if not message[at - 1] & 0x80:
            return value, at


class Robot:
    """A parsed EgmRobot."""

    def __init__(self, message: bytes) -> None:
        self.fields = parse(message)
        header = self.part(1)
        self.seqno, self.tm, self.mtype = (header[number][0] for number in (1, 2, 3))
        self.actual, self.planned = self._joints(2), self._joints(3)
        self.motors_on = self.part(4)[1] == [1]
        self.mci = {1: "error", 2: "stopped", 3: "running"}[self.part(5)[1][0]]
        self.converged = bool(self.fields[6][0])
        self.rapid_running = self.part(8)[1] == [2]
        self.utilization: float = self.fields[10][0]

    def part(self, *path: int) -> dict[int, list[Any]]:
        fields = self.fields
        for number in path:
            fields = parse(fields[number][0])
        return fields

    def _joints(self, number: int) -> list[float]:
        joints: list[float] = self.part(number, 1)[1]
        return joints + (self.part(number, 3)[1] if 3 in self.part(number) else [])


@dataclass
class Pc:
    """A PC and one unit of a controller, in simulated time."""

    controller: Controller
    clock: float = 0.0
    seqno: int = 0

    def __post_init__(self) -> None:
        self.link = next(iter(self.controller.units.values()))
        self.unit = self.link.mechanical

    def cycle(self, position: Sequence[float] | None = None, speed: Sequence[float] | None = None,
              *datagrams: bytes) -> Robot | None:  # fmt: skip
        """Send a reference, or the datagrams, or nothing; return the unit's message, None if it sends none."""
        if position is not None or speed is not None:
            self.seqno += 1
            datagrams += (sensor(self.seqno, position, speed),)
        self.clock += PERIOD
        self.controller.panel.advance(PERIOD)
        sent = self.link.step(datagrams, self.clock)
        return Robot(sent[-1]) if sent else None

    def read(self, position: Sequence[float] | None = None, speed: Sequence[float] | None = None) -> Robot:
        robot = self.cycle(position, speed)
        assert robot is not None
        return robot

    def wait(self, seconds: float, position: Sequence[float] | None = None,
             speed: Sequence[float] | None = None) -> Robot:  # fmt: skip
        """Repeat the references in each cycle; return the last message."""
        for _ in range(round(seconds / PERIOD)):
            robot = self.read(position, speed)
        return robot


def pc(*, egm: dict[str, float] | None = None, controller: dict[str, Any] | None = None, axes: int = 6,
       **unit: Any) -> Pc:  # fmt: skip
    """A PC and a unit in EGMRunJoint with all joints at 0."""
    unit.setdefault("initial_position", (0.0,) * axes)
    external = ExternalJoint(-100.0, 100.0, 180.0) if axes == 7 else None
    settings = UnitConfig("ROB_1", 6511, external_joint=external, egm=EgmConfig(**FREE | (egm or {})), **unit)
    return Pc(Controller(Irc5Config((settings,), **controller or {})))
