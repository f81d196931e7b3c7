"""The bus to a RAPID program, against servers on real sockets that the tests play; its clock is simulated."""

from __future__ import annotations

import contextlib
import dataclasses
import random
import socket
import struct
from collections.abc import Callable, Iterator
from math import nan
from typing import Any

import pytest

from rtcp.config.buses import RapidBus
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.config.model import ArmConfig
from rtcp.control.cycle import make_drives
from rtcp.control.operator import UNREAD_S, Operator
from rtcp.devices.drive import TargetState
from rtcp.devices.driver import make_driver
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.rapid import RapidData, RapidMaster
from rtcp.ipc.states import DriveState, Missing

STAND, FOLLOW, STOP = 0, 1, 2
READY = (1, 0, 0, 0, 0, 2, 1)
"""STATUS of a controller that may be commanded: powered, e_stopped, error_code, in_error, in_motion, mode, possible."""
S = 1_000_000_000
PING = struct.pack("<3i", 1, 2, 0)
"""The heartbeat of the motion client, without its length."""


class Robot:
    """A controller whose servers the test plays, and the bus that is connected to them."""

    def __init__(self, config: ArmConfig) -> None:
        self.listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        motion, state = (listener.getsockname()[1] for listener in self.listeners)
        bus = config.bus
        assert isinstance(bus, RapidBus)
        self.axes = len(config.joints)
        self.time_ns = 50 * S
        self.data = RapidData(
            config, dataclasses.replace(bus, motion_port=motion, state_port=state), "127.0.0.1", lambda: self.time_ns
        )
        self.accept()

    def accept(self) -> None:
        """Let the bus connect."""
        self.data.receive()
        self.state = self.listeners[1].accept()[0]
        self.state.sendall(struct.pack("<11i", 40, 13, 1, 0, *READY))
        self.until(lambda: self.data.motion._socket is not None)
        self.motion = self.listeners[0].accept()[0]
        self.motion.settimeout(0.05)
        self.until(lambda: self.data.motion.is_open)
        self.data.send()
        assert self.motion.recv(16)[4:] == PING
        assert self.state.recv(16)[4:] == struct.pack("<3i", 1, 1, 0)
        self.answer_heartbeat()

    def close(self) -> None:
        self.data.close()
        for server in (*self.listeners, self.motion, self.state):
            server.close()

    def until(self, met: Callable[[], bool]) -> None:
        """Receive until a condition is met."""
        while not met():
            self.data.receive()

    def pass_time(self, seconds: float) -> None:
        self.time_ns += round(seconds * S)

    def report(self, joints: list[float], status: tuple[int, ...] = READY) -> None:
        """Send positions and status as the state server does, and let the bus read them."""
        body = struct.pack(f"<i{len(joints)}f", 0, *joints)
        self.data._positions_ns = self.data._status_ns = 0
        self.state.sendall(struct.pack("<4i", 12 + len(body), 10, 1, 0) + body)
        self.state.sendall(struct.pack("<11i", 40, 13, 1, 0, *status))
        self.until(lambda: self.data._positions_ns == self.data._status_ns == self.time_ns)
        assert self.actual(0)[0] == pytest.approx(joints[0])

    def command(self, target: float, command: int = FOLLOW) -> None:
        """Command all joints, then send and receive once."""
        for i in range(self.axes):
            self.data.set_output(i, struct.pack("<ddB", target, 0.0, command))
        self.data.send()
        self.data.receive()

    def actual(self, joint: int) -> tuple[float, DriveState, Missing]:
        position, state, missing = struct.unpack("<dBB", self.data.input(joint))
        return position, DriveState(state), Missing(missing)

    def answer_heartbeat(self) -> None:
        self.motion.sendall(struct.pack("<4i", 12, 1, 3, 1))
        self.until(lambda: not self.data._asked[1])

    def requests(self) -> list[bytes]:
        """The messages that the motion server has received, without their lengths."""
        messages: list[bytes] = []
        with contextlib.suppress(TimeoutError):
            while head := self.motion.recv(4):
                messages.append(self.motion.recv(*struct.unpack("<i", head)))
        return messages

    def received(self) -> list[tuple[Any, ...]]:
        """Sequence, first joint and duration of the points that the motion server has received; answers heartbeats."""
        points: list[tuple[Any, ...]] = []
        for message in self.requests():
            if message == PING:
                self.answer_heartbeat()
                continue
            length = len(message)
            assert struct.unpack_from("<3i", message) == (11, 2, 0)
            count = (length - 12 - 12) // 4
            sequence, *numbers = struct.unpack(f"<i{count + 2}f", message[12:])
            points.append((sequence, numbers[0], numbers[-1]))
        return points

    def answer(self, code: int = 1) -> None:
        """Reply to a request, and let the bus read it."""
        before = self.data.accepted, self.data.refused, self.data._stop_ns
        self.motion.sendall(struct.pack("<4i", 12, 11, 3, code))
        self.until(lambda: (self.data.accepted, self.data.refused, self.data._stop_ns) != before)


