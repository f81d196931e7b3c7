from __future__ import annotations

import math
import struct
from itertools import groupby
from math import ceil

import pytest

from rtcp.config.model import BITS, DataTypeName, integer_range
from rtcp.devices import Cia402Drive, DeviceError, DriveState
from rtcp.devices import TargetState as T

from .conftest import FACTOR, RPDO, TPDO, Channel, Wire, slave

S = DriveState
DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP = 0x0250, 0x0231, 0x0233, 0x0237, 0x0217
FAULT_REACTION, FAULT = 0x021F, 0x0218


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x0000, S.NOT_READY_TO_SWITCH_ON), (0x0220, S.NOT_READY_TO_SWITCH_ON), (0x0040, S.SWITCH_ON_DISABLED),
        (DISABLED, S.SWITCH_ON_DISABLED), (0x0060, S.SWITCH_ON_DISABLED), (READY, S.READY_TO_SWITCH_ON),
        (SWITCHED_ON, S.SWITCHED_ON), (ENABLED, S.OPERATION_ENABLED), (0x1637, S.OPERATION_ENABLED),
        (QUICK_STOP, S.QUICK_STOP_ACTIVE), (FAULT_REACTION, S.FAULT_REACTION_ACTIVE), (0x023F, S.FAULT_REACTION_ACTIVE),
        (FAULT, S.FAULT), (0x0238, S.FAULT), (0x0001, S.UNKNOWN), (0x0061, S.UNKNOWN),
    ],
)  # fmt: skip
def test_the_statusword_tells_the_state(drive: Cia402Drive, wire: Wire, word: int, state: DriveState) -> None:
    wire.receive(word)
    assert drive.state is state


def test_no_goal_but_enabling_gives_torque_and_no_state_leaves_a_drive_without_a_controlword(
    drive: Cia402Drive, wire: Wire
) -> None:
    for word in range(0x80):
        for goal in T:
            wire.receive(word)
            drive.advance(goal)
            sent = wire.sent()[0]
            # 0x0F: enable operation; 0x02: quick stop; 0x80: fault reset.
            assert sent in (0x00, 0x02, 0x06, 0x07, 0x0F, 0x80)
            assert goal is T.ENABLED or sent != 0x0F
            assert (sent == 0x02) is (goal is T.QUICK_STOPPED)
            assert goal is not T.TORQUE_OFF or sent == 0x00
            assert sent != 0x80 or (goal is T.RESET and drive.state is S.FAULT)


@pytest.mark.parametrize(
    ("goal", "steps"),
    [
        (T.ENABLED, [(DISABLED, 0x06), (READY, 0x07), (SWITCHED_ON, 0x0F), (ENABLED, 0x0F)]),
        (T.DISABLED, [(ENABLED, 0x07), (SWITCHED_ON, 0x06), (READY, 0x00), (DISABLED, 0x00)]),
        (T.RESET, [(FAULT_REACTION, 0x00), (FAULT, 0x80), (DISABLED, 0x00)]),
        (T.ENABLED, [(FAULT, 0x00), (FAULT, 0x00), (FAULT, 0x00)]),
        (T.ENABLED, [(QUICK_STOP, 0x0F), (ENABLED, 0x0F)]),
    ],
)
def test_each_step_is_decided_by_the_state_found(
    drive: Cia402Drive, wire: Wire, goal: T, steps: list[tuple[int, int]]
) -> None:
    for status, control in steps:
        wire.receive(status)
        drive.advance(goal)
        assert wire.sent()[0] == control


def test_a_drive_that_stays_where_it_is_gets_the_same_step_again(drive: Cia402Drive, wire: Wire) -> None:
    for _ in range(20):
        wire.receive(READY)
        assert not drive.advance(T.ENABLED)
        assert wire.sent()[0] == 0x07


