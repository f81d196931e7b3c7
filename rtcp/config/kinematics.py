"""Reads the arm's kinematics: from the whole file of an arm, or from one that has only `name` and `kinematics`."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

from kinematics.model import ArmModel, DhRow, JointLimit, LinkMass
from kinematics.pose import Pose, Vector
from rtcp.config.checking import Checker, allowed
from rtcp.config.document import Document, read
from rtcp.config.errors import ConfigError
from rtcp.config.geometry import Kinematics, kinematics_findings
from rtcp.config.model import Joint, Name
from rtcp.config.schema import ArmFile, load


@dataclass(frozen=True)
class KinematicsFile:
    """An arm that is only computed with: no slaves, no drives."""

    name: Name
    kinematics: Kinematics


@dataclass(frozen=True)
class _Part:
    kinematics: Kinematics


_FILE, _PART = Checker(KinematicsFile), Checker(_Part)

_OF_A_WHOLE_ARM = {entry.name for entry in fields(ArmFile)} - {entry.name for entry in fields(KinematicsFile)}


def load_kinematics(path: Path) -> ArmModel:
    """Read an arm's file and return its kinematics.

    A file with any key of a whole arm is checked as one, with its device files; its joints' `position` and `velocity`
    are then the limits of the model, and `kinematics.limits` are the mechanical ones that they must lie within.

    Raises:
        ConfigError: with one sentence for every mistake: file, line, key, what was found and what is allowed.
    """
    document = read(path)
    data = document.data if isinstance(document.data, dict) else {}
    if _OF_A_WHOLE_ARM.isdisjoint(data):
        file, findings = _FILE.check(data)
        findings += kinematics_findings(data)
        if findings or file is None:
            raise ConfigError(document.sentences(findings))
        return _model(document, file.name, file.kinematics, ())
    config = load(path)
    if data.get("kinematics") is None:
        wanted = allowed(Kinematics)
        raise ConfigError(document.sentences([((), f"the key kinematics is missing; it must be {wanted}")]))
    part, findings = _PART.check({"kinematics": data["kinematics"]})
    if findings or part is None:
        raise ConfigError(document.sentences(findings))
    return _model(document, config.name, part.kinematics, config.joints)


def torque_limits(path: Path) -> tuple[float, ...] | None:
    """Return the torque limits, Nm, of a whole arm's joints; None where the file has kinematics alone.

    Raises:
        ConfigError: as `load_kinematics`.
    """
    data = read(path).data
    if not isinstance(data, dict) or _OF_A_WHOLE_ARM.isdisjoint(data):
        return None
    return tuple(joint.torque for joint in load(path).joints)


def _model(document: Document, name: str, part: Kinematics, joints: tuple[Joint, ...]) -> ArmModel:
    if joints:
        limits = tuple(JointLimit(joint.position.min, joint.position.max, joint.velocity) for joint in joints)
        names = tuple(joint.name for joint in joints)
    else:
        limits = tuple(JointLimit(one.min, one.max, one.velocity or math.inf) for one in part.limits or ())
        names = ArmModel.joint_names
    x, y, z = part.tool.position
    try:
        return ArmModel(
            name=name,
            rows=tuple(DhRow(row.alpha, row.a, row.d, row.offset) for row in part.dh),
            limits=limits,
            links=tuple(LinkMass(link.mass, _vector(link.centre)) for link in part.links or ()),
            tool=Pose.from_xyzrpy(x, y, z, *part.tool.rpy),
            joint_names=names,
        )
    except ValueError as error:
        raise ConfigError(document.sentences([(("kinematics",), str(error))])) from error


def _vector(numbers: tuple[float, ...]) -> Vector:
    x, y, z = numbers
    return x, y, z
