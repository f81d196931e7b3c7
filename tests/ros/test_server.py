"""The server over real sockets, with a fake arm that records its calls."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Any

import pytest

from rtcp.api import RtcpError
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder
from rtcp.fieldbus.simple_message.messages import (
    ByteOrder,
    CommType,
    GetVersion,
    JointFeedback,
    JointPoint,
    JointPosition,
    JointTrajPt,
    Message,
    MessageType,
    Ping,
    ReplyCode,
    Status,
    TriState,
    Version,
)
from rtcp.ipc.commands import Halt
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ros import held_up
from rtcp.ros.simple_message.arm import Point
from rtcp.ros.simple_message.robot_arm import RobotArm
from rtcp.ros.simple_message.sequence import BUFFER_POINTS
from rtcp.ros.simple_message.server import ServerOptions, SimpleMessageServer
from tests import simulated_time
from tests.gateway.fake_loop import RunningLoop
from tests.ros.fake_arm import HOME, READY, FakeArm, FakeTrajectory

START, END, STOP = -1, -3, -4
THERE = (0.5, *HOME[1:])
OK, NO = ReplyCode.SUCCESS, ReplyCode.FAILURE
LITTLE, BIG = ByteOrder.LITTLE, ByteOrder.BIG
STOP_POINT = JointTrajPt(STOP, (), 0.0, 0.0)


def exact(q1: float) -> float:
    """The number rounded to float32."""
    return float(struct.unpack("f", struct.pack("f", q1))[0])


def point(sequence: int, q1: float = 0.5, duration: float = 0.5) -> JointTrajPt:
    return JointTrajPt(sequence, (q1, *HOME[1:]), 0.1, duration)


def at(time: float, q1: float = 0.5) -> Point:
    return Point(time, (exact(q1), *HOME[1:]))


class Peer:
    """A client written from the byte tables; only the messages' bodies use the product's code."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, order: ByteOrder) -> None:
        self._reader, self.writer, self.order = reader, writer, order
        self._decoder = FrameDecoder(order)
        self._frames: list[Frame] = []

    async def frame(self) -> Frame:
        while not self._frames:
            data = await self._reader.read(1 << 16)
            if not data:
                raise EOFError
            self._frames += self._decoder.feed(data)
        return self._frames.pop(0)

    async def message(self) -> Message:
        frame = await self.frame()
        assert frame.comm_type is CommType.TOPIC
        return frame.message(self.order)

    def send(self, *messages: Message) -> None:
        """Requests, all in one piece."""
        self.writer.write(b"".join(Frame.request(each, self.order).pack(self.order) for each in messages))

    def topic(self, *messages: Message) -> None:
        self.writer.write(b"".join(Frame.topic(each, self.order).pack(self.order) for each in messages))

    async def codes(self, *messages: Message) -> list[ReplyCode]:
        self.send(*messages)
        return [(await self.frame()).reply_code for _ in messages]

    async def is_closed(self) -> bool:
        with contextlib.suppress(ConnectionError, EOFError):
            while True:
                await self.frame()
        return True


class Rig:
    """The server and its arm."""

    def __init__(self, arm: FakeArm, server: SimpleMessageServer) -> None:
        self.arm, self.server = arm, server
        self._peers: list[Peer] = []

    async def motion(self, order: ByteOrder = LITTLE, host: str = "127.0.0.1") -> Peer:
        return await self._connect(0, order, host)

    async def state(self, order: ByteOrder = LITTLE, host: str = "127.0.0.1") -> Peer:
        return await self._connect(1, order, host)

    async def _connect(self, server: int, order: ByteOrder, host: str) -> Peer:
        peer = Peer(*await asyncio.open_connection(host, self.server.ports[server], local_addr=(host, 0)), order)
        self._peers.append(peer)  # a connection that nobody keeps is closed by the collector
        return peer


@contextlib.asynccontextmanager
async def serving(arm: FakeArm | None = None, **options: Any) -> AsyncIterator[Rig]:
    arm = arm or FakeArm()
    given = ServerOptions(motion_port=0, state_port=0, **options)
    async with SimpleMessageServer(arm, given) as server:
        yield Rig(arm, server)


