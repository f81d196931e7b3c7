"""Policies on a whole platform, on the virtual segment."""

from __future__ import annotations

import contextlib
import io
import re
import signal
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
from rtcp.ipc.events import SetpointOutOfRange, StreamEnded
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ipc.states import ControlMode, State
from tests.e2e.conftest import Platform
from tests.waiting import until

pytestmark = pytest.mark.platform

BENT = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]
GOAL = np.array([0.1, 0.35, 1.5, 0.05, 0.55, -0.1])


@pytest.fixture
def robot(enabled: Platform) -> Iterator[rtcp.Robot]:
    with rtcp.connect("a policy", control_socket(enabled.directory)) as robot:
        robot.mode("joint")
        robot.move_joints(BENT)
        yield robot


def towards_goal(seen: Any) -> Any:
    """A policy that leads the joints to `GOAL` by velocities."""
    return np.clip(2.0 * (GOAL - seen["actual_position"]), -0.3, 0.3)


def test_a_policy_moves_the_robot_as_it_moves_the_simulated_arm(robot: rtcp.Robot, config: ArmConfig) -> None:
    seen = []

    class Task(ArmEnv):
        def __init__(self, **arguments: Any) -> None:
            super().__init__("joint_velocities", rate_hz=20.0, **arguments)

        def reward(self, observation: Any, action: Any, info: Any) -> float:
            return -float(np.abs(observation["actual_position"] - GOAL).max())

    def make(robot: rtcp.Robot) -> Any:
        return gymnasium.wrappers.TimeLimit(Task(robot=robot), 30)

    def policy(observation: Any) -> Any:
        seen.append(observation["actual_position"])
        return towards_goal(observation)

    done = deploy(policy, robot, make, options={"positions": BENT})
    assert (done.ended, done.steps, done.state, done.refusal) == (Ended.TRUNCATED, 30, State.HOLDING, None)
    assert done.reward < 0.0
    assert robot.status().control_mode is ControlMode.JOINT
    simulated = Task(config=config)
    observation, _ = simulated.reset(options={"positions": BENT})
    path = [observation["actual_position"]]
    for _ in range(80):
        observation, _, _, _, _ = simulated.step(towards_goal(observation))
        path.append(observation["actual_position"])
    simulated.close()
    # The robot may be late on the path, by as much as its host takes: each place of it is one of the path.
    distances = [min(np.abs(place - other).max() for other in path) for place in seen]
    assert max(distances) < 0.02
    assert np.abs(seen[-1] - path[0]).max() > 0.05
    assert_at_rest(robot)


def assert_at_rest(robot: rtcp.Robot) -> None:
    until(lambda: robot.status().velocities == pytest.approx([0.0] * 6, abs=0.02), "an arm at rest")


def test_whatever_ends_a_policy_leaves_the_arm_at_rest_in_the_control_mode_of_before(robot: rtcp.Robot) -> None:
    def velocities(robot: rtcp.Robot) -> Any:
        return ArmEnv("joint_velocities", robot=robot)

    def fails(seen: Any) -> Any:
        if abs(seen["actual_velocity"][0]) > 0.1:
            raise ZeroDivisionError("a mistake in the policy")
        return [0.3, 0, 0, 0, 0, 0]

    def is_interrupted(seen: Any) -> Any:
        if abs(seen["actual_velocity"][0]) > 0.05:
            signal.raise_signal(signal.SIGINT)
        return [-0.2, 0, 0, 0, 0, 0]

    def hangs(seen: Any) -> Any:
        if abs(seen["actual_velocity"][0]) > 0.05:
            until(lambda: "stream_ended" in [event.name for event in robot.events(before)], "the end of the stream")
        return [0.2, *BENT[1:]]

    def pushes(robot: rtcp.Robot) -> Any:
        made = gymnasium.make("rtcp.gym:rtcp/JointTorques-v0", robot=robot, max_episode_steps=30)
        return gymnasium.wrappers.FlattenObservation(made)

    begun = robot.positions[0]
    pushed = deploy(lambda seen: np.array([12.0, 0, 0, 0, 0, 0]), robot, pushes)
    assert (pushed.ended, pushed.steps, pushed.state) == (Ended.TRUNCATED, 30, State.HOLDING), pushed
    assert abs(robot.positions[0] - begun) > 0.02
    assert_holds(robot)
    with pytest.raises(ZeroDivisionError):
        deploy(fails, robot, velocities)
    assert_holds(robot)
    interrupted = deploy(is_interrupted, robot, velocities)
    assert (interrupted.ended, interrupted.state) == (Ended.INTERRUPTED, State.HOLDING)
    assert_holds(robot)
    before = max(event.number for event in robot.events())
    late = deploy(hangs, robot)
    assert (late.ended, late.state) == (Ended.TERMINATED, State.HOLDING)
    assert StreamEnded() in late.events
    assert isinstance(late.refusal, rtcp.TimedOut)
    assert late.largest_delay_s > 0.1
    assert late.late_steps >= 1
    assert_holds(robot)
    outside = deploy(lambda seen: [9.0, *BENT[1:]], robot)
    assert outside.ended is Ended.TERMINATED
    assert SetpointOutOfRange(0, 9.0, 3.1) in outside.events
    assert_holds(robot)


def assert_holds(robot: rtcp.Robot) -> None:
    status = robot.status()
    assert (status.state, status.control_mode) == (State.HOLDING, ControlMode.JOINT)
    assert_at_rest(robot)


def test_nothing_moves_without_an_episode_or_an_enabled_robot_or_in_an_environment_of_another_one(
    robot: rtcp.Robot, config: ArmConfig
) -> None:
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
    robot.mode("joint")
    with pytest.raises(rtcp.Invalid, match="pass the argument `robot`"):
        deploy(lambda seen: GOAL, robot, lambda robot: ArmEnv(config=config))
    faster = replace(config, joints=tuple(replace(joint, velocity=2 * joint.velocity) for joint in config.joints))
    with pytest.raises(rtcp.Invalid, match="those of the robot"):
        deploy(towards_goal, robot, partial(ArmEnv, "joint_velocities", config=faster))
    with pytest.raises(rtcp.Invalid, match="seconds: found nan"):
        deploy(lambda seen: GOAL, robot, seconds=float("nan"))
    robot.disable()
    with pytest.raises(rtcp.Refused, match="the arm is in state ready") as raised:
        deploy(lambda seen: BENT, robot)
    assert raised.value.fields == {"state": "ready"}
    assert robot.positions == pytest.approx(BENT, abs=2e-3)


def test_the_examples_of_the_page_run(enabled: Platform, robot: rtcp.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs/gym.md").read_text()
    first, task, deployed = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    # The robot is enabled already; it is moved by another commander now.
    robot.disable()
    for name, value in enabled.environment.items():
        monkeypatch.setenv(name, value)
    exec(first, {"__name__": "__main__"})
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(task + deployed.replace("seconds=5.0", "seconds=1.0"), {"__name__": "__main__"})
    assert "Ended.TIME" in said.getvalue()
