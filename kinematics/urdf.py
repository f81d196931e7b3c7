"""An arm as URDF, for viewers, simulators and planners that read nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from math import atan2, cos, hypot, isfinite, pi, sin

from kinematics.model import ArmModel, LinkMass
from kinematics.pose import Pose, Rotation, Vector, require_finite

UNKNOWN = 1e6  # Nm or rad/s: the format wants numbers, and a simulator takes zero for a joint that cannot move

_GYRATION = 0.05  # m, radius of the ball that stands for a link's unknown inertia
_SLIM, _THICK = 0.03, 0.045  # radii of the drawn links and joints, in parts of the arm's length
_COLOURS = {"grey": "0.75 0.75 0.75 1", "blue": "0.2 0.35 0.6 1"}  # of links and of joints

_TO_X = (0.0, pi / 2, 0.0)  # roll, pitch, yaw that lay a cylinder, which stands along z, along x


def to_urdf(model: ArmModel, effort: Sequence[float] | None = None) -> str:
    """The arm as a URDF document: base_link, link1 to link6 on revolute joints, tool0 fixed to link6.

    `effort`: six torque limits in Nm. The format wants them, and speed limits: those that are not known are `UNKNOWN`.
    Frame i of the table is the frame of link i, so q of the document is q of the model.

    Where the model has link masses, each link has its mass and centre of mass; its moments of inertia, which the model
    does not know, are those of a solid ball of 50 mm radius, so that simulators accept it: gravity is right,
    dynamics are not. What is drawn are cylinders along the lengths of the table, without meshes.

    ValueError for another count of efforts than six, and for one that is not finite or negative.
    Format: http://wiki.ros.org/urdf/XML
    """
    efforts = [UNKNOWN] * len(model.rows) if effort is None else list(effort)
    if len(efforts) != len(model.rows):
        raise ValueError(f"effort has {len(efforts)} values: {len(model.rows)} are needed")
    require_finite(efforts, model.joint_names)
    if min(efforts) < 0.0:
        raise ValueError(f"effort is {efforts}: it cannot be negative")

    robot = ET.Element("robot", name=model.name)
    for colour, rgba in _COLOURS.items():
        ET.SubElement(ET.SubElement(robot, "material", name=colour), "color", rgba=rgba)
    size = sum(abs(row.a) + abs(row.d) for row in model.rows) or 1.0
    links = ["base_link", *(f"link{number}" for number in range(1, 7))]
    for number, name in enumerate(links):
        link = ET.SubElement(robot, "link", name=name)
        if number and model.links:
            _inertial(link, model.links[number - 1])
        if number:
            _cylinder(link, _THICK * size, 2.5 * _THICK * size, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "blue")
        if number < len(model.rows):
            _segments(link, model, number, size)
        else:
            _rod(link, model.tool.position, size)
    ET.SubElement(robot, "link", name="tool0")

    for number, (row, limit) in enumerate(zip(model.rows, model.limits, strict=True)):
        sine, cosine = model.constants[number][:2]
        so, co = sin(row.offset), cos(row.offset)
        # Rx(alpha) Tx(a) Rz(offset) Tz(d): the joint's own Rz(q) commutes with the last two, and comes after them.
        rotation = (co, -so, 0.0, cosine * so, cosine * co, -sine, sine * so, sine * co, cosine)
        joint = ET.SubElement(robot, "joint", name=model.joint_names[number], type="revolute")
        _connect(joint, links[number], links[number + 1], Pose((row.a, -sine * row.d, cosine * row.d), rotation))
        ET.SubElement(joint, "axis", xyz="0 0 1")
        ET.SubElement(
            joint,
            "limit",
            lower=_text(limit.lower),
            upper=_text(limit.upper),
            effort=_text(efforts[number]),
            velocity=_text(limit.velocity if isfinite(limit.velocity) else UNKNOWN),
        )
    _connect(ET.SubElement(robot, "joint", name="tool0_fixed", type="fixed"), links[-1], "tool0", model.tool)

    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def fixed_axes_rpy(rotation: Rotation) -> Vector:
    """Roll, pitch, yaw in rad of URDF: R = Rz(yaw) Ry(pitch) Rx(roll), turns about fixed axes x, y, z in this order.

    Not the angles of `Pose.rpy`. Beside pitch = +-pi/2, where yaw is free, yaw is what round-off makes it and roll
    follows from it, so that the rotation keeps its accuracy.
    """
    r00, r01, r02, r10, r11, r12, r20, _, _ = rotation
    yaw = atan2(r10, r00)
    cy, sy = cos(yaw), sin(yaw)
    pitch = atan2(-r20, cy * r00 + sy * r10)
    return atan2(sy * r02 - cy * r12, cy * r11 - sy * r01), pitch, yaw


def _connect(joint: ET.Element, parent: str, child: str, pose: Pose) -> None:
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    _origin(joint, pose.position, fixed_axes_rpy(pose.rotation))


def _inertial(link: ET.Element, body: LinkMass) -> None:
    if body.mass == 0.0:
        return  # a mass of zero is refused by simulators; no inertial means none
    inertial = ET.SubElement(link, "inertial")
    _origin(inertial, body.centre, (0.0, 0.0, 0.0))
    ET.SubElement(inertial, "mass", value=_text(body.mass))
    moment = _text(0.4 * body.mass * _GYRATION**2)  # a solid ball: 2/5 m r^2 about every axis
    ET.SubElement(inertial, "inertia", ixx=moment, ixy="0", ixz="0", iyy=moment, iyz="0", izz=moment)


def _segments(link: ET.Element, model: ArmModel, number: int, size: float) -> None:
    """The lengths a, along x, and d, along the next axis, of the row that leads from this link to the next."""
    row = model.rows[number]
    radius = _SLIM * size
    if row.a:
        _cylinder(link, radius, abs(row.a), (row.a / 2, 0.0, 0.0), _TO_X, "grey")
    if row.d:
        sine, cosine = model.constants[number][:2]
        middle = (row.a, -sine * row.d / 2, cosine * row.d / 2)
        _cylinder(link, radius, abs(row.d), middle, (row.alpha, 0.0, 0.0), "grey")


def _rod(link: ET.Element, end: Vector, size: float) -> None:
    """From the link's origin to a point of it."""
    x, y, z = end
    length = hypot(x, y, z)
    if length:
        turned = (0.0, atan2(hypot(x, y), z), atan2(y, x))
        _cylinder(link, _SLIM * size, length, (x / 2, y / 2, z / 2), turned, "grey")


def _cylinder(link: ET.Element, radius: float, length: float, centre: Vector, rpy: Vector, colour: str) -> None:
    visual = ET.SubElement(link, "visual")
    _origin(visual, centre, rpy)
    geometry = ET.SubElement(visual, "geometry")
    ET.SubElement(geometry, "cylinder", radius=f"{radius:.4g}", length=f"{length:.4g}")
    ET.SubElement(visual, "material", name=colour)


def _origin(parent: ET.Element, xyz: Vector, rpy: Vector) -> None:
    ET.SubElement(parent, "origin", xyz=" ".join(map(_text, xyz)), rpy=" ".join(map(_text, rpy)))


def _text(value: float) -> str:
    """The shortest decimal that reads back as the same number."""
    return repr(float(value) + 0.0)  # the sum takes the sign from a zero