def config(velocity: float = 10.0) -> ArmConfig:
    arm = load(default_config().with_name("abb_irb120_rapid.yaml"))
    return dataclasses.replace(arm, joints=tuple(dataclasses.replace(joint, velocity=velocity) for joint in arm.joints))


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot(config())
    made.report([0.5] * 10)
    yield made
    made.close()


@pytest.fixture
def following(robot: Robot) -> Robot:
    """A robot that follows at 0.5 rad, before its first point."""
    robot.command(0.5)
    return robot


def test_a_joint_that_is_to_stand_or_has_reached_its_target_costs_no_message(robot: Robot) -> None:
    for command in (STAND, STOP, FOLLOW, FOLLOW, STAND):
        robot.command(0.5, command)
        robot.pass_time(0.1)
    assert robot.received() == []


def test_the_way_to_a_target_takes_the_time_since_the_target_before(following: Robot) -> None:
    following.pass_time(0.04)
    following.command(0.6)
    following.answer()
    following.pass_time(0.03)
    following.command(0.7)
    assert following.received() == [
        (0, pytest.approx(0.6), pytest.approx(0.04)),
        (1, pytest.approx(0.7), pytest.approx(0.03)),
    ]


def test_after_a_rest_the_way_begins_with_the_motion(following: Robot) -> None:
    following.command(0.6)
    following.answer()
    following.pass_time(20.0)
    following.report([0.6] * 10)
    following.command(0.6)
    following.pass_time(0.03)
    following.command(0.7)
    assert following.received()[-1] == (1, pytest.approx(0.7), pytest.approx(0.03))


def test_until_the_answer_comes_the_newest_target_waits(following: Robot) -> None:
    following.pass_time(0.03)
    for target in (0.6, 0.7, 0.8):
        following.command(target)
        following.pass_time(0.03)
    following.data.receive()
    assert struct.unpack("<IIBdbbb", following.data.input(6))[2] == 1
    assert len(following.received()) == 1
    following.answer()
    following.command(0.9)
    assert following.received() == [(1, pytest.approx(0.9), pytest.approx(0.09))]


def test_no_point_is_faster_than_its_joint_however_early_the_cycle_comes() -> None:
    robot = Robot(config(velocity=2.0))
    robot.report([0.5] * 10)
    robot.command(0.5)
    robot.pass_time(0.01)
    robot.command(0.6)
    assert robot.received() == [(0, pytest.approx(0.6), pytest.approx(0.05))]
    robot.close()


@pytest.mark.parametrize("target", [0.52, -0.5])
def test_a_stream_does_not_begin_away_from_where_the_joints_stand(robot: Robot, target: float) -> None:
    for _ in range(3):
        robot.command(target)
        robot.pass_time(0.03)
        assert robot.actual(0)[1:] == (DriveState.SWITCHED_ON, Missing.NOTHING)
    assert robot.received() == []
    robot.command(0.5)
    assert robot.actual(0)[1] is DriveState.OPERATION_ENABLED
    robot.command(0.5)
    robot.command(target)
    assert [sequence for sequence, *_ in robot.received()] == [0]


def test_a_refused_point_ends_the_stream_and_is_not_offered_again_with_more_time(following: Robot) -> None:
    following.pass_time(0.03)
    following.command(0.6)
    following.answer(2)
    assert following.actual(0)[1:] == (DriveState.SWITCHED_ON, Missing.NOTHING)
    master = RapidMaster(config(), "virtual", 0)
    master._data = following.data
    assert "refused point 0" in master.explain(0)
    for target in (0.7, 0.8, 0.9):
        following.command(target)
    assert [sequence for sequence, *_ in following.received()] == [0, -4]
    assert (following.data.accepted, following.data.refused) == (0, 1)
    following.answer()
    following.command(0.9)
    assert following.actual(0)[1] is DriveState.SWITCHED_ON
    following.command(0.5, STAND)
    assert following.actual(0)[1] is DriveState.OPERATION_ENABLED
    assert following.received() == []


