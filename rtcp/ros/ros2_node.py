"""The ROS 2 node without its wire: topics, services, their contents, and the execution of commands.

A wire (`ros2_zenoh`, `ros2_dds`, `ros2_rclpy`) creates messages of its own classes, and transports them.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import signal
import threading
from collections.abc import Callable, Collection, Coroutine, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import IDENTITY
from kinematics.urdf import to_urdf
from rtcp.api import RtcpError
from rtcp.config.model import ArmConfig
from rtcp.fieldbus.simple_message.messages import TriState
from rtcp.motion.planning.interpolation import quaternion
from rtcp.ros.commands import (
    Commander,
    CommandOptions,
    Connect,
    FollowCode,
    Inbox,
    Tolerance,
    Tolerances,
    Trajectory,
    TrajectoryPoint,
    refusal,
)
from rtcp.ros.group import GroupStates, connects
from rtcp.ros.processes import ProcessService
from rtcp.ros.ros2_types import CANCEL, FOLLOW, GROUP_VALUES, PATH_COMMAND, STOP_MOTION, TRIGGER, WITH_TEXT
from rtcp.ros.state import ChannelSample, Diagnostics, JointSample, RobotStatus, StatePublisher

Make = Callable[..., Any]
"""Creates a message from the name of its type and its fields."""

ACTION = "joint_trajectory_action"
_FEEDBACK = f"{FOLLOW}_Feedback"
_POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
OUT: Mapping[str, str] = {
    "joint_states": "sensor_msgs/msg/JointState",
    "feedback_states": _FEEDBACK,
    "robot_status": "industrial_msgs/msg/RobotStatus",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "processes": "diagnostic_msgs/msg/DiagnosticArray",
    "tf": "tf2_msgs/msg/TFMessage",
    "robot_description": "std_msgs/msg/String",
    "speed_override_state": "std_msgs/msg/Float64",
    "gpio_controller/gpio_states": GROUP_VALUES,
}
"""Published topic -> type."""
IN: Mapping[str, str] = {
    "joint_command": _POINT,
    "joint_path_command": _TRAJECTORY,
    "joint_trajectory": _TRAJECTORY,
    "speed_override": "std_msgs/msg/Float64",
    "gpio_controller/commands": GROUP_VALUES,
}
"""Subscribed topic -> type."""
SERVICES: Mapping[str, str] = {
    "joint_path_command": PATH_COMMAND,
    "stop_motion": STOP_MOTION,
    "robot_stop": TRIGGER,
    "robot_enable": TRIGGER,
    "robot_disable": TRIGGER,
}
ACTION_SERVICES: Mapping[str, str] = {
    f"{ACTION}/_action/send_goal": f"{FOLLOW}_SendGoal",
    f"{ACTION}/_action/cancel_goal": CANCEL,
    f"{ACTION}/_action/get_result": f"{FOLLOW}_GetResult",
}
ACTION_TOPICS: Mapping[str, str] = {
    f"{ACTION}/_action/feedback": f"{FOLLOW}_FeedbackMessage",
    f"{ACTION}/_action/status": "action_msgs/msg/GoalStatusArray",
}
LATCHED = ("robot_description", f"{ACTION}/_action/status")
"""Topics whose last message late readers also receive: reliable, transient local, keep last 1."""
DEPTH = 10
"""History depth of all other topics: reliable, volatile, keep last 10."""
RETRY_S = 1.0
_STEP_S = 0.005
_CLOSE_S = 2.0
"""Longest wait for the end of the connection; the end of the process ends it too."""
_LOG = logging.getLogger("rtcp.ros")


@dataclass(frozen=True)
class Ros2Options:
    """Options of `rtcp ros`."""

    name: str = "rtcp"
    rate_hz: float = 100.0
    """Rate of joint_states, feedback_states and tf, Hz."""
    domain: int = 0
    """ROS_DOMAIN_ID."""
    commands: CommandOptions = field(default_factory=CommandOptions)
    remappings: Sequence[str] = ()
    """`joint_states:=/left/joint_states`; with rclpy."""
    group: bool = False
    """Whether all arms of the cell are one group of joints."""
    namespace: str = ""
    """Namespace of topics, services and the action, except `diagnostics`: `left`; empty: none."""

    def resolved(self, name: str) -> str:
        """Return the name of a topic or service with its namespace, without a leading slash."""
        return f"{self.namespace}/{name}" if self.namespace and name != "diagnostics" else name


class Wire(Protocol):
    """Carries the messages."""

    make: Make

    @property
    def topics(self) -> Collection[str]:
        """Topics of `OUT` that can be published."""

    def publish(self, topic: str, message: Any) -> None:
        """Publish on one of `topics`."""

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the feedback to the clients of the active goals."""

    def serve(self, service: ProcessService) -> None:
        """Offer the command of a process, where the wire has services; `Commands.respond` executes it."""


