"""Forward kinematics, Jacobian and gravity against Pinocchio, which reads the exported URDF."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

from kinematics.forward import forward_batch
from kinematics.gravity import gravity_torques
from kinematics.jacobian import jacobian
from kinematics.model import ArmModel, DhRow, LinkMass
from kinematics.pose import Pose
from kinematics.urdf import to_urdf

pin = pytest.importorskip("pinocchio")

COUNT = 2000
LINKS = (
    LinkMass(1.9, (0.0, 0.02, -0.05)),
    LinkMass(2.4, (0.21, 0.01, 0.04)),
    LinkMass(1.7, (0.03, 0.18, -0.02)),
    LinkMass(0.9, (0.01, 0.0, -0.11)),
    LinkMass(0.6, (-0.01, 0.03, 0.02)),
    LinkMass(0.4, (0.0, 0.01, -0.03)),
)


def general(model: ArmModel) -> ArmModel:
    """Neither parallel axes nor a spherical wrist, and a turned tool."""
    numbers = random.Random(9)
    rows = tuple(DhRow(*(numbers.uniform(-1.5, 1.5) for _ in range(4))) for _ in range(6))
    return replace(model, rows=rows, tool=Pose.from_xyzrpy(0.03, -0.02, 0.11, 0.4, -1.2, 2.1))


@pytest.fixture(params=["assistive", "irb120", "general"])
def model(request) -> ArmModel:
    base = general(request.getfixturevalue("irb120")) if request.param == "general" else None
    return replace(base or request.getfixturevalue(request.param), links=LINKS)


@pytest.fixture
def oracle(model):
    """Pinocchio's model of the document, its data, and the number of its frame tool0."""
    built = pin.buildModelFromXML(to_urdf(model))
    return built, built.createData(), built.getFrameId("tool0")


def configurations() -> np.ndarray:
    return np.random.default_rng(10).uniform(-np.pi, np.pi, (COUNT, 6))


def test_the_tool_is_where_pinocchio_puts_it(model, oracle):
    built, data, tool = oracle
    q = configurations()
    positions, rotations = forward_batch(model, q)
    for row, position, rotation in zip(q, positions, rotations, strict=True):
        pin.framesForwardKinematics(built, data, row)
        assert np.abs(data.oMf[tool].translation - position).max() < 1e-9
        assert np.abs(data.oMf[tool].rotation - rotation).max() < 1e-9


def test_the_jacobian_is_pinocchios(model, oracle):
    built, data, tool = oracle
    for row in configurations():
        expected = pin.computeFrameJacobian(built, data, row, tool, pin.LOCAL_WORLD_ALIGNED)
        assert np.abs(expected - jacobian(model, row.tolist())).max() < 1e-9


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.80665), (4.0, -2.0, 8.0)])
def test_the_gravity_torques_are_pinocchios(gravity, model, oracle):
    built, data, _ = oracle
    built.gravity.linear = np.array(gravity)
    for row in configurations():
        expected = pin.computeGeneralizedGravity(built, data, row)
        assert np.abs(expected - gravity_torques(model, row.tolist(), gravity)).max() < 1e-9


def test_the_torques_of_a_payload_are_pinocchios(model, oracle):
    built, data, tool = oracle
    payload = LinkMass(1.5, (0.02, -0.04, 0.07))
    frame = built.frames[tool]
    built.appendBodyToJoint(
        frame.parentJoint, pin.Inertia(payload.mass, np.array(payload.centre), np.eye(3) * 1e-3), frame.placement
    )
    built.gravity.linear = np.array([0.0, 0.0, -9.80665])
    data = built.createData()
    for row in configurations():
        expected = pin.computeGeneralizedGravity(built, data, row)
        assert np.abs(expected - gravity_torques(model, row.tolist(), payload=payload)).max() < 1e-9


def test_the_limits_that_pinocchio_reads_are_the_models(model):
    built = pin.buildModelFromXML(to_urdf(model, effort=[6.0, 5.0, 4.0, 3.0, 2.0, 1.0]))
    assert list(built.names[1:]) == list(model.joint_names)
    assert built.lowerPositionLimit.tolist() == [limit.lower for limit in model.limits]
    assert built.upperPositionLimit.tolist() == [limit.upper for limit in model.limits]
    assert built.velocityLimit.tolist() == [limit.velocity for limit in model.limits]
    assert built.effortLimit.tolist() == [6.0, 5.0, 4.0, 3.0, 2.0, 1.0]
