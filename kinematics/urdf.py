"""Export of an arm as URDF, for viewers, simulators and planners."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from math import atan2, cos, hypot, isfinite, sin

from kinematics.capsules import JOINT_LENGTH, SLIM, THICK, extent, rods
from kinematics.model import ArmModel, Capsule, LinkMass
from kinematics.pose import Pose, Rotation, Vector, require_finite, turned

UNKNOWN = 1e6  # Nm or rad/s: the format requires a number, and for a simulator zero means a fixed joint

_RADIUS = 0.05  # m, of the solid ball that stands in for a link's unknown inertia
_COLOURS = {"grey": "0.75 0.75 0.75 1", "blue": "0.2 0.35 0.6 1"}  # of links and of joints


def to_urdf(model: ArmModel, effort: Sequence[float] | None = None) -> str:
    """The arm as a URDF document: base_link, link1 to link6 on revolute joints, tool0 fixed to link6.

    `effort`: six torque limits, Nm. The format requires them and speed limits: unknown ones are `UNKNOWN`. Frame i of
    the model is the frame of link i, so q of the document is q of the model.

    Links have the masses and centres of mass of the model, if it has any. Moments of inertia are unknown; those of a
    solid ball of 50 mm radius let simulators accept the file: gravity is right, dynamics are not. Links are
    cylinders, without meshes, for drawing and for collisions: pad them to the real covers in the planner; where the
    model names bodies, links are these.

    Raises ValueError for a count of efforts other than six, and for one that is negative or not finite.
    Format: http://wiki.ros.org/urdf/XML
    """
    efforts = [UNKNOWN] * len(model.rows) if effort is None else list(effort)
    if len(efforts) != len(model.rows):
        raise ValueError(f"effort has {len(efforts)} values; {len(model.rows)} are required")
    require_finite(efforts, model.joint_names)
    if min(efforts) < 0.0:
        raise ValueError(f"effort is {efforts}; it must not be negative")

    robot = ET.Element("robot", name=model.name)
    for colour, rgba in _COLOURS.items():
        ET.SubElement(ET.SubElement(robot, "material", name=colour), "color", rgba=rgba)
    slim, thick = SLIM * extent(model), THICK * extent(model)
    links = ["base_link", *(f"link{number}" for number in range(1, len(model.rows) + 1))]
    for number, name in enumerate(links):
        link = ET.SubElement(robot, "link", name=name)
        if number and model.links:
            _inertial(link, model.links[number - 1])
        if model.bodies:
            for body in model.bodies:
                if body.link == number:
                    _capsule(link, body)
            continue
        if number:
            _cylinder(link, thick, JOINT_LENGTH * thick, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "blue")
        for _, start, end in (rod for rod in rods(model) if rod[0] == number):
            _rod(link, start, end, slim)
    ET.SubElement(robot, "link", name="tool0")

    for number, limit in enumerate(model.limits):
        joint = ET.SubElement(robot, "joint", name=model.joint_names[number], type="revolute")
        _connect(joint, links[number], links[number + 1], _joint_pose(model, number))
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
    """Roll, pitch, yaw in rad of URDF: R = Rz(yaw) Ry(pitch) Rx(roll), about the fixed axes x, y, z in this order.

    These are not the angles of `Pose.rpy`. Beside pitch = +-pi/2 yaw is undefined; roll then follows from the yaw that
    round-off gives, so that the rotation keeps its accuracy.
    """
    r00, r01, r02, r10, r11, r12, r20, _, _ = rotation
    yaw = atan2(r10, r00)
    cy, sy = cos(yaw), sin(yaw)
    pitch = atan2(-r20, cy * r00 + sy * r10)
    return atan2(sy * r02 - cy * r12, cy * r11 - sy * r01), pitch, yaw


def _joint_pose(model: ArmModel, number: int) -> Pose:
    """Rx(alpha) Tx(a) Rz(offset) Tz(d) of a row: the joint's own Rz(q) commutes with the last two and follows them."""
    sine, cosine, a, d, offset = model.constants[number]
    return Pose((a, -sine * d, cosine * d), turned(sine, cosine, offset))


def _connect(joint: ET.Element, parent: str, child: str, pose: Pose) -> None:
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    _origin(joint, pose.position, fixed_axes_rpy(pose.rotation))


def _inertial(link: ET.Element, body: LinkMass) -> None:
    if body.mass == 0.0:
        return  # simulators reject a mass of zero; a link without inertial has none
    inertial = ET.SubElement(link, "inertial")
    _origin(inertial, body.centre, (0.0, 0.0, 0.0))
    ET.SubElement(inertial, "mass", value=_text(body.mass))
    moment = _text(0.4 * body.mass * _RADIUS**2)  # a solid ball: 2/5 m r^2 about every axis
    ET.SubElement(inertial, "inertia", ixx=moment, ixy="0", ixz="0", iyy=moment, iyz="0", izz=moment)


def _rod(link: ET.Element, start: Vector, end: Vector, radius: float) -> None:
    """Draw a cylinder from one point of the link to another."""
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    middle = tuple(0.5 * (a + b) for a, b in zip(start, end, strict=True))
    _cylinder(link, radius, hypot(x, y, z), middle, (0.0, atan2(hypot(x, y), z), atan2(y, x)), "grey")


def _capsule(link: ET.Element, body: Capsule) -> None:
    """Draw a cylinder with a ball at each end."""
    radius = f"{body.radius:.4g}"
    if body.start != body.end:
        _rod(link, body.start, body.end, body.radius)
        _body(link, body.end, (0.0, 0.0, 0.0), "blue", "sphere", radius=radius)
    _body(link, body.start, (0.0, 0.0, 0.0), "blue", "sphere", radius=radius)


def _cylinder(
    link: ET.Element, radius: float, length: float, centre: Sequence[float], rpy: Vector, colour: str
) -> None:
    _body(link, centre, rpy, colour, "cylinder", radius=f"{radius:.4g}", length=f"{length:.4g}")


def _body(link: ET.Element, centre: Sequence[float], rpy: Vector, colour: str, shape: str, **size: str) -> None:
    for use in ("visual", "collision"):
        body = ET.SubElement(link, use)
        _origin(body, centre, rpy)
        ET.SubElement(ET.SubElement(body, "geometry"), shape, dict(size))
        if use == "visual":
            ET.SubElement(body, "material", name=colour)


def _origin(parent: ET.Element, xyz: Sequence[float], rpy: Vector) -> None:
    ET.SubElement(parent, "origin", xyz=" ".join(map(_text, xyz)), rpy=" ".join(map(_text, rpy)))


def _text(value: float) -> str:
    """The shortest decimal that reads back as the same number."""
    return repr(float(value) + 0.0)  # adding zero makes -0.0 positive
