"""Latency of commands of a ROS 1 client until their frame is sent, on the running platform.

`python -m rtcp.ros.ros1_latency PROBES` runs a master, a node and, by itself again, a client: processes as a user's. It
prints JSON: s from the call of rospy to the frame, for `topic` joint_command and `service` joint_path_command. The arm
is enabled, at rest, and nobody commands it; it stays where it is.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rtcp.api import Feed, State
from rtcp.ros import ros1_messages

_MASTER = "/usr/bin/rosmaster"
_INTERVAL_S = {"topic": 0.08, "service": 0.3}
"""Interval between two commands, s: the motion before has ended."""
_STEP_RAD, _MOVE_S = 1e-5, 0.1
_LONGEST_S = 180.0
_PAUSE_S = 2.0
"""Pause that ends a stream, s."""


def _measure(probes: str) -> str:
    """Return what the client prints; exit with one sentence where ROS 1 is missing or the client fails."""
    if problem := ros1_messages.missing():
        raise SystemExit(problem)
    if not os.path.exists(_MASTER):
        raise SystemExit(f"there is no ROS master ({_MASTER} is missing): apt install python3-rosmaster")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    environment = {**os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    with contextlib.ExitStack() as running:
        for command in ([_MASTER, "--core", "-p", port], [sys.executable, "-m", "rtcp.cli", "ros"]):
            begun = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            running.callback(begun.wait)
            running.callback(begun.terminate)
        client = [sys.executable, "-m", "rtcp.ros.ros1_latency", probes, "client"]
        try:
            process = subprocess.run(
                client, env=environment, capture_output=True, text=True, check=False, timeout=_LONGEST_S
            )
        except subprocess.TimeoutExpired:
            raise SystemExit(f"the ROS client has not ended within {_LONGEST_S:g} s") from None
    if process.returncode:
        raise SystemExit(f"the ROS client failed: {process.stderr.strip().rpartition(chr(10))[2]}")
    return process.stdout.strip().rpartition("\n")[2]


def _probe(count: int) -> dict[str, list[float]]:
    ros1_messages.make_importable()
    import rospy
    from industrial_msgs.srv import CmdJointTrajectory
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    rospy.init_node("latency", anonymous=True)
    publisher = rospy.Publisher("joint_command", JointTrajectoryPoint, queue_size=10, tcp_nodelay=True)
    rospy.wait_for_service("joint_path_command")
    call = rospy.ServiceProxy("joint_path_command", CmdJointTrajectory, persistent=True)
    names = rospy.wait_for_message("joint_states", JointState).name
    while publisher.get_num_connections() == 0:
        time.sleep(0.05)
    feed = Feed()
    feed.wait(_PAUSE_S)
    here = feed.records()[0]["commanded_position"][-1].tolist()
    points_at_rest = [JointTrajectoryPoint(positions=here, time_from_start=rospy.Duration(t)) for t in (0.0, _MOVE_S)]
    path = JointTrajectory(joint_names=names, points=points_at_rest)
    beside = [here[0] + _STEP_RAD, *here[1:]]
    points = itertools.cycle([JointTrajectoryPoint(positions=beside), points_at_rest[0]])

    def latencies(kind: str, send: Callable[[], object], has_begun: Callable[[Any], Any]) -> list[float]:
        seconds = []
        for _ in range(count):
            feed.records()
            sent_ns = time.monotonic_ns()
            send()
            time.sleep(_INTERVAL_S[kind])
            records, _ = feed.records()
            # A change: on a busy host the motion before can last until here.
            begun = np.flatnonzero(np.diff(has_begun(records).astype(int)) == 1) + 1
            # The outputs of a cycle leave at the beginning of the next one.
            if begun.size and begun[0] + 1 < len(records):
                seconds.append(1e-9 * float(records["time_ns"][begun[0] + 1] - sent_ns))
        return seconds

    def moves(records: Any) -> Any:
        return records["commanded_position"][:, 0] != records["commanded_position"][0, 0]

    publisher.publish(points_at_rest[0])  # opens the stream
    time.sleep(0.5)
    by_kind = {"topic": latencies("topic", lambda: publisher.publish(next(points)), moves)}
    time.sleep(_PAUSE_S)
    by_kind["service"] = latencies("service", lambda: call(path), lambda records: records["state"] == State.MOVING)
    return by_kind


if __name__ == "__main__":
    print(json.dumps(_probe(int(sys.argv[1]))) if sys.argv[2:] else _measure(sys.argv[1]))
