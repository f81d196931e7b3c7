"""The TCP servers of RAPID streaming: one client each; another one waits for its disconnect, as in RAPID."""

from __future__ import annotations

import socket
import time

from rtcp.config.model import ConfigError
from rtcp.virtual.irc5.simple_message import MessageType, NotAMessage, take_frame
from rtcp.virtual.irc5.streaming import RapidStreaming

_READ_BYTES = 4096


class ClientSocket:
    """A listening socket and its single client; never blocks."""

    def __init__(self, host: str, port: int) -> None:
        """Listen.

        Raises:
            ConfigError: the address cannot be used.
        """
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((host, port))
        except OSError as error:
            self._listener.close()
            raise ConfigError([f"rapid: cannot listen at {host}:{port} ({error.strerror})"]) from error
        self._listener.listen(4)
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._client: socket.socket | None = None
        self._received = bytearray()
        self._unsent: list[bytes] = []
        """Unsent parts, one per cycle."""
        self.has_heartbeat = False
        """Whether the client has sent a heartbeat."""
        self.silence_s = 0.0
        """Time since the last byte of the client, or since it connected, while a byte was waited for, s."""

    @property
    def is_connected(self) -> bool:
        """Whether there is a client."""
        return self._client is not None

    @property
    def is_blocked(self) -> bool:
        """Whether SocketSend waits for the client to read."""
        return bool(self._unsent)

    def close(self) -> None:
        """Stop listening."""
        self.drop()
        self._listener.close()

    def drop(self) -> None:
        """Close the client's connection."""
        if self._client is not None:
            self._client.close()
            self._client = None
        self._received.clear()
        self._unsent.clear()

    def receive(self) -> bytearray:
        """Accept a client, read, and return the unprocessed data; the client may have disconnected afterwards."""
        try:
            if self._client is None:
                self._client, _ = self._listener.accept()
                self.has_heartbeat, self.silence_s = False, 0.0
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if len(self._received) < _READ_BYTES:  # else the client is ahead of RAPID, and TCP holds it back
                data = self._client.recv(_READ_BYTES)
                self._received += data
                self.silence_s = 0.0
                if not data:
                    self.drop()
        except BlockingIOError:
            pass
        except OSError:
            self.drop()
        return self._received

    def send(self, message: bytes, in_halves: bool) -> None:
        """Send a message, whole or as halves in two cycles."""
        half = len(message) // 2
        self._unsent += [message[:half], message[half:]] if in_halves else [message]

    def flush(self) -> None:
        """Send the first unsent part."""
        if self._client is None or not self._unsent:
            return
        try:
            sent = self._client.send(self._unsent[0], socket.MSG_NOSIGNAL)
        except BlockingIOError:
            return
        except OSError:
            self.drop()
            return
        if sent == len(self._unsent[0]):
            self._unsent.pop(0)
        else:
            self._unsent[0] = self._unsent[0][sent:]


class StreamingServer:
    """Serves a controller's RAPID streaming; `cycle` advances by a period."""

    def __init__(self, streaming: RapidStreaming, period_s: float) -> None:
        """Listen at both ports.

        Raises:
            ConfigError: a port cannot be used.
        """
        self.period_s = period_s
        self._streaming = streaming
        config = streaming.config
        self._motion = ClientSocket(config.bind, config.motion_port)
        try:
            self._state = ClientSocket(config.bind, config.state_port)
        except ConfigError:
            self._motion.close()
            raise
        streaming.ports = {"motion_port": self._motion.port, "state_port": self._state.port}
        self._state_due_s = self._without_client_s = 0.0
        self._has_crashed = False

    def close(self) -> None:
        """Close all sockets."""
        self._motion.close()
        self._state.close()

    def cycle(self, clock_s: float) -> None:
        """Read, step all units, send."""
        streaming = self._streaming
        if "socket_cut" in streaming.faults:
            streaming.faults.discard("socket_cut")
            self._cut()
        if "server_crash" in streaming.faults:
            self._has_crashed = True
            streaming.step(self.period_s)
        else:
            if self._has_crashed:
                self._restart()
            self._serve_motion()
            self._serve_state()
        for task in streaming.tasks.values():
            task.unit.accelerometer.sample(task.unit.actual, time.monotonic())

    def _cut(self) -> None:
        if self._motion.is_connected:
            self._streaming.disconnect()
        self._motion.drop()
        self._state.drop()

    def _restart(self) -> None:
        """Start the tasks of the servers again: the old sockets are closed, and the ports are taken anew."""
        self._has_crashed = False
        ports, config = self._streaming.ports, self._streaming.config
        self.close()
        self._motion = ClientSocket(config.bind, ports["motion_port"])
        self._state = ClientSocket(config.bind, ports["state_port"])
        self._streaming.disconnect()

    def _notice_silence(self, client: ClientSocket, limit_s: float) -> None:
        """Drop a client that has not sent for too long, so that the next one is served."""
        client.silence_s += self.period_s
        if client.is_connected and client.silence_s > limit_s:
            self._streaming.counts["silent_client"] += 1
            client.drop()

    def _count_time_without_client(self) -> None:
        limit_s = self._streaming.config.motors_off_s
        self._without_client_s = 0.0 if self._motion.is_connected else self._without_client_s + self.period_s
        if 0.0 < limit_s <= self._without_client_s:
            self._without_client_s = 0.0
            self._streaming.switch_motors_off()

    def _serve_motion(self) -> None:
        streaming, motion = self._streaming, self._motion
        connected = motion.is_connected
        data = motion.receive()
        if not streaming.is_busy:
            config = streaming.config
            self._notice_silence(motion, config.client_timeout_s if motion.has_heartbeat else config.idle_timeout_s)
        self._count_time_without_client()
        if not streaming.is_busy and motion.is_connected:
            try:
                frame = take_frame(data)
            except NotAMessage:
                streaming.counts["not_a_message"] += 1
                motion.drop()
            else:
                if frame is not None:
                    motion.has_heartbeat = motion.has_heartbeat or frame.msg_type == MessageType.PING
                    streaming.receive(frame)
        if connected and not motion.is_connected:
            streaming.disconnect()
        reply = streaming.step(self.period_s)
        if reply is not None and "silent_motion" not in streaming.faults:
            motion.send(reply, "half_message" in streaming.faults)
        motion.flush()

    def _serve_state(self) -> None:
        streaming, state = self._streaming, self._state
        heartbeat = state.receive()
        if heartbeat:
            state.has_heartbeat = True
            heartbeat.clear()
        if state.has_heartbeat:
            self._notice_silence(state, streaming.config.client_timeout_s)
        self._state_due_s -= self.period_s
        if self._state_due_s <= 0.0:
            self._state_due_s = max(self._state_due_s + streaming.config.state_period_s, 0.0)
            if state.is_connected and not state.is_blocked and "silent_state" not in streaming.faults:
                state.send(streaming.state(state.has_heartbeat), "half_message" in streaming.faults)
        state.flush()
