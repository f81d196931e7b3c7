"""Two tools on a real socket between real processes: lines and status are those of the tool in use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import rtcp
from kinematics.forward import forward, forward_batch
from rtcp.api import Invalid, Robot
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

HERE = [0.0, -0.2, 2.0, 0.0, 1.0, 0.0]


@pytest.fixture
def robot(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("who has tools", control_socket(enabled.directory)) as robot:
        robot.move_joints(HERE)
        yield robot
        robot.set_tool("flange")
        robot.set_payload(0.0)


def test_a_line_of_the_chosen_tool_is_a_line_of_its_point(shared: Platform, robot: Robot) -> None:
    with pytest.raises(Invalid, match="spoon"):
        robot.set_tool("spoon")
    feed = rtcp.Feed(shared.directory)
    flange, probe = feed.config.models
    there = forward(probe, HERE)
    assert robot.preview(pose=[*there.position, *there.rpy], tool="probe").path[-1] == pytest.approx(HERE, abs=1e-3)
    robot.set_tool("probe")
    start, status = forward(probe, HERE), robot.status()
    assert (status.tool, status.payload.mass) == ("probe", 0.0)
    assert status.pose == pytest.approx([*start.position, *start.rpy], abs=1e-3)
    assert robot.fk(HERE)[:3] == pytest.approx(start.position, abs=1e-9)
    x, y, z = start.position
    arrival = robot.move_line([[x, y + 0.15, z - 0.1, *start.rpy], [x, y, z, 0.3, *start.rpy[1:]]], 0.1)
    assert arrival.length_m == pytest.approx(2 * np.hypot(0.15, 0.1), abs=1e-6)
    records, missing = feed.records()
    feed.close()
    assert not missing
    sent = records["sent_position"][records["wkc"] == records["wkc_expected"]]
    # Where the point is off the plane of both lines, and off their direction in it; the flange turns about it.
    for model, largest in ((probe, 2e-4), (flange, np.inf)):
        points = forward_batch(model, sent)[0] - forward(model, HERE).position
        off = np.hypot(points[:, 0], points @ (0.0, 0.1, 0.15) / np.hypot(0.1, 0.15))
        assert off.max() < largest
    assert off.max() > 0.02
    moved = records[np.abs(records["actual_velocity"]).max(axis=1) > 0.01]
    assert moved["tool"].tolist() == [1] * len(moved)
    tip = [moved[name] for name in ("tool_x", "tool_y", "tool_z")]
    assert np.abs(np.column_stack(tip) - forward_batch(probe, moved["actual_position"])[0]).max() < 1e-9


def test_the_command_line_lists_and_chooses_tools_and_says_what_is_held(enabled: Platform, robot: Robot) -> None:
    assert [line.split()[1] for line in enabled.rtcp("tool").stdout.splitlines() if "*" in line] == ["flange"]
    assert "the tool is probe" in enabled.rtcp("tool", "probe").stdout
    assert "0.4 kg" in enabled.rtcp("payload", "0.4", "--centre", "0", "0", "0.05").stdout
    shown = enabled.rtcp("status").stdout
    assert "probe with 0.4 kg: " in shown
    assert "2 kg is not allowed" in enabled.rtcp("payload", "2", check=None).stderr
