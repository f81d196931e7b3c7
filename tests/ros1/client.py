"""One command from a client on rospy: `client.py KIND JSON` prints the result as JSON.

`path` and `point` publish once, `stream` publishes points of a sine at `rate_hz` on `topic`; `service`, `stop_motion`,
`robot_enable`, `robot_disable` call; `follow` sends a goal of the action, and with `cancel_s` cancels it after so many
seconds.
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


def point_of(given: dict[str, Any]) -> Any:
    return JointTrajectoryPoint(positions=given["q"], time_from_start=rospy.Duration(given["t"]))


def trajectory_of(given: dict[str, Any]) -> Any:
    points = [point_of(point) for point in given["points"]]
    return JointTrajectory(joint_names=given["names"], points=points * given.get("times", 1))


def publish(topic: str, message: Any) -> None:
    publisher = rospy.Publisher(topic, type(message), queue_size=1)
    while publisher.get_num_connections() == 0:
        time.sleep(0.05)
    publisher.publish(message)
    time.sleep(0.5)  # rospy sends from a thread


def stream(given: dict[str, Any]) -> dict[str, Any]:
    """Publish `count` points of (1 - cos) with its velocity; only the first joint moves."""
    topic, rate_hz = given["topic"], given["rate_hz"]
    is_point = topic != "joint_trajectory"
    kind = JointTrajectoryPoint if is_point else JointTrajectory
    publisher = rospy.Publisher(topic, kind, queue_size=100, tcp_nodelay=True)
    while publisher.get_num_connections() == 0:
        time.sleep(0.05)
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
        publisher.publish(message)
    time.sleep(0.5)
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
    client.send_goal(goal)
    if "cancel_s" in given:
        while client.get_state() == actionlib.GoalStatus.PENDING:
            time.sleep(0.02)
        time.sleep(given["cancel_s"])
        client.cancel_goal()
    client.wait_for_result()
    result = client.get_result()
    return {"state": client.get_state(), "code": result.error_code, "text": result.error_string}


def main() -> None:
    kind, given = sys.argv[1], json.loads(sys.argv[2])
    rospy.init_node("client", anonymous=True)
    answer: dict[str, Any] = {}
    if kind == "path":
        publish(given.get("topic", "joint_path_command"), trajectory_of(given))
    elif kind == "point":
        publish("joint_command", point_of(given))
    elif kind == "stream":
        answer = stream(given)
    elif kind == "service":
        answer = call("joint_path_command", CmdJointTrajectory, trajectory_of(given))
    elif kind == "stop_motion":
        answer = call(kind, StopMotion)
    elif kind == "follow":
        answer = follow(given)
    else:
        answer = call(kind, Trigger)
    print("answer", json.dumps(answer))


if __name__ == "__main__":
    main()
