"""Drives of CiA 402 in the whole loop, in simulated time: of one mode, in the standard's units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.config import default_config, load, load_device, load_segment, segment_path
from rtcp.config.model import ArmConfig, Pdo, SlaveConfig, StartupSdo
from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.errors import BusError
from rtcp.ipc.commands import Home, MoveJoints, Reset, SetControlMode, SetDriveMode
from rtcp.ipc.events import DriveErrorCode, DriveFault, Homed, HomingFailed, ProcessDataLost, SlaveLost
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import DriveModeUnsupported, HomingUnsupported
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models.servo import ServoAxis
from tests.drive_esi import ARMS, Objects, write_esi

SHIPPED = load(default_config())
BENT = (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)


def of_one_mode() -> ArmConfig:
    """The shipped arm with drives whose PDOs have no mode, which a start-up SDO sets to CSP."""
    device = SHIPPED.slaves[1].device
    images = [
        (Pdo(pdo.index, tuple(entry for entry in pdo.channels if "modes" not in entry.name)),)
        for (pdo,) in (device.rpdo, device.tpdo)
    ]
    csp = StartupSdo(0x6060, 0, "int8", 8)
    device = replace(device, rpdo=images[0], tpdo=images[1], sdo=(*device.sdo, csp))
    slaves = tuple(slave if i == 0 else SlaveConfig(slave.name, device) for i, slave in enumerate(SHIPPED.slaves))
    return replace(SHIPPED, slaves=slaves, cycle=replace(SHIPPED.cycle, period_us=1000.0))


@pytest.fixture
def arm() -> Iterator[Simulation]:
    """Enabled at `BENT`."""
    with Simulation(of_one_mode(), follow_clock=False, positions=BENT) as made:
        made.hold()
        yield made


def test_an_arm_whose_drives_have_no_mode_in_their_pdos_moves_in_csp(arm: Simulation) -> None:
    goal = (0.1, *BENT[1:])
    arm.do(MoveJoints(goal, 0.5, True))
    arm.bring_to(State.HOLDING)
    arm.run(0.2)
    assert arm.models[0].mechanics.position == pytest.approx(0.1, abs=2e-3)


def test_every_other_mode_is_refused_with_the_reason(arm: Simulation) -> None:
    names = Names(arm.config)
    for command in (SetDriveMode(DriveMode.CST), SetControlMode(ControlMode.TORQUE)):
        refusal = arm.send(command).refusal
        assert refusal == DriveModeUnsupported(0, DriveMode.CST)
    assert "no process data for that (rpdo and tpdo in its device file)" in names.message(refusal)
    refusal = arm.send(Home(2)).refusal
    assert refusal == HomingUnsupported(2)
    assert names.message(refusal) == (
        "joint3 has no homing here: the PDOs of its drive lack modes_of_operation or modes_of_operation_display, "
        "so it stays in CSP"
    )
    assert arm.state is State.HOLDING


# -- the device files of standard drives, on slaves of an ESI file -------------------------------------------------


def arm_of(directory: Path, name: str, differing: Objects | None = None) -> tuple[ArmConfig, SegmentConfig]:
    """The shipped arm with drives of `ARMS`, as many as its joints need."""
    key, objects, options = ARMS[name]
    device = load_device(default_config().parent / "devices" / f"{key}.yaml")
    write_esi(directory / "drive.xml", device, {**objects, **(differing or {})})
    axes = len(device.axes)
    slaves = tuple(SlaveConfig(f"drive{i + 1}", device, f"{key}.yaml") for i in range(6 // axes))
    joints = tuple(
        replace(joint, slave=f"drive{i // axes + 1}", axis=i % axes + 1) for i, joint in enumerate(SHIPPED.joints)
    )
    # These drives turn more inertia than those whose torque limits the joints have.
    supervision = replace(SHIPPED.supervision, torque=1.5)
    config = replace(SHIPPED, slaves=(SHIPPED.slaves[0], *slaves), joints=joints, supervision=supervision)
    described = SegmentSlave(esi="drive.xml", behaviour="cia402", options=options)
    shipped = load_segment(segment_path(SHIPPED))
    segment = replace(
        shipped, slaves=(shipped.slaves[0], *[described] * len(slaves)), source=directory / "segment.yaml"
    )
    return replace(config, cycle=replace(SHIPPED.cycle, period_us=1000.0)), segment


@pytest.fixture(params=ARMS)
def standard(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Simulation]:
    """Enabled at `BENT`."""
    config, segment = arm_of(tmp_path, request.param)
    with Simulation(config, follow_clock=False, positions=BENT, segment=segment) as made:
        start(made)
        yield made


def start(arm: Simulation) -> None:
    arm.hold()


def servos(arm: Simulation) -> list[ServoAxis]:
    return [servo for slave in arm.bus.slaves for servo in slave.device.servos]


def test_an_arm_of_standard_drives_moves_where_it_is_sent(standard: Simulation) -> None:
    goal = (0.2, 0.35, 2.2, -0.2, 0.4, 0.3)
    standard.do(MoveJoints(goal, 0.5, True))
    standard.run(0.6)
    assert min(abs(servo.mechanics.velocity) for servo in servos(standard)) > 0.02
    speeds = [pytest.approx(servo.mechanics.velocity, abs=5e-3) for servo in servos(standard)]
    assert standard.loop.arm.state.actual_velocity == speeds
    standard.bring_to(State.HOLDING, 8.0)
    standard.run(0.3)
    assert [servo.mechanics.position for servo in servos(standard)] == [pytest.approx(q, abs=5e-3) for q in goal]
    assert standard.loop.arm.state.actual == [pytest.approx(q, abs=5e-3) for q in goal]
    torques = [servo.axis.torque for servo in servos(standard)]
    assert standard.loop.arm.state.actual_torque == [pytest.approx(torque, abs=0.5) for torque in torques]
    assert max(map(abs, torques)) > 3.0


def test_a_fault_of_one_axis_stops_all_and_names_its_joint(standard: Simulation) -> None:
    standard.do(MoveJoints((0.3, *BENT[1:]), 0.3, True))
    standard.run(0.2)
    servos(standard)[1].inject_fault(0x2310)
    standard.bring_to(State.FAULT, 2.0)
    standard.run(0.5)
    (fault,) = [record.event for record in standard.events if isinstance(record.event, DriveFault)]
    assert fault.axis == 1
    codes = [record.event for record in standard.events if isinstance(record.event, DriveErrorCode)]
    has_code = (0x603F, 0) in standard.bus.slaves[1].device.objects
    assert [(event.axis, event.error_code) for event in codes] == [(1, 0x2310)] * has_code
    assert not servos(standard)[1].powered
    standard.do(Reset())
    standard.bring_to(State.READY)


def test_a_drive_homes_where_it_can_and_otherwise_the_arm_holds(standard: Simulation) -> None:
    homes = (0x6098, 0) in standard.bus.slaves[1].device.objects
    before = standard.loop.arm.state.actual[2]
    standard.do(Home(2))
    standard.run(0.05)
    standard.bring_to(State.HOLDING)
    (end,) = [record.event for record in standard.events if isinstance(record.event, Homed | HomingFailed)]
    assert (isinstance(end, Homed), end.axis) == (homes, 2)
    if isinstance(end, HomingFailed):
        assert (end.mode, standard.loop.arm.state.actual[2]) == (8, pytest.approx(before, abs=1e-3))


def test_the_loss_of_a_slave_concerns_all_its_axes(tmp_path: Path) -> None:
    config, segment = arm_of(tmp_path, "two-axis")
    with Simulation(config, follow_clock=False, positions=BENT, segment=segment) as arm:
        start(arm)
        arm.bus.drop(3, 2, 0x001B)
        arm.bring_to(State.FAULT, 2.0)
        arm.run(0.5)
        assert {type(record.event) for record in arm.events} & {SlaveLost, ProcessDataLost}
        assert not any(servo.powered for servo in servos(arm)[2:4])
        arm.do(Reset())
        arm.hold()


def test_a_drive_whose_second_axis_has_another_gear_does_not_start(tmp_path: Path) -> None:
    config, segment = arm_of(tmp_path, "two-axis", {0x6891: (100, 1)})
    with pytest.raises(BusError, match=r"slave 2 \(drive1\), axis 2: .*0x6891 holds 100 .* the file has 50 "):
        Simulation(config, segment=segment)