def run(test: Callable[[Rig], Awaitable[None]], **options: Any) -> FakeArm:
    """Run a test's client; return the arm when the server has ended."""

    async def whole() -> FakeArm:
        async with serving(**options) as rig:
            await test(rig)
        return rig.arm

    return simulated_time.run(whole())


async def streaming(rig: Rig) -> Peer:
    """Return a client whose arm moves along its first two points."""
    peer = await rig.motion()
    await peer.codes(point(0), point(1))
    await rig.arm.until("open_trajectory")
    return peer


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


# -- requests ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ByteOrder)
def test_requests_are_answered_in_the_byte_order_of_the_first_length(order: ByteOrder) -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion(order)
        peer.send(Ping(), GetVersion())
        assert await peer.frame() == Frame(MessageType.PING, CommType.SERVICE_REPLY, OK)
        version = (await peer.frame()).message(order)
        assert isinstance(version, Version)
        assert (version.major, version.minor) == (0, 2)

    run(client)


@pytest.mark.parametrize("number", [0, 12, 13, 20, 21, 2001, 65001])
def test_unknown_and_deprecated_requests_are_answered_with_failure_and_topics_are_ignored(number: int) -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        for comm_type in (CommType.TOPIC, CommType.SERVICE_REQUEST):
            peer.writer.write(Frame(number, comm_type, ReplyCode.INVALID, bytes(40)).pack(LITTLE))
        peer.writer.write(Frame(11, CommType.SERVICE_REPLY, OK, bytes(40)).pack(LITTLE))
        assert await peer.frame() == Frame(number, CommType.SERVICE_REPLY, NO)
        assert await peer.codes(Ping()) == [OK]

    assert run(client).calls == []


# -- streaming and downloading ----------------------------------------------------------------------------------------


def test_a_streamed_trajectory_begins_when_enough_motion_is_there_and_is_appended_to() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        assert await peer.codes(point(0, 0.0, 10.0), point(1, 0.25, 0.25)) == [OK, OK]
        await rig.arm.until("open_trajectory")
        assert await peer.codes(point(2, 0.5, 0.25)) == [OK]
        await rig.arm.until("append")

    arm = run(client)
    assert arm.calls[:2] == [("open_trajectory", at(0.0, 0.0), at(0.25, 0.25)), ("append", at(0.5, 0.5))]


def test_a_short_streamed_trajectory_begins_when_nothing_more_comes() -> None:
    async def client(rig: Rig) -> None:
        assert await (await rig.motion()).codes(point(0, 0.25, 0.05)) == [OK]
        await rig.arm.until("open_trajectory")

    assert run(client).calls[0] == ("open_trajectory", Point(exact(0.05), (0.25, *HOME[1:])))


def test_requests_are_answered_while_the_arm_moves() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        for number in range(400):
            assert await peer.codes(point(number, 0.001 * (number + 100), 0.25)) == [OK]
        await rig.arm.until("append")

    arm = run(client)
    given = [each for call in arm.calls if call[0] in ("open_trajectory", "append") for each in call[1:]]
    assert [each.time for each in given] == [0.25 * (number + 1) for number in range(len(given))]


def test_points_after_the_arm_has_run_out_of_them_begin_again_from_where_it_rests() -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        rig.arm.arrive()
        await peer.codes(point(2, 0.75, 0.25), point(3, 1.0, 0.25))
        await rig.arm.until("open_trajectory", "open_trajectory")

    assert run(client).calls[1] == ("open_trajectory", at(0.25, 0.75), at(0.5, 1.0))


def test_points_that_the_arm_ran_out_of_just_then_are_not_lost() -> None:
    class LateArm(FakeArm):
        """Its trajectory ends in the moment in which a point is appended."""

        async def open_trajectory(self, points: Sequence[Point]) -> FakeTrajectory:
            trajectory = await super().open_trajectory(points)
            append = trajectory.append

            async def late(points: Sequence[Point]) -> None:
                if self.names.count("append") == 0:
                    self.arrive()
                    with contextlib.suppress(RtcpError):
                        await append(points)
                    while not self.is_over:
                        await asyncio.sleep(0)
                    raise RtcpError("refused", "the trajectory has ended")
                await append(points)

            trajectory.append = late  # type: ignore[method-assign]
            wait = trajectory.wait

            async def waited() -> None:
                await wait()
                asyncio.get_running_loop().call_later(0.0, setattr, self, "is_over", True)

            trajectory.wait = waited  # type: ignore[method-assign]
            return trajectory

        is_over = False

    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        await peer.codes(point(2))
        await rig.arm.until("append", "open_trajectory")

    assert run(client, arm=LateArm()).calls[2] == ("open_trajectory", at(0.5))


