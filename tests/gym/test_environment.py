"""Environments of the arm in simulated time: the real loop, guards and device models."""

from __future__ import annotations

import gc
import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'rtcp[gym]'")

import gymnasium
from gymnasium.utils.env_checker import check_env

import rtcp
from rtcp.config import default_config
from rtcp.config.model import ArmConfig, InputConfig
from rtcp.gym import ACTION_TIMEOUT_S, ACTIONS, ArmEnv
from rtcp.ipc.commands import Disable
from rtcp.ipc.events import BoxReached, CommandExpired, ProcessDataLost, SetpointNotFinite, SetpointOutOfRange
from rtcp.ipc.states import State
from tests.gym.conftest import Make

BENT = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]
SI = "recommend using a symmetric and normalized space"


class Reach(ArmEnv):
    """A task: the tool at a place that the episode draws."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, observe=("tool_x", "tool_y", "tool_z"), **named)
        self.observation_space["goal"] = gymnasium.spaces.Box(-2.0, 2.0, (3,), np.float64)
        self.goal = np.zeros(3)

    def begin_episode(self, options: Mapping[str, Any]) -> None:
        self.goal = self.np_random.uniform(-0.5, 0.5, 3)

    def observation(self) -> dict[str, Any]:
        return {**super().observation(), "goal": self.goal.copy()}

    def reward(self, observation: Any, action: Any, info: Any) -> float:
        tool = np.concatenate([observation[name] for name in ("tool_x", "tool_y", "tool_z")])
        return -float(np.linalg.norm(tool - observation["goal"]))


def run(environment: Any, seed: int, steps: int = 15) -> list[Any]:
    """Return what an episode of random actions shows: observations, rewards and events."""
    environment.action_space.seed(7)
    shown = [environment.reset(seed=seed)]
    shown += [environment.step(environment.action_space.sample()) for _ in range(steps)]
    return shown


def as_bytes(shown: Any) -> Any:
    """Return the same with arrays as their bytes, so that two runs compare to the bit."""
    if isinstance(shown, dict):
        return {name: as_bytes(value) for name, value in shown.items()}
    if isinstance(shown, list | tuple):
        return [as_bytes(value) for value in shown]
    return shown.tobytes() if isinstance(shown, np.ndarray) else shown


def until_terminated(environment: Any, action: Any, steps: int = 400) -> dict[str, Any]:
    for _ in range(steps):
        _, _, terminated, _, info = environment.step(np.asarray(action))
        if terminated:
            return dict(info)
    raise AssertionError(f"not terminated after {steps} steps")


@pytest.mark.parametrize("action", ACTIONS)
def test_gymnasiums_checker_finds_nothing_but_that_units_are_si(config: ArmConfig, action: str) -> None:
    name = action.title().replace("_", "")
    made = gymnasium.make(f"rtcp.gym:rtcp/{name}-v0", config=config)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(made.unwrapped)
    made.observation_space.sample()
    made.close()
    assert [str(warning.message) for warning in caught if SI not in str(warning.message)] == []


def test_a_seed_gives_the_same_run_to_the_bit_and_another_seed_another(make: Make) -> None:
    # The reference clock's time is by chance; the rest follows from the actions.
    observe = ("actual_position", "actual_torque", "dc_time_ns")
    for action in ACTIONS:
        first, second = make(action, observe=observe), make(action, observe=observe)
        # An episode before does not matter: a seed begins anew.
        run(second, 5, 3)
        assert as_bytes(run(first, 1)) == as_bytes(run(second, 1))
        assert as_bytes(run(first, 1)) != as_bytes(run(second, 2))
    task = make("joint_velocities", Reach)
    assert task.reset(seed=1)[0]["goal"] == pytest.approx(task.reset(seed=1)[0]["goal"], abs=0.0)
    assert task.reset(seed=1)[0]["goal"] != pytest.approx(task.reset(seed=2)[0]["goal"])


def test_an_episode_begins_at_the_positions_of_its_options_holding_in_the_control_mode_of_its_actions(
    make: Make,
) -> None:
    modes = {}
    for action in ACTIONS:
        made = make(action, observe=("actual_position", "control_mode", "drive_mode"))
        seen, info = made.reset(options={"positions": BENT})
        assert seen["actual_position"] == pytest.approx(BENT, abs=2e-3)
        # An open stream is a motion, also before its first setpoint.
        state = State.MOVING if action == "joint_positions" else State.HOLDING
        assert info == {"events": (), "state": state}
        modes[action] = int(seen["control_mode"][0]), int(seen["drive_mode"][0])
        made.close()
    # ControlMode, and CiA 402's modes CSP 8, CSV 9, CST 10.
    assert modes == {
        "joint_positions": (1, 8), "joint_velocities": (4, 9), "joint_torques": (5, 10), "tool_velocities": (2, 8),
    }  # fmt: skip


def test_an_arm_with_an_enabling_switch_has_it_pressed(config: ArmConfig, make: Make) -> None:
    switched = replace(config, inputs=replace(config.inputs, enabling_switch=InputConfig(16)))
    made = make("joint_velocities", config=switched)
    made.reset(options={"positions": BENT})
    _, _, _, _, info = made.step([0.1, 0, 0, 0, 0, 0])
    assert info == {"events": (), "state": State.MOVING}


def test_an_arm_that_cannot_be_brought_to_holding_is_an_error_of_the_reset(config: ArmConfig, make: Make) -> None:
    hasty = replace(config, enable_timeout_s=1e-3)
    with pytest.raises(rtcp.Faulted, match="cannot be brought to holding"):
        make("joint_velocities", config=hasty).reset(options={"positions": BENT})


def test_each_kind_of_action_moves_the_arm_as_it_says(make: Make) -> None:
    fields = ("cycle", "actual_position", "actual_velocity", "tool_vx", "tool_vy")
    moved = {}
    target = [0.05, *BENT[1:]]
    for action, values in (
        ("joint_positions", target),
        ("joint_velocities", [0.2, 0, 0, 0, 0, 0]),
        ("joint_torques", [10.0, 0, 0, 0, 0, 0]),
        ("tool_velocities", [0, 0.05, 0, 0, 0, 0]),
    ):
        made = make(action, observe=fields)
        begun, _ = made.reset(options={"positions": BENT})
        for _ in range(50):
            seen, reward, terminated, _, info = made.step(np.array(values, np.float32))
            assert (reward, terminated, info) == (0.0, False, {"events": (), "state": State.MOVING})
        # A step of 20 ms is 10 cycles.
        assert seen["cycle"] - begun["cycle"] == 500
        moved[action] = seen
        made.close()
    assert moved["joint_positions"]["actual_position"] == pytest.approx(target, abs=2e-3)
    assert moved["joint_velocities"]["actual_velocity"] == pytest.approx([0.2, 0, 0, 0, 0, 0], abs=0.02)
    assert moved["joint_torques"]["actual_velocity"][0] > 0.1
    assert moved["joint_torques"]["actual_position"][1:] == pytest.approx(BENT[1:], abs=0.02)
    assert moved["tool_velocities"]["tool_vy"] == pytest.approx([0.05], abs=0.005)
    assert moved["tool_velocities"]["tool_vx"] == pytest.approx([0.0], abs=0.005)


def test_a_policy_that_drives_into_a_keep_out_box_terminates_with_the_guards_event(make: Make) -> None:
    made = make("joint_positions")
    made.reset(options={"positions": BENT})
    # Towards the user: the guard of the trajectory ends the motion before a body comes near.
    info = until_terminated(made, [0.0, 1.3, 0.5, 0.0, 0.5, 0.0])
    (event,) = (event for event in info["events"] if isinstance(event, BoxReached))
    assert info["state"] in (State.STOPPING, State.STOPPED_BY_LIMIT)
    assert "the arm stopped" in made.names.message(event)
    # Nothing moves it on, and nothing else is raised.
    _, _, terminated, _, info = made.step(made.action_space.sample())
    assert terminated


def test_a_fault_terminates_the_episode_with_its_event(make: Make) -> None:
    made = make("joint_velocities")
    made.reset()
    made.arm.simulation.data.lose(100_000, heard=True)
    info = until_terminated(made, [0.1, 0, 0, 0, 0, 0])
    assert [type(event) for event in info["events"] if event.is_fault] == [ProcessDataLost]
    assert info["state"] is State.FAULT


def test_a_person_who_takes_the_torque_off_terminates_the_episode(make: Make) -> None:
    made = make("joint_torques")
    made.reset()
    made.arm.simulation.do(Disable())
    info = until_terminated(made, [0.0] * 6, 1)
    assert info["state"] in (State.DISABLING, State.READY)
    assert info["refusal"].reason == "wrong_state"


def test_a_setpoint_outside_the_range_or_not_a_number_ends_the_stream_and_the_episode(make: Make) -> None:
    made = make("joint_positions")
    for value, kind in ((9.0, SetpointOutOfRange), (float("nan"), SetpointNotFinite)):
        made.reset(options={"positions": BENT})
        info = until_terminated(made, [value, *BENT[1:]], 2)
        assert type(info["events"][0]) is kind


@pytest.mark.parametrize(
    ("action", "values", "reason"),
    [
        ("joint_velocities", [9.0, 0, 0, 0, 0, 0], "joint_speed_out_of_range"),
        ("joint_torques", [900.0, 0, 0, 0, 0, 0], "torque_out_of_range"),
        ("tool_velocities", [9.0, 0, 0, 0, 0, 0], "jog_speed_out_of_range"),
        ("joint_velocities", [float("nan"), 0, 0, 0, 0, 0], ""),
    ],
)
def test_an_action_that_is_not_accepted_says_why_and_the_one_before_lasts_its_time(
    make: Make, action: str, values: list[float], reason: str
) -> None:
    made = make(action)
    made.reset(options={"positions": BENT})
    small = np.full(6, 0.01, np.float32)
    _, _, _, _, info = made.step(small)
    assert "refusal" not in info
    for step in range(100):  # noqa: B007
        seen, _, terminated, _, info = made.step(np.array(values))
        if terminated:
            break
        assert isinstance(info["refusal"], rtcp.Invalid if not reason else rtcp.Refused)
        assert info["refusal"].reason == reason
    assert step == pytest.approx(ACTION_TIMEOUT_S * made.rate_hz, abs=2)
    assert isinstance(info["refusal"], rtcp.TimedOut) or CommandExpired() in info["events"]
    # It is not sent any more: an arm that rests does not move again.
    for _ in range(20):
        seen, _, terminated, _, info = made.step(small)
        assert terminated
        assert isinstance(info["refusal"], rtcp.TimedOut)
    assert seen["actual_velocity"] == pytest.approx([0.0] * 6, abs=0.01)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"observe": ("actual_positoin",)}, "no field 'actual_positoin', allowed are number, "),
        ({"observe": "actual_positoin"}, "no field 'actual_positoin', allowed are number, "),
        ({"action": "joint_speeds"}, "found 'joint_speeds', allowed are joint_positions, joint_velocities"),
        ({"rate_hz": 5.0}, "rate_hz: found 5, allowed are 10 Hz and more"),
        ({"rate_hz": 60.0}, "a step of 8.33333 cycles of 2000 us"),
        ({"rate_hz": float("nan")}, "rate_hz: found nan"),
        ({"config": default_config().parent / "heater.yaml"}, "heater has no joints"),
    ],
)
def test_an_argument_that_is_wrong_is_an_error_that_says_what_is_allowed(
    config: ArmConfig, arguments: dict[str, Any], said: str
) -> None:
    with pytest.raises(rtcp.Invalid) as raised:
        ArmEnv(**{"config": config, **arguments})
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("positions", "said"),
    [
        ([0.0], "allowed are 6 numbers"),
        ("bent", "allowed are 6 numbers"),
        ([0.0, 2.5, 0, 0, 0, 0], "joint2 at 2.5 rad, its range is -2 to 2 rad"),
        ([float("nan")] * 6, "joint1 at nan rad"),
    ],
)
def test_positions_that_no_joint_can_stand_at_are_refused(make: Make, positions: Any, said: str) -> None:
    made = make("joint_positions")
    made.reset()
    with pytest.raises(rtcp.Invalid) as raised:
        made.reset(options={"positions": positions})
    assert said in str(raised.value)
    with pytest.raises(rtcp.Invalid, match="call reset"):
        made.step(np.zeros(6))


@pytest.mark.parametrize("action", [np.zeros(7), ["left"] * 6, "left"])
def test_an_action_that_is_not_a_number_for_each_joint_is_an_error(make: Make, action: Any) -> None:
    made = make("joint_velocities")
    made.reset()
    with pytest.raises(rtcp.Invalid, match="action: found"):
        made.step(action)


def test_an_episode_of_which_no_action_is_accepted_ends_like_any_other_without_actions(make: Make) -> None:
    made = make("joint_velocities")
    for _ in range(2):
        made.reset()
        for step in range(100):  # noqa: B007
            _, _, terminated, _, info = made.step([float("nan")] * 6)
            if terminated:
                break
        assert step == pytest.approx(ACTION_TIMEOUT_S * made.rate_hz, abs=2)
        assert isinstance(info["refusal"], rtcp.TimedOut)


def test_no_bound_of_an_action_is_beyond_the_limit_that_it_stands_for(make: Make, config: ArmConfig) -> None:
    for action, kind in ACTIONS.items():
        space = make(action).action_space
        low, high = kind.bounds(config)
        assert (space.low.astype(np.float64) >= low).all()
        assert (space.high.astype(np.float64) <= high).all()
        assert space.high == pytest.approx(np.array(high), rel=1e-6)


@pytest.mark.parametrize("vector", [gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv])
def test_vectors_of_environments_are_those_of_gymnasium_and_give_what_one_gives(
    config: ArmConfig, make: Make, vector: Any
) -> None:
    make_reach = partial(Reach, "joint_positions", config=config)
    many = vector([make_reach, make_reach])
    goals, infos = many.reset(seed=[1, 2])
    assert list(infos["state"]) == [State.MOVING] * 2
    alone = make("joint_positions", Reach)
    assert as_bytes(alone.reset(seed=2)[0]) == as_bytes({name: values[1] for name, values in goals.items()})
    out = np.array([BENT, [9.0, *BENT[1:]]])
    _, _, terminated, _, infos = many.step(out)
    many.close()
    assert list(terminated) == [False, True]
    assert infos["events"][1][0] == SetpointOutOfRange(0, 9.0, 3.1)


def test_episodes_leave_no_files_and_no_shared_memory_behind(make: Make, config: ArmConfig) -> None:
    def left() -> tuple[int, int]:
        maps = [line for line in Path("/proc/self/maps").read_text().splitlines() if "rtcp-simulation-" in line]
        # Also while an episode runs no file is left: neither is then by a process that is killed.
        assert all(line.endswith("(deleted)") for line in maps)
        return len(maps), len(os.listdir("/proc/self/fd"))

    made = make("joint_velocities")
    _, files = left()
    counts = set()
    for _ in range(5):
        made.reset()
        made.step(np.zeros(6))
        counts.add(left())
    assert len(counts) == 1
    assert counts != {(0, files)}
    made.close()
    made.close()
    assert left() == (0, files)
    lost = ArmEnv("joint_velocities", config=config)
    lost.reset()
    del lost
    gc.collect()
    assert left() == (0, files)
