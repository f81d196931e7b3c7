"""A drive that homes: against words on the wire, and against the model of the drive."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest

from rtcp.control.homing import ENDED, HOMING, SHOWN, START, Homing, HomingPhase, Shown
from rtcp.devices import Cia402Drive, DriveState, TargetState
from rtcp.virtual.models import create
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage

from .conftest import slave

PERIOD_S = 0.0005
ENABLED, SWITCHED_ON = 0x0237, 0x0233
REST, UNDER_WAY, FOUND, ATTAINED, FAILING, FAILED = 0x0637, 0x0237, 0x1237, 0x1637, 0x2237, 0x2637
LATE = 10
"""Cycles for which what a drive shows is not yet taken for an answer to the start."""
INDEX_PITCH = 2 * math.pi / 100
P = HomingPhase


# -- the words ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def homing(drive, wire) -> Homing:
    """A homing whose drive is in mode 6 and has just been given the start."""
    enabled(drive, wire)
    homing = Homing(PERIOD_S)
    homing.start(drive)
    wire.says(ENABLED, 700, mode=8)
    homing.step()
    wire.says(REST, 700, mode=6)
    homing.step()
    return homing


def enabled(drive, wire) -> None:
    for word in (SWITCHED_ON, ENABLED):
        wire.says(word, 700)
        drive.advance(TargetState.ENABLED)


def told(homing, wire, word: int, times: int = 1, position: int = 700, mode: int = 6, velocity: int = 0) -> HomingPhase:
    for _ in range(times):
        wire.says(word, position, velocity, mode=mode)
        homing.step()
    return homing.phase


def test_every_pattern_of_the_three_bits_says_something():
    assert set(SHOWN) == {high << 12 | low << 10 for high in range(4) for low in range(2)}
    assert {SHOWN[bits] for bits in SHOWN if bits & 0x2000} == {Shown.FAILED, Shown.FAILING}


def test_the_start_bit_rises_only_when_the_drive_shows_mode_6(drive, wire):
    enabled(drive, wire)
    homing = Homing(PERIOD_S)
    homing.start(drive)
    for _ in range(50):
        assert told(homing, wire, ENABLED, mode=8) is P.ENTERING
        assert (wire.hears()[0], wire.hears()[4]) == (0x0F, 6)
    assert told(homing, wire, REST) is P.SEARCHING
    assert wire.hears()[0] == START == 0x1F


def test_the_start_bit_stays_for_as_long_as_the_homing_is_under_way(homing, wire):
    for word in (REST, UNDER_WAY, FOUND, UNDER_WAY):
        assert told(homing, wire, word, 200) is P.SEARCHING
        assert wire.hears()[0] == START


@pytest.mark.parametrize("stale", [ATTAINED, FAILED, FAILING])
def test_what_an_earlier_homing_left_is_no_answer(homing, wire, stale):
    assert told(homing, wire, stale, LATE) is P.SEARCHING
    assert told(homing, wire, UNDER_WAY, 500) is P.SEARCHING
    assert told(homing, wire, ATTAINED) is P.LEAVING


def test_a_drive_at_its_home_goes_back_to_csp_with_its_place_as_target(homing, drive, wire):
    told(homing, wire, UNDER_WAY, 20, position=900)
    assert told(homing, wire, ATTAINED, position=-2500) is P.LEAVING
    for position in range(-2500, -2510, -1):
        # A target that were copied would sag with the drive.
        assert told(homing, wire, ATTAINED, position=position) is P.LEAVING
        control, target, speed, torque, mode = wire.hears()
        assert (control, target, speed, torque, mode) == (0x0F, -2500, 0, 0, 8)
        assert homing.position == pytest.approx(-0.25)
    assert told(homing, wire, ENABLED, position=-2510, mode=8) is P.HOMED
    assert homing.ended
    assert wire.hears()[:3] == (0x0F, -2500, 5000)


def test_the_set_point_stands_until_the_drive_is_in_mode_6(drive, wire):
    enabled(drive, wire)
    drive.target_position = drive.position + 0.01
    before = drive.target_position
    homing = Homing(PERIOD_S)
    homing.start(drive)
    for position in (700, 650):
        assert told(homing, wire, ENABLED, position=position, mode=8) is P.ENTERING
        assert homing.position == before
    told(homing, wire, REST, position=650)
    assert homing.position == drive.position


def test_a_drive_that_never_shows_mode_6_keeps_its_target(drive, wire):
    enabled(drive, wire)
    drive.target_position = drive.position + 0.01
    before = drive.target_position
    homing = Homing(PERIOD_S)
    homing.start(drive)
    told(homing, wire, ENABLED, 20, mode=8)
    homing.stop()
    told(homing, wire, ENABLED, 2000, mode=8)
    assert homing.phase is P.STOPPED
    assert (homing.position, drive.target_position) == (before, before)


def test_the_set_point_is_where_the_drive_is(homing, wire):
    for position in (700, 800, -100):
        told(homing, wire, UNDER_WAY, position=position)
        assert homing.position == pytest.approx(position * 1e-4)


@pytest.mark.parametrize("word", [FAILED, FAILING, 0x3237, 0x3637])
def test_a_homing_error_takes_the_start_bit_away_and_ends_in_csp(homing, wire, word):
    told(homing, wire, UNDER_WAY, 20)
    assert told(homing, wire, word, velocity=500) is P.STOPPING
    for _ in range(200):
        assert told(homing, wire, FAILING, velocity=500) is P.STOPPING
        assert (wire.hears()[0], wire.hears()[4]) == (0x0F, 6)
    assert told(homing, wire, FAILED) is P.LEAVING
    assert told(homing, wire, ENABLED, 2, mode=8) is P.FAILED
    assert homing.shown == word


def test_a_stop_takes_the_start_bit_away_and_waits_for_rest(homing, wire):
    told(homing, wire, UNDER_WAY, 20, velocity=500)
    homing.stop()
    assert told(homing, wire, UNDER_WAY, 100, velocity=500) is P.STOPPING
    assert (wire.hears()[0], wire.hears()[4]) == (0x0F, 6)
    assert told(homing, wire, REST) is P.LEAVING
    assert told(homing, wire, ENABLED, 2, mode=8) is P.STOPPED


def test_after_a_stop_the_target_is_where_the_drive_came_to_rest(homing, wire):
    told(homing, wire, UNDER_WAY, 20, position=900, velocity=500)
    homing.stop()
    for position in range(900, 950):
        told(homing, wire, UNDER_WAY, position=position, velocity=500)
        assert homing.position == pytest.approx(position * 1e-4)
    told(homing, wire, REST, position=955)
    told(homing, wire, ENABLED, 2, position=955, mode=8)
    assert wire.hears()[1] == 955
    assert homing.position == pytest.approx(0.0955)


def test_a_stop_at_the_home_changes_nothing(homing, wire):
    told(homing, wire, ATTAINED, LATE + 1)
    homing.stop()
    assert homing.phase is P.LEAVING
    assert told(homing, wire, ENABLED, 2, mode=8) is P.HOMED
    homing.stop()
    assert homing.phase is P.HOMED


def test_a_drive_that_knows_no_homing_stays_in_csp(drive, wire):
    enabled(drive, wire)
    homing = Homing(PERIOD_S)
    homing.start(drive)
    assert told(homing, wire, ENABLED, 1999, mode=8) is P.ENTERING
    assert told(homing, wire, ENABLED, 4, mode=8) is P.FAILED
    assert (homing.shown, homing.shown_mode) == (ENABLED, 8)
    assert (wire.hears()[0], wire.hears()[4]) == (0x0F, 8)


def test_a_drive_that_does_not_come_back_to_csp_is_stuck(homing, wire):
    assert told(homing, wire, ATTAINED, 2000) is P.LEAVING
    assert told(homing, wire, ATTAINED, 20) is P.STUCK


def test_a_drive_that_leaves_mode_6_by_itself_has_not_homed(homing, wire):
    told(homing, wire, UNDER_WAY, 20)
    # In CSP bit 12 says that the drive follows its targets.
    told(homing, wire, ATTAINED, 30, mode=8)
    assert homing.phase is P.STUCK


def test_a_search_without_end_fails(drive, wire):
    enabled(drive, wire)
    homing = Homing(PERIOD_S, longest_s=1.0)
    homing.start(drive)
    told(homing, wire, REST)
    assert told(homing, wire, UNDER_WAY, 2000) is P.SEARCHING
    assert told(homing, wire, UNDER_WAY, 2) is P.STOPPING
    assert told(homing, wire, REST, 20) is P.LEAVING
    assert told(homing, wire, ENABLED, 2, mode=8) is P.FAILED


def test_a_drive_that_is_let_go_is_in_csp_when_it_is_enabled_again(homing, drive, wire):
    told(homing, wire, UNDER_WAY, 20)
    homing.abandon()
    assert homing.ended
    told(homing, wire, UNDER_WAY, 3)
    drive.advance(TargetState.QUICK_STOPPED)
    assert (wire.hears()[0], wire.hears()[4]) == (0x02, 8)


def test_a_homing_can_follow_another(homing, drive, wire):
    told(homing, wire, ATTAINED, LATE + 1)
    told(homing, wire, ENABLED, 2, mode=8)
    homing.start(drive)
    assert not homing.ended
    assert told(homing, wire, ENABLED, position=750, mode=8) is P.ENTERING
    assert homing.position == pytest.approx(0.07)
    assert told(homing, wire, REST) is P.SEARCHING
    told(homing, wire, FAILED, LATE + 1)
    told(homing, wire, FAILED, 20)
    assert told(homing, wire, ENABLED, 2, mode=8) is P.FAILED


def test_nothing_happens_before_the_start():
    homing = Homing(PERIOD_S)
    homing.stop()
    homing.abandon()
    assert homing.step() is P.IDLE
    assert homing.position == 0.0


# -- the drive ---------------------------------------------------------------------------------------------------------


class Line:
    """The driver and the model of a drive, with the bus's two cycles in between."""

    def __init__(self, zero: float = 0.0, **options: object) -> None:
        self.model = create("cubemars-orh60", load_inertia=0.05, **options)
        self.model.set_outputs_valid(True)
        self.model.step(0.2)
        self._rx = PdoImage.from_assignment(self.model.objects, RX_ASSIGN)
        self._tx = PdoImage.from_assignment(self.model.objects, TX_ASSIGN)
        self.drive = Cia402Drive(slave(), 0.001, speed_limit=0.5, zero=zero)
        self._on_the_way = [self._packed()] * 2
        self.cycle()
        while not self.drive.advance(TargetState.ENABLED):
            self.cycle()

    def __setitem__(self, key: tuple[int, int], value: int) -> None:
        self.model.objects[key].value = value

    def _packed(self) -> bytes:
        data = bytearray(self._tx.byte_length)
        self._tx.pack(data)
        return bytes(data)

    def cycle(self) -> None:
        self._rx.unpack(self.drive.encode())
        self.model.step(PERIOD_S)
        self._on_the_way.append(self._packed())
        self.drive.decode(self._on_the_way.pop(0))

    def home(self, homing: Homing, seconds: float = 10.0) -> Iterator[HomingPhase]:
        homing.start(self.drive)
        for _ in range(round(seconds / PERIOD_S)):
            self.cycle()
            yield homing.step()
            if homing.phase in ENDED:
                return
        raise AssertionError(f"not within {seconds} s: {homing.phase}")

    @property
    def still(self) -> bool:
        return abs(self.model.mechanics.velocity) < 0.002


