"""Motions that have an end, planned in the gateway; the loop's part is played."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.config.model import Stop
from rtcp.gateway.planner import Planner
from rtcp.ipc.codes import Code, MotionMode, Refusal
from rtcp.ipc.machine import Command
from rtcp.motion.limits import Limits
from tests.runtime.played import Played, played

BENT = [0.0, 0.2, math.pi / 2, 0.0, 0.4, 0.0]


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Played]:
    with played(tmp_path, BENT) as made:
        yield made


def tool(arm: Played, q: list[float]) -> list[float]:
    assert arm.config.arm is not None
    pose = forward(arm.config.arm, q)
    return [*pose.position, *pose.rpy]


def beside(arm: Played, dy: float) -> list[float]:
    x, y, z, *turn = tool(arm, BENT)
    return [x, y + dy, z, *turn]


def end_of_line(arm: Played, pose: list[float]) -> tuple[float, ...]:
    """Where the joints are at the line's end: what the played loop is to come to."""
    return Planner(arm.config, Limits(arm.config)).lines([Stop(tuple(pose))], BENT, None).end


def test_a_move_carries_its_speed_and_whether_each_joint_is_at_its_best(arm: Played) -> None:
    goal = [0.1, *BENT[1:]]
    assert arm.ask("move", q=goal)["error"] == 0.0
    arm.ask("move", q=BENT, speed=0.2, each=True)
    assert [numbers[-2:] for numbers in arm.loop.taken(Command.MOVE)] == [(0.0, 0.5), (1.0, 0.2)]
    assert arm.loop.taken(Command.MOVE)[0][:6] == tuple(goal)


def test_a_move_of_another_number_of_joints_is_refused_and_nothing_is_commanded(arm: Played) -> None:
    assert "5 joint positions were given, the arm has 6" in str(arm.refused("move", q=BENT[:5]))
    assert arm.loop.commands == []


def test_a_line_is_planned_from_where_the_arm_is_commanded_and_ends_at_the_pose(arm: Played) -> None:
    goal = beside(arm, 0.1)
    arm.loop.ends[Command.LINE] = end_of_line(arm, goal)
    answer = arm.ask("line", pose=goal, speed=0.05)
    assert answer["length_m"] == pytest.approx(0.1)
    assert answer["error"] < 1e-9
    [(_slot, count, *_)] = arm.loop.taken(Command.LINE)
    assert count == 1
    [[row]] = arm.loop.plans
    assert row[0:3] == pytest.approx(tool(arm, BENT)[:3])
    assert row[7:10] == pytest.approx(goal[:3])
    # The fraction's speed times the length: what was asked for.
    assert row[14] * row[17] == pytest.approx(0.05)


def test_a_line_through_several_poses_has_a_piece_for_each(arm: Played) -> None:
    poses = [beside(arm, 0.05), beside(arm, 0.0)]
    arm.loop.ends[Command.LINE] = BENT
    arm.ask("line", poses=poses)
    assert [len(plan) for plan in arm.loop.plans] == [2]


@pytest.mark.parametrize(
    ("pose", "sentence"),
    [
        ([-2.0, 0.0, 0.6, 0.0, 0.0, 0.0], " m: out of reach"),
        ([0.5, 0.0, 0.3, 0.0, 0.0, 0.0], "the line at 0."),
        ([-0.6, 0.0, 0.6, 0.0, 0.0], "pose 1: found 5 numbers, allowed are 6"),
    ],
    ids=["out of reach", "across the arm", "five numbers"],
)
def test_a_line_that_cannot_be_is_refused_beforehand_with_its_place_and_nothing_is_commanded(
    arm: Played, pose: list[float], sentence: str
) -> None:
    assert sentence in str(arm.refused("line", pose=pose))
    assert arm.loop.commands == []


def test_a_line_is_looked_at_under_the_limits_that_are_in_force_now(arm: Played) -> None:
    arm.ask("limits", set={"box.max.y": 0.05})
    failed = arm.refused("line", pose=beside(arm, 0.1))
    assert failed.kind == "refused"
    assert "the arm would be in the space outside the Cartesian box" in str(failed)
    assert "m of 0.100 m" in str(failed)
    assert arm.loop.taken(Command.LINE) == []


def test_a_pose_is_moved_to_by_the_nearest_solution(arm: Played) -> None:
    goal = tool(arm, [0.1, *BENT[1:]])
    arm.ask("move_pose", pose=goal, speed=0.3)
    [numbers] = arm.loop.taken(Command.MOVE)
    assert list(numbers[:6]) == pytest.approx([0.1, *BENT[1:]], abs=1e-9)
    assert numbers[-1] == 0.3


def test_a_pose_out_of_reach_is_refused_with_the_kinematics_reason(arm: Played) -> None:
    failed = arm.refused("move_pose", pose=[-2.0, 0.0, 0.6, 0.0, 0.0, 0.0])
    assert failed.kind == "refused"
    assert "the pose cannot be reached: out of reach by" in str(failed)
    assert arm.loop.commands == []


def test_a_pose_is_moved_to_on_a_line_where_the_arm_is_in_mode_cartesian(arm: Played) -> None:
    arm.show(motion=MotionMode.CARTESIAN)
    arm.loop.ends[Command.LINE] = end_of_line(arm, beside(arm, 0.05))
    arm.ask("move_pose", pose=beside(arm, 0.05))
    assert [kind for kind, *_ in arm.loop.commands] == [Command.LINE]


