"""Writes down what the node publishes, one JSON line a message: `listener.py FILE`. A client as any other, on rospy."""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any

from rtcp.ros import ros1_messages

ros1_messages.make_importable()

import rospy  # noqa: E402
from control_msgs.msg import FollowJointTrajectoryFeedback  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from industrial_msgs.msg import RobotStatus  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402


def main() -> None:
    rospy.init_node("listener", anonymous=True)
    lock = threading.Lock()
    with open(sys.argv[1], "w") as file:

        def write(topic: str, message: Any, **values: Any) -> None:
            stamp_ns = message.header.stamp.to_nsec()
            # The reading with the least delay: this process can lose the CPU between the two clocks.
            readings = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(5)]
            before, wall, after = min(readings, key=lambda reading: reading[2] - reading[0])
            ahead_ns = wall - (before + after) // 2
            line = {"topic": topic, "stamp_ns": stamp_ns, "ahead_ns": ahead_ns, "monotonic_ns": stamp_ns - ahead_ns}
            with lock:
                file.write(json.dumps({**line, **values}) + "\n")
                file.flush()

        def on_joints(message: Any) -> None:
            write("joint_states", message, name=message.name, position=message.position, velocity=message.velocity,
                  effort=message.effort)  # fmt: skip

        def on_feedback(message: Any) -> None:
            write("feedback_states", message, desired=message.desired.positions, actual=message.actual.positions,
                  error=message.error.positions, accelerations=message.actual.accelerations)  # fmt: skip

        def on_status(message: Any) -> None:
            names = ("mode", "e_stopped", "drives_powered", "motion_possible", "in_motion", "in_error")
            values = {name: getattr(message, name).val for name in names}
            write("robot_status", message, error_code=message.error_code, **values)

        def on_diagnostics(message: Any) -> None:
            (entry,) = message.status
            values = {pair.key: pair.value for pair in entry.values}
            write("diagnostics", message, level=entry.level, text=entry.message, values=values)

        def on_tf(message: Any) -> None:
            for stamped in message.transforms:
                at, q = stamped.transform.translation, stamped.transform.rotation
                write("/tf", stamped, parent=stamped.header.frame_id, child=stamped.child_frame_id,
                      at=[at.x, at.y, at.z], turn=[q.w, q.x, q.y, q.z])  # fmt: skip

        for topic, kind, callback in (
            ("/tf", TFMessage, on_tf),
            ("joint_states", JointState, on_joints),
            ("feedback_states", FollowJointTrajectoryFeedback, on_feedback),
            ("robot_status", RobotStatus, on_status),
            ("/diagnostics", DiagnosticArray, on_diagnostics),
        ):
            rospy.Subscriber(topic, kind, callback, tcp_nodelay=True)
        rospy.spin()


if __name__ == "__main__":
    main()
