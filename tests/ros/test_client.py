"""Our client of controllers, against a server of ours and against sockets that misbehave."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable

import pytest

from rtcp.fieldbus.simple_message import messages
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder
from rtcp.ros.simple_message import client as client_module
from rtcp.ros.simple_message.client import MotionClient, StateClient
from rtcp.ros.simple_message.server import ServerOptions, SimpleMessageServer
from tests import simulated_time
from tests.ros.fake_arm import HOME, FakeArm

OK = messages.ReplyCode.SUCCESS


@pytest.fixture(autouse=True)
def reconnects_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "RECONNECT_S", 0.01)


async def connected(client: MotionClient | StateClient) -> None:
    while not client.is_connected:
        await asyncio.sleep(0.001)


def run(test: Awaitable[None]) -> None:
    async def whole() -> None:
        await test

    simulated_time.run(whole())


def test_it_is_tried_again_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert client_module.RECONNECT_S == 1.0


@pytest.mark.parametrize("order", messages.ByteOrder)
def test_motion_and_state_of_a_controller_in_either_byte_order(order: messages.ByteOrder) -> None:
    async def test() -> None:
        arm, received = FakeArm(), list[messages.Message]()
        async with SimpleMessageServer(arm, ServerOptions(motion_port=0, state_port=0, byte_order=order)) as server:
            motion = MotionClient("127.0.0.1", server.ports[0], order)
            state = StateClient("127.0.0.1", received.append, server.ports[1])
            tasks = [asyncio.create_task(each.run()) for each in (motion, state)]
            await connected(motion)
            assert (await motion.request(messages.GetVersion())).reply_code is OK
            motion.send(messages.JointTrajPt(-1, HOME, 0.1, 10.0))
            motion.send(messages.JointTrajPt(-3, (0.5, *HOME[1:]), 0.1, 0.5))
            await arm.until("run_trajectory")
            assert await motion.stop()
            await arm.until("halt")
            while {type(each) for each in received} < {messages.JointPosition, messages.Status}:
                arm.set_status(error_code=0)  # a new sample
                await asyncio.sleep(0.001)
            for task in tasks:
                task.cancel()

    run(test())


class Controller:
    """A socket with the test's answers."""

    def __init__(self) -> None:
        self.writers: list[asyncio.StreamWriter] = []
        self.frames: list[Frame] = []
        self.changed = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        decoder = FrameDecoder()
        self.writers.append(writer)
        self.changed.set()
        while data := await reader.read(1000):
            self.frames += decoder.feed(data)
            self.changed.set()

    async def until(self, connections: int = 0, frames: int = 0) -> None:
        while len(self.writers) < connections or len(self.frames) < frames:
            self.changed.clear()
            await self.changed.wait()

    async def listen(self) -> int:
        self.server = await asyncio.start_server(self.serve, "127.0.0.1", 0)
        return int(self.server.sockets[0].getsockname()[1])


