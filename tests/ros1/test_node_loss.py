"""The loss of the node: a module of its own, since a service belongs to the newest node."""

from __future__ import annotations

import signal

import pytest

from tests.e2e.conftest import Platform
from tests.waiting import until

from .conftest import Client, Ros, begin_node, is_at
from .test_commanding import path

pytestmark = pytest.mark.platform
STREAM = {"topic": "joint_command", "velocities": True, "radius": 0.3, "period_s": 20.0, "rate_hz": 50}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(
            "path", marks=pytest.mark.long("test_after_the_loss_of_its_node_the_arm_stops_and_the_drives_are_disabled")
        ),
        "stream",
    ],
)
def test_after_the_loss_of_its_node_the_arm_stops_and_the_drives_are_disabled(
    ros: Ros, platform: Platform, client: Client, kind: str
) -> None:
    platform.until(lambda status: not status["lease"]["holder"], "the end of the last lease")
    platform.restore()
    platform.call("enable")
    node = begin_node(ros, platform)
    client.begin(kind, **path(platform, [0.3, *[0.0] * 5], 20.0) if kind == "path" else STREAM | {"count": 5000})
    try:
        platform.until_moving(0.01)
        node.send_signal(signal.SIGKILL)
        platform.until(lambda status: status["state"] == "ready", "drives without torque")
    finally:
        client.end()
        ros.stop(node)
    rest = platform.status()["joints"]["actual_position"]
    another, second = begin_node(ros, platform), Client(ros)
    try:
        assert second.command("robot_enable")["success"]
        # Nothing moves by itself.
        assert platform.status()["joints"]["actual_position"] == pytest.approx(rest, abs=2e-3)
    finally:
        second.end()
        ros.stop(another)


def test_a_node_that_was_stopped_for_a_while_carries_out_nothing_that_waited_for_it(
    ros: Ros, platform: Platform, client: Client
) -> None:
    platform.until(lambda status: not status["lease"]["holder"], "the end of the last lease")
    platform.restore()
    platform.call("enable")
    node = begin_node(ros, platform)
    client.begin("stream", **STREAM, count=250)
    try:
        platform.until_moving(0.01)
        node.send_signal(signal.SIGSTOP)
        rest = platform.until(lambda status: status["state"] == "holding", "a controlled stop")["joints"]
        client.result()
        client.command("point", t=0.0, q=[0.3, *[0.0] * 5])
        node.send_signal(signal.SIGCONT)
        client.begin("stream", **STREAM, count=50)
        client.result()
        assert platform.status()["joints"]["commanded_position"] == rest["commanded_position"]
        # Its next stream begins anew, after a pause.
        goal = [0.05, *[0.0] * 5]
        until(lambda: client.command("point", t=0.0, q=goal) == {} and is_at(platform, goal), "the point", 2.0)
    finally:
        node.send_signal(signal.SIGCONT)
        ros.stop(node)
