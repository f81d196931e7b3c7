"""A stand-in for rclpy and the message packages: our own, in one process, without a wire. It is not rclpy.

It has what `ros2_rclpy.py` and its test use, and takes messages as strictly: a list where a sequence is, no others.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import threading
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from enum import Enum
from types import ModuleType, SimpleNamespace
from typing import Any

from rtcp.ros import ros2_node, ros2_types

TOPICS: dict[str, list[Any]] = {}
SUBSCRIPTIONS: dict[str, list[tuple[Callable[[Any], None], QoSProfile]]] = {}
SERVICES: dict[str, Callable[[Any, Any], Any]] = {}
ACTIONS: dict[str, ActionServer] = {}


def _message(name: str) -> type:
    """Return a class with the fields of a message, zero or empty where they are not given."""
    fields = {field.name: field for field in ros2_types.fields_of(name)}

    def __init__(self: Any, **given: Any) -> None:
        assert given.keys() <= fields.keys(), f"{name}: {given.keys() - fields.keys()}"
        for field in fields.values():
            is_list = field.length is not None
            nested = None if is_list or "/" not in field.type else _class(field.type)
            plain = {"string": "", "bool": False, "byte": b"\0", "float64": 0.0}.get(field.type, 0)
            value = given.get(field.name, [] if is_list else nested() if nested else plain)
            wanted = list if is_list else nested or type(plain)
            assert isinstance(value, wanted), f"{name}.{field.name} is {type(value)}"
            setattr(self, field.name, value)

    return type(name, (), {"__init__": __init__})


CLASSES: dict[str, type] = {}


def _class(name: str) -> type:
    if name not in CLASSES:
        CLASSES[name] = _message(name)
    return CLASSES[name]


class Publisher:
    def __init__(self, topic: str, qos: QoSProfile) -> None:
        self._topic, self._qos = topic, qos

    def publish(self, message: Any) -> None:
        if self._qos.durability is DurabilityPolicy.TRANSIENT_LOCAL:
            TOPICS[self._topic] = [message]
        for callback, qos in SUBSCRIPTIONS.get(self._topic, ()):
            # A reliable subscription does not match a best-effort publisher.
            if self._qos.reliability in (ReliabilityPolicy.RELIABLE, qos.reliability):
                callback(message)


class Node:
    def create_publisher(self, kind: type, topic: str, qos: Any) -> Publisher:
        return Publisher(topic, qos)

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any, callback_group: Any = None
    ) -> None:
        SUBSCRIPTIONS.setdefault(topic, []).append((callback, qos))
        if qos.durability is DurabilityPolicy.TRANSIENT_LOCAL:
            for message in TOPICS.get(topic, ()):
                callback(message)

    def create_service(
        self, kind: type, name: str, callback: Callable[[Any, Any], Any], callback_group: Any = None
    ) -> None:
        SERVICES[name] = callback

    def create_client(self, kind: Any, name: str) -> Any:
        return SimpleNamespace(
            wait_for_service=lambda timeout_sec: True, call=lambda request: SERVICES[name](request, kind.Response())
        )

    def destroy_node(self) -> None:
        for kept in (TOPICS, SUBSCRIPTIONS, SERVICES, ACTIONS):
            kept.clear()


class DurabilityPolicy(Enum):
    VOLATILE = 2
    TRANSIENT_LOCAL = 1


class ReliabilityPolicy(Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class QoSProfile:
    def __init__(
        self,
        depth: int,
        durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
        reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
    ) -> None:
        self.depth, self.durability, self.reliability = depth, durability, reliability


class ActionServer:
    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        execute_callback: Callable[[Any], Any],
        cancel_callback: Callable[[Any], Any],
        callback_group: Any = None,
    ) -> None:
        self.execute, self.cancel = execute_callback, cancel_callback
        ACTIONS[name] = self


class Goal:
    """The goal at server and client."""

    accepted = True

    def __init__(self, server: ActionServer, request: Any, on_feedback: Callable[[Any], None] | None) -> None:
        self.request, self._server, self._on_feedback = request, server, on_feedback
        self.goal_id = SimpleNamespace(uuid=list(uuid.uuid4().bytes))
        self.is_cancel_requested = False
        self._status = 2
        self._ended: Future[Any] = Future()
        threading.Thread(target=lambda: self._ended.set_result(server.execute(self)), daemon=True).start()

    def publish_feedback(self, feedback: Any) -> None:
        if self._on_feedback is not None:
            self._on_feedback(SimpleNamespace(feedback=feedback))

    def succeed(self) -> None:
        self._status = 4

    def canceled(self) -> None:
        assert self.is_cancel_requested
        self._status = 5

    def abort(self) -> None:
        self._status = 6

    def cancel_goal(self) -> Any:
        self.is_cancel_requested = self._server.cancel(self) is CancelResponse.ACCEPT
        return SimpleNamespace(goals_canceling=[self] if self.is_cancel_requested else [])

    def get_result(self) -> Any:
        return SimpleNamespace(result=self._ended.result(), status=self._status)


class ActionClient:
    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._name = name

    def wait_for_server(self, timeout_sec: float) -> bool:
        return True

    def send_goal_async(self, request: Any, feedback_callback: Callable[[Any], None] | None = None) -> Future[Goal]:
        sent: Future[Goal] = Future()
        sent.set_result(Goal(ACTIONS[self._name], request, feedback_callback))
        return sent


class CancelResponse(Enum):
    REJECT = 1
    ACCEPT = 2


class MultiThreadedExecutor:
    def __init__(self, num_threads: int = 1) -> None:
        self._ends = threading.Event()

    def add_node(self, node: Node) -> None:
        pass

    def spin(self) -> None:
        self._ends.wait()

    def shutdown(self) -> None:
        self._ends.set()


def _interface(name: str) -> Any:
    package, folder, last = name.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), last)


def modules() -> dict[str, ModuleType]:
    """Return what takes the place of rclpy and the message packages in `sys.modules`."""
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda args, domain_id, signal_handler_options: None,
            "create_node": lambda name, namespace=None: Node(),
            "shutdown": lambda: None,
        },
        "rclpy.action": {"ActionServer": ActionServer, "ActionClient": ActionClient, "CancelResponse": CancelResponse},
        "rclpy.callback_groups": {"ReentrantCallbackGroup": SimpleNamespace},
        "rclpy.executors": {"MultiThreadedExecutor": MultiThreadedExecutor},
        "rclpy.qos": {kind.__name__: kind for kind in (DurabilityPolicy, QoSProfile, ReliabilityPolicy)},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_interface": _interface},
    }
    for name in ros2_types._store().fielddefs:
        package, folder, last = name.split("/")
        contents.setdefault(package, {})
        if folder == "msg" or "_" not in last:
            contents.setdefault(f"{package}.{folder}", {})[last] = _class(name)
    for name in (*ros2_node.SERVICES.values(), ros2_types.FOLLOW):
        package, folder, last = name.split("/")
        parts = ("Goal", "Result", "Feedback") if folder == "action" else ("Request", "Response")
        holder = type(last, (), {part: _class(f"{name}_{part}") for part in parts})
        contents.setdefault(f"{package}.{folder}", {})[last] = holder
    made = {}
    for name, names in contents.items():
        made[name] = ModuleType(name)
        made[name].__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
        made[name].__path__ = []
        vars(made[name]).update(names)
    return made
