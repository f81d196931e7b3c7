"""A client of the live view, written after the protocol (foxglove.sdk.v1) and on public libraries alone."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets import Subprotocol
from websockets.sync.client import connect

SUBPROTOCOL = Subprotocol("foxglove.sdk.v1")
MESSAGE_DATA = 1


class Viewer:
    """A connection that has read what the server offers and subscribed to some of it.

    Args:
        url: of the server.
        topics: to subscribe to; none: all.
    """

    def __init__(self, url: str, topics: Sequence[str] = ()) -> None:
        # No pings: a viewer that hangs does not notice.
        # A short close: what was sent and not read would hold it up.
        opened: Any = connect(
            url, subprotocols=[SUBPROTOCOL], max_size=None, compression=None, ping_interval=None, close_timeout=0.1
        )
        self._socket = opened.__enter__()
        self._decoders = DecoderFactory()
        self.info = json.loads(self._socket.recv())
        self.channels: dict[str, dict[str, Any]] = {}
        while "/robot_description" not in self.channels:
            said = json.loads(self._socket.recv())
            assert said["op"] == "advertise"
            self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        self.subscribe(*(topics or self.channels))

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    def subscribe(self, *topics: str) -> None:
        """Subscribe; a subscription has its channel's number."""
        ids = [self.channels[topic]["id"] for topic in topics]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": i, "channelId": i} for i in ids]}))

    def read(self) -> tuple[str, Any]:
        """Return the next message, decoded by its channel's schema, and its topic."""
        data = self._socket.recv()
        assert isinstance(data, bytes), data
        code, number, _ = struct.unpack_from("<BIQ", data)
        assert code == MESSAGE_DATA
        channel = next(channel for channel in self.channels.values() if channel["id"] == number)
        if channel["encoding"] == "json":
            return channel["topic"], json.loads(data[13:])
        schema = Schema(number, channel["schema"].encode(), channel["schemaEncoding"], channel["schemaName"])
        decode = self._decoders.decoder_for(channel["encoding"], schema)
        assert decode is not None
        return channel["topic"], decode(data[13:])

    def first(self, topic: str) -> Any:
        """Return the next message of a topic; pass over others."""
        while True:
            channel, message = self.read()
            if channel == topic:
                return message
