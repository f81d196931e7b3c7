"""`rtcp ros --simple-message` on the virtual arm: its motions, and what a lost client leaves."""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import Callable, Iterator
from math import cos, pi
from typing import Any

import pytest

from rtcp.ros.simple_message.client import MotionClient
from rtcp.ros.simple_message.messages import JointPosition, JointTrajPt, Ping, ReplyCode
from tests.e2e.conftest import Platform, gone, kill

pytestmark = pytest.mark.alone
TOLERANCE_RAD = 0.01
STEPS = 30


@pytest.fixture
def port(enabled: Platform) -> Iterator[int]:
    """The motion port of a server of the enabled arm."""
    served = enabled.background("ros", "--simple-message", "--motion-port", "0", "--state-port", "0")
    assert served.stdout is not None
    first = served.stdout.readline()
    found = re.search(r"motion at 127\.0\.0\.1:(\d+)", first)
    assert found, first
    yield int(found[1])
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


async def until(platform: Platform, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    while not holds(status := await asyncio.to_thread(platform.status)):
        await asyncio.sleep(0.02)
    return status


def rests_at(goal: float) -> Callable[[dict[str, Any]], bool]:
    return lambda status: (
        status["state"] == "holding" and abs(status["joints"]["actual_position"][0] - goal) < TOLERANCE_RAD
    )


def test_streamed_downloaded_and_real_time_points_move_the_arm(enabled: Platform, port: int) -> None:
    async def test() -> None:
        client, running = await connect(port)
        begin = enabled.status()["joints"]["commanded_position"]
        for point in swing(begin, 0.2):
            # The server sees the platform as soon as it has connected to it.
            while (await client.request(point)).reply_code is not ReplyCode.SUCCESS:
                assert point.sequence == 0
                await asyncio.sleep(0.05)
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

    asyncio.run(test())


def test_a_lost_client_leaves_an_arm_at_rest_and_disabled(enabled: Platform, port: int) -> None:
    async def test() -> None:
        client, running = await connect(port)
        begin = enabled.status()["joints"]["commanded_position"]
        for point in swing(begin, 0.4):
            while (await client.request(point)).reply_code is not ReplyCode.SUCCESS:
                assert point.sequence == 0
                await asyncio.sleep(0.05)
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


def test_the_arms_file_starts_the_server_once_and_it_ends_with_the_platform(platform: Platform) -> None:
    platform.be_patient(2000)
    file = platform.directory / "config" / "assistive_arm.yaml"
    file.write_text(file.read_text() + "\nros: {simple_message: {motion_port: 0, state_port: 0}}\n")
    platform.rtcp("start", "--detach")
    while not (found := re.search(r"motion at 127\.0\.0\.1:(\d+)", platform.logs())):
        time.sleep(0.05)
    gateway = platform.pids()["gateway"]
    kill(gateway)
    gone(gateway)
    platform.rtcp("status")  # starts the gateway anew

    async def answers() -> ReplyCode:
        client, running = await connect(int(found[1]))
        reply = await client.request(Ping())
        running.cancel()
        return reply.reply_code

    assert asyncio.run(answers()) is ReplyCode.SUCCESS
    server = json.loads((platform.directory / "ros-server.json").read_text())["pid"]
    assert len(re.findall(r"motion at ", platform.logs())) == 1
    kill(platform.pids()["gateway"])
    platform.rtcp("stop")
    gone(server)
