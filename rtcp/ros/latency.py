"""Latency of a joint_command of ROS 2, or of a real-time point of Simple Message, until its frame is sent.

`python -m rtcp.ros.latency dds|zenoh|simple-message [COUNT]` measures it on the running platform, with enabled drives:
the node runs in a separate process, over the loopback interface. It prints the latency of each command, cycles, as
JSON. Simple Message leaves the drives disabled, since its connection ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from rtcp.api import connect
from rtcp.api.feed import Feed
from rtcp.fieldbus.simple_message.framing import Frame
from rtcp.fieldbus.simple_message.messages import ByteOrder, JointPosition

Publish = Callable[[Sequence[float]], None]
"""Sends joint positions, rad."""

_DOMAIN = 77
_ON_LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
_PROBE_INTERVAL_S = 0.15
_STEP_RAD = 1e-5
"""Step of each command, back and forth, rad: the arm rests again long before the next."""
_SILENCE_S = 30.0
"""Longest wait for a command that the node passes on, s."""
_POINT = "trajectory_msgs/msg/JointTrajectoryPoint"


@contextlib.contextmanager
def _by_dds() -> Iterator[tuple[Publish, list[str]]]:
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from rtcp.ros.ros2_dds import make, qos_of, struct_of

    _domain = Domain(_DOMAIN, _ON_LOOPBACK)  # ends with its last reference
    participant = DomainParticipant(_DOMAIN)
    topic = Topic(participant, "rt/joint_command", struct_of(_POINT))
    writer = DataWriter(participant, topic, qos_of("joint_command", _POINT))
    yield lambda q: writer.write(make(_POINT, positions=q)), ["--dds", "--domain", str(_DOMAIN)]


@contextlib.contextmanager
def _by_zenoh() -> Iterator[tuple[Publish, list[str]]]:
    from rtcp.ros.ros2_types import encode, make
    from rtcp.ros.ros2_zenoh import key_of, open_session

    router = f"tcp/127.0.0.1:{_free_ports(1)[0]}"
    with open_session(router, is_router=True), open_session(router) as session:
        publisher = session.declare_publisher(key_of(_DOMAIN, "joint_command", _POINT))
        arguments = ["--zenoh", "--router", router, "--domain", str(_DOMAIN)]
        yield lambda q: publisher.put(encode(_POINT, make(_POINT, positions=q))), arguments


@contextlib.contextmanager
def _by_simple_message() -> Iterator[tuple[Publish, list[str]]]:
    ports = [str(port) for port in _free_ports(2)]
    with contextlib.ExitStack() as connected:
        connection: socket.socket | None = None

        def send(q: Sequence[float]) -> None:
            nonlocal connection
            if connection is None:
                with contextlib.suppress(ConnectionRefusedError):  # the server is not there yet
                    connection = socket.create_connection(("127.0.0.1", int(ports[0])))
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    connected.enter_context(connection)
            if connection is not None:
                point = JointPosition(0, tuple(q))
                connection.sendall(Frame.topic(point, ByteOrder.LITTLE).pack(ByteOrder.LITTLE))

        yield send, ["--simple-message", "--motion-port", ports[0], "--state-port", ports[1]]


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as bound:
        free = [bound.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [int(listener.getsockname()[1]) for listener in free]


def measure(wire: str, count: int) -> list[float]:
    """Measure `count` commands; return the latency of each, cycles.

    Raises:
        SystemExit: with a sentence, where the library is missing or the node passes nothing on.
    """
    try:
        with _WIRES[wire]() as (publish, arguments):
            return _measure(publish, arguments, count)
    except ImportError as error:
        raise SystemExit(f"{error}: pip install 'rtcp[{wire}]'") from None


_WIRES = {"dds": _by_dds, "zenoh": _by_zenoh, "simple-message": _by_simple_message}


def _measure(publish: Publish, arguments: Sequence[str], count: int) -> list[float]:
    with connect() as robot:
        here = robot.status().commanded_positions
    node = subprocess.Popen(
        [sys.executable, "-m", "rtcp.cli", "ros", "--name", "latency", *arguments],
        env=os.environ | {"CYCLONEDDS_URI": _ON_LOOPBACK},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    cycles: list[float] = []
    try:
        with contextlib.closing(Feed()) as feed:
            until = time.monotonic() + _SILENCE_S
            is_beside = False
            while len(cycles) < count:
                if time.monotonic() > until:
                    raise SystemExit(f"the node has passed on no command for {_SILENCE_S:g} s")
                is_beside = not is_beside
                target = [here[0] + (_STEP_RAD if is_beside else 0.0), *here[1:]]
                if measured := _cycles_until_it_moves(feed, partial(publish, target)):
                    cycles += measured
                    until = time.monotonic() + _SILENCE_S
    finally:
        node.terminate()
        node.wait()
    return cycles


def _cycles_until_it_moves(feed: Feed, publish: Callable[[], None]) -> list[float]:
    """Return the time from `publish` until the frame with the first new position is sent, cycles; empty: no such frame.

    The arm is at rest before the call and afterwards.
    """
    before, _ = feed.records()
    published_ns = time.monotonic_ns()
    publish()
    time.sleep(_PROBE_INTERVAL_S)
    records, _ = feed.records()
    if not len(before) or not len(records):
        return []
    moved = np.flatnonzero(records["sent_position"][:, 0] != before["sent_position"][-1, 0])
    # The outputs of a record leave at the beginning of the next cycle.
    if not len(moved) or moved[0] + 1 >= len(records):
        return []
    return [(int(records["time_ns"][moved[0] + 1]) - published_ns) / feed.period_ns]


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], int(sys.argv[2]) if sys.argv[2:] else 100)))
