"""Sequence numbers and times of a client's points."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtcp.fieldbus.simple_message.messages import (
    JointPoint,
    JointPosition,
    JointTrajPt,
    JointTrajPtFull,
    TrajectoryPoint,
    TriState,
    ValidFields,
)
from rtcp.ros.simple_message.arm import ArmState, Point
from rtcp.ros.simple_message.sequence import (
    BUFFER_POINTS,
    REALTIME_PAUSE_S,
    Append,
    Begin,
    Execute,
    Finish,
    Halt,
    Order,
    PointIgnored,
    PointRefused,
    PointSequence,
    Target,
)
from tests.ros.fake_arm import HOME, READY

THERE = (0.5, *HOME[1:])
STATE = ArmState(1, HOME, (0.0,) * 6, HOME, READY)
START, END, STOP = -1, -3, -4


def point(sequence: int, q1: float = 0.5, duration: float = 0.5) -> JointTrajPt:
    return JointTrajPt(sequence, (q1, *HOME[1:], 0.0, 0.0, 0.0, 0.0), 0.1, duration)


def at(time: float, q1: float = 0.5) -> Point:
    return Point(time, (q1, *HOME[1:]))


class Receiver:
    """A sequence of an arm at HOME, with a clock that the test sets."""

    def __init__(self, state: ArmState | None = STATE) -> None:
        self.sequence = PointSequence()
        self.state = state
        self.now = 100.0

    def __call__(self, *messages: JointPosition | TrajectoryPoint) -> list[Order]:
        return [order for each in messages for order in self.sequence.receive(each, self.state, self.now)]

    def refuses(self, message: JointPosition | TrajectoryPoint, reason: str) -> None:
        with pytest.raises(PointRefused, match=reason):
            self(message)

    def ignores(self, *messages: JointPosition | TrajectoryPoint) -> None:
        for message in messages:
            with pytest.raises(PointIgnored):
                self(message)


@pytest.fixture
def receive() -> Receiver:
    return Receiver()


# -- streaming --------------------------------------------------------------------------------------------------------


def test_streamed_points_have_times_from_the_start(receive: Receiver) -> None:
    orders = receive(point(0, 0.1, 0.25), point(1, 0.2, 0.5), point(2, 0.3, 0.125))
    assert orders == [Begin(at(0.25, 0.1)), Append(at(0.75, 0.2)), Append(at(0.875, 0.3))]


def test_the_first_duration_means_nothing_where_the_arm_is_already(receive: Receiver) -> None:
    assert receive(point(0, 0.0, 10.0), point(1, 0.2, 0.5)) == [Begin(at(0.0, 0.0)), Append(at(0.5, 0.2))]


def test_within_a_tenth_of_a_degree_the_trajectory_begins_exactly_where_the_arm_is_commanded(receive: Receiver) -> None:
    assert receive(point(0, 0.0017, 10.0)) == [Begin(at(0.0, 0.0))]
    assert receive(point(0, 0.0018, 10.0)) == [Begin(at(10.0, 0.0018))]


def test_a_sequence_of_0_is_a_new_trajectory(receive: Receiver) -> None:
    receive(point(0), point(1))
    assert receive(point(0, 0.3, 2.0)) == [Begin(at(2.0, 0.3))]


def test_an_end_mark_finishes_a_stream(receive: Receiver) -> None:
    receive(point(0))
    assert receive(JointTrajPt(END, (), 0.0, 0.0)) == [Finish()]


def test_a_start_mark_of_streaming_may_carry_the_first_point_or_none(receive: Receiver) -> None:
    assert receive(point(-2), point(1)) == [Begin(at(0.5)), Append(at(1.0))]
    assert receive(JointTrajPt(-2, (0.0,) * 10, 0.0, 0.0), point(0)) == [Begin(at(0.5))]


def test_the_same_point_again_is_harmless(receive: Receiver) -> None:
    receive(point(0), point(1))
    assert receive(point(1), point(1)) == []
    assert receive(point(2)) == [Append(at(1.5))]


@pytest.mark.parametrize("wrong", [point(4), point(1), point(0x7FFFFFFF), point(-5), point(2, 0.6)])
def test_a_gap_aborts_and_the_rest_is_ignored_until_a_new_beginning(receive: Receiver, wrong: JointTrajPt) -> None:
    receive(point(0), point(1), point(2))
    receive.refuses(wrong, f"sequence {wrong.sequence} came where 3 follows")
    receive.ignores(point(3), point(4), point(END))
    assert receive(point(0)) == [Begin(at(0.5))]


def test_a_point_without_a_beginning_is_refused_once(receive: Receiver) -> None:
    receive.refuses(point(5), "sequence 5 came where 0")
    receive.ignores(point(6))


@pytest.mark.parametrize("beginning", [0, START])
def test_points_after_a_stop_are_ignored_until_a_new_beginning(receive: Receiver, beginning: int) -> None:
    receive(point(0), point(1))
    assert receive(point(STOP)) == [Halt()]
    receive.ignores(point(2), point(END))
    receive(point(beginning), point(1))


def test_what_the_arm_refused_is_ignored_until_a_new_beginning(receive: Receiver) -> None:
    receive(point(0))
    receive.sequence.ignore(receive.now)
    receive.ignores(point(1))
    assert receive(point(0)) == [Begin(at(0.5))]


# -- downloading ------------------------------------------------------------------------------------------------------


def test_a_download_is_executed_when_it_is_complete(receive: Receiver) -> None:
    assert receive(point(START, 0.0, 10.0), point(1, 0.1), point(2, 0.2)) == []
    assert receive(point(END, 0.3)) == [Execute((at(0.0, 0.0), at(0.5, 0.1), at(1.0, 0.2), at(1.5, 0.3)))]


def test_a_trajectory_of_one_point_is_downloaded_twice_and_executed_once(receive: Receiver) -> None:
    assert receive(point(START), point(END)) == [Execute((at(0.5),))]
    assert receive(point(END)) == []


def test_a_download_between_bare_marks_is_executed(receive: Receiver) -> None:
    mark = JointTrajPt(START, (0.0,) * 10, 0.0, 0.0)
    assert receive(mark, point(0), point(1), replace(mark, sequence=END)) == [Execute((at(0.5), at(1.0)))]


def test_a_download_to_where_the_arm_is_moves_nothing(receive: Receiver) -> None:
    assert receive(point(START, 0.0, 10.0), point(END, 0.0, 10.0)) == []


def test_a_download_that_is_too_long_is_refused(receive: Receiver) -> None:
    receive(point(START), *(point(number) for number in range(1, BUFFER_POINTS)))
    receive.refuses(point(BUFFER_POINTS), f"more than {BUFFER_POINTS} points")
    receive.ignores(point(BUFFER_POINTS + 1), point(END))


def test_an_end_without_points_is_refused(receive: Receiver) -> None:
    mark = JointTrajPt(START, (0.0,) * 10, 0.0, 0.0)
    receive(mark)
    receive.refuses(replace(mark, sequence=END), "ends without a point")


# -- points with all fields -------------------------------------------------------------------------------------------


def full(sequence: int, time: float, q1: float = 0.5, valid: int = 15, robot: int = 0) -> JointTrajPtFull:
    positions = (q1, *HOME[1:], 0.0, 0.0, 0.0, 0.0)
    fields = ValidFields(valid)
    return JointTrajPtFull(robot, sequence, fields, time, positions, (0.2,) + (0.0,) * 9, (0.3,) + (0.0,) * 9)


def test_a_full_points_time_counts_from_the_first_point_where_the_arm_is_there(receive: Receiver) -> None:
    begin, append = receive(full(0, 0.5, 0.0, 3), full(1, 2.0, 0.5, 3))
    assert (begin, append) == (Begin(at(0.0, 0.0)), Append(at(1.5)))


def test_a_full_points_time_counts_from_the_start_where_the_arm_is_elsewhere(receive: Receiver) -> None:
    assert receive(full(0, 1.0, 0.1, 3), full(1, 2.0, 0.5, 3)) == [Begin(at(1.0, 0.1)), Append(at(2.0))]


@pytest.mark.parametrize(
    ("valid", "velocities", "accelerations"), [(3, False, False), (7, True, False), (15, True, True)]
)
def test_only_valid_fields_count(receive: Receiver, valid: int, velocities: bool, accelerations: bool) -> None:
    (order,) = receive(full(0, 1.0, valid=valid))
    assert isinstance(order, Begin)
    assert order.point.velocities == ((0.2, 0.0, 0.0, 0.0, 0.0, 0.0) if velocities else None)
    assert order.point.accelerations == ((0.3, 0.0, 0.0, 0.0, 0.0, 0.0) if accelerations else None)


@pytest.mark.parametrize("valid", [0, 1, 2, 12, 14])
def test_a_point_has_a_time_and_positions(receive: Receiver, valid: int) -> None:
    receive.refuses(full(0, 1.0, valid=valid), f"valid_fields {valid}")


def test_all_points_have_the_fields_of_the_first(receive: Receiver) -> None:
    receive(full(0, 1.0, valid=7))
    receive.refuses(full(1, 2.0, valid=3), "not those of the first point")


def test_another_robot_is_refused(receive: Receiver) -> None:
    receive.refuses(full(0, 1.0, robot=1), "robot_id 1")


def test_our_message_moves_an_arm_of_twelve_joints() -> None:
    twelve = tuple(0.1 * joint for joint in range(12))
    receive = Receiver(replace(STATE, commanded=(0.0,) * 12))
    assert receive(JointPoint(0, 1.0, twelve)) == [Begin(Point(1.0, twelve))]
    receive.refuses(point(0), "found 10 joints, and the arm has 12")


# -- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("duration", [0.0, -0.5])
def test_a_point_back_in_time_is_refused(receive: Receiver, duration: float) -> None:
    receive(point(0))
    receive.refuses(point(1, duration=duration), "not later than 0.5 s")
    receive.ignores(point(2))


def test_a_first_point_elsewhere_in_no_time_is_refused(receive: Receiver) -> None:
    receive.refuses(point(0, 0.5, 0.0), "the arm is not there")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_numbers_that_are_not_finite_are_refused(value: float) -> None:
    Receiver().refuses(point(0, value), "sequence 0, joint 1: the position")
    Receiver().refuses(point(0, 0.5, value), "not finite")
    Receiver().refuses(JointPosition(0, (0.0, value, 0.0, 0.0, 0.0, 0.0)), "joint 2: the position")


def test_joints_that_the_arm_has_not_are_refused(receive: Receiver) -> None:
    Receiver().refuses(JointPosition(0, (*HOME, 0.25, 0.0, 0.0, 0.0)), r"joint 7: .* 0\.25, and the arm has 6 joints")
    receive.refuses(JointPoint(0, 1.0, (*HOME, 0.0)), "found 7 joints, and the arm has 6")
    receive.refuses(JointPoint(0, 1.0, HOME[:5]), "found 5 joints, and the arm has 6")
    receive.refuses(JointPoint(0, 1.0, (0.0,) * 13), "found 13 joints")


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (replace(READY, e_stopped=TriState.TRUE), "emergency stop"),
        (replace(READY, in_error=TriState.TRUE), "fault"),
        (replace(READY, drives_powered=TriState.FALSE), "drives are disabled"),
    ],
)
@pytest.mark.parametrize("message", [point(0), point(START), JointPosition(0, THERE)])
def test_an_arm_that_cannot_move_refuses_a_beginning(
    status: object, reason: str, message: JointPosition | TrajectoryPoint
) -> None:
    Receiver(replace(STATE, status=status)).refuses(message, reason)  # type: ignore[arg-type]


def test_without_a_platform_everything_but_a_stop_is_refused() -> None:
    receive = Receiver(None)
    receive.refuses(point(0), "platform")
    assert receive(point(STOP)) == [Halt()]


# -- real-time points -------------------------------------------------------------------------------------------------


def test_a_real_time_point_is_a_target_at_once(receive: Receiver) -> None:
    assert receive(JointPosition(0, THERE), JointPosition(0, HOME)) == [Target(THERE), Target(HOME)]


def test_a_real_time_point_ends_the_trajectory_before(receive: Receiver) -> None:
    receive(point(0), JointPosition(0, THERE))
    receive.refuses(point(1), "came where 0")


def test_real_time_points_that_go_on_after_a_stop_do_not_move_the_arm_again(receive: Receiver) -> None:
    receive(JointPosition(0, THERE))
    assert receive(JointPosition(STOP, ())) == [Halt()]
    for _ in range(20):
        receive.now += REALTIME_PAUSE_S / 2
        receive.ignores(JointPosition(0, THERE))
    receive.now += REALTIME_PAUSE_S
    assert receive(JointPosition(0, THERE)) == [Target(THERE)]


def test_real_time_points_that_go_on_after_an_emergency_stop_do_not_move_the_arm_again(receive: Receiver) -> None:
    receive.state = replace(STATE, status=replace(READY, e_stopped=TriState.TRUE))
    receive.refuses(JointPosition(0, THERE), "emergency stop")
    receive.state = STATE
    receive.ignores(JointPosition(0, THERE))
