"""A client for robot controllers of any maker that speak Simple Message: their state, and motion.

A lost connection is tried again once a second (ROS-Industrial driver specification, 1.2.2).
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from typing import TypeVar

from rtcp.fieldbus.simple_message import messages
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder, FrameError
from rtcp.ros.simple_message.server import MOTION_PORT, STATE_PORT, notice_lost_peer

T = TypeVar("T")
RECONNECT_S = 1.0
CONNECT_TIMEOUT_S = 3.0
"""Longest attempt to connect, s. Without a limit an attempt that began while the link was down repeats its first packet
at growing intervals, and finds a link that is back after 60 s up to a minute late.
"""
SILENCE_S = 5.0
"""Time without a message after which a state stream counts as lost, s; robots send some 10 a second."""
REPLY_TIMEOUT_S = 5.0
_READ_BYTES = 4096
log = logging.getLogger(__name__)


class _Connection:
    """A connection that `run` keeps open.

    Args:
        host: name or address of the controller.
        port: its port.
        order: its byte order; None: detected from the length field of its first message.
    """

    def __init__(self, host: str, port: int, order: messages.ByteOrder | None) -> None:
        self._host, self._port, self._order = host, port, order
        self._writer: asyncio.StreamWriter | None = None
        self._problem = ""
        self._silence_s: float | None = None
        """Time without data after which the connection counts as lost, s; None: unlimited."""

    @property
    def is_connected(self) -> bool:
        """Whether the connection is open, as far as is known."""
        return self._writer is not None

    async def run(self) -> None:
        """Connect and receive, repeatedly, until cancelled; a problem is logged once while it persists."""
        while True:
            try:
                await self._serve()
                problem = "the controller closed the connection"
            except (FrameError, messages.MessageError, OSError) as error:
                problem = str(error)
            if problem != self._problem:
                log.warning("controller %s:%d: %s", self._host, self._port, problem)
            self._problem = problem
            await asyncio.sleep(RECONNECT_S)

    async def _serve(self) -> None:
        connecting = asyncio.open_connection(self._host, self._port)
        reader, writer = await _within(CONNECT_TIMEOUT_S, connecting, "it does not answer")
        silence = f"no message for {self._silence_s} s"
        try:
            notice_lost_peer(writer.get_extra_info("socket"))
            decoder = FrameDecoder(self._order)
            self._writer = writer
            log.info("controller %s:%d: connected", self._host, self._port)
            while data := await _within(self._silence_s, reader.read(_READ_BYTES), silence):
                for frame in decoder.feed(data):
                    self._problem = ""
                    self._receive(frame, decoder.order or messages.ByteOrder.LITTLE)
            decoder.end()
        finally:
            self._writer = None
            writer.transport.abort()
            self._disconnected()

    def _receive(self, frame: Frame, order: messages.ByteOrder) -> None:
        raise NotImplementedError

    def _disconnected(self) -> None:
        pass


async def _within(seconds: float | None, work: Awaitable[T], problem: str) -> T:
    """Return what `work` returns; raises ConnectionError with `problem` after this time."""
    # Not `wait_for`: before Python 3.12 it loses a cancellation that comes together with the result.
    task = asyncio.ensure_future(work)
    try:
        done, _ = await asyncio.wait([task], timeout=seconds)
    finally:
        task.cancel()
    if not done:
        raise ConnectionError(problem)
    return task.result()


class StateClient(_Connection):
    """Receives the state of a controller.

    Args:
        host: name or address of the controller.
        receive: called with each message; messages of unknown types are ignored.
        port: its port.
        order: its byte order; None: detected from the length field of its first message.
    """

    def __init__(
        self,
        host: str,
        receive: Callable[[messages.Message], None],
        port: int = STATE_PORT,
        order: messages.ByteOrder | None = None,
    ) -> None:
        super().__init__(host, port, order)
        self._received = receive
        self._silence_s = SILENCE_S

    def _receive(self, frame: Frame, order: messages.ByteOrder) -> None:
        code = messages.ReplyCode.SUCCESS
        try:
            self._received(frame.message(order))
        except messages.MessageError as error:
            code = messages.ReplyCode.FAILURE
            log.debug("controller %s:%d: %s", self._host, self._port, error)
        if frame.comm_type is messages.CommType.SERVICE_REQUEST and self._writer is not None:
            self._writer.write(frame.reply(code).pack(order))


class MotionClient(_Connection):
    """Sends motion to a controller; `run` has to run as a task.

    Args:
        host: name or address of the controller.
        port: its port.
        order: its byte order.
        joints: number of joints of all its arms; 12 for two.
    """

    def __init__(
        self,
        host: str,
        port: int = MOTION_PORT,
        order: messages.ByteOrder = messages.ByteOrder.LITTLE,
        joints: int = messages.JOINTS,
    ) -> None:
        super().__init__(host, port, order)
        self._joints = joints
        self._send_order = order
        self._pending: deque[asyncio.Future[Frame]] = deque()
        """Requests in the order in which their replies come."""

    def send(self, message: messages.Message) -> None:
        """Send a topic, which has no reply; raises ConnectionError without a connection."""
        self._write(Frame.topic(message, self._send_order))

    async def request(self, message: messages.Message) -> Frame:
        """Send a request at once, also while others wait for their replies, and return its reply.

        Raises:
            ConnectionError: no connection, or it was lost before the reply.
            TimeoutError: no reply in 5 s; the connection is closed, so that a late reply is not taken for another's.
        """
        self._write(Frame.request(message, self._send_order))
        reply: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()
        self._pending.append(reply)
        try:
            return await asyncio.wait_for(reply, REPLY_TIMEOUT_S)
        except asyncio.TimeoutError:
            if self._writer is not None:
                self._writer.transport.abort()
            raise TimeoutError(f"no reply to {message.TYPE.name} in {REPLY_TIMEOUT_S:g} s") from None

    async def stop(self) -> bool:
        """Stop the robot; return whether the controller confirms it. Errors as in `request`."""
        stop = messages.JointTrajPt(messages.SpecialSequence.STOP_TRAJECTORY, (0.0,) * self._joints, 0.0, 0.0)
        return (await self.request(stop)).reply_code is messages.ReplyCode.SUCCESS

    def _write(self, frame: Frame) -> None:
        if self._writer is None:
            raise ConnectionError(f"no connection to the controller {self._host}:{self._port}")
        self._writer.write(frame.pack(self._send_order))

    def _receive(self, frame: Frame, order: messages.ByteOrder) -> None:
        if frame.comm_type is messages.CommType.SERVICE_REPLY and self._pending:
            reply = self._pending.popleft()
            if not reply.done():  # else nobody waits for it any more
                reply.set_result(frame)

    def _disconnected(self) -> None:
        for reply in self._pending:
            if not reply.done():
                reply.set_exception(ConnectionError("the connection was lost before the reply"))
        self._pending.clear()
