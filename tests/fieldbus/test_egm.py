"""The EGM bus on real sockets: messages are encoded and replies decoded without the product's code."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.config import default_config, load
from rtcp.config.buses import EgmBus
from rtcp.config.loader import widen
from rtcp.config.model import ArmConfig
from rtcp.control.operator import Operator
from rtcp.devices.driver import make_driver
from rtcp.fieldbus.egm import EgmData, EgmMaster
from rtcp.fieldbus.errors import BusError
from rtcp.ipc.states import DriveState, Missing
from tests.virtual.irc5.wire import doubles, entry, parse

CONFIG = load(default_config().parent / "abb_irb120.yaml")
AT = (10.0, -20.0, 30.0, -40.0, 50.0, -60.0)
"""Degrees."""
STAND, FOLLOW, STOP = 0, 1, 2
ON, OFF = 1, 2
ERROR, STOPPED, RUNNING = 1, 2, 3
COUNTS = ("session", "lost", "doubled", "disordered", "superseded", "foreign")


def message(
    seqno: int, joints: Sequence[float] = AT, *, external: Sequence[float] = (), clock_us: int | None = None,
    motors: int = ON, rapid: int = 2, mci: int = RUNNING, collision: bool = False, mtype: int = 2,
    force: bytes = b"",
) -> bytes:  # fmt: skip
    """Return an EgmRobot. `clock_us`: the controller's clock, by default 4 ms a message; negative: no `time`."""
    us = 4000 * seqno if clock_us is None else clock_us
    pose = entry(1, entry(1, 374.0) + entry(2, 0.0) + entry(3, 630.0))
    part = entry(1, doubles(1, joints)) + entry(2, pose)
    part += entry(3, doubles(1, external)) if external else b""
    part += entry(4, entry(1, us // 1_000_000) + entry(2, us % 1_000_000)) if us >= 0 else b""
    return (
        entry(1, entry(1, seqno) + entry(2, 7) + entry(3, mtype))
        + entry(2, part)
        + entry(3, part)
        + entry(4, entry(1, motors))
        + entry(5, entry(1, mci))
        + entry(6, 0)
        + entry(8, entry(1, rapid))
        + (entry(9, force) if force else b"")
        + entry(10, 12.5)
        + entry(11, 3)
        + entry(12, entry(1, int(collision)))
    )


class Reply:
    """A decoded EgmSensor: degrees and degrees/s, the external joint last."""

    def __init__(self, datagram: bytes) -> None:
        fields = parse(datagram)
        header = parse(fields[1][0])
        self.seqno, self.mtype = header[1][0], header[3][0]
        self.position, self.speed = self._joints(fields[2][0]), self._joints(fields[3][0])

    @staticmethod
    def _joints(part: bytes) -> list[float]:
        fields = parse(part)
        joints: list[float] = parse(fields[1][0])[1]
        return joints + (parse(fields[3][0])[1] if 3 in fields else [])


class Wire:
    """The bus of an arm, and the controller's socket."""

    def __init__(self, axes: int = 6, **keys: Any) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        joints = (*CONFIG.joints, *(replace(CONFIG.joints[0], name=f"more_{i}") for i in range(axes - 6)))
        assert isinstance(CONFIG.bus, EgmBus)
        self.config: ArmConfig = replace(
            CONFIG, joints=joints, bus=replace(CONFIG.bus, port=port, **{"lost_cycles": 1000, **keys})
        )
        self.master = EgmMaster(self.config, "virtual", 0)
        self.data: EgmData = self.master.start(Path(), lambda sentence: None)
        self.axes = axes
        self.address = ("127.0.0.1", port)
        self.robot = self.other()

    def other(self) -> socket.socket:
        """Return the socket of another sender."""
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind(("127.0.0.1", 0))
        made.setblocking(False)
        return made

    def close(self) -> None:
        self.master.close()
        self.robot.close()

    def command(self, positions: Sequence[float], speeds: Sequence[float], command: int = FOLLOW) -> None:
        """Set the targets of the next reply: rad, rad/s."""
        for i, (position, speed) in enumerate(zip(positions, speeds, strict=True)):
            self.data.set_output(i, struct.pack("<ddB", position, speed, command))

    def cycle(self, *datagrams: bytes, sender: socket.socket | None = None) -> Reply | None:
        """Send to the bus, run a cycle, and return its reply; more than one is an error."""
        for datagram in datagrams:
            (sender or self.robot).sendto(datagram, self.address)
        self.data.receive()
        self.data.send()
        replies = self.replies()
        assert len(replies) <= 1
        return Reply(replies[0]) if replies else None

    def follow(self) -> None:
        """Begin a session and command its joints."""
        self.cycle(message(0))
        self.command([0.5] * 6, [0.3] * 6)
        self.cycle(message(1))

    def reply(self, *datagrams: bytes) -> Reply:
        """Run a cycle that is answered."""
        reply = self.cycle(*datagrams)
        assert reply is not None
        return reply

    def replies(self) -> list[bytes]:
        """Return all datagrams that wait at the controller."""
        datagrams = []
        while True:
            try:
                datagrams.append(self.robot.recv(2048))
            except BlockingIOError:
                return datagrams

    def states(self) -> list[DriveState]:
        return [DriveState(struct.unpack("<dBBd", self.data.input(i))[1]) for i in range(self.axes)]

    def missing(self) -> Missing:
        return Missing(struct.unpack("<dBBd", self.data.input(0))[2])

    def counts(self) -> dict[str, int]:
        values = struct.unpack("<5BdI6I9db", self.data.input(self.axes))
        return dict(zip(COUNTS, values[7:13], strict=True))


@pytest.fixture
def wire() -> Iterator[Wire]:
    made = Wire()
    yield made
    made.close()


def new_wire(axes: int = 6, **keys: Any) -> Iterator[Wire]:
    made = Wire(axes, **keys)
    yield made
    made.close()


# -- replies -----------------------------------------------------------------------------------------------------------


def test_a_reply_is_these_bytes(wire: Wire) -> None:
    wire.cycle(message(0))
    wire.command([math.pi / 2, -math.pi / 4, 0.0, 0.0, 0.0, 0.0], [math.pi / 180, -math.pi / 360, 0, 0, 0, 0])
    wire.robot.sendto(message(1), wire.address)
    assert wire.data.receive() == 1
    wire.data.send()
    (reply,) = wire.replies()
    header = parse(parse(reply)[1][0])
    wanted = (
        entry(1, entry(1, 2) + entry(2, header[2][0]) + entry(3, 3))
        + entry(2, entry(1, doubles(1, (90.0, -45.0, 0.0, 0.0, 0.0, 0.0))))
        + entry(3, entry(1, doubles(1, (1.0, -0.5, 0.0, 0.0, 0.0, 0.0))))
    )
    assert reply == wanted


def test_a_joint_without_a_command_is_answered_with_where_it_stands(wire: Wire) -> None:
    wire.command([0.0] * 6, [0.3] * 6, STAND)
    for seqno in range(3):
        reply = wire.reply(message(seqno))
        assert reply.position == pytest.approx(AT)
        assert reply.speed == [0.0] * 6


def test_a_ramp_to_rest_is_sent_as_targets_are(wire: Wire) -> None:
    wire.cycle(message(0))
    wire.command([0.1] * 6, [0.2] * 6, STOP)
    reply = wire.reply(message(1))
    assert reply.position == pytest.approx([math.degrees(0.1)] * 6)
    assert reply.speed == pytest.approx([math.degrees(0.2)] * 6)


def test_after_a_command_the_joint_stands_at_the_last_reference(wire: Wire) -> None:
    wire.cycle(message(0))
    wire.command([0.1] * 6, [0.2] * 6)
    wire.cycle(message(1))
    wire.command([0.5] * 6, [0.2] * 6, STAND)
    reply = wire.reply(message(2))
    assert reply.position == pytest.approx([math.degrees(0.1)] * 6)
    assert reply.speed == [0.0] * 6


def test_the_external_joint_is_the_third() -> None:
    for wire in new_wire(7):
        assert wire.cycle(message(0, external=(70.0,))) is not None
        positions = [math.degrees(struct.unpack("<dBBd", wire.data.input(i))[0]) for i in range(7)]
        assert positions == pytest.approx([10.0, -20.0, 70.0, 30.0, -40.0, 50.0, -60.0])
        wire.command([math.radians(value) for value in range(7)], [math.radians(-value) for value in range(7)])
        reply = wire.reply(message(1, external=(70.0,)))
        assert reply.position == pytest.approx([0, 1, 3, 4, 5, 6, 2])
        assert reply.speed == pytest.approx([0, -1, -3, -4, -5, -6, -2])


def test_there_is_one_reply_to_what_waits_and_it_follows_the_newest(wire: Wire) -> None:
    newest = tuple(value + 2.0 for value in AT)
    reply = wire.reply(message(0), message(1), message(2, newest))
    assert reply.position == pytest.approx(newest)
    assert wire.counts()["superseded"] == 2


def test_without_a_message_nothing_is_sent(wire: Wire) -> None:
    wire.cycle(message(0))
    assert wire.cycle() is None
    wire.data.send()
    assert wire.replies() == []


# -- states ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "state", "missing"),
    [
        ({"motors": OFF, "rapid": 1, "mci": STOPPED}, DriveState.SWITCH_ON_DISABLED, Missing.MOTORS),
        ({"rapid": 1, "mci": STOPPED}, DriveState.READY_TO_SWITCH_ON, Missing.PROGRAM),
        ({"mci": STOPPED}, DriveState.SWITCHED_ON, Missing.CONTROL),
        ({}, DriveState.OPERATION_ENABLED, Missing.NOTHING),
        ({"rapid": 0}, DriveState.OPERATION_ENABLED, Missing.NOTHING),
        ({"mci": ERROR}, DriveState.FAULT, Missing.CLEARANCE),
        ({"collision": True}, DriveState.FAULT, Missing.CLEARANCE),
        ({"motors": OFF, "mci": ERROR}, DriveState.FAULT, Missing.CLEARANCE),
    ],
)
def test_the_state_of_a_drive_is_that_of_the_controller(
    wire: Wire, fields: dict[str, Any], state: DriveState, missing: Missing
) -> None:
    wire.cycle(message(0))
    wire.cycle(message(1, **fields))
    assert wire.states() == [state] * 6
    assert wire.missing() is missing
    assert bool(wire.master.waiting_for()) is (missing is not Missing.NOTHING)


def test_silence_is_no_connection(wire: Wire) -> None:
    assert wire.missing() is Missing.CONNECTION
    wire.cycle(message(0))
    assert wire.master.connected
    wire.data._heard_ns -= 10**10
    assert wire.cycle() is None
    assert wire.states() == [DriveState.NOT_READY_TO_SWITCH_ON] * 6
    assert wire.missing() is Missing.CONNECTION
    assert not wire.master.connected


def test_who_speaks_after_a_silence_begins_a_session(wire: Wire) -> None:
    wire.cycle(message(5))
    wire.data._heard_ns -= 10**10
    wire.cycle()
    wire.command([0.0] * 6, [0.3] * 6)
    reply = wire.reply(message(6))
    assert reply.position == pytest.approx(AT)
    assert wire.counts()["session"] == 2


def test_after_a_stall_of_the_loop_what_waited_is_dropped_and_a_session_begins(wire: Wire) -> None:
    wire.follow()
    wire.data._called_ns -= 10**10
    assert wire.cycle(*(message(2 + i) for i in range(20))) is None
    assert wire.counts()["session"] == 1
    reply = wire.reply(message(22))
    assert (reply.position, reply.speed) == (pytest.approx(AT), [0.0] * 6)
    assert wire.states() == [DriveState.SWITCHED_ON] * 6
    assert wire.counts()["superseded"] == 20


def test_another_unit_that_speaks_after_a_silence_does_not_go_on_with_the_session(wire: Wire) -> None:
    wire.follow()
    wire.data._heard_ns -= 10**10  # no cycle has noticed it yet
    with wire.other() as other:
        other.sendto(message(40, (0.0,) * 6), wire.address)
        wire.data.receive()
        wire.data.send()
        reply = Reply(other.recv(2048))
    assert (reply.position, reply.speed) == ([0.0] * 6, [0.0] * 6)
    assert wire.states() == [DriveState.SWITCHED_ON] * 6


def test_a_stop_that_is_superseded_at_once_ends_the_motion_all_the_same(wire: Wire) -> None:
    wire.follow()
    reply = wire.reply(message(2, mci=STOPPED, motors=OFF), message(3))
    assert (reply.position, reply.speed) == (pytest.approx(AT), [0.0] * 6)
    assert wire.states() == [DriveState.SWITCHED_ON] * 6


@pytest.mark.parametrize(("interval_us", "missing"), [(4032, 0), (4000, 0), (8064, 6), (2016, 6)])
def test_a_controller_at_another_pace_than_the_cycle_is_not_followed(
    wire: Wire, interval_us: int, missing: int
) -> None:
    for seqno in range(60):
        wire.cycle(message(seqno, clock_us=interval_us * seqno))
    assert wire.missing() is Missing(missing)
    expected = DriveState.SWITCHED_ON if missing else DriveState.OPERATION_ENABLED
    assert wire.states() == [expected] * 6


def test_a_flood_of_messages_is_no_flood_of_cycles(wire: Wire) -> None:
    begun, cycles = time.monotonic_ns(), 50
    for seqno in range(cycles):
        assert wire.cycle(message(seqno)) is not None
    # A cycle takes at least half a period, however fast messages come.
    assert time.monotonic_ns() - begun >= (cycles - 1) * 2_016_000


def test_the_velocity_is_that_of_the_controllers_clock_whatever_is_lost(wire: Wire) -> None:
    for seqno in (*range(10), 14, 15, 19):
        wire.cycle(message(seqno, (0.04 * seqno,) * 6))
        if seqno:
            assert math.degrees(struct.unpack("<dBBd", wire.data.input(0))[3]) == pytest.approx(10.0)


# -- sessions and counts -----------------------------------------------------------------------------------------------


def test_the_first_reply_of_a_session_is_where_the_unit_stands(wire: Wire) -> None:
    wire.command([0.0] * 6, [0.3] * 6)
    first = wire.reply(message(0))
    assert (first.position, first.speed) == (pytest.approx(AT), [0.0] * 6)
    assert wire.states() == [DriveState.SWITCHED_ON] * 6
    second = wire.reply(message(1))
    assert second.position == [0.0] * 6


@pytest.mark.parametrize(("last", "first"), [(500, 0), (5, 0), (5, 1), (5, 3)])
def test_a_seqno_that_goes_back_with_a_newer_time_begins_a_session(wire: Wire, last: int, first: int) -> None:
    wire.cycle(message(last - 1))
    wire.command([0.0] * 6, [0.3] * 6)
    wire.cycle(message(last))
    moved = tuple(value + 3.0 for value in AT)
    reply = wire.reply(message(first, moved, clock_us=4000 * last + 20_000))
    assert (reply.position, reply.speed) == (pytest.approx(moved), [0.0] * 6)
    assert wire.states() == [DriveState.SWITCHED_ON] * 6
    assert wire.counts()["session"] == 2


@pytest.mark.parametrize("behind", [1, 8, 9, 25, 100])
def test_an_old_message_is_counted_and_nothing_more(wire: Wire, behind: int) -> None:
    wire.cycle(message(200))
    wire.cycle(message(201))
    assert wire.cycle(message(201 - behind, (0.0,) * 6)) is None
    assert wire.states() == [DriveState.OPERATION_ENABLED] * 6
    wire.cycle(message(202))
    assert wire.counts() == dict.fromkeys(COUNTS, 0) | {"session": 1, "disordered": 1}


def test_messages_that_are_lost_or_doubled_are_counted(wire: Wire) -> None:
    wire.cycle(message(0))
    wire.cycle(message(1), message(1))
    wire.cycle(message(4))
    assert wire.counts() == dict.fromkeys(COUNTS, 0) | {"session": 1, "doubled": 1, "lost": 2}


def test_a_count_begins_anew_after_its_largest_number(wire: Wire) -> None:
    wire.cycle(message(0))
    wire.cycle(message(0xFFFFFFFF, clock_us=1))
    wire.cycle(message(0, clock_us=2))
    wire.cycle(message(0xFFFFFFF0, clock_us=3))
    assert wire.counts()["lost"] == (0xFFFFFFFE + 0xFFFFFFEF) % 2**32


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"\xff" * 40,
        message(1)[:-30],
        message(1, clock_us=-1),
        message(1, mtype=3),
        message(1, mtype=17),
        message(1, AT[:5]),
        message(1, (*AT, 0.0)),
        message(1, (math.nan, *AT[1:])),
        message(1, (math.inf, *AT[1:])),
        message(1, (1e7, *AT[1:])),
    ],
    ids=["empty", "garbled", "cut", "no time", "from a PC", "no type", "5 joints", "7 joints", "nan", "inf", "large"],
)
def test_what_is_no_message_of_the_unit_is_counted_and_dropped(wire: Wire, datagram: bytes) -> None:
    wire.cycle(message(0))
    assert wire.cycle(datagram) is None
    assert wire.states() == [DriveState.SWITCHED_ON] * 6
    assert wire.cycle(message(1)) is not None
    assert wire.counts() == dict.fromkeys(COUNTS, 0) | {"session": 1, "foreign": 1}


