from __future__ import annotations

import struct
from typing import Literal

import pytest

from rtcp.config.model import DeviceDescription, InputConfig, Pdo, PdoEntry, SlaveConfig
from rtcp.devices import DeviceError, IoBox
from rtcp.devices.io_box import Switch

OUTPUTS = (PdoEntry(0x7000, 1, "uint16", "outputs"),)
INPUTS = (PdoEntry(0x6000, 1, "uint16", "inputs"), PdoEntry(0x6010, 1, "int32", "counter"))


def make_box(outputs: tuple[PdoEntry, ...] = OUTPUTS, inputs: tuple[PdoEntry, ...] = INPUTS) -> IoBox:
    device = DeviceDescription("a box", "io", 1, 2, (Pdo(0x1600, outputs),), (Pdo(0x1A00, inputs),))
    return IoBox(SlaveConfig("io", device), 0.001)


def test_inputs_and_counter_are_decoded() -> None:
    box = make_box()
    box.decode(struct.pack("<Hi", 0xFF3E, -70000))
    assert (box.inputs, box.counter) == (0xFF3E, -70000)


def test_each_output_is_a_bit() -> None:
    box = make_box()
    for number in (1, 16, 3):
        box.set_output(number, True)
    box.set_output(3, False)
    assert box.encode() == b"\x01\x80"


def test_outputs_between_other_channels_stand_at_their_place() -> None:
    padding = (PdoEntry(0, 0, "uint8", "gap"),)
    box = make_box(outputs=padding + OUTPUTS + padding)
    box.outputs = 0x1234
    assert box.encode() == b"\x00\x34\x12\x00"
    assert len(box.encode()) == box.output_bytes


@pytest.mark.parametrize("number", [0, 17, -1])
def test_an_output_that_does_not_exist_is_refused_with_the_range(number: int) -> None:
    with pytest.raises(DeviceError, match="it has 1 to 16"):
        make_box().set_output(number, True)


def test_a_box_without_a_counter_counts_nothing() -> None:
    box = make_box(inputs=INPUTS[:1])
    box.decode(b"\x3e\xff")
    assert (box.inputs, box.counter) == (0xFF3E, 0)


def test_a_box_without_inputs_is_refused() -> None:
    with pytest.raises(DeviceError, match="`tpdo` maps no inputs; kind io needs inputs, found are counter"):
        make_box(inputs=INPUTS[1:])


def test_inputs_as_single_bits_are_refused() -> None:
    with pytest.raises(DeviceError, match="channel inputs is bool"):
        make_box(inputs=(PdoEntry(0x6000, 1, "bool", "inputs"), INPUTS[1]))


@pytest.mark.parametrize("active", ["high", "low"])
def test_reading_for_activity_never_clears_an_active_input(active: Literal["high", "low"]) -> None:
    pressed, released = (0b100, 0) if active == "high" else (0, 0b100)
    switch = Switch(InputConfig(3, active, debounce_ms=3), False, 1e-3)
    for _ in range(10):
        switch.read_active(pressed)
    assert switch.active
    for _ in range(10):
        switch.read_active(released)
    assert switch.active
    for _ in range(10):
        switch.read(released)
    assert not switch.active
