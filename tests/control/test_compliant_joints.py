"""In CST a hand can move the joints: what then stays continuous, and what is refused."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import AbsoluteLimits, SupervisionConfig
from rtcp.ipc.commands import (
    ApplyTorque,
    Command,
    Disable,
    Enable,
    Guide,
    MoveJoints,
    SetControlMode,
    SetDriveMode,
    SetLimits,
)
from rtcp.ipc.events import TooHeavyForCst
from rtcp.ipc.refusals import TorqueLimitTooLow, WeightUnknown
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.motion.limits import rows
from rtcp.testing import Simulation

PERIOD_S = 0.002
_OUTPUTS = struct.Struct("<Hiiib")
ONE_NM = 10000
"""Counts of the drives' torques."""
NOTHING = (0.0,) * 6


@pytest.fixture
def arm(request: pytest.FixtureRequest) -> Iterator[Simulation]:
    """The arm holds; its second joint carries 18 to 24 Nm. The parameter replaces keys of the configuration."""
    config = load(default_config())
    config = replace(config, cycle=replace(config.cycle, period_us=PERIOD_S * 1e6), **request.param)
    with Simulation(config, positions=[0.0, -1.1, 0.3, 0.0, 0.5, 0.0], follow_clock=False) as arm:
        arm.hold()
        arm.run(1.0)
        yield arm


def in_mode(**keys: Any) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("arm", [keys], indirect=True)


@in_mode(drive_mode="cst")
def test_the_torque_that_holds_a_joint_at_the_end_of_its_range_is_continuous(arm: Simulation) -> None:
    widest = arm.loop.arm.limits.widest
    high = -1.0
    new = rows(replace(widest, high=(widest.high[0], high, *widest.high[2:])))
    arm.do(SetLimits(arm.observer.write_plan(new), len(new)))
    arm.do(MoveJoints((0.0, high, 0.3, 0.0, 0.5, 0.0), 0.5, True))
    torques: list[float] = []
    positions: list[float] = []

    def see(frame: Any) -> None:
        torques.append(_OUTPUTS.unpack(frame.sent[2])[3] / ONE_NM)
        positions.append(arm.models[1].mechanics.position)

    arm.on_frame = see
    arm.bring_to(State.HOLDING)
    arrived = len(torques)
    arm.run(1.0)
    assert max(abs(b - a) for a, b in pairwise(torques[arrived:])) < 1.0
    assert min(torques[arrived:]) > 10.0
    assert max(positions) < high + 0.01
    assert min(positions[arrived:]) > high - 0.005


@in_mode(drive_mode="cst")
@pytest.mark.parametrize("command", [SetControlMode(ControlMode.CARTESIAN), SetDriveMode(DriveMode.CST)], ids=str)
def test_the_torque_against_a_hand_is_continuous_when_the_drives_stay_in_cst(arm: Simulation, command: Command) -> None:
    joint = arm.models[1].mechanics
    joint.external_torque += 15.0
    arm.run(0.2)
    torques: list[float] = []
    arm.on_frame = lambda frame: torques.append(_OUTPUTS.unpack(frame.sent[2])[3] / ONE_NM)
    arm.run(0.02)
    arm.do(command)
    arm.run(0.1)
    assert max(abs(b - a) for a, b in pairwise(torques)) < 1.0


@in_mode(drive_mode="cst")
@pytest.mark.parametrize("mode", [DriveMode.CSP, DriveMode.CSV])
def test_a_joint_that_a_hand_moves_brakes_and_stays_when_its_drive_leaves_cst(arm: Simulation, mode: DriveMode) -> None:
    joint = arm.models[1].mechanics
    joint.external_torque = 25.0
    arm.run(0.1)
    speed, there = joint.velocity, joint.position
    assert speed > 0.3
    speeds: list[float] = []
    arm.on_frame = lambda frame: speeds.append(joint.velocity)
    arm.do(SetDriveMode(mode))
    arm.run(1.0)
    arm.on_frame = None
    joint.external_torque = 0.0
    arm.run(2.0)
    limit = arm.config.joints[1].acceleration
    # Over 8 ms, as the drive's own loop needs some time to follow.
    assert max(abs(b - a) for a, b in zip(speeds, speeds[4:], strict=False)) < 2.0 * limit * 4 * PERIOD_S
    assert arm.state is State.HOLDING
    # Nobody commanded a return to where the hand had found it.
    assert there < joint.position < there + speed * speed / limit
    assert joint.position == pytest.approx(arm.loop.arm.state.commanded[1], abs=2e-3)