def test_an_end_mark_finishes_the_streamed_trajectory() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        assert await peer.codes(point(0), JointTrajPt(END, (), 0.0, 0.0)) == [OK, OK]
        await rig.arm.until("open_trajectory", "finish")
        rig.arm.arrive()

    run(client)


def test_a_downloaded_trajectory_is_executed_when_complete_and_its_topics_are_not_answered() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        peer.topic(point(START, 0.0, 10.0), point(1, 0.25), point(END, 0.5))
        await rig.arm.until("run_trajectory")
        peer.send(Ping())
        assert (await peer.frame()).msg_type == MessageType.PING

    assert run(client).calls[0] == ("run_trajectory", at(0.0, 0.0), at(0.5, 0.25), at(1.0, 0.5))


def test_a_stream_is_refused_where_the_buffer_is_full(caplog: pytest.LogCaptureFixture) -> None:
    class SlowArm(FakeArm):
        async def open_trajectory(self, points: object) -> FakeTrajectory:
            await asyncio.Event().wait()
            raise AssertionError

    async def client(rig: Rig) -> None:
        peer = await rig.motion()

        async def replies() -> list[ReplyCode]:
            return [(await peer.frame()).reply_code for _ in range(6000)]

        answered = asyncio.create_task(replies())
        for number in range(0, 6000, 500):
            peer.send(*(point(each) for each in range(number, number + 500)))
            await peer.writer.drain()
        codes = await answered
        assert codes[:BUFFER_POINTS] == [OK] * BUFFER_POINTS
        assert NO in codes
        assert set(codes[codes.index(NO) :]) == {NO}
        assert len(lines(caplog)) == 1
        assert "buffer is full" in lines(caplog)[0]

    run(client, arm=SlowArm())


def test_a_new_trajectory_takes_the_place_of_the_one_under_way_without_a_stop() -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        await peer.codes(point(0, 0.25), point(1, 0.125))
        await rig.arm.until("open_trajectory", "open_trajectory")
        assert rig.arm.calls[1] == ("open_trajectory", at(0.5, 0.25), at(1.0, 0.125))

    run(client)


# -- stop and refusals ------------------------------------------------------------------------------------------------


def test_a_stop_is_answered_at_once_and_what_follows_is_ignored_until_a_new_sequence() -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        rig.arm.stopped.clear()  # the stop lasts
        assert await peer.codes(STOP_POINT, point(2), point(3)) == [OK, NO, NO]
        await rig.arm.until("open_trajectory", "halt")
        assert await peer.codes(point(0), point(1)) == [OK, OK]
        await asyncio.sleep(0.3)
        assert rig.arm.names[-1] == "halt"  # still braking
        rig.arm.stopped.set()
        await rig.arm.until("halt", "open_trajectory")

    assert "cancelled" in run(client).names


def test_a_trajectory_and_its_stop_in_one_segment_move_nothing() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        assert await peer.codes(point(START), point(END), STOP_POINT) == [OK, OK, OK]
        await rig.arm.until("halt")

    assert "run_trajectory" not in run(client).names


def test_a_gap_stops_the_arm_and_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        assert await peer.codes(point(3), point(4), point(5)) == [NO, NO, NO]
        await rig.arm.until("halt")
        assert len(lines(caplog)) == 1
        assert "sequence 3 came where 2 follows" in lines(caplog)[0]

    run(client)


