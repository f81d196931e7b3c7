"""Every mode of the drive reaches its target, inside its limits, at any step size."""

from math import pi

import pytest

from tests.virtual.models.conftest import Bench, Maker

INDEX_PITCH = 2 * pi / 100


# Cyclic synchronous position


@pytest.mark.parametrize("model", ["orh40", "orh50", "orh60", "orh70"])
@pytest.mark.parametrize("mass_moment", [0.0, 0.5])
def test_csp_tracks_a_smooth_motion_and_ends_on_its_target(drive: Maker, model: str, mass_moment: float) -> None:
    bench = drive(model, load_mass_moment=mass_moment, gravity_phase=0.5).enabled(8)
    bench.run(0.2)
    worst = 0.0

    def watch() -> None:
        nonlocal worst
        worst = max(worst, abs(bench[0x607A] / 10000 - bench.position))

    bench.smooth_move(1.0, 2.0, watch)
    assert 1e-4 < worst < 2e-3
    assert bench.position == pytest.approx(1.0, abs=3e-4)
    assert abs(bench.velocity) < 2e-3
    assert bench.bit(12)
    assert not bench.bit(11)


def test_csp_moves_no_faster_than_the_target_velocity_says(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench[0x60FF] = 2000
    bench[0x607A] = 13500
    fastest = highest = 0.0

    def watch(_: float) -> None:
        nonlocal fastest, highest
        fastest, highest = max(fastest, bench.velocity), max(highest, bench.position)

    bench.run(3.0, watch)
    assert bench.bit(11)
    assert bench.position == pytest.approx(0.6, abs=2e-3)
    took = 3.0 + bench.until(lambda: bench.position > 1.349, 6.0)
    assert took == pytest.approx(6.75, abs=0.1)
    bench.run(0.5, watch)
    assert fastest < 0.23
    assert highest < 1.3525
    assert bench.position == pytest.approx(1.35, abs=3e-4)
    assert not bench.bit(11)


def test_csp_finishes_its_motion_after_a_halt_at_its_very_end(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench[0x60FF] = 5000
    bench[0x607A] = 1000
    bench.until(lambda: bench[0x6062] == 1000, 1.0)
    bench.control(0x10F)
    bench.run(0.5)
    assert abs(bench[0x6064] - 1000) > 50
    bench.control(0x00F)
    bench.run(0.5)
    assert bench[0x6064] == pytest.approx(1000, abs=3)


def test_csp_with_speed_limit_zero_does_not_move(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench[0x60FF] = 0
    bench[0x607A] = 10000
    bench.run(1.0)
    assert bench.position == 0.0
    assert bench.bit(11)
    bench[0x60FF] = -5000
    bench.run(2.5)
    assert bench.position == pytest.approx(1.0, abs=3e-4)


def test_csp_clamps_its_target_to_the_software_limits(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench[0x60FF] = 5000
    bench[0x607D, 2] = 5000
    bench[0x607A] = 8000
    bench.run(1.5)
    assert bench.position == pytest.approx(0.5, abs=3e-4)
    assert bench.bit(11)


def test_csp_interpolates_over_the_interpolation_time(drive: Maker) -> None:
    bench = drive(step=0.001).enabled(8)
    bench[0x60C2, 1] = 10
    bench[0x607A] = 100
    demands = []
    bench.run(0.012, lambda _: demands.append(bench[0x6062]))
    assert demands == [0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 100]


def test_csp_follows_the_line_between_set_points_within_a_cycle(drive: Maker) -> None:
    bench = drive(step=0.0005).enabled(8)
    speeds = []
    # One count a cycle is the coarsest staircase. Without interpolation the speed would alternate: 0 and 0.4 rad/s.
    for n in range(2000):
        bench[0x607A] = n // 2
        bench.run(0.0005)
        if n > 1000:
            speeds.append(bench.velocity)
    assert max(speeds) - min(speeds) < 0.02
    assert sum(speeds) / len(speeds) == pytest.approx(0.1, rel=0.01)
    # A stream that ends abruptly swings back only once.
    bench.run(0.3, lambda _: speeds.append(bench.velocity))
    assert min(speeds) > -0.05


# Cyclic synchronous velocity and torque


@pytest.mark.parametrize("model", ["orh40", "orh70"])
def test_csv_runs_at_the_velocity_commanded(drive: Maker, model: str) -> None:
    bench = drive(model).enabled(9)
    bench[0x60FF] = -7000
    bench[0x60B1] = 2000
    bench.run(0.5)
    assert bench.velocity == pytest.approx(-0.5, abs=5e-3)
    assert bench.bit(12)
    assert not bench.bit(11)


def test_csv_stays_below_the_max_velocity(drive: Maker) -> None:
    bench = drive().enabled(9)
    bench[0x60FF] = 90000
    bench.run(1.0)
    assert bench.velocity == pytest.approx(bench[0x607F] / 10000, abs=0.02)
    assert bench.bit(11)
    assert bench.state == "enabled"


@pytest.mark.parametrize("mode", [3, 9, 10])
def test_a_mode_without_a_target_position_stops_at_the_software_limit(drive: Maker, mode: int) -> None:
    bench = drive().enabled(mode)
    bench[0x607D, 2] = 10000
    bench[0x60FF] = 10000
    bench[0x6071] = 200000
    highest = bench.largest(3.0, lambda: bench.position)
    assert 0.99 < highest < 1.003
    assert abs(bench.velocity) < 2e-3
    assert bench.bit(11)
    bench[0x60FF] = -10000
    bench[0x6071] = -200000
    bench.run(0.3)
    assert bench.position < 0.97


def test_cst_applies_the_torque_commanded_and_shows_it(drive: Maker) -> None:
    bench = drive(friction=0.0, viscous_friction=0.0, load_inertia=1.0).enabled(10)
    bench[0x6071] = 30000
    bench[0x60B2] = 10000
    bench.run(0.5)
    assert bench[0x6077] == 40000
    assert bench.velocity == pytest.approx(0.5 * 4.0 / 2.0, rel=0.01)


def test_no_mode_exceeds_the_max_torque(drive: Maker) -> None:
    bench = drive().enabled(10)
    bench[0x6072] = 50000
    bench[0x6071] = -200000
    bench.run(0.01)
    assert bench[0x6077] == -50000
    assert bench.bit(11)


def test_the_torque_limit_is_the_firmware_s_or_the_start_stop_torque(drive: Maker) -> None:
    assert drive("orh70")[0x6072] == 500000
    small = drive("orh40").enabled(10)
    assert small[0x6072] == 190000
    small[0x6072] = 900000
    small[0x6071] = 900000
    small.run(0.001)
    assert small[0x6077] == 190000


# Profile position


def _set_point(bench: Bench, target: int, controlword: int = 0x1F) -> None:
    bench[0x607A] = target
    bench.control(controlword)
    assert bench.bit(12)
    bench.control(controlword & ~0x10)


def test_profile_position_moves_to_the_target_by_its_profile(drive: Maker) -> None:
    bench = drive().enabled(1)
    _set_point(bench, 10000)
    assert not bench.bit(10)
    took = bench.until(lambda: bench.bit(10), 5.0)
    # 1 rad at 1 rad/s with 4 rad/s^2: 1 s and twice 1/8 s; then the window time.
    assert took == pytest.approx(1.26, abs=0.03)
    assert bench.position == pytest.approx(1.0, abs=1e-3)


def test_a_set_point_is_acknowledged_until_bit_4_falls(drive: Maker) -> None:
    bench = drive().enabled(1)
    bench[0x607A] = 1000
    assert not bench.bit(12)
    bench.control(0x1F)
    bench.run(0.1)
    assert bench.bit(12)
    bench.control(0x0F)
    assert not bench.bit(12)


def test_a_second_set_point_waits_for_the_first(drive: Maker) -> None:
    bench = drive().enabled(1)
    _set_point(bench, 5000)
    bench[0x607A] = 2000
    bench.control(0x1F)
    bench.control(0x0F)
    # The buffer is full: the acknowledgement stays until the first target is reached.
    assert bench.bit(12)
    highest = bench.largest(2.0, lambda: bench.position)
    assert highest == pytest.approx(0.5, abs=2e-3)
    assert bench.position == pytest.approx(0.2, abs=1e-3)
    assert not bench.bit(12)
    assert bench.bit(10)


def test_change_immediately_leaves_the_first_set_point(drive: Maker) -> None:
    bench = drive().enabled(1)
    _set_point(bench, 20000)
    bench.run(0.5)
    _set_point(bench, -2000, 0x3F)
    highest = bench.largest(3.0, lambda: bench.position)
    assert highest < 0.7
    assert bench.position == pytest.approx(-0.2, abs=1e-3)


def test_a_relative_set_point_counts_from_the_last_one(drive: Maker) -> None:
    bench = drive(initial_position=0.3).enabled(1)
    for expected in (0.5, 0.7):
        _set_point(bench, 2000, 0x5F)
        bench.until(lambda: bench.bit(10), 3.0)
        assert bench.position == pytest.approx(expected, abs=1e-3)


def test_enabling_with_bit_4_set_starts_nothing(drive: Maker) -> None:
    bench = drive()
    bench[0x6060] = 1
    bench[0x607A] = 10000
    for controlword in (0x06, 0x07, 0x1F):
        bench.control(controlword)
    bench.run(0.5)
    assert bench.state == "enabled"
    assert bench.position == 0.0


def test_a_profile_target_beyond_the_software_limits_is_clamped(drive: Maker) -> None:
    bench = drive().enabled(1)
    bench[0x607D, 1] = -3000
    _set_point(bench, -9000)
    bench.until(lambda: bench.bit(10), 3.0)
    assert bench.position == pytest.approx(-0.3, abs=1e-3)
    assert bench.bit(11)


def test_profiles_accelerate_no_faster_than_the_firmware_allows(drive: Maker) -> None:
    bench = drive().enabled(3)
    bench[0x6083] = 900000
    bench[0x60FF] = 20000
    took = bench.until(lambda: bench[0x606B] == 20000, 2.0)
    assert took == pytest.approx(0.5, abs=0.01)


# Profile velocity and homing


def test_profile_velocity_ramps_reaches_and_shows_standstill(drive: Maker) -> None:
    bench = drive().enabled(3)
    bench.run(0.05)
    assert bench.bit(12)
    bench[0x60FF] = 10000
    bench.run(0.1)
    assert bench.velocity == pytest.approx(0.4, abs=0.03)
    assert not bench.bit(10)
    bench.run(0.3)
    assert bench.bit(10)
    assert not bench.bit(12)
    bench[0x60FF] = 0
    bench.run(0.5)
    assert bench.bit(10)
    assert bench.bit(12)


@pytest.mark.parametrize("method", [35, 37])
def test_homing_where_it_stands_gives_the_place_the_home_offset(drive: Maker, method: int) -> None:
    bench = drive(initial_position=0.7).enabled(6)
    bench[0x6098] = method
    bench[0x607C] = -2500
    assert bench.bit(10)
    assert not bench.bit(12)
    bench.control(0x1F)
    bench.run(0.01)
    assert bench.bit(10)
    assert bench.bit(12)
    assert bench[0x6064] == -2500
    assert abs(bench[0x60F4]) <= 1


@pytest.mark.parametrize(("method", "turns"), [(33, 4), (34, 5)])
@pytest.mark.parametrize("start", [4.5, 4.0, 5.0])
def test_homing_on_the_index_finds_the_next_pulse_in_its_direction(
    drive: Maker, method: int, turns: int, start: float
) -> None:
    bench = drive(initial_position=start * INDEX_PITCH).enabled(6)
    # From a start on a pulse, the next pulse counts.
    turns += {(33, 4.0): -1, (34, 5.0): 1}.get((method, start), 0)
    bench[0x6098] = method
    bench[0x607C] = 1000
    bench.control(0x1F)
    bench.run(0.1)
    assert not bench.bit(10)
    assert not bench.bit(12)
    bench.until(lambda: bench.bit(10) and bench.bit(12), 5.0)
    home = bench.drive.mechanics.position - bench.position + 0.1
    assert home == pytest.approx(turns * INDEX_PITCH, abs=1e-4)


def test_homing_with_speed_zero_is_a_homing_error(drive: Maker) -> None:
    bench = drive().enabled(6)
    bench[0x6098] = 34
    bench[0x6099, 2] = 0
    bench.control(0x1F)
    bench.run(0.01)
    assert bench.bit(13)
    assert not bench.bit(12)


def test_taking_bit_4_away_interrupts_homing(drive: Maker) -> None:
    bench = drive(initial_position=0.01).enabled(6)
    bench[0x6098] = 34
    bench.control(0x1F)
    bench.run(0.2)
    bench.control(0x0F)
    bench.run(0.5)
    assert bench.bit(10)
    assert not bench.bit(12)
    assert abs(bench.velocity) < 2e-3
    assert bench.position < INDEX_PITCH


# Whatever the mode


def test_changing_the_mode_while_moving_is_smooth(drive: Maker) -> None:
    bench = drive().enabled(9)
    bench[0x60FF] = 5000
    bench.run(0.5)
    last, largest = bench.position, 0.0
    for mode in (3, 10, 9, 8, 1, 8):
        bench[0x6060] = mode
        for _ in range(100):
            bench[0x607A] = bench[0x6064]
            bench.run(0.0005)
            largest, last = max(largest, abs(bench.position - last)), bench.position
        assert bench[0x6061] == mode
        assert bench.state == "enabled"
    assert largest < 5e-4


def test_a_velocity_mode_takes_the_torque_over_that_holds_the_load(drive: Maker) -> None:
    bench = drive(load_mass_moment=2.0, initial_position=pi / 2).enabled(10)
    bench[0x6071] = -196000
    bench.run(0.3)
    before = bench.position
    bench[0x6060] = 9
    fastest = bench.largest(0.3, lambda: abs(bench.velocity))
    assert bench[0x6061] == 9
    assert fastest < 0.005
    assert bench.position == pytest.approx(before, abs=1e-3)


def test_an_enabled_drive_without_a_mode_holds_its_place(drive: Maker) -> None:
    bench = drive(load_mass_moment=2.0, initial_position=1.0).enabled(0)
    bench.run(1.0)
    assert bench[0x6061] == 0
    assert bench.position == pytest.approx(1.0, abs=3e-4)


@pytest.mark.parametrize("mode", [1, 3, 8, 9, 10])
def test_the_motion_does_not_depend_on_the_step(drive: Maker, mode: int) -> None:
    def course(step: float) -> list[float]:
        bench = drive("orh50", step=step).enabled(mode)
        bench[0x60FF] = 5000
        bench[0x607A] = 4000
        bench[0x6071] = 20000
        bench.control(0x1F)
        places = []
        for _ in range(5):
            bench.run(0.2)
            places.append(bench.position)
        return places

    fine = course(0.0001)
    assert fine[-1] > 0.2
    for step in (0.0005, 0.001, 0.002, 0.004):
        # The command arrives up to one step later, at up to 2 rad/s.
        assert course(step) == pytest.approx(fine, abs=2.0 * step + 2e-3)


@pytest.mark.parametrize("step", [0.0001, 0.0005, 0.001, 0.004])
@pytest.mark.parametrize("model", ["orh40", "orh70"])
def test_the_position_loop_is_stable_at_every_step_size(drive: Maker, model: str, step: float) -> None:
    bench = drive(model, step=step, load_mass_moment=0.5, gravity_phase=1.0).enabled(8)
    bench.run(0.5)
    bench.drive.mechanics.external_torque = 3.0
    bench.run(0.5)
    bench.drive.mechanics.external_torque = 0.0
    bench.run(0.5)
    places = set()
    bench.run(0.2, lambda _: places.add(bench[0x6064]))
    assert max(places) - min(places) <= 1
    assert abs(bench[0x60F4]) <= 3
