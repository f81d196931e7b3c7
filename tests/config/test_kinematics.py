"""The `kinematics:` part of an arm's file: what it says, and the sentence for each mistake in it."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from kinematics.forward import forward, frames
from kinematics.model import DhRow, JointLimit
from kinematics.pose import IDENTITY, Pose
from rtcp.config import ConfigError, default_config, find, find_arm, load, load_kinematics
from rtcp.config.model import CartesianConfig
from rtcp.config.numbers import angle

ARM, IRB = Path("assistive_arm.yaml"), Path("abb_irb120.yaml")
ROW1 = "{alpha: 0, a: 0, d: 0.290}"
LIMIT1 = "{min: -11*pi/12, max: 11*pi/12, velocity: 25*pi/18}"
LINK1 = "{mass: 3.067, centre: [0.0000977, -0.00012, -0.05159]}"
MECHANICAL = "\n  limits:\n" + "    - {min: -pi, max: pi, velocity: 1.0}\n" * 6
HALF = math.pi / 2


@pytest.fixture
def problems_of(directory: Path) -> Callable[..., list[str]]:
    """Put `new` for the first `old` of a file, read its kinematics and return the sentences without their place."""

    def spoil(file: Path, *changes: tuple[str, str]) -> list[str]:
        text = file.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        file.write_text(text)
        with pytest.raises(ConfigError) as caught:
            load_kinematics(file)
        assert all(re.match(rf"{file}:\d+: ", problem) for problem in caught.value.problems)
        return [problem.split(": ", 1)[1] for problem in caught.value.problems]

    return spoil


def rewritten(file: Path, change: Callable[[dict[str, object]], object]) -> Path:
    """The file with its values changed; comments and layout are lost."""
    data = yaml.safe_load(file.read_text())
    change(data)
    file.write_text(yaml.safe_dump(data))
    return file


def without_kinematics(data: dict[str, object]) -> None:
    """Take away the geometry, and with it the boxes, which need it."""
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
    limits = load_kinematics(default_config().parent / "abb_irb120.yaml").limits
    degrees = [tuple(round(math.degrees(v), 9) for v in (one.lower, one.upper, one.velocity)) for one in limits]
    assert degrees == [
        (-165, 165, 250), (-110, 110, 250), (-110, 70, 250), (-160, 160, 320), (-120, 120, 320), (-400, 400, 420),
    ]  # fmt: skip


def test_a_file_of_kinematics_alone_is_no_arm_to_start(directory: Path) -> None:
    with pytest.raises(ConfigError, match="the key joints is missing"):
        load(IRB)


def test_an_arm_starts_without_kinematics_too(directory: Path) -> None:
    whole = load(ARM)
    without = load(rewritten(ARM, without_kinematics))
    assert whole.arm is not None
    assert without == dataclasses.replace(whole, arm=None, cartesian=CartesianConfig())


def test_kinematics_and_configuration_load_without_numpy() -> None:
    reading = "rtcp.config.load_kinematics(rtcp.config.default_config())"
    code = f"import sys, rtcp.config; {reading}; print('numpy' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False\n"


# -- angles ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("written", "number"),
    [
        ("pi", math.pi), ("-pi", -math.pi), ("+pi", math.pi), ("pi/2", math.pi / 2), ("-pi/2", -math.pi / 2),
        ("pi/4", math.pi / 4), ("3*pi/4", 3 * math.pi / 4), ("-11*pi/12", -math.radians(165)), ("2*pi", math.tau),
    ],
)  # fmt: skip
def test_a_fraction_of_pi_is_that_number(written: str, number: float) -> None:
    assert angle(written) == number


@pytest.mark.parametrize(
    "written",
    ["", "PI", "Pi", "pi ", " pi", "- pi", "--pi", "pi/0", "pi/-2", "0*pi", "pi*2", "pi/2/2", "pi+1", "2pi", "1.5*pi",
     "pi/2.0", "9999999*pi", "pi/9999999", "e", "math.pi", "__import__('os')", "pi\n", "π", "1١*pi"],
)  # fmt: skip
def test_any_other_text_is_no_angle(written: str) -> None:
    assert angle(written) == written


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

TURN = "a number from -6.28319 to 6.28319, or a fraction of pi, as -pi/2 or 11*pi/12"
DEGREES = "; angles are in rad: write 90 degrees as pi/2"

MISTAKES = {
    "an expression for an angle": (
        IRB,
        ("alpha: -pi/2", "alpha: pi*2"),
        f'kinematics.dh[1].alpha: found the text "pi*2", allowed is {TURN}',
    ),
    "an angle with its unit": (
        IRB,
        ("alpha: -pi/2", "alpha: -90 deg"),
        f'kinematics.dh[1].alpha: found the text "-90 deg", allowed is {TURN}; '
        "write the number alone, the key names its unit",
    ),
    "an angle in degrees": (
        IRB,
        ("alpha: -pi/2", "alpha: -90"),
        f"kinematics.dh[1].alpha: found -90, allowed is {TURN}{DEGREES}",
    ),
    "a tool turned by degrees": (
        IRB,
        ("kinematics:\n", "kinematics:\n  tool: {rpy: [0, 180, 0]}\n"),
        f"kinematics.tool.rpy[1]: found 180, allowed is {TURN}{DEGREES}",
    ),
    "no number for an angle": (
        IRB,
        ("alpha: -pi/2", "alpha: .nan"),
        f"kinematics.dh[1].alpha: found nan, allowed is {TURN}{DEGREES}",
    ),
    "an infinite length": (
        IRB,
        ("d: 0.290", "d: .inf"),
        "kinematics.dh[0].d: found inf, allowed is a number from -100 to 100",
    ),
    "a length in millimetres": (
        IRB,
        ("d: 0.290", "d: 290"),
        "kinematics.dh[0].d: found 290, allowed is a number from -100 to 100",
    ),
    "a length in pi": (
        IRB,
        ("d: 0.290", "d: pi"),
        'kinematics.dh[0].d: found the text "pi", allowed is a number from -100 to 100',
    ),
    "a row without its length": (
        IRB,
        (ROW1, "{alpha: 0, d: 0.290}"),
        "kinematics.dh[0]: the key a is missing; it must be a number from -100 to 100",
    ),
    "a row with a key of another convention": (
        IRB,
        (ROW1, "{alpha: 0, a: 0, d: 0.290, theta: 0}"),
        "kinematics.dh[0].theta: this key does not exist; allowed are alpha, a, d, offset",
    ),
    "five rows": (
        IRB,
        (f"    - {ROW1}\n", ""),
        "kinematics.dh: found a list of 5, allowed is a list of 6 entries",
    ),
    "seven rows": (
        ARM,
        ("    - {alpha: pi/2, a: 0, d: 0.140}\n", "    - {alpha: pi/2, a: 0, d: 0.140}\n" * 2),
        "kinematics.dh: found a list of 7, allowed is a list of 6 entries",
    ),
    "five limits": (
        IRB,
        (f"    - {LIMIT1}", "    #"),
        "kinematics.limits: found a list of 5, allowed is a list of 6 entries",
    ),
    "five masses": (
        IRB,
        (f"    - {LINK1}", "    #"),
        "kinematics.links: found a list of 5, allowed is a list of 6 entries",
    ),
    "min above max": (
        IRB,
        (LIMIT1, "{min: pi/2, max: -pi/2}"),
        "kinematics.limits[0]: found min 1.5708 and max -1.5708; min must be less than max",
    ),
    "a speed of nothing": (
        IRB,
        (LIMIT1, "{min: -1, max: 1, velocity: 0}"),
        "kinematics.limits[0].velocity: found 0, allowed is a number greater than 0, "
        "or a fraction of pi, as -pi/2 or 11*pi/12",
    ),
    "a negative mass": (
        IRB,
        ("mass: 3.067", "mass: -3.067"),
        "kinematics.links[0].mass: found -3.067, allowed is a number of at least 0",
    ),
    "a centre in a plane": (
        IRB,
        ("[0.0000977, -0.00012, -0.05159]", "[0.0000977, -0.00012]"),
        "kinematics.links[0].centre: found a list of 2, allowed is a list of 3 numbers",
    ),
    "a tool with a quaternion": (
        IRB,
        ("kinematics:\n", "kinematics:\n  tool: {rpy: [0, 0, 0, 1]}\n"),
        "kinematics.tool.rpy: found a list of 4, allowed is a list of 3 numbers",
    ),
    "a list for the kinematics": (
        IRB,
        ("kinematics:\n", "kinematics: []\nother:\n"),
        "kinematics: found an empty list, allowed is a mapping with the keys dh, limits, links, tool",
    ),
    "an unknown key beside it": (
        IRB,
        ("name: abb-irb120", "name: abb-irb120\npayload: 3"),
        "payload: this key does not exist; allowed are name, kinematics",
    ),
    "a joint beyond its mechanics": (
        ARM,
        ("kinematics:\n", "kinematics:" + MECHANICAL.replace("max: pi", "max: 3.0", 1)),
        "joints[0].position.max: found 3.1, allowed is at most 3, the joint's mechanical end in kinematics.limits[0]",
    ),
    "a joint beyond the lower end": (
        ARM,
        ("kinematics:\n", "kinematics:" + MECHANICAL.replace("min: -pi", "min: -pi/2", 1)),
        "joints[0].position.min: found -3.1, allowed is at least -1.5708, the joint's mechanical end in "
        "kinematics.limits[0]",
    ),
    "a joint faster than its mechanics": (
        ARM,
        ("kinematics:\n", "kinematics:" + MECHANICAL.replace("velocity: 1.0", "velocity: 0.25", 1)),
        "joints[0].velocity: found 0.5, allowed is at most 0.25, the velocity in kinematics.limits[0]",
    ),
}


@pytest.mark.parametrize(("file", "change", "sentence"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_in_the_kinematics_is_named(
    problems_of: Callable[..., list[str]], file: Path, change: tuple[str, str], sentence: str
) -> None:
    assert sentence in problems_of(file, change)


def test_the_start_of_the_platform_names_them_too(problems_after: Callable[..., list[str]]) -> None:
    problems = problems_after(str(ARM), ("d: 0.140", "d: 140"), ("period_us: 500", "period_us: 5"))
    assert [problem.split(": ")[1] for problem in problems] == ["cycle.period_us", "kinematics.dh[5].d"]


def test_an_arm_of_another_number_of_joints_has_no_kinematics(directory: Path) -> None:
    file = rewritten(ARM, lambda data: data["joints"].pop())  # type: ignore[attr-defined]
    with pytest.raises(ConfigError) as caught:
        load_kinematics(file)
    (problem,) = caught.value.problems
    assert problem.endswith("kinematics: found beside 5 joints, allowed are 6; leave it out for such an arm")
    assert len(load(rewritten(file, without_kinematics)).joints) == 5


def test_limits_are_needed_where_no_joints_have_them(directory: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_kinematics(rewritten(IRB, lambda data: data["kinematics"].pop("limits")))  # type: ignore[attr-defined]
    (problem,) = caught.value.problems
    wanted = "in a file without joints it must be a list of 6 mappings with the keys min, max, velocity"
    assert problem.endswith(f"kinematics: the key limits is missing; {wanted}")


def test_an_arm_without_kinematics_says_so_when_it_is_asked_for_them(directory: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_kinematics(rewritten(ARM, without_kinematics))
    wanted = "it must be a mapping with the keys dh, limits, links, tool"
    assert caught.value.problems == [f"{ARM}:1: the key kinematics is missing; {wanted}"]


def test_a_mistake_elsewhere_in_a_whole_arm_is_named_too(problems_of: Callable[..., list[str]]) -> None:
    (problem,) = problems_of(ARM, ("drive_mode: csp", "drive_mode: cps"))
    assert problem == 'drive_mode: found the text "cps", allowed is one of csp, csv, cst'


def problems_of_reading() -> list[str]:
    try:
        load_kinematics(IRB)
    except ConfigError as error:
        return error.problems or ["no sentence"]
    return []


def places(node: object, where: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    if where:
        yield where
    for key, value in node.items() if isinstance(node, dict) else enumerate(node[:1] if isinstance(node, list) else ()):
        yield from places(value, (*where, key))


@pytest.mark.parametrize("value", [None, -1, 1e300, "x", "pi", [], [1, 2, 3], {"a": 1}, True], ids=repr)
def test_whatever_stands_in_whatever_place_is_accepted_or_named(directory: Path, value: object) -> None:
    shipped = yaml.safe_load(IRB.read_text())
    shipped["kinematics"]["tool"] = {"position": [0, 0, 0.1], "rpy": [0, 0, 0]}
    for where in places(shipped):
        spoilt = copy.deepcopy(shipped)
        node = spoilt
        for key in where[:-1]:
            node = node[key]
        node[where[-1]] = value
        IRB.write_text(yaml.safe_dump(spoilt))
        assert all(re.match(rf"{IRB}:\d+: ", sentence) for sentence in problems_of_reading())


# -- which arm ---------------------------------------------------------------------------------------------------------


def test_without_a_name_the_arm_is_that_of_the_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RTCP_CONFIG", str(default_config()))
    assert find_arm() == default_config()


@pytest.mark.parametrize("name", ["abb_irb120", "assistive_arm"])
def test_a_bare_name_is_a_file_beside_the_default(name: str) -> None:
    assert find_arm(name) == default_config().parent / f"{name}.yaml"


def test_a_path_is_a_path_also_without_an_ending(directory: Path) -> None:
    Path("mine").write_bytes(IRB.read_bytes())
    assert find_arm("mine") == Path("mine")
    assert find_arm("./abb_irb120.yaml") == Path("abb_irb120.yaml")


@pytest.mark.parametrize("given", ["none.yaml", "./none", "none/arm", "/none"])
def test_a_path_that_leads_nowhere_is_named(directory: Path, given: str) -> None:
    with pytest.raises(ConfigError, match="named by --arm, does not exist"):
        find_arm(given)


def test_an_unknown_name_is_answered_with_the_known_ones(directory: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        find_arm("abb_irb140")
    wanted = "there is no such file, and no arm of this name; known are abb_irb120, assistive_arm"
    assert caught.value.problems == [f"--arm abb_irb140: {wanted}"]


def test_kinematics_beside_it_do_not_disturb_the_search_for_the_arms_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RTCP_CONFIG", raising=False)
    monkeypatch.setattr(find, "SYSTEM", Path("/nonexistent/assistive_arm.yaml"))
    assert find.find_config().name == "assistive_arm.yaml"