@pytest.mark.parametrize("call", ["open_trajectory", "append"])
def test_a_refusal_of_the_arm_stops_it_and_the_rest_is_refused(call: str, caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        rig.arm.refuses[call] = RtcpError("refused", "joint 1 would leave its range")
        peer = await streaming(rig)
        await peer.codes(point(2))
        if call == "append":
            await rig.arm.until("append", "halt")
        while not lines(caplog):
            await peer.codes(Ping())
        assert await peer.codes(point(3), point(4)) == [NO, NO]
        assert [line for line in lines(caplog) if "joint 1 would leave its range" in line] == lines(caplog)
        assert len(lines(caplog)) == 1
        rig.arm.refuses.clear()
        assert await peer.codes(point(0), point(1)) == [OK, OK]

    run(client)


def test_a_motion_that_ends_with_an_error_is_logged_and_the_rest_refused(caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        rig.arm.fail(RtcpError("fault", "emergency stop"))
        while not lines(caplog):
            await peer.codes(Ping())
        assert "emergency stop" in lines(caplog)[0]
        assert await peer.codes(point(2)) == [NO]

    run(client)


def test_a_refused_point_leaves_another_commanders_motion_alone() -> None:
    async def client(rig: Rig) -> None:
        rig.arm.refuses["run_trajectory"] = RtcpError("refused", "the panel commands the arm")
        peer = await rig.motion()
        await peer.codes(point(START), point(END))
        await rig.arm.until("run_trajectory")
        assert await peer.codes(JointPosition(0, (float("nan"),) * 6)) == [NO]
        assert "halt" not in rig.arm.names

    run(client)


def test_bodies_of_another_length_are_refused_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        for _ in range(3):
            peer.writer.write(Frame(11, CommType.SERVICE_REQUEST, ReplyCode.INVALID, bytes(61)).pack(LITTLE))
            assert (await peer.frame()).reply_code is NO
        assert len(lines(caplog)) == 1
        assert "61 bytes of body" in lines(caplog)[0]

    assert "run_trajectory" not in run(client).names


# -- real-time points -------------------------------------------------------------------------------------------------


def test_each_real_time_point_takes_the_place_of_the_one_before() -> None:
    targets = [(exact(0.001 * number), *HOME[1:]) for number in range(200)]

    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        for target in targets:
            assert await peer.codes(JointPosition(0, target)) == [OK]
        while rig.arm.calls[-1] != ("move_joints", targets[-1]):
            rig.arm.called.clear()
            await rig.arm.called.wait()
        assert set(rig.arm.names) == {"move_joints"}

    given = [call[1] for call in run(client).calls if call[0] == "move_joints"]
    assert given == sorted(given)
    assert len(given) > 2


def test_real_time_points_in_one_segment_are_not_all_sent_to_the_arm_but_the_last_is() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        peer.send(*(JointPosition(0, (0.25 * number, *HOME[1:])) for number in range(50)))
        await rig.arm.until("move_joints")
        while rig.arm.calls[-1] != ("move_joints", (0.25 * 49, *HOME[1:])):
            rig.arm.called.clear()
            await rig.arm.called.wait()
        assert len(rig.arm.calls) < 10

    run(client)


# -- framing errors and lost links ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (struct.pack("<i", -1), "length -1 "),
        (struct.pack("<i", 11), "length 11 "),
        (struct.pack("<i", 1024), "length 1024 "),
        (struct.pack("<i", 0x7FFFFFFF), "outside 12..1023"),
        (struct.pack(">4i", 12, 1, 2, 0), "outside 12..1023"),
        (struct.pack("<4i", 12, 1, 9, 0), "comm_type 9"),
        (b"GET / HTTP/1.1\r\n", "outside 12..1023"),
    ],
)
def test_bytes_that_are_no_frame_close_the_connection_with_one_line_and_the_arm_rests(
    data: bytes, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        peer.writer.write(data)
        assert await peer.is_closed()
        await rig.arm.until("halt", "disable")
        assert len(lines(caplog)) == 1
        assert reason in lines(caplog)[0]

    run(client)


def test_an_end_within_a_frame_is_one_line(caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        peer.writer.write(struct.pack("<2i", 64, 11))
        peer.writer.close()
        await rig.arm.until("halt", "disable")
        assert len(lines(caplog)) == 1
        assert "it ended after 8 bytes of a frame" in lines(caplog)[0]

    run(client)


@pytest.mark.parametrize("is_reset", [False, True])
def test_a_lost_client_stops_the_arm_and_disables_its_drives_and_nothing_moves_after_it(is_reset: bool) -> None:
    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        if is_reset:
            peer.writer.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("2i", 1, 0)
            )
        peer.writer.transport.abort()
        await rig.arm.until("halt", "disable")
        again = await rig.motion()
        assert await again.codes(Ping(), point(2), point(0)) == [OK, NO, NO]
        assert rig.arm.names[-1] == "disable"
        rig.arm.set_status(drives_powered=TriState.TRUE)
        assert await again.codes(point(1), point(0), point(1)) == [NO, OK, OK]
        await rig.arm.until("disable", "open_trajectory")

    run(client)


def test_points_that_waited_while_the_server_did_not_run_are_a_lost_link(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(held_up, "HELD_UP_S", 0.3)

    async def client(rig: Rig) -> None:
        peer = await streaming(rig)
        peer.send(point(2), point(0, 0.7), JointPosition(0, THERE))
        await peer.writer.drain()
        time.sleep(0.4)  # the whole process is stopped
        with pytest.raises((EOFError, OSError)):
            await peer.frame()
        await rig.arm.until("halt", "disable")
        assert "the server did not run for 0.4 s" in lines(caplog)[0]
        assert rig.arm.names.count("open_trajectory") == 1
        assert "append" not in rig.arm.names

    run(client)


def test_a_client_that_never_moved_the_arm_leaves_it_alone() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.motion()
        assert await peer.codes(Ping(), point(7), JointTrajPt(0, (nan, *HOME[1:]), 0.1, 0.0)) == [OK, NO, NO]

    assert run(client).calls == []


def test_a_fault_while_stopping_does_not_keep_the_drives_enabled() -> None:
    async def client(rig: Rig) -> None:
        rig.arm.refuses["halt"] = RtcpError("fault", "the drive of joint 2 is lost")
        peer = await streaming(rig)
        peer.writer.close()
        await rig.arm.until("halt", "disable")

    run(client)


def test_the_end_of_the_server_stops_what_its_client_moves() -> None:
    async def client(rig: Rig) -> None:
        await streaming(rig)

    assert sorted(run(client).names) == ["cancelled", "disable", "halt", "open_trajectory"]


def test_a_client_from_the_same_address_takes_over_and_gets_no_arm_before_it_rests() -> None:
    async def client(rig: Rig) -> None:
        old = await streaming(rig)
        rig.arm.stopped.clear()
        new = await rig.motion(BIG)
        assert await new.codes(Ping(), point(0), point(1), STOP_POINT) == [OK, NO, NO, OK]
        assert await old.is_closed()
        rig.arm.stopped.set()
        await rig.arm.until("disable")
        rig.arm.set_status(drives_powered=TriState.TRUE)
        await asyncio.sleep(0)
        codes = [NO]
        while NO in codes:
            codes = await new.codes(point(0), point(1))
        await rig.arm.until("open_trajectory")

    run(client)


def test_points_that_come_with_a_connection_that_takes_over_find_the_arm_already_stopping() -> None:
    async def client(rig: Rig) -> None:
        await streaming(rig)
        rig.arm.stopped.clear()
        with socket.create_connection(("127.0.0.1", rig.server.ports[0])) as new:
            # It waits in the buffer of the kernel before the server accepts the connection.
            new.sendall(Frame.request(point(0), LITTLE).pack(LITTLE))
            new.setblocking(False)
            reply = await asyncio.get_running_loop().sock_recv(new, 16)
            assert reply == Frame.request(point(0), LITTLE).reply(NO).pack(LITTLE)
            rig.arm.stopped.set()

    run(client)


def test_a_connection_without_points_leaves_the_client_that_moves_the_arm_alone() -> None:
    async def client(rig: Rig) -> None:
        first = await streaming(rig)
        for host in ("127.0.0.1", "127.0.0.2"):
            (await rig.motion(host=host)).writer.close()
        idle = await rig.motion()
        assert await idle.codes(Ping()) == [OK]
        assert await first.codes(point(2)) == [OK]
        idle.writer.close()
        assert await first.codes(point(3)) == [OK]
        assert "halt" not in rig.arm.names

    run(client, bind="0.0.0.0")


@pytest.mark.parametrize("moved_before", [False, True])
def test_a_refused_client_that_closes_leaves_the_arm_of_another_commander_alone(
    moved_before: bool, caplog: pytest.LogCaptureFixture
) -> None:
    async def client(rig: Rig) -> None:
        if moved_before:
            peer = await streaming(rig)
            rig.arm.arrive()
        else:
            peer = await rig.motion()
        rig.arm.refuses["open_trajectory"] = RtcpError("refused", "panel commands the arm", "lease_held")
        # Without a motion of its own it leaves the drives alone also where nobody moves the arm now.
        rig.arm.is_held_by_others = moved_before
        await peer.codes(point(0), point(1))
        while not lines(caplog):
            await peer.codes(Ping())
        peer.writer.close()
        await peer.writer.wait_closed()

    arm = run(client)
    assert "halt" not in arm.names
    assert "disable" not in arm.names


def test_a_client_from_another_address_is_turned_away(caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        first = await streaming(rig)
        for _ in range(3):
            assert await (await rig.motion(host="127.0.0.2")).is_closed()
        assert await first.codes(point(2)) == [OK]
        assert len(lines(caplog)) == 1
        assert "127.0.0.2" in lines(caplog)[0]
        assert "halt" not in rig.arm.names

    run(client, bind="0.0.0.0")


def test_connections_notice_a_pulled_cable() -> None:
    async def client(rig: Rig) -> None:
        await (await rig.motion()).codes(Ping())
        await (await rig.state()).message()
        for each in rig.server._clients:
            given = each._writer.get_extra_info("socket")
            assert given.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
            assert given.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) <= 5
            assert 0 < given.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) <= 10_000
        assert len(rig.server._clients) == 2

    run(client)


# -- state ------------------------------------------------------------------------------------------------------------


async def until(peer: Peer, wanted: Message) -> list[Message]:
    """The messages up to the one that is wanted."""
    messages = [await peer.message()]
    while messages[-1] != wanted:
        messages.append(await peer.message())
    return messages


def test_state_clients_get_positions_of_each_sample_once_and_the_status_always() -> None:
    async def client(rig: Rig) -> None:
        peers = [await rig.state(), await rig.state()]
        for peer in peers:
            await until(peer, READY)
        rig.arm.set_status(in_motion=TriState.TRUE)
        assert rig.arm.state is not None
        for peer in peers:
            messages = await until(peer, rig.arm.state.status)
            kinds = {type(each) for each in [*messages, await peer.message(), await peer.message()]}
            assert kinds <= {JointPosition, Status}
            positions = [each for each in messages if isinstance(each, JointPosition)]
            assert positions == [JointPosition(0, (*HOME, 0.0, 0.0, 0.0, 0.0))]
        silent = [await peers[0].message() for _ in range(10)]
        assert JointPosition not in {type(each) for each in silent}

    run(client)


def test_old_samples_say_nothing_on_the_arm() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.state()
        unknown = Status(motion_possible=TriState.FALSE)
        await until(peer, unknown)
        rig.arm.set_status(in_motion=TriState.TRUE)
        assert rig.arm.state is not None
        await until(peer, rig.arm.state.status)
        rig.arm.state = None
        await until(peer, unknown)

    run(client)


def test_feedback_is_sent_as_an_option() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.state()
        rig.arm.set_status(in_motion=TriState.TRUE)
        while not isinstance(message := await peer.message(), JointFeedback):
            pass
        assert message.positions[:6] == HOME

    run(client, joint_feedback=True)


def test_the_state_of_an_arm_with_more_than_ten_joints_is_our_own_message() -> None:
    async def client(rig: Rig) -> None:
        peer = await rig.state()
        rig.arm.set_status(in_motion=TriState.TRUE)
        while not isinstance(message := await peer.message(), JointPoint):
            assert isinstance(message, Status | JointPosition)
            # A client for two arms has wider arrays of joints.
            assert isinstance(message, Status) or len(message.positions) == 12

    run(client, arm=FakeArm((0.125,) * 12))


def test_a_silent_state_client_is_sent_the_byte_order_of_the_motion_client_at_its_address() -> None:
    async def client(rig: Rig) -> None:
        assert isinstance(await (await rig.state(LITTLE)).message(), JointPosition | Status)
        await (await rig.motion(BIG)).codes(Ping())
        assert isinstance(await (await rig.state(BIG)).message(), JointPosition | Status)
        assert isinstance(await (await rig.state(LITTLE, "127.0.0.2")).message(), JointPosition | Status)

    run(client, bind="0.0.0.0")


def test_the_option_sets_the_byte_order_of_state() -> None:
    async def client(rig: Rig) -> None:
        assert isinstance(await (await rig.state(BIG)).message(), JointPosition | Status)

    run(client, byte_order=BIG)


def test_a_state_client_that_does_not_read_is_dropped_and_the_others_are_served(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)

    async def client(rig: Rig) -> None:
        deaf, good = await rig.state(), await rig.state()
        deaf.writer.transport.pause_reading()  # type: ignore[attr-defined]
        (served,) = [
            each for each in rig.server._states if each.name.endswith(str(deaf.writer.get_extra_info("sockname")[1]))
        ]
        served._writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        served._writer.write(bytes(1 << 24))
        while served in rig.server._states:
            await good.message()
        assert any("it does not read" in record.getMessage() for record in caplog.records)

    run(client)


def test_positions_are_sent_at_their_rate_although_the_host_is_slow() -> None:
    class SlowArm(FakeArm):
        """Its state takes a while, and is new each time."""

        def __getattribute__(self, name: str) -> Any:
            if name == "state":
                time.sleep(0.0037)
                self.set_stamp()
            return super().__getattribute__(name)

        def set_stamp(self) -> None:
            state = self.__dict__["state"]
            self.__dict__["state"] = replace(state, stamp_ns=state.stamp_ns + 1)

    async def client(rig: Rig) -> None:
        peer = await rig.state()
        began, received = time.monotonic(), 0
        while time.monotonic() - began < 10.0:
            received += isinstance(await peer.message(), JointPosition)
        assert received >= 990

    run(client, arm=SlowArm())


def test_a_client_that_floods_holds_nobody_up_and_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    ping = Frame.request(Ping(), LITTLE).pack(LITTLE)

    async def client(rig: Rig) -> None:
        flood, good = await rig.motion(), await rig.motion()
        flood.writer.write(4000 * ping)
        assert await good.codes(Ping()) == [OK]
        answered = len(flood._reader._buffer) // 16  # type: ignore[attr-defined]
        assert answered < 1000  # the other client has its turn in between
        flood.writer.write(5000 * ping)
        assert await flood.is_closed()
        assert lines(caplog) == [f"{name_of(flood)}: it sends more than 8192 messages in 1 s"]
        assert await good.codes(Ping()) == [OK]

    run(client)


def name_of(peer: Peer) -> str:
    host, port = peer.writer.get_extra_info("sockname")
    return f"motion client {host}:{port}"


def test_a_motion_client_that_does_not_read_its_replies_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    async def client(rig: Rig) -> None:
        deaf, good = await rig.motion(), await rig.motion()
        await deaf.codes(Ping())
        deaf.writer.transport.pause_reading()  # type: ignore[attr-defined]
        served = next(each for each in rig.server._clients if each.name == name_of(deaf))
        served._writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        served._writer.write(bytes(1 << 24))
        deaf.send(Ping())
        while served in rig.server._clients:
            await asyncio.sleep(0.0)
        assert await good.codes(Ping()) == [OK]
        assert lines(caplog) == [f"{name_of(deaf)}: it does not read"]

    run(client)


def test_connections_beyond_those_that_a_port_takes_are_closed_and_the_others_are_served(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def client(rig: Rig) -> None:
        states = [await rig.state() for _ in range(32)]
        for each in states:
            await each.message()
        for _ in range(3):
            assert await (await rig.state()).is_closed()
        assert lines(caplog) == ["32 state clients are connected: a further one is closed"]
        assert await (await rig.motion()).codes(Ping()) == [OK]
        await states[0].message()
        states[1].writer.transport.abort()
        while len(rig.server._states) == 32:
            await states[0].message()
        await (await rig.state()).message()

    run(client)


def test_a_stop_reaches_the_loop_although_the_gateway_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path))
    loop = RunningLoop(blackboard_file(tmp_path))
    try:
        with pytest.raises(RtcpError) as raised:
            asyncio.run(RobotArm().halt())
        assert raised.value.fields == {"stop_taken": True}
        assert loop.kinds == [Halt]
    finally:
        loop.end()
        blackboard_file(tmp_path).unlink()