@pytest.mark.parametrize(
    ("goal", "status", "reached"),
    [
        (T.ENABLED, ENABLED, True), (T.ENABLED, SWITCHED_ON, False), (T.ENABLED, FAULT, False),
        (T.DISABLED, DISABLED, True), (T.DISABLED, ENABLED, False), (T.DISABLED, FAULT, True),
        (T.DISABLED, QUICK_STOP, False), (T.RESET, FAULT, False), (T.RESET, DISABLED, True),
    ],
)  # fmt: skip
def test_advance_tells_whether_the_goal_is_reached(
    drive: Cia402Drive, wire: Wire, goal: T, status: int, reached: bool
) -> None:
    wire.receive(status)
    assert drive.advance(goal) is reached


@pytest.mark.parametrize("pulse_s", [0.01, 0.2])
@pytest.mark.parametrize("period_s", [0.00025, 0.001, 0.004, 0.033])
def test_the_fault_reset_is_a_pulse_of_a_given_time_for_any_cycle_and_is_repeated(
    period_s: float, pulse_s: float
) -> None:
    drive = Cia402Drive(slave(), period_s)
    drive.reset_pulse_s = pulse_s
    words = []
    for _ in range(5 * ceil(pulse_s / period_s)):
        drive.decode(struct.pack("<Hiiib", FAULT, 0, 0, 0, 8))
        drive.advance(T.RESET)
        words.append(drive.controlword)
    pulses = [(word, len(list(group)) * period_s) for word, group in groupby(words)]
    assert [word for word, _ in pulses[:4]] == [0x80, 0x00, 0x80, 0x00]
    assert all(pulse_s - 1e-9 <= length < pulse_s + period_s for _, length in pulses[:4])


def test_the_target_follows_the_position_until_the_drive_is_enabled(drive: Cia402Drive, wire: Wire) -> None:
    for status, position in ((DISABLED, 100), (READY, 200), (SWITCHED_ON, 300)):
        wire.receive(status, position)
        assert wire.sent()[1] == position
        drive.advance(T.ENABLED)


def test_the_target_is_latched_once_on_the_step_to_operation_enabled(drive: Cia402Drive, wire: Wire) -> None:
    wire.receive(SWITCHED_ON, 12345)
    drive.advance(T.ENABLED)
    sent = [wire.sent()[1]]
    # The arm sags by a count a cycle: a copied target would sag with it.
    for position in range(12344, 12300, -1):
        wire.receive(SWITCHED_ON if position > 12340 else ENABLED, position)
        drive.advance(T.ENABLED)
        sent.append(wire.sent()[1])
    assert set(sent) == {12345}


def test_the_target_is_latched_anew_after_a_fault_reset(drive: Cia402Drive, wire: Wire) -> None:
    for status, position, goal in (
        (SWITCHED_ON, 1000, T.ENABLED), (ENABLED, 1000, T.ENABLED), (FAULT, 4000, T.ENABLED),
        (FAULT, 5000, T.RESET), (DISABLED, 6000, T.ENABLED), (READY, 7000, T.ENABLED),
        (SWITCHED_ON, 8000, T.ENABLED), (ENABLED, 8001, T.ENABLED),
    ):  # fmt: skip
        wire.receive(status, position)
        drive.advance(goal)
    assert wire.sent()[:2] == (0x0F, 8000)


def test_the_target_is_latched_anew_when_the_drive_left_the_enabled_state_on_its_own(
    drive: Cia402Drive, wire: Wire
) -> None:
    for status, position in ((SWITCHED_ON, 1000), (ENABLED, 1000), (SWITCHED_ON, 9000), (ENABLED, 9001)):
        wire.receive(status, position)
        drive.advance(T.ENABLED)
    assert wire.sent()[1] == 9000


def test_latching_forgets_a_velocity_and_a_torque_of_before(drive: Cia402Drive, wire: Wire) -> None:
    drive.target_velocity, drive.target_torque = 1.0, 5.0
    wire.receive(SWITCHED_ON)
    drive.advance(T.ENABLED)
    assert (drive.target_velocity, drive.target_torque) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("mode", "velocity", "torque"), [(8, 5000, 0), (9, 2500, 0), (10, 0, 12_0000), (1, 0, 0), (0, 0, 0)]
)
def test_each_mode_sends_its_own_fields(drive: Cia402Drive, wire: Wire, mode: int, velocity: int, torque: int) -> None:
    drive.mode, drive.target_velocity, drive.target_torque = mode, 0.25, 12.0
    wire.receive(ENABLED, mode=mode)
    drive.controlword = 0x0F
    assert wire.sent()[2:] == (velocity, torque, mode)


