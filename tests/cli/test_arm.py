"""`rtcp arm`: fk, ik, plot, urdf, export-c, export-moveit."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

HOME = ("0", "0", "0", "0", "0", "0")
HALF = math.pi / 2
BRANCHES = {f"{s}/{e}/{w}" for s in ("front", "back") for e in ("up", "down") for w in ("flip", "no-flip")}
IRB = ("--arm", "abb_irb120")

Rtcp = Callable[..., Any]


@pytest.fixture
def arm_files(arm: Path) -> Path:
    """The folder of a copy of the default configuration."""
    return arm.parent


def texts(numbers: list[float]) -> list[str]:
    return [repr(number) for number in numbers]


def forward(rtcp: Rtcp, q: list[float], *options: str) -> list[float]:
    """Position and angles of the tool."""
    answer = json.loads(rtcp("arm", "fk", *texts(q), "--json", *options).out)
    return [*answer["position"], *answer["rpy"]]


# -- fk ----------------------------------------------------------------------------------------------------------------


def test_at_zero_the_arm_points_straight_up(rtcp: Rtcp) -> None:
    ended = rtcp("arm", "fk", *HOME, "--json")
    assert (ended.code, ended.err) == (0, "")
    answer = json.loads(ended.out)
    assert answer.keys() == {"position", "rpy"}
    assert answer["position"] == pytest.approx([0.0, 0.0, 1.3], abs=1e-12)
    assert answer["rpy"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_another_arm_is_chosen_by_its_name_or_its_file(rtcp: Rtcp, arm_files: Path) -> None:
    for name in ("abb_irb120", str(arm_files / "abb_irb120.yaml")):
        assert forward(rtcp, [0.0] * 6, "--arm", name) == pytest.approx([0.374, 0.0, 0.630, 0.0, HALF, 0.0], abs=1e-12)


def test_the_arm_is_that_of_the_platforms_configuration(
    rtcp: Rtcp, arm_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = arm_files / "assistive_arm.yaml"
    file.write_text(file.read_text().replace("d: 0.140}", "d: 0.240}"))
    monkeypatch.setenv("RTCP_CONFIG", str(file))
    assert forward(rtcp, [0.0] * 6)[2] == pytest.approx(1.4)


def test_angles_may_be_fractions_of_pi(rtcp: Rtcp) -> None:
    ended = rtcp("arm", "fk", "0", "-pi/2", "pi/2", "0", "-pi", "2*pi/3", "--json")
    position = json.loads(ended.out)["position"]
    assert position == forward(rtcp, [0.0, -HALF, HALF, 0.0, -math.pi, 2 * math.pi / 3])[:3]


def test_the_table_shows_every_frame_and_the_tool(rtcp: Rtcp) -> None:
    ended = rtcp("arm", "fk", "0", "0", "pi/2", "0", "0", "0")
    rows = {line.split()[0]: line.split()[1:] for line in ended.out.splitlines() if len(line.split()) == 7}
    assert rows.keys() == {"frame", *"123456", "tool"}
    assert rows["3"][:3] == ["0.000000", "0.000000", "0.610000"]
    assert rows["tool"] == ["-0.690000", "0.000000", "0.610000", "0.000000", "-1.570796", "0.000000"]
    assert "shoulder 0.55 m, elbow 1.57 rad, wrist 0 rad" in ended.out


def test_a_joint_outside_its_limits_is_named(rtcp: Rtcp) -> None:
    ended = rtcp("arm", "fk", "0", "0", "0", "0", "-2.5", "0")
    assert ended.code == 0
    assert "joint5 at -2.5 rad is outside its limits, -2 to 2" in ended.out
    assert "limits" not in rtcp("arm", "fk", *HOME).out


# -- ik ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arm", "q"),
    [((), [0.4, -0.6, 0.9, -0.5, 0.8, 1.1]), (IRB, [0.4, -0.3, 0.2, -0.5, 0.8, 1.1])],
    ids=["assistive", "irb120"],
)
def test_every_solution_leads_back_to_the_pose_and_one_is_where_it_came_from(
    rtcp: Rtcp, arm: tuple[str, ...], q: list[float]
) -> None:
    pose = forward(rtcp, q, *arm)
    ended = rtcp("arm", "ik", *texts(pose), "--json", *arm)
    assert (ended.code, ended.err) == (0, "")
    answer = json.loads(ended.out)
    assert answer.keys() == {"solutions", "reason"}
    assert answer["reason"] is None
    assert all(entry.keys() == {"q", "branch", "within_limits"} for entry in answer["solutions"])
    assert {entry["branch"] for entry in answer["solutions"]} == BRANCHES
    assert len(answer["solutions"]) == 8
    for entry in answer["solutions"]:
        assert forward(rtcp, entry["q"], *arm) == pytest.approx(pose, abs=1e-9)
    origin = [entry for entry in answer["solutions"] if entry["q"] == pytest.approx(q, abs=1e-9)]
    assert [entry["within_limits"] for entry in origin] == [True]


def test_the_table_shows_branch_joints_limits_and_distances(rtcp: Rtcp) -> None:
    ended = rtcp("arm", "ik", "0.3", "0", "0.5", "0", "pi", "0", *IRB)
    assert ended.code == 0
    first, second = ended.out.split("limits and distances to the singularities")
    rows = [line.split() for line in first.splitlines() if line[:1].isdigit()]
    assert {row[1] for row in rows} == BRANCHES
    assert [row[-1] for row in rows] == ["inside", *["outside"] * 7]
    assert all(len(row) == 9 and "…" not in "".join(row) for row in rows)
    far = [line.split() for line in second.splitlines() if line.split()[:1] and line.split()[0].isdigit()]
    assert far[0][:5] == ["1", "-", "0.3", "1.57", "1.38"]
    assert far[3][1:4] == ["q3,", "q4,", "q5"]


def test_no_solution_inside_the_limits_is_reported(rtcp: Rtcp, arm_files: Path) -> None:
    file = arm_files / "abb_irb120.yaml"
    file.write_text(file.read_text().replace("min: -2.87, max: 2.87", "min: -0.1, max: 0.1"))
    pose = ("0", "0.3", "0.5", "0", "pi", "0", "--arm", str(file))
    ended = rtcp("arm", "ik", *pose)
    assert ended.code == 0
    assert "no solution is inside the joints' limits" in ended.out
    assert not any(entry["within_limits"] for entry in json.loads(rtcp("arm", "ik", *pose, "--json").out)["solutions"])


def test_on_a_singularity_the_free_joints_stay_near_the_given_ones(rtcp: Rtcp) -> None:
    straight_up = ("0", "0", "1.3", "0", "0", "0")
    ended = rtcp("arm", "ik", *straight_up, "--json", "--near", "-0.3", "0", "0", "-.2", "0", "0")
    (solution,) = json.loads(ended.out)["solutions"]
    assert solution["q"] == pytest.approx([-0.3, 0.0, 0.0, -0.2, 0.0, 0.5], abs=1e-9)
    output = " ".join(rtcp("arm", "ik", *straight_up).out.split())
    assert "shoulder, elbow, wrist" in output


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_a_pose_out_of_reach_ends_with_3_and_says_by_how_much(rtcp: Rtcp, options: tuple[str, ...]) -> None:
    ended = rtcp("arm", "ik", "0", "0", "1.4", "0", "0", "0", *options)
    assert ended.code == 3
    assert ended.err.startswith("rtcp: out of reach by 0.1 m")
    if options:
        answer = json.loads(ended.out)
        assert answer["solutions"] == []
        assert answer["reason"] in ended.err
    else:
        assert ended.out == ""


UR5 = """
name: ur5
kinematics:
  dh:
    - {alpha: 0, a: 0, d: 0.089159}
    - {alpha: pi/2, a: 0, d: 0}
    - {alpha: 0, a: -0.425, d: 0}
    - {alpha: 0, a: -0.39225, d: 0.10915}
    - {alpha: pi/2, a: 0, d: 0.09465}
    - {alpha: -pi/2, a: 0, d: 0.0823}
  limits: [&all {min: -2*pi, max: 2*pi}, *all, *all, *all, *all, *all]
