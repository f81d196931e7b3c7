"""Feed-forward on the whole loop in simulated time: what the drives are sent, and the following error with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, FeedForwardConfig, PdoEntry
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.ipc import commands
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.motion.feed_forward import FeedForward
from rtcp.motion.limits import rows
from rtcp.motion.state import ArmState
from rtcp.testing import Simulation

CONFIG = load(default_config())
START, GOAL = (0.0, 0.2, 1.2, 0.0, 0.4, 0.0), (0.3, 0.7, 1.7, 0.4, 0.8, 0.4)
INERTIA = (2.2, 2.7, 0.9, 0.07, 0.04, 0.007)
ALL = FeedForwardConfig(velocity=1.0, gravity=1.0, acceleration=1.0)
VELOCITY, TORQUE = 0x60B1, 0x60B2
COUNTS = 1e4


def fed(settings: FeedForwardConfig, inertia: tuple[float, ...] = INERTIA) -> ArmConfig:
    """The default arm with drives that map the offsets."""
    slaves = []
    for slave in CONFIG.slaves:
        device = slave.device
        if device.kind == "cia402":
            offsets = (
                PdoEntry(VELOCITY, 0, "int32", "velocity_offset", 1 / COUNTS),
                PdoEntry(TORQUE, 0, "int32", "torque_offset", 1 / COUNTS),
            )
            pdo = device.rpdo[0]
            device = replace(device, rpdo=(replace(pdo, channels=(*pdo.channels, *offsets)),))
        slaves.append(replace(slave, device=device))
    joints = tuple(replace(joint, inertia=each) for joint, each in zip(CONFIG.joints, inertia, strict=True))
    cycle = replace(CONFIG.cycle, period_us=2000.0)
    return replace(CONFIG, slaves=tuple(slaves), joints=joints, feed_forward=settings, cycle=cycle)


class Fed(Simulation):
    """An arm that watches the offsets and the following errors of its drives."""

    def __init__(self, settings: FeedForwardConfig, velocity_share: float = 1.0) -> None:
        segment = load_segment(CONFIG.source.parent / "segment.yaml")
        slaves = tuple(
            replace(slave, options={**slave.options, "velocity_share": velocity_share})
            if "orh" in (slave.model or "")
            else slave
            for slave in segment.slaves
        )
        chosen = SegmentConfig(slaves, segment.source, segment.arm)
        super().__init__(fed(settings), seed=1, positions=START, segment=chosen)

    def offsets(self, index: int) -> list[float]:
        """An offset of each drive as it has it, rad/s or Nm."""
        return [int(model.objects[index, 0].value) / COUNTS for model in self.models]

    def largest_error(self) -> float:
        """Move and return the largest following error inside the drives, rad (0x60F4: counts of 0.0001 rad)."""
        self.do(commands.MoveJoints(GOAL, 0.4, True))
        largest = 0.0
        while self.state is State.MOVING:
            self.cycle()
            largest = max(largest, *(abs(model.axis.demand - model.axis.position) for model in self.models))
        return largest


@pytest.fixture
def make() -> Iterator[Callable[..., Fed]]:
    made: list[Fed] = []

    def begin(settings: FeedForwardConfig, velocity_share: float = 1.0) -> Fed:
        arm = Fed(settings, velocity_share)
        made.append(arm)
        arm.hold()
        arm.run(0.8)
        return arm

    yield begin
    for arm in made:
        arm.close()


def test_offsets_reduce_the_following_error_of_drives_that_rely_on_them(make: Callable[..., Fed]) -> None:
    without, fed = (make(settings, velocity_share=0.0).largest_error() for settings in (FeedForwardConfig(), ALL))
    print(f"following error: {without:.5f} rad without offsets, {fed:.5f} rad with them")
    assert fed < 0.2 * without


def test_torque_offsets_reduce_the_following_error_of_drives_that_feed_the_velocity_forward_themselves(
    make: Callable[..., Fed],
) -> None:
    torque = replace(ALL, velocity=0.0)
    without, fed = (make(settings).largest_error() for settings in (FeedForwardConfig(), torque))
    print(f"following error: {without:.5f} rad without offsets, {fed:.5f} rad with torque offsets")
    assert fed < without


def test_while_it_holds_the_torque_offset_is_the_weight_and_the_arm_does_not_move_when_it_comes(
    make: Callable[..., Fed],
) -> None:
    arm = make(ALL)
    assert arm.offsets(TORQUE) == pytest.approx(list(arm.loop.arm.gravity.torques(START)), abs=2e-4)
    assert arm.offsets(VELOCITY) == [0.0] * 6
    assert max(abs(a - b) for a, b in zip(arm.loop.arm.state.actual, START, strict=True)) < 1e-3


def test_the_velocity_offset_is_the_velocity_of_the_setpoint_in_csp_and_0_in_csv(
    make: Callable[..., Fed],
) -> None:
    arm = make(ALL)
    arm.do(commands.MoveJoints(GOAL, 0.4, True))
    arm.run(0.5)
    assert max(map(abs, arm.offsets(VELOCITY))) > 0.1
    arm.until(lambda: arm.state is State.HOLDING, 5.0)
    arm.do(commands.SetDriveMode(DriveMode.CSV))
    arm.run(0.2)
    arm.do(commands.MoveJoints(START, 0.4, True))
    arm.run(0.5)
    assert arm.state is State.MOVING
    assert arm.offsets(VELOCITY) == [0.0] * 6
    assert max(map(abs, arm.offsets(TORQUE))) > 1.0


def test_the_torque_offset_goes_on_through_a_change_between_csp_and_csv_and_the_arm_does_not_move(
    make: Callable[..., Fed],
) -> None:
    arm = make(ALL)
    held = arm.offsets(TORQUE)
    before = [model.mechanics.position for model in arm.models]
    for mode in (DriveMode.CSV, DriveMode.CSP):
        arm.do(commands.SetDriveMode(mode))
        for _ in range(100):
            arm.cycle()
            assert arm.offsets(TORQUE) == pytest.approx(held, abs=0.01)
            assert [model.mechanics.position for model in arm.models] == pytest.approx(before, abs=2e-5)


def test_a_setpoint_that_passes_its_limit_by_round_off_keeps_its_offset(make: Callable[..., Fed]) -> None:
    arm = make(ALL)
    new = rows(replace(arm.loop.arm.limits.widest, velocity=(0.3,) * 6))
    arm.do(commands.SetLimits(arm.observer.write_plan(new), len(new)))
    arm.do(commands.MoveJoints((1.2, *START[1:]), 0.3, True))
    arm.run(0.5)
    assert arm.loop.arm.state.commanded_velocity[0] > 0.3
    assert arm.offsets(VELOCITY)[0] == pytest.approx(0.3, abs=2 / COUNTS)


@pytest.mark.parametrize("end", ["fault", "emergency stop", "disabled", "in CST", "enabling"])
def test_without_setpoints_and_outside_csp_and_csv_all_offsets_are_0(make: Callable[..., Fed], end: str) -> None:
    arm = make(ALL)
    arm.do(commands.MoveJoints(GOAL, 0.4, True))
    arm.run(0.5)
    if end == "fault":
        arm.models[3].inject_fault(0x8611)
        arm.bring_to(State.FAULT)
    elif end == "emergency stop":
        assert arm.box is not None
        arm.box.inputs &= ~0x200
        arm.until(lambda: arm.state is State.EMERGENCY_STOP, 1.0)
    else:
        arm.until(lambda: arm.state is State.HOLDING, 5.0)
        if end == "in CST":
            arm.do(commands.SetControlMode(ControlMode.TORQUE))
            arm.run(0.3)
        else:
            arm.do(commands.Disable())
            arm.bring_to(State.READY)
            if end == "enabling":
                arm.send(commands.Enable())
                arm.until(lambda: arm.state is State.ENABLING, 1.0)
    arm.run(0.005)
    for _ in range(20):
        assert arm.offsets(VELOCITY) == arm.offsets(TORQUE) == [0.0] * 6
        arm.cycle()


class Offset:
    def __init__(self) -> None:
        self.velocity = self.torque = self.change = 0.0


@pytest.mark.parametrize("value", [1e9, -1e9, math.nan, math.inf])
def test_offsets_are_finite_and_inside_the_limits_in_force(value: float) -> None:
    config = fed(ALL)
    with Simulation(config, positions=START) as arm:
        limits, gravity = arm.loop.arm.limits, arm.loop.arm.gravity
        offsets = [Offset() for _ in config.joints]
        feed, state = FeedForward(config, limits, gravity, offsets), ArmState(len(config.joints))
        state.commanded_velocity[1] = state.commanded_acceleration[1] = value
        for _ in range(1000):
            feed.update(state, DriveMode.CSP)
            assert abs(offsets[1].velocity) == (0.0 if math.isnan(value) else limits.velocity[1])
            assert abs(offsets[1].torque) <= limits.torque[1]
