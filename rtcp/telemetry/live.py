"""The live view: the channels of a recording over WebSocket, for Foxglove and Lichtblick (subprotocol foxglove.sdk.v1).

A process of its own reads the blackboard as a recorder does. Clients only watch. Each has a queue of its own: one that
reads too slowly loses its oldest messages, and nobody else waits for it.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from rtcp.ipc.errors import RtcpError
from rtcp.ipc.names import Names
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.recording import ERROR, INFORMATION, WARNING
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.session import SessionError, read_session
from rtcp.telemetry.channels import Channels, Records

_TURN_S = 0.025
_QUEUE = 8192
"""Messages that wait for one client: 1 s of every signal at 500 us, some MB."""


class Feed:
    """What a loop publishes from now on: cycle records, events and sentences, each once.

    Args:
        directory: the runtime directory.

    Raises:
        BlackboardError, SessionError: no platform runs there.
    """

    def __init__(self, directory: Path) -> None:
        self.config = read_session(directory).config
        self._observer = Observer(blackboard_file(directory))
        self._loop = select.poll()
        try:
            self._loop.register(os.pidfd_open(self._observer.loop_pid), select.POLLIN)
        except OSError as error:
            raise BlackboardError(f"the loop (process {self._observer.loop_pid}) has ended") from error
        self._names = Names(self.config)
        self._at, self._event = self._observer.head, self._observer.last_event
        self._text = max((text.number for text in self._observer.texts_since(0)), default=0)

    def ended(self, wait_s: float) -> bool:
        """Wait, and return early and true when the loop's process has ended."""
        return bool(self._loop.poll(wait_s * 1e3))

    def records(self) -> tuple[Records, int]:
        """Return the new cycle records, and how many were overwritten before they were read."""
        records, missing = self._observer.since(self._at)
        self._at += len(records) + missing
        return records, missing

    def messages(self) -> Iterator[tuple[int, str, int]]:
        """Yield new events and sentences: instant (CLOCK_MONOTONIC, ns), text and level of `foxglove.Log`."""
        for event in self._observer.events_since(self._event):
            self._event = event.number
            level = ERROR if type(event.event) in self._names.faults else INFORMATION
            yield event.monotonic_ns, self._names.message(event.event), level
        for text in self._observer.texts_since(self._text):
            self._text = text.number
            # Its own time is the wall clock, which may have been set meanwhile.
            yield time.monotonic_ns(), text.sentence, WARNING if text.is_problem else INFORMATION


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
        try:
            self._feed = Feed(directory)
        except (BlackboardError, SessionError) as error:
            raise RtcpError(
                "not running", f"no platform runs in {directory} ({error}): start one with `rtcp start`"
            ) from error
        self._every = every
        self._subscriptions = _Subscriptions()
        context = foxglove.Context()
        self._channels = Channels(self._feed.config, time.time_ns() - time.monotonic_ns(), context=context)
        try:
            self._server = foxglove.start_server(
                name=f"rtcp: {self._feed.config.name}", host=host, port=port, context=context,
                server_listener=self._subscriptions, message_backlog_size=_QUEUE,
            )  # fmt: skip
        except RuntimeError as error:
            reason = str(error).rpartition("Failed to bind port: ")[2]
            raise RtcpError("refused", f"{host} port {port} cannot be listened at: {reason}: choose another") from error
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
        self._channels.publish(records[records["number"] % self._every == 0] if self._every > 1 else records)
        for instant, message, level in self._feed.messages():
            self._channels.log(self._channels.wall_ns(instant), message, level)