def test_another_sender_is_foreign_while_the_controller_speaks(wire: Wire) -> None:
    wire.cycle(message(0))
    with wire.other() as other:
        assert wire.cycle(message(1, (0.0,) * 6), sender=other) is None
        with pytest.raises(BlockingIOError):
            other.recv(2048)
    assert wire.cycle(message(1)) is not None
    assert wire.counts()["foreign"] == 1


def test_only_the_controller_that_is_named_is_answered() -> None:
    for wire in new_wire(controller="192.0.2.1"):
        assert wire.cycle(message(0)) is None
        assert not wire.master.connected


def test_more_foreign_datagrams_than_a_cycle_reads_hide_no_message(wire: Wire) -> None:
    wire.cycle(message(0))
    for _ in range(100):
        wire.robot.sendto(b"\xff" * 20, wire.address)
    wire.robot.sendto(message(1), wire.address)
    assert wire.data.receive_until(2**62) == 1


def test_a_port_that_is_taken_is_named(wire: Wire) -> None:
    second = EgmMaster(wire.config, "virtual", 0)
    with pytest.raises(BusError, match=rf"UDP port {wire.address[1]} of 127.0.0.1 \(bus.port\) cannot be opened"):
        second.start(Path(), lambda sentence: None)
    second.close()


def test_an_address_of_another_host_is_named() -> None:
    EgmMaster.check_interface("127.0.0.1")
    with pytest.raises(BusError, match=r"address 192.0.2.1 \(`interface`\) is none of this host's"):
        EgmMaster.check_interface("192.0.2.1")