def test_what_is_to_follow_before_the_stop_is_answered_begins_anew_where_the_joints_stand(following: Robot) -> None:
    following.command(0.6)
    following.answer()
    following.command(0.6, STOP)
    following.command(0.6)
    assert following.actual(0)[1:] == (DriveState.SWITCHED_ON, Missing.NOTHING)
    following.answer()
    following.pass_time(0.03)
    following.command(0.7)
    following.command(0.8)
    assert [sequence for sequence, *_ in following.received()] == [0, -4]
    following.report([0.55] * 10)
    following.command(0.55)
    following.command(0.55)
    following.command(0.57)
    assert following.received() == [(0, pytest.approx(0.57), pytest.approx(0.002))]


@pytest.mark.parametrize("command", [STAND, STOP])
def test_what_is_under_way_is_stopped_once_and_the_next_motion_counts_from_0(following: Robot, command: int) -> None:
    following.command(0.6)
    following.answer()
    for _ in range(3):
        following.command(0.6, command)
    following.command(0.7)  # not before the stop is answered
    assert [sequence for sequence, *_ in following.received()] == [0, -4]
    following.answer()
    following.report([0.55] * 10)
    following.command(0.55, STAND)
    following.command(0.55)
    following.command(0.6)
    assert [sequence for sequence, *_ in following.received()] == [0]


def test_a_stop_does_not_wait_for_the_answer_to_a_point(following: Robot) -> None:
    following.command(0.6)
    following.command(0.6, STOP)
    assert [sequence for sequence, *_ in following.received()] == [0, -4]
    following.answer()
    following.answer()
    following.command(0.6, STOP)
    assert following.received() == []


def test_a_refused_stop_ends_the_connection_and_with_it_the_motion(following: Robot) -> None:
    following.command(0.6)
    following.answer()
    following.command(0.6, STOP)
    following.answer(2)
    assert following.data.motion.problem.endswith(": it refused to stop")
    assert following.motion.recv(1000)[-68:][16:20] == struct.pack("<i", -4)
    assert following.motion.recv(1) == b""


@pytest.mark.parametrize("replies", [[(11, 3, 1)] * 2, [(11, 3, 1), (11, 3, 2)], [(10, 3, 1)]])
def test_a_reply_that_belongs_to_no_request_ends_the_connection(
    following: Robot, replies: list[tuple[int, int, int]]
) -> None:
    following.command(0.6)
    for reply in replies:
        following.motion.sendall(struct.pack("<4i", 12, *reply))
    following.until(lambda: not following.data.motion.is_open)
    assert following.data.motion.problem.endswith(": a reply came that nothing had asked for")
    assert following.actual(0)[1] is DriveState.NOT_READY_TO_SWITCH_ON


@pytest.mark.parametrize(
    ("status", "state", "missing"),
    [
        (READY, DriveState.OPERATION_ENABLED, Missing.NOTHING),
        ((-1, -1, -1, -1, -1, -1, -1), DriveState.OPERATION_ENABLED, Missing.NOTHING),
        ((0, 0, 0, 0, 0, 2, 0), DriveState.SWITCH_ON_DISABLED, Missing.MOTORS),
        ((1, 1, 0, 0, 0, 2, 0), DriveState.SWITCH_ON_DISABLED, Missing.MOTORS),
        ((1, 0, 0, 0, 0, 2, 0), DriveState.READY_TO_SWITCH_ON, Missing.PROGRAM),
        ((0, 1, 0, 1, 0, 2, 0), DriveState.FAULT, Missing.CLEARANCE),
    ],
)
def test_the_state_of_a_drive_is_what_the_status_says(
    robot: Robot, status: tuple[int, ...], state: DriveState, missing: Missing
) -> None:
    robot.report([0.25] + [0.0] * 9, status)
    robot.until(lambda: robot.actual(0)[1] is state)
    assert robot.actual(5) == (0.0, state, missing)


def test_a_controller_that_takes_none_is_sent_a_stop_whatever_is_commanded(following: Robot) -> None:
    following.command(0.6)
    following.answer()
    following.report([0.55] * 10, (1, 0, 0, 0, 0, 2, 0))
    following.until(lambda: following.actual(0)[1] is DriveState.READY_TO_SWITCH_ON)
    following.command(0.7)
    following.command(0.8)
    assert [sequence for sequence, *_ in following.received()] == [0, -4]
    following.answer()
    following.report([0.54] * 10)
    following.command(0.8)
    following.command(0.8)
    assert following.actual(0)[1] is DriveState.SWITCHED_ON
    assert following.received() == []