Maker = Callable[..., Line]


@pytest.fixture
def line() -> Maker:
    return Line


def run(line: Line, homing: Homing) -> list[HomingPhase]:
    return list(line.home(homing))


@pytest.mark.parametrize("method", [35, 37])
@pytest.mark.parametrize("home_offset", [0, -2500, 12345])
def test_where_it_stands_becomes_its_home(line: Maker, method: int, home_offset: int) -> None:
    one = line(initial_position=0.7)
    one[0x6098, 0], one[0x607C, 0] = method, home_offset
    before = one.model.mechanics.position
    assert run(one, Homing(PERIOD_S))[-1] is P.HOMED
    assert one.drive.position == pytest.approx(home_offset * 1e-4, abs=2e-4)
    assert one.model.mechanics.position == pytest.approx(before, abs=2e-4)


@pytest.mark.parametrize(("method", "turns"), [(33, 4), (34, 5)])
def test_the_next_index_in_its_direction_becomes_its_home(line: Maker, method: int, turns: int) -> None:
    one = line(initial_position=4.5 * INDEX_PITCH)
    one[0x6098, 0], one[0x607C, 0] = method, 1000
    assert run(one, Homing(PERIOD_S))[-1] is P.HOMED
    home = one.model.mechanics.position - one.drive.position + 0.1
    assert home == pytest.approx(turns * INDEX_PITCH, abs=2e-4)


