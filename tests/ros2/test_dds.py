"""The node over DDS: against its own encoding, and against Debian's Fast DDS in a network namespace of their own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install 'rtcp[dds]' (x86_64)")

from cyclonedds.qos import Policy

from rtcp.ros import ros2_dds, ros2_types
from rtcp.ros.ros2_node import IN, OUT

from .node import SAMPLE

HERE = Path(__file__).parent
HEADERS = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
IN_A_NAMESPACE = 'ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec "$@"'


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


@pytest.fixture(scope="module")
def exchange(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Messages that the node and Fast DDS received from each other."""
    if not HEADERS.exists() or shutil.which("g++") is None:
        pytest.skip("Fast DDS is not installed: apt install libfastrtps-dev g++")
    program = tmp_path_factory.mktemp("fast_dds") / "fast_dds"
    subprocess.run(
        ["g++", "-o", program, HERE / "fast_dds.cpp", "-lfastrtps", "-lfastcdr", "-pthread"], check=True, text=True
    )
    unshare = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--user", "--map-root-user"]
    inside = [*unshare, "sh", "-c", IN_A_NAMESPACE, "sh"]
    if (tried := subprocess.run([*inside, "true"], capture_output=True, text=True, check=False)).returncode:
        pytest.skip(f"no network namespace with multicast can be made here: {tried.stderr.strip()}")
    done = subprocess.run(
        [*inside, sys.executable, "-m", "tests.ros2.dds_exchange", program],
        capture_output=True, text=True, check=False, cwd=HERE.parent.parent,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout) | {"log": done.stderr})


def test_fast_dds_reads_the_joint_states(exchange: dict[str, Any]) -> None:
    data = bytes.fromhex(exchange["joint_states"][0])
    message = ros2_types.decode("sensor_msgs/msg/JointState", data)
    assert data[:4] == b"\x00\x01\x00\x00"
    assert (message.name, message.effort.tolist()) == (list("abcdef"), list(SAMPLE.effort))
    assert len(set(exchange["joint_states"])) == 1


def test_a_late_reader_of_fast_dds_receives_the_description(exchange: dict[str, Any]) -> None:
    text = ros2_types.decode("std_msgs/msg/String", bytes.fromhex(exchange["robot_description"])).data
    assert text.startswith("<?xml")
    assert text.endswith("</robot>\n")


def test_fast_dds_is_told_the_hash_of_each_type(exchange: dict[str, Any]) -> None:
    announced = {
        (f"rt/{topic}", ros2_types.dds_type(kind), f"typehash={ros2_types.type_hash(kind)};")
        for topic, kind in OUT.items()
    }
    assert {tuple(writer) for writer in exchange["writers"]} == announced


@pytest.mark.parametrize("quality", ["reliable", "best_effort"])
def test_commands_written_by_fast_dds_reach_the_arm(exchange: dict[str, Any], quality: str) -> None:
    assert exchange[f"joint_command, {quality}"] == ["stream", [0.1, 0.2, 0.3]]
    assert exchange[f"joint_path_command, {quality}"] == ["run", [[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]]


def test_bytes_that_are_no_message_are_logged_and_the_next_message_is_taken(exchange: dict[str, Any]) -> None:
    assert "deserialization rt/joint" in exchange["log"]
