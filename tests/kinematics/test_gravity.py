"""Torques that hold the arm still."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.gravity import gravity_torques
from kinematics.model import ArmModel, LinkMass
from kinematics.pose import Pose, Vector

G = 9.80665
# The masses of the actuators, each on the link before its joint; the tubes are massless.
LINKS = (
    LinkMass(0.720, (0.0, 0.0, 0.0)),
    LinkMass(0.720, (0.440, 0.0, 0.0)),
    LinkMass(0.650, (0.0, 0.450, 0.0)),
    LinkMass(0.500, (0.0, 0.0, 0.0)),
    LinkMass(0.335, (0.0, -0.060, 0.0)),
    LinkMass(0.100, (0.0, 0.0, -0.040)),
)
ALONG_X = [0.0, math.pi / 2, 0.0, 0.0, 0.0, 0.0]


@pytest.fixture
def loaded(assistive: ArmModel) -> ArmModel:
    return replace(assistive, links=LINKS)


def potential_energy(model: ArmModel, q: Sequence[float], gravity: Vector, payload: LinkMass | None = None) -> float:
    poses = frames(model, q)
    bodies = list(zip(poses[:6], model.links, strict=True))
    if payload is not None:
        bodies.append((poses[6], payload))
    return -sum(
        body.mass * float(np.dot(gravity, np.add(pose.position, np.reshape(pose.rotation, (3, 3)) @ body.centre)))
        for pose, body in bodies
    )


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -G), (3.0, -7.0, 2.0)])
@pytest.mark.parametrize("payload", [None, LinkMass(0.5, (0.02, 0.03, 0.08))])
def test_the_torques_are_the_gradient_of_the_potential_energy(
    gravity: Vector, payload: LinkMass | None, loaded: ArmModel
) -> None:
    model = replace(loaded, tool=Pose.from_xyzrpy(0.01, 0.02, 0.1, 0.5, -0.3, 1.0))
    numbers = random.Random(2)
    step = 1e-5
    for _ in range(20):
        q = [numbers.uniform(-3.0, 3.0) for _ in range(6)]
        slopes = []
        for joint in range(6):
            before, after = list(q), list(q)
            before[joint] -= step
            after[joint] += step
            rise = potential_energy(model, after, gravity, payload) - potential_energy(model, before, gravity, payload)
            slopes.append(rise / (2 * step))
        assert gravity_torques(model, q, gravity, payload) == pytest.approx(slopes, abs=1e-7)


def test_joint_2_of_the_stretched_arm_carries_every_mass_times_its_distance(loaded: ArmModel) -> None:
    expected = G * (0.720 * 0.440 + 0.650 * 0.890 + 0.500 * 0.990 + 0.335 * 1.050 + 0.100 * 1.090)
    assert forward(loaded, ALONG_X).position == pytest.approx((1.130, 0.0, 0.170))
    torques = gravity_torques(loaded, ALONG_X)
    # Positive angles of joint 2 lower the arm: the torque is negative.
    assert torques[1] == pytest.approx(-expected)
    assert torques[0] == pytest.approx(0.0, abs=1e-12)


def test_an_arm_without_masses_is_refused_by_name(assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match=f"arm '{assistive.name}' has no link masses"):
        gravity_torques(assistive, [0.0] * 6)


def test_a_value_that_is_not_finite_is_refused_by_name(loaded: ArmModel) -> None:
    with pytest.raises(ValueError, match="gravity y"):
        gravity_torques(loaded, [0.0] * 6, gravity=(0.0, math.nan, -G))
    with pytest.raises(ValueError, match="joint6"):
        gravity_torques(loaded, [0.0] * 5 + [math.inf])
