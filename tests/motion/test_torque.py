"""Joint torques on top of gravity, and their bounds, on simulated joints."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.model import LinkMass
from rtcp.config.model import ArmConfig
from rtcp.ipc.commands import ApplyTorque
from rtcp.ipc.events import CommandExpired
from rtcp.ipc.refusals import FractionOutOfRange, TorqueOutOfRange
from rtcp.motion.controllers import ControllerSetup
from rtcp.motion.controllers.torque import TorqueController
from rtcp.motion.drive_writers import CstWriter
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase
from tests.samples import examples, some

from .conftest import no_plan

PERIOD = 0.0005
MASS, ARM_M, G = 3.0, 0.4, 9.80665
INERTIA = (1.2, 1.5, 0.8, 0.4, 0.2, 0.08)
"""Inertia of each joint with its load and its rotor, kg m^2."""
FREE = [0.0] * 6


@dataclass
class Joint:
    """The fields of a drive that the control law reads and writes."""

    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0
    mode_display: int = 0
    target_position: float = 0.0
    target_velocity: float = 0.0
    target_torque: float = 0.0


class Plant:
    """Six joints without friction; one link hangs on joint 2: its weight's potential is m g r cos(q2)."""

    def __init__(self, arm: ArmConfig, q: Sequence[float] = FREE, payload: float = 0.0) -> None:
        no_mass, link = LinkMass(0.0, (0.0, 0.0, 0.0)), LinkMass(MASS, (ARM_M, 0.0, 0.0))
        model = replace(arm.arm, links=(no_mass, link, no_mass, no_mass, no_mass, no_mass))
        self.weight = (MASS + payload) * G * ARM_M
        self.joints = [Joint(position=angle, torque=t) for angle, t in zip(q, self.holding(q), strict=True)]
        self.limits = Limits(arm)
        self.state = ArmState(6)
        self.state.commanded, self.state.actual = list(q), list(q)
        self.state.actual_torque = self.holding(q)
        self.guard = TrajectoryGuard(replace(arm, arm=None), self.limits, PERIOD)
        self.guard.latch(self.state)
        self.law = CstWriter(arm.joints, PERIOD, self.limits.torque)
        self.law.start(self.joints, [joint.torque for joint in self.joints])
        setup = ControllerSetup(replace(arm, arm=model), self.limits, self.guard, PERIOD, no_plan)
        self.mode = TorqueController(setup)
        self.outside = [0.0] * 6
        """External torques, Nm."""
        self.seen: list[tuple[list[float], list[float], list[float]]] = []
        """Position, speed and torque of all joints after each cycle."""

    def holding(self, q: Sequence[float]) -> list[float]:
        return [0.0, -self.weight * math.sin(q[1]), 0.0, 0.0, 0.0, 0.0]

    def cycle(self) -> None:
        state, joints = self.state, self.joints
        target = self.mode.update(state)
        self.guard.apply(state, target, self.mode.tolerates_saturation)
        if target.direct:
            assert all(-most <= torque <= most for torque, most in zip(target.torque, self.limits.torque, strict=True))
            self.law.pass_on(state.commanded, target.torque, target.weight, joints)
        else:
            self.law.update(state.commanded, state.commanded_velocity, joints)
        load = self.holding([joint.position for joint in joints])
        for i, joint in enumerate(joints):
            joint.torque = joint.target_torque
            joint.velocity += (joint.torque + self.outside[i] - load[i]) / INERTIA[i] * PERIOD
            joint.position += joint.velocity * PERIOD
        state.actual = [joint.position for joint in joints]
        state.actual_velocity = [joint.velocity for joint in joints]
        state.actual_torque = [joint.torque for joint in joints]
        state.now_ns += round(PERIOD * 1e9)
        self.seen.append((list(state.actual), list(state.actual_velocity), list(state.actual_torque)))

    def run(self, seconds: float, torques: Sequence[float] | None = None, **given: float) -> None:
        """Run, with a command renewed every 50 ms."""
        for k in range(round(seconds / PERIOD)):
            if torques is not None and k % 100 == 0:
                self.push(torques, **given)
            self.cycle()

    def push(self, torques: Sequence[float], stiffness: float = 0.0, damping: float = 0.0) -> None:
        command = ApplyTorque(tuple(torques), stiffness, damping, 0.2)
        assert self.mode.accept(command, self.state, self.mode.phase is Phase.MOVE) is None

    def check(self) -> None:
        """Torque within its limit, speed within 5 %, position inside the range; in every cycle."""
        limits = self.limits
        for positions, speeds, torques in self.seen:
            for i in range(6):
                assert abs(torques[i]) <= limits.torque[i] * (1 + 1e-9), i
                assert abs(speeds[i]) <= 1.05 * limits.velocity[i], (i, speeds[i])
                assert limits.low[i] <= positions[i] <= limits.high[i], (i, positions[i])

    def accelerations(self, axis: int, over_s: float = 0.1) -> list[float]:
        """Mean acceleration of a joint over spans of `over_s`, rad/s^2."""
        n = round(over_s / PERIOD)
        speeds = [speed[axis] for _, speed, _ in self.seen]
        return [(b - a) / over_s for a, b in zip(speeds, speeds[n:], strict=False)]

    def largest_step(self, since: int = 1) -> float:
        """Largest change of a joint's torque in a cycle, Nm."""
        torques = [torque for _, _, torque in self.seen]
        return max(
            abs(b - a)
            for before, after in zip(torques[since - 1 :], torques[since:], strict=False)
            for a, b in zip(before, after, strict=True)
        )


