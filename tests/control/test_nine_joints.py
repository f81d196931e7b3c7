"""A file of nine joints without `kinematics` on the in-process bus: read, enabled, moved, narrowed, recorded.

Eleven joints are refused when the file is read: `tests/config/test_mistakes.py`.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from math import cos, pi
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from rtcp.config import default_config, load
from rtcp.config.model import Point
from rtcp.ipc.commands import Jog, MoveJoints, RunTrajectory, SetLimits, StreamPosition
from rtcp.ipc.refusals import PositionOutOfRange
from rtcp.ipc.states import JogFrame, State
from rtcp.motion.limits import Values, rows
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.telemetry.channels import Channels
from rtcp.telemetry.reading import read
from rtcp.telemetry.recorder import McapWriter
from rtcp.testing.simulation import Simulation

JOINTS = 9
TARGET = tuple(0.02 * (axis + 1) for axis in range(JOINTS))


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Simulation]:
    """Enabled at 0."""
    with Simulation(load(nine_joints(tmp_path)), follow_clock=False, positions=[0.0] * JOINTS) as made:
        made.hold()
        yield made


def nine_joints(directory: Path) -> Path:
    """Write a configuration with three more drives and without geometry; return the arm's file."""
    shutil.copytree(default_config().parent, directory, dirs_exist_ok=True)
    yaml, file, segment_file = YAML(typ="safe"), directory / "assistive_arm.yaml", directory / "segment.yaml"
    arm, segment = yaml.load(file.read_text()), yaml.load(segment_file.read_text())
    for key in ("kinematics", "cartesian", "jog", "rest_pose"):
        del arm[key]
    for number in range(7, JOINTS + 1):
        arm["joints"].append({**arm["joints"][-1], "name": f"joint{number}", "slave": f"drive{number}"})
        arm["slaves"].append({"name": f"drive{number}", "device": "cubemars-orh"})
        segment["slaves"].append(segment["slaves"][-1])
    for path, data in ((file, arm), (segment_file, segment)):
        with path.open("w") as written:
            yaml.dump(data, written)
    return file


def arrive(arm: Simulation, target: tuple[float, ...]) -> None:
    """Let the motion end; assert that every drive stands at the target."""
    arm.bring_to(State.HOLDING, 10.0)
    arm.run(0.2)
    assert arm.loop.arm.state.actual == pytest.approx(target, abs=2e-3)


def test_all_nine_move_to_positions_and_a_jog_moves_the_ninth(arm: Simulation) -> None:
    arm.do(MoveJoints(TARGET, speed=0.3, synchronized=True))
    arrive(arm, TARGET)
    arm.do(Jog((0.0,) * 8 + (0.2,), JogFrame.JOINTS, 0.3))
    arm.bring_to(State.HOLDING, 2.0)
    *others, ninth = arm.loop.arm.state.commanded
    assert others == pytest.approx(TARGET[:8])
    assert ninth > TARGET[8] + 0.03


def test_a_planned_trajectory_leads_all_nine(arm: Simulation) -> None:
    points = [Point(0.0, (0.0,) * JOINTS), Point(1.0, TARGET)]
    plan = plan_trajectory(points, arm.loop.arm.limits, arm.loop.arm.state.commanded)
    arm.do(RunTrajectory(arm.observer.write_plan(plan.rows), len(plan.rows)))
    arrive(arm, TARGET)


def test_a_stream_leads_all_nine(arm: Simulation) -> None:
    for step in range(200):
        fraction = 0.5 - 0.5 * cos(pi * min(1.0, step / 150))
        arm.do(StreamPosition(tuple(fraction * q for q in TARGET), arm.now_ns * 1e-9))
        arm.run(0.01)
    arrive(arm, TARGET)


def test_the_limits_of_the_ninth_are_narrowed(arm: Simulation) -> None:
    widest = Values.configured(arm.config)
    narrow = rows(replace(widest, high=(*widest.high[:8], 0.1)))
    arm.do(SetLimits(arm.observer.write_plan(narrow), len(narrow)))
    assert arm.send(MoveJoints(TARGET, 0.3, True)).refusal == PositionOutOfRange(8, TARGET[8], 0.1)
    arm.do(MoveJoints((*TARGET[:8], 0.09), 0.3, True))


def test_its_cycles_are_recorded_and_read_back(arm: Simulation, tmp_path: Path) -> None:
    arm.do(MoveJoints(TARGET, speed=0.3, synchronized=True))
    arrive(arm, TARGET)
    records, _ = arm.observer.since(0)
    writer = McapWriter(Channels(arm.config, arm.observer.schema, 0), arm.config)
    writer.open(tmp_path / "a.mcap")
    writer.write(records, records)
    writer.close()
    recording = read(tmp_path / "a.mcap")
    assert len(recording.joints) == JOINTS
    assert np.array_equal(recording.records["actual_position"], records["actual_position"])
    assert recording.records["sent_position"][-1] == pytest.approx(TARGET, abs=1e-6)
