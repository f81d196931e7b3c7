"""A policy that learns to reach with the tool, in the simulation, and does it on the robot.

pip install 'rtcp[gym]' stable-baselines3
python examples/reach.py train reach.zip      # minutes on two cores
python examples/reach.py evaluate reach.zip   # 20 episodes with other targets
rtcp start --detach && rtcp enable
python examples/reach.py deploy reach.zip     # on the running platform: the virtual arm, or the robot
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

import rtcp
from rtcp.config import default_config, load, with_period
from rtcp.gym import ACTION_TIMEOUT_S, ActionKind, ArmEnv, Ended, deploy
from rtcp.gym.deployment import Policy
from rtcp.ipc.commands import Jog
from rtcp.ipc.states import JogFrame

HOME = (0.0, 0.3, 1.57, 0.0, 0.5, 0.0)
"""Where each episode begins, rad: bent, in front of the user."""
TOOL = ("tool_x", "tool_y", "tool_z")
SPEED = ("tool_vx", "tool_vy", "tool_vz")
SIDE_M = 0.3
"""Side of the cube around the tool at `HOME` in which the targets are."""
REACHED_M = 0.02
STEPS = 30
"""Steps of an episode: 3 s."""
TRANSLATION = ActionKind(
    "cartesian",
    lambda config: ([-config.cartesian.speed] * 3, [config.cartesian.speed] * 3),
    lambda values: Jog((*values, 0.0, 0.0, 0.0), JogFrame.BASE, ACTION_TIMEOUT_S),
)
"""Velocities of the tool, m/s, without those of its orientation."""


class Reach(ArmEnv):
    """Velocities of the tool bring it to a target that each episode draws; 10 actions a second."""

    def __init__(self, **arguments: Any) -> None:
        # A cycle of 5 ms is the same arm, and ten times as fast to simulate as one of 0.5 ms.
        arguments.setdefault("config", with_period(load(default_config()), 5000))
        super().__init__(TRANSLATION, observe=(*TOOL, *SPEED), rate_hz=10.0, **arguments)
        self.observation_space["to_target"] = gymnasium.spaces.Box(-5.0, 5.0, (3,), np.float64)
        self.target: npt.NDArray[np.float64] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin at `HOME`."""
        return super().reset(seed=seed, options={"positions": HOME, **(options or {})})

    def begin_episode(self, options: Mapping[str, Any]) -> None:
        """Draw the target, or take that of the options, m."""
        tool = self._tool_position(super().observation())
        drawn = tool + self.np_random.uniform(-0.5 * SIDE_M, 0.5 * SIDE_M, 3)
        self.target = np.asarray(options.get("target", drawn), np.float64)

    def observation(self) -> dict[str, Any]:
        """Add the way to the target, m."""
        observed = super().observation()
        return {**observed, "to_target": self.target - self._tool_position(observed)}

    def reward(self, observation: Any, action: Any, info: dict[str, Any]) -> float:
        """Return more the nearer the tool is, always above 0: a guard that ends the episode costs the rest of it."""
        distance = float(np.linalg.norm(observation["to_target"]))
        info["distance"] = distance
        return float(np.exp(-distance / 0.1) + np.exp(-distance / 0.02))

    @staticmethod
    def _tool_position(observed: Mapping[str, Any]) -> npt.NDArray[np.float64]:
        return np.concatenate([observed[name] for name in TOOL])


def make(**arguments: Any) -> gymnasium.Env[Any, Any]:
    """Return the task with actions from -1 to 1, and an end after `STEPS`."""
    return gymnasium.wrappers.TimeLimit(
        gymnasium.wrappers.RescaleAction(Reach(**arguments), np.float32(-1.0), np.float32(1.0)), STEPS
    )


def train(file: Path, steps: int) -> None:
    """Learn with soft actor-critic from two simulated arms at a time; write the policy."""
    import torch
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    torch.set_num_threads(1)
    arms = make_vec_env(make, 2, seed=1, vec_env_cls=SubprocVecEnv, monitor_kwargs={"info_keywords": ("distance",)})
    model = SAC(
        "MultiInputPolicy", arms, learning_rate=1e-3, gamma=0.9, batch_size=256, learning_starts=300, train_freq=1,
        gradient_steps=2, ent_coef="auto_0.1", policy_kwargs={"net_arch": [64, 64]}, seed=1, verbose=1, device="cpu",
    )  # fmt: skip
    begun = time.monotonic()
    model.learn(steps, log_interval=20)
    arms.close()
    model.save(file)
    print(f"{steps} steps of 0.1 s in {time.monotonic() - begun:.0f} s: {file}")


def learnt(file: Path) -> Policy:
    """Return the policy that `train` wrote."""
    from stable_baselines3 import SAC

    model = SAC.load(file, device="cpu")
    return lambda observation: model.predict(observation, deterministic=True)[0]


def evaluate(policy: Policy, episodes: int) -> float:
    """Return the share of episodes at whose end the tool is within `REACHED_M` of the target."""
    environment = make()
    distances = []
    for episode in range(episodes):
        observation, info = environment.reset(seed=1000 + episode)
        over = False
        while not over:
            observation, _, terminated, truncated, info = environment.step(policy(observation))
            over = terminated or truncated
        distances.append(info["distance"])
    environment.close()
    reached = sum(distance < REACHED_M for distance in distances) / episodes
    print(f"{reached:.0%} of {episodes} targets reached within {REACHED_M} m; median {np.median(distances):.4f} m")
    return reached


def on_the_robot(policy: Policy, targets: int) -> float:
    """Reach for targets on the running platform; return the share that was reached."""
    distances: list[float] = []

    def measured(observation: Any) -> Any:
        distances.append(float(np.linalg.norm(observation["to_target"])))
        return policy(observation)

    reached = 0
    with rtcp.connect("reach") as robot:
        for number in range(targets):
            distances.clear()
            done = deploy(measured, robot, make, seed=2000 + number)
            print(
                f"{distances[0]:.3f} m away, then {distances[-1]:.4f} m; {done.late_steps} of {done.steps} steps late"
            )
            if done.ended is not Ended.TRUNCATED:
                print(done)
                break
            reached += distances[-1] < REACHED_M
    print(f"{reached} of {targets} targets reached within {REACHED_M} m")
    return reached / targets


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "evaluate", "deploy"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--episodes", type=int, default=20)
    arguments = parser.parse_args()
    if arguments.what == "train":
        train(arguments.file, arguments.steps)
    elif arguments.what == "evaluate":
        evaluate(learnt(arguments.file), arguments.episodes)
    else:
        on_the_robot(learnt(arguments.file), arguments.episodes)


if __name__ == "__main__":
    main()
