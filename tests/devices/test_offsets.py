"""The offsets of a drive on the wire: when they are sent, and what they are then."""

from __future__ import annotations

import math
import struct

import pytest

from rtcp.devices import Cia402Drive
from rtcp.devices import TargetState as T
from rtcp.devices.cia402 import ENABLE_OPERATION
from rtcp.devices.drive import DriveOffsets

from .conftest import FACTOR, RPDO, STATUS, slave

HOMING, CSP, CSV, CST = 6, 8, 9, 10
DISABLED, SWITCHED_ON, ENABLED = 0x0250, 0x0233, 0x0237
WITH_OFFSETS = (*RPDO, ("velocity_offset", 0x60B1, "int32", FACTOR), ("torque_offset", 0x60B2, "int16", FACTOR))
SENT = struct.Struct("<ih")


def offsets_sent(word: int, commanded: int, shown: int, velocity: float, torque: float) -> tuple[int, int]:
    """The offsets of a drive that is commanded to be enabled and shows a statusword and a mode."""
    drive = Cia402Drive(slave(WITH_OFFSETS), 0.001, speed_limit=0.5)
    drive.offsets = DriveOffsets(drive.rpdo)
    drive.mode = commanded
    for _ in range(2):
        drive.decode(STATUS.pack(word, 0, 0, 0, shown))
        drive.advance(T.ENABLED)
        assert SENT.unpack(drive.encode()[-SENT.size :]) == (0, 0)
    drive.offsets.velocity, drive.offsets.torque, drive.offsets.change = velocity, torque, math.inf
    return SENT.unpack(drive.encode()[-SENT.size :])


@pytest.mark.parametrize(("mode", "shown"), [(CSP, CSP), (CSV, CSV), (CSV, CSP)])
def test_an_enabled_drive_is_sent_its_offsets_in_its_units_rounded_towards_zero(mode: int, shown: int) -> None:
    assert offsets_sent(ENABLED, mode, shown, 0.12349, -1.23459) == (1234, -12345)


@pytest.mark.parametrize(
    ("word", "commanded", "shown"),
    [
        (SWITCHED_ON, CSP, CSP), (DISABLED, CSP, CSP), (ENABLED, CST, CST), (ENABLED, CST, CSP), (ENABLED, CSP, CST),
        (ENABLED, 6, 6),
    ],
)  # fmt: skip
def test_a_drive_that_is_not_enabled_or_not_in_the_commanded_csp_or_csv_is_sent_zeros(
    word: int, commanded: int, shown: int
) -> None:
    assert offsets_sent(word, commanded, shown, 0.1, 1.0) == (0, 0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_offsets_that_are_no_numbers_are_sent_as_0(value: float) -> None:
    assert offsets_sent(ENABLED, CSP, CSP, value, value) == (0, 0)


def test_offsets_beyond_the_range_of_their_fields_are_sent_as_its_end() -> None:
    assert offsets_sent(ENABLED, CSP, CSP, 1e9, -1e9) == (2**31 - 1, -(2**15))


def test_the_torque_that_is_sent_changes_slowly_whatever_the_mode_but_goes_to_0_at_once_for_cst() -> None:
    drive = Cia402Drive(slave(WITH_OFFSETS), 0.001, speed_limit=0.5)
    drive.offsets = DriveOffsets(drive.rpdo)
    sent = []
    for commanded, shown in ((CSP, CSP), (CSP, CSP), (CSV, CSP), (HOMING, CSV), (CSV, CSV), (CSV, CSV), (CST, CSV)):
        drive.mode, drive.controlword = commanded, ENABLE_OPERATION
        drive.decode(STATUS.pack(ENABLED, 0, 0, 0, shown))
        drive.offsets.torque, drive.offsets.change = 1.0, 0.4
        sent.append(SENT.unpack(drive.encode()[-SENT.size :])[1])
    assert sent == [4000, 8000, 10000, 6000, 10000, 10000, 0]


def test_a_step_of_the_state_machine_clears_the_offsets() -> None:
    drive = Cia402Drive(slave(WITH_OFFSETS), 0.001, speed_limit=0.5)
    drive.offsets = DriveOffsets(drive.rpdo)
    drive.offsets.velocity, drive.offsets.torque = 0.1, 1.0
    drive.advance(T.QUICK_STOPPED)
    assert (drive.offsets.velocity, drive.offsets.torque) == (0.0, 0.0)
