"""How the arm is operated: what the shipped file says of it, and the sentence for each mistake."""

from __future__ import annotations

import itertools
import math
import random
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from kinematics.forward import frames
from rtcp.config import ConfigError, default_config, load, load_segment, segment_path
from rtcp.config.document import read
from rtcp.config.loader import with_control_mode
from rtcp.config.model import (
    ArmConfig,
    Box,
    CartesianConfig,
    EmergencyStopConfig,
    InputConfig,
    JogConfig,
    KeepOut,
    Kinematics,
    SupervisionConfig,
)
from rtcp.config.rules import shoulder_and_reach
from rtcp.config.validation import Checker
from rtcp.virtual.models import create

ARM = "assistive_arm.yaml"
TOOL_BOX = "{min: [-1.2, -1.0, -0.42], max: [0.8, 1.0, 1.4]}"
USER = "{name: user, min: [0.42, -0.35, -0.1], max: [1.1, 0.35, 0.85]}"
STICK = "joystick: {forward: 1, backward: 2, left: 3, right: 4, mode_up: 5, mode_down: 6, active: low, debounce_ms: 5}"
TOGGLE = "arm_toggle: {number: 9, active: high, debounce_ms: 5}"
WITHOUT_GEOMETRY = ("\nkinematics:\n" + default_config().read_text().split("\nkinematics:\n")[1], "")


def around(corners: str) -> tuple[str, str]:
    return USER, f"{{name: user, {corners}}}"


