"""The bus of RAPID streaming against the virtual controller, in one process and one simulated time, over a cable."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.config.buses import RapidBus
from rtcp.config.cell import Base, ControllerUnits, Member
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.fieldbus.rapid import RapidData
from rtcp.fieldbus.rapid_units import SharedUnitData, UnitExchange
from rtcp.ipc.states import DriveState, Missing
from rtcp.virtual.irc5.config import Irc5Config, RapidConfig, UnitConfig
from rtcp.virtual.irc5.controller import Controller
from rtcp.virtual.irc5.panel import Mode, Motors
from rtcp.virtual.irc5.streaming_server import StreamingServer

PERIOD_S = 0.004
STEPS_A_CYCLE = 8
S = 1_000_000_000
STAND, FOLLOW, STOP = 0, 1, 2
REST = [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]
CONFIG = load(default_config().with_name("abb_irb120_rapid.yaml"))
READY = DriveState.OPERATION_ENABLED, Missing.NOTHING


class Cable:
    """Forwards the bytes of both servers. Cut, open connections say nothing to either side, and new ones fail."""

    def __init__(self, ports: dict[str, int]) -> None:
        self.is_cut = False
        self._to = [ports["motion_port"], ports["state_port"]]
        self._listeners = [socket.create_server(("127.0.0.1", 0), backlog=200) for _ in range(2)]
        for listener in self._listeners:
            listener.setblocking(False)
        self.ports = [listener.getsockname()[1] for listener in self._listeners]
        self._pairs: list[tuple[socket.socket, socket.socket]] = []

    def step(self) -> None:
        if self.is_cut:
            for listener in self._listeners:
                with contextlib.suppress(BlockingIOError):
                    listener.accept()[0].close()
            return
        for listener, port in zip(self._listeners, self._to, strict=True):
            with contextlib.suppress(BlockingIOError):
                near = listener.accept()[0]
                far = socket.create_connection(("127.0.0.1", port), timeout=5.0)
                for end in (near, far):
                    end.setblocking(False)
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._pairs.append((near, far))
        for pair in self._pairs[:]:
            for source, target in (pair, pair[::-1]):
                try:
                    data = source.recv(1 << 16)
                    if not data:
                        raise ConnectionError
                    target.sendall(data)
                except BlockingIOError:
                    pass
                except OSError:
                    for end in pair:
                        end.close()
                    self._pairs.remove(pair)
                    break

    def close(self) -> None:
        for end in (*self._listeners, *(end for pair in self._pairs for end in pair)):
            end.close()


class Link:
    """A controller, the cable, and the buses of its arms; `step` is a cycle of the controller."""

    def __init__(self, folder: Path, arms: int = 1, rapid: dict[str, Any] | None = None, **bus: Any) -> None:
        units = tuple(
            UnitConfig(f"ROB_{i + 1}", 6511 + i, initial_position=(0, 0, 0, 0, 28.6479, 0), period_s=PERIOD_S)
            for i in range(arms)
        )
        settings: dict[str, Any] = {"motion_port": 0, "state_port": 0, "start_delay_s": 0.0}
        self.controller = Controller(Irc5Config(units, rapid=RapidConfig(**settings | (rapid or {}))))
        assert self.controller.streaming is not None
        self.streaming = self.controller.streaming
        self.server = StreamingServer(self.streaming, PERIOD_S)
        self.cable = Cable(self.streaming.ports)
        self.time_ns = 50 * S
        motion, state = self.cable.ports
        assert isinstance(CONFIG.bus, RapidBus)
        own = dataclasses.replace(CONFIG.bus, motion_port=motion, state_port=state, **bus)
        self.names = ["left", "right", "third", "fourth"][:arms]
        for name in self.names:
            (folder / name).mkdir()
        members = tuple(Member(name, CONFIG, Base(), folder / name) for name in self.names)
        exchange = UnitExchange(ControllerUnits(members, 0)) if arms > 1 else None
        self.data = RapidData(CONFIG, own, "127.0.0.1", lambda: self.time_ns, exchange)
        shared = [
            SharedUnitData(CONFIG, own, ControllerUnits(members, i), lambda: self.time_ns) for i in range(1, arms)
        ]
        self.arms: list[RapidData | SharedUnitData] = [self.data, *shared]
        self.targets = [REST] * arms
        self.commands = [STAND] * arms
        self.states: list[tuple[DriveState, Missing]] = []
        self.good = [-1] * arms
        self._steps = 0

    def close(self) -> None:
        for each in (*self.arms, self.cable, self.server):
            each.close()

    def step(self) -> None:
        self.time_ns += round(PERIOD_S * S)
        self.controller.panel.advance(PERIOD_S)
        self.cable.step()
        self.server.cycle(0.0)
        self.cable.step()
        self._steps += 1
        if self._steps % STEPS_A_CYCLE == 0:
            self.cycle()

    def cycle(self) -> None:
        """A cycle of the arms' loops: the first has the connection, and begins those of the others."""
        self.data.send()
        self.good = [arm.receive() for arm in self.arms]
        for number, arm in enumerate(self.arms):
            for i, target in enumerate(self.targets[number]):
                arm.set_output(i, struct.pack("<ddB", target, 0.0, self.commands[number]))
        for arm in self.arms[1:]:
            arm.send()

    def until(self, met: Callable[[], bool], seconds: float = 20.0) -> None:
        end = self.time_ns + round(seconds * S)
        while not met():
            assert self.time_ns < end, "not met in simulated time"
            self.step()

    def run(self, seconds: float) -> None:
        end = self.time_ns + round(seconds * S)
        while self.time_ns < end:
            self.step()

    def state(self, arm: int = 0) -> tuple[DriveState, Missing]:
        _, state, missing = struct.unpack("<dBB", self.arms[arm].input(0))
        return DriveState(state), Missing(missing)

    def begin(self) -> None:
        """Connect, and let all arms follow where they stand."""
        self.until(lambda: all(self.state(i) == READY for i in range(len(self.arms))))
        for i in range(len(self.arms)):
            self.commands[i] = FOLLOW
        self.run(0.1)

    def drive(self, arm: int, joint: int, to: float, speed: float = 0.5) -> Callable[[], bool]:
        """Return a condition for `until` that moves a target on with every call, and is met at its end."""
        began, start = self.time_ns, self.targets[arm][joint]

        def moved() -> bool:
            way = speed * (self.time_ns - began) / S
            target = min(start + way, to) if to > start else max(start - way, to)
            self.targets[arm] = [*self.targets[arm][:joint], target, *self.targets[arm][joint + 1 :]]
            return target == to

        return moved

    def actual(self, arm: int = 0) -> list[float]:
        """Return the true joint positions of an arm, rad."""
        unit = self.controller.units[f"ROB_{arm + 1}"].mechanical
        return [0.017453292519943295 * joint for joint in unit.actual]

    def rests(self) -> bool:
        return not any(any(unit.mechanical.speeds) for unit in self.controller.units.values())


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Link]]:
    with contextlib.ExitStack() as stack:

        def made(*arguments: Any, **keys: Any) -> Link:
            link = Link(tmp_path, *arguments, **keys)
            stack.callback(link.close)
            return link

        yield made