# -- at random ---------------------------------------------------------------------------------------------------------

LIMITS = [math.degrees(joint.position.max) for joint in CONFIG.joints]
STEP = st.one_of(
    st.tuples(st.just("next"), st.integers(1, 20)),
    st.tuples(st.just("old"), st.integers(0, 300)),
    st.tuples(st.just("session"), st.integers(0, 3)),
    st.tuples(st.just("foreign"), st.integers(0, 3)),
    st.tuples(st.just("garbled"), st.binary(max_size=100)),
    st.tuples(st.just("cut"), st.integers(0, 200)),
    st.tuples(st.just("flipped"), st.integers(0, 2**32)),
)
SHARE = st.floats(-1.0, 1.0)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(st.tuples(st.lists(STEP, max_size=4), SHARE, st.sampled_from([STAND, FOLLOW, STOP])), max_size=30))
def test_whatever_arrives_nothing_raises_and_no_reference_is_outside_the_limits(cycles: list[Any]) -> None:
    for wire in new_wire():
        seqno, clock = 0, 4000
        newest = message(0, clock_us=clock)
        with wire.other() as other:
            for steps, share, command in cycles:
                wire.command(
                    [math.radians(share * limit) for limit in LIMITS],
                    [share * joint.velocity for joint in CONFIG.joints],
                    command,
                )
                before = sum(wire.counts().values())
                flipped = False
                for kind, value in steps:
                    sender, datagram = wire.robot, newest
                    if kind == "next":
                        seqno, clock = seqno + value, clock + 4000
                        datagram = newest = message(seqno, clock_us=clock)
                    elif kind == "old":
                        datagram = message(max(seqno - value, 0), (0.0,) * 6, clock_us=max(clock - 4000 * value, 0))
                    elif kind == "session":
                        seqno, clock = value, clock + 20_000
                        datagram = newest = message(seqno, clock_us=clock)
                    elif kind == "foreign":
                        sender = other
                    elif kind == "garbled":
                        datagram = value
                    elif kind == "cut":
                        datagram = newest[:value]
                    else:
                        at = value % len(newest)
                        datagram = newest[:at] + bytes([newest[at] ^ 1 << value % 8]) + newest[at + 1 :]
                        flipped = True
                    sender.sendto(datagram, wire.address)
                reply = wire.cycle()
                assert sum(wire.counts().values()) >= before
                if flipped:  # it may be another valid position; on a wire, UDP's checksum rejects it
                    break
                if reply is None:
                    continue
                assert reply.mtype == 3
                for position, speed, limit, joint in zip(
                    reply.position, reply.speed, LIMITS, CONFIG.joints, strict=True
                ):
                    assert abs(position) <= limit + 1e-9
                    assert abs(speed) <= math.degrees(joint.velocity) + 1e-9


