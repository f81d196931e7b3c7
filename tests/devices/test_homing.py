"""A drive that homes: against words on the wire, and against the model of the drive."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from rtcp.config.model import HomingConfig
from rtcp.control.homing import ENDED, HOMING, HOMING_STATUS, START, Homing, HomingPhase, HomingStatus
from rtcp.devices import Cia402Drive, DriveState, TargetState
from rtcp.virtual.models import CubemarsDrive, create
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage

from .conftest import Wire, slave

PERIOD_S = 0.0005
ENABLED, SWITCHED_ON = 0x0237, 0x0233
REST, UNDER_WAY, FOUND, ATTAINED, FAILING, FAILED = 0x0637, 0x0237, 0x1237, 0x1637, 0x2237, 0x2637
SETTLE = round(HomingConfig.settle_ms * 1e-3 / PERIOD_S)
"""Cycles for which the statusword may lag."""
INDEX_PITCH = 2 * math.pi / 100
P = HomingPhase
VELOCITIES = pytest.mark.parametrize("velocity", [500, -500])


def made(**keys: float) -> Homing:
    return Homing(HomingConfig(**keys), 1.0, PERIOD_S)


# -- the words ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def homing(drive: Cia402Drive, wire: Wire) -> Homing:
    """A homing whose drive is in mode 6 and has just received the start."""
    enabled(drive, wire)
    homing = made()
    homing.start(drive)
    wire.receive(ENABLED, 700, mode=8)
    homing.step()
    for _ in range(SETTLE + 1):
        wire.receive(REST, 700, mode=6)
        homing.step()
    return homing


def enabled(drive: Cia402Drive, wire: Wire) -> None:
    for word in (SWITCHED_ON, ENABLED):
        wire.receive(word, 700)
        drive.advance(TargetState.ENABLED)


def show(
    homing: Homing, wire: Wire, word: int, times: int = 1, position: int = 700, mode: int = 6, velocity: int = 0
) -> HomingPhase:
    for _ in range(times):
        wire.receive(word, position, velocity, mode=mode)
        homing.step()
    return homing.phase


def test_every_pattern_of_the_three_bits_says_something() -> None:
    assert set(HOMING_STATUS) == {high << 12 | low << 10 for high in range(4) for low in range(2)}
    assert {HOMING_STATUS[bits] for bits in HOMING_STATUS if bits & 0x2000} == {
        HomingStatus.FAILED,
        HomingStatus.FAILING,
    }


def test_the_start_bit_rises_only_when_the_drive_has_shown_mode_6_for_a_while(drive: Cia402Drive, wire: Wire) -> None:
    enabled(drive, wire)
    homing = made()
    homing.start(drive)
    for _ in range(50):
        assert show(homing, wire, ENABLED, mode=8) is P.ENTERING
        assert (wire.sent()[0], wire.sent()[4]) == (0x0F, 6)
    assert show(homing, wire, REST, SETTLE) is P.ENTERING
    assert wire.sent()[0] == 0x0F
    assert show(homing, wire, REST) is P.SEARCHING
    assert wire.sent()[0] == START == 0x1F


def test_the_start_bit_stays_for_as_long_as_the_homing_is_under_way(homing: Homing, wire: Wire) -> None:
    for word in (REST, UNDER_WAY, FOUND, UNDER_WAY):
        assert show(homing, wire, word, 200) is P.SEARCHING
        assert wire.sent()[0] == START


@pytest.mark.parametrize("stale", [ATTAINED, FAILED, FAILING])
def test_bits_count_once_they_were_clear_after_the_start(homing: Homing, wire: Wire, stale: int) -> None:
    assert show(homing, wire, stale, SETTLE) is P.SEARCHING
    assert show(homing, wire, UNDER_WAY, 500) is P.SEARCHING
    assert show(homing, wire, ATTAINED, SETTLE) is P.SEARCHING
    assert show(homing, wire, ATTAINED) is P.LEAVING


def test_bits_that_are_never_clear_count_after_a_while(homing: Homing, wire: Wire) -> None:
    assert show(homing, wire, ATTAINED, 2 * SETTLE) is P.SEARCHING
    assert show(homing, wire, ATTAINED) is P.LEAVING


def test_a_success_that_does_not_last_is_none(homing: Homing, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY)
    assert show(homing, wire, ATTAINED, SETTLE) is P.SEARCHING
    assert show(homing, wire, FAILED) is P.STOPPING


@pytest.mark.parametrize(
    ("home", "shown", "phase"),
    [(0.0, 0.0, P.HOMED), (0.0, 0.19, P.HOMED), (0.0, -0.21, P.ELSEWHERE), (1.5, 1.5, P.HOMED), (1.5, -1.5, P.HOMED),
     (1.5, 0.0, P.HOMED), (1.5, 0.7, P.ELSEWHERE), (math.nan, 5.0, P.HOMED)],
)  # fmt: skip
def test_a_homed_drive_shows_its_home_offset(
    drive: Cia402Drive, wire: Wire, home: float, shown: float, phase: HomingPhase
) -> None:
    enabled(drive, wire)
    homing = made()
    homing.start(drive, home)
    position = round(shown * 1e4)
    show(homing, wire, REST, SETTLE + 1, position)
    show(homing, wire, UNDER_WAY, 1, position)
    show(homing, wire, ATTAINED, 3 * SETTLE, position)
    assert homing.phase is P.LEAVING
    assert show(homing, wire, ENABLED, 2, position, mode=8) is phase


def test_a_position_that_comes_later_than_its_bits_is_waited_for(drive: Cia402Drive, wire: Wire) -> None:
    enabled(drive, wire)
    homing = made()
    homing.start(drive, 0.0)
    show(homing, wire, REST, SETTLE + 1, 9000)
    show(homing, wire, UNDER_WAY, 1, 9000)
    show(homing, wire, ATTAINED, SETTLE, 9000)
    show(homing, wire, ATTAINED, 1, 0)
    assert show(homing, wire, ENABLED, 2, 0, mode=8) is P.HOMED


def test_a_drive_at_its_home_goes_back_to_csp_with_its_place_as_target(
    homing: Homing, drive: Cia402Drive, wire: Wire
) -> None:
    show(homing, wire, UNDER_WAY, 20, position=900)
    assert show(homing, wire, ATTAINED, SETTLE + 1, position=-2500) is P.LEAVING
    for position in range(-2500, -2510, -1):
        # A target copied from the position would sag with the drive.
        assert show(homing, wire, ATTAINED, position=position) is P.LEAVING
        control, target, speed, torque, mode = wire.sent()
        assert (control, target, speed, torque, mode) == (0x0F, -2500, 0, 0, 8)
        assert homing.position == pytest.approx(-0.25)
    assert show(homing, wire, ENABLED, position=-2510, mode=8) is P.HOMED
    assert homing.ended
    assert wire.sent()[:3] == (0x0F, -2500, 5000)


def test_the_set_point_stands_until_the_drive_is_in_mode_6(drive: Cia402Drive, wire: Wire) -> None:
    enabled(drive, wire)
    drive.target_position = drive.position + 0.01
    before = drive.target_position
    homing = made()
    homing.start(drive)
    for position in (700, 650):
        assert show(homing, wire, ENABLED, position=position, mode=8) is P.ENTERING
        assert homing.position == before
    show(homing, wire, REST, position=650)
    assert homing.position == drive.position


def test_a_drive_that_never_shows_mode_6_keeps_its_target(drive: Cia402Drive, wire: Wire) -> None:
    enabled(drive, wire)
    drive.target_position = drive.position + 0.01
    before = drive.target_position
    homing = made()
    homing.start(drive)
    show(homing, wire, ENABLED, 20, mode=8)
    homing.stop()
    show(homing, wire, ENABLED, 2000, mode=8)
    assert homing.phase is P.STOPPED
    assert (homing.position, drive.target_position) == (before, before)


def test_the_set_point_is_where_the_drive_is(homing: Homing, wire: Wire) -> None:
    for position in (700, 800, -100):
        show(homing, wire, UNDER_WAY, position=position)
        assert homing.position == pytest.approx(position * 1e-4)


@VELOCITIES
@pytest.mark.parametrize("word", [FAILED, FAILING, 0x3237, 0x3637])
def test_a_homing_error_takes_the_start_bit_away_and_ends_in_csp(
    homing: Homing, wire: Wire, word: int, velocity: int
) -> None:
    show(homing, wire, UNDER_WAY, 20)
    assert show(homing, wire, word, velocity=velocity) is P.STOPPING
    for _ in range(200):
        assert show(homing, wire, FAILING, velocity=velocity) is P.STOPPING
        assert (wire.sent()[0], wire.sent()[4]) == (0x0F, 6)
    assert show(homing, wire, FAILED) is P.LEAVING
    assert show(homing, wire, ENABLED, 2, mode=8) is P.FAILED
    assert homing.shown == word


@VELOCITIES
def test_a_stop_takes_the_start_bit_away_and_waits_for_rest(homing: Homing, wire: Wire, velocity: int) -> None:
    show(homing, wire, UNDER_WAY, 20, velocity=velocity)
    homing.stop()
    assert show(homing, wire, UNDER_WAY, SETTLE, velocity=velocity) is P.STOPPING
    assert (wire.sent()[0], wire.sent()[4]) == (0x0F, 6)
    assert show(homing, wire, REST) is P.LEAVING
    assert show(homing, wire, ENABLED, 2, mode=8) is P.STOPPED


@VELOCITIES
def test_a_drive_that_does_not_come_to_rest_runs_on_and_keeps_mode_6(homing: Homing, wire: Wire, velocity: int) -> None:
    show(homing, wire, UNDER_WAY, 20, velocity=velocity)
    homing.stop()
    assert show(homing, wire, UNDER_WAY, 6000 + SETTLE, velocity=velocity) is P.STOPPING
    assert show(homing, wire, UNDER_WAY, velocity=velocity) is P.RUNNING
    assert wire.sent()[4] == 6


def test_rest_counts_only_when_the_drive_has_had_time_to_answer_the_stop(homing: Homing, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY, 20)
    homing.stop()
    assert show(homing, wire, UNDER_WAY, SETTLE) is P.STOPPING
    assert show(homing, wire, UNDER_WAY) is P.LEAVING


def test_after_a_stop_the_target_is_where_the_drive_came_to_rest(homing: Homing, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY, 20, position=900, velocity=500)
    homing.stop()
    for position in range(900, 950):
        show(homing, wire, UNDER_WAY, position=position, velocity=500)
        assert homing.position == pytest.approx(position * 1e-4)
    show(homing, wire, REST, SETTLE, position=955)
    show(homing, wire, ENABLED, 2, position=955, mode=8)
    assert wire.sent()[1] == 955
    assert homing.position == pytest.approx(0.0955)


@pytest.mark.parametrize("then", [ATTAINED, FOUND, UNDER_WAY])
def test_a_drive_that_has_reported_success_for_less_than_a_while_can_be_stopped(
    homing: Homing, wire: Wire, then: int
) -> None:
    show(homing, wire, UNDER_WAY)
    show(homing, wire, ATTAINED)
    show(homing, wire, then, 5)
    homing.stop()
    assert show(homing, wire, then) is P.STOPPING
    assert wire.sent()[0] == 0x0F
    assert show(homing, wire, ATTAINED, SETTLE) is P.LEAVING
    assert show(homing, wire, ENABLED, 2, mode=8) is P.STOPPED
    homing.stop()
    assert homing.phase is P.STOPPED


def test_a_success_that_is_interrupted_must_last_anew(homing: Homing, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY)
    show(homing, wire, ATTAINED, SETTLE)
    show(homing, wire, FOUND)
    assert show(homing, wire, ATTAINED, SETTLE) is P.SEARCHING
    assert show(homing, wire, ATTAINED) is P.LEAVING
    homing.stop()
    assert show(homing, wire, ENABLED, 2, mode=8) is P.HOMED


def test_a_drive_that_knows_no_homing_stays_in_csp(drive: Cia402Drive, wire: Wire) -> None:
    enabled(drive, wire)
    homing = made()
    homing.start(drive)
    assert show(homing, wire, ENABLED, 1999, mode=8) is P.ENTERING
    assert show(homing, wire, ENABLED, 4, mode=8) is P.FAILED
    assert (homing.shown, homing.shown_mode) == (ENABLED, 8)
    assert (wire.sent()[0], wire.sent()[4]) == (0x0F, 8)


def test_a_drive_that_does_not_come_back_to_csp_is_stuck(homing: Homing, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY)
    assert show(homing, wire, ATTAINED, SETTLE + 2000) is P.LEAVING
    assert show(homing, wire, ATTAINED, 20) is P.STUCK


def test_a_drive_that_leaves_mode_6_by_itself_has_not_homed(homing: Homing, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY, 20)
    # In CSP bit 12 says that the drive follows its targets.
    show(homing, wire, ATTAINED, SETTLE + 30, mode=8)
    assert homing.phase is P.STUCK


def test_a_search_without_end_fails(drive: Cia402Drive, wire: Wire) -> None:
    enabled(drive, wire)
    homing = made(search_s=1.0)
    homing.start(drive)
    show(homing, wire, REST, SETTLE + 1)
    assert show(homing, wire, UNDER_WAY, 2000) is P.SEARCHING
    assert show(homing, wire, UNDER_WAY, 2) is P.STOPPING
    assert show(homing, wire, REST, SETTLE + 1) is P.LEAVING
    assert show(homing, wire, ENABLED, 2, mode=8) is P.FAILED


def test_a_drive_that_is_let_go_is_in_csp_when_it_is_enabled_again(
    homing: Homing, drive: Cia402Drive, wire: Wire
) -> None:
    show(homing, wire, UNDER_WAY, 20)
    homing.abandon()
    assert homing.ended
    show(homing, wire, UNDER_WAY, 3)
    drive.advance(TargetState.QUICK_STOPPED)
    assert (wire.sent()[0], wire.sent()[4]) == (0x02, 8)


def test_a_homing_can_follow_another(homing: Homing, drive: Cia402Drive, wire: Wire) -> None:
    show(homing, wire, UNDER_WAY)
    show(homing, wire, ATTAINED, SETTLE + 1)
    show(homing, wire, ENABLED, 2, mode=8)
    homing.start(drive)
    assert not homing.ended
    assert show(homing, wire, ENABLED, position=750, mode=8) is P.ENTERING
    assert homing.position == pytest.approx(0.07)
    assert show(homing, wire, REST, SETTLE + 1) is P.SEARCHING
    show(homing, wire, UNDER_WAY, position=800)
    assert homing.position == pytest.approx(0.08)
    show(homing, wire, FAILED, SETTLE + 2)
    assert show(homing, wire, ENABLED, 2, mode=8) is P.FAILED
    homing.start(drive)
    assert (homing.shown, homing.shown_mode) == (0, HOMING)
    homing.stop()
    show(homing, wire, ENABLED, SETTLE + 1, mode=8)
    assert show(homing, wire, ENABLED, 2, mode=8) is P.STOPPED


def test_nothing_happens_before_the_start() -> None:
    homing = made()
    homing.stop()
    homing.abandon()
    assert homing.step() is P.IDLE
    assert homing.position == 0.0


# -- the drive ---------------------------------------------------------------------------------------------------------


class Line:
    """The driver and the model of a drive, with the bus's two cycles in between."""

    def __init__(self, zero: float = 0.0, **options: object) -> None:
        model = create("cubemars-orh60", load_inertia=0.05, **options)
        assert isinstance(model, CubemarsDrive)
        self.model = model
        self.model.set_outputs_valid(True)
        self.model.step(0.2)
        self._rx = PdoImage.from_assignment(self.model.objects, RX_ASSIGN)
        self._tx = PdoImage.from_assignment(self.model.objects, TX_ASSIGN)
        self.drive = Cia402Drive(slave(), 0.001, speed_limit=0.5, zero=zero)
        self._in_transit = [self._packed()] * 2
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
        self._in_transit.append(self._packed())
        self.drive.decode(self._in_transit.pop(0))

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


