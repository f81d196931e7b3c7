"""The arm as a robot controller of ROS-Industrial: asyncio servers for motion and state (`docs/simple_message.md`).

Every request is answered in the iteration of the event loop in which it was read: the reference client waits for
replies without a timeout, and would take a late one for the reply to its stop.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rtcp import __version__
from rtcp.api import RobotStatus
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder, FrameError
from rtcp.fieldbus.simple_message.messages import (
    JOINTS,
    MOST_JOINTS,
    ByteOrder,
    CommType,
    JointFeedback,
    JointPoint,
    JointPosition,
    JointTrajPt,
    JointTrajPtFull,
    Message,
    MessageError,
    MessageType,
    Ping,
    ReplyCode,
    Status,
    TriState,
    ValidFields,
    Version,
)
from rtcp.ros.held_up import HeldUp
from rtcp.ros.simple_message.arm import Arm, ArmState
from rtcp.ros.simple_message.execution import MotionExecutor
from rtcp.ros.simple_message.sequence import BUFFER_POINTS, Halt, PointIgnored, PointRefused, PointSequence

MOTION_PORT = 11000
STATE_PORT = 11002
STATE_PERIOD_S = 0.01
_UNREAD_LIMIT = 1 << 16
"""Unread data at which a client that does not read is disconnected, bytes."""
_READ_BYTES = 4096
"""Most bytes of a client, some 60 points, before the other clients' turn."""
_MOST_MESSAGES = 2 * BUFFER_POINTS
"""Most messages of a client within `_FLOOD_S`: two whole trajectories that it downloads at once."""
_FLOOD_S = 1.0
_MOST_CLIENTS = 32
"""Most connections of a port at once."""
_KEEPALIVE_IDLE_S, _KEEPALIVE_INTERVAL_S, _KEEPALIVE_PROBES = 1, 1, 3
_USER_TIMEOUT_MS = 4000
_POINTS = (
    MessageType.JOINT_POSITION,
    MessageType.JOINT_TRAJ_PT,
    MessageType.JOINT_TRAJ_PT_FULL,
    MessageType.JOINT_POINT,
)
_VERSION = Version(*(int(part) for part in __version__.split(".")[:3]))
_UNKNOWN = Status(motion_possible=TriState.FALSE)
"""Status without a running platform: RobotStatus has no field `connected`."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServerOptions:
    """Where and how to serve."""

    bind: str = "127.0.0.1"
    motion_port: int = MOTION_PORT
    """0: a free one."""
    state_port: int = STATE_PORT
    byte_order: ByteOrder | None = None
    """None: detected from the length field of a client's first message; for a state client that sends nothing, that of
    the motion client with the same address, else little endian."""
    joint_feedback: bool = False
    """Whether to send JOINT_FEEDBACK, which the reference client reports as an error each time."""


def notice_lost_peer(connection: socket.socket) -> None:
    """Let a connection fail some seconds after its peer was lost, whether data waits for acknowledgement or not."""
    for level, option, value in (
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
        (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _KEEPALIVE_IDLE_S),
        (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _KEEPALIVE_INTERVAL_S),
        (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _KEEPALIVE_PROBES),
        # Nothing is probed while data waits for an acknowledgement.
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS),
    ):
        connection.setsockopt(level, option, value)


class _Client:
    """A connection: frames in, replies out."""

    def __init__(self, role: str, writer: asyncio.StreamWriter, order: ByteOrder | None) -> None:
        self._writer = writer
        self.role = role
        self.host, port = writer.get_extra_info("peername")[:2]
        self.name = f"{role} client {self.host}:{port}"
        self._decoder = FrameDecoder(order)
        self.why_closed = ""
        self.is_dropped = False
        """Whether the connection was closed because of what the client does."""
        self._counted_s, self._messages = time.monotonic(), 0
        """Begin of the present interval of `_FLOOD_S`, and the messages in it."""
        notice_lost_peer(writer.get_extra_info("socket"))

    @property
    def order(self) -> ByteOrder | None:
        """Byte order of the client; None: unknown before its first frame."""
        return self._decoder.order

    async def serve(self, reader: asyncio.StreamReader, answer: Callable[[Frame, ByteOrder], Frame | None]) -> str:
        """Answer frames until the connection ends; return the reason of the end."""
        try:
            while (data := await reader.read(_READ_BYTES)) and not self._writer.is_closing():
                for frame in self._decoder.feed(data):
                    self._count()
                    order = self._decoder.order or ByteOrder.LITTLE
                    if (reply := answer(frame, order)) is not None:
                        self.send(reply.pack(order))
                await asyncio.sleep(0.0)  # a client whose data never ends must not hold up the others
            if not self.why_closed:
                self._decoder.end()
        except (FrameError, OSError) as error:
            return self.why_closed or str(error)
        finally:
            self.close()
        return self.why_closed or "it closed the connection"

    def _count(self) -> None:
        """Count a message; drop a client that floods."""
        now = time.monotonic()
        if now - self._counted_s >= _FLOOD_S:
            self._counted_s, self._messages = now, 0
        self._messages += 1
        if self._messages > _MOST_MESSAGES:
            self._drop(f"it sends more than {_MOST_MESSAGES} messages in {_FLOOD_S:g} s")

    def send(self, data: bytes) -> None:
        """Send bytes, or close the connection of a client that does not read."""
        if self._writer.transport.get_write_buffer_size() > _UNREAD_LIMIT:
            self._drop("it does not read")
        elif not self._writer.is_closing():
            self._writer.write(data)

    def _drop(self, why: str) -> None:
        self.is_dropped = True
        self.close(why)

    def close(self, why: str = "") -> None:
        """Close the connection; what was not sent yet is dropped."""
        self.why_closed = self.why_closed or why
        self._writer.transport.abort()


class _MotionSession:
    """Session of one motion client."""

    def __init__(self, client: _Client, arm: Arm, executor: MotionExecutor) -> None:
        self.client = client
        self._arm = arm
        self._executor = executor
        self._sequence = PointSequence()
        self._is_refusing = False
        self._has_ended = False

    def end(self) -> bool:
        """End the session of the arm's client: if it has moved the arm, stop it and disable its drives.

        Nothing happens while another commander moves the arm, nor at a second call. Returns whether the arm stops.
        """
        stops = self._executor.has_moved and not self._has_ended and not self._arm.is_held_by_others
        if stops:
            self._executor.release()
        self._has_ended = True
        return stops

    def answer(self, frame: Frame, order: ByteOrder) -> Frame | None:
        """Begin to execute a frame; return its reply, or None for a topic."""
        if frame.msg_type not in _POINTS or frame.comm_type is CommType.SERVICE_REPLY:
            return answer_basics(frame, order)
        code = self._receive(frame, order)
        return frame.reply(code) if frame.comm_type is CommType.SERVICE_REQUEST else None

    def refuse(self, reason: str) -> None:
        """Stop the client's motion, ignore its points up to the next begin, and log the reason."""
        log.warning("%s: %s", self.client.name, reason)
        self._is_refusing = True
        self._sequence.ignore(time.monotonic())
        self._executor.halt_own()

    def _receive(self, frame: Frame, order: ByteOrder) -> ReplyCode:
        try:
            message = frame.message(order)
            assert isinstance(message, JointPosition | JointTrajPt | JointTrajPtFull | JointPoint)  # _POINTS
            for step in self._sequence.receive(message, self._arm.state, time.monotonic()):
                if self._executor.is_releasing and not isinstance(step, Halt):
                    raise PointRefused("the arm is stopping, because the client before was lost: send it again then")
                self._executor.carry_out(step)
        except PointIgnored:
            return ReplyCode.FAILURE
        except PointRefused as error:
            self.refuse(str(error))
            return ReplyCode.FAILURE
        except MessageError as error:
            # Its sequence number is unknown: a client of another build would cause a log line with every point.
            if not self._is_refusing:
                self.refuse(str(error))
            return ReplyCode.FAILURE
        self._is_refusing = False
        return ReplyCode.SUCCESS


