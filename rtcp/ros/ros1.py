"""ROS 1: the node on rospy, a thin layer over `rtcp.ros.state` and `rtcp.ros.commands`.

The only file that imports ROS; call `ros1_messages.make_importable` before its import.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import http.client
import os
import re
import signal
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Collection, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import actionlib
import rosgraph
import rospy
from control_msgs.msg import FollowJointTrajectoryAction, FollowJointTrajectoryFeedback, FollowJointTrajectoryResult
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from diagnostic_msgs.srv import AddDiagnostics, AddDiagnosticsResponse
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from industrial_msgs.msg import RobotStatus as RobotStatusMessage
from industrial_msgs.srv import CmdJointTrajectory, CmdJointTrajectoryResponse, StopMotion, StopMotionResponse
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger, TriggerResponse
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from kinematics.model import ArmModel
from kinematics.urdf import to_urdf
from rtcp.api import Replaced, RtcpError
from rtcp.config.model import ArmConfig
from rtcp.fieldbus.simple_message.messages import TriState
from rtcp.ros.commands import (
    CANCELLED,
    Commander,
    CommandOptions,
    FollowCode,
    Inbox,
    Tolerance,
    Tolerances,
    Trajectory,
    TrajectoryPoint,
)
from rtcp.ros.group import GroupStates, connects
from rtcp.ros.processes import ProcessService
from rtcp.ros.state import ChannelSample, Diagnostics, JointSample, RobotStatus, StatePublisher, transforms_of

T = TypeVar("T")

_STEP_S = 0.005
_MASTER_S = 1.0
"""Interval between two checks of the master, s."""
_MASTER_TIMEOUT_S = 2.0
_SUCCESS, _FAILURE = 1, -1
"""Values of industrial_msgs/ServiceReturnCode."""
_CLOSE_S = 2.0
"""Longest wait for the end of the connection; the end of the process ends it too."""
_END_S = 5.0
"""Longest wait from the signal to the end of the process, s."""


@dataclass(frozen=True)
class NodeOptions:
    """Options of `rtcp ros`."""

    name: str = "rtcp"
    rate_hz: float = 100.0
    """Rate of joint_states, feedback_states and /tf, Hz."""
    has_link_frames: bool = False
    """Whether /tf includes the frames of the links, where no robot_state_publisher runs."""
    arguments: Sequence[str] = ()
    """Remappings and private parameters as roslaunch passes them: `joint_states:=/left/joint_states`."""
    commands: CommandOptions = field(default_factory=CommandOptions)
    group: bool = False
    """Whether all arms of the cell are one group of joints."""


def run(options: NodeOptions) -> None:
    """Run the node until SIGINT, SIGTERM or SIGHUP; wait for the master and the platform. From the main thread only."""
    # A flag instead of an exception, which bare `except` clauses of rospy would swallow.
    ends = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: ends.set())
    threading.Thread(target=_end_late, args=(ends,), daemon=True).start()
    master = Master()
    while not (identity := master.identity()):
        if ends.wait(_MASTER_S):
            return
    # Without disable_signals rospy would install handlers of SIGINT and SIGTERM. Without disable_rostime the timers of
    # actionlib would wait for /clock where use_sim_time is set, and its finished goals would never be forgotten. All
    # stamps here are the host's.
    rospy.init_node(options.name, argv=[options.name, *options.arguments], disable_signals=True, disable_rostime=True)
    watch = threading.Thread(target=master.wait_for_another, args=(identity,), daemon=True)
    watch.start()
    commands = Commands(options.commands, options.group)
    publications = Publications(commands, options.has_link_frames)
    publisher: StatePublisher | GroupStates
    if options.group:
        publisher = GroupStates(publications, rospy.get_name(), options.rate_hz, publications.describe)
    else:
        publisher = StatePublisher(publications, rate_hz=options.rate_hz, name=rospy.get_name())
    # Change to another master only at rest: the end of the connection would stop a motion.
    while not ends.is_set() and (watch.is_alive() or commands.commander.is_moving):
        publisher.step(_STEP_S)
    publisher.close()
    commands.close()
    if not ends.is_set():
        # rospy registers its topics only with the master of its start: for another one the process restarts.
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    rospy.signal_shutdown("the node ends")


def _end_late(ends: threading.Event) -> None:
    """End the process some time after the signal: without a master a registration never returns, and rospy's own end
    waits for its lock.
    """
    ends.wait()
    time.sleep(_END_S)
    print(f"ended {_END_S:g} s after the signal, without the ROS master's answer", file=sys.stderr, flush=True)
    os._exit(0)


class Master:
    """The ROS master; detects its replacement by another one."""

    def __init__(self) -> None:
        self._server: Any = xmlrpc.client.ServerProxy(rosgraph.get_master_uri(), transport=_Transport())

    def identity(self) -> tuple[Any, ...]:
        """Return process id and run_id of the master; empty: no answer."""
        try:
            _, _, pid = self._server.getPid("/rtcp")
            code, _, run_id = self._server.getParam("/rtcp", "/run_id")
        except (OSError, http.client.HTTPException, xmlrpc.client.Error):
            return ()
        return pid, run_id if code == 1 else ""

    def wait_for_another(self, identity: tuple[Any, ...]) -> None:
        """Return when another master than this one answers."""
        while self.identity() in ((), identity):
            time.sleep(_MASTER_S)


class _Transport(xmlrpc.client.Transport):
    """HTTP with a timeout: without it an unreachable master would block the caller for minutes."""

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _MASTER_TIMEOUT_S
        return connection


class Publications:
    """Publishes the samples of the core (`rtcp.ros.state.Sink`)."""

    def __init__(self, commands: Commands, has_link_frames: bool) -> None:
        self._commands, self._has_link_frames = commands, has_link_frames
        self._models: Sequence[ArmModel] = ()
        # Each with a queue, so that a slow subscriber does not block the node.
        self._joint_states = rospy.Publisher("joint_states", JointState, queue_size=100, tcp_nodelay=True)
        self._feedback = rospy.Publisher(
            "feedback_states", FollowJointTrajectoryFeedback, queue_size=100, tcp_nodelay=True
        )
        self._status = rospy.Publisher("robot_status", RobotStatusMessage, queue_size=10, tcp_nodelay=True)
        self._speed_override = rospy.Publisher("speed_override_state", Float64, queue_size=10)
        self._diagnostics = rospy.Publisher("/diagnostics", DiagnosticArray, queue_size=10)
        self._tf = rospy.Publisher("/tf", TFMessage, queue_size=100, tcp_nodelay=True)
        self._channels: dict[tuple[str, str], rospy.Publisher | None] = {}
        """None: not yet registered."""
        self._processes: rospy.Publisher | None = None

    def connected(self, config: ArmConfig) -> None:
        """Set robot_description, where the geometry is known and it is not yet set."""
        rospy.loginfo("connected to %s", config.name)
        self._models = config.models
        if config.arm is not None:
            self.describe(to_urdf(config.arm, [joint.torque for joint in config.joints]))

    def describe(self, urdf: str) -> None:
        """Set robot_description, where it is not yet set."""
        try:
            if not rospy.has_param("robot_description"):
                rospy.set_param("robot_description", urdf)
        except (OSError, rospy.ROSException) as error:  # the master is gone; another one restarts the process
            rospy.logwarn("robot_description was not set: %s", error)

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        """Publish joint_states, feedback_states, and the frames where the geometry is known."""
        states = JointState(name=names, position=sample.position, velocity=sample.velocity, effort=sample.effort)
        feedback = FollowJointTrajectoryFeedback(
            joint_names=names,
            desired=JointTrajectoryPoint(positions=sample.commanded),
            actual=JointTrajectoryPoint(positions=sample.position, velocities=sample.velocity),
            error=JointTrajectoryPoint(
                positions=[want - have for want, have in zip(sample.commanded, sample.position, strict=True)]
            ),
        )
        states.header.stamp = feedback.header.stamp = _time(sample.stamp_ns)
        self._joint_states.publish(states)
        self._feedback.publish(feedback)
        self._commands.publish_feedback(feedback)
        if not self._models:
            return
        message, model = TFMessage(), self._models[sample.tool]
        for name, (position, (w, x, y, z)) in transforms_of(model, sample.position, self._has_link_frames).items():
            transform = TransformStamped(child_frame_id=name)
            transform.header.stamp, transform.header.frame_id = states.header.stamp, "base_link"
            transform.transform.translation, transform.transform.rotation = Vector3(*position), Quaternion(x, y, z, w)
            message.transforms.append(transform)
        self._tf.publish(message)

    def status(self, status: RobotStatus) -> None:
        """Publish robot_status."""
        if status.in_error is TriState.TRUE:
            self._commands.note_stop()
        message = RobotStatusMessage(error_code=status.error_code)
        message.header.stamp = _time(status.stamp_ns)
        for name in ("mode", "e_stopped", "drives_powered", "motion_possible", "in_motion", "in_error"):
            getattr(message, name).val = getattr(status, name)
        self._status.publish(message)
        if status.speed_override > 0.0:
            self._speed_override.publish(status.speed_override)

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        """Publish diagnostics."""
        entry = _entry(f"{rospy.get_name().lstrip('/')}: robot", diagnostics)
        message = DiagnosticArray(status=[entry])
        message.header.stamp = _time(diagnostics.stamp_ns)
        self._diagnostics.publish(message)

    def processes(self, entries: Mapping[str, Diagnostics]) -> None:
        """Publish processes."""
        if self._processes is not None:
            message = DiagnosticArray(status=[_entry(*item) for item in entries.items()])
            message.header.stamp = _time(max(entry.stamp_ns for entry in entries.values()))
            self._processes.publish(message)

    def serve(self, services: Sequence[ProcessService]) -> None:
        """Offer the commands of processes."""
        threading.Thread(target=self._register_processes, args=(services,), daemon=True).start()

    def _register_processes(self, services: Sequence[ProcessService]) -> None:
        """Register the topic and the services of processes, as `_register`."""
        try:
            if self._processes is None:
                self._processes = rospy.Publisher("processes", DiagnosticArray, queue_size=10)
            self._commands.serve(services)
        except (rospy.ROSException, OSError) as error:
            rospy.logerr("processes are not served: %s", error)

    def channels(self, sample: ChannelSample) -> None:
        """Publish each channel on a separate topic, and subscribe to commands of settable ones."""
        values = {(slave, name): value for slave, named in sample.values.items() for name, value in named.items()}
        if new := [channel for channel in values if channel not in self._channels]:
            self._channels |= dict.fromkeys(new)
            # A registration waits for the master, without which the other topics go on.
            threading.Thread(target=self._register, args=(new, sample.settable), daemon=True).start()
        for channel, value in values.items():
            if publisher := self._channels[channel]:
                publisher.publish(value)

    def _register(self, channels: Sequence[tuple[str, str]], settable: Collection[tuple[str, str]]) -> None:
        """Register the topics of channels (slave, name)."""
        for slave, name in channels:
            topic = "/".join(("gpio", *(re.sub(r"\W", "_", part, flags=re.ASCII) for part in (slave, name))))
            try:
                self._channels[slave, name] = rospy.Publisher(topic, Float64, queue_size=10)
                if (slave, name) in settable:
                    self._commands.take_output(f"{topic}/command", slave, name)
            except (rospy.ROSException, OSError) as error:
                rospy.logerr("topic %s is not published: %s", topic, error)


class Commands:
    """Receives topics, services and the action; the core executes them on an event loop in a separate thread."""

    def __init__(self, options: CommandOptions, group: bool = False) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self.commander = self._wait(self._make(options, group))
        self._inbox = Inbox(self._loop, rospy.logerr)
        self._goals: dict[str, tuple[Any, asyncio.Task[None]]] = {}
        """Id of a goal of the action -> its handle and task."""
        self._services: set[str] = set()
        """Names of the services of processes."""
        for topic, kind, carry_out in (
            ("joint_path_command", JointTrajectory, lambda m: self.commander.begin_trajectory(_trajectory(m))),
            ("joint_command", JointTrajectoryPoint, lambda m: self.commander.command_point(_point(m), _publisher(m))),
            ("joint_trajectory", JointTrajectory, lambda m: self.commander.command_joints(_trajectory(m))),
            ("speed_override", Float64, lambda m: self.commander.set_speed_override(m.data)),
        ):
            rospy.Subscriber(topic, kind, self._begin, (topic, carry_out), queue_size=100, tcp_nodelay=True)
        rospy.Service("joint_path_command", CmdJointTrajectory, self._path)
        rospy.Service("stop_motion", StopMotion, self._stop)
        rospy.Service("robot_stop", Trigger, lambda request: self._trigger(self.commander.stop()))
        rospy.Service("robot_enable", Trigger, lambda request: self._trigger(self.commander.enable()))
        rospy.Service("robot_disable", Trigger, lambda request: self._trigger(self.commander.disable()))
        self._action = actionlib.ActionServer(
            "joint_trajectory_action", FollowJointTrajectoryAction, self._on_goal, self._on_cancel, auto_start=False
        )
        self._action.start()

    def close(self) -> None:
        """Close the connection to the platform: its motion comes to a controlled stop."""
        with contextlib.suppress(concurrent.futures.TimeoutError, RtcpError):
            asyncio.run_coroutine_threadsafe(self.commander.close(), self._loop).result(_CLOSE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)

    def note_stop(self) -> None:
        """See `Commander`; from any thread."""
        self._loop.call_soon_threadsafe(self.commander.note_stop)

    def take_output(self, topic: str, slave: str, name: str) -> None:
        """Subscribe to a topic whose messages set an output."""

        def carry_out(message: Any) -> Coroutine[Any, Any, None]:
            return self.commander.set_outputs([(slave, name, message.data)])

        rospy.Subscriber(topic, Float64, self._begin, (topic, carry_out), queue_size=100)

    def serve(self, services: Sequence[ProcessService]) -> None:
        """Offer the commands of processes, each once."""
        for service in services:
            if service.name not in self._services:
                self._services.add(service.name)
                self._serve(service)

    def _serve(self, service: ProcessService) -> None:
        kind, respond = (AddDiagnostics, AddDiagnosticsResponse) if service.has_fields else (Trigger, TriggerResponse)

        def carry_out(request: Any) -> Any:
            text = getattr(request, "load_namespace", "")
            return self._trigger(self.commander.command_process(service, text), respond)

        rospy.Service(service.name, kind, carry_out)

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the feedback to the clients of the active goals."""
        for handle, _ in list(self._goals.values()):
            handle.publish_feedback(feedback)

    @staticmethod
    async def _make(options: CommandOptions, group: bool) -> Commander:
        return Commander(connects(rospy.get_name(), group), options, rospy.logerr)

    def _wait(self, coroutine: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result()

    def _begin(self, message: Any, receiver: tuple[str, Callable[[Any], Coroutine[Any, Any, None]]]) -> None:
        """Execute a message in the background; a refusal is logged. `receiver`: topic and function."""
        topic, carry_out = receiver
        self._inbox.put(topic, carry_out(message))

    def _path(self, request: Any) -> Any:
        response = CmdJointTrajectoryResponse()
        response.code.val = self._served(self.commander.begin_trajectory(_trajectory(request.trajectory)))
        return response

    def _stop(self, request: Any) -> Any:
        response = StopMotionResponse()
        response.code.val = self._served(self.commander.stop())
        return response

    def _served(self, coroutine: Coroutine[Any, Any, object]) -> int:
        """Return a ServiceReturnCode; the response has no field for the reason of a FAILURE, which is logged."""
        try:
            self._wait(coroutine)
        except RtcpError as error:
            rospy.logerr("%s", error)
            return _FAILURE
        return _SUCCESS

    def _trigger(self, coroutine: Coroutine[Any, Any, str], respond: Callable[..., Any] = TriggerResponse) -> Any:
        try:
            return respond(True, self._wait(coroutine))
        except RtcpError as error:
            rospy.logerr("%s", error)
            return respond(False, str(error))

    # -- the action ---------------------------------------------------------------------------------------------------

    # actionlib holds its lock during callbacks, and its handles need it: callbacks must not wait for the loop.

    def _on_goal(self, handle: Any) -> None:
        number = handle.get_goal_id().id

        def begin() -> None:
            task = self._loop.create_task(self._follow(handle))
            self._goals[number] = handle, task
            task.add_done_callback(lambda task: self._goals.pop(number, None))

        self._loop.call_soon_threadsafe(begin)

    def _on_cancel(self, handle: Any) -> None:
        number = handle.get_goal_id().id

        def cancel() -> None:
            if number in self._goals:
                self._goals[number][1].cancel()

        self._loop.call_soon_threadsafe(cancel)

    async def _follow(self, handle: Any) -> None:
        goal, result = handle.get_goal(), FollowJointTrajectoryResult()
        tolerances = Tolerances(
            _tolerances(goal.path_tolerance), _tolerances(goal.goal_tolerance), goal.goal_time_tolerance.to_sec()
        )
        has_begun = False

        def accept() -> None:
            nonlocal has_begun
            has_begun = True
            handle.set_accepted()

        try:
            code, text = await self.commander.follow(_trajectory(goal.trajectory), tolerances, accept)
        except (asyncio.CancelledError, Replaced) as error:
            code, text = CANCELLED
            text = str(error) or text
            result.error_code, result.error_string = int(code), text
            handle.set_canceled(result, text)
            return
        except Exception as error:  # the action has no code for it; a goal always ends with a result
            code, text = FollowCode.INVALID_GOAL, str(error)
        result.error_code, result.error_string = int(code), text
        if code is FollowCode.SUCCESSFUL:
            if not has_begun:  # the arm is already at the goal
                handle.set_accepted()
            handle.set_succeeded(result, text)
        else:
            rospy.logerr("joint_trajectory_action: %s", text)
            (handle.set_aborted if has_begun else handle.set_rejected)(result, text)


def _trajectory(message: Any) -> Trajectory:
    return Trajectory(message.joint_names, [_point(point) for point in message.points], message.header.stamp.to_sec())


def _point(message: Any) -> TrajectoryPoint:
    return TrajectoryPoint(
        message.time_from_start.to_sec(), message.positions, message.velocities, message.accelerations
    )


def _publisher(message: Any) -> str:
    return str(message._connection_header["callerid"])


def _tolerances(messages: Any) -> tuple[Tolerance, ...]:
    return tuple(Tolerance(entry.name, entry.position, entry.velocity, entry.acceleration) for entry in messages)


def _entry(name: str, diagnostics: Diagnostics) -> Any:
    values = [KeyValue(*pair) for pair in diagnostics.values]
    return DiagnosticStatus(level=diagnostics.level, name=name, message=diagnostics.message, values=values)


def _time(stamp_ns: int) -> Any:
    return rospy.Time(*divmod(stamp_ns, 1_000_000_000))