@pytest.fixture
def plant(arm: ArmConfig) -> Plant:
    return Plant(arm, [0.0, 0.5, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="session")
def new_plant(arm: ArmConfig) -> Callable[..., Plant]:
    return lambda *given, **more: Plant(arm, *given, **more)


@pytest.mark.parametrize("angle", [-1.5, 0.5, 1.2])
def test_without_a_torque_asked_for_the_arm_floats_where_it_is(new_plant: Callable[..., Plant], angle: float) -> None:
    plant = new_plant([0.0, angle, 0.0, 0.0, 0.0, 0.0])
    plant.run(1.0, FREE)
    assert plant.state.actual == pytest.approx([0.0, angle, 0.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert plant.state.actual_torque[1] == pytest.approx(-MASS * G * ARM_M * math.sin(angle))


def test_gravity_is_carried_wherever_the_arm_is_pushed_to(plant: Plant) -> None:
    plant.run(0.5, [0.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    plant.run(1.0, [0.0, -2.0, 0.0, 0.0, 0.0, 0.0])
    for (before, _, _), (_, _, torques) in zip(plant.seen, plant.seen[1:], strict=False):
        gravity = -MASS * G * ARM_M * math.sin(before[1])
        assert abs(torques[1] - gravity) <= 2.0 + 60.0 * 0.3 * 0.5 + 1e-6
    moved = [positions[1] for positions, _, _ in plant.seen]
    assert max(moved) > 0.6
    plant.check()


def test_a_weight_that_the_model_does_not_know_is_held_at_the_start(new_plant: Callable[..., Plant]) -> None:
    plant = new_plant([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], payload=1.0)
    plant.run(0.5, FREE)
    assert plant.state.actual[1] == pytest.approx(1.0, abs=1e-6)


def test_a_torque_accelerates_as_the_inertia_says(plant: Plant) -> None:
    plant.run(0.2, [1.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    # 1 rad/s^2, but for the ramp of the torque: 1.2 of 49 Nm in 2.4 ms.
    assert plant.state.actual_velocity[0] == pytest.approx(0.2, abs=0.003)


def test_a_reversal_of_the_whole_torque_keeps_to_the_acceleration_and_the_set_point_follows(plant: Plant) -> None:
    worst = 0.0
    for sign in (1.0, -1.0, 1.0):
        for _ in range(10):
            plant.run(0.1, [sign * torque for torque in plant.limits.torque])
            apart = zip(plant.state.commanded, plant.state.actual, strict=True)
            worst = max(worst, *(abs(a - b) for a, b in apart))
    # An emergency stop comes at 0.15 rad (supervision.following_error).
    assert worst < 0.05
    for axis in range(6):
        # The set-point has 2 rad/s^2, and the arm is at most 0.2 rad/s beside it.
        assert max(map(abs, plant.accelerations(axis))) < 2.0 + 2 * 0.2 / 0.1
        assert max(map(abs, plant.accelerations(axis, 0.4))) < 2.0 + 0.5
    plant.check()


def test_the_torque_asked_for_rises_no_faster_than_to_its_limit_in_a_tenth_of_a_second(plant: Plant) -> None:
    plant.push(FREE)
    plant.cycle()
    plant.run(0.02, plant.limits.torque)
    assert plant.largest_step() <= 49.0 * PERIOD / 0.1 * 1.2


@pytest.mark.parametrize("sign", some([1.0, -1.0], 2))
def test_any_torque_leaves_the_speed_and_the_range_as_they_are(plant: Plant, sign: float) -> None:
    # To the edge of the range, and on against it.
    plant.run(9.0, [sign * torque for torque in plant.limits.torque])
    plant.check()
    edges = plant.limits.high if sign > 0 else plant.limits.low
    assert plant.state.actual == pytest.approx(edges, abs=0.03)
    assert max(map(abs, plant.state.actual_velocity)) < 1e-3
    assert max(abs(speeds[0]) for _, speeds, _ in plant.seen) > 0.45
    # From the edge a torque leads back.
    plant.run(1.0, [-sign * torque for torque in plant.limits.torque])
    assert all(abs(q - edge) > 0.1 for q, edge in zip(plant.state.actual, edges, strict=True))
    plant.check()


@settings(max_examples=examples(12))
@given(st.integers(0, 10**6))
def test_no_torques_whatever_break_a_bound(new_plant: Callable[..., Plant], seed: int) -> None:
    chance = random.Random(seed)
    limits = new_plant().limits
    ends = list(zip(limits.low, limits.high, strict=True))
    plant = new_plant([chance.uniform(low + 0.03, high - 0.03) for low, high in ends])
    for _ in range(6):
        asked = [chance.choice((-1.0, 1.0, chance.uniform(-1.0, 1.0))) * torque for torque in limits.torque]
        plant.run(chance.uniform(0.02, 0.8), asked, stiffness=chance.choice((0.0, 1.0)), damping=chance.random())
    plant.check()


def test_it_ends_by_itself_when_it_is_not_said_again(plant: Plant) -> None:
    plant.run(0.3, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    plant.run(0.1)
    assert plant.mode.phase is Phase.MOVE
    plant.run(1.5)
    assert (plant.mode.phase, plant.mode.ended) == (Phase.HOLD, CommandExpired())
    assert max(map(abs, plant.state.actual_velocity)) < 2e-3
    plant.check()


def test_the_law_of_cst_takes_over_and_gives_back_without_a_step(plant: Plant) -> None:
    plant.run(0.1)
    handed = len(plant.seen)
    plant.run(0.3, [2.0, -1.0, 0.5, 0.0, 0.0, 0.0])
    plant.mode.stop(plant.state)
    plant.run(1.5)
    plant.run(0.2, FREE)
    # The requested torque changes by at most 0.25 Nm a cycle; the law adds the deceleration of its setpoint.
    assert plant.largest_step(handed) < 0.4
    plant.check()


def test_a_law_whose_set_point_is_elsewhere_takes_over_without_a_step(plant: Plant) -> None:
    """For example after a blow, which the setpoint follows only slowly."""
    joint = plant.joints
    there = [drive.position + 0.05 for drive in joint]
    for _ in range(100):
        plant.law.pass_on(there, [3.0] * 6, [3.0] * 6, joint)
    plant.law.update(there, [0.2] * 6, joint)
    for i in range(6):
        assert joint[i].target_torque == pytest.approx(3.0, abs=0.05)


def test_stiffness_holds_the_arm_about_where_it_was_asked_for(plant: Plant) -> None:
    plant.run(2.0, [6.0, 0.0, 0.0, 0.0, 0.0, 0.0], stiffness=0.5, damping=1.0)
    # 6 Nm on half of 600 Nm/rad.
    assert plant.state.actual[0] == pytest.approx(0.02, rel=0.02)
    plant.check()


def test_stiffness_asked_for_at_once_is_about_where_the_arm_begins(new_plant: Callable[..., Plant]) -> None:
    bent = [0.4, 0.5, 1.2, -0.3, 0.8, 0.1]
    plant = new_plant(bent)
    for _ in range(2):  # a second motion does not begin at the end of the first
        plant.mode.hold()
        plant.run(0.5, FREE, stiffness=1.0, damping=1.0)
        assert plant.state.actual == pytest.approx(bent, abs=1e-3)


def test_damping_slows_a_motion_down(plant: Plant) -> None:
    plant.run(2.0, [6.0, 0.0, 0.0, 0.0, 0.0, 0.0], damping=1.0)
    assert plant.state.actual_velocity[0] == pytest.approx(6.0 / 60.0, rel=0.05)


def test_a_hand_that_leans_on_the_arm_does_not_push_it_out_of_its_range(new_plant: Callable[..., Plant]) -> None:
    plant = new_plant([3.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    plant.outside[0] = 6.0
    plant.run(4.0, FREE)
    # 6 Nm on 600 Nm/rad, from where the margin of 0.02 rad begins.
    assert plant.state.actual[0] == pytest.approx(3.1 - 0.02 + 0.01, abs=1e-3)
    plant.check()


def test_beside_the_edge_it_begins_without_a_push(new_plant: Callable[..., Plant]) -> None:
    plant = new_plant([3.09, 0.5, -2.395, 0.0, 0.0, 0.0])
    before = list(plant.state.actual_torque)
    plant.push(FREE)
    plant.cycle()
    assert plant.state.actual_torque == pytest.approx(before, abs=0.01)
    plant.run(1.0, plant.limits.torque)
    plant.check()


def test_torques_and_fractions_out_of_range_are_refused(plant: Plant) -> None:
    most = plant.limits.torque
    beyond = ApplyTorque((0.0, most[1] + 0.5, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.2)
    assert plant.mode.accept(beyond, plant.state, False) == TorqueOutOfRange(1, most[1] + 0.5, most[1])
    for stiffness, damping in ((1.5, 0.0), (0.0, 1.5)):
        command = ApplyTorque((0.0,) * 6, stiffness, damping, 0.2)
        assert plant.mode.accept(command, plant.state, False) == FractionOutOfRange(1.5)
    assert plant.mode.phase is Phase.HOLD
