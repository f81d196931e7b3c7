"""ROS 1: the node on rospy, a thin skin on `rtcp.ros.state`. The only file that imports ROS; call
`ros1_messages.make_importable` first."""

from __future__ import annotations

import http.client
import os
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import rosgraph
import rospy
from control_msgs.msg import FollowJointTrajectoryFeedback
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from industrial_msgs.msg import RobotStatus as RobotStatusMessage
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectoryPoint

from kinematics.urdf import to_urdf
from rtcp.config.model import ArmConfig
from rtcp.ros.state import Diagnostics, JointSample, RobotStatus, StatePublisher

_TURN_S = 0.005
_MASTER_S = 1.0
"""Interval between two looks at the master, s."""
_MASTER_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class NodeOptions:
    """What `rtcp ros` was asked for."""

    name: str = "rtcp"
    rate_hz: float = 100.0
    """Of joint_states and feedback_states."""
    arguments: Sequence[str] = ()
    """Remappings and private parameters as roslaunch passes them: `joint_states:=/left/joint_states`."""


def run(options: NodeOptions) -> None:
    """Run the node until an exception, as Ctrl-C raises it, ends it; wait for the master and the platform."""
    master = Master()
    while not (identity := master.identity()):
        time.sleep(_MASTER_S)
    # Without disable_signals rospy would take SIGINT and SIGTERM for itself.
    rospy.init_node(options.name, argv=[options.name, *options.arguments], disable_signals=True)
    watch = threading.Thread(target=master.wait_for_another, args=(identity,), daemon=True)
    watch.start()
    publisher = StatePublisher(Publications(), rate_hz=options.rate_hz, name=rospy.get_name())
    try:
        while watch.is_alive():
            publisher.step(_TURN_S)
    finally:
        publisher.close()
        if watch.is_alive():
            rospy.signal_shutdown("the node ends")
    # rospy registers its topics once, with the master of its start: for another one the process begins anew.
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


class Master:
    """The ROS master, and whether it is still the same one."""

    def __init__(self) -> None:
        self._server: Any = xmlrpc.client.ServerProxy(rosgraph.get_master_uri(), transport=_Transport())

    def identity(self) -> tuple[Any, ...]:
        """Return process id and run_id of the master; nothing: none answers."""
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
    """HTTP that gives up: a master whose machine is gone would hold the caller for minutes."""

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _MASTER_TIMEOUT_S
        return connection


class Publications:
    """Publishes what the core says (`rtcp.ros.state.Sink`)."""

    def __init__(self) -> None:
        # A queue each: no subscriber that reads slowly holds the node.
        self._joint_states = rospy.Publisher("joint_states", JointState, queue_size=100, tcp_nodelay=True)
        self._feedback = rospy.Publisher(
            "feedback_states", FollowJointTrajectoryFeedback, queue_size=100, tcp_nodelay=True
        )
        self._status = rospy.Publisher("robot_status", RobotStatusMessage, queue_size=10, tcp_nodelay=True)
        self._diagnostics = rospy.Publisher("/diagnostics", DiagnosticArray, queue_size=10)

    def connected(self, config: ArmConfig) -> None:
        """Set robot_description, where the geometry is known and nobody has set it."""
        rospy.loginfo("connected to %s", config.name)
        try:
            if config.arm is not None and not rospy.has_param("robot_description"):
                rospy.set_param("robot_description", to_urdf(config.arm, [joint.torque for joint in config.joints]))
        except (OSError, rospy.ROSException) as error:  # the master is gone; another one starts the process anew
            rospy.logwarn("robot_description was not set: %s", error)

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        """Publish joint_states and feedback_states."""
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

    def status(self, status: RobotStatus) -> None:
        """Publish robot_status."""
        message = RobotStatusMessage(error_code=status.error_code)
        message.header.stamp = _time(status.stamp_ns)
        for name in ("mode", "e_stopped", "drives_powered", "motion_possible", "in_motion", "in_error"):
            getattr(message, name).val = getattr(status, name)
        self._status.publish(message)

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        """Publish diagnostics."""
        entry = DiagnosticStatus(
            level=diagnostics.level,
            name=f"{rospy.get_name().lstrip('/')}: robot",
            message=diagnostics.message,
            values=[KeyValue(*pair) for pair in diagnostics.values],
        )
        message = DiagnosticArray(status=[entry])
        message.header.stamp = _time(diagnostics.stamp_ns)
        self._diagnostics.publish(message)


def _time(stamp_ns: int) -> Any:
    return rospy.Time(*divmod(stamp_ns, 1_000_000_000))
