"""The loss of the node: a module of its own, since a service belongs to the newest node."""

from __future__ import annotations

import signal
import time

import pytest

from tests.e2e.conftest import Platform

from .conftest import Ros, begin_node, command, is_at, until
from .test_commanding import path

pytestmark = pytest.mark.platform


@pytest.mark.parametrize("kind", ["path", "stream"])
def test_after_the_loss_of_its_node_the_arm_stops_and_the_drives_are_disabled(
    ros: Ros, platform: Platform, kind: str
) -> None:
    platform.until(lambda status: not status["lease"]["holder"], "the end of the last lease")
    platform.restore()
    platform.call("enable")
    node = begin_node(ros, platform)
    given = {"topic": "joint_command", "velocities": True, "radius": 0.3, "period_s": 20.0, "rate_hz": 50, "count": 500}
    sent = path(platform, [0.3, *[0.0] * 5], 20.0) if kind == "path" else given
    client = ros.begin_client(kind, **sent)
    try:
        platform.until_moving(0.01)
        node.send_signal(signal.SIGKILL)
        platform.until(lambda status: status["state"] == "ready", "drives without torque")
    finally:
        client.kill()
        client.communicate()
        ros.stop(node)
    rest = platform.status()["joints"]["actual_position"]
    another = begin_node(ros, platform)
    try:
        assert command(ros, "robot_enable")["success"]
        # Nothing moves by itself.
        assert platform.status()["joints"]["actual_position"] == pytest.approx(rest, abs=2e-3)
    finally:
        ros.stop(another)


def test_a_node_that_was_stopped_for_a_while_carries_out_nothing_that_waited_for_it(
    ros: Ros, platform: Platform
) -> None:
    platform.until(lambda status: not status["lease"]["holder"], "the end of the last lease")
    platform.restore()
    platform.call("enable")
    node = begin_node(ros, platform)
    client = ros.begin_client(
        "stream", topic="joint_command", velocities=True, radius=0.3, period_s=20.0, rate_hz=50, count=400
    )
    try:
        platform.until_moving(0.01)
        node.send_signal(signal.SIGSTOP)
        rest = platform.until(lambda status: status["state"] == "holding", "a controlled stop")["joints"]
        time.sleep(2.0)
        node.send_signal(signal.SIGCONT)
        client.communicate()  # it goes on for seconds
        assert platform.status()["joints"]["commanded_position"] == rest["commanded_position"]
        # Its next stream begins anew.
        time.sleep(1.5)
        command(ros, "point", t=0.0, q=[0.05, *[0.0] * 5])
        until(lambda: is_at(platform, [0.05, *[0.0] * 5]), "the point")
    finally:
        node.send_signal(signal.SIGCONT)
        client.kill()
        ros.stop(node)
