"""In torque mode no body of the arm enters a box, whatever the torques and the hands that push it."""

from __future__ import annotations

import random
from dataclasses import replace
from types import SimpleNamespace

import pytest

from kinematics.forward import frames
from rtcp.config import default_config, load
from rtcp.ipc.commands import ApplyTorque
from rtcp.ipc.events import BoxReached, PushedNear
from rtcp.ipc.states import State
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Values
from rtcp.testing import Simulation
from tests.samples import examples

CONFIG = load(default_config())
CONFIG = replace(CONFIG, control_mode="torque", cycle=replace(CONFIG.cycle, period_us=2000))
MODEL = CONFIG.models[0]
LIMITS = Values.configured(CONFIG)
BODIES = Zones(MODEL, SimpleNamespace(box=LIMITS.box, keep_out=LIMITS.keep_out, cones=()), 0.0)
"""The bodies themselves, without a clearance."""
PUSHED = 3
"""Joints that torques and hands turn."""


def distance(q: list[float]) -> float:
    return BODIES.distance(frames(MODEL, q))[0]


def approach(q: list[float]) -> list[float]:
    """Return the direction, 1 or -1, in which each joint leads towards the nearest box."""
    here = distance(q)
    ahead = [distance([x + 1e-3 * (i == axis) for i, x in enumerate(q)]) for axis in range(PUSHED)]
    return [-1.0 if there > here else 1.0 for there in ahead]


def pose(rnd: random.Random, least: float = 0.05, most: float = 0.12) -> list[float]:
    """Return a pose near a box, `least` to `most` m away."""
    while True:
        q = [rnd.uniform(-1.5, 1.5), rnd.uniform(-1.2, 1.0), rnd.uniform(0.0, 2.2), 0.0, rnd.uniform(-1.0, 1.5), 0.0]
        if least < distance(q) < most:
            return q


@pytest.mark.parametrize("seed", range(examples(50)))
def test_full_torque_towards_a_box_stops_before_its_margin(seed: int) -> None:
    rnd = random.Random(seed)
    with Simulation(CONFIG, positions=pose(rnd), follow_clock=False) as arm:
        arm.hold()
        arm.run(1.0)
        joints = [model.mechanics for model in arm.models]
        least = 1.0
        for cycle in range(500):
            here = [joint.position for joint in joints]
            if cycle % 5 == 0:
                least = min(least, distance(here))
            if cycle % 50 == 0 and arm.state in (State.HOLDING, State.MOVING):
                sides = approach(here)
                torques = [side * joint.torque for side, joint in zip(sides, CONFIG.joints, strict=False)]
                arm.send(ApplyTorque((*torques, 0.0, 0.0, 0.0), 0.0, 0.0, 0.2))
            else:
                arm.cycle()
        # Less than the clearance of 0.01 m and the margin of 0.02 m only by what the position loop overshoots.
        assert least > 0.015
        assert BoxReached in [type(record.event) for record in arm.events] or least > 0.03


@pytest.mark.parametrize("seed", range(examples(20)))
def test_a_hand_that_pushes_the_arm_towards_a_box_is_stopped_by_the_drives(seed: int) -> None:
    rnd = random.Random(seed)
    with Simulation(CONFIG, positions=pose(rnd), follow_clock=False) as arm:
        arm.hold()
        arm.run(1.0)
        joints = [model.mechanics for model in arm.models]
        # The drives have 49 Nm for the weight and the hand.
        least, push = 1.0, rnd.uniform(15.0, 30.0)
        for cycle in range(400):
            here = [joint.position for joint in joints]
            if cycle % 5 == 0:
                least = min(least, distance(here))
                for side, joint in zip(approach(here), joints, strict=False):
                    joint.external_torque = side * push
            arm.cycle()
        assert least > 0.0
        assert arm.state is not State.FAULT or PushedNear in [type(record.event) for record in arm.events]


@pytest.mark.parametrize("seed", [1, 2])
def test_the_drives_stop_an_arm_that_is_struck_towards_a_box_before_it_is_too_fast(seed: int) -> None:
    with Simulation(CONFIG, positions=pose(random.Random(seed), 0.013, 0.03), follow_clock=False) as arm:
        arm.hold()
        arm.run(1.0)
        joints = [model.mechanics for model in arm.models][:PUSHED]
        # More than the drives can hold, for 60 ms.
        blow = [60.0 * side for side in approach([model.mechanics.position for model in arm.models])]
        for torque, joint in zip(blow, joints, strict=False):
            joint.external_torque += torque
        arm.run(0.06)
        for torque, joint in zip(blow, joints, strict=False):
            joint.external_torque -= torque
        arm.run(0.5)
        assert type(arm.events[-1].event) is PushedNear
        assert distance([model.mechanics.position for model in arm.models]) > 0.005
