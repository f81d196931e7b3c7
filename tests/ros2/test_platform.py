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
from tests.leftovers import Leftovers
from tests.waiting import until

from .node import free_port, outputs, point
from .zenoh_client import GID, JOINT_STATES, Router, call

THERE = [0.2, 0.1, 0.0, 0.1, 0.0, 0.1]
LONG = pytest.mark.long(
    "test_the_latency_of_topic_and_service_is_measured_in_the_frames_and_a_sine_is_logged_from_the_topics"
)


@pytest.fixture(scope="module")
def platform(leftovers: Leftovers) -> Iterator[Platform]:
    """A started platform whose last slave is a terminal with valves."""
    made = Platform()
    leftovers.shared.add(str(made.directory))
    made.be_patient(2000)
    add_valves(made.directory / "config")
    made.rtcp("start", "--detach")
    yield made
    made.end()
    leftovers.shared.discard(str(made.directory))


@pytest.fixture(scope="module")
def node(platform: Platform) -> Iterator[tuple[subprocess.Popen[str], Router]]:
    """The node over Zenoh, and its router."""
    router = Router()
    made = platform.background("ros", "--zenoh", "--router", router.address, "--name", "arm")
    yield made, router
    made.send_signal(signal.SIGINT)
    _, log = made.communicate()
    assert made.returncode == 0, log
    router.close()


@pytest.mark.platform
def test_arm_and_channels_of_a_terminal_are_seen_and_commanded_over_zenoh(
    platform: Platform, node: tuple[subprocess.Popen[str], Router]
) -> None:
    router = node[1]
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
    sees_sets_and_is_refused_channels(platform, *node)


def sees_sets_and_is_refused_channels(platform: Platform, process: subprocess.Popen[str], router: Router) -> None:
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

        def is_set() -> bool:
            set_current(12.5)  # again: a node that did not run for a while refuses what waited for it
            return bool(latest()["valves"]["current"] == 12.5)

        until(is_set, "the output", 0.5)
        assert "12500" in platform.rtcp("segment", "get", "8", "0x7000:1").stdout
        set_current(21.0)
        assert process.stderr is not None
        log = iter(process.stderr.readline, "")
        refused = next((line for line in log if "cannot be set" in line), "")
        assert "gpio_controller/commands: valves.current: 21 cannot be set: allowed is 4 to 20" in refused
        assert latest()["valves"]["current"] == 12.5
        subscriber.undeclare()


def test_without_a_router_the_node_waits_and_ends_when_it_is_asked_to() -> None:
    command = [sys.executable, "-m", "rtcp.cli", "ros", "--zenoh", "--router", f"tcp/127.0.0.1:{free_port()}"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as node:
        assert node.stderr is not None
        assert "waiting for the router" in until(node.stderr.readline, "a line of the log")
        node.send_signal(signal.SIGTERM)
    assert node.returncode == 0


@pytest.mark.platform
@LONG
@pytest.mark.parametrize("wire", ["simple-message", "dds", "zenoh"])
def test_the_latency_of_each_wire_is_measured_in_the_frames(platform: Platform, wire: str) -> None:
    if wire == "dds":
        pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install 'rtcp[dds]' (x86_64)")
    platform.until(lambda status: not status["lease"]["holder"], "the end of the lease of the test before")
    platform.call("enable")
    command = [sys.executable, "-m", "rtcp.ros.latency", wire, "5"]
    done = subprocess.run(command, env=platform.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # A late host adds less than a cycle: the record has the instant at which the cycle was due.
    assert [cycles > 0.0 for cycles in json.loads(done.stdout)] == [True] * 5
