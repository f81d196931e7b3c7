"""Hand guiding on the in-process bus: the real loop and device models, and a hand that pushes the tool."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import pytest

from kinematics.forward import forward, frames
from kinematics.jacobian import jacobian
from rtcp.config.model import ArmConfig, InputConfig
from rtcp.ipc import refusals
from rtcp.ipc.commands import Guide, Halt, SetControlMode
from rtcp.ipc.events import Event, GuidedTooFast, LeaseExpired, PermissionWithdrawn
from rtcp.ipc.states import ControlMode, State
from rtcp.motion.controllers import ControllerSetup
from rtcp.motion.controllers.guide import GuideController
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState
from rtcp.testing.simulation import Frame, Simulation
from tests.samples import examples, some

from .conftest import ARM, MODEL, no_plan

BENT = (0.0, -0.5, 1.8, 0.0, 1.2, 0.0)
POSTURES = (BENT, (0.4, -0.2, 0.9, 0.3, 0.5, 0.2), (-1.2, -1.2, 0.4, 1.0, -0.8, 2.0), (-0.6, 0.3, 1.8, 0.0, 1.0, -1.0))
SWITCH = 11
ZONES = Zones(MODEL, Limits(ARM), ARM.cartesian.clearance)


class Guided(Simulation):
    """An arm on the bus in control mode torque, tracked in every cycle."""

    def __init__(self, q: Sequence[float], config: ArmConfig = ARM) -> None:
        # A cycle of 1 ms: half the work of the shipped one.
        config = replace(config, cycle=replace(config.cycle, period_us=1000))
        super().__init__(config, follow_clock=False, positions=q)
        self.largest_step = 0.0
        self.fastest_tool = self.fastest_joint = 0.0
        self.clear = self.range = 1e9
        if config.inputs.enabling_switch is not None:
            self.press(True)
        self.hold()
        self.do(SetControlMode(ControlMode.TORQUE))
        self.run(0.3)
        self.cycles, self.commanded = 0, list(self.loop.arm.state.commanded)
        self.on_frame = self.track

    def press(self, pressed: bool) -> None:
        """Press the enabling switch, or release it."""
        assert self.box is not None
        self.box.set_input(SWITCH - 1, pressed)
        self.run(0.02)

    @property
    def q(self) -> list[float]:
        """Positions of the simulated joints, rad."""
        return [model.mechanics.position for model in self.models]

    @property
    def speeds(self) -> list[float]:
        return [model.mechanics.velocity for model in self.models]

    @property
    def tool(self) -> tuple[float, float, float]:
        return forward(MODEL, self.q).position

    def begin(self, duration_s: float = 0.0) -> refusals.Refusal | None:
        return self.send(Guide(duration_s)).refusal

    def push(self, *wrench: float) -> Callable[[int], None]:
        arm = self.bus.segment.arm
        assert arm is not None
        return arm.push((*wrench, *[0.0] * (6 - len(wrench))))

    def track(self, frame: Frame) -> None:
        """Track a cycle."""
        commanded = list(self.loop.arm.state.commanded)
        steps = (abs(after - before) for after, before in zip(commanded, self.commanded, strict=True))
        self.largest_step = max(self.largest_step, *steps)
        self.commanded = commanded
        self.cycles += 1
        if self.cycles % 10 == 0:
            self.measure()

    def measure(self) -> None:
        q, speeds = self.q, self.speeds
        twist = [sum(a * b for a, b in zip(row, speeds, strict=True)) for row in jacobian(MODEL, q)[:3]]
        self.fastest_tool = max(self.fastest_tool, math.hypot(*twist))
        self.fastest_joint = max(self.fastest_joint, *map(abs, speeds))
        self.clear = min(self.clear, ZONES.distance(frames(MODEL, q))[0])
        ends = (
            min(angle - joint.position.min, joint.position.max - angle)
            for angle, joint in zip(q, ARM.joints, strict=True)
        )
        self.range = min(self.range, *ends)

    @property
    def happened(self) -> list[Event]:
        return [record.event for record in self.events]

    def check(self) -> None:
        """Inside the range and clear of all boxes; the setpoint has made no step larger than a joint's speed."""
        assert self.clear > 0.0
        assert self.range > 0.0
        assert self.largest_step <= max(joint.velocity for joint in ARM.joints) * self.period_ns * 1.001e-9