def client(link: Link, server: str) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", link.streaming.ports[f"{server}_port"]))
    connection.setblocking(False)
    return connection


def answers(connection: socket.socket, bytes_sent: bytes) -> Callable[[], bool]:
    """Send; return whether an answer has come."""
    connection.sendall(bytes_sent)

    def answered() -> bool:
        with contextlib.suppress(BlockingIOError):
            return bool(connection.recv(100))
        return False

    return answered


PING = struct.pack("<4i", 12, 1, 2, 0)


# -- loss of the link --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", [8.0, 60.0])
def test_without_link_the_arm_stops_and_all_connections_come_back_by_themselves_the_state_first(
    make: Callable[..., Link], seconds: float
) -> None:
    link = make()
    link.begin()
    moved = link.drive(0, 0, 1.0)
    link.until(lambda: moved() or link.actual()[0] > 0.2)
    link.cable.is_cut = True
    link.until(lambda: link.state() == (DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION), 1.2)
    link.commands[0] = STAND
    link.run(seconds - 1.0)
    assert link.rests()
    assert link.actual()[0] < 0.5  # it has not gone to where it was to go
    assert link.streaming.counts["silent_client"] == 2
    here = link.actual()
    link.cable.is_cut = False
    link.until(lambda: link.good == [1])
    assert link.state()[1] is Missing.CONNECTION  # positions come, and no motion is possible yet
    link.until(lambda: link.state() == READY, 5.0)
    link.run(1.0)
    assert link.actual() == here  # nothing moves that nobody commanded
    link.targets[0] = [struct.unpack("<d", link.data.input(i)[:8])[0] for i in range(6)]
    link.commands[0] = FOLLOW
    link.run(0.1)
    link.until(link.drive(0, 1, link.targets[0][1] + 0.1))
    link.until(lambda: link.actual()[1] == pytest.approx(link.targets[0][1], abs=1e-4))


