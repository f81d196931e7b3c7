"""Motions that have an end, planned in the gateway; the loop is fake."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.config.model import Point, Stop
from rtcp.gateway.command_channel import Caller
from rtcp.gateway.motion_actions import Planner
from rtcp.ipc.commands import MoveJoints, RunLines, RunTrajectory
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import BoxReached, NotSettled, PermissionWithdrawn, SlaveLost, Stopped
from rtcp.ipc.refusals import EmergencyStopPressed
from rtcp.ipc.states import ControlMode, State
from rtcp.motion.limits import Limits
from tests.gateway.fake_platform import FakePlatform

Q = BENT = [0.0, 0.2, math.pi / 2, 0.0, 0.4, 0.0]
THERE = [0.2, *BENT[1:]]
LONG = 1_000_000


def tool(arm: FakePlatform, q: list[float]) -> list[float]:
    assert arm.config.arm is not None
    pose = forward(arm.config.arm, q)
    return [*pose.position, *pose.rpy]


def beside(arm: FakePlatform, dy: float) -> list[float]:
    x, y, z, *rpy = tool(arm, BENT)
    return [x, y + dy, z, *rpy]


def end_of_line(arm: FakePlatform, pose: list[float]) -> tuple[float, ...]:
    """Joint positions at the end of a line, which the fake loop takes as its end."""
    return Planner(arm.config, Limits(arm.config)).path([Stop(tuple(pose))], BENT, None).end


def test_a_move_sends_its_speed_and_whether_the_joints_arrive_together(arm: FakePlatform) -> None:
    assert arm.ask("move_joints", q=THERE) == {"positions": THERE, "error": 0.0}
    arm.ask("move_joints", q=BENT, speed=0.2, synchronized=False)
    assert arm.loop.commands == [MoveJoints(tuple(THERE), 0.5, True), MoveJoints(tuple(BENT), 0.2, False)]


def test_a_move_reports_its_progress(arm: FakePlatform) -> None:
    reports: list[dict[str, Any]] = []
    arm.run(lambda: arm.methods.call("move_joints", Caller("one", 1, reports.append), {"q": THERE}))
    assert {"state", "fraction", "remaining_s", "positions"} == set(reports[0])


MOTIONS: list[tuple[str, dict[str, Any]]] = [
    ("move_joints", {"q": THERE}),
    ("run_trajectory", {"points": [{"t": 0.0, "q": BENT}, {"t": 2.0, "q": THERE}]}),
]


@pytest.mark.parametrize(("motion", "params"), MOTIONS)
def test_a_motion_reports_once_that_it_was_accepted_and_one_that_is_refused_does_not(
    arm: FakePlatform, motion: str, params: dict[str, Any]
) -> None:
    reports: list[dict[str, Any]] = []
    arm.loop.ends[RunTrajectory] = tuple(THERE)
    arm.run(lambda: arm.methods.call(motion, Caller("one", 1, reports.append), params))
    assert [report.get("accepted") for report in reports].count(True) == 1
    reports.clear()
    arm.loop.refusals = dict.fromkeys((MoveJoints, RunTrajectory), EmergencyStopPressed())
    with pytest.raises(RtcpError):
        arm.run(lambda: arm.methods.call(motion, Caller("one", 1, reports.append), params))
    assert not any("accepted" in report for report in reports)


@pytest.mark.parametrize("motion", ["move_joints", "run_trajectory", "move_line"])
def test_the_status_has_the_goal_while_the_arm_moves_there(arm: FakePlatform, motion: str) -> None:
    pose = beside(arm, 0.1)
    goals: dict[str, tuple[Sequence[float], dict[str, Any]]] = {
        "move_joints": (THERE, {"q": THERE}),
        "run_trajectory": (THERE, {"points": [{"t": 0.0, "q": BENT}, {"t": 2.0, "q": THERE}]}),
        "move_line": (end_of_line(arm, pose), {"poses": [pose]}),
    }
    goal, params = goals[motion]
    arm.loop.ends[RunLines], arm.loop.moves_for = goal, LONG

    async def work() -> None:
        moving = asyncio.create_task(arm.call(motion, params))
        assert (await status_in(arm, State.MOVING, moving))["goal"] == pytest.approx(list(goal), abs=1e-7)
        with pytest.raises(RtcpError, match="one"):
            await arm.call("move_joints", {"q": BENT}, "two", 2)
        assert (await arm.call("status", {}))["goal"] is not None
        arm.loop.state = State.STOPPING
        assert (await status_in(arm, State.STOPPING, moving))["goal"] is None
        arm.loop.state = State.HOLDING
        with pytest.raises(RtcpError):
            await moving
        assert arm.methods._motion.goal is None

    arm.run(work)


@pytest.mark.parametrize("method", ["jog", "move_joints"])
def test_a_jog_and_a_refused_motion_have_no_goal(arm: FakePlatform, method: str) -> None:
    arm.loop.refusals[MoveJoints] = EmergencyStopPressed()

    async def work() -> Any:
        if method == "jog":
            await arm.call("jog", {"velocity": [0.01] + [0.0] * 5})
        else:
            with pytest.raises(RtcpError):
                await arm.call("move_joints", {"q": THERE})
            arm.loop.state = State.MOVING
        return await status_in(arm, State.MOVING)

    assert arm.run(work)["goal"] is None


async def status_in(arm: FakePlatform, state: State, moving: asyncio.Task[Any] | None = None) -> Any:
    """Return the first status in a state, with its goal if already known."""
    while (status := await arm.call("status", {}))["state"] != state.name.lower():
        assert moving is None or not moving.done()
        await asyncio.sleep(0.002)
    await asyncio.sleep(0.02)
    return await arm.call("status", {}) if state is State.MOVING else status


def test_a_line_is_planned_from_the_commanded_position_and_ends_at_the_pose(arm: FakePlatform) -> None:
    goal = beside(arm, 0.1)
    arm.loop.ends[RunLines] = end_of_line(arm, goal)
    answer = arm.ask("move_line", poses=[goal], speed=0.05)
    assert answer["length_m"] == pytest.approx(0.1)
    assert answer["error"] < 1e-9
    assert arm.loop.commands == [RunLines(0, 1)]
    [[row]] = arm.loop.plans
    assert row[0:3] == pytest.approx(tool(arm, BENT)[:3])
    assert row[7:10] == pytest.approx(goal[:3])
    # The speed of the fraction times the length: the tool's.
    assert row[14] * row[17] == pytest.approx(0.05)


def test_a_line_through_several_poses_has_a_piece_for_each(arm: FakePlatform) -> None:
    arm.loop.ends[RunLines] = BENT
    arm.ask("move_line", poses=[beside(arm, 0.05), beside(arm, 0.0)])
    assert [len(plan) for plan in arm.loop.plans] == [2]


def test_a_plan_is_checked_against_the_limits_in_force(arm: FakePlatform) -> None:
    async def narrow_then_move() -> None:
        await arm.call("set_limits", {"changes": {"box.max.y": 0.05}})
        await arm.call("move_line", {"poses": [beside(arm, 0.1)]})

    with pytest.raises(Exception, match=r"the arm would be in the space outside the Cartesian box.*") as raised:
        arm.run(narrow_then_move)
    assert "m of 0.100 m" in str(raised.value)
    assert arm.loop.received(RunLines) == []


def test_a_pose_is_reached_by_the_nearest_solution(arm: FakePlatform) -> None:
    arm.ask("move_pose", pose=tool(arm, THERE), speed=0.3)
    (command,) = arm.loop.received(MoveJoints)
    assert command.q == pytest.approx(THERE, abs=1e-9)
    assert command.speed == 0.3


@pytest.mark.parametrize(("line", "mode"), [(True, ControlMode.JOINT), (False, ControlMode.CARTESIAN)])
def test_a_pose_is_reached_on_a_line_when_asked_or_in_control_mode_cartesian(
    arm: FakePlatform, line: bool, mode: ControlMode
) -> None:
    arm.show(control_mode=mode)
    arm.loop.ends[RunLines] = end_of_line(arm, beside(arm, 0.05))
    arm.ask("move_pose", pose=beside(arm, 0.05), line=line)
    assert arm.loop.kinds == [RunLines]


def test_a_trajectory_is_written_as_waypoints(arm: FakePlatform) -> None:
    arm.loop.ends[RunTrajectory] = THERE
    answer = arm.ask("run_trajectory", points=[{"t": 0.0, "q": BENT}, {"t": 2.0, "q": THERE}])
    [[first, last]] = arm.loop.plans
    assert (first[0], last[0], answer["duration_s"]) == (0.0, 2.0, 2.0)
    assert last[1:7] == THERE


NEAR = [-0.459, 0.0, 5.0, 0.0, -0.47, 0.0]
REFUSED: dict[str, tuple[str, dict[str, Any], str, str]] = {
    "five joints": ("move_joints", {"q": BENT[:5]}, "invalid", "q: found 5 numbers, allowed are 6"),
    "pose out of reach": ("move_pose", {"pose": [-2.0, 0, 0.6, 0, 0, 0]}, "refused", "reached: out of reach by"),
    "pose in a box": ("move_pose", {"pose": [0.6, 0, 0.4, 0, 1.57, 0]}, "refused", "the keep-out box user"),
    "pose of five numbers": ("move_pose", {"pose": [0.0] * 5}, "invalid", "pose: found 5 numbers, allowed are 6"),
    "pose far away": ("move_pose", {"pose": [1e9, 0, 0, 0, 0, 0]}, "invalid", "pose.x: found 1e+09 m, allowed is -100"),
    "line out of reach": ("move_line", {"poses": [NEAR]}, "refused", "the line at 0."),
    "line across the arm": ("move_line", {"poses": [[0.5, 0, 0.3, 0, 0, 0]]}, "refused", "the line at 0."),
    "pose of a line": ("move_line", {"poses": [[0.0] * 5]}, "invalid", "poses[0]: found 5 numbers, allowed are 6"),
    "speed of the tool": ("move_line", {"poses": [NEAR], "speed": 9.0}, "refused", "found a speed of 9 m/s"),
    "empty path": ("run_path", {"stops": []}, "refused", "the path has no poses"),
    "time runs back": (
        "run_trajectory", {"points": [{"t": 2.0, "q": BENT}, {"t": 1.0, "q": BENT}]}, "refused",
        "point 2: its time is 1 s after 2 s",
    ),
    "too fast": (
        "run_trajectory", {"points": [{"t": 0.0, "q": BENT}, {"t": 0.1, "q": [1.0, *BENT[1:]]}]}, "refused", "joint1",
    ),
    "no time": ("run_trajectory", {"points": [{"q": BENT}]}, "invalid", "points[0]: the key t is missing"),
    "no numbers": ("run_trajectory", {"points": [{"t": 1.0, "q": "here"}]}, "invalid", "points[0].q: found the"),
    "another arm's": ("run_trajectory", {"points": [{"t": 1.0, "q": BENT[:5]}]}, "refused", "5 numbers"),
    "no points": ("run_trajectory", {"points": []}, "refused", "the trajectory has no points"),
    "relative file": ("run", {"file": "a.csv"}, "invalid", 'file: found the text "a.csv", allowed is an absolute path'),
    "missing file": ("run", {"file": "/none/a.csv"}, "invalid", "/none/a.csv"),
}  # fmt: skip


@pytest.mark.parametrize(("method", "params", "kind", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_what_the_arm_cannot_do_fails_before_the_loop_is_asked(
    arm: FakePlatform, method: str, params: dict[str, Any], kind: str, message: str
) -> None:
    error = arm.error(method, **params)
    assert error.kind == kind
    assert message in str(error)
    assert arm.loop.commands == []


def test_a_path_has_poses_and_joints_and_a_speed_for_each(arm: FakePlatform) -> None:
    arm.loop.ends[RunLines] = BENT
    arm.ask("run_path", stops=[{"pose": beside(arm, 0.05), "speed": 0.02}, {"q": BENT}], speed=0.04)
    [rows] = arm.loop.plans
    assert [row[14] * row[17] for row in rows] == pytest.approx([0.02, 0.04])


def test_a_file_that_begins_elsewhere_is_approached_only_when_asked(arm: FakePlatform, tmp_path: Path) -> None:
    first, last = [0.3, *BENT[1:]], [0.4, *BENT[1:]]
    file = tmp_path / "motion.yaml"
    file.write_text(f"trajectory:\n  - {{t: 0, q: {first}}}\n  - {{t: 2, q: {last}}}\n")
    arm.loop.ends[RunTrajectory] = last
    assert "joint1" in str(arm.error("run", file=str(file)))
    assert arm.loop.commands == []
    arm.ask("run", file=str(file), approach=True)
    assert arm.loop.kinds == [MoveJoints, RunTrajectory]
    assert arm.loop.received(MoveJoints)[0].q == tuple(first)


def test_of_a_trajectory_that_is_refused_the_approach_is_not_begun(arm: FakePlatform) -> None:
    points = [{"t": 0.0, "q": [0.3, *BENT[1:]]}, {"t": 0.01, "q": [0.4, *BENT[1:]]}]
    assert "joint1" in str(arm.error("run_trajectory", points=points, approach=True))
    assert arm.loop.commands == []


def test_a_path_is_run_from_its_second_stop_after_an_approach_to_its_first(arm: FakePlatform) -> None:
    arm.loop.ends[RunLines] = end_of_line(arm, beside(arm, 0.1))
    stops = [{"pose": beside(arm, 0.05)}, {"pose": beside(arm, 0.1)}]
    arm.ask("run_path", stops=stops, approach=True)
    assert arm.loop.kinds == [MoveJoints, RunLines]
    [[row]] = arm.loop.plans
    assert row[0:3] == pytest.approx(beside(arm, 0.05)[:3])
    arm.loop.commands.clear()
    arm.ask("run_path", stops=stops[:1], approach=True)
    assert arm.loop.kinds == [MoveJoints]


def test_a_mistake_in_a_file_is_named_with_its_line(arm: FakePlatform, tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    file.write_text("t,q1,q2,q3,q4,q5,q6\n1,0,0,0,0,0,0\n0.5,0,0,0,0,0,0\n")
    error = arm.error("run", file=str(file))
    assert error.kind == "invalid"
    assert f"{file}:3: trajectory[1].t: found 0.5" in str(error)


def test_a_refusal_of_the_loop_has_its_name_and_message(arm: FakePlatform) -> None:
    arm.loop.refusals[MoveJoints] = EmergencyStopPressed()
    error = arm.error("move_joints", q=BENT)
    assert (error.kind, error.reason) == ("refused", "emergency_stop_pressed")
    assert "the emergency stop is pressed" in str(error)


ENDS = {
    "permission withdrawn": (State.HOLDING, PermissionWithdrawn(), "the move ended before it arrived: the enabling"),
    "stop by a limit": (State.STOPPED_BY_LIMIT, BoxReached(0, 0.01), "the move was stopped by a limit: the arm stopp"),
    "fault": (State.FAULT, SlaveLost(3), "slave 3"),
    "not settled": (
        State.HOLDING,
        NotSettled(1, 0.01, 0.002, 3.0),
        "the move ended before it arrived: joint2 is",
    ),
    "halt": (State.HOLDING, Stopped(), "the move ended before it arrived: the arm has stopped and holds"),
}


@pytest.mark.parametrize(("state", "event", "message"), ENDS.values(), ids=ENDS.keys())
def test_a_motion_that_ends_early_fails_with_the_event_that_ended_it(
    arm: FakePlatform, state: State, event: Any, message: str
) -> None:
    arm.loop.ends[MoveJoints] = BENT
    arm.loop.event_at_the_end, arm.loop.ends_in = event, state
    error = arm.error("move_joints", q=THERE)
    assert (error.kind, error.reason, error.fields) == ("fault", event.name, event.as_json())
    assert str(error).startswith(message)


@pytest.mark.parametrize(("motion", "params"), MOTIONS)
def test_a_halt_while_the_joints_settle_at_the_end_of_a_motion_is_no_arrival(
    arm: FakePlatform, motion: str, params: dict[str, Any]
) -> None:
    arm.loop.event_at_the_end = Stopped()
    error = arm.error(motion, **params)
    assert arm.loop.q == THERE
    assert (error.kind, error.reason) == ("fault", "stopped")


def test_a_motion_that_another_command_ends_is_refused(arm: FakePlatform) -> None:
    arm.loop.ends_in = State.READY
    error = arm.error("move_joints", q=THERE)
    assert (error.kind, str(error)) == ("refused", "the move was ended by another command: the machine is ready")


# -- previews -------------------------------------------------------------------------------------------------------


def test_a_preview_of_a_joint_move_leads_from_here_to_there_and_sends_nothing(arm: FakePlatform) -> None:
    preview = arm.ask("preview", q=THERE, speed=0.1)
    assert preview["path"][0] == pytest.approx(BENT)
    assert preview["path"][-1] == pytest.approx(THERE)
    assert preview["duration_s"] > 2.0
    assert arm.loop.commands == []


def test_a_preview_of_a_line_keeps_the_tool_on_it(arm: FakePlatform) -> None:
    preview = arm.ask("preview", pose=beside(arm, 0.1), line=True)
    x, _, z, *_ = tool(arm, BENT)
    for q in preview["path"]:
        assert tool(arm, q)[0] == pytest.approx(x, abs=1e-6)
        assert tool(arm, q)[2] == pytest.approx(z, abs=1e-6)
    assert tool(arm, preview["path"][-1]) == pytest.approx(beside(arm, 0.1), abs=1e-6)


def test_a_preview_of_a_file_passes_its_points(arm: FakePlatform, tmp_path: Path) -> None:
    middle = [0.1, *BENT[1:]]
    file = tmp_path / "motion.yaml"
    points = "".join(f"  - {{t: {t}, q: {q}}}\n" for t, q in enumerate((BENT, middle, THERE)))
    file.write_text(f"trajectory:\n{points}")
    for approach in (False, True):
        preview = arm.ask("preview", file=str(file), approach=approach)
        assert min(max(map(abs, (a - b for a, b in zip(q, middle, strict=True)))) for q in preview["path"]) < 1e-2
        assert preview["path"][-1] == pytest.approx(THERE)


def test_a_preview_is_refused_with_what_would_refuse_the_move(arm: FakePlatform) -> None:
    error = arm.error("preview", q=[9.0, *BENT[1:]])
    assert (error.reason, error.fields["axis"]) == ("position_out_of_range", 0)
    assert arm.error("preview", q=THERE, speed=9.0).reason == "speed_out_of_range"
    assert "cannot be reached" in str(arm.error("preview", pose=[5.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_ik_inverts_fk_near_the_arm_or_near_what_is_given(arm: FakePlatform) -> None:
    pose = arm.ask("fk", q=THERE)["pose"]
    assert arm.ask("ik", pose=pose)["q"] == pytest.approx(THERE, abs=1e-9)
    turned = [*THERE[:3], 1.0, 0.5, -0.5]
    flipped = [*THERE[:3], 1.0 - math.pi, -0.5, math.pi - 0.5]
    pose = arm.ask("fk", q=turned)["pose"]
    for near in (turned, flipped):
        assert arm.ask("ik", pose=pose, near=near)["q"] == pytest.approx(near, abs=1e-9)
    assert (arm.loop.commands, arm.observer.holder()) == ([], "")


def test_ik_is_refused_with_how_far_or_which_joint_or_which_box(arm: FakePlatform) -> None:
    far = arm.error("ik", pose=[5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert (far.kind, far.reason) == ("refused", "out_of_reach")
    assert far.fields["distance"] > 3.0
    low, high = arm.config.cartesian.keep_out[0].min, arm.config.cartesian.keep_out[0].max
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    boxed = [arm.error("ik", pose=[*middle, rx, ry, 0.0]) for rx in (0.0, 1.5, 3.0) for ry in (-1.5, 0.0, 1.5)]
    assert {"in_box"} <= {error.reason for error in boxed} <= {"in_box", "joint_limited", "out_of_reach"}
    assert all(error.fields["box"] for error in boxed if error.reason == "in_box")
    arm.ask("set_limits", changes={"joint1.max": 0.2})
    limited = arm.error("ik", pose=arm.ask("fk", q=[1.0, *BENT[1:]])["pose"])
    assert limited.reason in ("joint_limited", "in_box")


@pytest.mark.parametrize(("method", "key"), [("fk", "q"), ("ik", "near")])
def test_a_configuration_with_too_few_joints_is_invalid(arm: FakePlatform, method: str, key: str) -> None:
    pose = {"pose": [0.0] * 6} if method == "ik" else {}
    error = arm.error(method, **pose, **{key: [0.0] * 5})
    assert (error.kind, str(error)) == ("invalid", f"{key}: found 5 numbers, allowed are 6: one a joint, rad")


FOLDED = [1.0, -1.9, 2.3, -2.9, -1.1, -0.2]
"""The forearm lies on the base."""
ITSELF = "a collision with itself (the base and the link of joint3)"


def test_a_way_that_leads_into_the_arm_itself_is_refused(arm: FakePlatform) -> None:
    config = replace(arm.config, cartesian=replace(arm.config.cartesian, box=None, keep_out=()))
    planner = Planner(config, Limits(config))
    with pytest.raises(RtcpError, match=re.escape(f"the move leads through {ITSELF} (after ")):
        planner.joint_move(FOLDED, [1.0, -1.6, 2.2, -2.9, -1.1, -0.2], None, True)
    points = [Point(0.0, tuple(BENT)), Point(60.0, tuple(FOLDED))]
    with pytest.raises(RtcpError, match=re.escape(ITSELF)):
        planner.trajectory(points, BENT)