def test_a_trajectory_is_checked_whole_before_it_is_commanded(arm: Played) -> None:
    there = [0.2, *BENT[1:]]
    arm.loop.ends[Command.TRAJECTORY] = there
    arm.ask("trajectory", points=[{"t": 0.0, "q": BENT}, {"t": 2.0, "q": there}])
    [[first, last]] = arm.loop.plans
    assert (first[0], last[0]) == (0.0, 2.0)
    assert last[1:7] == there


POINTS: dict[str, tuple[list[dict[str, Any]], str, str]] = {
    "time runs back": ([{"t": 2.0, "q": BENT}, {"t": 1.0, "q": BENT}], "refused", "point 2: its time is 1 s after 2 s"),
    "too fast": ([{"t": 0.0, "q": BENT}, {"t": 0.1, "q": [1.0, *BENT[1:]]}], "refused", "joint1"),
    "no time": ([{"q": BENT}], "invalid", "points[0].t is missing; it must be a number"),
    "a text": ([{"t": 1.0, "q": "here"}], "invalid", 'points[0].q: found "here", allowed is a list of numbers'),
    "another arm's": ([{"t": 1.0, "q": BENT[:5]}], "refused", "5 numbers"),
    "nothing": ([], "refused", "the trajectory has no points"),
}


@pytest.mark.parametrize(("points", "kind", "sentence"), POINTS.values(), ids=POINTS.keys())
def test_a_trajectory_that_cannot_be_is_one_sentence_and_nothing_is_commanded(
    arm: Played, points: list[dict[str, Any]], kind: str, sentence: str
) -> None:
    failed = arm.refused("trajectory", points=points)
    assert failed.kind == kind
    assert sentence in str(failed)
    assert arm.loop.commands == []


def test_a_path_without_poses_is_one_sentence(arm: Played) -> None:
    assert "the path has no poses" in str(arm.refused("path", path=[]))


def test_a_path_takes_poses_and_joints_and_a_speed_for_each(arm: Played) -> None:
    arm.loop.ends[Command.LINE] = BENT
    arm.ask("path", path=[{"pose": beside(arm, 0.05), "speed": 0.02}, {"q": BENT}], speed=0.04)
    [rows] = arm.loop.plans
    assert [row[14] * row[17] for row in rows] == pytest.approx([0.02, 0.04])


def test_a_file_is_run_after_an_approach_to_where_it_begins(arm: Played, tmp_path: Path) -> None:
    first, last = [0.3, *BENT[1:]], [0.4, *BENT[1:]]
    file = tmp_path / "motion.yaml"
    file.write_text(f"trajectory:\n  - {{t: 0, q: {first}}}\n  - {{t: 2, q: {last}}}\n")
    arm.loop.ends[Command.TRAJECTORY] = last
    assert "joint1" in str(arm.refused("run", file=str(file)))
    assert arm.loop.commands == []
    arm.ask("run", file=str(file), approach=True)
    assert [kind for kind, *_ in arm.loop.commands] == [Command.MOVE, Command.TRAJECTORY]
    assert list(arm.loop.taken(Command.MOVE)[0][:6]) == first


def test_a_path_is_run_from_its_second_pose_on_after_an_approach_to_its_first(arm: Played) -> None:
    arm.loop.ends[Command.LINE] = end_of_line(arm, beside(arm, 0.1))
    arm.ask("path", path=[{"pose": beside(arm, 0.05)}, {"pose": beside(arm, 0.1)}], approach=True)
    assert [kind for kind, *_ in arm.loop.commands] == [Command.MOVE, Command.LINE]
    [[row]] = arm.loop.plans
    assert row[0:3] == pytest.approx(beside(arm, 0.05)[:3])
    assert row[7:10] == pytest.approx(beside(arm, 0.1)[:3])


def test_a_path_of_one_pose_is_its_approach(arm: Played) -> None:
    arm.ask("path", path=[{"pose": beside(arm, 0.05)}], approach=True)
    assert [kind for kind, *_ in arm.loop.commands] == [Command.MOVE]


def test_a_mistake_in_a_file_is_named_with_its_line(arm: Played, tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    file.write_text("t,q1,q2,q3,q4,q5,q6\n1,0,0,0,0,0,0\n0.5,0,0,0,0,0,0\n")
    failed = arm.refused("run", file=str(file))
    assert failed.kind == "invalid"
    assert f"{file}:3: t: found 0.5 after 1; times must rise" in str(failed)
    assert arm.loop.commands == []


def test_what_the_loop_refuses_is_told_in_its_sentence(arm: Played) -> None:
    arm.loop.refusals[Command.MOVE] = (Refusal.PRESSED, -1, 0.0, 0.0)
    failed = arm.refused("move", q=BENT)
    assert failed.kind == "refused"
    assert "the emergency stop is pressed" in str(failed)


def test_a_motion_that_ends_early_is_told_with_its_reason(arm: Played) -> None:
    goal = [0.5, *BENT[1:]]
    arm.loop.ends[Command.MOVE] = BENT
    arm.loop.event_at_the_end = (Code.NOT_PERMITTED,)
    failed = arm.refused("move", q=goal)
    assert failed.kind == "fault"
    assert "the enabling switch was let go" in str(failed)


def test_a_motion_that_is_halted_is_told_so_however_old_the_pictures_message_is(
    arm: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arm.picture, "follow", list)
    arm.picture.message = "the move has arrived"
    arm.loop.ends[Command.MOVE] = BENT
    arm.loop.event_at_the_end = (Code.STOPPED,)
    failed = arm.refused("move", q=[0.5, *BENT[1:]])
    assert str(failed) == "the move ended before it arrived: the arm has stopped and holds"