@pytest.fixture
def guided() -> Iterator[Callable[..., Guided]]:
    with ExitStack() as made:
        yield lambda *given: made.enter_context(Guided(*given))


@pytest.mark.parametrize("q", some(POSTURES))
def test_without_a_push_the_arm_stays_where_it_is(guided: Callable[..., Guided], q: tuple[float, ...]) -> None:
    arm = guided(q)
    before = arm.tool
    assert arm.begin() is None
    arm.run(2.0)
    assert arm.state is State.MOVING
    assert math.dist(arm.tool, before) < 2e-3


@pytest.mark.parametrize("force", some([(0.0, 20.0, 0.0), (0.0, -20.0, 0.0), (0.0, 0.0, 20.0), (0.0, 0.0, -20.0)]))
def test_the_tool_follows_the_force_and_rests_where_it_is_let_go(
    guided: Callable[..., Guided], force: tuple[float, float, float]
) -> None:
    arm = guided(BENT)
    assert arm.begin() is None
    before, end = arm.tool, arm.push(*force)
    arm.run(0.8)
    end(0)
    arm.run(0.5)
    there = arm.tool
    moved = [b - a for a, b in zip(before, there, strict=True)]
    along = sum(a * b for a, b in zip(moved, force, strict=True)) / 20.0
    assert along > 0.08
    assert along > 0.9 * math.hypot(*moved)
    arm.run(0.5)
    assert math.dist(arm.tool, there) < 2e-3
    assert arm.fastest_tool < ARM.guiding.speed
    arm.check()


def test_a_weight_that_is_200_grams_wrong_does_not_make_the_arm_drift(guided: Callable[..., Guided]) -> None:
    arm = guided((0.0, -1.2, 0.4, 0.0, 0.0, 0.0))
    arm.push(0.0, 0.0, -0.2 * 9.81)
    arm.run(1.0)
    assert arm.begin() is None
    arm.run(1.0)
    before = arm.tool
    arm.run(1.0)
    assert math.dist(arm.tool, before) < 1e-3


@pytest.mark.parametrize("q_and_force", [
    ((2.0, -0.3, 1.4, 0.0, 1.2, 0.0), (20.0, 0.0, 0.0)),
    ((2.0, -0.3, 1.4, 0.0, 1.2, 0.0), (13.0, -13.0, -7.0)),
    ((0.0, -1.0, 1.4, 0.0, 1.2, 0.0), (0.0, 0.0, -20.0)),
])  # fmt: skip
def test_a_hand_that_leans_on_the_arm_stops_it_before_a_box_without_ending_the_guiding(
    guided: Callable[..., Guided], q_and_force: Any
) -> None:
    q, force = q_and_force
    arm = guided(q)
    assert arm.begin() is None
    arm.push(*force)
    arm.run(4.0)
    assert arm.state is State.MOVING
    assert max(map(abs, arm.speeds)) < 0.02
    assert ZONES.distance(frames(MODEL, arm.q))[0] < 0.02
    arm.check()


def test_a_hand_that_leans_on_a_joint_stops_it_before_the_end_of_its_range(guided: Callable[..., Guided]) -> None:
    arm = guided((2.8, 0.5, -1.8, 0.0, -1.2, 0.0))
    assert arm.begin() is None
    arm.push(*[0.0] * 5, 12.0)
    arm.run(2.0)
    assert arm.state is State.MOVING
    assert 0.02 < 3.1 - arm.q[0] < 0.06
    arm.check()


@pytest.mark.parametrize("seed", range(examples(2)))
def test_no_pushes_whatever_carry_the_arm_out_of_its_bounds(guided: Callable[..., Guided], seed: int) -> None:
    chance = random.Random(seed)
    while True:
        q = [chance.uniform(joint.position.min + 0.1, joint.position.max - 0.1) for joint in ARM.joints]
        if ZONES.distance(frames(MODEL, q))[0] > 0.03:
            break
    arm = guided(q)
    assert arm.begin() is None
    for _ in range(6):
        direction = [chance.gauss(0.0, 1.0) for _ in range(3)]
        size = chance.uniform(0.0, 20.0) / math.hypot(*direction)
        end = arm.push(*(size * part for part in direction), *(chance.uniform(-1.0, 1.0) for _ in range(3)))
        arm.run(chance.uniform(0.2, 1.2))
        end(0)
        if arm.state is not State.MOVING:
            arm.run(1.0)
            assert isinstance(arm.happened[-2], GuidedTooFast)
            assert arm.begin() is None
    arm.check()
    assert arm.fastest_joint < ARM.guiding.joint_speed
    assert arm.fastest_tool < 1.4 * ARM.guiding.speed


