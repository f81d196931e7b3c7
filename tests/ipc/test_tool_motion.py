"""The fields of the tool, which readers add to cycle records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kinematics.forward import forward
from kinematics.jacobian import jacobian
from rtcp.config import default_config, load
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer
from rtcp.ipc.schema import arm_schema
from rtcp.ipc.tool_motion import FIELDS, POSE, VELOCITY, ToolMotion
from tests.records import numbers

ARM = load(default_config()).arm
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
    tool = ToolMotion(ARM, SCHEMA)
    extended = tool.add(records)
    assert ARM is not None
    pose = forward(ARM, Q)
    assert [extended[name][0] for name in POSE] == pytest.approx([*pose.position, *pose.rpy], abs=1e-12)
    expected = np.array(jacobian(ARM, Q)) @ RATES
    assert [extended[name][0] for name in VELOCITY] == pytest.approx(expected, abs=1e-12)
    assert [float(extended[name][1]) for name in VELOCITY] == [0.0] * 6
    for name in SCHEMA.names:
        assert extended[name].tolist() == records[name].tolist(), name
    assert tool.schema.names == (*SCHEMA.names, *POSE, *VELOCITY)
    assert {tool.schema[name].unit for name in POSE} == {"m", "rad"}


def test_a_joint_that_is_not_a_number_leaves_the_tool_of_its_own_cycle_unknown(tmp_path: Path) -> None:
    extended = ToolMotion(ARM, SCHEMA).add(records_of(tmp_path, (Q, RATES), ((float("nan"), *Q[1:]), RATES)))
    assert np.isfinite(extended["tool_x"]).tolist() == [True, False]
    assert np.isfinite(extended["tool_vx"]).tolist() == [True, False]


def test_an_arm_without_geometry_and_a_platform_without_joints_have_no_fields_of_a_tool(tmp_path: Path) -> None:
    records = records_of(tmp_path, (Q, RATES))
    assert ToolMotion(None, SCHEMA).add(records) is records
    schema = SCHEMA.subset(["number", "time_ns"])
    assert ToolMotion(ARM, schema).schema is schema


def test_no_record_is_none_with_these_fields(tmp_path: Path) -> None:
    extended = ToolMotion(ARM, SCHEMA).add(records_of(tmp_path, (Q, RATES))[:0])
    assert (len(extended), extended.dtype.names[-1]) == (0, FIELDS[-1].name)
