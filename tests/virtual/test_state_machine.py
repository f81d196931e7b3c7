"""The AL state machine: refused transitions and their codes, errors and acknowledgement (ETG.1000.6, ETG.1020)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rtcp.virtual.objects import DataType, Entry
from tests.virtual.line import (
    ACK,
    BOOT,
    ERROR,
    INIT,
    MS,
    OP,
    PRE_OP,
    SAFE_OP,
    SM_INPUTS,
    SM_MAILBOXES,
    SM_OUTPUTS,
    Line,
    TinyDevice,
    start_sync0,
)


def to_configured_pre_op(line: Line) -> None:
    line.to_pre_op()
    line.configure_process_data()


REACH: dict[int, Callable[[Line], None]] = {
    INIT: Line.address,
    PRE_OP: to_configured_pre_op,
    SAFE_OP: Line.to_safe_op,
    OP: Line.to_op,
}


def reach(state: int, device: TinyDevice | None = None) -> Line:
    line = Line([TinyDevice() if device is None else device])
    REACH[state](line)
    return line


@pytest.mark.parametrize(
    ("state", "requested", "code"),
    [
        (INIT, SAFE_OP, 0x0011),
        (INIT, OP, 0x0011),
        (PRE_OP, OP, 0x0011),
        (PRE_OP, BOOT, 0x0011),
        (SAFE_OP, BOOT, 0x0011),
        (OP, BOOT, 0x0011),
        (INIT, BOOT, 0x0013),
        (INIT, 0, 0x0012),
        (PRE_OP, 5, 0x0012),
        (SAFE_OP, 9, 0x0012),
        (OP, 15, 0x0012),
    ],
)
def test_a_request_that_the_state_machine_does_not_know_is_answered_with_its_code(
    state: int, requested: int, code: int
) -> None:
    assert reach(state).request(0, requested) == (state | ERROR, code)


@pytest.mark.parametrize(("state", "requested"), [(a, b) for a in REACH for b in REACH if b <= a])
def test_every_step_down_and_the_state_itself_is_granted(state: int, requested: int) -> None:
    assert reach(state).request(0, requested) == (requested, 0)


@pytest.mark.parametrize(
    "registers",
    [
        bytes(16),
        SM_MAILBOXES[:8] + bytes(8),
        bytes.fromhex("0010 8000 22 00 01 00") + SM_MAILBOXES[8:],
        bytes.fromhex("0010 2000 26 00 01 00") + SM_MAILBOXES[8:],
        SM_MAILBOXES[:8] + bytes.fromhex("4010 8000 22 00 01 00"),
        SM_MAILBOXES[:8] + bytes.fromhex("802f 0001 22 00 01 00"),
    ],
    ids=["off", "SM1 off", "direction", "too short", "overlapping", "beyond the memory"],
)
def test_mailboxes_that_cannot_work_are_refused_with_0x0016(registers: bytes) -> None:
    line = reach(INIT)
    line.write(0, 0x0800, registers)
    assert line.request(0, PRE_OP) == (INIT | ERROR, 0x0016)


def set_up(line: Line, sm2: bytes = SM_OUTPUTS, sm3: bytes = SM_INPUTS) -> Line:
    line.to_pre_op()
    line.write(0, 0x0810, sm2)
    line.write(0, 0x0818, sm3)
    return line


@pytest.mark.parametrize(
    ("sm2", "sm3", "code"),
    [
        ("0011 0300 64 00 01 00", SM_INPUTS.hex(), 0x001D),
        ("0011 0200 64 00 00 00", SM_INPUTS.hex(), 0x001D),
        ("0011 0200 60 00 01 00", SM_INPUTS.hex(), 0x001D),
        ("0011 0200 66 00 01 00", SM_INPUTS.hex(), 0x001D),
        ("000f 0200 64 00 01 00", SM_INPUTS.hex(), 0x001D),
        (SM_OUTPUTS.hex(), "0014 0100 20 00 01 00", 0x001E),
        (SM_OUTPUTS.hex(), "0014 0200 24 00 01 00", 0x001E),
        (SM_OUTPUTS.hex(), "fb2f 0200 20 00 01 00", 0x001E),
        (SM_OUTPUTS.hex(), "0000 0000 20 00 00 00", 0x001E),
        (SM_OUTPUTS.hex(), "0411 0200 20 00 01 00", 0x0017),
        ("fe10 0200 64 00 01 00", SM_INPUTS.hex(), 0x0017),
    ],
    ids=["length", "off", "direction", "mode", "in the registers", "in: length", "in: direction", "in: no room",
         "in: off", "inside the outputs' three buffers", "inside a mailbox"],
)  # fmt: skip
def test_sync_managers_that_do_not_fit_the_mapping_are_refused(sm2: str, sm3: str, code: int) -> None:
    line = set_up(Line([TinyDevice()]), bytes.fromhex(sm2), bytes.fromhex(sm3))
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, code)


def test_a_mapping_changed_by_sdo_makes_the_old_length_wrong() -> None:
    device = TinyDevice()
    line = set_up(Line([device]))
    device.objects[0x1C12, 0].value = 0
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, 0x001D)
    line.write(0, 0x0816, b"\x00")
    assert line.request(0, SAFE_OP | ACK) == (SAFE_OP, 0)


@pytest.mark.parametrize(("mapping", "code"), [(0x1600, 0x0025), (0x1A00, 0x0024)])
def test_a_mapping_of_objects_that_do_not_exist_is_refused(mapping: int, code: int) -> None:
    device = TinyDevice()
    line = set_up(Line([device]))
    device.objects[mapping, 1].value = 0x7FFF0110
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, code)


def test_a_watchdog_with_a_time_but_no_divider_is_refused() -> None:
    line = set_up(Line([TinyDevice()]))
    line.write(0, 0x0400, b"\x00\x00")
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, 0x001F)
    line.write(0, 0x0420, b"\x00\x00")
    assert line.request(0, SAFE_OP | ACK) == (SAFE_OP, 0)


@pytest.mark.parametrize(("activation", "cycle", "code"), [(0x01, MS, 0x0030), (0x05, MS, 0x0030), (0x03, 0, 0x0030)])
def test_sync_pulses_that_the_device_cannot_work_by_are_refused(activation: int, cycle: int, code: int) -> None:
    line = set_up(Line([TinyDevice()]))
    line.write(0, 0x09A0, cycle.to_bytes(4, "little"))
    line.write(0, 0x0981, bytes((activation,)))
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, code)


def test_a_sync0_cycle_below_the_devices_minimum_in_0x1c32_is_refused_with_0x0035() -> None:
    device = TinyDevice()
    minimum = Entry(0x1C32, 5, "Minimum cycle time", DataType.UNSIGNED32, 250_000)
    device.objects.record(0x1C32, "Output parameters", [minimum])
    line = set_up(Line([device]))
    line.write(0, 0x09A0, (200_000).to_bytes(4, "little"))
    line.write(0, 0x0981, b"\x03")
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, 0x0035)


def test_sync0_left_on_by_the_last_master_whose_time_is_set_anew_is_a_fatal_sync_error() -> None:
    line = set_up(Line([TinyDevice()]))
    start_sync0(line, 0, MS, first_in=2 * MS)
    line.pass_time(10 * MS)
    line.write(0, 0x0920, (10**12).to_bytes(8, "little"))
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, 0x002C)
    line.write(0, 0x0981, b"\x00")
    assert line.request(0, SAFE_OP | ACK) == (SAFE_OP, 0)


def test_op_waits_for_outputs_and_is_refused_when_none_come() -> None:
    line = reach(SAFE_OP)
    assert line.request(0, OP) == (SAFE_OP, 0)
    line.pass_time(500 * MS)
    assert line.al(0) == (SAFE_OP, 0)
    line.pass_time(600 * MS)
    assert line.al(0) == (SAFE_OP | ERROR, 0x001B)


def test_op_with_sync0_that_never_starts_is_refused_with_0x002d() -> None:
    line = set_up(Line([TinyDevice()]))
    line.configure_process_data()
    now = line.number(0, 0x0910, 8)
    line.write(0, 0x0990, (now - 5 * MS).to_bytes(8, "little"))  # in the past: no pulse will come
    line.write(0, 0x09A0, MS.to_bytes(4, "little"))
    line.write(0, 0x0981, b"\x03")
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    line.request(0, OP)
    for _ in range(1200):
        line.exchange(1)
    assert line.al(0) == (SAFE_OP | ERROR, 0x002D)


def test_an_error_keeps_the_slave_until_it_is_acknowledged() -> None:
    line = reach(PRE_OP)
    assert line.request(0, OP) == (PRE_OP | ERROR, 0x0011)
    assert line.request(0, SAFE_OP) == (PRE_OP | ERROR, 0x0011)
    assert line.request(0, PRE_OP | ACK) == (PRE_OP, 0)
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)


def test_init_is_granted_without_acknowledging() -> None:
    line = reach(PRE_OP)
    line.request(0, OP)
    assert line.request(0, INIT) == (INIT, 0)


@pytest.mark.parametrize("requested", [SAFE_OP, PRE_OP, INIT])
def test_leaving_op_makes_the_outputs_invalid_once(requested: int) -> None:
    line = reach(OP)
    line.exchange(99)
    line.request(0, requested)
    assert line.tiny[0].valid == [True, False]
    assert line.tiny[0].out.value == 0


@pytest.mark.parametrize(("register", "state", "code"), [(0x0806, INIT, 0x0016), (0x0816, PRE_OP, 0x001D),
                                                         (0x081E, PRE_OP, 0x001E)])  # fmt: skip
def test_switching_a_sync_manager_off_in_op_makes_the_slave_fall(register: int, state: int, code: int) -> None:
    line = reach(OP)
    line.write(0, register, b"\x00")
    assert line.al(0) == (state | ERROR, code)
    assert line.tiny[0].valid == [True, False]


def test_outputs_sent_before_op_do_not_reach_the_device() -> None:
    line = reach(SAFE_OP)
    assert line.exchange(77)[1] == 3
    line.pass_time(5 * MS)
    assert line.tiny[0].out.value == 0


def test_process_data_are_not_counted_before_safe_op() -> None:
    line = Line([TinyDevice(), TinyDevice()])
    line.to_pre_op()
    line.configure_process_data()
    assert line.exchange()[1] == 0
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    assert line.exchange()[1] == 3


def test_a_device_without_outputs_goes_to_op_without_any() -> None:
    device = TinyDevice()
    device.objects[0x1C12, 0].value = 0
    line = set_up(Line([device]), sm2=bytes(8))
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    assert line.request(0, OP) == (OP, 0)
