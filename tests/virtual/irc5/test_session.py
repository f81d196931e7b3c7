"""Sessions of a unit: who speaks first, how EGMRunJoint ends, what goes on after it."""

from __future__ import annotations

import itertools

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.virtual.irc5.mechanical_unit import QUEUE, RapidRefused
from tests.virtual.irc5.wire import PERIOD, Robot, pc, sensor

STILL = (0.0,) * 6


def test_the_robot_speaks_first_with_seqno_0_and_stands_until_it_is_answered() -> None:
    robot = pc()
    states = [robot.read() for _ in range(5)]
    assert [state.seqno for state in states] == [0, 1, 2, 3, 4]
    assert {state.mci for state in states} == {"running"}
    assert states[-1].actual == list(STILL)


def test_every_field_that_abb_libegm_requires_is_there() -> None:
    state = pc().read()
    assert state.mtype == 2
    assert state.tm == int(PERIOD * 1000)
    for number in (2, 3):
        assert len(state.part(number, 1)[1]) == 6
        assert sorted(state.part(number, 2, 1)) == [1, 2, 3]
        assert sorted(state.part(number, 2, 2)) == [1, 2, 3, 4]
        assert sorted(state.part(number, 4)) == [1, 2]
    assert {4, 5, 6, 8} <= set(state.fields)


def test_robotware_6_knows_neither_move_index_nor_collisions() -> None:
    assert max(pc(robotware=6).read().fields) == 10
    assert max(pc(robotware=7).read().fields) == 12


def test_a_cycle_reads_one_datagram_so_that_surplus_replies_are_lag() -> None:
    robot = pc(egm={"low_pass_hz": 0.0})
    burst = [sensor(i, None, (float(i), 0, 0, 0, 0, 0)) for i in range(1, 4)]
    robot.cycle(None, None, *burst)
    speeds = [robot.unit.speeds[0]]
    for _ in range(3):
        robot.read()
        speeds.append(robot.unit.speeds[0])
    assert speeds == pytest.approx([1.0, 2.0, 3.0, 3.0])


def test_a_queue_that_is_full_loses_what_comes_and_counts_it() -> None:
    robot = pc()
    robot.cycle(None, None, *[sensor(i, STILL) for i in range(QUEUE + 3)])
    assert robot.unit.counts["overflow"] == 3


def test_the_last_speed_stays_in_force_until_comm_timeout() -> None:
    robot = pc(egm={"comm_timeout_s": 0.2, "low_pass_hz": 0.0})
    robot.read(None, (10.0, 0, 0, 0, 0, 0))
    for _ in range(int(0.2 / PERIOD)):
        state = robot.read()
        assert robot.unit.speeds[0] == pytest.approx(10.0)
        assert state.mci == "running"
    state = robot.read()
    assert state.mci == "stopped"
    assert "ERR_UDPUC_COMM" in robot.unit.events[-1]


def test_after_the_time_out_rapids_handler_begins_a_new_session() -> None:
    robot = pc()
    robot.wait(0.2 + PERIOD)
    states = [robot.read() for _ in range(8)]
    first = next(state for state in states if state.mci == "running")
    assert first.seqno == 0
    assert first.rapid_running


def test_without_a_loop_the_time_out_ends_the_program() -> None:
    robot = pc(loop=False)
    state = robot.wait(0.5)
    assert (state.mci, state.rapid_running) == ("stopped", False)


def test_an_arm_that_moved_comes_to_rest_in_the_default_ramp_time_after_the_time_out() -> None:
    robot = pc(loop=False, egm={"ramp_s": 0.5, "low_pass_hz": 0.0})
    robot.read(None, (10.0, 0, 0, 0, 0, 0))
    while robot.read().mci == "running":
        pass
    robot.wait(0.4)
    assert robot.unit.speeds[0] == pytest.approx(2.0, abs=0.2)
    robot.wait(0.12)
    assert robot.unit.speeds[0] == 0.0


def test_convergence_for_cond_time_ends_the_instruction_and_the_loop_begins_the_next() -> None:
    robot = pc(egm={"cond_time_s": 0.1})
    states = [robot.read(STILL) for _ in range(30)]
    assert states[0].converged
    stopped = next(i for i, state in enumerate(states) if state.mci == "stopped")
    assert stopped * PERIOD == pytest.approx(0.1, abs=2 * PERIOD)
    later = [robot.read(STILL) for _ in range(10)]
    assert later[-1].mci == "running"
    assert later[-1].seqno == 39
    assert later[-1].fields[11] == [2]


def test_a_joint_outside_the_window_does_not_converge() -> None:
    robot = pc(egm={"cond_time_s": 0.1, "convergence_window": 0.5, "pos_corr_gain": 0.0})
    assert not robot.wait(0.5, (0.6, 0, 0, 0, 0, 0)).converged
    assert robot.wait(0.05, (0.4, 0, 0, 0, 0, 0)).converged


