"""The model of an arm refuses invalid values; the package loads nothing that the loop must not load."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, pi
from typing import Any

import pytest

import kinematics
from kinematics.model import ArmModel, DhRow, JointLimit, LinkMass
from kinematics.pose import Pose, Vector

LINK = LinkMass(1.0, (0.0, 0.0, 0.1))


@pytest.mark.parametrize("name", ["alpha", "a", "d", "offset"])
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_a_row_refuses_a_parameter_that_is_not_finite(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name} is {value}"):
        replace(DhRow(0.0, 0.1, 0.2, 0.3), **{name: value})


@pytest.mark.parametrize(("lower", "upper"), [(1.0, 1.0), (1.0, -1.0)])
def test_a_limit_refuses_an_empty_interval(lower: float, upper: float) -> None:
    with pytest.raises(ValueError, match=f"lower {lower} is not below upper {upper}"):
        JointLimit(lower, upper)


@pytest.mark.parametrize(("lower", "upper", "name"), [(-inf, 1.0, "lower"), (0.0, inf, "upper"), (nan, 1.0, "lower")])
def test_a_limit_refuses_a_bound_that_is_not_finite(lower: float, upper: float, name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} is"):
        JointLimit(lower, upper)


@pytest.mark.parametrize("speed", [0.0, -1.0, nan])
def test_a_limit_refuses_a_speed_that_is_not_positive(speed: float) -> None:
    with pytest.raises(ValueError, match="velocity"):
        JointLimit(-1.0, 1.0, speed)


@pytest.mark.parametrize(
    ("mass", "centre", "reason"),
    [
        (-0.1, (0.0, 0.0, 0.0), "negative"),
        (nan, (0.0, 0.0, 0.0), "^mass is nan"),
        (1.0, (0.0, inf, 0.0), "^centre y is inf"),
        (1.0, (0.0, 0.0), "2 numbers"),
    ],
)
def test_a_link_refuses_an_impossible_mass_or_centre(mass: float, centre: Vector, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        LinkMass(mass, centre)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda arm: {"rows": arm.rows[:5]}, "rows has 5 entries"),
        (lambda arm: {"limits": (*arm.limits, arm.limits[0])}, "limits has 7 entries"),
        (lambda arm: {"links": (LINK,) * 5}, "links has 5 entries"),
        (lambda arm: {"joint_names": ("a", "b", "c", "d", "e")}, "joint_names has 5 entries"),
        (lambda arm: {"joint_names": ("a", "b", "c", "d", "e", "a")}, "different names"),
        (lambda arm: {"joint_names": ("a", "b", "c", "d", "e", "")}, "different names"),
        (lambda arm: {"tool": Pose((0.0, nan, 0.0), arm.tool.rotation)}, "y is nan"),
        (lambda arm: {"tool": Pose((0.0, 0.0, 0.0), (2.0, *arm.tool.rotation[1:]))}, "tool's rotation is invalid"),
        (lambda arm: {"tool": Pose((0.0, 0.0, 0.0), (-1.0, *arm.tool.rotation[1:]))}, "tool's rotation is invalid"),
    ],
)
def test_an_invalid_arm_is_refused_with_the_reason(
    change: Callable[[ArmModel], dict[str, Any]], reason: str, assistive: ArmModel
) -> None:
    with pytest.raises(ValueError, match=reason):
        replace(assistive, **change(assistive))


def test_an_arm_has_all_masses_or_none(assistive: ArmModel) -> None:
    assert replace(assistive, links=(LINK,) * 6).links == (LINK,) * 6
    assert assistive.links == ()


def test_right_angles_have_exact_sines_and_cosines(assistive: ArmModel) -> None:
    assert [constants[:2] for constants in assistive.constants] == [(0, 1), (-1, 0), (0, -1), (-1, 0), (-1, 0), (1, 0)]


def test_angles_close_to_a_right_angle_are_kept() -> None:
    row = DhRow(pi / 2 - 1e-6, 0.0, 0.0)
    arm = ArmModel("oblique", (row,) * 6, (JointLimit(-1.0, 1.0),) * 6)
    assert arm.constants[0][1] == pytest.approx(1e-6, rel=1e-9)


def test_importing_the_package_loads_neither_numpy_nor_xml() -> None:
    code = "import kinematics, sys; print([name for name in ('numpy', 'xml') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_every_name_of_the_package_exists() -> None:
    assert [name for name in kinematics.__all__ if getattr(kinematics, name, None) is None] == []
    with pytest.raises(AttributeError, match="has no attribute 'backward'"):
        _ = kinematics.backward