@pytest.mark.parametrize("commanded", [8, 9, 10])
@pytest.mark.parametrize("displayed", [0, 1, 3, 6, 8, 9, 10])
def test_no_speed_is_sent_to_a_drive_in_another_mode_and_torque_only_on_the_way_to_cst(
    drive: Cia402Drive, wire: Wire, commanded: int, displayed: int
) -> None:
    drive.mode, drive.target_velocity, drive.target_torque = commanded, 0.25, 12.0
    wire.receive(ENABLED, mode=displayed)
    drive.controlword = 0x0F
    _, _, velocity, torque, mode = wire.sent()
    assert mode == commanded
    # A drive in CST uses neither, and needs them when it changes.
    assert velocity == 0 or displayed in (commanded, 10)
    assert torque == (12_0000 if commanded == 10 else 0)


def test_a_quick_stop_is_held_and_sends_neither_speed_nor_torque(drive: Cia402Drive, wire: Wire) -> None:
    for mode in (8, 9, 10):
        drive.mode, drive.target_velocity, drive.target_torque = mode, 0.25, 12.0
        for status in (ENABLED, QUICK_STOP, QUICK_STOP):
            wire.receive(status, mode=mode)
            drive.advance(T.QUICK_STOPPED)
            assert wire.sent()[0] == 0x02
            assert wire.sent()[2:4] == (0, 0)


@pytest.mark.parametrize("status", [DISABLED, FAULT])
def test_a_drive_without_torque_has_reached_its_quick_stop(drive: Cia402Drive, wire: Wire, status: int) -> None:
    wire.receive(status)
    assert drive.advance(T.QUICK_STOPPED)


def test_a_quick_stop_is_sent_whatever_the_statusword_says(drive: Cia402Drive, wire: Wire) -> None:
    # The statusword may be wrong and the drive enabled: any other controlword would take its torque.
    for word in range(0x80):
        wire.receive(word)
        drive.advance(T.QUICK_STOPPED)
        assert wire.sent()[0] == 0x02


