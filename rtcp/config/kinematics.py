"""Reads the arm's kinematics: from the whole file of an arm, or from one that has only `name` and `kinematics`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from kinematics.model import ArmModel
from rtcp.config.arm_model import arm_model
from rtcp.config.checking import Checker, allowed
from rtcp.config.document import read
from rtcp.config.errors import ConfigError
from rtcp.config.geometry import Kinematics, kinematics_findings
from rtcp.config.model import Name
from rtcp.config.schema import ArmFile, load


@dataclass(frozen=True)
class KinematicsFile:
    """An arm that is only computed with: no slaves, no drives."""

    name: Name
    kinematics: Kinematics


_FILE = Checker(KinematicsFile)

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
        try:
            return arm_model(file.name, file.kinematics, ())
        except ValueError as error:
            raise ConfigError(document.sentences([(("kinematics",), str(error))])) from error
    config = load(path)
    if config.arm is None:
        wanted = allowed(Kinematics)
        raise ConfigError(document.sentences([((), f"the key kinematics is missing; it must be {wanted}")]))
    return config.arm


def torque_limits(path: Path) -> tuple[float, ...] | None:
    """Return the torque limits, Nm, of a whole arm's joints; None where the file has kinematics alone.

    Raises:
        ConfigError: as `load_kinematics`.
    """
    data = read(path).data
    if not isinstance(data, dict) or _OF_A_WHOLE_ARM.isdisjoint(data):
        return None
    return tuple(joint.torque for joint in load(path).joints)