"""


def test_an_arm_without_a_spherical_wrist_has_one_solution_without_a_branch(rtcp: Rtcp, tmp_path: Path) -> None:
    arm = ("--arm", str(tmp_path / "ur5.yaml"))
    (tmp_path / "ur5.yaml").write_text(UR5)
    pose = forward(rtcp, [0.1, -1.0, 1.0, 0.3, 0.5, 0.2], *arm)
    (solution,) = json.loads(rtcp("arm", "ik", *texts(pose), "--json", *arm).out)["solutions"]
    assert solution["branch"] is None
    assert forward(rtcp, solution["q"], *arm) == pytest.approx(pose, abs=1e-8)
    last = rtcp("arm", "ik", *texts(pose), *arm).out.splitlines()[-1].split()
    assert last[:5] == ["1", "-", "-", "-", "-"]  # and the smallest singular value, which every arm has
    far = rtcp("arm", "ik", "5", "0", "0", "0", "0", "0", *arm)
    assert far.code == 3
    assert "the nearest configuration misses the pose by" in far.err


# -- bad usage ---------------------------------------------------------------------------------------------------------

WRONG = {
    "too few joints": (("fk", "1", "2"), "2 positions for an arm of 6 joints: give 6 numbers, rad"),
    "too many joints": (("plot", *["-0.1"] * 7), "7 positions for an arm of 6 joints: give 6 numbers, rad"),
    "half a pose": (("ik", "1", "-2", "3"), "3 numbers for a pose of 6: give X Y Z RX RY RZ"),
    "no number": (("fk", "0", "x", "0", "0", "0", "-1y"), "joint 2: 'x' is not a number (rad)"),
    "another wrong one": (("fk", "0", "x", "0", "0", "0", "-1y"), "joint 6: '-1y' is not a number (rad)"),
    "NaN": (("fk", "0", "0", "nan", "0", "0", "0"), "joint 3: nan is not finite; a finite number of rad is needed"),
    "an infinite height": (("ik", "0", "0", "-inf", "0", "0", "0"), "z: -inf is not finite; a finite number of m"),
    "a number too large": (("ik", "0", "0", "1", "0", "1e999", "0"), "ry: 1e999 is not finite"),
    "a length in pi": (("ik", "pi", "0", "1", "0", "0", "0"), "x: 'pi' is not a number (m)"),
    "an expression": (("fk", "0", "pi+1", "0", "0", "0", "0"), "joint 2: 'pi+1' is not a number (rad)"),
    "NaN in a picture": (("plot", "nan", "0", "0", "0", "0", "0"), "joint 1: nan is not finite"),
    "NaN for a free joint": (
        ("ik", "0", "0", "1.3", "0", "0", "0", "--near", "0", "0", "0", "-nan", "0", "0"),
        "--near, joint 4: -nan is not finite",
    ),
    "five free joints": (("ik", *HOME, "--near", "0", "0", "0", "0", "0"), "requires 6 arguments"),
    "a misspelt option": (("fk", *HOME, "--jsn"), "no such option: --jsn (did you mean --json?)"),
    "a misspelt option of ik": (("ik", "0", "-1", "0", "0", "0", "0", "--nera"), "did you mean --near?"),
    "a misspelt option of plot": (("plot", *HOME, "--outt", "a.png"), "did you mean --out?"),
    "an option behind the end of options": (("fk", "--", *HOME, "--json"), "--json is after --, which ends the"),
    "an unknown arm": (("fk", *HOME, "--arm", "abb_irb140"), "known are abb_irb120, abb_irb120_rapid, assistive_arm"),
    "a file that is not there": (("urdf", "--arm", "none.yaml"), "none.yaml, named by --arm, does not exist"),
    "a file of something else": (("fk", *HOME, "--arm", "segment"), "segment.yaml:"),
    "a picture of no kind": (("plot", *HOME, "--out", "arm.jpg"), "the ending must be one of .png, .svg, .pdf"),
    "a picture without ending": (("plot", *HOME, "--out", "arm"), "the ending must be one of .png, .svg, .pdf"),
    "a place that is not there": (("plot", *HOME, "--out", "none/arm.png"), "--out none/arm.png cannot be written"),
    "a URDF nowhere": (("urdf", "--out", "none/arm.urdf"), "--out none/arm.urdf cannot be written: No such file"),
    "a URDF over a directory": (("urdf", "--out", "."), "--out . cannot be written: Is a directory"),
    "C over a file": (
        ("export-c", "--out", "/dev/null"),
        "_kinematics.h cannot be written",
    ),
    "a number for export-c": (("export-c", "1"), "extra argument"),
    "a package over a file": (("export-moveit", "--out", "/dev/null"), "cannot be written: "),
    "a number for urdf": (("urdf", "1"), "extra argument"),
}


@pytest.mark.parametrize(("arguments", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_bad_usage_is_a_sentence_and_exit_code_2(
    rtcp: Rtcp, arguments: tuple[str, ...], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = rtcp("arm", *arguments)
    assert (ended.code, ended.out) == (2, "")
    assert sentence in ended.trouble
    assert "Traceback" not in ended.err
    assert not [path for path in tmp_path.iterdir() if path.is_file()]


def test_a_mistake_in_the_arms_file_is_named_with_its_place(rtcp: Rtcp, arm_files: Path) -> None:
    file = arm_files / "abb_irb120.yaml"
    file.write_text(file.read_text().replace("d: 0.290", "d: nothing"))
    line = file.read_text().split("d: nothing")[0].count("\n") + 1
    for command in (("fk", *HOME), ("ik", *HOME), ("plot", *HOME), ("urdf",)):
        ended = rtcp("arm", *command, "--arm", str(file))
        assert ended.code == 2
        assert ended.err.startswith(f"rtcp: {file}:{line}: kinematics.dh[0].d: found the text")


@pytest.mark.parametrize(
    "value", ["0", "-0.0", "1e-300", "-1e300", "1e308", "1_0", "٣", "0x10", "", " ", "-", "--", "pi/0"]
)
@pytest.mark.parametrize("command", ["fk", "ik"])
def test_whatever_is_given_ends_in_an_answer_or_a_sentence(rtcp: Rtcp, command: str, value: str) -> None:
    for place in (0, 5):
        numbers = ["0.1", "0.2", "0.5", "0.3", "-0.4", "0.6"]
        numbers[place] = value
        ended = rtcp("arm", command, *numbers, *IRB)
        assert ended.code in (0, 2, 3), ended.err
        assert bool(ended.err) == (ended.code != 0)
        assert "Traceback" not in ended.err


# -- plot --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [(), (("d: 0.290", "d: 0"), ("a: 0.270", "a: 0"), ("d: 0.302", "d: 0"))])
def test_a_picture_is_drawn_without_a_display_and_without_warnings(
    tmp_path: Path, arm_files: Path, changes: tuple[tuple[str, str], ...]
) -> None:
    file = arm_files / "abb_irb120.yaml"
    text = file.read_text() + "\n  tool: {position: [0, 0.05, 0.1], rpy: [0, pi/4, 0]}\n"
    for old, new in changes:
        text = text.replace(old, new)
    file.write_text(text)
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, "-W", "error::RuntimeWarning", "-m", "rtcp.cli", "arm", "plot", *HOME]
    done = subprocess.run(
        [*command, "--arm", str(file)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "wrote arm.png\n", "")
    assert (tmp_path / "arm.png").stat().st_size > 10_000


@pytest.mark.parametrize(("ending", "beginning"), [("png", b"\x89PNG\r\n"), ("svg", b"<?xml"), ("PDF", b"%PDF")])
def test_a_picture_has_the_format_of_its_ending(rtcp: Rtcp, tmp_path: Path, ending: str, beginning: bytes) -> None:
    out = tmp_path / f"arm.{ending}"
    ended = rtcp("arm", "plot", "0", "-0.5", "pi/3", "0", "0.5", "0", "--out", str(out))
    assert (ended.code, ended.err) == (0, "")
    assert ended.out == f"wrote {out}\n"
    assert out.read_bytes().startswith(beginning)


def test_a_picture_names_arm_joints_and_tool(rtcp: Rtcp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib as mpl

    monkeypatch.setitem(mpl.rcParams, "svg.fonttype", "none")  # leaves text as text
    out = tmp_path / "arm.svg"
    rtcp("arm", "plot", "0", "0", "0.25", "0", "0", "0", *IRB, "--out", str(out))
    text = "".join(ET.parse(out).getroot().itertext())
    assert "abb-irb120 at q = (0, 0, 0.25, 0, 0, 0) rad" in text
    x, y, z = forward(rtcp, [0.0, 0.0, 0.25, 0.0, 0.0, 0.0], *IRB)[:3]
    assert f"tool at ({x:.3f}, {y:.3f}, {z:.3f}) m" in text
    assert all(name in text for name in ("base", "1, 2", "4, 5", "6, tool", "from the side", "from above", "x, m"))


def test_every_facet_has_four_corners() -> None:
    from rtcp.cli.arm_plot import _ball, _tube

    start, end = _array([0.0, 0.0, 0.0]), _array([0.0, 0.1, 0.3])
    shapes = {facet.shape for facet in (*_tube(start, end, 0.02, closed=True), *_ball(end, 0.02))}
    assert shapes == {(4, 3)}  # matplotlib pads other facets with undefined corners


def test_only_a_picture_loads_what_draws_it() -> None:
    heavy = ("matplotlib", "numpy")
    program = (
        "import sys; from rtcp.cli.__main__ import main\n"
        "main(['arm', 'fk', *['0'] * 6]); main(['arm', 'ik', *['0.3'] * 6]); "
        f"main(['arm', 'urdf']); print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == "[]"


# -- urdf --------------------------------------------------------------------------------------------------------------


def test_the_urdf_goes_to_standard_output_or_into_a_file(rtcp: Rtcp, tmp_path: Path) -> None:
    out = tmp_path / "arm.urdf"
    ended = rtcp("arm", "urdf", "--out", str(out))
    assert (ended.code, ended.out) == (0, f"wrote {out}\n")
    assert rtcp("arm", "urdf").out == out.read_text()
    assert ET.parse(out).getroot().get("name") == "assistive-arm"


def test_the_urdf_has_the_limits_of_the_joints(rtcp: Rtcp, arm_files: Path) -> None:
    for options in ((), ("--arm", str(arm_files / "assistive_arm.yaml"))):
        limits = ET.fromstring(rtcp("arm", "urdf", *options).out).findall("joint/limit")
        rows = [[float(limit.get(key, "nan")) for key in ("lower", "upper", "velocity", "effort")] for limit in limits]
        assert rows[0] == [-3.1, 3.1, 0.5, 49.0]
        assert rows[5] == [-3.1, 3.1, 0.5, 7.7]
    irb = ET.fromstring(rtcp("arm", "urdf", *IRB).out).findall("joint/limit")
    assert float(irb[2].get("upper", "nan")) == 1.22


def _array(q: list[float]) -> Any:
    import numpy as np

    return np.array(q)


# -- range -------------------------------------------------------------------------------------------------------------


def test_the_range_of_the_irb_120_is_that_of_its_data_sheet(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'rtcp[plot]'")
    from rtcp.cli.arm_range import wrist_range
    from rtcp.config import find_arm
    from rtcp.config.loader import load_mechanics

    grid = wrist_range(load_mechanics(find_arm("abb_irb120")))
    # 3HAC035960-001: 580 mm before axis 1; the highest wrist is stretched out above axis 2, at 290 mm.
    assert grid[:, :, 0].max() == pytest.approx(0.580, abs=1e-3)
    assert grid[:, :, 1].max() == pytest.approx(0.290 + 0.270 + math.hypot(0.302, 0.070), abs=1e-3)


def test_a_picture_of_the_range_is_written(rtcp: Rtcp, tmp_path: Path) -> None:
    picture = tmp_path / "range.png"
    rtcp("arm", "range", *IRB, "--facing", "0.914", "--out", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
