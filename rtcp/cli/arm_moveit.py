"""The ROS package for MoveIt, made from an arm's file and the templates in `moveit/`."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from itertools import combinations
from math import isfinite, pi
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
import numpy.typing as npt

from kinematics.c_source import VERSION, to_c
from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import IDENTITY
from kinematics.urdf import to_urdf
from rtcp.config import load_kinematics
from rtcp.config.loader import whole_arm
from rtcp.config.model import UNLIMITED_TORQUE, CartesianConfig

GROUP = "manipulator"
"""Planning group, named as ROS-Industrial does."""
_SAMPLES = 1000
"""Number of random configurations in which links are checked for overlap."""
_BALLS = 8
"""Number of balls that fill a cylinder."""

Array = npt.NDArray[np.float64]


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
    model, config = load_kinematics(arm), whole_arm(arm)
    settings = config.joints if config else ()
    solver = to_c(model)
    urdf = to_urdf(model, [joint.torque for joint in settings if joint.torque < UNLIMITED_TORQUE] or None)
    package = f"{solver.prefix}_moveit_config"
    zero = [min(max(0.0, limit.lower), limit.upper) for limit in model.limits]
    joints = [
        {
            "name": name,
            "zero": zero[number],
            "velocity": limit.velocity if isfinite(limit.velocity) else None,
            "acceleration": settings[number].acceleration if settings else None,
            "jerk": settings[number].jerk if settings else None,
        }
        for number, (name, limit) in enumerate(zip(model.joint_names, model.limits, strict=True))
    ]
    tree = ET.fromstring(urdf)
    values = {
        "package": package,
        "prefix": solver.prefix,
        "robot": model.name,
        "version": VERSION,
        "group": GROUP,
        "joints": joints,
        "names": model.joint_names,
        "links": [link.get("name") for link in tree.findall("link")],
        "touching": _touching(model, tree, zero),
        "cartesian": config.cartesian if config else CartesianConfig(),
    }
    files = {f"src/{name}": text for name, text in solver.files.items()}
    files[f"config/{solver.prefix}.urdf"] = urdf
    for name, text in _rendered(values).items():
        files[name.replace("config/arm.", f"config/{solver.prefix}.")] = text
    return MoveItPackage(package, dict(sorted(files.items())))


def _touching(model: ArmModel, urdf: ET.Element, zero: list[float]) -> list[tuple[str, str, str]]:
    """Return links that are no neighbours and overlap in every configuration (Always) or at zero (Default).

    MoveIt would reject every plan because of them. It still checks pairs that never touch.
    """
    names = [link.get("name", "") for link in urdf.findall("link")]
    balls = [_balls(link) for link in urdf.findall("link")]
    low = [max(limit.lower, -pi) for limit in model.limits]
    high = [min(limit.upper, pi) for limit in model.limits]
    sampled = np.random.default_rng(0).uniform(low, high, (_SAMPLES, len(low)))
    pairs = [(i, j) for i, j in combinations(range(len(names)), 2) if j > i + 1 and len(balls[i]) and len(balls[j])]

    def overlapping(q: list[float]) -> set[tuple[int, int]]:
        placed = []
        for pose, own in zip((IDENTITY, *frames(model, q)), balls, strict=True):
            placed.append((own[:, :3] @ np.reshape(pose.rotation, (3, 3)).T + pose.position, own[:, 3]))

        def overlap(i: int, j: int) -> bool:
            (a, a_radius), (b, b_radius) = placed[i], placed[j]
            return bool(np.any(np.linalg.norm(a[:, None] - b, axis=2) < a_radius[:, None] + b_radius))

        return {pair for pair in pairs if overlap(*pair)}

    at_zero, always = overlapping(zero), set(pairs)
    for q in sampled.tolist():
        always &= overlapping(q)
    return [(names[i], names[j], "Always" if (i, j) in always else "Default") for i, j in sorted(at_zero | always)]


def _balls(link: ET.Element) -> Array:
    """Return balls inside the cylinders and spheres of a link: centre in its frame and radius, m, shape (n, 4)."""
    balls: list[tuple[float, ...]] = []
    for body in link.findall("collision"):
        origin, cylinder, sphere = body.find("origin"), body.find("geometry/cylinder"), body.find("geometry/sphere")
        assert origin is not None
        centre = np.array(origin.get("xyz", "").split(), float)
        if sphere is not None:
            balls.append((*centre, float(sphere.get("radius", ""))))
            continue
        assert cylinder is not None
        _, pitch, yaw = map(float, origin.get("rpy", "").split())
        axis = np.array([np.cos(yaw) * np.sin(pitch), np.sin(yaw) * np.sin(pitch), np.cos(pitch)])  # no roll
        radius, length = float(cylinder.get("radius", "")), float(cylinder.get("length", ""))
        along = (np.arange(_BALLS) + 0.5) * length / _BALLS - length / 2
        balls += [(*(centre + z * axis), min(radius, length / 2 - abs(z))) for z in along]
    return np.reshape(balls, (-1, 4))


def _rendered(values: dict[str, Any]) -> dict[str, str]:
    """Return the rendered templates by their paths."""
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
