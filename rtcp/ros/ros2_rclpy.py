"""ROS 2 with rclpy, from a sourced ROS environment; the only file that imports it.

A topic or service whose message package is not installed (industrial_msgs, control_msgs) is omitted, and logged.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import threading
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosidl_runtime_py.utilities import get_interface

from rtcp.ros.commands import FollowCode
from rtcp.ros.ros2_node import ACTION, DEPTH, IN, LATCHED, OUT, SERVICES, Commands, Ros2Options
from rtcp.ros.ros2_types import FOLLOW

_THREADS = 8
"""Number of threads: each goal or service in progress occupies one."""
_POLL_S = 0.01
"""Polling interval of a goal's cancellation, s."""
_SUBSCRIPTION_QOS = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Quality of service of subscriptions: it also matches reliable writers."""
_LOG = logging.getLogger("rtcp.ros")


def class_of(name: str) -> Any:
    """Return the class of a type: of `std_srvs/srv/Trigger_Response` it is `std_srvs.srv.Trigger.Response`.

    Raises:
        ImportError: its package is not installed.
    """
    package, folder, last = name.split("/")
    base, _, part = last.partition("_")
    message_class = get_interface(f"{package}/{folder}/{base}")
    return getattr(message_class, part) if part else message_class


def make(name: str, /, **fields: Any) -> Any:
    """Return a message."""
    if "level" in fields:
        fields["level"] = bytes([fields["level"]])  # its type is byte
    return class_of(name)(**{key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()})


@contextlib.contextmanager
def open_wire(options: Ros2Options, commands: Commands, ends: threading.Event) -> Iterator[RclpyWire]:
    """Open the wire."""
    arguments = [word for remapping in options.remappings for word in ("-r", remapping)]
    rclpy.init(
        args=["--ros-args", *arguments] if arguments else [],
        domain_id=options.domain,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node = rclpy.create_node(options.name, namespace=options.namespace or None)
    executor = MultiThreadedExecutor(_THREADS)
    try:
        wire = RclpyWire(node, commands)
        executor.add_node(node)
        spinning = threading.Thread(target=executor.spin, daemon=True)
        spinning.start()
        yield wire
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()


class RclpyWire:
    """The node of rclpy."""

    make = staticmethod(make)

    def __init__(self, node: Any, commands: Commands) -> None:
        self._commands = commands
        self._goals: dict[bytes, Any] = {}
        group = {"callback_group": ReentrantCallbackGroup()}
        self._publishers = {
            topic: node.create_publisher(class_of(kind), topic, _qos(topic)) for topic, kind in _known(OUT).items()
        }
        self.topics = tuple(self._publishers)
        for topic, kind in _known(IN).items():
            receive = partial(commands.receive, topic)
            node.create_subscription(class_of(kind), topic, receive, _SUBSCRIPTION_QOS, **group)
        for service, kind in _known(SERVICES).items():
            node.create_service(class_of(kind), service, partial(self._respond, service), **group)
        if _known({ACTION: FOLLOW}):
            self._action = ActionServer(
                node,
                class_of(FOLLOW),
                ACTION,
                execute_callback=self._execute,
                cancel_callback=lambda goal: CancelResponse.ACCEPT,
                **group,
            )

    def publish(self, topic: str, message: Any) -> None:
        """See `Wire`."""
        self._publishers[topic].publish(message)

    def publish_feedback(self, feedback: Any) -> None:
        """See `Wire`."""
        for goal in list(self._goals.values()):
            goal.publish_feedback(feedback)

    def _respond(self, service: str, request: Any, response: Any) -> Any:
        return self._commands.submit(self._commands.respond(make, service, request)).result()

    def _execute(self, goal: Any) -> Any:
        key = bytes(goal.goal_id.uuid)
        following = self._commands.submit(self._commands.follow(goal.request))
        self._goals[key] = goal
        while not following.done():
            concurrent.futures.wait([following], _POLL_S)
            if goal.is_cancel_requested:
                following.cancel()
        del self._goals[key]
        if following.cancelled():
            goal.canceled()
            code, text = FollowCode.SUCCESSFUL, "cancelled: the arm brakes"
        else:
            code, text = following.result()
            (goal.succeed if code is FollowCode.SUCCESSFUL else goal.abort)()
        return make(f"{FOLLOW}_Result", error_code=int(code), error_string=text)


def _qos(topic: str) -> Any:
    if topic in LATCHED:
        return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return QoSProfile(depth=DEPTH)


def _known(types: Mapping[str, str]) -> dict[str, str]:
    """Return the topics or services whose message packages are installed."""
    known = {}
    for name, kind in types.items():
        try:
            class_of(kind)
            known[name] = kind
        except (ImportError, AttributeError) as error:
            _LOG.warning("%s is left out: %s", name, error)
    return known
