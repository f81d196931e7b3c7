"""A measurement that a joint cannot have is not used; one that stays is a fault with its name."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from math import pi
from random import Random

import pytest

from rtcp.control.cycle import make_drives
from rtcp.control.measurements import Measurements
from rtcp.ipc.commands import SetDriveMode
from rtcp.ipc.events import DriveModeTimeout, FaultEvent, PositionJumped, VelocityDisagrees, VelocityJumped
from rtcp.ipc.states import DriveMode, DriveState, State

from .rig import CONFIG, COUNTS, CSP, CST, CSV, PERIOD_S, SPEED, LoopRig, about

_INPUTS = struct.Struct("<Hiiib")
POSITION, VELOCITY, TORQUE, MODE = 1, 2, 3, 4
CYCLES = CONFIG.supervision.cycles
MODES = pytest.mark.parametrize("mode", [CSP, CSV, CST])
ONE_TURN = 62832

Falsify = Callable[[int], int]
FALSE: dict[str, tuple[int, Falsify]] = {
    "one turn off": (POSITION, lambda counts: counts + ONE_TURN),
    "a hundredth of a radian off": (POSITION, lambda counts: counts - 100),
    "an overflow": (POSITION, lambda counts: (counts & 0xFFFF) - (1 << 31)),
    "a position of 0": (POSITION, lambda counts: 0),
    "a speed of 0": (VELOCITY, lambda counts: 0),
    "a speed of 5 rad/s": (VELOCITY, lambda counts: 50000),
    "a speed 0.2 rad/s lower": (VELOCITY, lambda counts: counts - 2000),
    "a torque of 40 Nm": (TORQUE, lambda counts: 400000),
    "mode 0": (MODE, lambda counts: 0),
    "mode 10 or 9": (MODE, lambda counts: CST if counts != CST else CSV),
}


def falsify(rig: LoopRig, at: int, change: Falsify, axis: int = 0) -> Callable[[], None]:
    """Falsify an input of a drive in all frames from now on; return a function that ends it."""
    real = rig.data.input

    def read(index: int) -> bytes:
        if index != axis + 1:
            return real(index)
        values = list(_INPUTS.unpack(real(index)))
        values[at] = change(values[at])
        return _INPUTS.pack(*values)

    rig.data.input = read  # type: ignore[method-assign]
    return lambda: setattr(rig.data, "input", real)


def frames_after(mode: int, false: str, cycles: int) -> tuple[LoopRig, list[tuple[int, int, int]]]:
    """Move at full speed with false samples of the first joint; return what its drive received for 0.1 s."""
    rig = LoopRig()
    rig.set_in_motion(mode)
    begun, events = len(rig.log), len(rig.events)
    end = falsify(rig, *FALSE[false])
    rig.run(cycles * PERIOD_S)
    end()
    rig.run(0.1 - cycles * PERIOD_S)
    assert rig.state is State.MOVING
    assert len(rig.events) == events
    return rig, [(cycle.drives[0].target, cycle.drives[0].speed, cycle.drives[0].effort) for cycle in rig.log[begun:]]


@MODES
@pytest.mark.parametrize("false", FALSE)
def test_false_samples_change_no_target_beyond_what_a_joint_notices(mode: int, false: str) -> None:
    rig, frames = frames_after(mode, false, CYCLES - 1)
    rig.close()
    true, expected = frames_after(mode, false, 0)
    true.close()
    # The position continues at the joint's velocity, which changes little in four cycles.
    speed, torque = 0.02 * SPEED * COUNTS, 0.5 * COUNTS
    for (position, velocity, effort), (a, b, c) in zip(frames, expected, strict=True):
        assert position == a
        assert abs(velocity - b) <= speed
        assert abs(effort - c) <= torque


@pytest.mark.parametrize("cycles", [1, CYCLES - 1])
def test_a_false_torque_in_the_cycle_of_a_mode_change_does_not_become_the_holding_torque(
    rig: LoopRig, cycles: int
) -> None:
    rig.hold(CSP)
    rig.run(0.1)
    before = rig.models[0].mechanics.position
    end = falsify(rig, TORQUE, lambda counts: counts + 10 * COUNTS)
    rig.run((cycles - 1) * PERIOD_S)
    rig.do(SetDriveMode(DriveMode.CST))
    end()
    rig.run(0.3)
    assert max(abs(cycle.drives[0].effort) for cycle in rig.log[-300:]) < 0.1 * COUNTS
    assert rig.models[0].mechanics.position == about(before, abs=1e-4)


@pytest.mark.parametrize("false", [CSP, CST])
@pytest.mark.parametrize("cycles", [1, CYCLES - 1])
def test_a_false_mode_display_while_a_drive_changes_its_mode_sends_it_no_target_of_that_mode(
    rig: LoopRig, false: int, cycles: int
) -> None:
    rig.hold(CSV)
    rig.misunderstood[0, 0x6060] = {CSP: CSV}
    rig.do(SetDriveMode(DriveMode.CSP))
    rig.run(5 * PERIOD_S)
    begun = len(rig.log)
    end = falsify(rig, MODE, lambda counts: false)
    rig.run(cycles * PERIOD_S)
    end()
    rig.run(10 * PERIOD_S)
    assert {(cycle.drives[0].speed, cycle.drives[0].effort) for cycle in rig.log[begun:]} == {(0, 0)}
    rig.misunderstood.clear()
    rig.run(0.1)
    assert rig.state is State.HOLDING


@pytest.mark.parametrize(
    ("false", "event"),
    [
        ("one turn off", PositionJumped),
        ("a hundredth of a radian off", PositionJumped),
        ("a speed of 0", VelocityJumped),
        ("mode 0", DriveModeTimeout),
    ],
)
@MODES
def test_samples_that_stay_false_are_a_fault_that_names_joint_sample_and_bound(
    rig: LoopRig, mode: int, false: str, event: type
) -> None:
    rig.set_in_motion(mode)
    falsify(rig, *FALSE[false], axis=1)
    rig.run((CYCLES - 1) * PERIOD_S)
    assert rig.state is State.MOVING
    rig.cycle()
    assert rig.state in (State.FAULT, State.EMERGENCY_STOP)
    found = rig.last
    if false == "one turn off":
        # The following error is beyond its limit too, and is the harder stop.
        return
    assert type(found) is event
    limits = CONFIG.supervision
    if isinstance(found, PositionJumped):
        bound = limits.speed * CONFIG.joints[1].velocity * CYCLES * PERIOD_S + limits.position_tolerance
        assert (found.axis, found.bound) == (1, about(bound))
    elif isinstance(found, VelocityJumped):
        assert (found.axis, found.velocity, found.before) == (1, 0.0, about(SPEED, rel=0.05))
    else:
        assert found == DriveModeTimeout(1, 0, DriveMode(mode))


@MODES
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("value", "stuck"), [(POSITION, True), (VELOCITY, True), (VELOCITY, False)])
def test_a_value_that_is_stuck_or_has_a_wrong_factor_is_a_fault_although_each_sample_is_possible(
    rig: LoopRig, mode: int, direction: int, value: int, stuck: bool
) -> None:
    rig.hold(mode)
    shown: list[int] = []

    def change(counts: int) -> int:
        shown.append(counts)
        return shown[0] if stuck else -counts

    falsify(rig, value, change, axis=1)
    rig.move(direction * 1.8, direction * 1.8)
    rig.run(0.6)
    found = rig.last_of(VelocityDisagrees)
    allowed = (CONFIG.supervision.velocity_gap * CONFIG.joints[1].velocity + 1.0 / COUNTS) * 0.1
    assert (found.axis, found.allowed) == (1, about(allowed))
    assert found.gap == about(found.allowed, rel=0.1)
    assert rig.state is State.FAULT


def event_of(
    period_s: float, speed: float, shown: Callable[[float], float], *, count: float, velocity_count: float = 0.0
) -> FaultEvent | None:
    """Turn a joint for 2 s, whose drive shows its velocity as `shown` and its position in counts; return its fault."""
    config = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=period_s * 1e6))
    (_, drive), *_ = make_drives(config)
    drive.resolution, drive.velocity_resolution = count, velocity_count
    drive.mode, drive.state = CSP, DriveState.OPERATION_ENABLED
    measurements = Measurements(config, 0)
    position = velocity = 0.0
    for k in range(round(2.0 / period_s)):
        drive.mode_display = CSP
        drive.position, drive.velocity = round(speed * k * period_s / count) * count, shown(speed)
        measurements.begin(1 + round(k * period_s * 1e9))
        measurements.check(0, drive, position, velocity, 0.0)
        if measurements.event is not None:
            return measurements.event
        position, velocity = drive.position, drive.velocity
    return None


def test_the_noise_of_a_measured_velocity_is_no_fault() -> None:
    random = Random(1)
    assert event_of(0.0005, 0.3, lambda speed: random.gauss(speed, 0.03), count=6e-6) is None


@pytest.mark.parametrize("period_s", [0.0005, 0.02, 0.05, 0.1])
def test_a_velocity_that_is_stuck_is_found_in_every_cycle_time(period_s: float) -> None:
    assert isinstance(event_of(period_s, 0.3, lambda speed: 0.0, count=1e-4), VelocityDisagrees)


def test_a_velocity_in_coarse_counts_is_no_fault() -> None:
    rpm = pi / 30
    assert event_of(0.0005, 0.3, lambda speed: speed // rpm * rpm, count=1e-4, velocity_count=rpm) is None
    assert event_of(0.0005, 0.3, lambda speed: speed // (3 * rpm) * 3 * rpm, count=1e-4) is not None


def test_a_velocity_that_is_computed_from_positions_forgets_a_false_position(rig: LoopRig) -> None:
    rig.set_in_motion()
    drive = rig.arm.drives[0]
    drive._in = (*drive._in[:2], -1, *drive._in[3:])  # type: ignore[attr-defined]
    rig.run(0.1)
    end = falsify(rig, *FALSE["a hundredth of a radian off"])
    rig.run(2 * PERIOD_S)
    end()
    for _ in range(40):
        rig.cycle()
        assert rig.arm.state.actual_velocity[0] == about(SPEED, rel=0.05)


def test_a_torque_that_no_drive_gives_is_never_used(rig: LoopRig) -> None:
    rig.hold(CST)
    before = rig.arm.state.actual_torque[0]
    falsify(rig, TORQUE, lambda counts: abs(counts) - (1 << 31))
    rig.run(3 * CYCLES * PERIOD_S)
    assert rig.arm.state.actual_torque[0] == about(before, abs=0.5)
    assert rig.state is State.HOLDING


def test_a_false_torque_is_not_taken_for_the_weight(rig: LoopRig) -> None:
    rig.hold(CST)
    before = rig.arm.state.actual_torque[0]
    falsify(rig, *FALSE["a torque of 40 Nm"])
    rig.run((CYCLES - 1) * PERIOD_S)
    assert rig.arm.state.actual_torque[0] == about(before, abs=0.5)