@pytest.mark.parametrize("method", [33, 34, 35, 37])
def test_the_zero_offset_counts_on_from_the_home(line: Maker, method: int) -> None:
    one = line(zero=0.25, initial_position=4.5 * INDEX_PITCH)
    one[0x6098, 0] = method
    homing = Homing(PERIOD_S)
    assert run(one, homing)[-1] is P.HOMED
    assert one.drive.position == pytest.approx(one.model.axis.position - 0.25, abs=2e-4)
    assert homing.position == pytest.approx(one.drive.position, abs=2e-4)


@pytest.mark.parametrize("method", [33, 34, 35, 37])
@pytest.mark.parametrize("mass", [0.0, 1.0])
def test_the_joint_makes_no_jump_on_the_way_there_and_back(line: Maker, method: int, mass: float) -> None:
    one = line(initial_position=4.5 * INDEX_PITCH, load_mass_moment=mass, gravity_phase=1.2)
    one[0x6098, 0], one[0x607C, 0] = method, -3000
    homing, last, fastest = Homing(PERIOD_S), one.model.mechanics.position, 0.0
    for phase in one.home(homing):
        now = one.model.mechanics.position
        fastest, last = max(fastest, abs(now - last) / PERIOD_S), now
        assert one.drive.state is DriveState.OPERATION_ENABLED
        assert phase in ENDED or homing.position == one.drive.position or phase in (P.ENTERING, P.LEAVING)
    speed = one.model.objects[0x6099, 2].value * 1e-4
    assert fastest < speed * 1.2 + 0.01
    held = one.model.mechanics.position
    for _ in range(1000):
        one.cycle()
        assert abs(one.model.mechanics.position - held) < 3e-4
    assert one.model.objects[0x6061, 0].value == 8


