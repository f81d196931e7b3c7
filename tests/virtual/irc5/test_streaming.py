"""RAPID streaming in simulated time: bytes, the queue and its delay, back-pressure, corners, stops, downloads."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.virtual.irc5.config import Irc5Config, RapidConfig, UnitConfig
from rtcp.virtual.irc5.controller import Controller
from rtcp.virtual.irc5.simple_message import Frame, NotAMessage, joint_position, read_joint_point, take_frame
from rtcp.virtual.request_socket import RequestRefused

PERIOD = 0.004
RATE_S = 1 / 30
SUCCESS, FAILURE = 1, 2
MIDDLE = (0.0,) * 6
NO_DELAY = {"position_delay_s": (0.0, 0.0)}


class Cell:
    """A controller in simulated time, and the client of its motion server."""

    def __init__(self, arms: int = 1, rapid: dict[str, Any] | None = None, **controller: Any) -> None:
        units = tuple(
            UnitConfig(f"ROB_{i + 1}", 6511 + i, initial_position=MIDDLE, period_s=PERIOD) for i in range(arms)
        )
        config = Irc5Config(units, rapid=RapidConfig(**NO_DELAY | (rapid or {})), **controller)
        self.controller = Controller(config)
        self.streaming = self.controller.streaming
        self.unit = self.controller.units["ROB_1"].mechanical
        self.task = self.streaming.tasks["ROB_1"]
        self.arms = arms
        self.clock = 0.0

    def step(self) -> int | None:
        """Advance by one period; return the code of its reply, None without a reply."""
        self.clock += PERIOD
        self.controller.panel.advance(PERIOD)
        reply = self.streaming.step(PERIOD)
        return None if reply is None else int(struct.unpack("<4i", reply)[3])

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            assert self.step() is None

    def send(self, sequence: int, degrees: Sequence[float], duration: float = RATE_S) -> None:
        """Send a point: degrees of the first joints, 0 for the others."""
        joints = [*degrees, *[0.0] * (max(10, 6 * self.arms) - len(degrees))]
        body = struct.pack(f"<i{len(joints) + 2}f", sequence, *map(math.radians, joints), 0.0, duration)
        assert not self.streaming.is_busy
        self.streaming.receive(Frame(11, 2, 0, body))

    def ask(self, sequence: int, degrees: Sequence[float] = (), duration: float = RATE_S) -> tuple[int, float]:
        """Send a point; return the reply's code and the time until it, s."""
        self.send(sequence, degrees, duration)
        begun = self.clock
        while (code := self.step()) is None:
            assert self.clock < begun + 3.0
        return code, self.clock - begun

    def run_until_rest(self) -> float:
        """Run until the queue is empty; return the time, s."""
        begun = self.clock
        while self.task.moves_ahead:
            self.step()
            assert self.clock < begun + 60.0
        return self.clock - begun


# -- bytes -------------------------------------------------------------------------------------------------------------


def test_the_length_says_how_many_joints_a_point_has() -> None:
    ten = bytes.fromhex("40000000 0b000000 02000000 00000000 07000000") + struct.pack("<12f", *range(10), 0.5, 0.25)
    twelve = bytes.fromhex("48000000 0b000000 02000000 00000000 08000000") + struct.pack("<14f", *range(12), 0.5, 0.25)
    data = bytearray(ten + twelve)
    first, second = take_frame(data), take_frame(data)
    assert (len(data), len(ten), len(twelve)) == (0, 4 + 64, 4 + 72)
    assert read_joint_point(first, 6) == (7, tuple(range(6)), 0.25)
    assert read_joint_point(first, 12) is None
    assert read_joint_point(second, 12) == (8, tuple(range(12)), 0.25)


def test_a_joint_position_of_12_joints_is_as_long_as_a_point_of_10_and_is_none() -> None:
    message = joint_position(0, [0.0] * 12)
    assert struct.unpack_from("<2i", message) == (64, 10)
    frame = take_frame(bytearray(message))
    assert read_joint_point(frame, 6) is None


def test_a_message_that_comes_byte_by_byte_is_complete_at_its_last() -> None:
    data = bytearray()
    message = joint_position(3, [0.5])
    for byte in message[:-1]:
        data.append(byte)
        assert take_frame(data) is None
    data.append(message[-1])
    frame = take_frame(data)
    assert frame == (10, 1, 0, message[16:])


