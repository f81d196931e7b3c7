"""The IO box: inputs with the joystick's pull-ups, outputs that are safe, a counter of AB edges."""

import pytest

from rtcp.virtual import coe as sdo_access
from rtcp.virtual.models import DiewuIoBox
from rtcp.virtual.objects import SdoAbort
from rtcp.virtual.pdo import PdoImage

OP = 8


def _inputs(box: DiewuIoBox) -> int:
    box.step(0.001)
    return int(box.objects[0x6000, 1].value)


def _counter(box: DiewuIoBox) -> int:
    box.step(0.001)
    return int(box.objects[0x6010, 1].value)


def _write(box: DiewuIoBox, index: int, subindex: int, value: int, size: int = 2) -> None:
    sdo_access.write(box.objects, index, subindex, False, OP, value.to_bytes(size, "little", signed=size == 4))


def test_by_default_the_joystick_is_neutral_the_toggle_at_the_arm_and_the_emergency_stop_released() -> None:
    assert _inputs(DiewuIoBox()) == 0x033F


@pytest.mark.parametrize(("line", "value"), [(0, 62), (1, 61), (2, 59), (3, 55), (4, 47), (5, 31)])
def test_a_line_pulled_low_reads_the_joystick_s_value(line: int, value: int) -> None:
    box = DiewuIoBox()
    box.set_input(line, False)
    assert _inputs(box) & 0x3F == value
    box.set_input(line, True)
    assert _inputs(box) & 0x3F == 63


@pytest.mark.parametrize("levels", [0, 0x033F, 0xFFFF])
def test_the_levels_at_power_on_are_an_option(levels: int) -> None:
    box = DiewuIoBox(inputs=levels)
    assert box.objects[0x6000, 1].value == box.inputs == _inputs(box) == levels


@pytest.mark.parametrize("wrong", [-1, 0x10000, 1.5, True])
def test_levels_that_are_no_sixteen_bits_are_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match="allowed is a whole number from 0 to 65535"):
        DiewuIoBox(inputs=wrong)


def test_all_sixteen_inputs_can_be_set() -> None:
    box = DiewuIoBox()
    box.set_input(15, True)
    assert _inputs(box) == 0x833F
    box.inputs = 0x1234
    assert _inputs(box) == 0x1234


def test_an_input_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="inputs 0 to 15, not 16"):
        DiewuIoBox().set_input(16, True)
    with pytest.raises(ValueError, match="65535"):
        DiewuIoBox().inputs = 0x10000


def test_inputs_forced_over_the_bus_hide_the_terminals_until_released() -> None:
    box = DiewuIoBox()
    _write(box, 0x2000, 1, 0x0001)
    assert _inputs(box) == 0x033E
    _write(box, 0x2000, 2, 0x0001)
    assert _inputs(box) == 0x033F
    box.set_input(0, False)
    assert _inputs(box) == 0x033F
    _write(box, 0x2000, 1, 0x0000)
    assert _inputs(box) == 0x033E
    assert box.inputs == 0x033E


def test_outputs_reach_the_terminals_only_while_they_are_valid() -> None:
    box = DiewuIoBox()
    box.objects[0x7000, 1].value = 0xA5C3
    box.step(0.001)
    assert box.outputs == 0
    box.set_outputs_valid(True)
    box.step(0.001)
    assert box.outputs == 0xA5C3
    assert box.objects[0x2002, 0].value == 0xA5C3
    box.set_outputs_valid(False)
    assert box.outputs == 0
    assert box.objects[0x2002, 0].value == 0


def test_the_counter_counts_whole_edges_both_ways() -> None:
    box = DiewuIoBox()
    box.turn(2.5)
    assert _counter(box) == 2
    box.turn(0.5)
    assert _counter(box) == 3
    box.turn(-10)
    assert _counter(box) == -7


def test_the_counter_wraps_around_its_32_bits() -> None:
    box = DiewuIoBox()
    _write(box, 0x2001, 1, 0x7FFFFFFF, 4)
    box.turn(1)
    assert _counter(box) == -0x80000000
    box.turn(-1)
    assert _counter(box) == 0x7FFFFFFF


def test_the_encoder_turns_by_itself_at_the_rate_chosen() -> None:
    box = DiewuIoBox(counter_rate=-250.0)
    for _ in range(1000):
        box.step(0.001)
    assert abs(int(box.objects[0x6010, 1].value) + 250) <= 1


def test_the_process_data_are_fixed() -> None:
    box = DiewuIoBox()
    assert PdoImage.from_assignment(box.objects, 0x1C12).byte_length == 2
    assert PdoImage.from_assignment(box.objects, 0x1C13).byte_length == 6
    with pytest.raises(SdoAbort):
        sdo_access.write(box.objects, 0x1C12, 0, False, 2, b"\x00")


def test_forced_inputs_are_let_go_when_their_time_has_run_out() -> None:
    box = DiewuIoBox()
    force(box, hold_ms=100)
    box.step(0.06)
    assert box.objects[0x6000, 1].value == 0x033E
    force(box, hold_ms=100)
    box.step(0.06)
    assert box.objects[0x6000, 1].value == 0x033E
    box.step(0.05)
    box.step(0.001)
    assert box.objects[0x6000, 1].value == 0x033F


def force(box: DiewuIoBox, hold_ms: int) -> None:
    for sub_index, value in ((3, hold_ms), (2, 0x003E), (1, 0x003F)):
        entry = box.objects[0x2000, sub_index]
        entry.value = value
        if entry.on_write is not None:
            entry.on_write(entry, value)
