"""Process data in time: the watchdog, SYNC0, the sync error and what a stop of the process must not do."""

from __future__ import annotations

import pytest

from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.segment import REPLAYED_PULSES
from tests.virtual.line import ACK, ERROR, MS, OP, SAFE_OP, Line, TinyDevice, by_sync0, in_op


def test_the_watchdog_takes_a_slave_without_outputs_to_safe_op_and_makes_them_safe() -> None:
    line = in_op(2)
    line.exchange(9, 9)
    line.pass_time(99 * MS)
    assert line.al(0) == (OP, 0)
    line.pass_time(3 * MS)
    assert [line.al(n) for n in (0, 1)] == [(SAFE_OP | ERROR, 0x001B)] * 2
    assert [device.valid for device in line.tiny] == [[True, False]] * 2
    assert line.tiny[0].out.value == 0
    assert line.number(0, 0x0440, 2) & 1 == 0
    assert line.number(0, 0x0442, 1) == 1


def test_after_the_watchdog_the_working_counter_lacks_the_outputs_until_the_error_is_acknowledged() -> None:
    line = in_op(2)
    line.pass_time(110 * MS)
    assert line.exchange()[1] == 2
    assert line.request(0, SAFE_OP | ACK) == (SAFE_OP, 0)
    assert line.exchange()[1] == 4
    line.request(0, OP)
    line.exchange()
    assert line.al(0) == (OP, 0)


@pytest.mark.parametrize(("divider", "time", "expected_ms"), [(2498, 50, 5), (248, 1000, 10)])
def test_the_watchdog_time_is_divider_times_count(divider: int, time: int, expected_ms: int) -> None:
    line = in_op(2)
    line.write(0, 0x0400, divider.to_bytes(2, "little"))
    line.write(0, 0x0420, time.to_bytes(2, "little"))
    line.exchange()
    line.pass_time((expected_ms - 1) * MS)
    assert line.slaves[0].application.state == OP
    line.pass_time(2 * MS)
    assert line.slaves[0].application.state == SAFE_OP


def test_a_watchdog_time_of_zero_and_a_sync_manager_that_does_not_trigger_it_switch_it_off() -> None:
    line = Line([TinyDevice(), TinyDevice()])
    line.to_pre_op()
    line.configure_process_data()
    line.write(0, 0x0420, b"\x00\x00")
    line.write(1, 0x0816, b"\x00")
    line.write(1, 0x0810, bytes.fromhex("0011 0200 24 00 01 00"))
    for slave in (0, 1):
        line.request(slave, SAFE_OP)
        line.request(slave, OP)
    line.exchange()
    line.pass_time(1000 * MS)
    assert [line.al(n) for n in (0, 1)] == [(OP, 0)] * 2


def test_a_device_lives_on_without_frames() -> None:
    line = Line([TinyDevice()])
    line.pass_time(1000 * MS)
    assert line.tiny[0].passed == pytest.approx(1.0, abs=0.002)


def test_with_sync0_a_device_makes_one_step_a_cycle_as_long_as_the_cycle() -> None:
    line = by_sync0(TinyDevice())
    before, passed = line.tiny[0].steps, line.tiny[0].passed
    for _ in range(50):
        line.exchange(1)
    assert line.tiny[0].steps - before == 50
    assert line.tiny[0].passed - passed == pytest.approx(0.050, abs=1e-6)


def test_outputs_take_effect_with_sync0_and_not_before() -> None:
    line = by_sync0(TinyDevice())
    line.exchange(500)
    assert line.tiny[0].out.value == 1
    line.pass_time(MS // 2 + 10_000)
    assert line.tiny[0].out.value == 500


def test_process_data_that_miss_sync0_twice_are_a_sync_error() -> None:
    device = TinyDevice()
    line = by_sync0(device)
    line.pass_time(MS)
    line.exchange(7)
    assert line.al(0) == (OP, 0)  # one miss: 3, not above 4
    line.pass_time(3 * MS)
    assert line.al(0) == (SAFE_OP | ERROR, 0x001A)
    assert device.valid == [True, False]


def test_a_miss_is_forgiven_after_three_cycles_on_time() -> None:
    line = by_sync0(TinyDevice())
    for _ in range(5):
        line.exchange(1, after=2 * MS)
        for _ in range(3):
            line.exchange(1)
    assert line.al(0) == (OP, 0)


def test_the_limit_in_object_0x10f1_counts_and_zero_switches_the_check_off() -> None:
    line = by_sync0(TinyDevice(sync_limit=8))
    line.pass_time(2 * MS)
    line.exchange(1)
    assert line.al(0) == (OP, 0)
    line.pass_time(5 * MS)
    assert line.al(0) == (SAFE_OP | ERROR, 0x001A)
    line = by_sync0(TinyDevice(sync_limit=0))
    line.pass_time(50 * MS)
    assert line.al(0) == (OP, 0)


@pytest.mark.parametrize(("limit", "misses"), [(8, 3), (20, 7)])
def test_without_object_0x10f1_the_models_option_is_the_limit(limit: int, misses: int) -> None:
    line = by_sync0(TinyDevice(sync_error_limit=limit))
    line.pass_time(misses * MS)
    assert line.al(0) == (OP, 0)
    line.pass_time(MS)
    assert line.al(0) == (SAFE_OP | ERROR, 0x001A)


def test_a_device_that_uses_no_sync0_misses_none() -> None:
    class WithoutSync0(TinyDevice):
        uses_sync0 = False

    line = by_sync0(WithoutSync0())
    line.pass_time(50 * MS)
    assert line.al(0) == (OP, 0)


def test_sync0_that_ends_in_op_is_a_fatal_sync_error() -> None:
    line = by_sync0(TinyDevice())
    line.write(0, 0x0981, b"\x00")
    line.pass_time(2 * MS)
    assert line.al(0) == (SAFE_OP | ERROR, 0x002C)


def test_after_a_stop_of_the_process_few_pulses_are_made_up_for_and_none_counts_as_missed() -> None:
    line = by_sync0(TinyDevice())
    steps, passed = line.tiny[0].steps, line.tiny[0].passed
    # The process slept for 80 ms.
    line.now += 80 * MS
    answered = line.exchange(1, after=0)
    line.pass_time(100_000)
    assert answered[1] == 3
    assert line.al(0) == (OP, 0)
    assert line.tiny[0].steps - steps <= REPLAYED_PULSES + 2
    assert line.tiny[0].passed - passed <= 0.045
    for _ in range(20):
        line.exchange(1)
    assert line.al(0) == (OP, 0)


def test_a_slave_without_clocks_has_no_clock_registers_and_works_by_frames() -> None:
    line = Line([TinyDevice(supports_dc=False)])
    line.to_op()
    assert line.one(DatagramCommand.FPWR, 0x1001, 0x0981, b"\x03").counter == 0
    assert line.exchange(3)[1] == 3
    assert line.exchange(3)[0] == [4]