def run(line: Line, homing: Homing) -> list[HomingPhase]:
    return list(line.home(homing))


@pytest.mark.parametrize("method", [35, 37])
@pytest.mark.parametrize("home_offset", [0, -2500, 12345])
def test_where_it_stands_becomes_its_home(method: int, home_offset: int) -> None:
    line = Line(initial_position=0.7)
    line[0x6098, 0], line[0x607C, 0] = method, home_offset
    before = line.model.mechanics.position
    assert run(line, made())[-1] is P.HOMED
    assert line.drive.position == pytest.approx(home_offset * 1e-4, abs=2e-4)
    assert line.model.mechanics.position == pytest.approx(before, abs=2e-4)


@pytest.mark.parametrize(("method", "turns"), [(33, 4), (34, 5)])
def test_the_next_index_in_its_direction_becomes_its_home(method: int, turns: int) -> None:
    line = Line(initial_position=4.5 * INDEX_PITCH)
    line[0x6098, 0], line[0x607C, 0] = method, 1000
    assert run(line, made())[-1] is P.HOMED
    home = line.model.mechanics.position - line.drive.position + 0.1
    assert home == pytest.approx(turns * INDEX_PITCH, abs=2e-4)


@pytest.mark.parametrize("method", [33, 34, 35, 37])
def test_the_zero_offset_counts_on_from_the_home(method: int) -> None:
    line = Line(zero=0.25, initial_position=4.5 * INDEX_PITCH)
    line[0x6098, 0] = method
    homing = made()
    assert run(line, homing)[-1] is P.HOMED
    assert line.drive.position == pytest.approx(line.model.axis.position - 0.25, abs=2e-4)
    assert homing.position == pytest.approx(line.drive.position, abs=2e-4)


