"""Arcs and programs on a real socket between real processes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from math import pi
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import rtcp
from kinematics.forward import forward, forward_batch
from rtcp.api import Robot, RtcpError, State
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform
from tests.waiting import HANG_S, until

pytestmark = pytest.mark.platform

HERE = [0.0, -0.2, 2.0, 0.0, 1.0, 0.0]


@pytest.fixture
def robot(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("a program", control_socket(enabled.directory)) as robot:
        robot.move_joints(HERE)
        yield robot


def places(feed: rtcp.Feed) -> npt.NDArray[np.float64]:
    """Return the tool's targets in answered cycles, m."""
    records, missing = feed.records()
    assert not missing
    answered = records[records["wkc"] == records["wkc_expected"]]
    arm = feed.config.arm
    assert arm is not None
    return forward_batch(arm, answered["sent_position"])[0]


def test_a_halt_on_a_circle_stops_on_the_circle(shared: Platform, robot: Robot) -> None:
    feed = rtcp.Feed(shared.directory)
    assert feed.config.arm is not None
    start = forward(feed.config.arm, HERE)
    x, y, z = start.position
    with ThreadPoolExecutor(1) as pool:
        arc = pool.submit(robot.move_arc, [x, y + 0.1, z - 0.1], [x, y, z - 0.2, *start.rpy], 2 * pi, 0.1)
        with rtcp.connect("who halts", control_socket(shared.directory)) as other:
            until(
                lambda: arc.done() or np.linalg.norm(np.subtract(other.pose[:3], start.position)) > 0.03,
                "a part of the way",
            )
            other.halt()
        with pytest.raises(RtcpError):
            arc.result()
    sent = places(feed)
    feed.close()
    assert np.abs(np.linalg.norm(sent - (x, y, z - 0.1), axis=1) - 0.1).max() < 2e-4
    assert np.linalg.norm(sent[-1] - start.position) > 0.02


def test_a_program_is_planned_drawn_and_run(enabled: Platform, robot: Robot, tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "motion.md").read_text()
    text = next(block for block in page.split("```yaml\n")[1:] if "parts:" in block).split("```")[0]
    file, picture = tmp_path / "program.yaml", tmp_path / "way.png"
    file.write_text("".join(line for line in text.splitlines(True) if "wait_for" not in line and "output" not in line))
    file.write_text(file.read_text().replace("times: 3", "times: 1"))
    before = robot.status().commanded_positions
    planned = enabled.rtcp("run", str(file), "--dry", "--picture", str(picture))
    assert "nothing has moved" in planned.stdout
    assert picture.stat().st_size > 10_000
    assert robot.status().commanded_positions == before
    feed = rtcp.Feed(enabled.directory)
    said = enabled.rtcp("run", str(file)).stdout
    assert "program.yaml:16: 3 motions in one" in said
    assert said.rstrip().endswith("the program is complete")
    sent = places(feed)
    feed.close()
    assert np.ptp(sent[:, 1]) > 0.13
    assert robot.status().commanded_positions == pytest.approx(HERE, abs=1e-6)
    assert enabled.rtcp("run", "--schema").stdout.startswith("{")
    with pytest.raises(RtcpError, match="holds a program"):
        robot.run(str(file))


def test_a_program_taught_at_the_command_line_runs_from_there_and_from_python(
    enabled: Platform, tmp_path: Path
) -> None:
    file = tmp_path / "taught.yaml"
    with rtcp.connect("who teaches", control_socket(enabled.directory)) as robot:
        robot.move_joints(HERE)
        enabled.rtcp("teach", str(file), "here", "--step", "move", "--speed", "0.4")
        robot.move_by([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
        enabled.rtcp("teach", str(file), "right", "--pose", "--step", "line", "--blend", "0.02")
        robot.move_by([0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
        assert robot.pose is not None
        below = robot.pose
        enabled.rtcp("teach", str(file), "below", "--pose", "--step", "line")
        robot.move_joints(HERE)
        said = enabled.rtcp("run", str(file)).stdout
        assert "2 motions in one" in said
        assert robot.pose == pytest.approx(below, abs=1e-3)
        robot.move_joints(HERE)
        rtcp.Program(file).run(robot, start=1)
        assert robot.pose == pytest.approx(below, abs=1e-3)
        enabled.rtcp("run", str(file), "--from", "4", check=2)


def test_cancelled_from_asyncio_a_program_stops_the_arm(enabled: Platform, tmp_path: Path) -> None:
    taught = rtcp.ProgramFile(tmp_path / "taught.yaml")
    taught.keep("here", q=HERE)
    taught.keep("there", q=[0.9, *HERE[1:]])
    taught.insert(0, {"move": "there", "speed": 0.1})
    taught.insert(0, {"move": "here"})
    begun: list[rtcp.api.program.Begun] = []

    async def run() -> None:
        async with rtcp.connect_async("who runs", control_socket(enabled.directory)) as robot:
            program = rtcp.Program(taught.path)
            running = asyncio.create_task(robot.in_thread(lambda synchronous: program.run(synchronous, begun.append)))
            while len(begun) < 2 or await robot.state() is not State.MOVING:
                await asyncio.sleep(0.05)
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
            while await robot.state() is not State.HOLDING:
                await asyncio.sleep(0.05)
            assert (await robot.positions())[0] < 0.8

    asyncio.run(asyncio.wait_for(run(), HANG_S))
    assert [step.number for step in begun] == [0, 1]
