"""A slave of channels alone in the whole loop, in simulated time: read, set, made safe."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from rtcp.config import default_config, load, load_segment, segment_path
from rtcp.config.model import ArmConfig, Pdo, PdoEntry, ProcessConfig, SlaveConfig
from rtcp.config.segment import SegmentSlave
from rtcp.ipc.commands import Disable, Reset, SetChannel
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import ChannelNotSettable, ChannelOutOfRange, NoLease, WrongState
from rtcp.ipc.states import State
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models import DiewuIoBox

SHIPPED = load(default_config())
SAFE, LOW, HIGH = 4.0, 4.0, 20.0
VALVE = PdoEntry(0x7000, 1, "uint16", "current", 0.001, "mA", min=LOW, max=HIGH, safe=SAFE)
PRESSURE = PdoEntry(0x6000, 1, "uint16", "pressure", 0.01, "bar", offset=-1.0)
ANGLE = PdoEntry(0x6010, 1, "int32", "angle", 0.5, "rad", modulo=1000)
BOX = SHIPPED.slaves[0].device
VALVES = replace(BOX, kind="analog", rpdo=(Pdo(0x1600, (VALVE,)),), tpdo=(Pdo(0x1A00, (PRESSURE, ANGLE)),))
SLOT = len(SHIPPED.slaves)
POSITION = SLOT + 1


def config(**more: Any) -> ArmConfig:
    slaves = (*SHIPPED.slaves, SlaveConfig("valves", VALVES))
    return replace(SHIPPED, slaves=slaves, cycle=replace(SHIPPED.cycle, period_us=1000.0), **more)


@pytest.fixture
def arm() -> Iterator[Simulation]:
    segment = load_segment(segment_path(SHIPPED))
    segment = replace(segment, slaves=(*segment.slaves, SegmentSlave("diewu-io")))
    with Simulation(config(), segment=segment, follow_clock=False) as made:
        made.bring_to(State.READY)
        made.run(0.1)
        made.acquire()
        yield made


def valves(arm: Simulation) -> DiewuIoBox:
    device = arm.bus.slaves[SLOT].device
    assert isinstance(device, DiewuIoBox)
    return device


def sent(arm: Simulation) -> float:
    """Current that the slave has received, mA."""
    arm.run(0.01)
    return 0.001 * valves(arm).outputs


def latest(arm: Simulation) -> dict[str, float]:
    record = arm.observer.latest()
    assert record is not None
    return {name: record[name].item() for name in ("valves_pressure", "valves_angle", "valves_current")}


def test_channels_are_read_in_their_units_and_in_the_record(arm: Simulation) -> None:
    model = valves(arm)
    model.inputs = 350
    for counts, angle in ((400, 200.0), (800, 400.0), (5, 502.5), (990, 495.0)):  # begins anew at 1000
        model.objects[0x6010, 1].value = counts
        arm.run(0.01)
        assert latest(arm)["valves_angle"] == pytest.approx(angle)
    assert latest(arm)["valves_pressure"] == pytest.approx(2.5)
    assert latest(arm)["valves_current"] == pytest.approx(SAFE)


def test_an_output_begins_safe_is_set_within_its_range_and_is_safe_after_a_fault(arm: Simulation) -> None:
    assert sent(arm) == pytest.approx(SAFE)
    arm.do(SetChannel(POSITION, 0, 12.5))
    assert sent(arm) == pytest.approx(12.5)
    for value in (3.999, 20.001, float("nan"), float("inf")):
        assert isinstance(arm.send(SetChannel(POSITION, 0, value)).refusal, ChannelOutOfRange)
    assert Names(arm.config).message(arm.send(SetChannel(POSITION, 0, 21.0)).refusal) == (
        "valves.current: 21 cannot be set: allowed is 4 to 20 (min, max and type in the device file of slave valves)"
    )
    assert sent(arm) == pytest.approx(12.5)
    arm.hold()
    assert sent(arm) == pytest.approx(12.5)
    arm.models[0].inject_fault(0x2310)
    arm.bring_to(State.FAULT)
    assert sent(arm) == pytest.approx(SAFE)
    assert isinstance(arm.send(SetChannel(POSITION, 0, 12.5)).refusal, WrongState)
    arm.do(Reset())
    arm.bring_to(State.READY)
    assert sent(arm) == pytest.approx(SAFE)
    arm.do(SetChannel(POSITION, 0, 5.0))
    assert sent(arm) == pytest.approx(5.0)
    arm.do(Disable())
    assert sent(arm) == pytest.approx(5.0)


def test_what_is_no_output_of_such_a_slave_is_not_set(arm: Simulation) -> None:
    for position, channel in ((POSITION, 1), (POSITION, -1), (1, 0), (2, 0), (0, 0), (POSITION + 1, 0)):
        assert arm.send(SetChannel(position, channel, 5.0)).refusal == ChannelNotSettable(position, channel)
    assert Names(arm.config).message(ChannelNotSettable(2, 1)).startswith("drive1.target_position cannot be set: ")
    assert arm.send(SetChannel(POSITION, 0, 5.0), lease=0).refusal == NoLease()
    assert sent(arm) == pytest.approx(SAFE)


def test_an_output_that_a_process_writes_is_the_process_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ProcessConfig, "channels", lambda self: iter([("gate", "rpdo", "valves.current")]))
    made = config(processes=(ProcessConfig("heater", "heater"),))
    assert made.process_outputs == {("valves", "current")}
