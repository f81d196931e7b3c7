"""ROS 2 over Zenoh without ROS: topics, services and the action, compatible with rmw_zenoh.

Keys, liveliness tokens and attachments are those of rmw_zenoh_cpp from 2025 on (its docs/design.md). The session is a
client: ROS's router does not forward between peers. The only file that imports zenoh.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import logging
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import Any

import zenoh
import zenoh.ext

from rtcp.ros.processes import ProcessService
from rtcp.ros.ros2_action import ActionServer
from rtcp.ros.ros2_node import (
    ACTION_SERVICES,
    ACTION_TOPICS,
    DEPTH,
    IN,
    LATCHED,
    OUT,
    RETRY_S,
    SERVICES,
    Commands,
    OpenWire,
    Ros2Options,
    kind_of,
)
from rtcp.ros.ros2_types import dds_type, decode, encode, make, type_hash

DEFAULT_ROUTER = "tcp/localhost:7447"
ATTACHMENT = struct.Struct("<qqB16s")
"""Number of the message, instant of sending (ns since 1970), length of the endpoint's id (gid), and the id."""
_NODE, _PUBLISHER, _SUBSCRIBER, _SERVER = "NN", "MP", "MS", "SS"
_QOS = f"::,{DEPTH}:,:,:,,"
"""Reliability, durability, history, deadline, lifespan, liveliness; empty ones are rmw_zenoh's defaults."""
_LATCHED_QOS = ":1:,1:,:,:,,"
_LOG = logging.getLogger("rtcp.ros")


def key_of(domain: int, topic: str, kind: str) -> str:
    """Return the key expression of a topic or service."""
    return f"{domain}/{topic}/{dds_type(kind)}/{type_hash(kind)}"


def open_session(router: str, is_router: bool = False) -> zenoh.Session:
    """Return a session as client of a router, or as a router that listens at this address.

    Raises:
        zenoh.ZError: the router does not answer, or the address is in use.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": "router" if is_router else "client",
        "listen/endpoints" if is_router else "connect/endpoints": [router],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # required by the cache of a latched topic
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def open_wire(router: str) -> OpenWire:
    """Return the function that opens the wire; it waits for the router."""

    @contextlib.contextmanager
    def opened(options: Ros2Options, commands: Commands, ends: threading.Event) -> Iterator[ZenohWire]:
        has_failed = False
        while True:
            try:
                session = open_session(router)
                break
            except zenoh.ZError as error:
                if not has_failed:
                    # After " at " zenoh names its own source files.
                    reason = str(error).partition(" at ")[0].strip()
                    _LOG.warning("%s: waiting for the router (`rmw_zenohd`): %s", router, reason)
                has_failed = True
            if ends.wait(RETRY_S):
                raise SystemExit(0)
        with session:
            yield ZenohWire(session, options, commands)

    return opened


class ZenohWire:
    """The node on a session."""

    make = staticmethod(make)
    topics = tuple(OUT)

    def __init__(self, session: zenoh.Session, options: Ros2Options, commands: Commands) -> None:
        self._session, self._options, self._commands = session, options, commands
        self._entities = itertools.count(1)
        self._space = f"/{options.namespace}".replace("/", "%")
        self._prefix = f"@ros2_lv/{options.domain}/{session.info.zid()}/0"
        self._action = ActionServer(commands, make, self.publish)
        # A declaration ends with its last reference.
        self._declared: list[Any] = [
            session.liveliness().declare_token(f"{self._prefix}/0/{_NODE}/%/{self._space}/{options.name}")
        ]
        self._publishers = {topic: self._publisher(topic, kind) for topic, kind in {**OUT, **ACTION_TOPICS}.items()}
        for topic, kind in IN.items():
            self._subscribe(topic, kind)
        for service, kind in SERVICES.items():
            self._serve(service, kind, partial(commands.respond, make, service))
        for service, kind in ACTION_SERVICES.items():
            self._serve(service, kind, partial(self._action.respond, service))

    def publish(self, topic: str, message: Any) -> None:
        """See `Wire`."""
        publisher, kind, gid, numbers = self._publishers[topic]
        publisher.put(encode(kind, message), attachment=ATTACHMENT.pack(next(numbers), time.time_ns(), len(gid), gid))

    def publish_feedback(self, feedback: Any) -> None:
        """See `Wire`."""
        self._action.publish_feedback(feedback)

    def serve(self, service: ProcessService) -> None:
        """See `Wire`."""
        self._serve(service.name, kind_of(service), partial(self._commands.respond, make, service))

    def _publisher(self, topic: str, kind: str) -> tuple[Any, str, bytes, itertools.count[int]]:
        key = key_of(self._options.domain, self._options.resolved(topic), kind)
        publisher: Any
        if topic in LATCHED:
            cache = zenoh.ext.CacheConfig(max_samples=1)
            publisher = zenoh.ext.declare_advanced_publisher(self._session, key, cache=cache, publisher_detection=True)
        else:
            publisher = self._session.declare_publisher(key)
        return publisher, kind, self._announce(_PUBLISHER, topic, kind), itertools.count(1)

    def _subscribe(self, topic: str, kind: str) -> None:
        def receive(sample: zenoh.Sample) -> None:
            try:
                message = decode(kind, sample.payload.to_bytes())
            except ValueError as error:
                _LOG.error("%s: %s", topic, error)
                return
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            sender = f"the publisher {attachment[-16:].hex()}" if len(attachment) == ATTACHMENT.size else ""
            self._commands.receive(topic, message, sender)

        self._declared.append(
            self._session.declare_subscriber(key_of(self._options.domain, self._options.resolved(topic), kind), receive)
        )
        self._announce(_SUBSCRIBER, topic, kind)

    def _serve(self, service: str, kind: str, respond: Callable[[Any], Awaitable[Any]]) -> None:
        key = key_of(self._options.domain, self._options.resolved(service), kind)

        async def answer(query: zenoh.Query) -> None:
            with query:
                try:
                    request = decode(f"{kind}_Request", b"" if query.payload is None else query.payload.to_bytes())
                except ValueError as error:
                    _LOG.error("%s: %s", service, error)
                    query.reply_err(str(error))
                    return
                response = encode(f"{kind}_Response", await respond(request))
                attachment = None if query.attachment is None else query.attachment.to_bytes()
                if attachment is not None and len(attachment) == ATTACHMENT.size:
                    # A client identifies its answer by its own number and id.
                    number, _, length, gid = ATTACHMENT.unpack(attachment)
                    attachment = ATTACHMENT.pack(number, time.time_ns(), length, gid)
                query.reply(key, response, attachment=attachment)

        def receive(query: zenoh.Query) -> None:
            self._commands.submit(answer(query))

        # rmw_zenoh queries only complete queryables.
        self._declared.append(self._session.declare_queryable(key, receive, complete=True))
        self._announce(_SERVER, service, kind)

    def _announce(self, entity: str, topic: str, kind: str) -> bytes:
        """Announce a topic or service for discovery; return the id of the endpoint."""
        qos = _LATCHED_QOS if topic in LATCHED else _QOS
        name = f"/{self._options.resolved(topic)}".replace("/", "%")
        key = (
            f"{self._prefix}/{next(self._entities)}/{entity}/%/{self._space}/{self._options.name}/{name}"
            f"/{dds_type(kind)}/{type_hash(kind)}/{qos}"
        )
        self._declared.append(self._session.liveliness().declare_token(key))
        return hashlib.sha256(key.encode()).digest()[:16]
