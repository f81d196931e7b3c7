"""Every refusal and every event has a sentence with value, limit and key."""

from __future__ import annotations

import pytest

from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.ipc.codes import Reason
from rtcp.ipc.machine import ALLOWED, Code, Command, Refusal, State
from rtcp.ipc.messages import Sentences

SENTENCES = Sentences(load(default_config()))


@pytest.mark.parametrize("refusal", [refusal for refusal in Refusal if refusal is not Refusal.NONE])
def test_every_refusal_has_a_sentence(refusal: Refusal) -> None:
    assert len(SENTENCES.refusal(refusal, 1, 4.0, 2.0)) > 20


@pytest.mark.parametrize("code", [code for code in Code if code not in (Code.NONE, Code.ENDED)])
def test_every_event_has_a_sentence(code: Code) -> None:
    assert len(SENTENCES.event(code, 1, 21.0, 20.0)) > 15


@pytest.mark.parametrize("reason", [reason for reason in Reason if reason is not Reason.NONE])
def test_every_reason_for_which_a_motion_ends_has_a_sentence(reason: Reason) -> None:
    assert len(SENTENCES.event(Code.ENDED + reason, 1, 21.0, 20.0)) > 15


def test_a_keep_out_box_is_told_with_its_name_and_key() -> None:
    said = SENTENCES.event(Code.ENDED + Reason.KEEP_OUT, 0, 0.012, 0.0)
    assert "the keep-out box user (cartesian.keep_out[0] in assistive_arm.yaml)" in said
    assert "`rtcp reset`" in said


def test_a_position_outside_its_range_is_told_with_joint_value_range_and_key() -> None:
    said = SENTENCES.refusal(Refusal.POSITION_LIMIT, 1, 9.0, 2.0)
    assert said == "joint2: target 9 rad is outside its range -2 to 2 rad (joints[1].position in assistive_arm.yaml)"


def test_a_position_outside_a_narrowed_range_is_told_with_the_limit_in_force() -> None:
    said = SENTENCES.refusal(Refusal.POSITION_LIMIT, 0, 0.7, 0.5)
    assert said == "joint1: target 0.7 rad is beyond 0.5 rad, to which its range is narrowed (`rtcp limits show`)"


def test_a_command_in_the_wrong_state_is_told_with_the_right_ones() -> None:
    said = SENTENCES.refusal(Refusal.NOT_IN_THIS_STATE, State.READY, Command.MOVE, 0.0)
    assert said == "move is not possible while ready; it is while: holding, moving; `rtcp enable` first"


def test_every_command_is_taken_in_some_state_and_the_end_in_all() -> None:
    assert set(ALLOWED) == set(Command)
    assert all(ALLOWED[command] for command in Command)
    assert ALLOWED[Command.SHUTDOWN] == set(State) - {State.OFF}
