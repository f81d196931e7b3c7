"""One command from a client on rospy: `client.py KIND JSON` prints what came of it as JSON.

`path` and `point` publish; `service`, `stop_motion`, `robot_enable`, `robot_disable` call; `follow` sends a goal of the
action, and with `cancel_s` cancels it after so many seconds.
"""

from __future__ import annotations

import json
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
    return JointTrajectory(joint_names=given["names"], points=[point_of(point) for point in given["points"]])


def publish(topic: str, message: Any) -> None:
    publisher = rospy.Publisher(topic, type(message), queue_size=1)
    while publisher.get_num_connections() == 0:
        time.sleep(0.05)
    publisher.publish(message)
    time.sleep(0.5)  # rospy sends from a thread


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
    goal.path_tolerance = [JointTolerance(**one) for one in given.get("path_tolerance", ())]
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
        publish("joint_path_command", trajectory_of(given))
    elif kind == "point":
        publish("joint_command", point_of(given))
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