@pytest.mark.parametrize("length", [-1, 0, 11, 1024, 1 << 24])
def test_a_length_that_no_message_has_is_refused(length: int) -> None:
    with pytest.raises(NotAMessage, match=rf"length {length} is outside 12..1023"):
        take_frame(bytearray(struct.pack("<i", length)))


@pytest.mark.parametrize(("arms", "length"), [(1, 56), (2, 64)])
def test_state_is_the_joints_of_all_arms_and_then_the_status(arms: int, length: int) -> None:
    cell = Cell(arms)
    state = bytearray(cell.streaming.state())
    assert struct.unpack_from("<4i", state) == (length, 10, 1, 0)
    assert state[4 + length :] == bytes.fromhex("28000000 0d000000 01000000 00000000") + struct.pack(
        "<7i", 1, 0, 0, 0, 0, 2, 1
    )


# -- ahead of the motion -----------------------------------------------------------------------------------------------


def test_a_sine_at_30_hz_is_late_by_what_was_measured_on_the_real_one() -> None:
    cell = Cell(rapid={"position_delay_s": (-0.005, 0.012)})
    amplitude, period = math.degrees(math.pi / 16), 2.0
    sine = cosine = sent = 0.0
    while cell.clock < 10.0:
        if cell.clock >= sent * RATE_S and not cell.streaming.is_busy:
            cell.send(round(sent), [amplitude * math.sin(2 * math.pi * cell.clock / period)])
            sent += 1
        cell.step()
        if cell.clock > 6.0:  # two periods
            angle = 2 * math.pi * cell.clock / period
            joint = struct.unpack_from("<f", cell.streaming.state(), 20)[0]
            assert 12 <= cell.task.moves_ahead <= 14
            sine, cosine = sine + joint * math.sin(angle), cosine + joint * math.cos(angle)
    assert math.atan2(-cosine, sine) * period / (2 * math.pi) == pytest.approx(0.455, abs=0.01)
    assert cell.unit.counts["corner_path_failure"] == 0


def test_replies_follow_acceptance_and_wait_for_room_in_the_queue() -> None:
    cell = Cell(rapid={"queue_moves": 4, "start_delay_s": 10.0})
    answers = [cell.ask(i, [0.2 * i]) for i in range(20)]
    assert {code for code, _ in answers} == {SUCCESS}
    assert all(seconds == pytest.approx(PERIOD) for _, seconds in answers[:4])
    for _, seconds in answers[7:]:  # the arm moves: each move frees a place
        assert seconds == pytest.approx(RATE_S, abs=1.1 * PERIOD)
    assert cell.task.moves_ahead == 5  # four in the queue and the current one


def test_motion_begins_after_the_look_ahead() -> None:
    cell = Cell(rapid={"start_delay_s": 0.3})
    assert cell.ask(0, [1.0])[0] == SUCCESS
    cell.wait(0.288)
    assert cell.unit.planned[0] == 0.0
    cell.wait(0.012)
    assert cell.unit.planned[0] > 0.0


def test_a_point_in_time_is_passed_in_a_corner_and_a_late_one_makes_a_stop_point() -> None:
    cell = Cell(rapid={"start_delay_s": 0.1})
    cell.ask(0, [2.0], 0.2)
    cell.wait(0.16)
    cell.ask(1, [4.0], 0.2)
    slowest = math.inf
    while cell.unit.planned[0] < 2.5:
        cell.step()
        slowest = min(slowest, cell.unit.speeds[0]) if cell.unit.planned[0] > 1.5 else math.inf
    assert slowest == pytest.approx(10.0)
    assert cell.unit.counts["corner_path_failure"] == 0
    cell.wait(0.14)
    cell.ask(2, [6.0], 0.2)
    speeds = []
    while cell.unit.planned[0] < 5.0:
        cell.step()
        speeds.append(cell.unit.speeds[0])
    assert (min(speeds), cell.unit.counts["corner_path_failure"]) == (0.0, 1)


def test_a_corner_is_cut_to_half_the_distance_and_does_not_stop() -> None:
    cell = Cell(rapid={"zone_mm": 1000.0, "start_delay_s": 0.1})
    cell.ask(0, [2.0], 0.2)
    cell.ask(1, [2.0, 2.0], 0.2)
    path = []
    while cell.task.moves_ahead:
        cell.step()
        path.append(tuple(cell.unit.planned[:2]))
    corner = min(math.dist(point, (2.0, 0.0)) for point in path)
    assert corner == pytest.approx(math.hypot(0.25, 0.25), abs=0.02)  # a parabola from middle to middle
    assert [point for point in path if point[0] < 0.99 and point[1] > 0.0] == []
    inside = [point for point in path if point[0] > 0.6 and point[1] < 1.4]
    assert min(math.dist(a, b) for a, b in pairwise(inside)) > 0.02


