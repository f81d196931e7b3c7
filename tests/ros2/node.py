"""A node of ROS 2 on a fake arm: no ROS, no platform."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from typing import Any

from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.ros.commands import CommandOptions
from rtcp.ros.ros2_node import Commands, Ros2Options
from rtcp.ros.ros2_types import GROUP_VALUES, make
from rtcp.ros.state import JointSample
from tests.ros.test_commands import HERE, NAMES, FakeArm

CONFIG = load(default_config())
SAMPLE = JointSample(1_700_000_000_250_000_000, (0.1,) * 6, (0.2,) * 6, (0.3,) * 6, (0.15,) * 6)
OPTIONS = Ros2Options("arm", commands=CommandOptions())


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


def point(t: float, q: Any, **fields: Any) -> Any:
    duration = make("builtin_interfaces/msg/Duration", sec=int(t), nanosec=round(t % 1 * 1e9))
    return make("trajectory_msgs/msg/JointTrajectoryPoint", positions=q, time_from_start=duration, **fields)


def trajectory(names: Any = NAMES) -> Any:
    points = [point(0.0, HERE), point(1.5, (0.0, 0.0, 0.0))]
    return make("trajectory_msgs/msg/JointTrajectory", joint_names=list(names), points=points)


def outputs(values: Mapping[str, Mapping[str, float]], make: Any = make) -> Any:
    """Return a command of outputs by slave and name."""
    kind = "control_msgs/msg/InterfaceValue"
    each = [make(kind, interface_names=list(some), values=list(some.values())) for some in values.values()]
    return make(GROUP_VALUES, interface_groups=list(values), interface_values=each)


def commanded(arm: FakeArm, topic: str) -> list[Any]:
    """The arm's commands from a topic: (`stream`, joint positions) of each setpoint, or its calls."""
    if topic == "joint_command":
        return [("stream", sent[0]) for stream in arm.streams for sent in stream.sent]
    return list(arm.calls)


def arrive(arm: FakeArm, commands: Commands) -> None:
    """End the motion under way."""

    async def end() -> None:
        arm.end()

    commands.submit(end()).result()
