"""`rtcp ros` over each wire on a real platform with its virtual arm."""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed: pip install 'rtcp[zenoh]'")

from rtcp.ros.ros2_types import GROUP_VALUES, decode, encode, make, type_hash
from rtcp.ros.ros2_zenoh import open_session
from tests.e2e.conftest import Platform
from tests.e2e.test_standard_drives import add_valves

from .node import free_port, outputs, point, until
from .zenoh_client import GID, JOINT_STATES, Router, call

pytestmark = pytest.mark.platform
THERE = [0.2, 0.1, 0.0, 0.1, 0.0, 0.1]


@pytest.fixture
def prepared() -> Iterator[Platform]:
    """A platform with the tolerances of a shared host, not yet started."""
    made = Platform()
    made.be_patient(2000)
    yield made
    made.end()


@pytest.fixture
def platform(prepared: Platform) -> Platform:
    """A started platform."""
    prepared.rtcp("start", "--detach")
    return prepared


def test_the_arm_is_enabled_moved_and_seen_over_zenoh(platform: Platform) -> None:
    router = Router()
    node = platform.background("ros", "--zenoh", "--router", router.address, "--name", "arm")
    received: list[Any] = []
    with open_session(router.address) as session:
        subscriber = session.declare_subscriber(JOINT_STATES, received.append)
        assert call(session, "robot_enable", "std_srvs/srv/Trigger").success
        names = platform.status()["joint_names"]
        points = [point(0.0, [0.0] * 6), point(2.0, THERE)]
        trajectory = make("trajectory_msgs/msg/JointTrajectory", joint_names=names, points=points)
        answer = call(session, "joint_path_command", "industrial_msgs/srv/CmdJointTrajectory", trajectory=trajectory)
        assert answer.code.val == 1

        def is_there() -> bool:
            message = decode("sensor_msgs/msg/JointState", received[-1].payload.to_bytes())
            return bool(message.name == names and message.position.tolist() == pytest.approx(THERE, abs=1e-3))

        until(lambda: received and is_there(), "the end of the trajectory")
        stamp = decode("sensor_msgs/msg/JointState", received[-1].payload.to_bytes()).header.stamp
        assert 0.0 <= time.time() - stamp.sec - 1e-9 * stamp.nanosec < 3600.0
        subscriber.undeclare()
    node.send_signal(signal.SIGINT)
    _, log = node.communicate()
    assert node.returncode == 0, log
    router.close()


def test_channels_of_a_terminal_are_seen_and_set_over_zenoh_and_refused_as_everywhere(prepared: Platform) -> None:
    platform, router = prepared, Router()
    add_valves(platform.directory / "config")
    platform.rtcp("start", "--detach")
    node = platform.background("ros", "--zenoh", "--router", router.address, "--name", "arm")
    kind = f"control_msgs::msg::dds_::DynamicInterfaceGroupValues_/{type_hash(GROUP_VALUES)}"
    received: list[Any] = []

    def latest() -> dict[str, Any]:
        if not received:
            return {}
        message = decode(GROUP_VALUES, received[-1].payload.to_bytes())
        values = zip(message.interface_groups, message.interface_values, strict=True)
        return {slave: dict(zip(group.interface_names, group.values.tolist(), strict=True)) for slave, group in values}

    with open_session(router.address) as session:
        subscriber = session.declare_subscriber(f"0/gpio_controller/gpio_states/{kind}", received.append)
        until(lambda: latest().get("valves", {}).get("current") == 4.0, "the safe value")
        assert {"emergency_stop", "gripper"} <= latest()["io"].keys()
        platform.rtcp("segment", "set", "8", "0x6000:1", "350")
        until(lambda: latest()["valves"]["pressure"] == pytest.approx(2.5), "the pressure")

        def set_current(value: float) -> None:
            command = encode(GROUP_VALUES, outputs({"valves": {"current": value}}))
            attachment = struct.pack("<qqB16s", 1, time.time_ns(), 16, GID)
            session.put(f"0/gpio_controller/commands/{kind}", command, attachment=attachment)

        set_current(12.5)
        until(lambda: latest()["valves"]["current"] == 12.5, "the output")
        assert "12500" in platform.rtcp("segment", "get", "8", "0x7000:1").stdout
        set_current(21.0)
        assert node.stderr is not None
        log = iter(node.stderr.readline, "")
        refused = next((line for line in log if "cannot be set" in line), "")
        assert "gpio_controller/commands: valves.current: 21 cannot be set: allowed is 4 to 20" in refused
        assert latest()["valves"]["current"] == 12.5
        subscriber.undeclare()
    node.send_signal(signal.SIGINT)
    node.communicate()
    router.close()


def test_without_a_router_the_node_waits_and_ends_when_it_is_asked_to(platform: Platform) -> None:
    node = platform.background("ros", "--zenoh", "--router", f"tcp/127.0.0.1:{free_port()}")
    assert node.stderr is not None
    assert "waiting for the router" in until(node.stderr.readline, "a line of the log")
    node.send_signal(signal.SIGTERM)
    node.communicate()
    assert node.returncode == 0


@pytest.mark.parametrize("wire", ["dds", "zenoh", "simple-message"])
def test_the_latency_of_each_wire_is_measured_in_the_frames(platform: Platform, wire: str) -> None:
    if wire == "dds":
        pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install 'rtcp[dds]' (x86_64)")
    platform.call("enable")
    command = [sys.executable, "-m", "rtcp.ros.latency", wire, "5"]
    done = subprocess.run(command, env=platform.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # A late host adds less than a cycle: the record has the instant at which the cycle was due.
    assert [cycles > 0.0 for cycles in json.loads(done.stdout)] == [True] * 5