MISTAKES = {
    "a motion that there is not": (
        ("control_mode: joint", "control_mode: joints"),
        'control_mode: found the text "joints", allowed is one of joint, cartesian, joystick, velocity, torque',
    ),
    "a joystick motion without a stick": (
        ("control_mode: joint", "control_mode: joystick"),
        ("  " + STICK, ""),
        'control_mode: found the text "joystick", which needs a joystick: the key inputs.joystick is missing',
    ),
    "a cartesian motion without geometry": (
        ("control_mode: joint", "control_mode: cartesian"),
        WITHOUT_GEOMETRY,
        'control_mode: found the text "cartesian", which needs the arm\'s geometry: the key kinematics is missing',
    ),
    "a joystick motion without geometry": (
        ("control_mode: joint", "control_mode: joystick"),
        WITHOUT_GEOMETRY,
        'control_mode: found the text "joystick", which needs the arm\'s geometry: the key kinematics is missing',
    ),
    "a box without geometry": (
        WITHOUT_GEOMETRY,
        "cartesian.keep_out[0]: found a box, which needs the arm's geometry: the key kinematics is missing",
    ),
    "a tool that is too fast under manual control": (
        ("  speed: 0.25", "  speed: 0.5"),
        "cartesian.speed: found 0.5, allowed is a number greater than 0 and at most 0.25",
    ),
    "a corner of two numbers": (
        around("min: [0.42, -0.35], max: [1.1, 0.35, 0.85]"),
        "cartesian.keep_out[0].min: found a list of 2, allowed is a list of 3 numbers",
    ),
    "a corner of four numbers": (
        around("min: [0.42, -0.35, -0.1, 0], max: [1.1, 0.35, 0.85]"),
        "cartesian.keep_out[0].min: found a list of 4, allowed is a list of 3 numbers",
    ),
    "a corner of nothing": (
        around("min: [], max: [1.1, 0.35, 0.85]"),
        "cartesian.keep_out[0].min: found an empty list, allowed is a list of 3 numbers",
    ),
    "a corner in millimetres": (
        around("min: [420, -0.35, -0.1], max: [1100, 0.35, 0.85]"),
        "cartesian.keep_out[0].min[0]: found 420, allowed is a number from -100 to 100",
    ),
    "a box turned round": (
        around("min: [0.42, 0.35, -0.1], max: [1.1, -0.35, 0.85]"),
        "cartesian.keep_out[0]: found min 0.35 and max -0.35 in y; min must be less than max",
    ),
    "a box without height": (
        (TOOL_BOX, TOOL_BOX.replace("-0.42", "1.4")),
        "cartesian.box: found min 1.4 and max 1.4 in z; min must be less than max",
    ),
    "a box around the base": (
        around("min: [-0.1, -0.1, -0.1], max: [0.1, 0.1, 0.05]"),
        "cartesian.keep_out[0]: found a box around the arm's base, allowed is one beside it: "
        "the base is at (0, 0, 0), the shoulder at (0, 0, 0.17)",
    ),
    "a box around all that the arm reaches": (
        around("min: [-2, -2, -2], max: [2, 2, 2]"),
        "cartesian.keep_out[0]: found a box around the arm's base, allowed is one beside it: "
        "the base is at (0, 0, 0), the shoulder at (0, 0, 0.17)",
    ),
    "a box that the arm never meets": (
        around("min: [2, -0.35, 0], max: [3, 0.35, 0.85]"),
        "cartesian.keep_out[0]: found a box that begins 2.000 m from the shoulder, allowed is at most 1.130 m, "
        "the arm's reach: the arm never meets it",
    ),
    "a box that the tool is never in": (
        (TOOL_BOX, "{min: [-4, -1, 0], max: [-3, 1, 1]}"),
        "cartesian.box: found a box that begins 3.000 m from the shoulder, allowed is at most 1.130 m, "
        "the arm's reach: the tool is never inside",
    ),
    "a keep-out box around the tool's": (
        (TOOL_BOX, "{min: [0.5, -0.3, 0.1], max: [0.8, 0.3, 0.3]}"),
        "cartesian.keep_out[0]: found a box around all of cartesian.box: the tool has no place left",
    ),
    "two boxes of one name": (
        ("name: chair", "name: user"),
        'cartesian.keep_out[1].name: found the text "user", the name of cartesian.keep_out[0].name; each needs its own',
    ),
    "a negative distance to a singularity": (
        ("shoulder: 0.03", "shoulder: -0.03"),
        "cartesian.singularity.shoulder: found -0.03, allowed is a number of at least 0",
    ),
    "a stick that is faster than the tool may be": (
        ("  angular_speed: 0.3", "  angular_speed: 0.6"),
        "jog.angular_speed: this is 0.6, allowed is at most 0.5, cartesian.angular_speed",
    ),
    "a stick whose usual speed is faster": (
        ("  speed: 0.25 ", "  speed: 0.05 "),
        ("  speed: 0.1 ", "  # "),
        "jog.speed: this is 0.1, allowed is at most 0.05, cartesian.speed",
    ),
    "an unknown frame": (
        ("frame: base", "frame: flange"),
        'jog.frame: found the text "flange", allowed is one of base, tool',
    ),
    "a watch that trips at the limit's half": (
        ("  torque: 1.5 ", "  torque: 0.5 "),
        "supervision.torque: found 0.5, allowed is a number from 1 to 10",
    ),
    "a keep-out box with the name of the box that the tool stays in": (
        ("name: user", "name: box"),
        'cartesian.keep_out[0].name: found the text "box", which in the key of a limit means cartesian.box',
    ),
    "a keep-out box with the name of all joints": (
        ("name: user", "name: joints"),
        'cartesian.keep_out[0].name: found the text "joints", which in the key of a limit means all joints',
    ),
    "a keep-out box with the name of a joint": (
        ("name: chair", "name: joint2"),
        'cartesian.keep_out[1].name: found the text "joint2", which in the key of a limit means joints[1]',
    ),
    "a keep-out box with a dot in its name": (
        ("name: user", "name: user.min"),
        'cartesian.keep_out[0].name: found the text "user.min", allowed is one without a dot: dots separate '
        "the parts of a key",
    ),
    "a joint with the name of all of them": (
        ("name: joint3", "name: joints"),
        'joints[2].name: found the text "joints", which in the key of a limit means all joints',
    ),
    "two directions on one input": (
        ("left: 3", "left: 2"),
        "inputs.joystick.left: found 2, the input of inputs.joystick.backward; each needs its own",
    ),
    "a direction on another's usual input": (
        ("forward: 1, backward: 2", "forward: 2"),
        "inputs.joystick.backward: found 2, the input of inputs.joystick.forward; each needs its own",
    ),
    "an emergency stop on the stick": (
        ("emergency_stop: {number: 10", "emergency_stop: {number: 1"),
        "inputs.emergency_stop.number: found 1, the input of inputs.joystick.forward; each needs its own",
    ),
    "an input that no box has": (
        ("number: 10", "number: 17"),
        "inputs.emergency_stop.number: found 17, allowed is an integer from 1 to 16",
    ),
    "an input without a number": (
        (TOGGLE, "arm_toggle: {active: high}"),
        "inputs.arm_toggle: the key number is missing; it must be an integer from 1 to 16",
    ),
    "an emergency stop whose level nobody has said": (
        ("{number: 10, active: low", "{number: 10"),
        "inputs.emergency_stop: the key active is missing; it must be one of high, low",
    ),
    "a level that is none": (
        ("{number: 10, active: low", "{number: 10, active: closed"),
        'inputs.emergency_stop.active: found the text "closed", allowed is one of high, low',
    ),
    "a meaning that there is not": (
        (TOGGLE, TOGGLE.replace("arm_toggle", "toggle")),
        "inputs.toggle: this key does not exist; did you mean arm_toggle? allowed are joystick, arm_toggle, "
        "enabling_switch, emergency_stop",
    ),
    "a gripper on a lamp": (
        ("{output: 4", "{output: 2"),
        "gripper.output: found 2, the output of outputs.motion_lamp; each needs its own",
    ),
    "two lamps on one output": (
        ("motion_lamp: 2", "motion_lamp: 1"),
        "outputs.motion_lamp: found 1, the output of outputs.state_lamp; each needs its own",
    ),
    "terminals of a box that is not there": (
        ("  - {name: io, device: diewu-io}\n", ""),
        "inputs.emergency_stop.number: found input 10, but no slave is of kind io; leave it out for such an arm",
    ),
    "an output of a box that is not there": (
        ("  - {name: io, device: diewu-io}\n", ""),
        "outputs.heartbeat: found output 3, but no slave is of kind io; leave it out for such an arm",
    ),
}