class Commands:
    """Executes incoming messages on an event loop in a separate thread, called by a wire's threads.

    Args:
        options: name of this commander, and options of the commands.
        connect: connects to the platform; None: to the one of this process' environment.
    """

    def __init__(
        self,
        options: Ros2Options,
        connect: Connect | None = None,
    ) -> None:
        self.loop = asyncio.new_event_loop()
        threading.Thread(target=self.loop.run_forever, daemon=True).start()

        async def commander() -> Commander:
            to_platform = connect or connects(options.name, options.group)
            return Commander(to_platform, options.commands, _LOG.error)

        self.commander = self.submit(commander()).result()
        self._inbox = Inbox(self.loop, _LOG.error)

    def __enter__(self) -> Commands:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(concurrent.futures.TimeoutError, RtcpError):
            self.submit(self.commander.close()).result(_CLOSE_S)
        self.loop.call_soon_threadsafe(self.loop.stop)

    def note_stop(self) -> None:
        """See `Commander`; from any thread."""
        self.loop.call_soon_threadsafe(self.commander.note_stop)

    def submit(self, coroutine: Coroutine[Any, Any, Any]) -> concurrent.futures.Future[Any]:
        """Run it on the loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop)

    def receive(self, topic: str, message: Any, sender: str = "") -> None:
        """Execute a message on a topic of `IN` in the background; a refusal is logged. `sender`: its publisher."""
        if topic == "joint_command":
            command = self.commander.command_point(point_of(message), sender)
        elif topic == "joint_trajectory":
            command = self.commander.command_joints(trajectory_of(message))
        elif topic == "speed_override":
            command = self.commander.set_speed_override(float(message.data))
        elif topic == "gpio_controller/commands":
            command = self.commander.set_outputs(outputs_of(message))
        else:
            command = self.commander.begin_trajectory(trajectory_of(message))
        self._inbox.put(topic, command)

    async def respond(self, make: Make, service: str | ProcessService, request: Any) -> Any:
        """Execute a service of `SERVICES` or of a process, and return its response."""
        kind = kind_of(service) if isinstance(service, ProcessService) else SERVICES[service]
        commander = self.commander
        has_succeeded, text = True, ""
        try:
            if isinstance(service, ProcessService):
                text = await commander.command_process(service, getattr(request, "load_namespace", ""))
            elif service == "robot_enable":
                text = await commander.enable()
            elif service == "robot_disable":
                text = await commander.disable()
            elif service in ("stop_motion", "robot_stop"):
                text = await commander.stop()
            else:
                await commander.begin_trajectory(trajectory_of(request.trajectory))
        except Exception as error:  # without a response the client would wait for ever
            _LOG.error("%s: %s", service if isinstance(service, str) else service.name, error)
            has_succeeded, text = False, str(error)
        if kind in (TRIGGER, WITH_TEXT):
            return make(f"{kind}_Response", success=has_succeeded, message=text)
        # These responses have no field for the reason, and ROS 2 has no error reply: the reason is logged.
        code = make("industrial_msgs/msg/ServiceReturnCode", val=1 if has_succeeded else -1)
        return make(f"{kind}_Response", code=code)

    async def follow(self, goal: Any) -> tuple[FollowCode, str]:
        """Run a goal of the action; return its code and message. When cancelled, the arm brakes on its path."""
        tolerances = Tolerances(
            _tolerances(goal.path_tolerance), _tolerances(goal.goal_tolerance), seconds(goal.goal_time_tolerance)
        )
        try:
            code, text = await self.commander.follow(trajectory_of(goal.trajectory), tolerances, lambda: None)
        except Exception as error:  # the action has no code for it; a goal always ends with a result
            code, text = FollowCode.INVALID_GOAL, str(error)
        if code is not FollowCode.SUCCESSFUL:
            _LOG.error("%s: %s", ACTION, text)
        return code, text


class Publications:
    """Publishes the samples of the core (`rtcp.ros.state.Sink`).

    Args:
        wire: transports the messages.
        name: name of the node.
        note_stop: called with each status in error.
    """

    def __init__(self, wire: Wire, name: str, note_stop: Callable[[], None]) -> None:
        self._wire, self._make = wire, wire.make
        self._name, self._note_stop = name, note_stop
        self._served: set[ProcessService] = set()
        self._models: Sequence[ArmModel] = ()

    def connected(self, config: ArmConfig) -> None:
        """Publish robot_description, where the geometry is known."""
        _LOG.info("connected to %s", config.name)
        self._models = config.models
        if config.arm is not None:
            self.describe(to_urdf(config.arm, [joint.torque for joint in config.joints]))

    def describe(self, urdf: str) -> None:
        """Publish robot_description."""
        self._publish("robot_description", data=urdf)

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        """Publish joint_states, tf, feedback_states, and the feedback of goals."""
        make, header = self._make, self._header(sample.stamp_ns)
        self._publish(
            "joint_states",
            header=header,
            name=list(names),
            position=sample.position,
            velocity=sample.velocity,
            effort=sample.effort,
        )
        if self._models:
            self._publish("tf", transforms=self._transforms(self._models[sample.tool], sample))
        if "feedback_states" not in self._wire.topics:
            return
        error = [want - have for want, have in zip(sample.commanded, sample.position, strict=True)]
        feedback = make(
            _FEEDBACK,
            header=header,
            joint_names=list(names),
            desired=make(_POINT, positions=sample.commanded),
            actual=make(_POINT, positions=sample.position, velocities=sample.velocity),
            error=make(_POINT, positions=error),
        )
        self._wire.publish("feedback_states", feedback)
        self._wire.publish_feedback(feedback)

    def status(self, status: RobotStatus) -> None:
        """Publish robot_status, and speed_override_state where it is known."""
        if status.in_error is TriState.TRUE:
            self._note_stop()
        if status.speed_override > 0.0:
            self._publish("speed_override_state", data=status.speed_override)
        if "robot_status" not in self._wire.topics:
            return
        make = self._make
        fields = {
            name: make("industrial_msgs/msg/TriState", val=int(getattr(status, name)))
            for name in ("e_stopped", "drives_powered", "motion_possible", "in_motion", "in_error")
        }
        self._publish(
            "robot_status",
            header=self._header(status.stamp_ns),
            mode=make("industrial_msgs/msg/RobotMode", val=int(status.mode)),
            error_codes=[status.error_code] if status.error_code else [],
            **fields,
        )

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        """Publish diagnostics."""
        entry = self._entry(f"{self._name}: robot", diagnostics)
        self._publish("diagnostics", header=self._header(diagnostics.stamp_ns), status=[entry])

    def processes(self, entries: Mapping[str, Diagnostics]) -> None:
        """Publish processes."""
        stamp_ns = max(entry.stamp_ns for entry in entries.values())
        status = [self._entry(name, entry) for name, entry in entries.items()]
        self._publish("processes", header=self._header(stamp_ns), status=status)

    def serve(self, services: Sequence[ProcessService]) -> None:
        """Offer the commands of processes."""
        for service in services:
            if service not in self._served:
                self._served.add(service)
                self._wire.serve(service)

    def _entry(self, name: str, diagnostics: Diagnostics) -> Any:
        make = self._make
        return make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=diagnostics.level,
            name=name,
            message=diagnostics.message,
            values=[make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in diagnostics.values],
        )

    def channels(self, sample: ChannelSample) -> None:
        """Publish gpio_states."""
        if "gpio_controller/gpio_states" not in self._wire.topics:
            return
        values = [
            self._make("control_msgs/msg/InterfaceValue", interface_names=list(group), values=list(group.values()))
            for group in sample.values.values()
        ]
        self._publish(
            "gpio_controller/gpio_states",
            header=self._header(sample.stamp_ns),
            interface_groups=list(sample.values),
            interface_values=values,
        )

    def _publish(self, topic: str, **fields: Any) -> None:
        self._wire.publish(topic, self._make(OUT[topic], **fields))

    def _header(self, stamp_ns: int, frame: str = "") -> Any:
        return self._make("std_msgs/msg/Header", stamp=time_of(self._make, stamp_ns), frame_id=frame)

    def _transforms(self, arm: ArmModel, sample: JointSample) -> list[Any]:
        """Return the transforms of the URDF's links, each in its parent's frame, as robot_state_publisher does."""
        make = self._make
        poses = (IDENTITY, *frames(arm, sample.position))
        links = ["base_link", *(f"link{number}" for number in range(1, len(poses) - 1)), "tool0"]
        transforms = []
        for at, child in enumerate(links[1:]):
            pose = poses[at].inverse() @ poses[at + 1]
            x, y, z = pose.position
            qw, qx, qy, qz = quaternion(pose.rotation)
            transform = make(
                "geometry_msgs/msg/Transform",
                translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
            )
            header = self._header(sample.stamp_ns, links[at])
            transforms.append(
                make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform)
            )
        return transforms


OpenWire = Callable[[Ros2Options, Commands, threading.Event], contextlib.AbstractContextManager[Wire]]
"""Opens a wire; returns early, with any wire, where the event is set."""


def run(options: Ros2Options, open_wire: OpenWire) -> None:
    """Run the node until SIGINT, SIGTERM or SIGHUP. From the main thread only."""
    ends = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: ends.set())
    with Commands(options) as commands, open_wire(options, commands, ends) as wire:
        publications = Publications(wire, options.name, commands.note_stop)
        publisher: StatePublisher | GroupStates
        if options.group:
            publisher = GroupStates(publications, options.name, options.rate_hz, publications.describe)
        else:
            publisher = StatePublisher(publications, rate_hz=options.rate_hz, name=options.name)
        while not ends.is_set():
            publisher.step(_STEP_S)
        publisher.close()


def kind_of(service: ProcessService) -> str:
    """Return the type of a process' service."""
    return WITH_TEXT if service.has_fields else TRIGGER