def test_it_may_be_stopped_at_any_time(line: Maker) -> None:
    seen = set()
    for at in (1, 2, 3, 5, 8, 30, 200, 400, 600):
        one = line(initial_position=4.5 * INDEX_PITCH)
        one[0x6098, 0] = 34
        homing = Homing(PERIOD_S)
        for cycles, _ in enumerate(one.home(homing)):
            if cycles == at:
                homing.stop()
        for _ in range(400):
            one.cycle()
        assert one.still
        assert one.drive.mode_display == 8
        assert one.drive.target_position == pytest.approx(one.model.axis.position, abs=3e-4)
        seen.add(homing.phase)
    assert seen <= {P.STOPPED, P.HOMED}
    assert P.STOPPED in seen


def test_a_search_at_speed_zero_fails_and_the_arm_holds(line: Maker) -> None:
    one = line()
    one[0x6098, 0], one[0x6099, 2] = 34, 0
    homing = Homing(PERIOD_S)
    assert run(one, homing)[-1] is P.FAILED
    assert homing.shown & 0x2000
    assert one.drive.state is DriveState.OPERATION_ENABLED
    assert one.drive.mode_display == 8


def test_after_a_fault_in_mid_search_it_is_enabled_in_csp(line: Maker) -> None:
    one = line(initial_position=4.5 * INDEX_PITCH)
    one[0x6098, 0] = 34
    homing = Homing(PERIOD_S)
    for cycles, _ in enumerate(one.home(homing)):
        if cycles == 100:
            one.model.inject_fault(0x7305)
        if one.drive.state is not DriveState.OPERATION_ENABLED:
            homing.abandon()
            break
    for goal in (TargetState.RESET, TargetState.ENABLED):
        for _ in range(4000):
            one.cycle()
            if one.drive.advance(goal) and one.still:
                break
    for _ in range(10):
        one.cycle()
    assert one.drive.state is DriveState.OPERATION_ENABLED
    assert one.drive.mode_display == 8
    assert one.drive.target_position == pytest.approx(one.drive.position, abs=3e-4)


def test_two_homings_in_a_row_find_the_same_home(line: Maker) -> None:
    one = line(initial_position=4.5 * INDEX_PITCH)
    homing = Homing(PERIOD_S)
    homes = []
    for method in (34, 33, 34):
        one[0x6098, 0] = method
        assert run(one, homing)[-1] is P.HOMED
        homes.append(one.model.mechanics.position - one.drive.position)
    assert homes[0] == pytest.approx(homes[2], abs=2 * INDEX_PITCH)
    assert all(abs(home / INDEX_PITCH - round(home / INDEX_PITCH)) < 0.01 for home in homes)
    assert HOMING == 6