@pytest.mark.parametrize("case", MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_named(problems_after: Callable[..., list[str]], case: tuple[tuple[str, str] | str, ...]) -> None:
    *changes, sentence = case
    problems = problems_after(ARM, *changes)
    assert sentence in [re.sub(r"^[^:]+:\d+: ", "", problem) for problem in problems]
    assert all(re.match(rf"{ARM}:\d+: ", problem) for problem in problems)


def test_one_mistake_gives_one_sentence_with_its_line(
    directory: Path, problems_after: Callable[..., list[str]]
) -> None:
    line = (directory / ARM).read_text().split(USER)[0].count("\n") + 1
    (problem,) = problems_after(ARM, around("min: [0.42, -0.35, 0.9], max: [1.1, 0.35, 0.85]"))
    wanted = "cartesian.keep_out[0]: found min 0.9 and max 0.85 in z; min must be less than max"
    assert problem == f"{ARM}:{line}: {wanted}"


def test_a_mistake_elsewhere_hides_none_of_these(problems_after: Callable[..., list[str]]) -> None:
    problems = problems_after(
        ARM,
        ("drive_mode: csp", "drive_mode: cps"),
        around("min: [2, 0, 0], max: [3, 1, 1]"),
        ("{output: 4", "{output: 1"),
    )
    assert [problem.split(": ")[1] for problem in problems] == ["drive_mode", "cartesian.keep_out[0]", "gripper.output"]


@pytest.mark.parametrize(
    "corners",
    [
        "min: [-1, -1, -0.5], max: [1, 1, -0.01]",
        "min: [-1, -1, 0.2], max: [1, 1, 0.3]",
        "min: [0.01, -1, -1], max: [1, 1, 1]",
        "min: [-1, -1, -1], max: [1, -0.01, 1]",
    ],
    ids=["a floor", "a shelf above the shoulder", "a wall", "a wall behind"],
)
def test_a_box_may_stand_close_to_the_base(directory: Path, corners: str) -> None:
    old, new = around(corners)
    Path(ARM).write_text(Path(ARM).read_text().replace(old, new))
    assert len(load(Path(ARM)).cartesian.keep_out) == 2


@pytest.mark.parametrize("key", ["control_mode", "cartesian", "jog", "supervision", "inputs", "outputs", "gripper"])
def test_each_part_may_be_left_out(directory: Path, key: str) -> None:
    data = yaml.safe_load(Path(ARM).read_text())
    del data[key]
    Path(ARM).write_text(yaml.safe_dump(data))
    fields = ArmConfig.__dataclass_fields__[key]
    default = fields.default_factory() if callable(fields.default_factory) else fields.default
    assert getattr(load(Path(ARM)), key) == default


def problems_of_loading() -> list[str]:
    try:
        load(Path(ARM))
    except ConfigError as error:
        return error.problems or ["no sentence"]
    return []


@pytest.mark.parametrize("value", [None, -1, 1e300, "x", [], [1, 2, 3], {"a": 1}, [{"min": []}], True], ids=repr)
def test_whatever_stands_in_these_parts_is_accepted_or_named(directory: Path, value: object) -> None:
    shipped = Path(ARM).read_text()
    for key, inner in (
        ("cartesian", None), ("cartesian", "box"), ("cartesian", "keep_out"), ("cartesian", "singularity"),
        ("jog", None), ("inputs", None), ("inputs", "joystick"), ("inputs", "arm_toggle"), ("outputs", None),
        ("gripper", None), ("gripper", "output"), ("gripper", "joint"), ("control_mode", None), ("supervision", None),
        ("kinematics", None), ("slaves", None),
    ):  # fmt: skip
        data = yaml.safe_load(shipped)
        if inner is None:
            data[key] = value
        else:
            data[key][inner] = value
        Path(ARM).write_text(yaml.safe_dump(data))
        assert all(re.match(r"[\w/.-]+:\d+: ", sentence) for sentence in problems_of_loading())


# -- what the shipped files say ----------------------------------------------------------------------------------------


def test_the_parts_are_read_into_their_dataclasses(directory: Path) -> None:
    text = (
        Path(ARM)
        .read_text()
        .replace("control_mode: joint ", "control_mode: joystick ")
        .replace("frame: base", "frame: tool")
    )
    Path(ARM).write_text(text.replace("# enabling_switch:", "enabling_switch:").replace("  cycles: 5", "  cycles: 7"))
    arm = load(Path(ARM))
    assert arm.control_mode == "joystick"
    assert arm.cartesian == CartesianConfig(
        box=Box((-1.2, -1.0, -0.42), (0.8, 1.0, 1.4)),
        keep_out=(
            KeepOut("user", (0.42, -0.35, -0.1), (1.1, 0.35, 0.85)),
            KeepOut("chair", (0.22, -0.6, -0.45), (1.2, 0.6, 0.25)),
        ),
    )
    assert arm.jog == JogConfig(frame="tool")
    assert arm.supervision == SupervisionConfig(cycles=7)
    assert arm.inputs.enabling_switch == InputConfig(11)
    assert arm.inputs.emergency_stop == EmergencyStopConfig(10, "low")


def test_the_geometry_is_the_one_of_the_kinematics_part() -> None:
    from rtcp.config import load_kinematics

    assert load(default_config()).arm == load_kinematics(default_config())


def test_the_configuration_is_read_without_numpy() -> None:
    code = "import sys, rtcp.config as c; c.load(c.default_config()); print('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def geometry_of(data: Any) -> Kinematics | None:
    return Checker(Kinematics).check(data["kinematics"])[0]


def inside(point: Sequence[float], box: Box | KeepOut) -> bool:
    return all(low <= c <= high for low, c, high in zip(box.min, point, box.max, strict=True))


def test_the_upright_pose_and_a_third_of_a_radian_around_it_are_free() -> None:
    arm = load(default_config())
    assert arm.arm is not None
    assert arm.cartesian.box is not None
    draw = random.Random(4)
    corners = itertools.product((-0.35, 0.0, 0.35), repeat=6)
    for q in itertools.chain(corners, ([draw.uniform(-0.35, 0.35) for _ in range(6)] for _ in range(2000))):
        _, _, elbow, _, wrist, _, tool = (pose.position for pose in frames(arm.arm, q))
        assert inside(tool, arm.cartesian.box)
        for box in arm.cartesian.keep_out:
            assert not any(inside(point, box) for point in (elbow, wrist, tool)), (q, box.name)


def test_a_pick_is_free_and_the_user_is_not() -> None:
    arm = load(default_config())
    assert arm.arm is not None
    picks = ([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0], [0.3, -0.6, 1.2, 0.0, 0.6, 0.0])
    for q in picks:
        _, _, elbow, _, wrist, _, tool = (pose.position for pose in frames(arm.arm, q))
        assert not any(inside(p, box) for p in (elbow, wrist, tool) for box in arm.cartesian.keep_out)
    tool = frames(arm.arm, [0.0, 0.0, -math.pi / 2, 0.0, 0.0, 0.0])[6].position
    assert inside(tool, arm.cartesian.keep_out[0])


def test_no_pose_of_the_arm_is_beyond_its_reach() -> None:
    part = geometry_of(read(default_config()).data)
    model = load(default_config()).arm
    assert part is not None
    assert model is not None
    shoulder, reach = shoulder_and_reach(part)
    draw = random.Random(5)
    assert math.dist(frames(model, [0.0] * 6)[6].position, shoulder) == pytest.approx(reach)
    for _ in range(300):
        found = frames(model, [draw.uniform(-3, 3) for _ in range(6)])
        assert found[0].position == pytest.approx(shoulder)
        assert max(math.dist(pose.position, shoulder) for pose in found) <= reach + 1e-9


def test_the_shoulder_is_found_also_where_the_base_is_tilted(directory: Path) -> None:
    data = yaml.safe_load(Path(ARM).read_text())
    data["kinematics"]["dh"][0].update(alpha=0.4, a=0.2)
    data["kinematics"]["tool"] = {"position": [0.0, 0.0, 0.1]}
    del data["cartesian"]
    Path(ARM).write_text(yaml.safe_dump(data))
    part, model = geometry_of(data), load(Path(ARM)).arm
    assert part is not None
    assert model is not None
    shoulder, reach = shoulder_and_reach(part)
    assert frames(model, [1.0, 0, 0, 0, 0, 0])[0].position == pytest.approx(shoulder)
    assert reach == pytest.approx(1.23)


# -- another motion at the start ---------------------------------------------------------------------------------------


def test_another_motion_is_checked_like_the_file(directory: Path) -> None:
    arm = load(Path(ARM))
    assert with_control_mode(arm, "joystick").control_mode == "joystick"
    data = yaml.safe_load(Path(ARM).read_text())
    del data["kinematics"], data["cartesian"], data["inputs"]["joystick"]
    Path(ARM).write_text(yaml.safe_dump(data))
    bare = load(Path(ARM))
    assert with_control_mode(bare, "velocity").control_mode == "velocity"
    with pytest.raises(ConfigError, match=r"^control_mode: .* needs the arm's geometry"):
        with_control_mode(bare, "cartesian")


# -- the virtual box ---------------------------------------------------------------------------------------------------


def test_at_power_on_the_virtual_arm_has_its_toggle_at_arm_and_its_emergency_stop_closed() -> None:
    arm = load(default_config())
    slave = load_segment(segment_path(arm)).slaves[0]
    levels = create(slave.model, **slave.options).inputs  # type: ignore[attr-defined]
    assert levels & 0xFF == 63

    def active(terminal: InputConfig | None) -> bool:
        assert terminal is not None
        return bool(levels >> terminal.number - 1 & 1) == (terminal.active == "high")

    assert active(arm.inputs.arm_toggle)
    assert not active(arm.inputs.emergency_stop)