@pytest.mark.parametrize("method", [33, 34, 35, 37])
@pytest.mark.parametrize("mass", [0.0, 1.0])
def test_the_joint_makes_no_jump_on_the_way_there_and_back(method: int, mass: float) -> None:
    line = Line(initial_position=4.5 * INDEX_PITCH, load_mass_moment=mass, gravity_phase=1.2)
    line[0x6098, 0], line[0x607C, 0] = method, -3000
    homing, last, fastest = made(), line.model.mechanics.position, 0.0
    for phase in line.home(homing):
        now = line.model.mechanics.position
        fastest, last = max(fastest, abs(now - last) / PERIOD_S), now
        assert line.drive.state is DriveState.OPERATION_ENABLED
        assert phase in ENDED or homing.position == line.drive.position or phase in (P.ENTERING, P.LEAVING)
    speed = float(line.model.objects[0x6099, 2].value) * 1e-4
    assert fastest < speed * 1.2 + 0.01
    rest = line.model.mechanics.position
    for _ in range(1000):
        line.cycle()
        assert abs(line.model.mechanics.position - rest) < 3e-4
    assert line.model.objects[0x6061, 0].value == 8


def test_it_may_be_stopped_at_any_time() -> None:
    seen = set()
    for at in (1, 2, 3, 5, 8, 30, 200, 210, 400, 800, 1200):
        line = Line(initial_position=4.5 * INDEX_PITCH)
        line[0x6098, 0] = 34
        homing = made()
        for cycles, _ in enumerate(line.home(homing)):
            if cycles == at:
                homing.stop()
        for _ in range(400):
            line.cycle()
        assert line.still
        assert line.drive.mode_display == 8
        assert line.drive.target_position == pytest.approx(line.model.axis.position, abs=3e-4)
        seen.add(homing.phase)
    assert seen <= {P.STOPPED, P.HOMED}
    assert P.STOPPED in seen


