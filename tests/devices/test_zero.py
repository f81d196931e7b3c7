"""A drive whose own zero is not the joint's."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.devices import Cia402Drive, TargetState

from .conftest import Wire, slave

SWITCHED_ON, ENABLED = 0x0233, 0x0237


@pytest.fixture
def shifted() -> Wire:
    return Wire(Cia402Drive(slave(), 0.001, speed_limit=0.5, zero=0.25))


def test_the_position_counts_from_the_joints_zero(shifted: Wire) -> None:
    shifted.receive(ENABLED, 2500, 300, 40)
    assert (shifted.drive.position, shifted.drive.velocity, shifted.drive.torque) == pytest.approx((0.0, 0.03, 0.004))
    shifted.receive(ENABLED, 0)
    assert shifted.drive.position == -0.25


def test_the_target_is_sent_as_the_drive_counts(shifted: Wire) -> None:
    shifted.receive(ENABLED, 2500)
    shifted.drive.target_position = 0.1
    assert shifted.sent()[1] == 3500
    shifted.drive.target_position = -0.25
    assert shifted.sent()[1] == 0


def test_speed_and_torque_know_no_zero(shifted: Wire) -> None:
    drive = shifted.drive
    drive.advance(TargetState.ENABLED)
    drive.controlword, drive.mode, drive.target_velocity, drive.target_torque = 0x0F, 9, 0.2, 1.0
    shifted.receive(ENABLED, 2500, mode=9)
    assert shifted.sent()[2] == 2000
    drive.mode = 10
    assert shifted.sent()[3] == 10000


def test_the_end_of_the_field_is_the_wires_and_not_the_joints(shifted: Wire) -> None:
    shifted.drive.target_position = 214748.3647
    assert shifted.sent()[1] == 2**31 - 1


@given(zero=st.floats(-100, 100), counts=st.integers(-1_000_000, 1_000_000))
def test_a_target_latched_at_the_position_is_sent_as_the_very_counts_that_came(zero: float, counts: int) -> None:
    wire = Wire(Cia402Drive(slave(), 0.001, zero=zero))
    wire.receive(SWITCHED_ON, counts)
    wire.drive.advance(TargetState.ENABLED)
    assert wire.sent()[1] == counts


@given(before=st.floats(-100, 100), after=st.floats(-100, 100), counts=st.integers(-1_000_000, 1_000_000))
def test_another_zero_moves_what_is_shown_and_not_what_is_sent(before: float, after: float, counts: int) -> None:
    wire = Wire(Cia402Drive(slave(), 0.001, zero=before))
    wire.receive(SWITCHED_ON, counts)
    wire.drive.advance(TargetState.ENABLED)
    wire.drive.zero = after
    assert wire.sent()[1] == counts
    assert wire.drive.position == pytest.approx(counts * 1e-4 - after, abs=1e-9)
    position = wire.drive.position
    wire.receive(SWITCHED_ON, counts)
    assert wire.drive.position == pytest.approx(position, abs=1e-9)