def test_a_small_zone_passes_close_to_the_point() -> None:
    cell = Cell(rapid={"zone_mm": 1.0, "start_delay_s": 0.1})
    cell.ask(0, [10.0], 1.0)
    cell.ask(1, [10.0, 10.0], 1.0)
    nearest = math.inf
    while cell.task.moves_ahead:
        cell.step()
        nearest = min(nearest, math.dist(cell.unit.planned[:2], (10.0, 0.0)))
    assert 0.0 < nearest < 0.2


@pytest.mark.parametrize(("degrees", "duration", "seconds"), [(10.0, 0.5, 0.5), (100.0, 0.1, 100.0 / 250.0)])
def test_a_move_takes_its_duration_or_as_long_as_the_joint_needs(
    degrees: float, duration: float, seconds: float
) -> None:
    cell = Cell(rapid={"start_delay_s": 0.0, "ramp_s": 0.02, "max_speed": 1000.0})
    cell.ask(0, [degrees], duration)
    assert cell.run_until_rest() == pytest.approx(seconds + 0.02, abs=2.1 * PERIOD)
    assert max(abs(speed) for speed in cell.unit.speeds) <= cell.unit.speed_limits[0] + 1e-6


def test_the_reported_position_is_late_by_the_set_delay() -> None:
    cell = Cell(rapid={"start_delay_s": 0.0, "position_delay_s": (-0.005, 0.012)})
    cell.ask(0, [10.0], 1.0)
    cell.wait(0.5)
    for delay in (-0.005, 0.0, 0.012):
        behind = cell.unit.planned[0] - cell.task.reported(delay)[0]
        assert behind == pytest.approx(10.0 * (0.014 + delay), abs=1e-6)  # 14 ms between planned and actual position


# -- stops -------------------------------------------------------------------------------------------------------------


def moving(**keys: Any) -> Cell:
    """An arm in a long move, with another move in its queue."""
    cell = Cell(rapid={"start_delay_s": 0.0}, **keys)
    cell.ask(0, [50.0], 1.0)
    cell.ask(1, [100.0], 1.0)
    cell.wait(0.5)
    assert cell.unit.speeds[0] == pytest.approx(50.0)
    return cell


def test_a_stop_message_slows_down_empties_the_queue_and_is_answered_at_rest() -> None:
    cell = moving()
    begun = cell.unit.planned[0]
    code, seconds = cell.ask(-4)
    assert code == SUCCESS
    assert seconds == pytest.approx(0.1, abs=2 * PERIOD)
    assert cell.unit.planned[0] - begun == pytest.approx(50.0 * 0.1 / 2, abs=0.3)
    assert (cell.unit.speeds[0], cell.task.moves_ahead) == (0.0, 0)
    assert cell.ask(0, [0.0], 2.0)[0] == SUCCESS
    cell.run_until_rest()
    assert cell.unit.planned[0] == pytest.approx(0.0, abs=1e-6)


def test_after_a_rapid_stop_points_are_refused_and_the_start_goes_on_with_the_path() -> None:
    cell = moving()
    cell.controller.request({"do": "stop_rapid"})
    cell.wait(0.2)
    assert cell.unit.speeds[0] == 0.0
    code, seconds = cell.ask(2, [0.0], 2.0)
    assert code == FAILURE
    assert seconds == pytest.approx(0.5, abs=PERIOD)
    cell.controller.request({"do": "start_rapid"})
    cell.run_until_rest()
    assert cell.unit.planned[0] == pytest.approx(100.0)


@pytest.mark.parametrize(("category", "seconds"), [(0, 0.15), (1, 0.4)])
def test_an_emergency_stop_halts_the_path_until_motors_and_rapid_are_started(category: int, seconds: float) -> None:
    cell = moving(emergency_stop_category=category)
    cell.controller.request({"do": "stop", "circuit": "emergency"})
    before = cell.unit.planned[0]
    cell.wait(seconds + 0.02)
    assert cell.unit.speeds[0] == 0.0
    assert cell.unit.planned[0] - before == pytest.approx(50.0 * seconds / 2, rel=0.1)
    state = cell.streaming.state()
    assert struct.unpack_from("<7i", state, len(state) - 28) == (0, 1, 0, 0, 0, 2, 0)
    assert cell.ask(2, [0.0])[0] == FAILURE
    cell.controller.request({"do": "release", "circuit": "emergency"})
    cell.controller.request({"do": "motors_on"})
    cell.wait(0.2)
    assert cell.unit.speeds[0] == 0.0
    cell.controller.request({"do": "start_rapid"})
    cell.run_until_rest()
    assert cell.unit.planned[0] == pytest.approx(100.0)


