"""Arcs and blends on a real socket between real processes: the targets on the wire, by the arm's geometry."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from math import pi
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import rtcp
from kinematics.forward import forward, forward_batch
from rtcp.api import Robot, RtcpError
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

HERE = [0.0, -0.2, 2.0, 0.0, 1.0, 0.0]
PATH = """
speed: 0.1
path:
  - {q: [0, -0.2, 2, 0, 1, 0], by_joints: true}
  - {pose: [X, 0.1, Z, RX, RY, RZ], blend: 0.02}
  - {via: [X, 0.15, Z - 0.05], pose: [X, 0.1, Z - 0.1, RX, RY, RZ], blend: 0.02}
  - {q: [0, -0.2, 2, 0, 1, 0], by_joints: true, speed: 0.4}
"""


@pytest.fixture
def robot(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("a program", control_socket(enabled.directory)) as robot:
        robot.move_joints(HERE)
        yield robot


def places(feed: rtcp.Feed) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the tool's targets and their times, s, in answered cycles."""
    records, missing = feed.records()
    assert not missing
    answered = records[records["wkc"] == records["wkc_expected"]]
    arm = feed.config.arm
    assert arm is not None
    return forward_batch(arm, answered["sent_position"])[0], 1e-6 * feed.config.cycle.period_us * answered["cycle"]


def test_a_circle_is_one_motion_on_its_circle_and_at_its_speed(shared: Platform, robot: Robot) -> None:
    feed = rtcp.Feed(shared.directory)
    assert feed.config.arm is not None
    start = forward(feed.config.arm, HERE)
    x, y, z = start.position
    arrival = robot.move_arc([x, y + 0.1, z - 0.1], [x, y, z - 0.2, *start.rpy], angle=2 * pi, speed=0.1)
    assert arrival.positions == pytest.approx(HERE, abs=1e-3)
    sent, times = places(feed)
    feed.close()
    from_circle = np.hypot(np.linalg.norm(sent - (x, y, z - 0.1), axis=1) - 0.1, sent[:, 0] - x)
    assert from_circle.max() < 2e-4
    steps, lengths = np.diff(times), np.linalg.norm(np.diff(sent, axis=0), axis=1)
    travelled = np.cumsum(lengths)
    inside = (travelled > 0.03) & (travelled < travelled[-1] - 0.03) & (steps < 1.5 * np.median(steps))
    assert inside.sum() > 500
    speeds = lengths[inside] / steps[inside]
    assert np.quantile(speeds, [0.01, 0.99]) == pytest.approx(0.1, rel=0.02)


def test_a_halt_on_a_circle_stops_on_the_circle(shared: Platform, robot: Robot) -> None:
    feed = rtcp.Feed(shared.directory)
    assert feed.config.arm is not None
    start = forward(feed.config.arm, HERE)
    x, y, z = start.position
    with ThreadPoolExecutor(1) as pool:
        arc = pool.submit(robot.move_arc, [x, y + 0.1, z - 0.1], [x, y, z - 0.2, *start.rpy], 2 * pi, 0.1)
        with rtcp.connect("who halts", control_socket(shared.directory)) as other:
            while not arc.done() and np.linalg.norm(np.subtract(other.pose[:3], start.position)) < 0.03:
                time.sleep(0.02)
            other.halt()
        with pytest.raises(RtcpError):
            arc.result()
    sent, _ = places(feed)
    feed.close()
    assert np.abs(np.linalg.norm(sent - (x, y, z - 0.1), axis=1) - 0.1).max() < 2e-4
    assert np.linalg.norm(sent[-1] - start.position) > 0.02


def test_a_file_with_arcs_blends_and_joint_moves_runs_whole_or_not_at_all(
    shared: Platform, robot: Robot, tmp_path: Path
) -> None:
    feed = rtcp.Feed(shared.directory)
    assert feed.config.arm is not None
    start = forward(feed.config.arm, HERE)
    (x, _, z), (rx, ry, rz) = start.position, start.rpy
    text = PATH.replace("Z - 0.05", f"{z - 0.05}").replace("Z - 0.1", f"{z - 0.1}")
    for name, number in (("RX", rx), ("RY", ry), ("RZ", rz), ("X", x), ("Z", z)):
        text = text.replace(name, f"{number}")
    file = tmp_path / "path.yaml"
    file.write_text(text)
    preview = robot.preview(file=str(file))
    arrival = robot.run(str(file))
    assert arrival.duration_s == pytest.approx(preview.duration_s, rel=0.01)
    assert arrival.positions == pytest.approx(HERE, abs=1e-3)
    sent, _ = places(feed)
    corner = np.linalg.norm(sent - (x, 0.1, z - 0.1), axis=1).min()
    assert 0.001 < corner < 0.02
    file.write_text(text.replace("blend: 0.02", "blend: -1", 1))
    with pytest.raises(RtcpError, match=r"path\.yaml:5.*blend"):
        robot.run(str(file))
    before = robot.status().positions
    file.write_text(text.replace("speed: 0.4", "speed: 40"))
    with pytest.raises(RtcpError, match="stop 4: found a speed of 40 rad/s"):
        robot.run(str(file))
    assert robot.status().positions == pytest.approx(before, abs=1e-3)
    feed.close()


