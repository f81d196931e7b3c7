"""The live view: the channels of a recording over WebSocket, for Foxglove and Lichtblick (subprotocol foxglove.sdk.v1).

A separate process reads the blackboard as a recorder does. Clients are read-only, with a queue each: a slow client
loses its oldest messages, one that does not read at all is disconnected; neither delays the others.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from pathlib import Path
from queue import SimpleQueue

import foxglove
import psutil
from foxglove.websocket import ChannelView, Client, ServerListener

from rtcp.api.feed import Feed
from rtcp.ipc.errors import RtcpError
from rtcp.telemetry.channels import Channels

_POLL_S = 0.025
_QUEUE = 8192
"""Most waiting messages of a client: 1 s of every signal at 500 us, some MB."""
_HANGS_MS = 10_000
"""Time without progress after which a client is disconnected, ms."""


class _Subscriptions(ServerListener):
    """Collects newly subscribed topics; the server calls it from its thread."""

    def __init__(self) -> None:
        self.topics: SimpleQueue[str] = SimpleQueue()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self.topics.put(channel.topic)


class LiveView:
    """Serves the running platform's channels.

    Args:
        directory: the runtime directory.
        host: address to listen at.
        port: port to listen at; 0: a free one.
        every: N publishes every Nth cycle.

    Raises:
        RtcpError: `not running`: no platform runs there; `refused`: the address is not available.
    """

    def __init__(self, directory: Path, host: str, port: int, every: int = 1) -> None:
        self._feed = Feed(directory)
        self._every = every
        self._subscriptions = _Subscriptions()
        context = foxglove.Context()
        self._channels = Channels(
            self._feed.config, self._feed.schema, time.time_ns() - time.monotonic_ns(), context=context
        )
        try:
            self._server = foxglove.start_server(
                name=f"rtcp: {self._feed.config.name}", host=host, port=port, context=context,
                server_listener=self._subscriptions, message_backlog_size=_QUEUE,
            )  # fmt: skip
        except RuntimeError as error:
            reason = str(error).rpartition("Failed to bind port: ")[2]
            raise RtcpError("refused", f"{host} port {port} cannot be listened at: {reason}: choose another") from error
        _drop_stalled_clients(self._server.port)
        address = f"[{host}]" if ":" in host else host
        self.url = f"ws://{address}:{self._server.port}"

    def run(self) -> None:
        """Publish until the platform ends."""
        try:
            while not self._feed.ended(_POLL_S):
                self._publish_new()
            self._publish_new()
        finally:
            self._server.stop()

    def _publish_new(self) -> None:
        while not self._subscriptions.topics.empty():
            self._channels.repeat(self._subscriptions.topics.get())
        records, _ = self._feed.records()
        self._channels.publish(records, records[records["number"] % self._every == 0] if self._every > 1 else None)
        for instant, message, level in self._feed.messages():
            self._channels.log(self._channels.wall_ns(instant), message, level)


def _drop_stalled_clients(port: int) -> None:
    """Let the kernel close stalled connections: accepted sockets inherit the option of the listening one."""
    # The SDK has no setting for this, nor for the errors that it then logs.
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)
    for connection in psutil.Process().net_connections("tcp"):
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port == port:
            with socket.socket(fileno=os.dup(connection.fd)) as listening:
                listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _HANGS_MS)
