"""A client on rospy that carries out commands: lines of JSON, [kind, arguments], each answered by a line.

`path` and `point` publish once, `stream` publishes points of a sine at `rate_hz` on `topic`; `service`, `stop_motion`,
`robot_enable`, `robot_disable` call; `follow` sends a goal of the action, and with `cancels` cancels it once the arm
has moved.
"""

from __future__ import annotations

import json
import math
import sys
import time
from typing import Any

from rtcp.ros import ros1_messages

ros1_messages.make_importable()

import actionlib  # noqa: E402
import rospy  # noqa: E402
from control_msgs.msg import FollowJointTrajectoryAction, FollowJointTrajectoryGoal, JointTolerance  # noqa: E402
from industrial_msgs.srv import CmdJointTrajectory, StopMotion  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402

_publishers: dict[str, Any] = {}


def point_of(given: dict[str, Any]) -> Any:
    return JointTrajectoryPoint(positions=given["q"], time_from_start=rospy.Duration(given["t"]))


def trajectory_of(given: dict[str, Any]) -> Any:
    points = [point_of(point) for point in given["points"]]
    return JointTrajectory(joint_names=given["names"], points=points * given.get("times", 1))


def publisher(topic: str, kind: Any) -> Any:
    """Return a publisher that the node has connected to."""
    if topic not in _publishers:
        _publishers[topic] = rospy.Publisher(topic, kind, queue_size=100, tcp_nodelay=True)
    while _publishers[topic].get_num_connections() == 0:
        time.sleep(0.05)
    return _publishers[topic]


def stream(given: dict[str, Any]) -> dict[str, Any]:
    """Publish `count` points of (1 - cos) with its velocity; only the first joint moves."""
    topic, rate_hz = given["topic"], given["rate_hz"]
    is_point = topic != "joint_trajectory"
    sends = publisher(topic, JointTrajectoryPoint if is_point else JointTrajectory)
    w = 2 * math.pi / given["period_s"]
    rest, begin = [0.0] * 5, time.monotonic()
    for number in range(1, given["count"] + 1):
        t = number / rate_hz
        time.sleep(max(0.0, begin + t - time.monotonic()))
        point = JointTrajectoryPoint(positions=[given["radius"] * (1 - math.cos(w * t)), *rest])
        if given["velocities"]:
            point.velocities = [given["radius"] * w * math.sin(w * t), *rest]
        point.time_from_start = rospy.Duration(t)
        message = point
        if not is_point:
            point.time_from_start = rospy.Duration(1 / rate_hz)  # as MoveIt Servo has it
            message = JointTrajectory(joint_names=given["names"], points=[point])
            message.header.stamp = rospy.Time.now()
        sends.publish(message)
    return {"last": list(point.positions)}


def call(name: str, kind: Any, *arguments: Any) -> dict[str, Any]:
    rospy.wait_for_service(name)
    try:
        answer = rospy.ServiceProxy(name, kind)(*arguments)
    except rospy.ServiceException as error:
        return {"error": str(error)}
    if kind is Trigger:
        return {"success": answer.success, "message": answer.message}
    return {"code": answer.code.val}


def follow(given: dict[str, Any]) -> dict[str, Any]:
    client = actionlib.SimpleActionClient("joint_trajectory_action", FollowJointTrajectoryAction)
    client.wait_for_server()
    goal = FollowJointTrajectoryGoal(trajectory=trajectory_of(given))
    goal.path_tolerance = [JointTolerance(**tolerance) for tolerance in given.get("path_tolerance", ())]
    goal.goal_tolerance = [JointTolerance(**tolerance) for tolerance in given.get("goal_tolerance", ())]
    heard: list[float] = []

    def on_feedback(feedback: Any) -> None:
        heard.append(feedback.actual.positions[0])

    client.send_goal(goal, feedback_cb=on_feedback)
    if given.get("cancels"):
        while not heard or abs(heard[-1] - heard[0]) < 0.01:
            time.sleep(0.02)
        client.cancel_goal()
    client.wait_for_result()
    result = client.get_result()
    return {"state": client.get_state(), "code": result.error_code, "text": result.error_string}


def carry_out(kind: str, given: dict[str, Any]) -> dict[str, Any]:
    if kind == "path":
        publisher(given.get("topic", "joint_path_command"), JointTrajectory).publish(trajectory_of(given))
    elif kind == "point":
        publisher("joint_command", JointTrajectoryPoint).publish(point_of(given))
    elif kind == "stream":
        return stream(given)
    elif kind == "service":
        return call("joint_path_command", CmdJointTrajectory, trajectory_of(given))
    elif kind == "stop_motion":
        return call(kind, StopMotion)
    elif kind == "follow":
        return follow(given)
    else:
        return call(kind, Trigger)
    return {}


def main() -> None:
    rospy.init_node("client", anonymous=True)
    for line in sys.stdin:
        print("answer", json.dumps(carry_out(*json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
