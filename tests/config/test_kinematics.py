"""The `kinematics:` part of an arm's file and the message for each mistake in it."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from kinematics.capsules import capsules, with_every_tool
from kinematics.forward import forward, frames
from kinematics.model import Capsule, DhRow, JointLimit
from kinematics.pose import IDENTITY, Pose
from rtcp.config import ConfigError, default_config, load, load_kinematics
from rtcp.config.findings import Finding
from rtcp.config.loader import load_mechanics
from rtcp.config.model import CartesianConfig
from rtcp.config.numbers import angle
from tests.findings import assert_finds, findings_of

ARM, IRB = Path("assistive_arm.yaml"), Path("geometry.yaml")
ROW1 = "{alpha: 0, a: 0, d: 0.290}"
LIMIT1 = "{min: -11*pi/12, max: 11*pi/12, velocity: 25*pi/18}"
LINK1 = "{mass: 3.067, centre: [0.0000977, -0.00012, -0.05159]}"
MECHANICAL = "\n  limits:\n" + "    - {min: -pi, max: pi, velocity: 1.0}\n" * 6
HALF = math.pi / 2


def rewritten(file: Path, change: Callable[[dict[str, object]], object]) -> Path:
    """The file with its values changed; comments and layout are lost."""
    data = yaml.safe_load(file.read_text())
    change(data)
    file.write_text(yaml.safe_dump(data))
    return file


def without_kinematics(data: dict[str, object]) -> None:
    """Remove the geometry and the boxes, which need it."""
    del data["kinematics"], data["cartesian"]


# -- what the shipped files say ----------------------------------------------------------------------------------------


def test_the_assistive_arm_has_the_rows_of_the_facts() -> None:
    l1, l2, l3, l4, l5 = 0.170, 0.440, 0.450, 0.100, 0.140
    assert load_kinematics(default_config()).rows == (
        DhRow(0, 0, l1),
        DhRow(-HALF, 0, 0, -HALF),
        DhRow(math.pi, l2, 0, -HALF),
        DhRow(-HALF, 0, l3 + l4),
        DhRow(-HALF, 0, 0),
        DhRow(HALF, 0, l5),
    )


def test_the_joints_of_a_whole_arm_are_the_limits_of_its_kinematics() -> None:
    arm, model = load(default_config()), load_kinematics(default_config())
    assert model.name == arm.name
    assert model.joint_names == tuple(joint.name for joint in arm.joints)
    assert model.limits == tuple(JointLimit(j.position.min, j.position.max, j.velocity) for j in arm.joints)


def test_the_joints_keep_their_names(directory: Path) -> None:
    ARM.write_text(ARM.read_text().replace("name: joint2", "name: shoulder"))
    assert load_kinematics(ARM).joint_names[:3] == ("joint1", "shoulder", "joint3")


def test_the_links_of_the_assistive_arm_weigh_their_actuators_and_more() -> None:
    moved = sum((0.720, 0.720, 0.650, 0.500, 0.335))
    tubes = 0.170 + 0.440 + 0.550 + 0.140
    assert sum(link.mass for link in load_kinematics(default_config()).links) == pytest.approx(moved + tubes)


def test_each_centre_of_mass_lies_on_its_link_when_the_arm_points_straight_up() -> None:
    model = load_kinematics(default_config())
    origins = [*frames(model, [0.0] * 6)]
    ends = ((0.0, 0.170), (0.170, 0.610), (0.610, 1.060), (1.060, 1.160), (1.160, 1.230), (1.230, 1.300))
    for pose, link, (low, high) in zip(origins, model.links, ends, strict=False):
        x, y, z = (pose @ Pose(link.centre, IDENTITY.rotation)).position
        assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-12)
        assert low < z < high


def test_the_irb_120_stands_at_its_data_sheets_zero() -> None:
    model = load_kinematics(default_config().parent / "abb_irb120.yaml")
    pose = forward(model, [0.0] * 6)
    assert pose.position == pytest.approx((0.374, 0.0, 0.630), abs=1e-15)
    assert pose.rpy == pytest.approx((0.0, HALF, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("joint", "moved", "position"),
    [
        (0, "the flange to the left", (0.0, 0.374, 0.630)),
        (1, "the arm forward", (0.340, 0.0, 0.290 - 0.374)),
        (2, "the forearm down", (0.070, 0.0, 0.560 - 0.374)),
        (4, "the hand down", (0.302, 0.0, 0.630 - 0.072)),
    ],
)
def test_a_quarter_turn_of_a_joint_of_the_irb_120_moves(
    joint: int, moved: str, position: tuple[float, float, float]
) -> None:
    model = load_kinematics(default_config().parent / "abb_irb120.yaml")
    q = [HALF if i == joint else 0.0 for i in range(6)]
    assert forward(model, q).position == pytest.approx(position, abs=1e-12)


def test_the_irb_120_has_the_ranges_and_speeds_of_its_data_sheet() -> None:
    limits = load_mechanics(default_config().parent / "abb_irb120.yaml").limits
    degrees = [tuple(round(math.degrees(v), 9) for v in (limit.lower, limit.upper, limit.velocity)) for limit in limits]
    assert degrees == [
        (-165, 165, 250), (-110, 110, 250), (-110, 70, 250), (-160, 160, 320), (-120, 120, 320), (-400, 400, 420),
    ]  # fmt: skip


def test_the_bodies_of_a_file_are_those_of_its_model(directory: Path) -> None:
    body = {"link": 2, "start": [0, 0, 0], "end": [0.27, 0, 0.01], "radius": 0.05}
    model = load_kinematics(rewritten(IRB, lambda data: data["kinematics"].update(bodies=[body])))  # type: ignore[attr-defined]
    assert model.bodies == (Capsule(2, (0.0, 0.0, 0.0), (0.27, 0.0, 0.01), 0.05),)
    assert load_kinematics(ARM).bodies == ()


def test_each_tool_is_a_model_of_its_own_whose_last_link_carries_it(directory: Path) -> None:
    body = {"start": [0, 0, 0], "end": [0, 0, 0.3], "radius": 0.02}
    probe = {"name": "probe", "position": [0, 0, 0.3], "mass": 0.21, "centre": [0, 0, 0.145], "bodies": [body]}
    arm = load(rewritten(ARM, lambda data: data["kinematics"].update(tools=[{"name": "flange"}, probe])))  # type: ignore[attr-defined]
    bare, with_probe = arm.models
    assert arm.tool_names == ("flange", "probe")
    assert (bare.tool, bare.links) == (IDENTITY, load_kinematics(default_config()).links)
    assert with_probe.tool.position == (0.0, 0.0, 0.3)
    assert with_probe.links[5].mass == pytest.approx(0.070 + 0.21)
    assert with_probe.links[5].centre == pytest.approx((0.0, 0.0, (0.070 * -0.035 + 0.21 * 0.145) / 0.28))
    assert capsules(with_probe) == (*capsules(bare), Capsule(6, (0.0, 0.0, 0.0), (0.0, 0.0, 0.3), 0.02))
    assert capsules(with_every_tool(arm.models)) == capsules(with_probe)


def test_a_tool_has_a_mass_only_where_the_links_have(directory: Path) -> None:
    def change(data: dict[str, Any]) -> None:
        del data["kinematics"]["links"]
        data["kinematics"]["tools"] = [{"name": "probe", "mass": 0.2}]

    with pytest.raises(ConfigError, match=r"kinematics.tools\[0\].mass: found 0.2 beside links of unknown mass"):
        load_kinematics(rewritten(IRB, change))


def test_a_file_of_kinematics_alone_is_no_arm_to_start(directory: Path) -> None:
    with pytest.raises(ConfigError, match="the key joints is missing"):
        load(IRB)


def test_an_arm_starts_without_kinematics_too(directory: Path) -> None:
    whole = load(ARM)
    without = load(rewritten(ARM, without_kinematics))
    assert whole.arm is not None
    assert without == dataclasses.replace(whole, arm=None, cartesian=CartesianConfig())


# -- angles ------------------------------------------------------------------------------------------------------------


def test_angles_may_be_written_as_numbers_too(directory: Path) -> None:
    exact = load_kinematics(IRB)
    IRB.write_text(re.sub(r"[-+0-9*]*pi[/0-9]*", lambda text: repr(angle(text.group())), IRB.read_text()))
    assert "*pi" not in IRB.read_text()
    assert load_kinematics(IRB) == exact


# -- limits, masses, tool ----------------------------------------------------------------------------------------------


def test_mechanical_limits_may_stand_beside_the_joints_which_stay_the_limits(directory: Path) -> None:
    own = load_kinematics(ARM).limits
    ARM.write_text(ARM.read_text() + MECHANICAL)
    assert load_kinematics(ARM).limits == own


def test_a_speed_that_is_not_known_is_no_limit(directory: Path) -> None:
    IRB.write_text(IRB.read_text().replace(", velocity: 25*pi/18}", "}", 1))
    assert load_kinematics(IRB).limits[0].velocity == math.inf


def test_masses_may_be_left_out(directory: Path) -> None:
    assert load_kinematics(rewritten(IRB, lambda data: data["kinematics"].pop("links"))).links == ()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("written", "pose"),
    [
        ("{position: [0.1, 0.2, 0.3], rpy: [pi/2, 0, 0.5]}", Pose.from_xyzrpy(0.1, 0.2, 0.3, HALF, 0.0, 0.5)),
        ("{position: [0, 0, 0.1]}", Pose.from_xyzrpy(0, 0, 0.1, 0, 0, 0)),
        ("{rpy: [0, -pi/2, 0]}", Pose.from_xyzrpy(0, 0, 0, 0, -HALF, 0)),
        ("{}", Pose.from_xyzrpy(0, 0, 0, 0, 0, 0)),
    ],
)
def test_the_tool_is_a_position_and_three_angles(directory: Path, written: str, pose: Pose) -> None:
    for file in (ARM, IRB):
        file.write_text(file.read_text() + f"\n  tool: {written}\n")
        assert load_kinematics(file).tool == pose


# -- mistakes ----------------------------------------------------------------------------------------------------------


def test_limits_are_needed_where_no_joints_have_them(directory: Path) -> None:
    file = rewritten(IRB, lambda data: data["kinematics"].pop("limits"))  # type: ignore[attr-defined]
    assert_finds(lambda: load_kinematics(file), "kinematics: missing key=limits")


def test_an_arm_without_kinematics_says_so_when_it_is_asked_for_them(directory: Path) -> None:
    file = rewritten(ARM, without_kinematics)
    assert_finds(lambda: load_kinematics(file), "1 : missing key=kinematics")


def test_mistakes_in_the_kinematics_and_elsewhere_are_named_together(
    directory: Path, findings_after: Callable[..., list[Finding]]
) -> None:
    findings = findings_after(str(ARM), ("d: 0.140", "d: 140"), ("period_us: 500", "period_us: 5"))
    assert [finding.key for finding in findings] == ["cycle.period_us", "kinematics.dh[5].d"]
    assert [finding.key for finding in findings_of(lambda: load_kinematics(ARM))] == [
        finding.key for finding in findings
    ]