def test_lines_with_a_blend_have_no_rest_between_them(shared: Platform, robot: Robot) -> None:
    feed = rtcp.Feed(shared.directory)
    assert feed.config.arm is not None
    start = forward(feed.config.arm, HERE)
    x, y, z = start.position
    poses = [[x, y + dy, z + dz, *start.rpy] for dy, dz in ((0.1, 0.0), (0.1, -0.1), (0.0, -0.1))]
    blended = robot.move_line(poses, 0.1, blend=0.03)
    robot.move_joints(HERE)
    resting = robot.move_line(poses, 0.1)
    assert blended.duration_s is not None
    assert resting.duration_s is not None
    sent, _ = places(feed)
    near = np.linalg.norm(sent[: len(sent) // 3] - (x, y + 0.1, z), axis=1).min()
    assert 0.001 < near < 0.03
    assert blended.duration_s < resting.duration_s
    with pytest.raises(RtcpError, match="blend"):
        robot.move_line(poses, blend=-1.0)
    feed.close()


@pytest.mark.parametrize(
    ("axis", "amount", "options", "index", "moved"),
    [
        ("x", "10mm", [], 0, 0.01),
        ("z", "-0.02m", ["--tool"], None, 0.02),
        ("rz", "5deg", [], None, 0.0),
        ("joint2", "1deg", [], None, None),
        ("3", "-0.05rad", ["--speed", "0.2"], None, None),
    ],
)
def test_a_step_moves_along_or_about_one_axis(
    enabled: Platform, robot: Robot, axis: str, amount: str, options: list[str], index: int | None, moved: float | None
) -> None:
    feed = rtcp.Feed(enabled.directory)
    arm = feed.config.arm
    feed.close()
    assert arm is not None
    before = robot.status().commanded_positions
    enabled.rtcp("step", axis, amount, *options)
    after = robot.status().commanded_positions
    if moved is None:
        joint = 1 if axis == "joint2" else 2
        assert after[joint] - before[joint] == pytest.approx(pi / 180 if joint == 1 else -0.05, abs=1e-6)
        return
    shift = np.array(forward(arm, after).position) - forward(arm, before).position
    assert np.linalg.norm(shift) == pytest.approx(moved, abs=1e-5)
    if index is not None:
        assert shift[index] == pytest.approx(moved, abs=1e-5)


def test_the_command_line_runs_a_circle_and_refuses_what_is_none(enabled: Platform, robot: Robot) -> None:
    feed = rtcp.Feed(enabled.directory)
    assert feed.config.arm is not None
    start = forward(feed.config.arm, HERE)
    feed.close()
    x, y, z = start.position
    end = [str(number) for number in (x, y, z - 0.2, *start.rpy)]
    via = [str(number) for number in (x, y + 0.1, z - 0.1)]
    enabled.rtcp("arc", *end, "--via", *via, "--angle", "pi/2", "--speed", "0.2")
    assert forward(feed.config.arm, robot.status().commanded_positions).position == pytest.approx(
        (x, y + 0.1, z - 0.1), abs=1e-4
    )
    enabled.rtcp("arc", *end, "--via", *end[:3], check=3)
    for wrong in (("x", "10"), ("x", "1deg"), ("joint1", "1mm"), ("yaw", "1deg"), ("x", "nanmm")):
        enabled.rtcp("step", *wrong, check=2)
    with pytest.raises(RtcpError, match="offset: found 2 numbers"):
        robot.move_by([0.0, 0.1])


def test_a_program_is_planned_drawn_and_run(enabled: Platform, robot: Robot, tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "motion.md").read_text()
    text = next(block for block in page.split("```yaml\n")[1:] if "parts:" in block).split("```")[0]
    file, picture = tmp_path / "program.yaml", tmp_path / "way.png"
    file.write_text("".join(line for line in text.splitlines(True) if "wait_for" not in line and "output" not in line))
    before = robot.status().commanded_positions
    planned = enabled.rtcp("run", str(file), "--dry", "--picture", str(picture))
    assert "nothing has moved" in planned.stdout
    assert picture.stat().st_size > 10_000
    assert robot.status().commanded_positions == before
    feed = rtcp.Feed(enabled.directory)
    said = enabled.rtcp("run", str(file)).stdout
    assert "program.yaml:16: 3 motions in one" in said
    assert said.rstrip().endswith("the program is complete")
    sent, _ = places(feed)
    feed.close()
    assert np.ptp(sent[:, 1]) > 0.13
    assert robot.status().commanded_positions == pytest.approx(HERE, abs=1e-6)
    file.write_text(text.replace("pose: [-0.66, 0.1, 0.23", "pose: [-3, 0.1, 0.23"))
    refused = enabled.rtcp("run", str(file), check=3)
    assert f"{file}:" in refused.stderr
    assert robot.status().commanded_positions == pytest.approx(HERE, abs=1e-6)
    assert enabled.rtcp("run", "--schema").stdout.startswith("{")
    with pytest.raises(RtcpError, match="holds a program"):
        robot.run(str(file))
