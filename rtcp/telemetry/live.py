"""The live view: the channels of a recording over WebSocket, for Foxglove and Lichtblick (subprotocol foxglove.sdk.v1).

A process of its own reads the blackboard as a recorder does. Clients only watch. Each has a queue of its own: one that
reads too slowly loses its oldest messages, one that does not read at all is dropped, and nobody else waits for it.
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

_TURN_S = 0.025
_QUEUE = 8192
"""Messages that wait for one client: 1 s of every signal at 500 us, some MB."""
_HANGS_MS = 10_000
"""Time without progress after which a client is disconnected, ms."""


class _Subscriptions(ServerListener):
    """Topics that somebody has subscribed to since they were last asked for; the server calls it on its thread."""

    def __init__(self) -> None:
        self.topics: SimpleQueue[str] = SimpleQueue()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self.topics.put(channel.topic)


class LiveView:
    """Serves the running platform's channels.

    Args:
        directory: the runtime directory.
        host: address to listen at.
        port: its port; 0: a free one.
        every: N: every Nth cycle.

    Raises:
        RtcpError: `not running`: no platform runs there; `refused`: nothing can listen at that address.
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
            while not self._feed.ended(_TURN_S):
                self._turn()
            self._turn()
        finally:
            self._server.stop()

    def _turn(self) -> None:
        while not self._subscriptions.topics.empty():
            self._channels.repeat(self._subscriptions.topics.get())
        records, _ = self._feed.records()
        self._channels.publish(records, records[records["number"] % self._every == 0] if self._every > 1 else None)
        for instant, message, level in self._feed.messages():
            self._channels.log(self._channels.wall_ns(instant), message, level)


def _drop_stalled_clients(port: int) -> None:
    """Have the kernel close stalled connections: accepted sockets inherit the option of the listening one."""
    # The SDK offers no setting for this, nor for the errors that it logs then.
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)
    for one in psutil.Process().net_connections("tcp"):
        if one.status == psutil.CONN_LISTEN and one.laddr.port == port:
            with socket.socket(fileno=os.dup(one.fd)) as listening:
                listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _HANGS_MS)
