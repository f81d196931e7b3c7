"""The class that MoveIt loads, compiled against stand-ins of MoveIt 1 and 2 and driven through them."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from math import cos, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.cli.arm_moveit import moveit_package
from rtcp.config import find_arm, load_kinematics
from tests.moveit.solver import needs_cpp

HERE = Path(__file__).parent
SUCCESS, NO_IK_SOLUTION = 1, -31
OK, MULTIPLE_TIPS_NOT_SUPPORTED, EMPTY_TIP_POSES, NO_SOLUTION = 1, 4, 5, 8
Q = (0.5, 0.4, -0.9, 0.7, 0.8, -0.6)
SEED = (0.6, 0.35, -0.7, 0.85, 0.7, -0.55)
COMMON = (
    "moveit/kinematics_base/kinematics_base.h", "moveit/robot_model/robot_model.h", "moveit/robot_state/robot_state.h",
)  # fmt: skip
HEADERS = {
    1: (*COMMON, "geometry_msgs/Pose.h", "moveit_msgs/MoveItErrorCodes.h", "ros/console.h"),
    2: (
        *(f"{name}pp" for name in COMMON), "geometry_msgs/msg/pose.hpp", "moveit_msgs/msg/move_it_error_codes.hpp",
        "rclcpp/rclcpp.hpp",
    ),
}  # fmt: skip
"""Headers of MoveIt 1 and of MoveIt 2 that the class includes; each is a stand-in."""

pytestmark = needs_cpp


class Plugin:
    """The exported class of an arm in a program of its own, compiled against the stand-ins of one MoveIt."""

    def __init__(self, arm: str, moveit: int, folder: Path) -> None:
        self.model = load_kinematics(find_arm(arm))
        package = moveit_package(find_arm(arm))
        for name, text in package.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        for name in (*HEADERS[moveit], "pluginlib/class_list_macros.hpp"):
            (folder / "include" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "include" / name).write_text('#include "stand_in.hpp"\n')
        [solver] = folder.glob("src/*.c")
        subprocess.run(["cc", "-std=c99", "-O1", "-c", solver, "-o", folder / "solver.o"], check=True)
        options = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", f"-DSTAND_IN_MOVEIT={moveit}"]
        command = ["c++", *options, f"-I{folder / 'include'}", f"-I{HERE}", str(folder / "src/kinematics_plugin.cpp")]
        subprocess.run([*command, HERE / "driver.cpp", folder / "solver.o", "-o", folder / "driver"], check=True)
        self.folder = folder
        [self.urdf] = folder.glob("config/*.urdf")
        self.process = subprocess.Popen(
            [folder / "driver"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(folder / "log").open("w"),
            text=True,
        )

    def ask(self, *command: str | float | Sequence[float]) -> list[str]:
        """Send one command; values of sequences are flattened."""
        assert self.process.stdin
        assert self.process.stdout
        words = [str(word) for part in command for word in ([part] if isinstance(part, str | int | float) else part)]
        self.process.stdin.write(" ".join(words) + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().split()

    def numbers(self, *command: str | float | Sequence[float]) -> list[float]:
        return [float(word) for word in self.ask(*command)]

    def initialize(
        self, *, group: str = "manipulator", base: str = "base_link", tip: str = "tool0", change: str = ""
    ) -> bool:
        """Initialize with the model of the exported URDF, in which `change` (OLD NEW) is replaced."""
        text = self.urdf.read_text()
        if change:
            old, new = change.split(" -> ")
            assert old in text
            text = text.replace(old, new)
        model = self.folder / "model"
        model.write_text(chain_of(text))
        return self.ask("init", str(model), group, base, tip) == ["1"]


def chain_of(urdf: str) -> str:
    """The joints of a URDF as the stand-in of RobotModel reads them: name, child, revolute, origin (3x4)."""
    lines = []
    for joint in ET.fromstring(urdf).findall("joint"):
        origin, child = joint.find("origin"), joint.find("child")
        assert origin is not None
        assert child is not None
        x, y, z = map(float, origin.attrib["xyz"].split())
        roll, pitch, yaw = map(float, origin.attrib["rpy"].split())
        sr, cr, sp, cp, sy, cy = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        rows = (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y),
            (-sp, cp * sr, cp * cr, z),
        )
        numbers = " ".join(repr(value) for row in rows for value in row)
        lines.append(f"{joint.get('name')} {child.get('link')} {int(joint.get('type') == 'revolute')} {numbers}\n")
    return "".join(lines)


def message(pose: Pose) -> list[float]:
    """x y z qx qy qz qw."""
    matrix = np.reshape(pose.rotation, (3, 3))
    # the axis of the rotation is the eigenvector of 1; the symmetric matrix below has the quaternion as its largest
    (a, b, c), (d, e, f), (g, h, i) = matrix
    symmetric = [[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g],
                 [c + g, f + h, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]]  # fmt: skip
    return [*pose.position, *np.linalg.eigh(symmetric)[1][:, -1].tolist()]


def within(model: ArmModel, pose: Pose, seed: Sequence[float]) -> list[list[float]]:
    """The solutions inside the limits, at the turns nearest to the seed, nearest first: from `kinematics`."""
    solutions = []
    for solution in InverseKinematics(model).solve(pose, seed).solutions:
        choices = []
        for angle, near, limit in zip(solution.q, seed, model.limits, strict=True):
            turned = (angle + number * 2 * pi for number in range(-3, 4))
            allowed = [q for q in turned if limit.lower <= q <= limit.upper]
            choices.append(min(allowed, key=lambda q: abs(q - near), default=None))
        if None not in choices:
            solutions.append(choices)
    return sorted(solutions, key=lambda q: max(abs(a - b) for a, b in zip(q, seed, strict=True)))


@pytest.fixture(scope="module", params=[("assistive_arm", 2), ("abb_irb120", 1)], ids=["moveit2", "moveit1"])
def plugin(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plugin]:
    arm, moveit = request.param
    made = Plugin(arm, moveit, tmp_path_factory.mktemp("plugin"))
    yield made
    made.process.communicate()


@pytest.fixture
def ready(plugin: Plugin) -> Plugin:
    assert plugin.initialize()
    return plugin


def test_the_solution_nearest_to_the_seed_is_given(ready: Plugin) -> None:
    pose = forward(ready.model, Q)
    for seed in np.random.default_rng(0).uniform(-1.5, 1.5, (50, 6)).tolist():
        code, *q = ready.numbers("ik", message(pose), seed)
        assert code == SUCCESS
        assert q == pytest.approx(within(ready.model, pose, seed)[0], abs=1e-9)


def test_a_joint_turns_towards_the_seed_where_its_limits_allow(ready: Plugin) -> None:
    last = ready.model.limits[5].upper - 0.05
    pose = forward(ready.model, (*Q[:5], last))
    for seed6 in (last + 0.02, last - 2 * pi + 0.1):
        _, *q = ready.numbers("ik", message(pose), [*Q[:5], seed6])
        assert q == pytest.approx(within(ready.model, pose, [*Q[:5], seed6])[0], abs=1e-9)
        if ready.model.name == "abb-irb120":  # its joint 6 turns more than twice
            assert q[5] == pytest.approx(seed6, abs=0.2)


def test_all_solutions_are_inside_the_limits_and_sorted(ready: Plugin) -> None:
    pose = forward(ready.model, (0.5, 1.8, -0.9, 0.7, 0.8, -0.6))
    error, count, *values = ready.numbers("all", 1, message(pose), SEED)
    wanted = within(ready.model, pose, SEED)
    assert (error, count) == (OK, len(wanted))
    assert 1 < len(wanted) < len(InverseKinematics(ready.model).solve(pose).solutions)
    assert np.reshape(values, (-1, 6)) == pytest.approx(np.array(wanted), abs=1e-9)


def test_consistency_limits_bound_every_joint(ready: Plugin) -> None:
    pose, seed = forward(ready.model, Q), [angle + 0.1 for angle in Q]
    code, _, *q = ready.numbers("search", message(pose), seed, 0.11, -1)
    assert code == SUCCESS
    assert q == pytest.approx(Q, abs=1e-9)
    assert ready.numbers("search", message(pose), seed, 0.09, -1) == [NO_IK_SOLUTION, 0]


def test_the_callback_is_asked_until_one_solution_passes(ready: Plugin) -> None:
    pose = forward(ready.model, Q)
    wanted = within(ready.model, pose, SEED)
    assert len(wanted) > 1
    for rejected in range(len(wanted)):
        for form in (("search", -1), ("search", 10), ("vector", 10)):
            code, calls, *q = ready.numbers(form[0], message(pose), SEED, form[1], rejected)
            assert (code, calls) == (SUCCESS, rejected + 1)
            assert q == pytest.approx(wanted[rejected], abs=1e-9)
    assert ready.numbers("search", message(pose), SEED, -1, len(wanted)) == [NO_IK_SOLUTION, len(wanted)]


def test_the_callback_sees_only_what_is_consistent(ready: Plugin) -> None:
    code, calls = ready.numbers("search", message(forward(ready.model, Q)), Q, 0.01, 100)
    assert (code, calls) == (NO_IK_SOLUTION, 1)


def test_without_limits_and_callback_the_nearest_is_found(ready: Plugin) -> None:
    code, _, *q = ready.numbers("search", message(forward(ready.model, Q)), Q, -1, -1)
    assert code == SUCCESS
    assert q == pytest.approx(Q, abs=1e-9)


@pytest.mark.parametrize("pose", [(9.0, 0, 0, 0, 0, 0, 1), (0.3, 0, 0.4, 0, 0, 0, 0), (0.3, 0, 0.4, "nan", 0, 0, 1)])
def test_a_pose_without_solution_is_no_ik_solution(ready: Plugin, pose: Sequence[float]) -> None:
    """Out of reach, an orientation of zero, one that is no number."""
    assert ready.numbers("ik", pose, Q) == [NO_IK_SOLUTION]
    assert ready.numbers("search", pose, Q, -1, 0) == [NO_IK_SOLUTION, 0]
    assert ready.numbers("all", 1, pose, Q) == [NO_SOLUTION, 0]


def test_an_orientation_that_is_not_of_length_1_is_refused(ready: Plugin) -> None:
    x, y, z, *orientation = message(forward(ready.model, Q))
    for factor, code in ((1.0001, SUCCESS), (2.0, NO_IK_SOLUTION), (0.5, NO_IK_SOLUTION)):
        assert ready.numbers("ik", (x, y, z, *(factor * value for value in orientation)), Q)[0] == code


def test_one_pose_at_a_time_is_solved(ready: Plugin) -> None:
    pose = message(forward(ready.model, Q))
    assert ready.numbers("all", 0, Q) == [EMPTY_TIP_POSES, 0]
    assert ready.numbers("all", 2, pose, pose, Q) == [MULTIPLE_TIPS_NOT_SUPPORTED, 0]


def test_every_frame_is_computed_and_an_unknown_one_is_not(ready: Plugin) -> None:
    links = [*(f"link{number}" for number in range(1, 7)), "tool0"]
    assert ready.ask("names") == [*ready.model.joint_names, *links]
    for q in np.random.default_rng(1).uniform(-3, 3, (20, 6)).tolist():
        for link, pose in zip(links, frames(ready.model, q), strict=True):
            actual, wanted = ready.numbers("fk", link, q), message(pose)
            assert actual[:3] == pytest.approx(wanted[:3], abs=1e-12)
            assert abs(np.dot(actual[3:], wanted[3:])) == pytest.approx(1.0, abs=1e-12)
            assert sqrt(np.dot(actual[3:], actual[3:])) == pytest.approx(1.0, abs=1e-12)
    assert ready.ask("fk", "gripper", Q) == []


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"group": "gripper"}, "the joints of group gripper are not those"),
        ({"change": '"JOINT" -> "shoulder"'}, "the joints of group manipulator are not those"),
        ({"tip": "link6"}, "the only tip of group manipulator must be tool0"),
        ({"base": "world"}, "the base world is not a link"),
        ({"base": "link1"}, "relative to link1 is not the solver's"),
        ({"change": '0.27 -> 0.28'}, "the frame link3 relative to base_link is not the solver's"),
        ({"change": 'link="link5" -> link="wrist"'}, "the model has no link link5"),
    ],
)  # fmt: skip
def test_a_model_that_is_not_the_solvers_is_refused(plugin: Plugin, wrong: dict[str, str], reason: str) -> None:
    if wrong.get("change", "").startswith("0.27") and plugin.model.name != "abb-irb120":
        wrong = {"change": "0.44 -> 0.45"}
    if "change" in wrong:
        wrong = {"change": wrong["change"].replace("JOINT", plugin.model.joint_names[1])}
    assert not plugin.initialize(**wrong)
    assert reason in (plugin.folder / "log").read_text().splitlines()[-1]
    assert plugin.numbers("ik", message(forward(plugin.model, Q)), Q) == [NO_IK_SOLUTION]