def test_a_hand_that_moves_the_tool_too_fast_ends_it(guided: Callable[..., Guided]) -> None:
    arm = guided(BENT, replace(ARM, guiding=replace(ARM.guiding, speed=0.05)))
    assert arm.begin() is None
    end = arm.push(0.0, 40.0, 0.0)
    arm.run(0.3)
    end(0)
    arm.run(1.0)
    assert arm.state is State.HOLDING
    (event,) = (event for event in arm.happened if isinstance(event, GuidedTooFast))
    assert event.speed > 1.5 * event.limit == pytest.approx(1.5 * 0.05)
    arm.check()


def with_switch() -> Any:
    return replace(ARM, inputs=replace(ARM.inputs, enabling_switch=InputConfig(SWITCH)))


ENDS: dict[str, tuple[Callable[[Guided], object], type[Event] | None]] = {
    "halt": (lambda arm: arm.send(Halt()), None),
    "enabling switch": (lambda arm: arm.press(False), PermissionWithdrawn),
    "silence": (lambda arm: arm.fall_silent(), LeaseExpired),
    "time": (lambda arm: None, None),
}


@pytest.mark.parametrize("end", ENDS)
def test_at_every_end_it_stops_and_holds_and_the_setpoint_makes_no_step(
    guided: Callable[..., Guided], end: str
) -> None:
    act, event = ENDS[end]
    arm = guided(BENT, with_switch())
    assert arm.begin(1.0 if end == "time" else 0.0) is None
    arm.push(0.0, 20.0, 0.0)
    arm.run(0.6)
    assert arm.fastest_tool > 0.1
    act(arm)
    arm.run(1.2)
    assert arm.state is State.HOLDING
    # The hand pushes on: the position loop holds against it.
    before = arm.tool
    arm.run(0.5)
    assert math.dist(arm.tool, before) < 1e-2
    assert (event is None) or any(isinstance(each, event) for each in arm.happened)
    arm.check()


def test_it_is_refused_while_the_enabling_switch_is_released_in_another_mode_and_with_a_load(
    guided: Callable[..., Guided],
) -> None:
    arm = guided(BENT, with_switch())
    arm.press(False)
    assert isinstance(arm.begin(), refusals.NotPermitted)
    arm.press(True)
    assert arm.begin(1e6) == refusals.DurationOutOfRange(1e6, 3600.0)
    end = arm.push(0.0, 0.0, -15.0)
    arm.run(0.3)
    assert isinstance(arm.begin(), refusals.WeightDiffers)
    end(0)
    arm.run(0.3)
    arm.do(SetControlMode(ControlMode.JOINT))
    arm.run(0.3)
    assert isinstance(arm.begin(), refusals.WrongControlMode)


def test_on_a_real_bus_it_is_refused_without_an_enabling_switch_unless_a_key_allows_it() -> None:
    real = replace(ARM, bus=replace(ARM.bus, interface="eth0"))
    assert refusal(real) == refusals.NoEnablingSwitch()
    assert refusal(replace(real, guiding=replace(ARM.guiding, enabling_switch=False))) is None
    assert refusal(replace(real, inputs=with_switch().inputs)) is None


def test_it_is_refused_where_the_masses_are_unknown() -> None:
    assert refusal(replace(ARM, arm=replace(MODEL, links=()))) == refusals.MassesUnknown()


def refusal(config: ArmConfig) -> refusals.Refusal | None:
    limits, state = Limits(config), ArmState(6)
    guard = TrajectoryGuard(config, limits, 0.0005)
    return GuideController(ControllerSetup(config, limits, guard, 0.0005, no_plan)).accept(Guide(0.0), state, False)
