"""Latency of commands of a ROS 1 client, on the running platform: until their frame is sent, and until the arm moves.

Each runs a master, a node and, by itself again, a client: processes as a user's. The arm is enabled, at rest, and
nobody commands it.

- `python -m rtcp.ros.ros1_latency probe COUNT` prints JSON: s from the call of rospy to the frame, for `topic`
  joint_command and `service` joint_path_command. The arm stays where it is.
- `python -m rtcp.ros.ros1_latency sine FOLDER RATE_HZ AMPLITUDE_RAD PERIOD_S PERIODS` publishes a sine of the first
  joint as joint_command. A program beside it logs the topics into the files of `LOGGED`. It prints their time 0 on
  CLOCK_MONOTONIC, s.
- `python -m rtcp.ros.ros1_latency log FOLDER` is this program: it logs until its standard input ends. It needs a
  running master, and works beside any publisher of joint_command.
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from math import cos, tau
from pathlib import Path
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
LOGGED = ("joint_command", "joint_states")
"""Topics of the log, each in a file TOPIC.csv: time since the first message of any of them, s, then the positions, rad,
under the names of the joints."""


def _measure(arguments: Sequence[str]) -> str:
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
        client = [sys.executable, "-m", "rtcp.ros.ros1_latency", "client", *arguments]
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
                passed_ns = int(records["time_ns"][begun[0] + 1]) - sent_ns
                if passed_ns > 0:  # else the command before came only now
                    seconds.append(1e-9 * passed_ns)
        return seconds

    def moves(records: Any) -> Any:
        return records["commanded_position"][:, 0] != records["commanded_position"][0, 0]

    publisher.publish(points_at_rest[0])  # opens the stream
    time.sleep(0.5)
    by_kind = {"topic": latencies("topic", lambda: publisher.publish(next(points)), moves)}
    time.sleep(_PAUSE_S)
    by_kind["service"] = latencies("service", lambda: call(path), lambda records: records["state"] == State.MOVING)
    return by_kind


def _sine(folder: str, rate_hz: float, amplitude: float, period_s: float, periods: int) -> float:
    """Publish the sine while another process logs it; return time 0 of the log, CLOCK_MONOTONIC, s."""
    ros1_messages.make_importable()
    import rospy
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectoryPoint

    rospy.init_node("sine", anonymous=True)
    publisher = rospy.Publisher("joint_command", JointTrajectoryPoint, queue_size=10, tcp_nodelay=True)
    base = list(rospy.wait_for_message("joint_states", JointState).position)
    command = [sys.executable, "-m", "rtcp.ros.ros1_latency", "log", folder]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as log:
        assert log.stdin is not None
        assert log.stdout is not None
        while publisher.get_num_connections() < len(("the node", "the log")):
            if log.poll() is not None:
                raise SystemExit("the log has ended")
            time.sleep(0.05)
        begun, number = time.monotonic(), 0
        while (now := time.monotonic() - begun) < periods * period_s:
            q = base[0] + amplitude * (1.0 - cos(tau * now / period_s))
            publisher.publish(JointTrajectoryPoint(positions=[q, *base[1:]]))
            # A missed tick is skipped: commands are never sent in a burst.
            number = max(number + 1, int((time.monotonic() - begun) * rate_hz))
            time.sleep(max(0.0, begun + number / rate_hz - time.monotonic()))
        publisher.publish(JointTrajectoryPoint(positions=base))
        time.sleep(_PAUSE_S)
        log.stdin.close()
        return float(log.stdout.read())


def _log(folder: str) -> float:
    """Log until standard input ends; return time 0 of the files, CLOCK_MONOTONIC, s."""
    ros1_messages.make_importable()
    import rospy
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectoryPoint

    rows: dict[str, list[tuple[float, Sequence[float]]]] = {topic: [] for topic in LOGGED}
    names: list[str] = []

    def note(message: Any, topic: str) -> None:
        if topic == "joint_command":
            rows[topic].append((time.monotonic(), message.positions))
        else:
            names[:] = message.name
            rows[topic].append((time.monotonic(), message.position))

    rospy.init_node("latency_log", anonymous=True)
    for topic, kind in zip(LOGGED, (JointTrajectoryPoint, JointState), strict=True):
        rospy.Subscriber(topic, kind, note, topic, queue_size=1000, tcp_nodelay=True)
    sys.stdin.read()
    began = min((some[0][0] for some in rows.values() if some), default=0.0)
    for topic, some in rows.items():
        with (Path(folder) / f"{topic}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["time_s", *names])
            writer.writerows([f"{at - began:.6f}", *(f"{q:.9g}" for q in positions)] for at, positions in list(some))
    return began


def _client(kind: str, *arguments: str) -> Any:
    if kind == "probe":
        return _probe(int(arguments[0]))
    folder, rate_hz, amplitude, period_s, periods = arguments
    return _sine(folder, float(rate_hz), float(amplitude), float(period_s), int(periods))


if __name__ == "__main__":
    what, *others = sys.argv[1:]
    if what == "client":
        print(json.dumps(_client(*others)))
    elif what == "log":
        print(_log(*others))
    else:
        print(_measure([what, *others]))
