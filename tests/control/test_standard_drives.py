"""Drives as CiA 402 has them, through the whole loop in simulated time: of one mode, in the standard's units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, Pdo, SlaveConfig, StartupSdo
from rtcp.ipc.commands import Enable, Home, MoveJoints, SetControlMode, SetDriveMode
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import DriveModeUnsupported, HomingUnsupported
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.launch.simulation import Simulation

SHIPPED = load(default_config())
BENT = (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)


def of_one_mode() -> ArmConfig:
    """The shipped arm with drives whose PDOs have no mode, which a start-up SDO sets to CSP."""
    device = SHIPPED.slaves[1].device
    images = [
        (Pdo(pdo.index, tuple(one for one in pdo.channels if "modes" not in one.name)),)
        for (pdo,) in (device.rpdo, device.tpdo)
    ]
    csp = StartupSdo(0x6060, 0, "int8", 8)
    device = replace(device, rpdo=images[0], tpdo=images[1], sdo=(*device.sdo, csp))
    slaves = tuple(one if i == 0 else SlaveConfig(one.name, device) for i, one in enumerate(SHIPPED.slaves))
    return replace(SHIPPED, slaves=slaves, cycle=replace(SHIPPED.cycle, period_us=1000.0))


@pytest.fixture
def arm() -> Iterator[Simulation]:
    """Enabled at `BENT`."""
    with Simulation(of_one_mode(), follow_clock=False, positions=BENT) as made:
        assert made.until(lambda: made.state is State.READY, 5.0)
        made.run(0.1)  # the emergency stop has to settle
        made.acquire()
        assert made.send(Enable()).refusal is None
        assert made.until(lambda: made.state is State.HOLDING, 5.0)
        yield made


def test_an_arm_whose_drives_have_no_mode_in_their_pdos_moves_in_csp(arm: Simulation) -> None:
    goal = (0.1, *BENT[1:])
    assert arm.send(MoveJoints(goal, 0.5, True)).refusal is None
    assert arm.until(lambda: arm.state is State.HOLDING, 5.0)
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
        "joint3 has no homing here: the PDOs of its drive have no modes_of_operation, so it stays in CSP"
    )
    assert arm.state is State.HOLDING