def test_a_search_at_speed_zero_fails_and_the_arm_holds() -> None:
    line = Line()
    line[0x6098, 0], line[0x6099, 2] = 34, 0
    homing = made()
    assert run(line, homing)[-1] is P.FAILED
    assert homing.shown & 0x2000
    assert line.drive.state is DriveState.OPERATION_ENABLED
    assert line.drive.mode_display == 8


def test_after_a_fault_in_mid_search_it_is_enabled_in_csp() -> None:
    line = Line(initial_position=4.5 * INDEX_PITCH)
    line[0x6098, 0] = 34
    homing = made()
    for cycles, _ in enumerate(line.home(homing)):
        if cycles == 100:
            line.model.inject_fault(0x7305)
        if line.drive.state is not DriveState.OPERATION_ENABLED:
            homing.abandon()
            break
    for goal in (TargetState.RESET, TargetState.ENABLED):
        for _ in range(4000):
            line.cycle()
            if line.drive.advance(goal) and line.still:
                break
    for _ in range(10):
        line.cycle()
    assert line.drive.state is DriveState.OPERATION_ENABLED
    assert line.drive.mode_display == 8
    assert line.drive.target_position == pytest.approx(line.drive.position, abs=3e-4)


def test_two_homings_in_a_row_find_the_same_home() -> None:
    line = Line(initial_position=4.5 * INDEX_PITCH)
    homing = made()
    homes = []
    for method in (34, 33, 34):
        line[0x6098, 0] = method
        assert run(line, homing)[-1] is P.HOMED
        homes.append(line.model.mechanics.position - line.drive.position)
    assert homes[0] == pytest.approx(homes[2], abs=2 * INDEX_PITCH)
    assert all(abs(home / INDEX_PITCH - round(home / INDEX_PITCH)) < 0.01 for home in homes)
    assert HOMING == 6
