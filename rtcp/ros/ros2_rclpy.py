"""ROS 2 with rclpy, from a sourced ROS environment; the only file that imports it.

A topic or service whose message package is not installed (industrial_msgs, control_msgs) is omitted, and logged.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import importlib
import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from rtcp.ros.commands import CANCELLED, FollowCode
from rtcp.ros.processes import ProcessService
from rtcp.ros.ros2_node import ACTION, DEPTH, IN, LATCHED, OUT, SERVICES, Commands, Ros2Options, kind_of
from rtcp.ros.ros2_types import FOLLOW

_THREADS = 8
"""Number of threads: each goal or service in progress occupies one."""
_POLL_S = 0.01
"""Polling interval of a goal's cancellation, s."""
_SPIN_S = 0.1
"""Longest time until the executor notices that the node ends, s."""
_SUBSCRIPTION_QOS = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Quality of service of subscriptions: it also matches reliable writers."""
_LIMITS = "limits."
"""Prefix of the parameters that are limits: `limits.box.max.z`."""
_LOG = logging.getLogger("rtcp.ros")


def class_of(name: str) -> Any:
    """Return the class of a type: of `std_srvs/srv/Trigger_Response` it is `std_srvs.srv.Trigger.Response`.

    Raises:
        ImportError: its package is not installed.
    """
    package, folder, last = name.split("/")
    base, _, part = last.partition("_")
    message_class = getattr(importlib.import_module(f"{package}.{folder}"), base)
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
    # A limit is a parameter from the moment on at which it is set.
    node = rclpy.create_node(options.name, namespace=options.namespace or None, allow_undeclared_parameters=True)
    executor = MultiThreadedExecutor(_THREADS)
    ended = threading.Event()

    def spin() -> None:
        while not ended.is_set():
            executor.spin_once(_SPIN_S)

    spinning = threading.Thread(target=spin, daemon=True)
    try:
        wire = RclpyWire(node, commands)
        executor.add_node(node)
        spinning.start()
        yield wire
        wire.close()
        # Before the shutdown: the executor fails if it waits while it is shut down.
        ended.set()
        spinning.join()
    finally:
        executor.shutdown()  # waits for the goals in progress
        node.destroy_node()
        rclpy.shutdown()


class RclpyWire:
    """The node of rclpy."""

    make = staticmethod(make)

    def __init__(self, node: Any, commands: Commands) -> None:
        self.node, self._commands = node, commands
        self._goals: dict[bytes, Any] = {}
        self._is_closing = False
        self._group = group = {"callback_group": ReentrantCallbackGroup()}
        self._publishers = {
            topic: node.create_publisher(class_of(kind), topic, _qos(topic)) for topic, kind in _known(OUT).items()
        }
        self.topics = tuple(self._publishers)
        for topic, kind in _known(IN).items():
            receive = partial(commands.receive, topic)
            node.create_subscription(class_of(kind), topic, receive, _SUBSCRIPTION_QOS, **group)
        for service, kind in SERVICES.items():
            self._serve(service, kind, service)
        node.add_on_set_parameters_callback(self._set_limits)
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

    def serve(self, service: ProcessService) -> None:
        """See `Wire`."""
        self._serve(service.name, kind_of(service), service)

    def _serve(self, name: str, kind: str, service: str | ProcessService) -> None:
        if _known({name: kind}):
            self.node.create_service(class_of(kind), name, partial(self._respond, service), **self._group)

    def close(self) -> None:
        """End the goals in progress: the arm brakes."""
        self._is_closing = True

    def _set_limits(self, parameters: Sequence[Any]) -> Any:
        """Narrow the limits among parameters that are set; all or none."""
        limits = {each.name.removeprefix(_LIMITS): each.value for each in parameters if each.name.startswith(_LIMITS)}
        try:
            if limits:
                self._commands.submit(self._commands.commander.set_limits(limits)).result()
        except Exception as error:  # the answer has the reason, whatever it is
            _LOG.error("parameters %s: %s", ", ".join(limits), error)
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _respond(self, service: str | ProcessService, request: Any, response: Any) -> Any:
        return self._commands.submit(self._commands.respond(make, service, request)).result()

    def _execute(self, goal: Any) -> Any:
        key = bytes(goal.goal_id.uuid)
        following = self._commands.submit(self._commands.follow(goal.request))
        self._goals[key] = goal
        while not following.done():
            concurrent.futures.wait([following], _POLL_S)
            if goal.is_cancel_requested or self._is_closing:
                following.cancel()
        del self._goals[key]
        if following.cancelled() and goal.is_cancel_requested:
            goal.canceled()
            code, text = CANCELLED
        elif following.cancelled():
            goal.abort()
            code, text = FollowCode.INVALID_GOAL, "the node ends: the arm brakes"
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