def test_no_point_goes_to_a_program_that_does_not_run(following: Robot) -> None:
    following.report([0.25] + [0.0] * 9, (1, 0, 0, 0, 0, 2, 0))
    following.until(lambda: following.actual(0)[1] is DriveState.READY_TO_SWITCH_ON)
    following.command(0.6)
    assert following.received() == []


def test_a_cycle_is_lost_when_no_positions_came_for_longer_than_the_state_period(robot: Robot) -> None:
    robot.pass_time(0.05)
    assert robot.data.receive() == 1
    robot.pass_time(0.001)
    assert robot.data.receive() == -1
    robot.report([0.25] + [0.0] * 9)
    assert robot.data.receive() == 1


@pytest.mark.parametrize("number", [10, 13])
def test_a_cycle_is_lost_when_either_positions_or_status_are_missing(robot: Robot, number: int) -> None:
    robot.pass_time(0.051)
    body = struct.pack("<i10f", 0, *[0.75] * 10) if number == 10 else struct.pack("<7i", 1, 1, 0, 0, 0, 2, 0)
    robot.state.sendall(struct.pack("<4i", 12 + len(body), number, 1, 0) + body)
    before = robot.actual(0)
    robot.until(lambda: robot.actual(0) != before)
    assert robot.data.receive() == -1


def test_a_status_that_does_not_exist_is_none(robot: Robot) -> None:
    robot.pass_time(0.051)
    body = struct.pack("<i10f", 0, *[0.75] * 10)
    robot.state.sendall(struct.pack("<11i", 40, 13, 1, 0, 1, 0, 0, 0, 0, 7, 1))
    robot.state.sendall(struct.pack("<4i", 12 + len(body), 10, 1, 0) + body)
    robot.until(lambda: robot.actual(0)[0] == 0.75)
    assert robot.data.receive() == -1


def test_what_waited_while_the_loop_stood_is_read_in_one_cycle(robot: Robot) -> None:
    for i in range(1, 301):
        body = struct.pack("<i10f", 0, *[i / 256] * 10)
        robot.state.sendall(struct.pack("<4i", 12 + len(body), 10, 1, 0) + body)
    arrived = robot.data.state._socket
    assert arrived is not None
    while len(arrived.recv(300 * 60, socket.MSG_PEEK)) < 300 * 60:
        pass
    robot.data.receive()
    assert robot.actual(0)[0] == 300 / 256


def test_positions_that_are_no_numbers_are_left_out(robot: Robot) -> None:
    body = struct.pack("<i10f", 0, nan, *[0.0] * 9)
    robot.state.sendall(struct.pack("<4i", 12 + len(body), 10, 1, 0) + body)
    robot.report([0.25] + [1.0] * 9)
    assert robot.actual(1)[0] == 1.0


def test_a_message_in_pieces_is_read(robot: Robot) -> None:
    body = struct.pack("<i10f", 0, *[0.125] * 10)
    message = struct.pack("<4i", 12 + len(body), 10, 1, 0) + body
    for piece in (message[:3], message[3:20], message[20:]):
        robot.data.receive()
        assert robot.actual(0)[0] == 0.5
        robot.state.sendall(piece)
    robot.until(lambda: robot.actual(0)[0] == 0.125)


@pytest.mark.parametrize("server", ["motion", "state"])
def test_a_lost_connection_is_said_and_made_again_after_a_second(following: Robot, server: str) -> None:
    following.command(0.6)
    following.answer()
    following.received()
    getattr(following, server).close()
    lost = getattr(following.data, server)
    following.until(lambda: not lost.is_open)
    assert following.actual(0)[1:] == (DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION)
    assert f"no connection to its {server} server at 127.0.0.1:" in lost.problem
    assert lost.problem.endswith(": the controller closed the connection")
    following.pass_time(0.99)
    following.data.receive()
    assert lost._socket is None
    following.pass_time(0.01)
    following.until(lambda: lost.is_open)


def test_a_motion_does_not_go_on_when_a_suspended_loop_does(following: Robot) -> None:
    following.command(0.6)
    following.answer()
    following.received()
    following.pass_time(1.001)
    following.report([0.6] * 10)
    following.command(0.61)
    assert following.requests() == [PING]
    assert following.motion.recv(1) == b""
    assert following.data.motion.problem.endswith(": the loop stood still for 1.0 s in a motion")
    assert following.actual(0)[1] is DriveState.NOT_READY_TO_SWITCH_ON


