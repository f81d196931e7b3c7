"""Makes the model that is computed with out of the `kinematics:` part of an arm's file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from kinematics.model import ArmModel, DhRow, JointLimit, LinkMass
from kinematics.pose import Pose, Vector
from rtcp.config.checking import Checker
from rtcp.config.geometry import Kinematics
from rtcp.config.model import Joint


@dataclass(frozen=True)
class _Part:
    kinematics: Kinematics


_PART = Checker(_Part)


def kinematics_part(data: object) -> Kinematics | None:
    """Return the `kinematics:` part of an arm's file; None where it is missing or has a wrong form."""
    found = data.get("kinematics") if isinstance(data, dict) else None
    part, _ = _PART.check({"kinematics": found})
    return None if part is None else part.kinematics


def arm_model(name: str, part: Kinematics, joints: Sequence[Joint]) -> ArmModel:
    """Return the model of an arm; where it has `joints`, their names, ranges and speeds are the model's.

    Raises:
        ValueError: the numbers make no arm; the message is a sentence.
    """
    if joints:
        limits = tuple(JointLimit(joint.position.min, joint.position.max, joint.velocity) for joint in joints)
        names = tuple(joint.name for joint in joints)
    else:
        limits = tuple(JointLimit(one.min, one.max, one.velocity or math.inf) for one in part.limits or ())
        names = ArmModel.joint_names
    x, y, z = part.tool.position
    return ArmModel(
        name=name,
        rows=tuple(DhRow(row.alpha, row.a, row.d, row.offset) for row in part.dh),
        limits=limits,
        links=tuple(LinkMass(link.mass, _vector(link.centre)) for link in part.links or ()),
        tool=Pose.from_xyzrpy(x, y, z, *part.tool.rpy),
        joint_names=names,
    )


def _vector(numbers: tuple[float, ...]) -> Vector:
    x, y, z = numbers
    return x, y, z