@in_mode(drive_mode="csv")
@pytest.mark.parametrize("mode", [DriveMode.CSP, DriveMode.CST])
def test_a_joint_that_a_hand_moved_does_not_snap_when_its_drive_leaves_csv(arm: Simulation, mode: DriveMode) -> None:
    joint = arm.models[5].mechanics
    joint.external_torque -= 10.0
    arm.run(0.04)
    joint.external_torque += 10.0
    arm.run(0.12)
    speeds: list[float] = []
    torques: list[float] = []

    def see(frame: Any) -> None:
        speeds.append(joint.velocity)
        *_, torque, sent = _OUTPUTS.unpack(frame.sent[6])
        if sent == DriveMode.CST:
            torques.append(torque / ONE_NM)

    arm.on_frame = see
    arm.do(SetDriveMode(mode))
    arm.run(0.5)
    limit = arm.config.joints[5].acceleration
    assert max(abs(b - a) for a, b in zip(speeds, speeds[4:], strict=False)) < 2.0 * limit * 4 * PERIOD_S
    assert max([abs(b - a) for a, b in pairwise(torques)], default=0.0) < 1.0
    assert bool(torques) is (mode is DriveMode.CST)


@in_mode(control_mode="torque")
def test_a_stiffness_and_a_damping_that_change_under_way_change_the_torque_gradually(arm: Simulation) -> None:
    arm.run(1.0)
    arm.do(ApplyTorque((0.0, 8.0, 0.0, 0.0, 0.0, 0.0), 0.3, 1.0, 1.0))
    arm.run(0.3)
    torques: list[float] = []
    arm.on_frame = lambda frame: torques.append(_OUTPUTS.unpack(frame.sent[2])[3] / ONE_NM)
    arm.run(0.01)
    arm.do(ApplyTorque((0.0, 8.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 1.0))
    arm.run(0.1)
    arm.do(ApplyTorque((0.0, 8.0, 0.0, 0.0, 0.0, 0.0), 1.0, 1.0, 1.0))
    arm.run(0.2)
    assert max(torques) - min(torques) > 3.0
    assert max(abs(b - a) for a, b in pairwise(torques)) < 1.5


@in_mode(control_mode="torque")
@pytest.mark.parametrize("command", [ApplyTorque(NOTHING, 0.0, 0.0, 0.2), Guide(0.2)], ids=["torque", "guide"])
def test_a_torque_motion_that_begins_while_a_joint_turns_is_refused_as_its_weight_is_unknown(
    arm: Simulation, command: Command
) -> None:
    joint = arm.models[5].mechanics
    joint.external_torque = 6.0
    assert arm.until(lambda: abs(arm.loop.arm.state.actual_velocity[5]) > 0.011, 1.0)
    refusal = arm.send(command).refusal
    assert isinstance(refusal, WeightUnknown)
    joint.external_torque = 0.0
    measured = arm.loop.arm.state.actual_velocity
    assert arm.until(lambda: max(map(abs, measured)) < 0.009, 3.0)
    arm.do(command)


@in_mode(drive_mode="csp", supervision=SupervisionConfig(torque=1.5))
def test_a_torque_limit_below_the_weight_permits_no_cst(arm: Simulation) -> None:
    widest, held = arm.loop.arm.limits.widest, abs(arm.loop.arm.state.actual_torque[1])
    # The supervision permits more than the limit.
    limit = 0.9 * held
    new = rows(replace(widest, torque=(widest.torque[0], limit, *widest.torque[2:])))
    arm.do(Disable())
    arm.bring_to(State.READY)
    arm.do(SetLimits(arm.observer.write_plan(new), len(new)))
    changes = (SetDriveMode(DriveMode.CST), SetControlMode(ControlMode.TORQUE))
    for enable in (False, True):
        if enable:
            arm.do(Enable())
            arm.bring_to(State.HOLDING)
            arm.run(0.2)
        for change in changes:
            refusal = arm.send(change).refusal
            assert isinstance(refusal, TorqueLimitTooLow)
            assert (refusal.axis, refusal.limit) == (1, limit)
            assert refusal.held == pytest.approx(held, rel=0.2)
        assert arm.loop.arm.mode is DriveMode.CSP


@in_mode(drive_mode="cst")
def test_an_arm_that_its_torque_limits_cannot_hold_is_not_enabled_in_cst(arm: Simulation) -> None:
    widest = arm.loop.arm.limits.widest
    new = rows(replace(widest, torque=(widest.torque[0], 5.0, *widest.torque[2:])))
    arm.do(Disable())
    arm.bring_to(State.READY)
    arm.do(SetLimits(arm.observer.write_plan(new), len(new)))
    assert isinstance(arm.send(Enable()).refusal, TorqueLimitTooLow)
    assert arm.state is State.READY


@in_mode(drive_mode="cst")
def test_an_arm_with_a_load_that_its_torque_limits_cannot_hold_ends_in_a_fault_before_cst(arm: Simulation) -> None:
    """The model does not know the load: only the drives show it, once they carry it."""
    widest, weight = arm.loop.arm.limits.widest, abs(arm.loop.arm.state.actual_torque[1])
    limit = 1.05 * weight
    new = rows(replace(widest, torque=(widest.torque[0], limit, *widest.torque[2:])))
    arm.do(Disable())
    arm.bring_to(State.READY)
    arm.do(SetLimits(arm.observer.write_plan(new), len(new)))
    virtual = arm.bus.segment.arm
    assert virtual is not None
    virtual.push((0.0, 0.0, -10.0, 0.0, 0.0, 0.0))
    modes: set[DriveMode] = set()
    arm.on_frame = lambda frame: modes.add(arm.loop.arm.mode)
    arm.do(Enable())
    arm.run(1.0)
    (event,) = (record.event for record in arm.events if isinstance(record.event, TooHeavyForCst))
    assert (event.axis, event.limit) == (1, limit)
    assert event.held > limit
    assert arm.state is State.FAULT
    assert modes == {DriveMode.CSP}


@in_mode(drive_mode="cst")
def test_targets_after_a_push_beyond_the_speed_limit_brake_by_the_acceleration_limit(arm: Simulation) -> None:
    drive, limits = arm.loop.arm.drives[4], arm.loop.arm.limits
    arm.models[4].mechanics.external_torque = -8.8
    arm.run(0.06)
    assert abs(drive.velocity) > limits.velocity[4]
    arm.send(SetDriveMode(DriveMode.CSP))
    targets = []
    for _ in range(round(0.4 / PERIOD_S)):
        arm.cycle()
        targets.append(drive.target_position)
    speeds = [(after - before) / PERIOD_S for before, after in pairwise(targets)]
    assert max(map(abs, speeds)) <= limits.velocity[4] * 1.001
    changes = [abs(after - before) / PERIOD_S for before, after in pairwise(speeds)]
    assert max(changes) <= limits.acceleration[4] * 1.01


NARROW, WIDE = 26.0, 49.0
"""Nm: torque limit of the second joint in the file, and the one to which it can be widened."""


@in_mode(
    drive_mode="cst",
    joints=tuple(
        replace(joint, torque=NARROW, absolute=AbsoluteLimits(torque=WIDE)) if i == 1 else joint
        for i, joint in enumerate(load(default_config()).joints)
    ),
)
def test_a_torque_limit_that_was_widened_is_what_holds_the_arm_in_cst(arm: Simulation) -> None:
    new = rows(replace(arm.loop.arm.limits.widest, torque=arm.loop.arm.limits.absolute.torque))
    arm.do(Disable())
    arm.bring_to(State.READY)
    arm.do(SetLimits(arm.observer.write_plan(new), len(new), widen=True))
    virtual = arm.bus.segment.arm
    assert virtual is not None
    virtual.push((0.0, 0.0, -20.0, 0.0, 0.0, 0.0))
    before = arm.models[1].mechanics.position
    arm.do(Enable())
    arm.bring_to(State.HOLDING)
    arm.run(1.0)
    assert abs(arm.loop.arm.state.actual_torque[1]) > NARROW
    assert arm.models[1].mechanics.position == pytest.approx(before, abs=0.005)
    assert arm.state is State.HOLDING