@pytest.mark.parametrize("later", [FOLLOW, STOP])
def test_a_motion_server_that_does_not_answer_is_lost(following: Robot, later: int) -> None:
    following.command(0.6)
    following.pass_time(0.5)
    following.command(0.6, later)
    following.pass_time(0.5)
    following.data.receive()
    assert following.data.motion.is_open
    following.pass_time(0.001)
    following.data.receive()
    assert following.data.motion.problem.endswith(": no answer for 1 s")


def test_bytes_that_are_no_message_end_the_connection(robot: Robot) -> None:
    robot.state.sendall(b"\xff" * 8)
    robot.until(lambda: not robot.data.state.is_open)
    assert "length -1 (little endian) is outside 12..1023" in robot.data.state.problem


def test_closing_stops_what_is_under_way(following: Robot) -> None:
    following.command(0.6)
    following.answer()
    following.received()
    following.data.close()
    stop = following.motion.recv(100)
    assert struct.unpack_from("<5i", stop) == (64, 11, 2, 0, -4)
    assert following.motion.recv(1) == b""


def test_twelve_joints_widen_the_messages() -> None:
    arm = config()
    robot = Robot(dataclasses.replace(arm, joints=(*arm.joints, *arm.joints)))
    robot.report([0.5] * 11 + [0.495])
    robot.command(0.5)
    robot.command(0.6)
    assert robot.actual(11)[0] == pytest.approx(0.495)
    assert struct.unpack("<i", robot.motion.recv(4)) == (72,)
    robot.close()


STATUSES = (*[READY] * 20, (0, 1, 0, 0, 0, 2, 0), (1, 0, 0, 0, 0, 2, 0), (1, 0, 0, 1, 0, 2, 1), (1, 0, 0, 0, 0, 9, 1))
VELOCITY = 1.0


class Session:
    """A controller that answers, refuses, falls silent and closes at random, and drives that are commanded at random.

    Checks what the motion server receives: no point before a stop is answered, or while the controller is not ready,
    or beyond the joints' speed from the commanded, at first the actual, positions.
    """

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        arm = config(VELOCITY)
        self.robot = Robot(arm)
        self.robot.motion.setblocking(False)
        self.drives = [drive for _, drive in make_drives(arm)]
        self.period_s = arm.cycle.period_us * 1e-6
        self.actual = [0.1] * len(self.drives)
        self.points = 0
        self.target, self.speed, self.status = TargetState.DISABLED, 0.0, READY
        self.forget()

    def forget(self) -> None:
        """Begin a connection."""
        self.bytes = b""
        self.unanswered: list[tuple[float, ...] | None] = []
        """Positions of the requests; empty: a stop; None: a heartbeat."""
        self.commanded: tuple[float, ...] = ()

    def serve(self, state: DriveState, shown: list[float]) -> None:
        """Check what the last cycle sent, and answer the oldest request at random."""
        with contextlib.suppress(OSError):
            self.bytes += self.robot.motion.recv(4096)
        while len(self.bytes) >= 16:
            if self.bytes[4:16] == PING:
                self.bytes = self.bytes[16:]
                self.unanswered.append(None)
                continue
            if len(self.bytes) < 68:
                break
            sequence, *joints, _, duration = struct.unpack("<i12f", self.bytes[16:68])
            self.bytes = self.bytes[68:]
            point = tuple(joints[: len(self.drives)]) if sequence >= 0 else ()
            if point:
                self.points += 1
                distance = max(abs(a - b) for a, b in zip(point, self.commanded or shown, strict=True))
                assert () not in self.unanswered
                assert state is DriveState.OPERATION_ENABLED
                # Late or lost positions miss some of the arm's last steps of 0.004 rad.
                assert distance <= VELOCITY * duration + (1e-4 if self.commanded else 0.031)
            self.unanswered.append(point)
        if self.unanswered and self.random.random() < 0.5:
            taken = self.random.random() < 0.93
            point = self.unanswered.pop(0)
            number = 1 if point is None else 11
            with contextlib.suppress(OSError):
                self.robot.motion.sendall(struct.pack("<4i", 12, number, 3, 1 if taken else 2))
            if point is not None:
                self.commanded = point if taken else self.commanded
            if self.commanded:
                pairs = zip(self.actual, self.commanded, strict=True)
                self.actual = [a + max(-0.004, min(0.004, b - a)) for a, b in pairs]

    def send_state(self) -> None:
        if self.random.random() < 0.1:
            self.status = self.random.choice(STATUSES)
        body = struct.pack("<i10f", 0, *self.actual, *[0.0] * (10 - len(self.actual)))
        messages = (
            struct.pack("<4i", 12 + len(body), 10, 1, 0) + body,
            struct.pack("<11i", 40, 13, 1, 0, *self.status),
        )
        for message in messages:
            if self.random.random() < 0.97:
                with contextlib.suppress(OSError):
                    self.robot.state.sendall(message)

    def reconnect(self) -> None:
        """Close connections at random; the bus connects again."""
        robot = self.robot
        for server in (robot.motion, robot.state):
            if self.random.random() < 0.003:
                server.close()
        if not (robot.data.motion.is_open and robot.data.state.is_open):
            robot.pass_time(2.0)
        for listener in robot.listeners:
            listener.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            connected = robot.listeners[0].accept()[0]
            robot.motion.close()
            robot.motion = connected
            robot.motion.setblocking(False)
            self.forget()
        with contextlib.suppress(BlockingIOError):
            connected = robot.listeners[1].accept()[0]
            robot.state.close()
            robot.state = connected

    def cycle(self) -> None:
        data = self.robot.data
        self.robot.pass_time(self.period_s * self.random.uniform(0.7, 1.3))
        state, shown = self.robot.actual(0)[1], [self.robot.actual(i)[0] for i in range(len(self.drives))]
        data.send()
        self.serve(state, shown)
        good = data.receive() == 1
        if self.random.random() < 0.02:
            self.target = self.random.choice((TargetState.ENABLED, TargetState.ENABLED, *TargetState))
        if self.random.random() < 0.05:
            self.speed = self.random.uniform(-VELOCITY, VELOCITY)
        for i, drive in enumerate(self.drives):
            if good:
                drive.decode(data.input(i))
            drive.advance(self.target)
            if good and drive.state is DriveState.OPERATION_ENABLED:
                wanted = drive.target_position + self.speed * self.period_s
                drive.target_position = max(drive.low, min(drive.high, wanted))
            data.set_output(i, drive.encode())


