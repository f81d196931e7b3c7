"""`rtcp ros --simple-message` on the virtual arm: its motions, and the end of a lost client."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from math import cos, pi
from typing import Any

import pytest

from rtcp.fieldbus.simple_message.messages import JointPosition, JointTrajPt, Ping, ReplyCode
from rtcp.ros.simple_message.client import MotionClient
from tests.e2e.conftest import Platform, gone, kill
from tests.waiting import until as wait_for

pytestmark = pytest.mark.platform
TOLERANCE_RAD = 0.01
STEPS = 20


@pytest.fixture
def port(enabled: Platform) -> Iterator[int]:
    """The motion port of a server of the enabled arm."""
    served = enabled.background("ros", "--simple-message", "--motion-port", "0", "--state-port", "0")
    assert served.stdout is not None
    first = served.stdout.readline()
    match = re.search(r"motion at 127\.0\.0\.1:(\d+)", first)
    assert match, first
    yield int(match[1])
    served.terminate()
    served.communicate()


def swing(begin: list[float], distance: float) -> list[JointTrajPt]:
    """Joint 1 by a distance in rad, 0.1 s a point; the first duration is the 10 s of the reference client."""
    shares = [(1.0 - cos(pi * step / STEPS)) / 2.0 for step in range(STEPS + 1)]
    return [
        JointTrajPt(step, (begin[0] + distance * share, *begin[1:]), 0.1, 0.1 if step else 10.0)
        for step, share in enumerate(shares)
    ]


async def connect(port: int) -> tuple[MotionClient, asyncio.Task[None]]:
    client = MotionClient("127.0.0.1", port)
    running = asyncio.create_task(client.run())
    while not client.is_connected:
        await asyncio.sleep(0.01)
    return client, running


async def accepted(client: MotionClient, point: JointTrajPt) -> None:
    """Send a point until the server takes it: only the first may come before the server has seen the platform."""
    while (await client.request(point)).reply_code is not ReplyCode.SUCCESS:
        assert point.sequence == 0
        await asyncio.sleep(0.05)


async def until(platform: Platform, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    while not holds(status := await asyncio.to_thread(platform.status)):
        await asyncio.sleep(0.02)
    return status


def rests_at(goal: float) -> Callable[[dict[str, Any]], bool]:
    return lambda status: (
        status["state"] == "holding" and abs(status["joints"]["actual_position"][0] - goal) < TOLERANCE_RAD
    )


def test_points_of_each_kind_move_the_arm_and_a_lost_client_leaves_it_at_rest_and_disabled(
    enabled: Platform, port: int
) -> None:
    async def test() -> None:
        client, running = await connect(port)
        begin = enabled.status()["joints"]["commanded_position"]
        for point in swing(begin, 0.2):
            await accepted(client, point)
        here = (await until(enabled, rests_at(begin[0] + 0.2)))["joints"]["commanded_position"]
        first, *between, last = swing(here, -0.2)
        for sequence, point in ((-1, first), *enumerate(between, start=1), (-3, last)):
            client.send(JointTrajPt(sequence, point.positions, point.velocity, point.duration))
        await until(enabled, rests_at(begin[0]))
        for point in swing(begin, 0.2):
            target = JointPosition(0, point.positions)
            assert (await client.request(target)).reply_code is ReplyCode.SUCCESS
            await asyncio.sleep(0.01)
        await until(enabled, rests_at(begin[0] + 0.2))
        running.cancel()
        await until(enabled, lambda status: status["state"] == "ready")
        # Lost in motion.
        enabled.call("enable")
        client, running = await connect(port)
        begin = enabled.status()["joints"]["commanded_position"]
        for point in swing(begin, 0.4):
            await accepted(client, point)
        await until(enabled, lambda status: status["state"] == "moving")
        running.cancel()
        rest = await until(enabled, lambda status: status["state"] == "ready")
        assert abs(rest["joints"]["actual_position"][0] - begin[0]) < 0.4 - TOLERANCE_RAD
        client, running = await connect(port)
        assert (await client.request(swing(begin, 0.4)[-1])).reply_code is ReplyCode.FAILURE
        assert (await client.request(swing(begin, 0.4)[0])).reply_code is ReplyCode.FAILURE
        assert enabled.status()["state"] == "ready"
        running.cancel()

    asyncio.run(test())


CLIENT = """
import socket, sys, time
from rtcp.fieldbus.simple_message.framing import Frame
from rtcp.fieldbus.simple_message.messages import ByteOrder, JointTrajPt
connection = socket.create_connection(("10.0.0.1", 11000))
first, *rest = map(float, sys.argv[1:])
while True:
    for sequence, (q1, duration) in enumerate([(first, 0.0), (first + 1.0, 20.0)]):
        point = JointTrajPt(sequence, (q1, *rest), 0.1, duration)
        connection.sendall(Frame.request(point, ByteOrder.LITTLE).pack(ByteOrder.LITTLE))
        reply = connection.recv(4096)
    if reply[12:16] == bytes([1, 0, 0, 0]):
        break
    time.sleep(0.05)