def test_a_connection_that_is_idle_is_kept_by_heartbeats(make: Callable[..., Link]) -> None:
    link = make(rapid={"client_timeout_s": 1.0, "idle_timeout_s": 3.0})
    link.begin()
    link.run(10.0)
    assert link.state() == READY
    assert link.streaming.counts["silent_client"] == 0
    assert link.streaming.counts["success"] > 10


def test_a_motion_server_that_stops_to_answer_heartbeats_is_lost(make: Callable[..., Link]) -> None:
    link = make()
    link.begin()
    link.streaming.faults.add("silent_motion")
    link.until(lambda: link.state()[1] is Missing.CONNECTION, 2.0)
    assert link.data.motion.problem.endswith(": no answer for 1 s")


@pytest.mark.parametrize(("server", "bytes_sent"), [("motion", PING), ("state", PING), ("motion", b"")])
def test_a_client_that_is_lost_without_a_word_does_not_keep_the_next_one_out(
    make: Callable[..., Link], server: str, bytes_sent: bytes
) -> None:
    link = make(rapid={"client_timeout_s": 2.0, "idle_timeout_s": 4.0})
    link.cable.is_cut = True
    with client(link, server) as lost, client(link, server) as waiting:
        if bytes_sent:
            link.until(answers(lost, bytes_sent))
        served = answers(waiting, PING)
        began = link.time_ns
        link.until(served, 6.0)
        after_s = (link.time_ns - began) / S
        assert after_s == pytest.approx(2.0 if bytes_sent else 4.0, abs=0.1)


def test_a_silent_client_in_a_motion_stops_the_arm(make: Callable[..., Link]) -> None:
    link = make()
    link.begin()
    # A point that lasts for longer than the client is waited for.
    link.cable.is_cut = True
    link.run(3.0)
    with client(link, "motion") as motion:
        joints = struct.pack("<12f", 0.9, 0.0, 0.0, 0.0, 0.5, 0.0, *[0.0] * 4, 1.0, 20.0)
        link.until(answers(motion, PING))
        link.until(answers(motion, struct.pack("<5i", 64, 11, 2, 0, 0) + joints))
        link.run(1.5)
        assert not link.rests()
        link.run(1.0)
        assert link.rests()


def test_the_motors_go_off_when_no_client_comes_for_the_configured_time(make: Callable[..., Link]) -> None:
    link = make(rapid={"motors_off_s": 5.0})
    link.begin()
    link.run(10.0)
    assert link.controller.panel.motors is Motors.ON
    link.cable.is_cut = True
    link.run(6.4)  # the last heartbeat was at most 0.5 s before the cut
    assert link.controller.panel.motors is Motors.ON
    link.run(1.1)
    assert link.controller.panel.motors is Motors.OFF


