"""The node over DDS: its encoding and quality of service. `test_rclpy.py` has it in front of a real ROS 2."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install 'rtcp[dds]' (x86_64)")

from cyclonedds.qos import Policy

from rtcp.ros import ros2_dds, ros2_types
from rtcp.ros.ros2_node import IN, OUT


def filled(make: Any, kind: str) -> Any:
    """Return a message with a value in most fields."""
    header = make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=3, nanosec=4), frame_id="abc")
    point = make("trajectory_msgs/msg/JointTrajectoryPoint", positions=[0.5, 1.0], effort=[2.0])
    fields: dict[str, dict[str, Any]] = {
        "sensor_msgs/msg/JointState": {"header": header, "name": ["a", "bcd"], "velocity": [1.0, 2.0]},
        "control_msgs/action/FollowJointTrajectory_Feedback": {"header": header, "joint_names": ["a"], "actual": point},
        "industrial_msgs/msg/RobotStatus": {
            "in_error": make("industrial_msgs/msg/TriState", val=-1),
            "error_codes": [7],
        },
        "trajectory_msgs/msg/JointTrajectory": {"joint_names": ["a", "b"], "points": [point, point]},
        "std_msgs/msg/String": {"data": "text"},
    }
    return make(kind, **fields.get(kind, {}))


@pytest.mark.parametrize("kind", sorted({*OUT.values(), *IN.values()}))
def test_cyclonedds_encodes_as_rosbags_does(kind: str) -> None:
    expected = ros2_types.encode(kind, filled(ros2_types.make, kind))
    assert filled(ros2_dds.make, kind).serialize(use_version_2=False) == expected


def test_states_are_reliable_and_volatile_and_the_description_is_kept_for_late_readers() -> None:
    states = ros2_dds.qos_of("joint_states", OUT["joint_states"])
    assert (states[Policy.Durability], states[Policy.History]) == (
        Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
    )
    description = ros2_dds.qos_of("robot_description", OUT["robot_description"])
    assert description[Policy.Durability] == Policy.Durability.TransientLocal
    assert description[Policy.DurabilityService].history == Policy.History.KeepLast(1)