print("moving", flush=True)
time.sleep(3600)
"""
"""A client of the network that goes silent: it starts a motion of 20 s."""


@contextlib.contextmanager
def namespace() -> Iterator[str]:
    """Process id of a process in a network namespace of its own."""
    with subprocess.Popen(["unshare", "--net", "sh", "-c", "echo; exec cat"], stdin=-1, stdout=-1) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        yield str(holder.pid)
        holder.terminate()


@pytest.mark.long("test_points_of_each_kind_move_the_arm_and_a_lost_client_leaves_it_at_rest_and_disabled")
@pytest.mark.skipif(os.geteuid() != 0, reason="two network namespaces with a cable between them need root")
def test_a_pulled_cable_stops_and_disables_the_arm_and_nothing_moves_when_it_is_back(enabled: Platform) -> None:
    with namespace() as near, namespace() as far, contextlib.ExitStack() as running:

        def inside(pid: str, *command: str) -> list[str]:
            return ["nsenter", "--net", "--target", pid, *command]

        def begin(pid: str, *command: str) -> str:
            made = subprocess.Popen(
                inside(pid, *command), env=enabled.environment, stdout=-1, stderr=subprocess.DEVNULL, text=True
            )
            running.enter_context(made)
            running.callback(made.terminate)
            assert made.stdout is not None
            return made.stdout.readline()

        def cable(is_in: bool) -> None:
            subprocess.run(inside(far, "ip", "link", "set", "far", "up" if is_in else "down"), check=True)

        ip = inside(near, "ip")
        subprocess.run([*ip, "link", "add", "near", "type", "veth", "peer", "far", "netns", far], check=True)
        subprocess.run([*ip, "address", "add", "10.0.0.1/24", "dev", "near"], check=True)
        subprocess.run([*ip, "link", "set", "near", "up"], check=True)
        subprocess.run(inside(far, "ip", "address", "add", "10.0.0.2/24", "dev", "far"), check=True)
        cable(True)
        server = (sys.executable, "-m", "rtcp.cli", "ros", "--simple-message", "--bind", "10.0.0.1")
        assert "motion at 10.0.0.1" in begin(near, *server)
        start = enabled.status()["joints"]["commanded_position"]
        assert begin(far, sys.executable, "-c", CLIENT, *map(str, start)) == "moving\n"
        enabled.until(lambda status: status["state"] == "moving", "motion")
        cable(False)
        enabled.until(lambda status: status["state"] == "ready", "the end of the connection")
        rest = enabled.status()["joints"]["actual_position"]
        assert rest[0] < start[0] + 0.9
        cable(True)
        time.sleep(2.0)  # in which the client's side would send again
        assert enabled.status()["state"] == "ready"
        assert enabled.status()["joints"]["actual_position"] == pytest.approx(rest, abs=1e-3)


def test_the_arms_file_starts_the_server_once_and_it_ends_with_the_platform(platform: Platform) -> None:
    platform.be_patient(2000)
    file = platform.directory / "config" / "assistive_arm.yaml"
    file.write_text(file.read_text() + "\nros: {simple_message: {motion_port: 0, state_port: 0}}\n")
    platform.rtcp("start", "--detach")
    match = wait_for(lambda: re.search(r"motion at 127\.0\.0\.1:(\d+)", platform.logs()), "the server")
    assert match is not None
    gateway = platform.pids()["gateway"]
    kill(gateway)
    gone(gateway)
    platform.rtcp("status")  # starts the gateway anew

    async def answers() -> ReplyCode:
        client, running = await connect(int(match[1]))
        reply = await client.request(Ping())
        running.cancel()
        return reply.reply_code

    assert asyncio.run(answers()) is ReplyCode.SUCCESS
    server = json.loads((platform.directory / "ros-server.json").read_text())["pid"]
    assert len(re.findall(r"motion at ", platform.logs())) == 1
    kill(platform.pids()["gateway"])
    platform.rtcp("stop")
    gone(server)