FORCE = (1.0, -2.0, 3.0, 0.1, 0.2, -0.3)


@pytest.mark.parametrize(
    ("encoded", "shown"),
    [
        (entry(1, 1) + doubles(2, FORCE), FORCE),
        (entry(1, 0) + doubles(2, FORCE), (math.nan,) * 6),
        (doubles(1, FORCE), FORCE),
        (doubles(1, (math.nan,) * 6), (math.nan,) * 6),
        (b"\xff", (math.nan,) * 6),
        (b"", (math.nan,) * 6),
    ],
    ids=["RobotWare 7", "no sensor active", "RobotWare 6.08", "no numbers", "garbled", "no sensor"],
)
def test_the_measured_force_is_read_in_the_form_of_both_versions(encoded: bytes, shown: Sequence[float]) -> None:
    wire = Wire()
    wire.cycle(message(0, force=encoded))
    assert struct.unpack("<5BdI6I9db", wire.data.input(6))[13:19] == pytest.approx(shown, nan_ok=True)
    wire.close()


@pytest.mark.parametrize(("motors", "powered"), [(ON, 1), (OFF, 0), (0, -1)])
def test_whether_the_motors_are_on_reaches_the_record_and_what_egm_does_not_tell_is_unknown(
    motors: int, powered: int
) -> None:
    wire = Wire()
    wire.cycle(message(0, motors=motors))
    unit = make_driver(wire.config.slaves[-1], 0.004)
    unit.decode(wire.data.input(6))
    operator = Operator(wire.config, {unit.name: unit}, None)
    assert (operator.drives_powered, operator.e_stopped, operator.operating_mode) == (powered, -1, -1)
    wire.close()


def test_a_controller_that_falls_silent_is_a_fault_at_the_third_missing_message() -> None:
    shipped = load(default_config().with_name("abb_irb120.yaml"))
    real = widen(replace(shipped, bus=replace(shipped.bus, interface="192.168.125.2")))
    assert real.bus.lost_cycles == 3
    # On the virtual bus a busy host is late by more.
    assert widen(shipped).bus.lost_cycles == 45