def test_after_a_crash_of_the_program_its_ports_are_taken_anew_and_the_bus_connects(make: Callable[..., Link]) -> None:
    link = make()
    link.begin()
    moved = link.drive(0, 0, 1.0)
    link.until(lambda: moved() or link.actual()[0] > 0.2)
    link.streaming.faults.add("server_crash")
    link.until(lambda: link.state() == (DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION), 2.0)
    link.commands[0] = STAND
    link.run(5.0)
    assert link.state()[1] is Missing.CONNECTION
    link.streaming.faults.discard("server_crash")
    link.until(lambda: link.state() == READY)
    here = link.actual()
    link.run(1.0)
    assert link.actual() == here


# -- motors and board --------------------------------------------------------------------------------------------------


def test_motors_on_is_an_order_in_automatic_mode_and_a_state(make: Callable[..., Link]) -> None:
    link = make()
    link.until(lambda: link.state() == READY)

    def motors() -> int:
        return int(struct.unpack("<IIBdbbb", link.data.input(6))[4])

    link.data.set_output(6, b"\x02")
    link.until(lambda: link.controller.panel.motors is Motors.OFF)
    link.until(lambda: motors() == 0)
    assert link.state() == (DriveState.SWITCH_ON_DISABLED, Missing.MOTORS)
    link.data.set_output(6, b"\x01")
    link.until(lambda: motors() == 1)
    link.data.set_output(6, b"\x00")
    link.controller.panel.select_mode(Mode.HAND)
    link.until(lambda: motors() == 0)
    link.data.set_output(6, b"\x01")
    link.run(1.0)
    assert link.controller.panel.motors is Motors.OFF


def test_an_order_without_a_connection_is_not_carried_out_later(make: Callable[..., Link]) -> None:
    link = make()
    link.until(lambda: link.state() == READY)
    link.cable.is_cut = True
    link.until(lambda: link.state()[1] is Missing.CONNECTION)
    link.data.set_output(6, b"\x02")
    link.run(1.0)
    link.cable.is_cut = False
    link.until(lambda: link.state() == READY)
    link.run(1.0)
    assert link.controller.panel.motors is Motors.ON


def test_the_board_is_read_and_set_and_set_again_after_a_loss(make: Callable[..., Link]) -> None:
    link = make(board="dsqc652")

    def board() -> dict[str, int]:
        return dict(link.streaming.status()["board"])

    link.until(lambda: link.state() == READY)
    link.controller.request({"do": "input", "input": "DI16", "level": "on"})
    link.controller.request({"do": "input", "input": "DI1", "level": "on"})
    link.until(lambda: link.data.input(7) == struct.pack("<H", 0x8001))
    link.data.set_output(7, struct.pack("<H", 0x4002))
    link.until(lambda: [name for name, level in board().items() if level] == ["DI1", "DI16", "DO2", "DO15"])
    link.streaming.faults.add("socket_cut")
    link.streaming.outputs = 0
    link.until(lambda: board()["DO15"] == 1)


# -- two arms in one stream --------------------------------------------------------------------------------------------


def test_two_arms_are_moved_at_once_by_points_of_twelve_joints(make: Callable[..., Link]) -> None:
    link = make(2)
    link.begin()
    points: list[tuple[float, ...]] = []
    left, right = link.drive(0, 0, 0.4), link.drive(1, 0, -0.4)
    receive = link.streaming.receive

    def noted(frame: Any) -> None:
        if frame.msg_type == 11:
            points.append(struct.unpack_from("<12f", frame.body, 4))
        receive(frame)

    link.streaming.receive = noted  # type: ignore[method-assign]
    link.until(lambda: left() & right())
    link.until(lambda: link.actual(0)[0] == pytest.approx(0.4, abs=1e-4))
    link.until(lambda: link.actual(1)[0] == pytest.approx(-0.4, abs=1e-4))
    assert len(points) > 10
    # The targets of both were commanded for one instant: they mirror each other.
    assert max(abs(point[0] + point[6]) for point in points) < 1e-6


