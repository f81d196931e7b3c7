"""The fields of the tool, which readers add to cycle records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinematics.forward import forward
from kinematics.jacobian import jacobian
from kinematics.pose import Pose
from rtcp.config import default_config, load
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer
from rtcp.ipc.schema import arm_schema
from rtcp.ipc.tool_motion import FIELDS, POSE, VELOCITY, ToolMotion
from tests.records import numbers

ARM = load(default_config()).arm
assert ARM is not None
PROBE = replace(ARM, tool=Pose((0.0, 0.1, 0.3), ARM.tool.rotation))
SCHEMA = arm_schema(6)
Q, RATES = (0.1, 0.3, 1.5, -0.2, 0.5, 0.4), (0.2, -0.1, 0.05, 0.3, -0.4, 1.0)


def records_of(path: Path, *rows: tuple[tuple[float, ...], tuple[float, ...]]) -> np.ndarray:
    board = Blackboard(path / "blackboard", SCHEMA, 500_000)
    for q, rates in rows:
        board.publish(numbers(SCHEMA, actual_position=q, actual_velocity=rates, cycle=7))
    records, _ = Observer(board.path).since(0)
    return records


def test_pose_and_velocity_of_the_tool_stand_beside_the_fields_of_the_loop(tmp_path: Path) -> None:
    records = records_of(tmp_path, (Q, RATES), ((0.0,) * 6, (0.0,) * 6))
    tool = ToolMotion((ARM, PROBE), SCHEMA)
    extended = tool.add(records)
    pose = forward(ARM, Q)
    assert [extended[name][0] for name in POSE] == pytest.approx([*pose.position, *pose.rpy], abs=1e-12)
    expected = np.array(jacobian(ARM, Q)) @ RATES
    assert [extended[name][0] for name in VELOCITY] == pytest.approx(expected, abs=1e-12)
    assert [float(extended[name][1]) for name in VELOCITY] == [0.0] * 6
    for name in SCHEMA.names:
        assert extended[name].tolist() == records[name].tolist(), name
    assert tool.schema.names == (*SCHEMA.names, *POSE, *VELOCITY)
    assert {tool.schema[name].unit for name in POSE} == {"m", "rad"}


def test_each_cycle_has_the_motion_of_the_tool_that_was_in_use(tmp_path: Path) -> None:
    records = records_of(tmp_path, (Q, RATES), (Q, RATES), (Q, RATES))
    records["tool"] = (1, 0, 2)
    extended = ToolMotion((ARM, PROBE), SCHEMA).add(records)
    for at, model in ((0, PROBE), (1, ARM)):
        assert [extended[name][at] for name in POSE[:3]] == pytest.approx(forward(model, Q).position, abs=1e-12)
        twist = np.array(jacobian(model, Q)) @ RATES
        assert [extended[name][at] for name in VELOCITY] == pytest.approx(twist, abs=1e-12)
    assert np.isnan(extended["tool_x"][2])


def test_a_joint_that_is_not_a_number_leaves_the_tool_of_its_own_cycle_unknown(tmp_path: Path) -> None:
    extended = ToolMotion((ARM, PROBE), SCHEMA).add(records_of(tmp_path, (Q, RATES), ((float("nan"), *Q[1:]), RATES)))
    assert np.isfinite(extended["tool_x"]).tolist() == [True, False]
    assert np.isfinite(extended["tool_vx"]).tolist() == [True, False]


def test_an_arm_without_geometry_and_a_platform_without_joints_have_no_fields_of_a_tool(tmp_path: Path) -> None:
    records = records_of(tmp_path, (Q, RATES))
    assert ToolMotion((), SCHEMA).add(records) is records
    schema = SCHEMA.subset(["number", "time_ns"])
    assert ToolMotion((ARM, PROBE), schema).schema is schema


def test_no_record_is_none_with_these_fields(tmp_path: Path) -> None:
    extended = ToolMotion((ARM, PROBE), SCHEMA).add(records_of(tmp_path, (Q, RATES))[:0])
    assert (len(extended), extended.dtype.names[-1]) == (0, FIELDS[-1].name)
