"""RAPID streaming of the controller's process, by plain sockets."""

from __future__ import annotations

import asyncio
import json
import math
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.fieldbus.simple_message.messages import JointPosition, JointTrajPt, Message, ReplyCode, SpecialSequence
from rtcp.ros.simple_message.client import MotionClient, StateClient

ROOT = Path(__file__).parents[3]
ZERO = "initial_position: [0, 0, 0, 0, 0, 0]"
STOP = struct.pack("<5i12f", 64, 11, 2, 0, -4, *[0.0] * 12)


class Irc5:
    """A running controller: its ports, and its operator."""

    def __init__(self, ready: dict[str, Any], operator: socket.socket) -> None:
        self.ready, self.operator = ready, operator

    def connect(self, server: str) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.ready[f"{server}_port"]), timeout=20.0)

    def ask(self, **request: Any) -> Any:
        self.operator.send(json.dumps(request).encode())
        answer = json.loads(self.operator.recv(1 << 16))
        assert answer["ok"], answer
        return answer["result"]


@contextmanager
def irc5(folder: Path, arms: int = 1, rapid: str = "") -> Iterator[Irc5]:
    config, control = folder / "irc5.yaml", folder / "irc5.sock"
    units = "".join(f"  - {{name: ROB_{i + 1}, port: {6511 + i}, {ZERO}}}\n" for i in range(arms))
    config.write_text(f"rapid: {{motion_port: 0, state_port: 0{rapid}}}\nunits:\n{units}", encoding="utf-8")
    command = [sys.executable, "-m", "rtcp.virtual.irc5", "--config", str(config), "--control", str(control)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        line = process.stdout.readline()
        assert line, process.communicate()[1]
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as operator:
            operator.settimeout(20.0)
            operator.connect(str(control))
            yield Irc5(json.loads(line), operator)
        process.send_signal(signal.SIGTERM)
        assert process.communicate()[1] == ""
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()


def point(sequence: int, degrees: list[float], duration: float = 0.05) -> bytes:
    """A JOINT_TRAJ_PT request."""
    joints = map(math.radians, degrees)
    return struct.pack(f"<5i{len(degrees) + 2}f", 24 + 4 * len(degrees), 11, 2, 0, sequence, *joints, 0.0, duration)


def read(connection: socket.socket) -> tuple[int, int, int, bytes]:
    """Return type, comm_type, reply_code and body of the next message."""
    length = struct.unpack("<i", exactly(connection, 4))[0]
    message = exactly(connection, length)
    msg_type, comm_type, code = struct.unpack_from("<3i", message)
    return msg_type, comm_type, code, message[12:]


def exactly(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise ConnectionError("closed")
        data += part
    return data


def read_on(connection: socket.socket) -> None:
    """Read until TimeoutError or ConnectionError."""
    for _ in range(1000):
        read(connection)


def until_joint(state: socket.socket, index: int, degrees: float) -> tuple[float, ...]:
    """Read state until a joint reaches `degrees`; return all joints, degrees."""
    while True:
        msg_type, _, _, body = read(state)
        if msg_type == 10:
            joints = [math.degrees(joint) for joint in struct.unpack_from(f"<{len(body) // 4 - 1}f", body, 4)]
            if abs(joints[index] - degrees) < 1e-3:
                return tuple(joints)


def test_two_arms_are_streamed_by_points_of_12_joints_and_state_follows(tmp_path: Path) -> None:
    with irc5(tmp_path, 2) as robot, robot.connect("motion") as motion, robot.connect("state") as state:
        for i in range(1, 21):
            motion.sendall(point(i - 1, [0.5 * i, *[0.0] * 5, -0.25 * i, *[0.0] * 5]))
            assert read(motion) == (11, 3, 1, b"")
        joints = until_joint(state, 0, 10.0)
        assert len(joints) == 12
        assert joints[6] == pytest.approx(-5.0, abs=1e-3)
        assert [read(state)[:3] for _ in range(4)] == [(13, 1, 0), (10, 1, 0)] * 2


def test_replies_wait_for_room_when_the_client_is_faster_than_the_arm(tmp_path: Path) -> None:
    with irc5(tmp_path, rapid=", queue_moves: 3, start_delay_s: 0") as robot, robot.connect("motion") as motion:
        motion.sendall(b"".join(point(i, [float(i + 1), *[0.0] * 9], 0.2) for i in range(12)))
        for _ in range(12):
            assert read(motion)[2] == 1
            assert robot.ask(do="status")["streaming"]["moves_ahead"]["ROB_1"] <= 5


def test_a_point_that_comes_in_halves_is_taken_and_a_stop_ends_the_motion(tmp_path: Path) -> None:
    with irc5(tmp_path, rapid=", start_delay_s: 0") as robot, robot.connect("motion") as motion:
        message = point(0, [90.0, *[0.0] * 9], 20.0)
        motion.sendall(message[:30])
        motion.sendall(message[30:])
        assert read(motion)[2] == 1
        motion.sendall(STOP)
        assert read(motion)[2] == 1
        status = robot.ask(do="status")
        assert status["streaming"]["moves_ahead"] == {"ROB_1": 0}
        assert status["units"]["ROB_1"]["velocity_deg_s"] == [0.0] * 6


def test_the_arm_stops_when_its_client_closes_the_connection(tmp_path: Path) -> None:
    with irc5(tmp_path, rapid=", start_delay_s: 0") as robot:
        with robot.connect("motion") as motion:
            motion.sendall(point(0, [90.0, *[0.0] * 9], 10.0))
            assert read(motion)[2] == 1
        while robot.ask(do="status")["streaming"]["moves_ahead"]["ROB_1"]:
            time.sleep(0.01)
        assert robot.ask(do="status")["units"]["ROB_1"]["position_deg"][0] < 80.0


def test_bytes_that_are_no_message_cost_the_connection_and_the_next_client_is_served(tmp_path: Path) -> None:
    with irc5(tmp_path) as robot:
        with robot.connect("motion") as motion:
            motion.sendall(b"\xff" * 40)
            with pytest.raises(ConnectionError):
                read(motion)
        with robot.connect("motion") as motion:
            motion.sendall(struct.pack("<4i", 12, 2, 2, 0))
            assert read(motion) == (2, 3, 2, b"")  # RAPID knows no GET_VERSION


def test_a_cut_closes_both_connections_and_stops_the_arm(tmp_path: Path) -> None:
    with irc5(tmp_path, rapid=", start_delay_s: 0") as robot:
        with robot.connect("motion") as motion, robot.connect("state") as state:
            motion.sendall(point(0, [90.0, *[0.0] * 9], 20.0))
            assert read(motion)[2] == 1
            read(state)
            robot.ask(do="fault", fault="socket_cut")
            for connection in (motion, state):
                with pytest.raises(ConnectionError):
                    read_on(connection)
        with robot.connect("motion") as motion:
            motion.sendall(STOP)
            assert read(motion)[2] == 1
            assert robot.ask(do="status")["units"]["ROB_1"]["velocity_deg_s"] == [0.0] * 6


def test_messages_in_halves_are_complete_and_silent_servers_speak_again_after_clear(tmp_path: Path) -> None:
    with irc5(tmp_path) as robot, robot.connect("motion") as motion, robot.connect("state") as state:
        robot.ask(do="fault", fault="half_message")
        motion.sendall(point(0, [1.0, *[0.0] * 9]))
        assert read(motion) == (11, 3, 1, b"")
        assert {read(state)[0] for _ in range(10)} == {10, 13}
        for fault in ("silent_state", "silent_motion"):
            robot.ask(do="fault", fault=fault)
        state.settimeout(1.0)
        with pytest.raises(TimeoutError):
            read_on(state)
        motion.sendall(point(1, [1.5, *[0.0] * 9]))
        motion.settimeout(0.3)
        with pytest.raises(TimeoutError):
            read(motion)
        robot.ask(do="clear")
        state.settimeout(20.0)
        assert read(state)[0] == 10


def test_a_port_that_is_taken_is_a_sentence(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        config = tmp_path / "irc5.yaml"
        config.write_text(f"rapid: {{motion_port: {port}}}\nunits: [{{name: A, port: 6511}}]\n", encoding="utf-8")
        command = [sys.executable, "-m", "rtcp.virtual.irc5", "--config", str(config)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (
        2, f"rapid: cannot listen at 127.0.0.1:{port} (Address already in use)\n"
    )  # fmt: skip


@pytest.mark.parametrize("mode", ["streaming", "downloading"])
def test_our_simple_message_client_moves_two_arms_by_twelve_joints(tmp_path: Path, mode: str) -> None:
    goal = [0.02 * (axis + 1) for axis in range(12)]
    steps = 20
    points = [
        JointTrajPt(at, tuple(joint * at / steps for joint in goal), 1.0, 0.0333 if at else 0.0)
        for at in range(steps + 1)
    ]
    if mode == "downloading":
        points[0] = replace(points[0], sequence=SpecialSequence.START_TRAJECTORY_DOWNLOAD)
        points[-1] = replace(points[-1], sequence=SpecialSequence.END_TRAJECTORY)
    messages: list[Message] = []

    def is_there() -> bool:
        positions = [message.positions for message in messages[-8:] if isinstance(message, JointPosition)]
        return bool(positions) and positions[-1] == pytest.approx(goal, abs=1e-3)

    async def move(robot: Irc5) -> None:
        motion = MotionClient("127.0.0.1", robot.ready["motion_port"], joints=12)
        state = StateClient("127.0.0.1", messages.append, robot.ready["state_port"])
        running = [asyncio.create_task(client.run()) for client in (motion, state)]
        while not (motion.is_connected and state.is_connected):
            await asyncio.sleep(0.01)
        for point_ in points:
            assert (await motion.request(point_)).reply_code is ReplyCode.SUCCESS
        while not is_there():
            await asyncio.sleep(0.01)
        assert await motion.stop()
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)

    with irc5(tmp_path, arms=2) as robot:
        asyncio.run(move(robot))