def answer_basics(frame: Frame, order: ByteOrder) -> Frame | None:
    """Answer PING and GET_VERSION, and any other request with FAILURE; topics and replies have no answer."""
    if frame.comm_type is not CommType.SERVICE_REQUEST:
        return None
    try:
        if frame.msg_type in (MessageType.PING, MessageType.GET_VERSION):
            is_ping = isinstance(frame.message(order), Ping)
            return frame.reply(ReplyCode.SUCCESS, b"" if is_ping else _VERSION.pack(order))
    except MessageError as error:
        log.warning("%s", error)
    return frame.reply(ReplyCode.FAILURE)


class SimpleMessageServer:
    """Serves an arm: `async with SimpleMessageServer(arm) as server: await asyncio.Event().wait()`.

    Args:
        arm: the arm.
        options: addresses, byte order and messages.
    """

    def __init__(self, arm: Arm, options: ServerOptions | None = None) -> None:
        self._arm = arm
        self._options = options or ServerOptions()
        self._executor = MotionExecutor(arm, self._refused_by_arm)
        self._motion: _MotionSession | None = None
        """Session of the client that has the arm: since its first point."""
        self._clients: set[_Client] = set()
        self._states: set[_Client] = set()
        self._orders: dict[str, ByteOrder] = {}
        """Byte order of the last motion client at each address."""
        self._turned_away = ""
        """Client already named in the log."""
        self._full: set[str] = set()
        """Roles whose port has as many connections as it takes; logged."""
        self._held_up = HeldUp(self._was_held_up)
        self._servers: list[asyncio.Server] = []
        self._serving: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> SimpleMessageServer:
        """Listen; raises OSError if a port is in use."""
        options = self._options
        for serve, port in ((self._serve_motion, options.motion_port), (self._serve_state, options.state_port)):
            try:
                self._servers.append(await asyncio.start_server(serve, options.bind, port))
            except OSError:
                self._close_servers()
                raise
        self._publishing = asyncio.create_task(self._publish())
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close every connection; where a client has moved the arm it stops, and its drives are disabled."""
        self._close_servers()
        self._publishing.cancel()
        for client in self._clients:
            client.close("the server ends")
        if self._serving:
            await asyncio.wait(self._serving)
        await self._executor.released()

    @property
    def ports(self) -> tuple[int, int]:
        """Ports of the motion and the state server."""
        motion, state = (int(server.sockets[0].getsockname()[1]) for server in self._servers)
        return motion, state

    def _was_held_up(self, gap_s: float) -> None:
        for client in self._clients - self._states:
            client.close(f"the server did not run for {gap_s:.1f} s")

    def _close_servers(self) -> None:
        for server in self._servers:
            server.close()

    @contextlib.contextmanager
    def _connected(self, role: str, writer: asyncio.StreamWriter) -> Iterator[_Client]:
        task = asyncio.current_task()
        assert task is not None
        client = _Client(role, writer, self._options.byte_order)
        self._clients.add(client)
        self._serving.add(task)
        try:
            yield client
        finally:
            client.close()
            self._clients.discard(client)
            self._serving.discard(task)

    def _is_full(self, role: str, writer: asyncio.StreamWriter) -> bool:
        """Return whether the port has too many connections: the new one is closed then, which is logged once."""
        if sum(client.role == role for client in self._clients) < _MOST_CLIENTS:
            self._full.discard(role)
            return False
        if role not in self._full:
            log.warning("%d %s clients are connected: a further one is closed", _MOST_CLIENTS, role)
        self._full.add(role)
        writer.transport.abort()
        return True

    # -- motion -------------------------------------------------------------------------------------------------------

    async def _serve_motion(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._is_full("motion", writer):
            return
        with self._connected("motion", writer) as client:
            if not self._held_up.is_timely():
                return  # its data may be old; it connects again
            if self._turns_away(client):
                return
            log.info("%s: connected", client.name)
            session = _MotionSession(client, self._arm, self._executor)

            def answer(frame: Frame, order: ByteOrder) -> Frame | None:
                self._held_up.check()
                if client.why_closed:
                    return None
                self._orders[client.host] = order
                if frame.msg_type in _POINTS and self._motion is not session:
                    if self._turns_away(client):
                        client.close("it is turned away")
                        return None
                    self._give_arm_to(session)
                return session.answer(frame, order)

            try:
                why = await client.serve(reader, answer)
            finally:
                stops = self._motion is session and session.end()
                if self._motion is session:
                    self._motion = None
            log.warning("%s: %s%s", client.name, why, ": the arm stops and its drives are disabled" if stops else "")

    def _turns_away(self, client: _Client) -> bool:
        """Return whether a client from elsewhere has the arm; log it once."""
        before = self._motion
        if before is None or before.client.host == client.host:
            self._turned_away = ""
            return False
        if client.host != self._turned_away:
            log.warning("%s is turned away: the arm has the %s", client.name, before.client.name)
        self._turned_away = client.host
        return True

    def _give_arm_to(self, session: _MotionSession) -> None:
        """Make a client the one that has the arm, at its first point: a connection alone changes nothing."""
        if self._motion is not None:
            # A client that crashed may be back before the loss of its old connection is detected.
            self._motion.client.close(f"{session.client.name} takes its place")
            self._motion.end()
        self._executor.begin_client()
        self._motion = session

    def _refused_by_arm(self, reason: str) -> None:
        if self._motion is not None:
            self._motion.refuse(reason)

    # -- state --------------------------------------------------------------------------------------------------------

    async def _serve_state(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._is_full("state", writer):
            return
        with self._connected("state", writer) as client:
            log.info("%s: connected", client.name)
            self._states.add(client)
            try:
                why = await client.serve(reader, answer_basics)
            finally:
                self._states.discard(client)
            log.log(logging.WARNING if client.is_dropped else logging.INFO, "%s: %s", client.name, why)

    async def _publish(self) -> None:
        """Send the state at a fixed rate: each sample of positions once, the status in every period."""
        stamp, begin, fresh_at = 0, 0, -math.inf
        due = time.monotonic()
        while True:
            self._held_up.check()
            state, now = self._arm.state, time.monotonic()
            messages: list[Message] = []
            if state is not None and state.stamp_ns != stamp:
                stamp, begin, fresh_at = state.stamp_ns, begin or state.stamp_ns, now
                messages += self._positions(state, (stamp - begin) * 1e-9)
            is_known = state is not None and now - fresh_at < RobotStatus.STALE_S
            messages.append(state.status if state is not None and is_known else _UNKNOWN)
            packed = {order: b"".join(Frame.topic(each, order).pack(order) for each in messages) for order in ByteOrder}
            for client in self._states:
                client.send(packed[client.order or self._orders.get(client.host, ByteOrder.LITTLE)])
            # Absolute, so that neither the work nor a late wake-up lowers the rate. Whole periods are skipped.
            now = time.monotonic()
            due = max(due + STATE_PERIOD_S, now - STATE_PERIOD_S)
            await asyncio.sleep(max(due - now, 0.0))

    def _positions(self, state: ArmState, seconds: float) -> list[Message]:
        """Return the messages with the joints; `seconds`: time of the sample from the first one, s."""
        if len(state.positions) > JOINTS:
            # A client for two arms has wider arrays of joints; one that has not ignores both messages.
            wide: list[Message] = [JointPosition(0, state.positions)] if len(state.positions) <= MOST_JOINTS else []
            return [*wide, JointPoint(0, seconds, state.positions, state.velocities)]
        messages: list[Message] = [JointPosition(0, state.positions)]
        if self._options.joint_feedback:
            valid = ValidFields.TIME | ValidFields.POSITION
            valid |= ValidFields.VELOCITY if state.velocities else 0
            messages.append(JointFeedback(0, valid, seconds, state.positions, state.velocities))
        return messages