def test_the_flange_has_250_mm_a_second_in_hand() -> None:
    cell = Cell(rapid={"start_delay_s": 0.0}, mode="hand")
    cell.controller.request({"do": "enabling", "position": "middle"})
    cell.controller.request({"do": "start_rapid"})
    cell.ask(0, [85.0], 0.5)
    fastest = 0.0
    while cell.task.moves_ahead:
        before = cell.unit.geometry.flange(cell.unit.planned).position
        cell.step()
        fastest = max(fastest, math.dist(before, cell.unit.geometry.flange(cell.unit.planned).position) / PERIOD)
    assert fastest == pytest.approx(250.0, rel=0.01)


def test_a_client_that_is_gone_stops_the_arms() -> None:
    cell = moving()
    cell.streaming.disconnect()
    cell.wait(0.2)
    assert (cell.unit.speeds[0], cell.task.moves_ahead) == (0.0, 0)


def test_a_target_outside_the_range_ends_rapid_with_an_error() -> None:
    cell = Cell()
    assert cell.ask(0, [0.0, 120.0], 1.0)[0] == SUCCESS  # the server accepts it, the move refuses it
    assert "50027 joint out of range: joint 2 to 120, allowed are -110 to 110" in cell.unit.events
    state = cell.streaming.state()
    assert struct.unpack_from("<7i", state, len(state) - 28) == (1, 0, 0, 1, 0, 2, 0)
    assert cell.ask(1, [0.0])[0] == FAILURE
    cell.controller.request({"do": "start_rapid"})
    state = cell.streaming.state()
    assert struct.unpack_from("<7i", state, len(state) - 28) == (1, 0, 0, 0, 0, 2, 1)


def test_a_point_that_asks_for_too_high_a_speed_is_refused_from_where_the_arm_is_commanded() -> None:
    cell = Cell(rapid={"max_speed": 100.0})
    assert cell.ask(0, [0.0, 5.1], 0.05)[0] == FAILURE
    assert cell.ask(0, [0.0, 4.9], 0.05)[0] == SUCCESS
    assert cell.ask(1, [0.0, 9.8], 0.05)[0] == SUCCESS
    assert cell.ask(2, [0.0, 4.7], 0.05)[0] == FAILURE
    assert cell.ask(-4)[0] == SUCCESS  # before the motion begins: the target is 0 again
    assert cell.ask(-1, [0.0, -4.9], 0.05)[0] == SUCCESS
    assert cell.ask(-3, [0.0, -10.0], 0.05)[0] == FAILURE


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused(value: float) -> None:
    cell = Cell()
    body = struct.pack("<i12f", 0, value, *[0.0] * 10, 0.1)
    cell.streaming.receive(Frame(11, 2, 0, body))
    assert cell.step() == FAILURE


# -- two arms ----------------------------------------------------------------------------------------------------------


def test_two_arms_move_by_one_message() -> None:
    cell = Cell(arms=2)
    assert cell.ask(0, [5.0, *[0.0] * 5, -5.0, *[0.0] * 5], 0.2)[0] == SUCCESS
    cell.run_until_rest()
    cell.wait(0.1)
    joints = struct.unpack_from("<12f", cell.streaming.state(), 20)
    assert [math.degrees(joints[i]) for i in (0, 6)] == pytest.approx([5.0, -5.0], abs=1e-4)


def test_a_point_without_the_joints_of_all_arms_is_refused() -> None:
    cell = Cell(arms=2)
    cell.arms = 1
    assert cell.ask(0, [5.0])[0] == FAILURE


