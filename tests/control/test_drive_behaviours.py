"""Drives that differ as makers build them, played by options of the segment: the whole loop in simulated time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import pi
from pathlib import Path

import pytest

from rtcp.config import default_config, load, load_device
from rtcp.config.model import DeviceDescription, DriveWaitsConfig, Pdo, SlaveConfig, StartupSdo
from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.errors import BusError
from rtcp.ipc.commands import Halt, Home, MoveJoints, Reset
from rtcp.ipc.events import Homed, HomedElsewhere, ResetTimeout
from rtcp.ipc.states import State
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models.servo import ServoAxis
from tests.drive_esi import SYNAPTICON, write_esi

SHIPPED = load(default_config().parent / "one_actuator.yaml")
DEVICE = load_device(default_config().parent / "devices" / "synapticon-somanet.yaml")
NEXT_INDEX = 33
"""Homing method: the next index pulse in negative direction."""
INDEX_PITCH = 2 * pi / 100


def arm_of(
    directory: Path,
    options: Mapping[str, float],
    period_us: float = 1000.0,
    device: DeviceDescription = DEVICE,
    waits: DriveWaitsConfig | None = None,
) -> Simulation:
    """One joint on one drive of the standard, at 0.5 rad, without an emergency stop."""
    write_esi(directory / "drive.xml", device, {**SYNAPTICON, 0x6098: ("SINT", NEXT_INDEX)})
    config = replace(
        SHIPPED,
        slaves=(SlaveConfig("drive1", device, "devices/x.yaml"),),
        cycle=replace(SHIPPED.cycle, period_us=period_us),
        inputs=replace(SHIPPED.inputs, emergency_stop=None),
        outputs=type(SHIPPED.outputs)(),
        drive_waits=waits or DriveWaitsConfig(),
    )
    scale: dict[str, object] = {"counts_per_turn": 524288.0 * 100, "initial_position": 0.5, "load_inertia": 0.1}
    slave = SegmentSlave(esi="drive.xml", behaviour="cia402", options=scale | dict(options))
    return Simulation(config, follow_clock=False, segment=SegmentConfig((slave,), source=directory / "segment.yaml"))


def servo(arm: Simulation) -> ServoAxis:
    (axis,) = arm.bus.slaves[0].device.servos
    assert isinstance(axis, ServoAxis)
    return axis


@pytest.mark.parametrize("lag_s", [0.01, 0.05, 0.15])
@pytest.mark.parametrize("period_us", [250.0, 1000.0, 4000.0])
def test_a_drive_whose_bits_come_late_is_homed_when_it_is_at_its_home(
    tmp_path: Path, period_us: float, lag_s: float
) -> None:
    with arm_of(tmp_path, {"mode_bits_lag": lag_s}, period_us) as arm:
        arm.hold()
        arm.do(Home(0, 0.0))
        arm.bring_to(State.HOLDING, 3.0)
        (homed,) = [record.event for record in arm.events if isinstance(record.event, Homed)]
        turns = servo(arm).mechanics.position / INDEX_PITCH
        assert homed.position == pytest.approx(0.0, abs=0.02)
        assert turns - homed.position / INDEX_PITCH == pytest.approx(7.0, abs=0.01)


def test_a_halt_stops_a_search_whose_bits_still_show_an_earlier_success(tmp_path: Path) -> None:
    with arm_of(tmp_path, {"mode_bits_lag": 0.25}) as arm:
        arm.hold()
        arm.run(0.5)
        arm.do(Home(0, 0.0))
        assert arm.until(lambda: servo(arm).mechanics.velocity < -0.01, 2.0)
        # Longer than settle_ms after the start bit, the bits of CSP count as a success.
        arm.run(0.12)
        before = servo(arm).mechanics.position
        arm.do(Halt())
        arm.bring_to(State.HOLDING, 2.0)
        assert servo(arm).mechanics.position == pytest.approx(before, abs=0.01)
        assert not any(isinstance(record.event, Homed) for record in arm.events)


def test_a_drive_that_says_it_is_homed_where_it_is_not_has_not_homed(tmp_path: Path) -> None:
    with arm_of(tmp_path, {"mode_bits_lag": 0.4}) as arm:
        arm.hold()
        arm.run(0.5)
        arm.do(Home(0, 0.0))
        arm.bring_to(State.HOLDING, 3.0)
        (end,) = [record.event for record in arm.events if isinstance(record.event, Homed | HomedElsewhere)]
        assert isinstance(end, HomedElsewhere)
        assert (end.axis, end.shown, end.home_offset) == (0, pytest.approx(0.48, abs=0.03), 0.0)
        here = servo(arm).mechanics.position
        arm.run(0.5)
        assert servo(arm).mechanics.position == pytest.approx(here, abs=1e-3)


@pytest.mark.parametrize("period_us", [250.0, 4000.0])
@pytest.mark.parametrize("pulse_ms", [10.0, 2.0])
def test_a_drive_is_reset_by_a_pulse_that_is_long_enough_for_it(
    tmp_path: Path, period_us: float, pulse_ms: float
) -> None:
    waits = DriveWaitsConfig(reset_pulse_ms=pulse_ms, reset_ms=500.0)
    long_enough = max(pulse_ms, period_us / 1000.0) >= 4.0
    with arm_of(tmp_path, {"reset_pulse": 0.003}, period_us, waits=waits) as arm:
        arm.hold()
        servo(arm).inject_fault(0x2310)
        arm.bring_to(State.FAULT)
        arm.run(0.5)
        arm.do(Reset())
        arm.bring_to(State.READY if long_enough else State.FAULT)
        assert any(isinstance(record.event, ResetTimeout) for record in arm.events) is not long_enough


@pytest.mark.parametrize(
    ("period_us", "option", "words"),
    [
        (1000.0, {"interpolation_ms": 5.0}, ""),
        (500.0, {"interpolation_ms": 1.0}, "8 bits in ms cannot express the cycle"),
        (500.0, {"interpolation_read_only": 500.0}, ""),
        (1000.0, {"interpolation_read_only": 500.0}, "attempt to write a read-only object"),
    ],
)
def test_a_drive_interpolates_over_the_cycle_or_does_not_start(
    tmp_path: Path, period_us: float, option: dict[str, float], words: str
) -> None:
    if words:
        with pytest.raises(BusError, match=rf"\(0x60C2\) is \d+ us, the cycle .* is {period_us:g} us.*{words}"):
            arm_of(tmp_path, option, period_us)
        return
    with arm_of(tmp_path, option, period_us) as arm:
        value, exponent = (
            arm.bus.slaves[0].device.objects[0x60C2, 1].value,
            -3 if "interpolation_ms" in option else -6,
        )
        assert value * 10.0**exponent == pytest.approx(period_us * 1e-6)
        arm.hold()
        arm.do(MoveJoints((0.6,), 0.5, True))
        arm.bring_to(State.HOLDING, 3.0)
        assert servo(arm).mechanics.position == pytest.approx(0.6, abs=3e-3)


def test_a_drive_without_0x6061_moves_in_csp(tmp_path: Path) -> None:
    (tpdo,) = DEVICE.tpdo
    shown = Pdo(tpdo.index, tuple(entry for entry in tpdo.channels if entry.index != 0x6061))
    device = replace(DEVICE, tpdo=(shown,), sdo=(*DEVICE.sdo, StartupSdo(0x6060, 0, "int8", 8)))
    with arm_of(tmp_path, {"no_mode_display": 1.0}, device=device) as arm:
        assert (0x6061, 0) not in arm.bus.slaves[0].device.objects
        arm.hold()
        arm.do(MoveJoints((0.6,), 0.5, True))
        arm.bring_to(State.HOLDING, 3.0)
        assert servo(arm).mechanics.position == pytest.approx(0.6, abs=3e-3)
        assert "the PDOs of its drive lack modes_of_operation or modes_of_operation_display" in arm.names.message(
            arm.send(Home(0)).refusal
        )
