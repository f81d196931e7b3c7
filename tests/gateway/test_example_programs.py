"""The programs in examples/tasks, and the computed motions of the experiment `joystick`, are planned whole by the
gateway, under the limits and boxes of the shipped arm."""

from __future__ import annotations

from math import dist, pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.api.program import PlannedMotion, Program
from rtcp.api.results import Preview, Terminals, result
from rtcp.telemetry.experiments.picks import ITEMS, begin_pose, lines
from tests.gateway.fake_platform import FakePlatform

TASKS = Path(__file__).parents[2] / "examples" / "tasks"
Q = [0.0, 0.2, pi / 2, 0.0, 0.4, 0.0]


def planned(arm: FakePlatform, name: str) -> list[PlannedMotion]:
    """Return the motions of a program from the joints of the fake loop."""
    robot: Any = SimpleNamespace(
        status=lambda: SimpleNamespace(commanded_positions=Q, tool=""),
        preview=lambda **params: result(Preview, arm.ask("preview", **params)),
        read_io=lambda: Terminals.from_json(arm.ask("read_io")),
    )
    return Program(TASKS / f"{name}.yaml").check(robot)


@pytest.mark.parametrize(("name", "motions"), [("drink", 9), ("door_handle", 7), ("switch", 6)])
def test_each_task_is_planned_whole_in_less_than_a_minute(arm: FakePlatform, name: str, motions: int) -> None:
    plans = planned(arm, name)
    assert len(plans) == motions
    assert sum(motion.plan.duration_s for motion in plans) < 60.0


def test_the_cup_stays_upright_on_all_its_way(arm: FakePlatform) -> None:
    assert arm.config.arm is not None
    ways = [motion.plan.path for motion in planned(arm, "drink")]
    with_cup = [q for path in ways[3:7] for q in path]
    # The axis of the cup is x of the tool: its z component in the base is 1. The gripper, z of the tool, is then level.
    assert min(forward(arm.config.arm, q).rotation[6] for q in with_cup) > 0.999
    at_face = forward(arm.config.arm, ways[4][-1]).position
    assert dist(at_face, (0.42, -0.35, at_face[2])) < 0.15


def test_the_lever_is_pressed_on_a_circle_about_its_pivot(arm: FakePlatform) -> None:
    assert arm.config.arm is not None
    arc = next(motion for motion in planned(arm, "door_handle") if motion.line == 19)
    places = [forward(arm.config.arm, q).position for q in arc.plan.path]
    assert [dist((x, y, z), (-0.64, 0.08, 0.55)) for x, y, z in places] == pytest.approx([0.12] * len(places), abs=1e-3)
    assert places[0][2] - places[-1][2] == pytest.approx(0.077, abs=1e-3)


@pytest.mark.parametrize("item", ITEMS)
def test_the_computed_motion_of_each_item_is_planned_whole_from_the_begin_of_the_task(
    arm: FakePlatform, item: str
) -> None:
    assert arm.config.arm is not None
    q = begin_pose(arm.config.arm)
    tool = arm.ask("fk", q=list(q))["pose"]
    for points in lines(item, tool[2]):
        stops = [{"pose": [*point, *tool[3:]]} for point in points]
        plan = result(Preview, arm.ask("preview", stops=stops, start=list(q), speed=arm.config.jog.speed))
        q = plan.path[-1]
        assert forward(arm.config.arm, q).position == pytest.approx(points[-1], abs=1e-6)
