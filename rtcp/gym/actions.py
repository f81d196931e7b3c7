"""What an action of a policy is: its bounds, and the command or setpoint that carries it to the loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rtcp.config.model import ArmConfig, ControlModeName
from rtcp.ipc.commands import ApplyTorque, Jog, MotionCommand, MoveAtVelocity
from rtcp.ipc.states import JogFrame
from rtcp.motion.controllers.stream import TIMEOUT_S

ACTION_TIMEOUT_S = TIMEOUT_S
"""Time after which an action that no other follows has ended, and the arm comes to rest, s; a stream has the same."""
Bounds = tuple[Sequence[float], Sequence[float]]


@dataclass(frozen=True)
class ActionKind:
    """A kind of action; a package may make its own for a command that it registers.

    Attributes:
        control_mode: of the arm meanwhile.
        bounds: lowest and highest value of each number, SI, by the configuration.
        command: makes the command of an action, which lasts for `ACTION_TIMEOUT_S`; None: actions are setpoints of
            a stream.
    """

    control_mode: ControlModeName
    bounds: Callable[[ArmConfig], Bounds]
    command: Callable[[Sequence[float]], MotionCommand] | None = None


def _ranges(config: ArmConfig) -> Bounds:
    return [joint.position.min for joint in config.joints], [joint.position.max for joint in config.joints]


def _within(bounds: Sequence[float]) -> Bounds:
    return [-bound for bound in bounds], bounds


ACTIONS = {
    "joint_positions": ActionKind("joint", _ranges),
    "joint_velocities": ActionKind(
        "velocity",
        lambda config: _within([joint.velocity for joint in config.joints]),
        lambda values: MoveAtVelocity(tuple(values), ACTION_TIMEOUT_S),
    ),
    "joint_torques": ActionKind(
        "torque",
        lambda config: _within([joint.torque for joint in config.joints]),
        lambda values: ApplyTorque(tuple(values), 0.0, 0.0, ACTION_TIMEOUT_S),
    ),
    "tool_velocities": ActionKind(
        "cartesian",
        lambda config: _within([config.cartesian.speed] * 3 + [config.cartesian.angular_speed] * 3),
        lambda values: Jog(tuple(values), JogFrame.BASE, ACTION_TIMEOUT_S),
    ),
}
"""By their names: rad; rad/s; Nm added to those that carry the weight; x y z, m/s, rx ry rz, rad/s, in the base."""
