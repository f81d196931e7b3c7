"""The ROS package for MoveIt, made from an arm's file and the templates in `moveit/`."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from kinematics.c_source import VERSION, to_c
from kinematics.urdf import to_urdf
from rtcp.config import load_kinematics
from rtcp.config.loader import joints_of

GROUP = "manipulator"
"""Planning group, named as ROS-Industrial does."""


class MoveItPackage(NamedTuple):
    """A ROS package: its name, and its files by their paths in it."""

    name: str
    files: dict[str, str]


def moveit_package(arm: Path) -> MoveItPackage:
    """Return the package of an arm's file.

    Raises:
        ConfigError: as `load_kinematics`.
        ValueError: the arm has no solver in C; the reason.
    """
    model, settings = load_kinematics(arm), joints_of(arm)
    solver = to_c(model)
    urdf = to_urdf(model, [joint.torque for joint in settings] or None)
    package = f"{solver.prefix}_moveit_config"
    joints = [
        {
            "name": name,
            "home": min(max(0.0, limit.lower), limit.upper),
            "velocity": limit.velocity if isfinite(limit.velocity) else None,
            "acceleration": settings[number].acceleration if settings else None,
            "jerk": settings[number].jerk if settings else None,
        }
        for number, (name, limit) in enumerate(zip(model.joint_names, model.limits, strict=True))
    ]
    values = {
        "package": package,
        "prefix": solver.prefix,
        "robot": model.name,
        "version": VERSION,
        "group": GROUP,
        "joints": joints,
        "names": model.joint_names,
        "links": [link.get("name") for link in ET.fromstring(urdf).findall("link")],
    }
    files = {f"src/{name}": text for name, text in solver.files.items()}
    files[f"config/{solver.prefix}.urdf"] = urdf
    for name, text in _rendered(values).items():
        files[name.replace("config/arm.", f"config/{solver.prefix}.")] = text
    return MoveItPackage(package, dict(sorted(files.items())))


def _rendered(values: dict[str, Any]) -> dict[str, str]:
    """Return the templates with the values in them, by their paths."""
    here = Path(__file__).resolve().parent
    shipped = here / "moveit"  # in a wheel; a checkout has the folder at its top
    folder = shipped if shipped.is_dir() else here.parents[1] / "moveit"
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    # pip compiles the launch file of an installed wheel, too.
    names = environment.list_templates(filter_func=lambda name: "__pycache__" not in name)
    return {name: environment.get_template(name).render(values) for name in names}
