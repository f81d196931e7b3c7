"""Definitions, hashes and encoding of the ROS 2 messages. The hashes are those of ROS 2's own generated code."""

from __future__ import annotations

import struct

import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'rtcp[zenoh]'")

from rtcp.ros.ros2_types import CANCEL, FOLLOW, TRIGGER, WITH_TEXT, dds_type, decode, encode, make, type_hash

PUBLISHED = {
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "trajectory_msgs/msg/JointTrajectory": "179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e",
    "trajectory_msgs/msg/JointTrajectoryPoint": "de8907036d8bd45aac6f30cc9044a3d4a329c42cbf719aff7d95a584cfa532d7",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "industrial_msgs/msg/RobotStatus": "0983f918a5b3fee8384138cb62b4b125ed17a0fde53d6229cd4a77d11d47d6f5",
    WITH_TEXT: "6b91084c9f8bffd9b0c1f6883e0e8e491a831f4fc6c6aec77a4efaf3f1ea90b5",
    f"{FOLLOW}_Feedback": "3fd0aaecf71725121ae1ff7f01098a5e0da581e672be18a6b2c286cb43d96b49",
    f"{FOLLOW}_SendGoal": "b13789dddc325a7a962825c45e28c77d37237ec129dd0c34dc5994562938c57f",
    f"{FOLLOW}_GetResult": "e3ceb38e3e1867c8dc0f46014df26e90eb93422f27e9e97f936e07f94be4bc8b",
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_hash_is_the_published_one(name: str) -> None:
    assert type_hash(name) == f"RIHS01_{PUBLISHED[name]}"


def test_a_type_has_the_name_that_dds_gives_it() -> None:
    assert dds_type("sensor_msgs/msg/JointState") == "sensor_msgs::msg::dds_::JointState_"
    assert dds_type(f"{FOLLOW}_SendGoal") == "control_msgs::action::dds_::FollowJointTrajectory_SendGoal_"


def test_a_message_is_encoded_as_worked_out_by_hand() -> None:
    header = make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=1, nanosec=2), frame_id="ab")
    message = make("sensor_msgs/msg/JointState", header=header, name=["j"], position=[0.5], effort=[-1.0])
    expected = bytes.fromhex("00010000 01000000 02000000 03000000 61620000 01000000 02000000 6a000000 01000000")
    # Eight bytes are aligned from the end of the header: here at once, and after the empty velocities too.
    expected += struct.pack("<dIId", 0.5, 0, 1, -1.0)
    assert encode("sensor_msgs/msg/JointState", message) == expected


def test_what_was_encoded_is_decoded_in_either_byte_order() -> None:
    little = encode("trajectory_msgs/msg/JointTrajectoryPoint", make("trajectory_msgs/msg/JointTrajectoryPoint"))
    assert decode("trajectory_msgs/msg/JointTrajectoryPoint", little).positions.tolist() == []
    big = bytes.fromhex("00000000 00000001 00000000") + struct.pack(">d", 0.25) + bytes(20)
    assert decode("trajectory_msgs/msg/JointTrajectoryPoint", big).positions.tolist() == [0.25]


def test_a_request_without_fields_is_one_byte() -> None:
    assert encode(f"{TRIGGER}_Request", make(f"{TRIGGER}_Request")) == bytes.fromhex("0001000000")


def test_bytes_of_another_type_are_refused() -> None:
    with pytest.raises(ValueError, match=CANCEL):
        decode(f"{CANCEL}_Request", b"\x00\x01\x00\x00\x01")
