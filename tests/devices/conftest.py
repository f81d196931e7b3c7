from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest

from rtcp.config.model import DataTypeName, DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.devices import Cia402Drive

Channel = tuple[str, int, DataTypeName, float]
"""Its name, index, type and factor."""

FACTOR = 1e-4
RPDO: tuple[Channel, ...] = (
    ("controlword", 0x6040, "uint16", 1.0),
    ("target_position", 0x607A, "int32", FACTOR),
    ("target_velocity", 0x60FF, "int32", FACTOR),
    ("target_torque", 0x6071, "int32", FACTOR),
    ("modes_of_operation", 0x6060, "int8", 1.0),
)
TPDO: tuple[Channel, ...] = (
    ("statusword", 0x6041, "uint16", 1.0),
    ("position", 0x6064, "int32", FACTOR),
    ("velocity", 0x606C, "int32", FACTOR),
    ("torque", 0x6077, "int32", FACTOR),
    ("modes_of_operation_display", 0x6061, "int8", 1.0),
)


def entries(rows: Iterable[Channel]) -> tuple[PdoEntry, ...]:
    return tuple(PdoEntry(index, 0, kind, name, factor) for name, index, kind, factor in rows)


def slave(rpdo: Iterable[Channel] = RPDO, tpdo: Iterable[Channel] = TPDO) -> SlaveConfig:
    device = DeviceDescription(
        name="a drive", kind="cia402", vendor_id=1, product_id=2,
        rpdo=(Pdo(0x1600, entries(rpdo)),), tpdo=(Pdo(0x1A00, entries(tpdo)),),
    )  # fmt: skip
    return SlaveConfig("joint1", device)


STATUS = struct.Struct("<Hiiib")
CONTROL = struct.Struct("<Hiiib")


class Wire:
    """The bus's side of a drive, in counts."""

    def __init__(self, drive: Cia402Drive) -> None:
        self.drive = drive

    def receive(self, word: int, position: int = 0, velocity: int = 0, torque: int = 0, mode: int = 8) -> None:
        self.drive.decode(STATUS.pack(word, position, velocity, torque, mode))

    def sent(self) -> tuple[int, int, int, int, int]:
        return CONTROL.unpack(self.drive.encode())


@pytest.fixture
def drive() -> Cia402Drive:
    return Cia402Drive(slave(), 0.001, speed_limit=0.5)


@pytest.fixture
def wire(drive: Cia402Drive) -> Wire:
    return Wire(drive)
