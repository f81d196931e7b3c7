"""Parts of the cycle: their faults, outputs that stay safe, inputs that are never ignored."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rtcp.config.model import DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.control.operator import Operator
from rtcp.control.part import Device, PartContext
from rtcp.devices.driver import DeviceError, Driver
from rtcp.ipc.commands import Command, Reset
from rtcp.ipc.events import DriverFailed, Event, LeftRange, OverSpeed, SlaveLost
from rtcp.ipc.refusals import DriverRaised, Refusal
from rtcp.ipc.states import State

from .rig import CONFIG, LoopRig

HEATER = SlaveConfig(
    "heater",
    DeviceDescription(
        "Heater", "heater", 1, 2, (Pdo(0x1600, (PdoEntry(0x7000, 1, "int16", "power", unit="W"),)),),
        (Pdo(0x1A00, (PdoEntry(0x6000, 1, "int16", "power", unit="W"),)),),
    ),
)  # fmt: skip


class Regulator(Driver):
    """Switches its output on in every cycle, also after `safe`."""

    def update(self, state: State, now_ns: int) -> Event | None:
        self.targets["power"] = 7.0
        return None


def recording_context() -> Any:
    """A context that records events; its class replaces methods, which only the interpreter allows."""

    class RecordingContext(PartContext):
        def __init__(self) -> None:
            super().__init__(0.001)
            self.published: list[Event] = []
            self.explained: list[tuple[str, str]] = []

        def publish(self, event: Event) -> None:
            self.published.append(event)

        def explain(self, what: str, error: BaseException) -> None:
            self.explained.append((what, str(error)))

    return RecordingContext()


class Raising(Driver):
    """Raises in one method."""

    method = ""
    """Name of the method that raises."""

    def raise_in(self, method: str) -> None:
        if method == self.method:
            raise ZeroDivisionError(method)

    def decode(self, data: bytes) -> None:
        self.raise_in("decode")

    def accept(self, command: Command) -> Refusal | None:
        self.raise_in("accept")
        return None

    def update(self, state: State, now_ns: int) -> Event | None:
        self.targets["power"] = 7.0
        self.raise_in("update")
        return None

    def safe(self) -> None:
        super().safe()
        self.raise_in("safe")

    def encode(self) -> bytes:
        self.raise_in("encode")
        return super().encode()

    def publish(self, values: list[Any], at: int) -> None:
        self.raise_in("publish")


class Image:
    """The inputs and outputs of the slave."""

    sent = b""

    def input(self, slot: int) -> bytes:
        return bytes(2)

    def set_output(self, slot: int, data: bytes) -> None:
        self.sent = data


@pytest.mark.interpreted
def test_outputs_stay_safe_until_the_machine_is_ready_again_whatever_the_driver_does() -> None:
    device, context, image = Device(0, Regulator(HEATER, 0.001)), recording_context(), Image()

    def cycle(state: State) -> int:
        context.state = state
        device.update(context)
        device.encode(image)  # type: ignore[arg-type]
        return int.from_bytes(image.sent, "little")

    assert cycle(State.HOLDING) == 7
    device.safe()
    assert [cycle(state) for state in (State.FAULT, State.RESETTING)] == [0, 0]
    cycle(State.READY)
    assert cycle(State.READY) == 7


@pytest.mark.interpreted
@pytest.mark.parametrize("method", ["decode", "accept", "update", "safe", "encode", "publish"])
def test_a_driver_that_raises_is_a_fault_with_outputs_of_zero_and_is_tried_again_after_the_reset(method: str) -> None:
    driver, context, image = Raising(HEATER, 0.001), recording_context(), Image()
    device = Device(0, driver)

    def cycle(state: State) -> int:
        context.state = state
        device.decode(image)  # type: ignore[arg-type]
        device.update(context)
        device.encode(image)  # type: ignore[arg-type]
        device.publish([0, 0])
        return int.from_bytes(image.sent, "little")

    assert cycle(State.HOLDING) == 7
    driver.method = method
    assert device.accept(Reset(), 0) == (DriverRaised(1) if method == "accept" else None)
    if method == "safe":
        device.safe()
    assert [cycle(State.HOLDING) for _ in range(3)][1:] == [0, 0]
    assert context.explained == [("driver of slave heater", method)]
    assert device.accept(Reset(), 0) == DriverRaised(1)
    # The machine calls `safe` on a fault, which is reported already.
    assert context.reported == (None if method == "safe" else DriverFailed(1))
    driver.method = ""
    device.safe()
    assert [cycle(state) for state in (State.FAULT, State.RESETTING)] == [0, 0]
    cycle(State.READY)
    assert cycle(State.READY) == 7


@pytest.mark.interpreted
def test_the_event_of_a_driver_is_reported() -> None:
    event = OverSpeed(0, 2.0, 1.0)

    class Supervising(Driver):
        def update(self, state: State, now_ns: int) -> Event | None:
            return event

    context = recording_context()
    Device(0, Supervising(HEATER, 0.001)).update(context)
    assert context.reported == event


def test_a_value_that_a_driver_adds_is_not_in_the_record_and_moves_nothing() -> None:
    driver = Driver(HEATER, 0.001)
    driver.values["mean"] = 1.0
    values: list[Any] = [0, 0, 5]
    driver.publish(values, 0)
    assert [field.name for field in driver.fields()] == ["power", "power_sent"]
    assert values == [0.0, 0.0, 5]


@pytest.mark.interpreted
@pytest.mark.parametrize("first", [0, 1])
def test_of_several_faults_in_a_cycle_the_hardest_is_taken_and_the_other_published(first: int) -> None:
    context, faults = recording_context(), [LeftRange(0, 1.0), OverSpeed(0, 2.0, 1.0)]
    for fault in (faults[first], faults[1 - first]):
        context.report(fault)
    assert context.reported == faults[1]
    assert context.published == [faults[0]]


def test_a_fault_that_is_reported_on_the_way_out_of_one_keeps_the_machine_in_it(rig: LoopRig) -> None:
    rig.lead_to(State.FAULT)
    rig.do(Reset())
    while rig.state is State.RESETTING:
        rig.context.report(SlaveLost(3))
        rig.cycle()
    assert rig.state is State.FAULT


def test_an_emergency_stop_that_hangs_on_no_box_is_refused_and_never_ignored() -> None:
    assert CONFIG.inputs.emergency_stop is not None
    with pytest.raises(DeviceError, match="EmergencyStopConfig needs an IO box"):
        Operator(CONFIG, {}, None)
    elsewhere = replace(CONFIG.inputs.emergency_stop, box="drive1")
    with pytest.raises(DeviceError, match="drive1 is none"):
        Operator(replace(CONFIG, inputs=replace(CONFIG.inputs, emergency_stop=elsewhere)), {}, None)
