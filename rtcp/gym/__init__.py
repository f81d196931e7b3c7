"""Gymnasium environments of the arm, and policies on the robot (`docs/gym.md`); needs the extra `gym`.

    environment = gymnasium.make("rtcp.gym:rtcp/JointVelocities-v0", max_episode_steps=200)

The loop, the guards and the device models are those of the platform, in simulated time.
"""

import gymnasium

from rtcp.gym.actions import ACTION_TIMEOUT_S, ACTIONS, ActionKind
from rtcp.gym.deployment import Deployment, Ended, deploy
from rtcp.gym.environment import ArmEnv

__all__ = ["ACTIONS", "ACTION_TIMEOUT_S", "ActionKind", "ArmEnv", "Deployment", "Ended", "deploy"]

for _name in ACTIONS:
    gymnasium.register(
        f"rtcp/{_name.title().replace('_', '')}-v0", entry_point="rtcp.gym:ArmEnv", kwargs={"action": _name}
    )
