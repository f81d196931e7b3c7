"""Programs that are taught, run, stepped and paused, on real frames between real processes."""

from __future__ import annotations

import asyncio
import math
import time
from pathlib import Path

import pytest

import rtcp
from rtcp.api import State
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

HERE = [0.0, -0.2, 2.0, 0.0, 1.0, 0.0]


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


def test_a_program_steps_back_the_way_it_came(enabled: Platform, tmp_path: Path) -> None:
    taught = rtcp.ProgramFile(tmp_path / "taught.yaml")
    with rtcp.connect("who steps", control_socket(enabled.directory)) as robot:
        robot.move_joints(HERE)
        x, y, z, *rpy = robot.fk(HERE)
        taught.keep("here", q=HERE)
        taught.keep("top", pose=[x, y + 0.05, z + 0.05, *rpy])
        taught.keep("right", pose=[x, y + 0.1, z, *rpy])
        taught.insert(0, {"arc": "right", "via": "top"})
        taught.insert(0, {"move": "here"})
        program = rtcp.Program(taught.path)
        program.run(robot)
        feed = rtcp.Feed(enabled.directory)
        program.step_back(robot, 1)
        records, _ = feed.records()
        feed.close()
        assert robot.positions == pytest.approx(HERE, abs=2e-3)
    # The centre of the arc is 0.05 m beside the start; the tool keeps this distance from it all the way.
    with rtcp.connect("who looks", control_socket(enabled.directory)) as robot:
        places = [robot.fk([float(q) for q in sent]) for sent in records["sent_position"][::50]]
    assert [math.hypot(place[1] - y - 0.05, place[2] - z) for place in places] == pytest.approx(
        [0.05] * len(places), abs=2e-4
    )


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
            end = time.monotonic() + 30.0
            while len(begun) < 2 or await robot.state() is not State.MOVING:
                assert time.monotonic() < end
                await asyncio.sleep(0.05)
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
            end = time.monotonic() + 5.0
            while await robot.state() is not State.HOLDING:
                assert time.monotonic() < end
                await asyncio.sleep(0.05)
            assert (await robot.positions())[0] < 0.8

    asyncio.run(run())
    assert [step.number for step in begun] == [0, 1]
