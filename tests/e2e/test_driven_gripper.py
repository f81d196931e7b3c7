"""A gripper with a drive of its own, the seventh on the wire: opened and closed by the API, never outside its range."""

from __future__ import annotations

from pathlib import Path

import pytest

import rtcp
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import CUBEMARS, Platform
from tests.e2e.wire import BOX_OUT, COUNTS_PER_RAD, DRIVE, DRIVES, images

pytestmark = [pytest.mark.platform, CUBEMARS]

LOW, HIGH, OPEN, CLOSED = 0.0, 1.5, 1.4, 0.05
ENABLE_OPERATION = 0x0F
FINGER = (
    f"gripper: {{open_position: {OPEN}, closed_position: {CLOSED}, joint: {{name: finger, slave: drive7, "
    f"position: {{min: {LOW}, max: {HIGH}}}, velocity: 1, acceleration: 2, jerk: 20, torque: 7}}}}"
)


def add_gripper(directory: Path) -> None:
    """Put a seventh drive on the cable of the configuration in `directory`, and make it the gripper's."""
    arm, segment = directory / "assistive_arm.yaml", directory / "segment.yaml"
    text = arm.read_text()
    drive6, output = "  - {name: drive6, device: cubemars-orh}\n", 'gripper: {output: 4, closed: "on"}'
    assert drive6 in text
    assert output in text
    text = text.replace(drive6, drive6 + drive6.replace("drive6", "drive7"))
    arm.write_text(text.replace(output, FINGER))
    options = "options: {serial: 8, load_inertia: 0.02, initial_position: 0.5}"
    segment.write_text(f"{segment.read_text()}  - model: cubemars-orh40\n    {options}\n")


@pytest.mark.long("test_it_closes_and_opens_under_the_lease_and_reports_each_time_where_it_rests")
def test_a_driven_gripper_opens_and_closes_and_its_target_never_leaves_its_range(
    platform: Platform, tmp_path: Path
) -> None:
    platform.be_patient(2000)
    add_gripper(platform.directory / "config")
    platform.rtcp("start", "--detach")
    with platform.capture(tmp_path / "frames"), rtcp.connect("a test", control_socket(platform.directory)) as robot:
        robot.enable()
        rests = [robot.gripper(open=opens) for opens in (True, False)]
        robot.disable()
    assert [(rest.position, rest.holds) for rest in rests] == [
        (pytest.approx(OPEN), False),
        (pytest.approx(CLOSED), False),
    ]
    sent = (
        DRIVE.unpack_from(image, BOX_OUT + DRIVES * DRIVE.size) for _, image in images(tmp_path / "frames", leave=False)
    )
    targets = [position / COUNTS_PER_RAD for controlword, position, *_ in sent if controlword == ENABLE_OPERATION]
    assert targets[0] == pytest.approx(0.5, abs=1e-3)
    assert max(targets) == pytest.approx(OPEN, abs=1e-4)
    assert targets[-1] == pytest.approx(CLOSED, abs=1e-4)
    assert all(LOW <= target <= HIGH for target in targets)
