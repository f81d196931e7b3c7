"""The exported URDF, read back with the standard library."""

from __future__ import annotations

import math
import random
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from kinematics.forward import forward
from kinematics.model import ArmModel, LinkMass
from kinematics.pose import IDENTITY
from kinematics.urdf import UNKNOWN, fixed_axes_rpy, to_urdf
from tests.kinematics.arms import Change, with_general_rows, with_tool

LINKS = tuple(LinkMass(0.1 * i, (0.01 * i, -0.02, 0.03)) for i in range(1, 7))


def read(element: ET.Element, name: str) -> list[float]:
    return [float(word) for word in element.get(name, "").split()]


def transform(origin: ET.Element | None) -> np.ndarray:
    """By the format's definition: roll, pitch, yaw about fixed x, y, z, one after the other."""
    result = np.eye(4)
    roll, pitch, yaw = read(origin, "rpy")
    for axes, angle in (((1, 2), roll), ((2, 0), pitch), ((0, 1), yaw)):
        rotation = np.eye(3)
        i, j = axes
        rotation[i, i] = rotation[j, j] = math.cos(angle)
        rotation[j, i], rotation[i, j] = math.sin(angle), -math.sin(angle)
        result[:3, :3] = rotation @ result[:3, :3]
    result[:3, 3] = read(origin, "xyz")
    return result


