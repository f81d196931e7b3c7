from __future__ import annotations

import struct

import pytest

from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import SlaveState
from rtcp.fieldbus.mailbox import abort_meaning, parse_emergency
from rtcp.ipc.codes import (
    ERROR_CODES,
    REMEDIES,
    code_meaning,
    error_meaning,
    error_remedy,
    error_words,
    refusal,
    state_name,
)
from rtcp.ipc.events import EmergencyMessage, ErrorReset


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (1, "INIT"), (2, "PRE-OP"), (4, "SAFE-OP"), (8, "OP"), (0x14, "SAFE-OP + ERROR"), (0, "no answer"),
        (7, "unknown state 7"),
    ],
)  # fmt: skip
def test_al_states_have_names(state: int, words: str) -> None:
    assert state_name(state) == words


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x001B, "watchdog"), (0x001D, "output configuration"), (0x9001, "specific to the maker"),
        (0x0999, "not in ETG.1020"),
    ],
)  # fmt: skip
def test_al_status_codes_have_words(code: int, words: str) -> None:
    assert words in code_meaning(code)


def test_a_refusal_says_who_was_asked_what_was_found_why_and_what_to_do() -> None:
    sentence = refusal("slave 3 (drive2)", AlState.SAFEOP, 0x12, 0x001D)
    for part in (
        "slave 3 (drive2)",
        "SAFE-OP",
        "PRE-OP + ERROR",
        "0x001D",
        "invalid output configuration",
        "check `rpdo`",
    ):
        assert part in sentence


def test_a_slave_that_is_gone_is_told_to_be_gone() -> None:
    assert "does not answer" in refusal("slave 3 (drive2)", AlState.OP, 0, 0)


@pytest.mark.parametrize(("code", "words"), [(0x06020000, "does not exist"), (0x12345678, "not in the standard")])
def test_abort_codes_have_words(code: int, words: str) -> None:
    assert words in abort_meaning(code)


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x8611, "following error"), (0x3221, "DC link under-voltage"), (0x73FF, "sensor"),
        (0xFF17, "specific to the maker"), (0x0000, "error reset"), (0x0007, "not in CiA 402"),
        (0xB000, "not in CiA 402"),
    ],
)  # fmt: skip
def test_error_codes_have_words_those_unknown_the_words_of_their_class(code: int, words: str) -> None:
    assert words in error_meaning(code)


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x2310, "overloads"), (0x3210, "supply"), (0x3220, "under load"), (0x4310, "cool down"), (0x7305, "encoder"),
        (0x8400, "so fast"), (0x8611, "blocks it"), (0x8130, "bus's cables"), (0x5441, "safety circuit"),
    ],
)  # fmt: skip
def test_error_codes_that_drives_send_say_what_to_do(code: int, words: str) -> None:
    assert words in error_remedy(code)
    assert error_words(code).endswith(f"; {error_remedy(code)}, then `rtcp reset`")


def test_a_code_that_nobody_can_do_anything_about_gives_no_advice() -> None:
    assert error_remedy(0x0000) == error_remedy(0xFF17) == ""
    assert error_words(0xFF17) == "0xFF17: specific to the maker"


def test_every_remedy_belongs_to_a_code_that_has_a_meaning() -> None:
    assert set(REMEDIES) <= set(ERROR_CODES)


def test_the_state_of_a_slave_says_its_code_and_what_to_do() -> None:
    state = SlaveState(3, 0x1003, "drive2", AlState.SAFEOP, True, 0x001B)
    assert state.words() == (
        "SAFE-OP + ERROR (0x001B: sync manager watchdog); no process data came for longer than `watchdog_ms`"
    )
    assert SlaveState(3, 0x1003, "drive2", AlState.OP, False, 0).words() == "OP"


def emergency_message(code: int = 0x8611, service: int = 1) -> bytes:
    return struct.pack("<HHB5s", service << 12, code, 0x21, b"\1\2\3\4\5")


@pytest.mark.parametrize(("code", "kind"), [(0x8611, EmergencyMessage), (0, ErrorReset)])
def test_an_emergency_message_is_read_out_of_a_mailbox(
    code: int, kind: type[EmergencyMessage] | type[ErrorReset]
) -> None:
    assert parse_emergency(emergency_message(code), 4) == kind(4, code, 0x21, 0x0102030405)


@pytest.mark.parametrize("message", [emergency_message(service=3), emergency_message()[:-1], b""])
def test_what_is_no_emergency_is_not_taken_for_one(message: bytes) -> None:
    assert parse_emergency(message, 1) is None
