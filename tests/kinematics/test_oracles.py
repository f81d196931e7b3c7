"""Comparison with other libraries: Pinocchio, which reads the exported URDF, EAIK, an analytic solver, and coal.

`make oracles` installs them; the tests skip what is missing.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from benchmarks.capsules import compare
from kinematics.forward import forward_batch, frames
from kinematics.gravity import gravity_torques
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import jacobian
from kinematics.model import ArmModel, LinkMass
from kinematics.pose import Vector
from kinematics.urdf import to_urdf
from tests.kinematics import arms
from tests.kinematics.arms import Change

COUNT = 2000
LINKS = (
    LinkMass(1.9, (0.0, 0.02, -0.05)),
    LinkMass(2.4, (0.21, 0.01, 0.04)),
    LinkMass(1.7, (0.03, 0.18, -0.02)),
    LinkMass(0.9, (0.01, 0.0, -0.11)),
    LinkMass(0.6, (-0.01, 0.03, 0.02)),
    LinkMass(0.4, (0.0, 0.01, -0.03)),
)
Oracle = tuple[Any, Any, int]
CONFIGURATIONS = np.random.default_rng(10).uniform(-np.pi, np.pi, (COUNT, 6))


@pytest.fixture
def pin() -> ModuleType:
    return pytest.importorskip("pinocchio")


@pytest.fixture(params=["as it is", "general"])
def model(request: pytest.FixtureRequest, either: ArmModel) -> ArmModel:
    return replace(arms.with_general_rows(either) if request.param == "general" else either, links=LINKS)


@pytest.fixture
def oracle(model: ArmModel, pin: ModuleType) -> Oracle:
    """Pinocchio's model of the document, its data, and the number of its frame tool0."""
    built = pin.buildModelFromXML(to_urdf(model))
    return built, built.createData(), built.getFrameId("tool0")


def test_the_tool_pose_matches_pinocchio(model: ArmModel, oracle: Oracle, pin: ModuleType) -> None:
    built, data, tool = oracle
    positions, rotations = forward_batch(model, CONFIGURATIONS)
    for row, position, rotation in zip(CONFIGURATIONS, positions, rotations, strict=True):
        pin.framesForwardKinematics(built, data, row)
        assert np.abs(data.oMf[tool].translation - position).max() < 1e-9
        assert np.abs(data.oMf[tool].rotation - rotation).max() < 1e-9


def test_the_jacobian_matches_pinocchio(model: ArmModel, oracle: Oracle, pin: ModuleType) -> None:
    built, data, tool = oracle
    for row in CONFIGURATIONS:
        expected = pin.computeFrameJacobian(built, data, row, tool, pin.LOCAL_WORLD_ALIGNED)
        assert np.abs(expected - jacobian(model, row.tolist())).max() < 1e-9


@pytest.mark.parametrize("payload", [None, LinkMass(1.5, (0.02, -0.04, 0.07))])
@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.80665), (4.0, -2.0, 8.0)])
def test_the_gravity_torques_match_pinocchio(
    gravity: Vector, payload: LinkMass | None, model: ArmModel, oracle: Oracle, pin: ModuleType
) -> None:
    built, _, tool = oracle
    if payload is not None:
        frame = built.frames[tool]
        body = pin.Inertia(payload.mass, np.array(payload.centre), np.eye(3) * 1e-3)
        built.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    built.gravity.linear = np.array(gravity)
    data = built.createData()
    for row in CONFIGURATIONS:
        expected = pin.computeGeneralizedGravity(built, data, row)
        assert np.abs(expected - gravity_torques(model, row.tolist(), gravity, payload)).max() < 1e-9


def test_pinocchio_reads_the_limits_of_the_model(model: ArmModel, pin: ModuleType) -> None:
    built = pin.buildModelFromXML(to_urdf(model, effort=[6.0, 5.0, 4.0, 3.0, 2.0, 1.0]))
    assert list(built.names[1:]) == list(model.joint_names)
    assert built.lowerPositionLimit.tolist() == [limit.lower for limit in model.limits]
    assert built.upperPositionLimit.tolist() == [limit.upper for limit in model.limits]
    assert built.velocityLimit.tolist() == [limit.velocity for limit in model.limits]
    assert built.effortLimit.tolist() == [6.0, 5.0, 4.0, 3.0, 2.0, 1.0]


def with_offsets(model: ArmModel) -> ArmModel:
    """A shoulder offset and a lateral offset, as in a PUMA, and a tool."""
    return arms.with_tool(arms.with_row(arms.with_row(model, 1, a=0.08), 2, d=0.12))


@pytest.mark.parametrize("change", [replace, with_offsets], ids=["as it is", "with offsets and tool"])
def test_eaik_finds_the_same_solutions(change: Change, either: ArmModel) -> None:
    eaik = pytest.importorskip("eaik.IK_Homogeneous")
    model = change(either)
    solver = InverseKinematics(model)
    other = eaik.HomogeneousRobot(np.array([arms.matrix(pose) for pose in frames(model, [0.0] * 6)]))
    compared = 0
    for pose in arms.chain(model, arms.random_configurations(model, COUNT, seed=7)):
        ours = np.array([solution.q for solution in solver.solve(arms.as_pose(pose)).solutions])
        answer = other.IK(pose)
        theirs = np.array([q for q, is_approximate in zip(answer.Q, answer.is_LS, strict=True) if not is_approximate])
        distance = arms.wrapped_difference(ours[:, None], theirs[None])
        assert len(ours) == len(theirs)
        assert max(distance.min(axis=0).max(), distance.min(axis=1).max()) < 1e-9
        compared += len(theirs)
    assert compared > 4 * COUNT


def test_coal_finds_the_same_distances_of_two_arms_and_of_boxes() -> None:
    pytest.importorskip("coal")
    differences = compare(arms.count(2000, 100_000))
    assert differences.overlapping > 30
    assert differences.in_boxes > 30
    assert differences.arms < 1e-6
    assert differences.boxes < 1e-6