@pytest.mark.parametrize("seed", range(8))
def test_in_a_random_session_no_point_leaves_that_must_not(seed: int) -> None:
    session = Session(seed)
    for _ in range(1500):
        session.send_state()
        session.reconnect()
        session.cycle()
    session.robot.close()
    assert session.points > 0


@pytest.mark.parametrize(
    ("status", "told"),
    [
        ((1, 0, 0, 0, 0, 2, 1), (1, 0, 2)),
        ((0, 1, 0, 1, 0, 1, 0), (0, 1, 1)),
        ((-1, -1, 0, -1, -1, -1, -1), (-1, -1, -1)),
    ],
    ids=["in automatic mode", "emergency stop in manual mode", "unknown"],
)
def test_motors_emergency_stop_and_key_of_the_controller_reach_the_record(
    robot: Robot, status: tuple[int, ...], told: tuple[int, ...]
) -> None:
    arm = config()
    unit = make_driver(arm.slaves[-1], 0.004)
    operator = Operator(arm, {unit.name: unit}, None)

    def shown() -> tuple[int, ...]:
        return operator.drives_powered, operator.e_stopped, operator.operating_mode

    operator.miss()
    assert shown() == (-1, -1, -1)  # nothing was ever received
    robot.report([0.25] * 10, status)
    unit.decode(robot.data.input(6))
    operator.read()
    assert shown() == told
    for _ in range(round(UNREAD_S / (1e-6 * arm.cycle.period_us)) + 1):
        assert shown() == told
        operator.miss()
    assert shown() == (-1, -1, -1)


def test_an_interface_that_is_no_address_is_refused() -> None:
    RapidMaster.check_interface("192.168.125.1")
    with pytest.raises(BusError, match=r"eth0 .* is no IPv4 address: that of the controller is expected"):
        RapidMaster.check_interface("eth0")


def test_what_is_waited_for_is_the_connection_and_then_what_the_controller_lacks() -> None:
    master = RapidMaster(config(), "virtual", 0)
    assert (master.connected, master.waiting_for()) == (False, "")
    master._data = robot_data = RapidData(config(), RapidBus(), "127.0.0.1")
    assert master.waiting_for() == "no answer from its state server at 127.0.0.1:11002 yet"
    robot_data.close()