def test_one_arm_lost_stops_on_its_brakes_and_no_point_is_accepted_any_more() -> None:
    cell = Cell(arms=2, rapid={"start_delay_s": 0.0})
    cell.ask(0, [50.0, *[0.0] * 5, 50.0], 1.0)
    cell.wait(0.5)
    cell.controller.request({"do": "fault", "unit": "ROB_2", "fault": "arm_lost"})
    cell.wait(0.2)
    lost = cell.controller.units["ROB_2"].mechanical
    assert cell.unit.speeds[0] == pytest.approx(50.0)
    assert lost.speeds[0] == 0.0
    assert cell.ask(1, [60.0, *[0.0] * 5, 60.0], 1.0)[0] == FAILURE
    assert lost.planned[0] < 40.0
    cell.controller.request({"do": "clear"})
    cell.controller.request({"do": "start_rapid"})
    cell.run_until_rest()
    assert cell.ask(1, [60.0, *[0.0] * 5, 60.0], 1.0)[0] == SUCCESS


# -- downloads ---------------------------------------------------------------------------------------------------------


def test_a_download_is_executed_when_its_last_point_is_there_and_ends_at_rest() -> None:
    cell = Cell(rapid={"start_delay_s": 0.1})
    points = [(-1, 0.0), *((i, 2.0 * i) for i in range(1, 30)), (-3, 60.0)]
    for sequence, degrees in points:
        assert cell.ask(sequence, [degrees], 0.1)[0] == SUCCESS
        assert cell.unit.planned[0] == 0.0
    seconds = cell.run_until_rest()
    assert seconds == pytest.approx(30 * 0.1 + 0.1, abs=0.03)  # moves, ramps; the full queue ends the look-ahead
    assert cell.unit.planned[0] == pytest.approx(60.0)
    assert cell.unit.counts["corner_path_failure"] == 0


def test_a_new_download_stops_the_one_under_way() -> None:
    cell = Cell(rapid={"start_delay_s": 0.0})
    cell.ask(-1, [50.0], 1.0)
    for i in range(1, 30):  # more than the queue has room for
        cell.ask(i, [50.0 + i], 1.0)
    cell.ask(-3, [100.0], 1.0)
    cell.wait(0.5)
    code, seconds = cell.ask(-1, [0.0], 1.0)
    assert code == SUCCESS
    assert seconds == pytest.approx(0.1, abs=2 * PERIOD)
    assert cell.unit.speeds[0] == 0.0
    assert cell.task.moves_ahead == 0


def test_a_point_waits_until_a_download_is_executed_and_a_new_sequence_ends_one_that_is_not_complete() -> None:
    cell = Cell(rapid={"start_delay_s": 0.1, "accept_timeout_s": 100.0})
    cell.ask(-1, [2.0], 0.1)
    cell.ask(-3, [4.0], 0.1)
    code, seconds = cell.ask(0, [0.0], 0.2)
    assert code == SUCCESS
    assert seconds == pytest.approx(0.1 + 0.2 + 0.1, abs=0.02)  # look-ahead, moves, ramps
    assert cell.unit.planned[0] == pytest.approx(4.0)
    cell.ask(-1, [90.0], 1.0)
    assert cell.ask(0, [6.0], 0.2)[0] == SUCCESS
    cell.run_until_rest()
    assert cell.unit.planned[0] == pytest.approx(6.0)


def test_a_download_that_is_refused_leaves_the_arm_where_it_is_commanded() -> None:
    cell = Cell(rapid={"max_speed": 10.0})
    cell.controller.request({"do": "stop_rapid"})
    cell.ask(-1, [5.0], 1.0)
    assert cell.ask(-3, [10.0], 1.0)[0] == FAILURE
    cell.controller.request({"do": "start_rapid"})
    assert cell.ask(0, [-1.0], 0.2)[0] == SUCCESS


def test_a_download_has_200_points_at_most() -> None:
    cell = Cell()
    codes = [cell.ask(-1 if i == 0 else i, [0.0])[0] for i in range(201)]
    assert codes == [SUCCESS] * 200 + [FAILURE]


# -- the operator ------------------------------------------------------------------------------------------------------


def test_faults_of_egm_are_refused_with_what_is_allowed() -> None:
    with pytest.raises(RequestRefused, match="allowed with rapid is one of socket_cut, half_message, silent_state"):
        Cell().controller.request({"do": "fault", "fault": "late"})


def test_the_operator_sees_queues_and_corner_path_failures() -> None:
    cell = Cell()
    cell.ask(0, [1.0])
    status = cell.controller.request({"do": "status"})
    assert status["streaming"]["moves_ahead"] == {"ROB_1": 1}
    cell.run_until_rest()
    status = cell.controller.request({"do": "status"})
    assert status["units"]["ROB_1"]["counts"] == {"corner_path_failure": 1}