def test_a_lost_connection_is_made_again_and_logged_once_and_its_request_fails(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def test() -> None:
        controller = Controller()
        client = MotionClient("127.0.0.1", await controller.listen())
        running = asyncio.create_task(client.run())
        for number in range(1, 5):
            await controller.until(connections=number)
            await connected(client)
            request = asyncio.create_task(client.request(messages.Ping()))
            await controller.until(frames=number)
            controller.writers[-1].close()
            with pytest.raises(ConnectionError, match="before the reply"):
                await request
        running.cancel()
        assert len([each for each in caplog.records if each.levelno >= logging.WARNING]) == 1

    run(test())


def test_without_a_connection_nothing_is_sent() -> None:
    async def test() -> None:
        client = MotionClient("127.0.0.1", 1)
        with pytest.raises(ConnectionError, match="no connection"):
            client.send(messages.Ping())
        with pytest.raises(ConnectionError, match="no connection"):
            await client.request(messages.Ping())

    run(test())


def test_replies_belong_to_requests_in_their_order_also_where_one_was_cancelled() -> None:
    async def test() -> None:
        controller = Controller()
        client = MotionClient("127.0.0.1", await controller.listen())
        running = asyncio.create_task(client.run())
        await connected(client)
        first, second, third = (asyncio.create_task(client.request(messages.Ping())) for _ in range(3))
        await controller.until(frames=3)
        second.cancel()
        for code in (messages.ReplyCode.SUCCESS, messages.ReplyCode.SUCCESS, messages.ReplyCode.FAILURE):
            controller.writers[0].write(controller.frames[0].reply(code).pack(messages.ByteOrder.LITTLE))
        assert (await first).reply_code is messages.ReplyCode.SUCCESS
        assert (await third).reply_code is messages.ReplyCode.FAILURE
        running.cancel()

    run(test())


def test_a_request_without_a_reply_ends_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "REPLY_TIMEOUT_S", 0.05)

    async def test() -> None:
        controller = Controller()
        client = MotionClient("127.0.0.1", await controller.listen())
        running = asyncio.create_task(client.run())
        await connected(client)
        with pytest.raises(TimeoutError, match="no reply to PING"):
            await client.request(messages.Ping())
        await controller.until(connections=2)
        running.cancel()

    run(test())


def test_a_controller_that_requests_is_answered_and_garbage_ends_the_connection() -> None:
    async def test() -> None:
        controller, received = Controller(), list[messages.Message]()
        client = StateClient("127.0.0.1", received.append, await controller.listen())
        running = asyncio.create_task(client.run())
        await controller.until(connections=1)
        controller.writers[0].write(
            Frame.request(messages.Status(), messages.ByteOrder.BIG).pack(messages.ByteOrder.BIG)
        )
        await controller.until(frames=1)
        assert controller.frames[0] == Frame(messages.Status.TYPE, messages.CommType.SERVICE_REPLY, OK)
        assert received == [messages.Status()]
        controller.writers[0].write(b"\0\0\0\0")
        await controller.until(connections=2)
        running.cancel()

    run(test())


class Link:
    """The link to a server: while it is down nothing passes it, and TCP repeats the first packet of a connection 1, 3,
    7, 15, 31 and 63 s after the first (Linux, tcp_syn_retries)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._connect = asyncio.open_connection
        self._writers: list[asyncio.StreamWriter] = []
        self.is_down = False
        monkeypatch.setattr(asyncio, "open_connection", self._open)

    async def _open(self, host: str, port: int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        for waits_s in (1, 2, 4, 8, 16, 32):
            if not self.is_down:
                reader, writer = await self._connect(host, port)
                self._writers.append(writer)
                return reader, writer
            await asyncio.sleep(waits_s)
        raise TimeoutError(110, "Connection timed out")

    def cut(self) -> None:
        """Cut it: both ends of a connection stay open, and hear nothing."""
        self.is_down = True
        for writer in self._writers:
            writer.transport.pause_reading()  # type: ignore[attr-defined]


@pytest.mark.parametrize("down_s", [8.0, 60.0])
def test_the_state_stream_is_back_seconds_after_a_link_that_was_down(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, down_s: float
) -> None:
    monkeypatch.undo()

    async def test() -> None:
        received, link = list[messages.Message](), Link(monkeypatch)
        async with SimpleMessageServer(FakeArm(), ServerOptions(motion_port=0, state_port=0)) as server:
            state = StateClient("127.0.0.1", received.append, server.ports[1])
            running = asyncio.create_task(state.run())
            while not received:
                await asyncio.sleep(0.01)
            link.cut()
            await asyncio.sleep(down_s)
            assert not state.is_connected
            assert "no message for 5.0 s" in caplog.text
            link.is_down = False
            received.clear()
            back = time.monotonic()
            while not received:
                await asyncio.sleep(0.01)
            assert time.monotonic() - back < client_module.CONNECT_TIMEOUT_S + client_module.RECONNECT_S + 0.1
            running.cancel()

    run(test())