def test_an_arm_that_stands_is_held_by_the_points_of_the_other(make: Callable[..., Link]) -> None:
    link = make(2)
    link.begin()
    link.commands[1] = STAND
    link.run(0.2)
    link.until(link.drive(0, 0, 0.3))
    link.until(lambda: link.actual(0)[0] == pytest.approx(0.3, abs=1e-4))
    assert link.actual(1) == pytest.approx(REST, abs=1e-5)
    assert link.state(0) == link.state(1) == READY
    link.commands[1] = FOLLOW
    link.run(0.2)
    link.until(link.drive(1, 2, 0.2))
    link.until(lambda: link.actual(1)[2] == pytest.approx(0.2, abs=1e-4))
    assert link.actual(0)[0] == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize("stopped", [0, 1])
def test_an_arm_that_is_stopped_in_its_motion_stops_the_other_too(make: Callable[..., Link], stopped: int) -> None:
    link = make(2)
    link.begin()
    moves = link.drive(0, 0, 1.0), link.drive(1, 0, 1.0)
    link.until(lambda: moves[0]() | moves[1]() or min(link.actual(i)[0] for i in range(2)) > 0.2)
    link.commands[stopped] = STOP
    other = 1 - stopped
    link.until(lambda: moves[other]() or link.state(other)[0] is DriveState.SWITCHED_ON, 1.0)
    if other == 0:
        assert "because right was stopped" in link.data.refusal
    link.commands[other] = STAND
    link.until(link.rests, 2.0)
    assert max(link.actual(i)[0] for i in range(2)) < 0.8
    link.until(lambda: link.state(0) == link.state(1) == READY)


def test_an_arm_that_holds_goes_on_holding_when_the_other_is_stopped(make: Callable[..., Link]) -> None:
    link = make(2)
    link.begin()
    moved = link.drive(1, 0, 1.0)
    link.until(lambda: moved() or link.actual(1)[0] > 0.2)
    link.commands[1] = STOP
    seen = set()
    for _ in range(300):
        link.step()
        seen.add(link.state(0))
    assert seen == {READY}


def test_an_arm_whose_platform_was_suspended_does_not_move_on_before_it_has_stood(make: Callable[..., Link]) -> None:
    link = make(2)
    link.begin()
    moved = link.drive(1, 0, 1.0)
    link.until(lambda: moved() or link.actual(1)[0] > 0.2)
    right = link.arms.pop()
    link.run(2.0)
    assert link.rests()
    stopped = link.actual(1)
    link.arms.append(right)
    link.run(0.1)
    assert link.state(1)[0] is DriveState.SWITCHED_ON
    link.until(link.drive(1, 0, link.targets[1][0] + 0.3))
    link.run(1.0)
    assert link.actual(1) == pytest.approx(stopped, abs=1e-4)
    link.commands[1], link.targets[1] = STAND, link.actual(1)
    link.until(lambda: link.state(0) == link.state(1) == READY)
    link.commands[1] = FOLLOW
    link.run(0.1)
    link.until(link.drive(1, 0, stopped[0] + 0.2))
    link.until(lambda: link.actual(1)[0] == pytest.approx(stopped[0] + 0.2, abs=1e-4))


def test_a_platform_that_ends_stops_all_arms_and_the_other_says_which_one_is_missing(
    make: Callable[..., Link],
) -> None:
    link = make(2)
    link.begin()
    moves = link.drive(0, 0, 1.0), link.drive(1, 0, 1.0)
    link.until(lambda: moves[0]() | moves[1]() or min(link.actual(i)[0] for i in range(2)) > 0.2)
    link.data.close()
    right = link.arms[1]
    link.arms = [right]
    link.data = right  # type: ignore[assignment]
    link.until(lambda: link.state() == (DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION))
    assert isinstance(right, SharedUnitData)
    assert right.problem == "no message from the platform left, which holds the connection to the controller"
    link.until(link.rests, 2.0)


def test_the_loss_of_the_connection_is_said_on_both_platforms(make: Callable[..., Link]) -> None:
    link = make(2)
    link.begin()
    link.cable.is_cut = True
    lost = DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION
    link.until(lambda: link.state(0) == link.state(1) == lost, 2.0)
    right = link.arms[1]
    assert isinstance(right, SharedUnitData)
    link.cable.is_cut = False
    link.commands = [STAND, STAND]
    link.until(lambda: link.state(0) == link.state(1) == READY)
