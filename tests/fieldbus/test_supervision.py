"""The slave watcher against a virtual segment: real processes, real frames, faults made at the segment."""

from __future__ import annotations

from typing import Any

import pytest

from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.recovery import Action, action_for
from tests.fieldbus.conftest import WATCHER, Segment

OP = ["OP"] * 3


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of all faults, one after the other on one segment of an IO box and two drives."""
    segment = Segment(tmp_path_factory.mktemp("segment") / "segment.yaml", 3)
    try:
        answer = segment.master("episodes", receive_fraction=0.5, child=WATCHER, control=str(segment.control))
    finally:
        segment.end()
    assert "result" in answer, answer
    return answer["result"]


@pytest.mark.parametrize(
    ("state", "error", "action"),
    [
        (AlState.SAFEOP, True, Action.ACKNOWLEDGE),
        (AlState.SAFEOP, False, Action.REQUEST_OP),
        (AlState.INIT, False, Action.RECONFIGURE),
        (AlState.INIT, True, Action.RECONFIGURE),
        (AlState.PREOP, False, Action.RECONFIGURE),
        (AlState.PREOP, True, Action.RECONFIGURE),
        (AlState.BOOT, False, Action.RECONFIGURE),
        (AlState.NONE, False, Action.MARK_LOST),
        (AlState.OP, False, Action.NOTHING),
    ],
)
def test_what_is_done_with_a_slave_follows_from_its_state(state: AlState, error: bool, action: Action) -> None:
    assert action_for(state, error) is action


def test_a_drive_that_was_without_supply_is_set_up_again_as_it_was(results: dict[str, Any]) -> None:
    result = results["supply"]
    assert result["states"] == OP
    assert (result["lost"], result["recovered"], result["left"]) == ([0, 1, 1], [0, 1, 1], [2])
    assert result["after"] == result["before"]
    assert result["before"][1]["activation"] == "03"
    assert max(abs(difference) for difference, _ in result["clocks"][1:]) < 5_000, result["clocks"]
    # SYNC0 of both drives on the common grid: no shift is configured.
    assert [phase for _, phase in result["clocks"][1:]] == [0, 0]
    assert result["whole"]
    messages = "\n".join(result["reported"])
    assert "slave 2 (drive1) to slave 3 (drive2) left OP: none of them answers" in messages
    assert "check the supply of slave 2 (drive1) and the cable between slave 1 (io) and slave 2 (drive1)" in messages
    assert "slave 2 (drive1) is set up again: it was without supply" in messages
    assert "slave 2 (drive1) is back in OP after" in messages


def test_a_reference_clock_that_was_without_supply_goes_on_with_the_others_time(results: dict[str, Any]) -> None:
    result = results["reference"]
    assert result["states"] == OP
    assert result["after"] == result["before"]
    # With another time of the reference, the drives' clocks would still drift towards it, 1 ms/s.
    assert max(abs(difference) for difference, _ in result["clocks"][1:]) < 5_000, result["clocks"]
    assert [phase for _, phase in result["clocks"][1:]] == [0, 0]
    assert result["whole"]


def test_slaves_behind_a_mended_cable_come_back_without_a_new_set_up(results: dict[str, Any]) -> None:
    result = results["cable"]
    assert result["states"] == OP
    assert (result["lost"], result["recovered"]) == ([0, 1, 1], [0, 1, 1])
    assert result["seen"][0] == ["OP"]
    assert result["seen"][1][:2] == ["no answer", "SAFE-OP + ERROR"]
    assert {"INIT", "PRE-OP"}.isdisjoint(result["seen"][1])
    assert not any("set up again" in sentence for sentence in result["reported"])


@pytest.mark.parametrize("state", ["SAFE-OP", "PRE-OP"])
def test_a_slave_that_fell_is_brought_back_and_the_fall_is_told_with_its_reason(
    results: dict[str, Any], state: str
) -> None:
    result = results[state]
    assert result["states"] == OP
    assert (result["left"], result["lost"], result["recovered"]) == ([3], [0, 0, 1], [0, 0, 1])
    assert result["after"] == result["before"]
    (fell,) = [sentence for sentence in result["reported"] if "left OP" in sentence]
    for part in ("slave 3 (drive2)", f"{state} + ERROR", "0x001B: sync manager watchdog", "`watchdog_ms`"):
        assert part in fell


def test_a_slave_that_refuses_op_is_asked_again_after_a_pause_and_keeps_no_other_waiting(
    results: dict[str, Any],
) -> None:
    result = results["refusal"]
    assert result["states"] == OP
    # OP was requested at once, after 1 s, and after 2 s.
    assert result["took_s"] > 1.2
    assert 2 <= result["seen"][1].count("SAFE-OP + ERROR") <= 4
    assert result["seen"][2].count("SAFE-OP + ERROR") == 1
    sentences = [sentence for sentence in result["reported"] if "did not reach OP" in sentence]
    assert len(sentences) == 1
    for part in ("slave 2 (drive1)", "0x0052", "external hardware is not ready", "check the device's supply"):
        assert part in sentences[0]
    order = [sentence for sentence in result["reported"] if "is back in OP" in sentence]
    assert order[0].startswith("slave 3 (drive2)")


def test_a_slave_that_goes_on_refusing_op_is_set_up_again(results: dict[str, Any]) -> None:
    result = results["clock"]
    assert result["states"] == OP
    assert result["after"] == result["before"]
    assert max(abs(difference) for difference, _ in result["clocks"][1:]) < 5_000
    assert any("slave 3 (drive2) did not reach OP" in sentence for sentence in result["reported"])


def test_a_slave_whose_answers_are_late_keeps_neither_turns_nor_other_slaves_waiting(results: dict[str, Any]) -> None:
    result = results["late"]
    assert result["states"] == OP
    beside = result["acted"]
    assert beside["names"] == ["Cubemars ORH70"]
    # While a few of the late slave's answers came, 0.6 s each, there were 15 turns with an object of another slave.
    assert beside["count"] == 15


def test_a_foreign_device_is_told_and_left_alone(results: dict[str, Any]) -> None:
    result = results["foreign"]
    (message,) = [sentence for sentence in result["reported"] if "another device" in sentence]
    for part in ("slave 3 (drive2)", "product 0x00040201", "expected Cubemars ORH", "0x00004711"):
        assert part in message
    assert result["acted"] == ["OP", "OP", "INIT"]


def test_another_device_of_the_same_kind_is_told_by_its_serial_number_and_left_alone(results: dict[str, Any]) -> None:
    result = results["swapped"]
    (message,) = [sentence for sentence in result["reported"] if "at its place answers" in sentence]
    for part in ("slave 3 (drive2)", "another Cubemars ORH", "(serial number 1), expected serial number 18193"):
        assert part in message
    assert result["acted"] == ["OP", "OP", "INIT"]


def test_parked_slaves_stay_in_pre_op_and_come_back_with_their_set_up(results: dict[str, Any]) -> None:
    result = results["parked"]
    assert result["acted"] == ["PRE-OP"] * 3
    assert result["states"] == OP
    assert (result["left"], result["lost"], result["reported"]) == ([], [0, 0, 0], [])
    assert result["after"] == result["before"]


def test_damaged_frames_are_counted_beyond_the_register_and_their_cable_is_named(results: dict[str, Any]) -> None:
    result = results["damage"]
    io, first, second = result["errors"]
    assert io == [0, 0, 0]
    assert (first[1:], second[0], second[2]) == ([0, 0], 0, 0)
    assert 390 < min(first[0], second[1]) <= max(first[0], second[1]) <= 400
    sentences = [sentence for sentence in result["reported"] if "errors enter" in sentence]
    assert len(sentences) == 1
    assert sentences[0].startswith("errors enter between slave 1 (io) and slave 2 (drive1): ")
    assert "check that cable and its plugs" in sentences[0]
    assert not any("slave 3" in sentence for sentence in sentences)


def test_a_cable_that_loses_its_link_is_named_once(results: dict[str, Any]) -> None:
    result = results["link"]
    sentences = [sentence for sentence in result["reported"] if "the link" in sentence]
    assert len(sentences) == 1
    assert sentences[0].startswith("the link between slave 2 (drive1) and slave 3 (drive2) was lost once since ")