def test_without_streaming_the_robot_is_silent_outside_egm_run_joint() -> None:
    robot = pc(stream=False, loop=False, egm={"cond_time_s": 0.1})
    answers = [robot.cycle(STILL) for _ in range(60)]
    assert isinstance(answers[0], Robot)
    assert answers[30:] == [None] * 30


def test_what_comes_while_nothing_runs_is_read_and_not_used() -> None:
    robot = pc(controller={"autostart": False})
    assert robot.wait(0.2, (10.0,) * 6).actual == list(STILL)
    assert set(robot.unit.counts) == {"unused"}


def test_a_rapid_stop_ends_running_and_program_start_resumes_it() -> None:
    robot = pc()
    before = robot.wait(0.1, None, (10.0, 0, 0, 0, 0, 0))
    robot.unit.stop_rapid()
    state = robot.read()
    assert (state.mci, state.rapid_running) == ("stopped", False)
    robot.wait(0.6)
    robot.unit.start_rapid()
    state = robot.read()
    assert (state.mci, state.rapid_running) == ("running", True)
    assert state.seqno > before.seqno
    assert robot.unit.speeds == [0.0] * 6


def test_a_reference_outside_the_range_is_an_error_that_the_next_start_clears() -> None:
    robot = pc()
    state = robot.read((165.1, 0, 0, 0, 0, 0))
    assert (state.mci, state.rapid_running) == ("error", False)
    assert robot.unit.events[-1] == "input out of bounds: joint 1 to 165.1, allowed are -165 to 165"
    robot.unit.start_rapid()
    state = robot.read()
    assert (state.mci, state.seqno) == ("running", 0)


def test_a_speed_reference_does_not_drive_a_joint_out_of_its_range() -> None:
    robot = pc(initial_position=(164.0, 0, 0, 0, 0, 0))
    assert robot.wait(0.5, None, (50.0, 0, 0, 0, 0, 0)).actual[0] == pytest.approx(165.0)


def test_rapid_does_not_start_with_motors_off() -> None:
    robot = pc(controller={"autostart": False})
    with pytest.raises(RapidRefused, match="the motors of ROB_1 are off: switch them on first"):
        robot.unit.start_rapid()


def test_an_old_seqno_is_used_all_the_same_and_counted() -> None:
    robot = pc(egm={"low_pass_hz": 0.0})
    robot.cycle(None, None, sensor(9, None, (1.0, 0, 0, 0, 0, 0)))
    robot.cycle(None, None, sensor(8, None, (2.0, 0, 0, 0, 0, 0)))
    assert robot.unit.speeds[0] == pytest.approx(2.0)
    assert robot.unit.counts == {"used": 2, "not_newer": 1}


def test_seven_axes_are_reported_six_and_one() -> None:
    state = pc(axes=7, initial_position=(0, 0, 0, 0, 30.0, 0, -45.0)).read()
    assert len(state.part(2, 1)[1]) == 6
    assert state.part(2, 3)[1] == state.part(3, 3)[1] == [-45.0]


def test_a_new_session_in_motion_brings_the_arm_to_rest_without_a_jump() -> None:
    robot = pc(egm={"ramp_s": 0.5})
    robot.wait(0.2, None, (20.0, 0, 0, 0, 0, 0))
    robot.unit.restart_session()
    speeds = [robot.unit.speeds[0]]
    for _ in range(40):
        robot.read()
        speeds.append(robot.unit.speeds[0])
    steps = [before - after for before, after in itertools.pairwise(speeds)]
    assert max(steps) <= 20.0 * PERIOD / 0.5 + 1e-9


def test_an_error_is_not_cleared_by_a_rapid_stop() -> None:
    robot = pc()
    robot.unit.fail("a test")
    robot.unit.stop_rapid()
    assert robot.read().mci == "error"


def test_a_session_does_not_restart_while_rapid_is_stopped() -> None:
    robot = pc()
    robot.unit.stop_rapid()
    with pytest.raises(RapidRefused, match="RAPID of ROB_1 is stopped: start it first"):
        robot.unit.restart_session()


def test_a_reference_in_a_new_session_takes_over_from_the_speed_that_is_left() -> None:
    robot = pc(egm={"low_pass_hz": 5.0})
    speed = (20.0, 0, 0, 0, 0, 0)
    robot.wait(0.5, None, speed)
    robot.unit.restart_session()
    robot.read(None, speed)
    assert robot.unit.speeds[0] == pytest.approx(20.0, abs=0.5)


def test_datagrams_for_the_last_session_are_not_used_in_the_next() -> None:
    robot = pc()
    robot.cycle(None, None, *[sensor(i, None, (50.0,) * 6) for i in range(10)])
    robot.unit.restart_session()
    used = robot.unit.counts["used"]
    robot.wait(0.05)
    assert robot.unit.counts["used"] == used


def test_a_stop_under_way_goes_on_when_no_data_come_in_the_next_session_either() -> None:
    robot = pc()
    robot.wait(0.5, [0.0] * 6, [20.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    robot.wait(0.2 + 0.5 + 5 * PERIOD)  # CommTimeout, then the default ramp time
    assert robot.unit.speeds == [0.0] * 6
