"""What the gateway makes of motions, held commands, limits and the stick, in front of a played loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.config import default_config, load
from rtcp.ipc.client import ControlClient
from rtcp.ipc.codes import Code, JogFrame, MotionMode, Reason, Refusal
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.machine import Command, State
from rtcp.ipc.runtime_directory import control_socket
from tests.runtime.played_loop import JOINTS, Loop

BENT = [0.0, 0.3, 1.57, 0.0, 0.8, 0.0]
CONFIG = load(default_config())
MASK, LEVELS, HOLD = 1, 2, 3


def wait_until(holds: Callable[[], bool], patience_s: float = 5.0) -> None:
    until = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < until, "it did not happen"
        time.sleep(0.01)


@pytest.fixture
def loop(gateway_client: ControlClient, gateway_loop: Loop) -> Loop:
    gateway_loop.state = State.HOLDING
    gateway_loop.q = list(BENT)
    wait_until(lambda: gateway_client.call("status")["joints"]["target"] == BENT)
    return gateway_loop


@pytest.fixture
def client(gateway_client: ControlClient, loop: Loop) -> ControlClient:
    return gateway_client


def tool_at(q: list[float]) -> list[float]:
    pose = forward(CONFIG.arm, q)  # type: ignore[arg-type]
    return [*pose.position, *pose.rpy]


def forced(loop: Loop) -> list[tuple[int, int]]:
    """The writes to the forced inputs, subindex and value, but for how long they hold."""
    return [write for write in written(loop) if write[0] != HOLD]


def written(loop: Loop) -> list[tuple[int, int]]:
    return [
        (subindex, int.from_bytes(bytes.fromhex(value), "little"))
        for index, subindex, value in loop.written
        if index == 0x2000
    ]


# -- motions that end -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("each", [False, True])
def test_a_move_tells_the_loop_whether_each_joint_goes_at_its_best(
    client: ControlClient, loop: Loop, each: bool
) -> None:
    client.call("move", {"q": [0.1] * JOINTS, "speed": 0.25, "each": each})
    assert loop.commands == [(Command.MOVE, *[0.1] * JOINTS, 0.0, 0.0, 0.0, 0.0, float(each), 0.25)]


def test_a_pose_is_reached_by_the_nearest_solution(client: ControlClient, loop: Loop) -> None:
    target = [0.1, 0.35, 1.5, 0.1, 0.7, 0.1]
    client.call("move_pose", {"pose": tool_at(target)})
    ((kind, *numbers),) = loop.commands
    assert kind == Command.MOVE
    assert numbers[:JOINTS] == pytest.approx(target, abs=1e-9)


@pytest.mark.parametrize(("line", "motion"), [(True, MotionMode.JOINT), (False, MotionMode.CARTESIAN)])
def test_a_line_is_written_as_a_plan_and_its_speed_is_that_of_the_tool(
    client: ControlClient, loop: Loop, line: bool, motion: MotionMode
) -> None:
    loop.motion = motion
    wait_until(lambda: client.call("status")["motion"] == motion.name.lower())
    goal = tool_at(BENT)
    goal[1] += 0.1
    loop.event_at_the_end = (Code.ARRIVED,)
    with pytest.raises(RtcpError, match="ended before it arrived"):
        # The played loop does not follow the line: that it is not there is noticed.
        client.call("move_pose", {"pose": goal, "line": line, "speed": 0.05})
    ((kind, slot, count, *_),) = loop.commands
    assert (kind, slot, count) == (Command.LINE, 0.0, 1.0)
    (row,) = loop.plans[0]
    assert row[7:10] == pytest.approx(goal[:3])
    assert row[14] * row[17] == pytest.approx(0.05)


UNREACHABLE = {
    "out of reach": ("move_pose", {"pose": [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]}, "out of reach by"),
    "a line out of reach": ("move_pose", {"pose": [-0.459, 0.0, 5.0, 0.0, -0.47, 0.0], "line": True}, "the line at 0."),
    "a path out of reach": ("line", {"poses": [[-0.459, 0.0, 5.0, 0.0, -0.47, 0.0]]}, "the line at 0."),
    "a pose in a box": ("move_pose", {"pose": [0.6, 0.0, 0.4, 0.0, 1.57, 0.0]}, "the keep-out box user"),
    "a speed beyond the tool's": ("line", {"poses": [tool_at(BENT)], "speed": 9.0}, "found a speed of 9 m/s"),
}


@pytest.mark.parametrize(("verb", "arguments", "sentence"), UNREACHABLE.values(), ids=UNREACHABLE.keys())
def test_what_the_arm_cannot_do_is_refused_before_the_loop_is_asked(
    client: ControlClient, loop: Loop, verb: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(RtcpError, match=sentence) as raised:
        client.call(verb, arguments)
    assert raised.value.kind == "refused"
    assert loop.commands == []


def test_a_trajectory_file_is_written_as_knots(client: ControlClient, loop: Loop, tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("t,q1,q2,q3,q4,q5,q6\n0,0,0.3,1.57,0,0.8,0\n2,0.1,0.3,1.57,0,0.8,0\n")
    result = client.call("run", {"file": str(file)})
    ((kind, _, count, *_),) = loop.commands
    assert (kind, count) == (Command.TRAJECTORY, 2.0)
    assert [row[0] for row in loop.plans[0]] == [0.0, 2.0]
    assert result["duration_s"] == 2.0


def test_a_trajectory_that_begins_elsewhere_is_approached_only_when_asked(
    client: ControlClient, loop: Loop, tmp_path: Path
) -> None:
    file = tmp_path / "t.csv"
    file.write_text("t,q1,q2,q3,q4,q5,q6\n0,0.5,0.3,1.57,0,0.8,0\n2,0.6,0.3,1.57,0,0.8,0\n")
    with pytest.raises(RtcpError, match="at time 0 s joint1 must be where it is"):
        client.call("run", {"file": str(file)})
    assert loop.commands == []
    client.call("run", {"file": str(file), "approach": True})
    assert [command[0] for command in loop.commands] == [Command.MOVE, Command.TRAJECTORY]
    assert loop.commands[0][1] == 0.5


def test_a_mistake_in_a_motion_file_is_named_with_its_line(client: ControlClient, loop: Loop, tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("t,q1,q2,q3,q4,q5,q6\n1,0,0,0,0,0,0\n1,0,0,0,0,0,0\n")
    with pytest.raises(RtcpError, match=r"t\.csv:3: t: found 1 after 1; times must rise") as raised:
        client.call("run", {"file": str(file)})
    assert raised.value.kind == "invalid"
    assert loop.commands == []


def test_a_motion_that_a_guard_stops_ends_in_the_guards_sentence(client: ControlClient, loop: Loop) -> None:
    loop.event_at_the_end = (Code.ENDED + Reason.KEEP_OUT, 0, 0.01, 0.0)
    loop.ends_in = State.STOPPED_BY_LIMIT
    with pytest.raises(RtcpError, match="the move was stopped by a limit: the arm stopped before") as raised:
        client.call("move", {"q": [0.1] * JOINTS})
    assert raised.value.kind == "fault"


def test_a_motion_that_ends_early_is_no_arrival(client: ControlClient, loop: Loop) -> None:
    loop.event_at_the_end = (Code.NOT_PERMITTED,)
    with pytest.raises(RtcpError, match="the move ended before it arrived: the enabling switch was let go"):
        client.call("move", {"q": [0.1] * JOINTS})


def test_a_reset_of_a_stop_by_a_limit_waits_for_no_disabling(client: ControlClient, loop: Loop) -> None:
    loop.state = State.STOPPED_BY_LIMIT
    wait_until(lambda: client.call("status")["state"].replace("_", " ") == "stopped by limit")
    assert client.call("reset") == {}
    assert [command[0] for command in loop.commands] == [Command.RESET]


# -- held commands --------------------------------------------------------------------------------------------------


def test_a_jog_keeps_one_lease_until_its_connection_closes(
    client: ControlClient, loop: Loop, gateway_directory: Path
) -> None:
    with ControlClient("a jogger", control_socket(gateway_directory)) as jogger:
        for _ in range(3):
            jogger.call("jog", {"v": [0.1, 0, 0, 0, 0, 0], "frame": "tool", "hold_s": 0.2})
        assert client.call("status")["lease"]["holder"] == "a jogger"
        with pytest.raises(RtcpError, match="the arm is commanded by a jogger"):
            client.call("move", {"q": BENT})
    wait_until(lambda: client.call("status")["lease"]["holder"] == "")
    jog = (Command.JOG, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, JogFrame.TOOL, 0.2)
    assert loop.commands == [jog] * 3


def test_a_jogger_that_falls_silent_loses_its_lease(
    client: ControlClient, loop: Loop, gateway_directory: Path
) -> None:  # fmt: skip
    with ControlClient("a jogger", control_socket(gateway_directory)) as jogger:
        jogger.call("jog", {"v": [0.1, 0, 0, 0, 0, 0], "frame": "base"})
        wait_until(lambda: client.call("status")["lease"]["holder"] == "", patience_s=CONFIG.lease_s + 1)
        client.call("output", {"number": 8, "value": True})
        jogger.call("jog", {"v": [0.1, 0, 0, 0, 0, 0], "frame": "base"})


@pytest.mark.parametrize(
    ("motion", "command"), [(MotionMode.JOINT, Command.JOG), (MotionMode.VELOCITY, Command.VELOCITY)]
)
def test_a_jog_of_joints_is_a_velocity_in_the_mode_velocity(
    client: ControlClient, loop: Loop, motion: MotionMode, command: Command
) -> None:
    loop.motion = motion
    wait_until(lambda: client.call("status")["motion"] == motion.name.lower())
    client.call("jog", {"v": [0.1] * JOINTS, "frame": "joints"})
    assert [found[0] for found in loop.commands] == [command]


# -- limits ---------------------------------------------------------------------------------------------------------


def test_limits_are_changed_all_at_once_and_shown(client: ControlClient, loop: Loop) -> None:
    shown = client.call("limits")
    assert shown["limits"] == shown["configured"]
    client.call("limits", {"set": {"joint2.max": 1.0, "joints.velocity": 0.4, "user.max.z": 0.9}})
    (rows,) = loop.plans
    joints, boxes = rows[1 : 1 + JOINTS], rows[1 + JOINTS :]
    assert [joint[1] for joint in joints] == [3.1, 1.0, 2.4, 3.1, 2.0, 3.1]
    assert [joint[2] for joint in joints] == [0.4] * JOINTS
    assert boxes[1][:6] == [0.42, -0.35, -0.1, 1.1, 0.35, 0.9]
    assert client.call("limits")["limits"]["max"][1] == 1.0
    client.call("limits", {"set": {"joint2.max": 2.0, "joints.velocity": 0.5, "user.max.z": 0.85}})
    assert client.call("limits")["limits"] == shown["limits"]


def test_limits_that_the_loop_refuses_are_not_in_force(client: ControlClient, loop: Loop) -> None:
    before = client.call("limits")["limits"]
    loop.refusals[Command.LIMITS] = (Refusal.LIMITS_OUTSIDE, 1, 0.3, 0.1)
    with pytest.raises(RtcpError, match="nothing was changed"):
        client.call("limits", {"set": {"joint2.max": 0.1}})
    assert client.call("limits")["limits"] == before


# -- the stick ------------------------------------------------------------------------------------------------------


def test_the_stick_is_forced_by_levels_first_and_let_go_of_by_the_mask(client: ControlClient, loop: Loop) -> None:
    client.call("stick", {"pressed": ["forward"], "hold_s": 0.3})
    assert forced(loop) == [(LEVELS, 62), (MASK, 63)]
    wait_until(lambda: forced(loop)[-1] == (MASK, 0))


def test_the_box_is_told_to_let_go_by_itself_before_anything_is_forced(client: ControlClient, loop: Loop) -> None:
    client.call("stick", {"pressed": ["forward"], "hold_s": 0.3})
    found = written(loop)
    assert found.index((HOLD, 1500)) < found.index((MASK, 63))


def test_the_stick_is_let_go_of_when_its_holder_falls_silent(client: ControlClient, loop: Loop) -> None:
    begun = time.monotonic()
    client.call("stick", {"pressed": ["left"], "hold_s": 0.3})
    wait_until(lambda: forced(loop)[-1] == (MASK, 0))
    assert 0.25 < time.monotonic() - begun < 1.0


def test_the_stick_is_let_go_of_when_its_holders_connection_closes(
    client: ControlClient, loop: Loop, gateway_directory: Path
) -> None:
    with ControlClient("a stick", control_socket(gateway_directory)) as stick:
        stick.call("stick", {"pressed": ["left"], "hold_s": 1.0})
        with pytest.raises(RtcpError, match="the stick is held by a stick"):
            client.call("stick", {"pressed": ["right"]})
    wait_until(lambda: forced(loop)[-1] == (MASK, 0), patience_s=0.5)


def test_a_stick_that_is_said_again_is_held_without_a_gap(client: ControlClient, loop: Loop) -> None:
    until = time.monotonic() + 0.6
    while time.monotonic() < until:
        client.call("stick", {"pressed": ["backward"], "hold_s": 0.2})
        time.sleep(0.05)
    assert forced(loop) == [(LEVELS, 61), (MASK, 63)]
    wait_until(lambda: forced(loop)[-1] == (MASK, 0))


def test_inputs_are_forced_while_the_arm_moves_too(client: ControlClient, loop: Loop) -> None:
    loop.state = State.MOVING
    client.call("stick", {"pressed": [], "byte": 58, "hold_s": 0.1})
    assert forced(loop)[0] == (LEVELS, 58)
    wait_until(lambda: forced(loop)[-1] == (MASK, 0))
