"""Faults on command, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.virtual.irc5.faults import DatagramFaults
from rtcp.virtual.request_socket import RequestRefused
from tests.virtual.irc5.wire import Pc, pc

STILL = (0.0,) * 6


def begin(robot: Pc, fault: str, **keys: Any) -> None:
    robot.controller.request({"do": "fault", "unit": "ROB_1", "fault": fault, **keys})


def seqnos(robot: Pc, cycles: int) -> list[int | None]:
    states = [robot.cycle(STILL) for _ in range(cycles)]
    return [None if state is None else state.seqno for state in states]


def test_a_silent_robot_still_reads_until_it_is_cleared() -> None:
    robot = pc()
    begin(robot, "silent")
    assert seqnos(robot, 5) == [None] * 5
    assert robot.unit.counts["used"] == 5
    robot.controller.request({"do": "clear"})
    assert seqnos(robot, 2) == [5, 6]


def test_a_silent_pc_is_a_time_out() -> None:
    robot = pc(loop=False)
    begin(robot, "silent", direction="from_pc")
    robot.wait(0.3, STILL)
    assert "ERR_UDPUC_COMM" in robot.unit.events[-1]


def test_lost_datagrams_are_missing_and_the_rest_is_in_order() -> None:
    robot = pc()
    begin(robot, "lost", value=0.3)
    arrived = [number for number in seqnos(robot, 1000) if number is not None]
    assert 600 < len(arrived) < 800
    assert arrived == sorted(set(arrived))


def test_late_datagrams_come_so_many_cycles_later() -> None:
    robot = pc()
    assert seqnos(robot, 2) == [0, 1]
    begin(robot, "late", value=3)
    assert seqnos(robot, 5) == [None, None, None, 2, 3]


@pytest.mark.parametrize(("kind", "expected"), [("doubled", [b"1", b"1"]), ("lost", [])])
def test_a_share_of_1_takes_every_datagram(kind: str, expected: list[bytes]) -> None:
    faults = DatagramFaults(1)
    faults.shares[kind] = 1.0
    assert faults.cycle([b"1"]) == expected


def test_old_datagrams_are_earlier_ones_again() -> None:
    robot = pc()
    begin(robot, "old", value=0.5)
    numbers = [number for number in seqnos(robot, 200) if number is not None]
    behind = [cycle - number for cycle, number in enumerate(numbers)]
    assert max(behind) > 0
    assert min(behind) == 0
    assert max(behind) < 25


def test_doubled_datagrams_of_the_pc_fill_the_queue_and_so_become_lag() -> None:
    robot = pc(egm={"low_pass_hz": 0.0})
    begin(robot, "doubled", value=1, direction="from_pc")
    for cycle in range(40):
        robot.cycle(None, (float(cycle), 0, 0, 0, 0, 0))
    assert robot.unit.speeds[0] == pytest.approx(19.0)


def test_a_restart_counts_seqno_from_0_again() -> None:
    robot = pc()
    robot.wait(0.1, STILL)
    begin(robot, "seqno_restart")
    assert seqnos(robot, 3) == [0, 1, 2]


def test_a_rapid_stop_shows_in_state_and_message() -> None:
    robot = pc()
    begin(robot, "rapid_stop")
    state = robot.read(STILL)
    assert (state.mci, state.rapid_running, state.motors_on) == ("stopped", False, True)


def test_the_end_by_convergence_can_be_had_at_once_but_only_while_running() -> None:
    robot = pc(loop=False)
    begin(robot, "convergence")
    state = robot.read(STILL)
    assert (state.mci, state.converged) == ("stopped", True)
    with pytest.raises(RequestRefused, match="ROB_1 is in MCI_STOPPED: only MCI_RUNNING ends by convergence"):
        begin(robot, "convergence")


def test_an_mci_error_stops_rapid_and_the_next_start_makes_a_new_session() -> None:
    robot = pc()
    robot.wait(0.1, STILL)
    begin(robot, "mci_error")
    assert robot.read(STILL).mci == "error"
    robot.controller.request({"do": "start_rapid", "unit": "ROB_1"})
    state = robot.read(STILL)
    assert (state.mci, state.seqno) == ("running", 0)


def test_a_utilization_over_100_is_reported() -> None:
    robot = pc()
    begin(robot, "utilization", value=130)
    assert robot.read(STILL).utilization == 130.0


@pytest.mark.parametrize(("robotware", "reported"), [(7, [1]), (6, None)])
def test_a_collision_is_an_error_which_robotware_7_also_names(robotware: int, reported: list[int] | None) -> None:
    robot = pc(robotware=robotware)
    robot.wait(0.1, None, (20.0, 0, 0, 0, 0, 0))
    begin(robot, "collision")
    state = robot.read()
    assert state.mci == "error"
    assert (state.part(12)[1] if 12 in state.fields else None) == reported
    robot.wait(0.2)
    assert robot.unit.speeds == [0.0] * 6


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({}, "do: found nothing, allowed is one of status, motors_on,"),
        ({"do": ["stop"]}, "do: found a list, allowed is one of"),
        ({"do": "stop"}, "circuit: found nothing, allowed is one of emergency, automatic, general, superior"),
        ({"do": "stop", "circuit": ["emergency"]}, "circuit: found a list"),
        ({"do": "mode", "mode": "manual"}, 'mode: found the text "manual", allowed is one of hand, auto'),
        ({"do": "status", "unit": "ROB_1"}, "unit: this key does not exist; allowed are do"),
        ({"do": "clear", "unit": "ROB_2"}, 'unit: found the text "ROB_2", allowed is one of ROB_1'),
        ({"do": "fault", "unit": "ROB_1"}, "fault: found nothing, allowed is one of seqno_restart, rapid_stop,"),
        ({"do": "fault", "fault": "lost", "value": 1.5}, "value: found 1.5, allowed is a number from 0 to 1"),
        ({"do": "fault", "fault": "late", "value": True}, "value: found true, allowed is a number from 0 to 250"),
        ({"do": "fault", "fault": "late", "value": float("nan")}, "value: found nan"),
        ({"do": "fault", "fault": "silent", "direction": "up"}, 'direction: found the text "up", allowed is one of'),
    ],
)
def test_a_request_that_cannot_be_met_is_refused_with_what_is_allowed(request_: dict[str, Any], sentence: str) -> None:
    with pytest.raises(RequestRefused) as refused:
        pc().controller.request(request_)
    assert str(refused.value).startswith(sentence)