def time_of(make: Make, stamp_ns: int) -> Any:
    """Return a builtin_interfaces/Time."""
    seconds_, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return make("builtin_interfaces/msg/Time", sec=seconds_, nanosec=nanoseconds)


def seconds(time: Any) -> float:
    """Return a Time or Duration in s."""
    return float(time.sec) + 1e-9 * float(time.nanosec)


def trajectory_of(message: Any) -> Trajectory:
    """Convert a trajectory_msgs/JointTrajectory."""
    points = [point_of(point) for point in message.points]
    return Trajectory(list(message.joint_names), points, seconds(message.header.stamp))


def outputs_of(message: Any) -> Iterator[tuple[str, str, float]]:
    """Yield slave, name and value of each output of a control_msgs/DynamicInterfaceGroupValues.

    Raises:
        RtcpError: the lists of names and values differ in length.
    """
    try:
        for slave, group in zip(message.interface_groups, message.interface_values, strict=True):
            for name, value in zip(group.interface_names, group.values, strict=True):
                yield slave, name, value
    except ValueError:
        raise refusal("wrong_count", "found lists of different lengths, allowed is a value for each name") from None


def point_of(message: Any) -> TrajectoryPoint:
    """Convert a trajectory_msgs/JointTrajectoryPoint."""
    return TrajectoryPoint(
        seconds(message.time_from_start),
        _numbers(message.positions),
        _numbers(message.velocities),
        _numbers(message.accelerations),
    )


def _numbers(values: Iterable[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _tolerances(messages: Iterable[Any]) -> tuple[Tolerance, ...]:
    return tuple(Tolerance(entry.name, entry.position, entry.velocity, entry.acceleration) for entry in messages)
