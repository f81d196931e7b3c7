"""Policies on a whole platform, on the virtual segment."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'rtcp[gym]'")

import gymnasium

import rtcp
from rtcp.config.model import ArmConfig
from rtcp.gym import ArmEnv, Ended, deploy
from rtcp.ipc.events import BoxReached, SetpointOutOfRange, StreamEnded
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ipc.states import ControlMode, State
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

BENT = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]
GOAL = np.array([0.1, 0.35, 1.5, 0.05, 0.55, -0.1])


@pytest.fixture
def robot(enabled: Platform) -> Iterator[rtcp.Robot]:
    with rtcp.connect("a policy", control_socket(enabled.directory)) as robot:
        if robot.state is State.STOPPED_BY_LIMIT:
            robot.reset()
        robot.mode("joint")
        robot.move_joints(BENT)
        yield robot


def towards(action: str) -> Any:
    """A policy that leads the joints to `GOAL`."""
    if action == "joint_positions":
        return lambda seen: GOAL
    return lambda seen: np.clip(2.0 * (GOAL - seen["actual_position"]), -0.3, 0.3)


@pytest.mark.parametrize("action", ["joint_positions", "joint_velocities"])
def test_a_policy_moves_the_robot_as_it_moves_the_simulated_arm(
    robot: rtcp.Robot, config: ArmConfig, action: str
) -> None:
    policy, seen = towards(action), []

    class Task(ArmEnv):
        def __init__(self, **arguments: Any) -> None:
            super().__init__(action, rate_hz=20.0, **arguments)

        def reward(self, observation: Any, action: Any, info: Any) -> float:
            return -float(np.abs(observation["actual_position"] - GOAL).max())

    def remembering(observation: Any) -> Any:
        seen.append(observation["actual_position"])
        return policy(observation)

    done = deploy(remembering, robot, Task, seconds=1.5, options={"positions": BENT})
    assert (done.ended, done.state, done.refusal) == (Ended.TIME, State.HOLDING, None)
    assert robot.status().control_mode is ControlMode.JOINT
    simulated = Task(config=config)
    observation, _ = simulated.reset(options={"positions": BENT})
    path = [observation["actual_position"]]
    for _ in range(len(seen) - 1):
        observation, _, _, _, _ = simulated.step(policy(observation))
        path.append(observation["actual_position"])
    simulated.close()
    # A robot's policy takes its time, and so does the way of its action: 0.3 rad/s and some 30 ms.
    late = done.largest_delay_s + 0.03
    assert np.abs(np.array(seen) - np.array(path)).max() < 0.01 + 0.3 * late
    assert robot.positions == pytest.approx(path[-1], abs=0.01 + 0.3 * late)
    assert np.abs(path[-1] - path[0]).max() > 0.09
    assert done.reward < 0.0


def assert_at_rest(robot: rtcp.Robot) -> None:
    """The status is up to 0.1 s old."""
    time.sleep(0.2)
    assert robot.status().velocities == pytest.approx([0.0] * 6, abs=0.02)


@pytest.mark.parametrize("action", ["joint_torques", "tool_velocities"])
def test_torques_and_velocities_of_the_tool_move_the_robot_by_the_same_way(robot: rtcp.Robot, action: str) -> None:
    push = {"joint_torques": [12.0, 0, 0, 0, 0, 0], "tool_velocities": [0, 0.1, 0, 0, 0, 0]}[action]

    def make(robot: rtcp.Robot) -> Any:
        made = gymnasium.make(f"rtcp.gym:rtcp/{action.title().replace('_', '')}-v0", robot=robot, max_episode_steps=30)
        return gymnasium.wrappers.FlattenObservation(made)

    before = robot.positions[0]
    done = deploy(lambda seen: np.array(push), robot, make)
    assert (done.ended, done.steps, done.state) == (Ended.TRUNCATED, 30, State.HOLDING), done
    assert abs(robot.positions[0] - before) > 0.02
    assert robot.status().control_mode is ControlMode.JOINT
    assert_at_rest(robot)


def test_a_policy_that_raises_leaves_the_arm_at_rest_in_the_control_mode_of_before(robot: rtcp.Robot) -> None:
    def policy(seen: Any) -> Any:
        if abs(seen["actual_velocity"][0]) > 0.1:
            raise ZeroDivisionError("a mistake in the policy")
        return [0.3, 0, 0, 0, 0, 0]

    with pytest.raises(ZeroDivisionError):
        deploy(policy, robot, lambda robot: ArmEnv("joint_velocities", robot=robot))
    status = robot.status()
    assert (status.state, status.control_mode) == (State.HOLDING, ControlMode.JOINT)
    assert_at_rest(robot)
    robot.move_joints(BENT)


def test_guards_end_a_policys_motion_on_the_robot_as_in_the_simulation(robot: rtcp.Robot) -> None:
    outside = deploy(lambda seen: [9.0, *BENT[1:]], robot)
    assert outside.ended is Ended.TERMINATED
    assert SetpointOutOfRange(0, 9.0, 3.1) in outside.events
    assert outside.state is State.HOLDING
    boxed = deploy(lambda seen: [0.0, 1.3, 0.5, 0.0, 0.5, 0.0], robot)
    assert boxed.ended is Ended.TERMINATED
    assert [event for event in boxed.events if isinstance(event, BoxReached)]
    assert boxed.state is State.STOPPED_BY_LIMIT
    with pytest.raises(rtcp.Refused, match=r"robot\.enable"):
        deploy(lambda seen: BENT, robot)
    robot.reset()


def test_a_policy_that_is_late_brings_the_arm_to_rest_and_the_result_says_how_late(robot: rtcp.Robot) -> None:
    calls = 0

    def policy(seen: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 10:
            time.sleep(1.0)
        return [0.2, *BENT[1:]]

    done = deploy(policy, robot)
    assert (done.ended, done.state) == (Ended.TERMINATED, State.HOLDING)
    assert StreamEnded() in done.events
    assert isinstance(done.refusal, rtcp.TimedOut)
    assert done.largest_delay_s == pytest.approx(1.0, abs=0.3)
    assert done.late_steps >= 1


def test_without_an_episode_nothing_is_commanded(robot: rtcp.Robot) -> None:
    made = ArmEnv("joint_velocities", robot=robot)
    robot.mode("velocity")
    with pytest.raises(rtcp.Invalid, match="call reset"):
        made.step([0.3, 0, 0, 0, 0, 0])
    made.reset()
    made.close()
    with pytest.raises(rtcp.Invalid, match="call reset"):
        made.step([0.3, 0, 0, 0, 0, 0])
    with pytest.raises(rtcp.Invalid, match="is closed"):
        made.reset(options={"positions": GOAL})
    assert robot.state is State.HOLDING
    assert robot.positions == pytest.approx(BENT, abs=2e-3)
    robot.mode("joint")


def test_a_deployment_that_would_not_move_this_robot_as_learnt_is_refused(robot: rtcp.Robot, config: ArmConfig) -> None:
    with pytest.raises(rtcp.Invalid, match="pass the argument `robot`"):
        deploy(towards("joint_positions"), robot, lambda robot: ArmEnv(config=config))
    faster = replace(config, joints=tuple(replace(joint, velocity=2 * joint.velocity) for joint in config.joints))
    with pytest.raises(rtcp.Invalid, match="those of the robot"):
        deploy(towards("joint_velocities"), robot, partial(ArmEnv, "joint_velocities", config=faster))
    with pytest.raises(rtcp.Invalid, match="seconds: found nan"):
        deploy(towards("joint_positions"), robot, seconds=float("nan"))


def test_an_arm_that_is_not_enabled_is_not_moved(robot: rtcp.Robot) -> None:
    robot.disable()
    with pytest.raises(rtcp.Refused, match="the arm is in state ready") as raised:
        deploy(lambda seen: BENT, robot)
    assert raised.value.fields == {"state": "ready"}
    robot.enable()


PROGRAM = """
import sys, pathlib, rtcp, rtcp.gym
with rtcp.connect("a program", pathlib.Path(sys.argv[1])) as robot:
    def policy(seen):
        if abs(seen["actual_velocity"][0]) > 0.05:
            print("moving", flush=True)
        return [0.2, 0, 0, 0, 0, 0]
    done = rtcp.gym.deploy(policy, robot, lambda robot: rtcp.gym.ArmEnv("joint_velocities", robot=robot))
    print(done.ended.name, done.state.name, robot.status().control_mode.name)
"""


def test_ctrl_c_ends_a_deployment_with_the_arm_at_rest(enabled: Platform, robot: rtcp.Robot) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(control_socket(enabled.directory))],
        env={**os.environ, **enabled.environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert program.stdout is not None
    assert program.stdout.readline() == "moving\n"
    program.send_signal(signal.SIGINT)
    said, problems = program.communicate()
    assert said.splitlines()[-1] == "INTERRUPTED HOLDING JOINT", problems
    assert problems == ""


def test_the_examples_of_the_page_run(enabled: Platform, robot: rtcp.Robot) -> None:
    page = (Path(__file__).parents[2] / "docs/gym.md").read_text()
    first, task, deployed = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    # The robot is enabled already; it is moved by another commander now.
    robot.disable()
    for program in (first, task + deployed):
        command, environment = [sys.executable, "-c", program], {**os.environ, **enabled.environment}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert "Ended.TIME" in done.stdout, done.stdout
