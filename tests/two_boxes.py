"""The default arm with two IO boxes: joystick, toggle and emergency stop on `io`, before the drives; enabling switch,
lamps and gripper on `desk`, behind them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from rtcp.config import default_config

SWITCH = 1
"""Input of the enabling switch at `desk`; a number may have a function at each box: at `io` it is the joystick's."""
_LAST_DRIVE = "  - {name: drive6, device: cubemars-orh}\n"


def two_boxes(directory: Path) -> Path:
    """Write the configuration into a directory, over the default one that may be there; return the arm's file."""
    shutil.copytree(default_config().parent, directory, dirs_exist_ok=True)
    return add_second_box(directory)


def add_second_box(directory: Path) -> Path:
    """Give the arm of a directory a second box; return its file."""
    arm, segment = directory / "assistive_arm.yaml", directory / "segment.yaml"
    text = arm.read_text()
    for old, new in (
        (_LAST_DRIVE, _LAST_DRIVE + "  - {name: desk, device: diewu-io}\n"),
        ("joystick: {forward", "joystick: {box: io, forward"),
        ("arm_toggle: {number", "arm_toggle: {box: io, number"),
        ("emergency_stop: {number", "emergency_stop: {box: io, number"),
        ("# enabling_switch: {number: 11", f"enabling_switch: {{box: desk, number: {SWITCH}"),
        ("outputs:\n", "outputs:\n  box: desk\n"),
        ("gripper: {output", "gripper: {box: desk, output"),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    arm.write_text(text)
    with segment.open("a") as file:
        file.write("  - {model: diewu-io, options: {inputs: 0}}\n")
    return arm
