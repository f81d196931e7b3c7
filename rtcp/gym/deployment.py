"""A policy on a robot: by the environment that it was trained in."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy.typing as npt

from rtcp.api import Robot, RtcpError, State
from rtcp.gym.arms import ConnectedArm
from rtcp.gym.environment import ArmEnv
from rtcp.ipc.events import Event

Policy = Callable[[Any], npt.ArrayLike]
"""Returns the action for an observation."""


class Ended(Enum):
    """Why a deployment has ended."""

    TIME = "time"
    """`seconds` have elapsed."""
    TERMINATED = "terminated"
    """A guard, a fault or a person ended the motion, or the task's own end: see `events`."""
    TRUNCATED = "truncated"
    """A wrapper ended the episode."""
    INTERRUPTED = "interrupted"
    """By Ctrl-C."""


@dataclass(frozen=True)
class Deployment:
    """What a policy did on a robot."""

    ended: Ended
    state: State
    """Of the machine at the end."""
    steps: int
    seconds: float
    events: tuple[Event, ...]
    """Those of the loop meanwhile."""
    refusal: RtcpError | None
    """Why the last action that was not accepted was not."""
    late_steps: int
    """Steps that began late: the policy or the host took longer than a step lasts."""
    largest_delay_s: float
    """Largest delay of a step, s; beyond `ACTION_TIMEOUT_S` the action has ended, and with it the deployment."""
    reward: float
    """Sum of the rewards."""


def deploy(
    policy: Policy,
    robot: Robot,
    make: Callable[..., Any] = ArmEnv,
    *,
    seconds: float | None = None,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
) -> Deployment:
    """Let a policy move a robot for one episode, under the robot's guards; return with the arm at rest.

    The policy gets the observations of the environment, at its rate, and its actions go the same way. What it raises
    is raised here, with the arm at rest. After a fault or a stop by a limit the control mode stays.

    Args:
        policy: called with each observation; of Stable-Baselines3 `lambda observation: model.predict(observation)[0]`.
        robot: connected and enabled.
        make: makes the environment that the policy was trained in: a class derived from `ArmEnv`, or a function that
            puts wrappers around one; called with the argument `robot`.
        seconds: longest time; None: until the episode ends, or Ctrl-C.
        seed: of the episode, as for `reset`.
        options: of the episode, as for `reset`: with `positions` the robot first moves there.

    Raises:
        Invalid: `seconds` is not above 0, or `make` makes an environment without the robot.
        Refused: the robot does not hold, or another commander moves it.
        NotRunning: the robot's platform has ended.
        ConnectionLost: it ended meanwhile.
    """
    if seconds is not None and not seconds > 0.0:
        raise RtcpError("invalid", f"seconds: found {seconds:g}, allowed is more than 0")
    environment = make(robot=robot)
    arm = environment.unwrapped.arm
    if not isinstance(arm, ConnectedArm):
        environment.close()
        raise RtcpError(
            "invalid", "make: its environment moves a simulated arm: pass the argument `robot` on to ArmEnv"
        )
    ended, steps, total = Ended.TIME, 0, 0.0
    events: list[Event] = []
    refusal: RtcpError | None = None
    begun = time.monotonic()
    try:
        observation, _ = environment.reset(seed=seed, options=options)
        begun = time.monotonic()
        while seconds is None or time.monotonic() - begun < seconds:
            observation, reward, terminated, truncated, info = environment.step(policy(observation))
            steps, total = steps + 1, total + float(reward)
            events += info["events"]
            refusal = info.get("refusal", refusal)
            if terminated or truncated:
                ended = Ended.TERMINATED if terminated else Ended.TRUNCATED
                break
    except KeyboardInterrupt:
        ended = Ended.INTERRUPTED
    finally:
        duration_s = time.monotonic() - begun
        environment.close()
    return Deployment(
        ended, robot.state, steps, duration_s, tuple(events), refusal, arm.late_steps, arm.largest_delay_s, total
    )