@pytest.mark.parametrize("status", [DISABLED, READY, SWITCHED_ON, QUICK_STOP, FAULT])
def test_no_speed_and_no_torque_is_sent_to_a_drive_that_is_not_enabled(
    drive: Cia402Drive, wire: Wire, status: int
) -> None:
    for mode in (8, 9, 10):
        drive.mode, drive.target_velocity, drive.target_torque = mode, 0.25, 12.0
        wire.receive(status, mode=mode)
        assert wire.sent()[2:4] == (0, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_target_that_is_no_number_leaves_what_was_sent(drive: Cia402Drive, wire: Wire, bad: float) -> None:
    wire.receive(SWITCHED_ON, 700)
    drive.advance(T.ENABLED)
    drive.mode = 9
    wire.receive(ENABLED, mode=9)
    drive.advance(T.ENABLED)
    drive.target_velocity = 0.1
    assert wire.sent()[1:3] == (700, 1000)
    drive.target_position = drive.target_velocity = bad
    assert wire.sent()[1:3] == (700, 1000)


@pytest.mark.parametrize(("target", "counts"), [(1e9, 2**31 - 1), (-1e9, -(2**31)), (214748.3647, 2**31 - 1)])
def test_a_target_out_of_the_field_is_cut_to_it(drive: Cia402Drive, wire: Wire, target: float, counts: int) -> None:
    wire.receive(ENABLED)
    drive.target_position = target
    assert wire.sent()[1] == counts


@pytest.mark.parametrize("kind", ["int16", "uint16", "int32", "uint32", "int64", "uint64"])
def test_targets_of_each_width_are_exact_within_it_and_cut_to_its_ends(kind: DataTypeName) -> None:
    bits, signed = BITS[kind], kind.startswith("int")
    low, high = integer_range(kind)
    as_sent: tuple[Channel, ...] = tuple(
        (name, index, kind if name.startswith("target") else own, factor) for name, index, own, factor in RPDO
    )
    shown: tuple[Channel, ...] = tuple((name, i, kind if name == "position" else own, f) for name, i, own, f in TPDO)
    drive = Cia402Drive(slave(as_sent, shown), 0.001, speed_limit=1e30)
    drive.mode, drive.controlword = 9, 0x0F

    def sent(count: float) -> tuple[int, int]:
        """Return the position and the velocity that the drive gets, for a target in counts."""
        inputs = struct.pack("<H", ENABLED) + min(max(round(count), low), high).to_bytes(
            bits // 8, "little", signed=signed
        )
        drive.decode(inputs + struct.pack("<iib", 0, 0, 9))
        drive.target_position = drive.target_velocity = count * FACTOR
        fields = drive.encode()[2:]
        return tuple(int.from_bytes(fields[at : at + bits // 8], "little", signed=signed) for at in (0, bits // 8))  # type: ignore[return-value]

    for count in (1, 30_000, high // 3 if bits < 64 else 2**40, -1 if signed else 0, -30_000 if signed else 0):
        assert sent(count) == (count, count)
    assert sent(4.0 * high) == (high, high)
    assert sent(-4.0 * high) == (low, low)


def test_values_are_in_si_units(drive: Cia402Drive, wire: Wire) -> None:
    wire.receive(ENABLED, 12345, -678, 90)
    assert (drive.position, drive.velocity, drive.torque) == pytest.approx((1.2345, -0.0678, 0.009))


def test_widths_and_order_are_those_of_the_description() -> None:
    tpdo: tuple[Channel, ...] = (
        ("torque", 0x6077, "int16", 0.1),
        TPDO[0],
        ("temperature", 0x2000, "int16", 0.1),
        *TPDO[1:3],
        TPDO[4],
    )
    rpdo: tuple[Channel, ...] = (
        RPDO[4],
        ("target_torque", 0x6071, "int16", 0.1),
        *RPDO[:3],
        ("offset", 0x60B1, "int32", 1.0),
    )
    drive = Cia402Drive(slave(rpdo, tpdo), 0.001)
    drive.decode(struct.pack("<hHhiib", -5, ENABLED, -125, 20000, 1, 10))
    assert (drive.torque, drive.temperature, drive.position) == pytest.approx((-0.5, -12.5, 2.0))
    drive.mode, drive.target_torque, drive.target_position, drive.controlword = 10, 3.0, 2.0, 0x0F
    assert drive.encode() == struct.pack("<bhHiii", 10, 30, 0x0F, 20000, 0, 0)


def test_missing_channels_are_all_named_at_the_start() -> None:
    with pytest.raises(DeviceError, match=r"`rpdo` maps no target_position; kind cia402"):
        Cia402Drive(slave(rpdo=RPDO[:1]), 0.001)


CSP_ONLY = slave((*RPDO[:2], RPDO[4]), (*TPDO[:2], TPDO[4]))


def test_a_drive_with_the_entries_of_csp_alone_is_driven_in_csp() -> None:
    drive = Cia402Drive(CSP_ONLY, 0.001, speed_limit=0.5)
    for status in (SWITCHED_ON, ENABLED, ENABLED):
        drive.decode(struct.pack("<Hib", status, 10000, 8))
        drive.advance(T.ENABLED)
    drive.target_position = 1.5
    assert drive.encode() == struct.pack("<Hib", 0x0F, 15000, 8)
    assert [drive.supports(mode) for mode in (8, 9, 10)] == [True, False, False]


def test_a_drive_that_does_not_show_its_mode_is_always_sent_csp() -> None:
    drive = Cia402Drive(slave(tpdo=TPDO[:4]), 0.001, speed_limit=0.5)
    assert [drive.supports(mode) for mode in (8, 9, 10)] == [True, False, False]
    assert not drive.changes_mode
    for status in (SWITCHED_ON, ENABLED):
        drive.decode(struct.pack("<Hiii", status, 10000, 0, 0))
        assert drive.encode()[-1] == 8
        drive.advance(T.ENABLED)
    assert drive.mode_display == 8


def test_a_drive_without_a_mode_in_its_pdos_stays_in_csp() -> None:
    drive = Cia402Drive(slave(RPDO[:4], TPDO[:4]), 0.001, speed_limit=0.5)
    assert [drive.supports(mode) for mode in (8, 9, 10)] == [True, False, False]
    for status in (SWITCHED_ON, ENABLED, ENABLED):
        drive.decode(struct.pack("<Hiii", status, 10000, 0, 0))
        drive.advance(T.ENABLED)
    assert (drive.changes_mode, drive.mode_display, drive.mode) == (False, 8, 8)
    assert drive.encode() == struct.pack("<Hiii", 0x0F, 10000, 5000, 0)


def test_the_speed_limit_is_positive_where_the_joint_turns_against_the_drive() -> None:
    reversed_ = [(name, index, kind, -factor if factor == FACTOR else factor) for name, index, kind, factor in RPDO]
    drive = Cia402Drive(slave(reversed_), 0.001, speed_limit=0.5)
    drive.controlword = 0x0F
    drive.decode(struct.pack("<Hiiib", ENABLED, 0, 0, 0, 8))
    drive.target_position = 0.1
    assert struct.unpack("<Hiiib", drive.encode())[1:3] == (-1000, 5000)
    drive.mode, drive.target_velocity = 9, 0.25
    drive.decode(struct.pack("<Hiiib", ENABLED, 0, 0, 0, 9))
    assert struct.unpack("<Hiiib", drive.encode())[2] == -2500


def test_a_velocity_that_is_not_mapped_is_the_mean_over_20_ms() -> None:
    drive = Cia402Drive(CSP_ONLY, 0.0005)
    for cycle in range(200):
        drive.decode(struct.pack("<Hib", ENABLED, 70000 + 3 * cycle, 8))
        if cycle == 0:
            assert drive.velocity == 0.0
    assert drive.velocity == pytest.approx(3 * 1e-4 / 0.0005)
    for _ in range(41):
        drive.decode(struct.pack("<Hib", ENABLED, 70597, 8))
    assert (drive.velocity, drive.torque) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("without", "modes"),
    [("target_velocity", [8, 10]), ("velocity", [8]), ("target_torque", [8, 9]), ("torque", [8, 9])],
)
def test_a_drive_serves_the_modes_whose_entries_it_maps(without: str, modes: list[int]) -> None:
    rpdo, tpdo = ([row for row in rows if row[0] != without] for rows in (RPDO, TPDO))
    drive = Cia402Drive(slave(tuple(rpdo), tuple(tpdo)), 0.001)
    assert [mode for mode in (8, 9, 10) if drive.supports(mode)] == modes


@pytest.mark.parametrize("factor", [FACTOR, -FACTOR])
@pytest.mark.parametrize("zero", [0.00006, -0.00006, 0.0])
@pytest.mark.parametrize("edge", [3.1, -3.1, 1.00004])
def test_a_target_at_the_end_of_the_range_is_rounded_inward(factor: float, zero: float, edge: float) -> None:
    rpdo = [(name, index, kind, factor if index == 0x607A else scale) for name, index, kind, scale in RPDO]
    drive = Cia402Drive(slave(rpdo), 0.001, zero=zero)
    drive.low, drive.high = (-4.0, edge) if edge > 0.0 else (edge, 4.0)
    wire = Wire(drive)
    wire.receive(ENABLED)
    drive.target_position = edge
    sent = wire.sent()[1] * factor - zero
    assert drive.low - 1e-9 <= sent <= drive.high + 1e-9
    assert sent == pytest.approx(edge, abs=FACTOR)


def test_a_velocity_and_a_torque_are_rounded_towards_zero(drive: Cia402Drive, wire: Wire) -> None:
    for mode, sign in ((9, 1), (9, -1), (10, 1), (10, -1)):
        drive.mode = mode
        wire.receive(ENABLED, mode=mode)
        drive.advance(T.ENABLED)
        drive.target_velocity = drive.target_torque = sign * 0.33338
        assert (wire.sent()[2] if mode == 9 else wire.sent()[3]) == sign * 3333