def tool_of_the_document(robot: ET.Element, q: list[float]) -> np.ndarray:
    """The product of all joints from base_link to tool0."""
    joints = {joint.find("parent").get("link"): joint for joint in robot.findall("joint")}
    angles = iter(q)
    link, result = "base_link", np.eye(4)
    while link in joints:
        joint = joints[link]
        result = result @ transform(joint.find("origin"))
        if joint.get("type") == "revolute":
            assert read(joint.find("axis"), "xyz") == [0, 0, 1]
            angle = next(angles)
            rotation = np.eye(4)
            rotation[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
            result = result @ rotation
        link = joint.find("child").get("link")
    assert link == "tool0"
    return result


@pytest.mark.parametrize("change", [replace, with_tool, with_general_rows])
def test_the_tool_pose_of_the_document_matches_the_model(change: Change, either: ArmModel) -> None:
    model = change(either)
    robot = ET.fromstring(to_urdf(model))
    numbers = random.Random(7)
    for _ in range(50):
        q = [numbers.uniform(-3.0, 3.0) for _ in range(6)]
        exported, expected = tool_of_the_document(robot, q), forward(model, q)
        assert exported[:3, 3] == pytest.approx(expected.position, abs=1e-13)
        assert exported[:3, :3].ravel() == pytest.approx(expected.rotation, abs=1e-13)


def test_every_body_that_is_drawn_is_a_collision_body_too(irb120: ArmModel) -> None:
    for link in ET.fromstring(to_urdf(irb120)).findall("link"):
        drawn, solid = (
            [(body.find("origin").attrib, body.find("geometry/cylinder").attrib) for body in link.findall(use)]
            for use in ("visual", "collision")
        )
        assert drawn == solid
        assert drawn or link.get("name") == "tool0"


def test_limits_are_exact(irb120: ArmModel) -> None:
    joints = ET.fromstring(to_urdf(irb120, effort=[6.1, 5.0, 4.0, 3.0, 2.0, 1.0])).findall("joint[@type='revolute']")
    assert [joint.get("name") for joint in joints] == list(irb120.joint_names)
    for joint, limit, effort in zip(joints, irb120.limits, [6.1, 5.0, 4.0, 3.0, 2.0, 1.0], strict=True):
        written = {key: float(value) for key, value in joint.find("limit").attrib.items()}
        assert written == {"lower": limit.lower, "upper": limit.upper, "velocity": limit.velocity, "effort": effort}


def test_unknown_limits_are_large_finite_numbers(irb120: ArmModel) -> None:
    limits = tuple(replace(limit, velocity=math.inf) for limit in irb120.limits)
    for limit in ET.fromstring(to_urdf(replace(irb120, limits=limits))).iter("limit"):
        assert (float(limit.get("velocity")), float(limit.get("effort"))) == (UNKNOWN, UNKNOWN)


def test_masses_and_centres_match_the_model(assistive: ArmModel) -> None:
    robot = ET.fromstring(to_urdf(replace(assistive, links=LINKS)))
    for number, body in enumerate(LINKS, start=1):
        inertial = robot.find(f"link[@name='link{number}']/inertial")
        assert float(inertial.find("mass").get("value")) == body.mass
        assert read(inertial.find("origin"), "xyz") == list(body.centre)
        inertia = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
        assert inertia["ixx"] == inertia["iyy"] == inertia["izz"] == pytest.approx(body.mass * 0.001)
        assert inertia["ixy"] == inertia["ixz"] == inertia["iyz"] == 0.0


def test_a_link_without_mass_has_no_inertial(assistive: ArmModel) -> None:
    assert ET.fromstring(to_urdf(replace(assistive, links=()))).find(".//inertial") is None
    links = (*LINKS[:3], LinkMass(0.0, (0.0, 0.0, 0.0)), *LINKS[4:])
    robot = ET.fromstring(to_urdf(replace(assistive, links=links)))
    with_inertial = [link.get("name") for link in robot.findall("link") if link.find("inertial") is not None]
    assert with_inertial == ["link1", "link2", "link3", "link5", "link6"]


@pytest.mark.parametrize("change", [with_tool, with_general_rows])
def test_the_drawn_links_connect_each_joint_to_the_next(change: Change, irb120: ArmModel) -> None:
    robot = ET.fromstring(to_urdf(change(irb120)))
    for joint in robot.findall("joint"):
        corner = np.zeros(3)
        for visual in robot.findall(f"link[@name='{joint.find('parent').get('link')}']/visual"):
            if visual.find("material").get("name") != "grey":
                continue
            placed = transform(visual.find("origin"))
            half = placed[:3, 2] * float(visual.find("geometry/cylinder").get("length")) / 2
            ends = sorted((placed[:3, 3] + half, placed[:3, 3] - half), key=lambda end: math.dist(end, corner))
            assert ends[0] == pytest.approx(corner, abs=1e-3)
            corner = ends[1]
        assert corner == pytest.approx(read(joint.find("origin"), "xyz"), abs=1e-3)


def test_every_link_is_visible_without_meshes(assistive: ArmModel) -> None:
    robot = ET.fromstring(to_urdf(assistive))
    colours = {material.get("name") for material in robot.findall("material")}
    for link in robot.findall("link"):
        if link.get("name") != "tool0":
            assert link.findall("visual/geometry/cylinder")
    assert {material.get("name") for material in robot.findall("link/visual/material")} == colours
    assert robot.find(".//mesh") is None


def test_a_name_with_markup_characters_is_escaped(assistive: ArmModel) -> None:
    name = 'arm <1> & "2"'
    assert ET.fromstring(to_urdf(replace(assistive, name=name))).get("name") == name


@pytest.mark.parametrize("pitch", [0.3, -1.2, math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9, -math.pi / 2 + 1e-12])
def test_the_angles_reproduce_the_rotation_also_where_yaw_is_undefined(pitch: float) -> None:
    numbers = random.Random(8)
    for _ in range(20):
        roll, yaw = numbers.uniform(-3.0, 3.0), numbers.uniform(-3.0, 3.0)
        origin = ET.Element("origin", xyz="0 0 0", rpy=f"{roll!r} {pitch!r} {yaw!r}")
        # Round-off destroys the small entries from which roll and yaw would be read separately.
        rotation = transform(origin)[:3, :3] + [[numbers.gauss(0.0, 1e-16) for _ in range(3)] for _ in range(3)]
        again = fixed_axes_rpy(tuple(rotation.ravel().tolist()))
        origin.set("rpy", " ".join(map(repr, again)))
        assert transform(origin)[:3, :3] == pytest.approx(rotation, abs=1e-14)


def test_the_identity_has_angles_of_zero() -> None:
    assert fixed_axes_rpy(IDENTITY.rotation) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("effort", "reason"),
    [([1.0] * 5, "5 values"), ([1.0] * 5 + [math.nan], "joint6"), ([-1.0] + [1.0] * 5, "negative")],
)
def test_invalid_efforts_are_refused(effort: list[float], reason: str, assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match=reason):
        to_urdf(assistive, effort=effort)
