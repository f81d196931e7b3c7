"""A gripper that a drive of its own moves: the axis after the joints, and the sentence for each mistake."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import GripperConfig, Joint, Range

ARM = "assistive_arm.yaml"
ON_AN_OUTPUT = 'gripper: {output: 4, closed: "on"}'
JOINT = (
    "{name: finger, slave: drive7, position: {min: -0.1, max: 1.5}, velocity: 1.0, acceleration: 4.0, jerk: 40.0, "
    "torque: 2.0}"
)
DRIVEN = f"gripper: {{joint: {JOINT}, open_position: 1.4, closed_position: 0.0}}"
SIXTH = "  - {name: drive6, device: cubemars-orh}\n"
SEVENTH = (SIXTH, SIXTH + SIXTH.replace("drive6", "drive7"))


def driven(old: str = "", new: str = "") -> tuple[tuple[str, str], ...]:
    """The changes that give the arm a gripper with a drive, with one thing in it replaced."""
    assert old in DRIVEN
    return SEVENTH, (ON_AN_OUTPUT, DRIVEN.replace(old, new, 1) if old else DRIVEN)


MISTAKES = {
    "neither": (
        ((ON_AN_OUTPUT, 'gripper: {closed: "on"}'),),
        "gripper: found neither output nor joint, allowed is one of them: a digital output, or a drive of its own",
    ),
    "both": (
        driven("{joint:", "{output: 4, joint:"),
        "gripper: found both output and joint, allowed is one of them: a digital output, or a drive of its own",
    ),
    "a position on an output": (
        ((ON_AN_OUTPUT, "gripper: {output: 4, open_position: 1.0}"),),
        "gripper.open_position: this key belongs to a gripper with a joint, not to one on an output",
    ),
    "a level of a drive": (
        driven("open_position", 'closed: "on", open_position'),
        "gripper.closed: this key belongs to a gripper on an output, not to one with a joint",
    ),
    "no place where it is open": (
        driven("open_position: 1.4, ", ""),
        "gripper: the key open_position is missing; it must be a number inside gripper.joint.position",
    ),
    "open beyond its range": (
        driven("1.4", "1.6"),
        "gripper.open_position: found 1.6, allowed is -0.1 to 1.5, gripper.joint.position",
    ),
    "closed beyond its range": (
        driven("closed_position: 0.0", "closed_position: -0.2"),
        "gripper.closed_position: found -0.2, allowed is -0.1 to 1.5, gripper.joint.position",
    ),
    "closed where it is open": (
        driven("closed_position: 0.0", "closed_position: 1.4"),
        "gripper.closed_position: found 1.4, the open_position; the two must differ",
    ),
    "the drive of a joint": (
        driven("drive7", "drive6"),
        'gripper.joint.slave: found the text "drive6", the slave of joints[5].slave; each needs its own',
    ),
    "the name of a joint": (
        driven("finger", "joint6"),
        'gripper.joint.name: found the text "joint6", the name of joints[5].name; each needs its own',
    ),
    "a slave that is none": (
        driven("drive7", "drive8"),
        'gripper.joint.slave: found the text "drive8", which is no slave; allowed are the names under slaves: '
        "io, drive1, drive2, drive3, drive4, drive5, drive6, drive7",
    ),
    "an empty range": (
        driven("min: -0.1", "min: 1.5"),
        "gripper.joint.position: found min 1.5 and max 1.5; min must be less than max",
    ),
    "a range beyond the wire": (
        driven("max: 1.5", "max: 300000"),
        "gripper.joint.position.max: found 300000, allowed is -214748 to 214748: "
        "target_position of Cubemars ORH is int32 with factor 0.0001",
    ),
    "a limit that is missing": (
        driven(", jerk: 40.0", ""),
        "gripper.joint: the key jerk is missing; it must be a number of at least 0.001",
    ),
}


@pytest.mark.parametrize(("changes", "sentence"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_named(
    problems_after: Callable[..., list[str]], changes: tuple[tuple[str, str], ...], sentence: str
) -> None:
    problems = problems_after(ARM, *changes)
    assert [re.sub(r"^[^:]+:\d+: ", "", problem) for problem in problems] == [sentence]


def test_the_grippers_joint_is_the_axis_after_the_arms(directory: Path) -> None:
    text = Path(ARM).read_text()
    for old, new in driven():
        text = text.replace(old, new)
    Path(ARM).write_text(text)
    arm = load(Path(ARM))
    finger = Joint("finger", "drive7", Range(-0.1, 1.5), 1.0, 4.0, 40.0, 2.0)
    assert arm.gripper == GripperConfig(joint=finger, open_position=1.4, closed_position=0.0)
    assert arm.axes == (*arm.joints, finger)
    assert len(arm.joints) == 6
    assert arm.arm == load(default_config()).arm


@pytest.mark.parametrize("gripper", ["", ON_AN_OUTPUT])
def test_without_a_drive_the_axes_are_the_joints(directory: Path, gripper: str) -> None:
    Path(ARM).write_text(Path(ARM).read_text().replace(ON_AN_OUTPUT, gripper))
    arm = load(Path(ARM))
    assert arm.axes == arm.joints


def test_there_is_room_for_ten_axes(directory: Path, problems_after: Callable[..., list[str]]) -> None:
    def joint(name: str, slave: str) -> str:
        return "\n  - " + JOINT.replace("finger", name).replace("drive7", slave)

    text = Path(ARM).read_text()
    more = "".join(joint(f"more{i}", f"more{i}") for i in range(4))
    slaves = "".join(f"  - {{name: more{i}, device: cubemars-orh}}\n" for i in range(5))
    kinematics = "\nkinematics:\n" + text.split("\nkinematics:\n")[1]
    text = text.replace("    cst_integral: 250\n", f"    cst_integral: 250{more}\n").replace(kinematics, "\n")
    text = text.split("\ncartesian:\n")[0] + "\njog:" + text.split("\njog:")[1]
    Path(ARM).write_text(text.replace(SEVENTH[0], SEVENTH[1] + slaves))
    assert len(load(Path(ARM)).axes) == 10
    (problem,) = problems_after(ARM, (ON_AN_OUTPUT, DRIVEN))
    assert problem.endswith("gripper.joint: found beside 10 joints, allowed are 10 in all")
    (problem,) = problems_after(ARM, (DRIVEN, ON_AN_OUTPUT), (more, more + joint("more4", "more4")))
    assert problem.endswith("joints: found a list of 11, allowed is a list of 1 to 10 entries")
