"""Every event and refusal has a message, made of its fields and the names of the configuration."""

from __future__ import annotations

from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.ipc import events
from rtcp.ipc.commands import COMMANDS, Enable
from rtcp.ipc.events import EVENTS, DriveFault, EmergencyStopActivated
from rtcp.ipc.message import PAYLOAD_SIZE, Joints, Kinds, MalformedMessage, Message
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import REFUSALS

NAMES = Names(load(default_config()))
FAMILIES: tuple[Kinds[Any], ...] = (COMMANDS, EVENTS, REFUSALS)


def example(kind: type[Message]) -> Message:
    """A message with a value of the right type in each field; the command that a refusal is about exists."""
    values: list[Any] = []
    for name, field in kind.field_types.items():
        if name == "command":
            values.append(Enable.number)
        elif field == Joints:
            values.append((0.5, -1.5))
        else:
            values.append(next(iter(field)) if hasattr(field, "__members__") else field(1))
    return kind(*values)


@pytest.mark.parametrize("kind", [*EVENTS, *REFUSALS], ids=lambda kind: kind.name)
def test_a_message_names_its_fields_and_leaves_no_placeholder(kind: type[Message]) -> None:
    text = NAMES.message(example(kind))
    assert text
    assert "\n" not in text
    assert not set(text) & {"{", "}"}


@pytest.mark.parametrize(
    ("event", "part"),
    [
        (events.ErrorReported("it is hot", 1, 10.04), "it is hot (once again in 10 s)"),
        (events.MessagesLeftOut(3, 198, 10.0), "further emergency messages of slave 3 were left out: 198 in 10 s"),
        (events.MessagesLeftOut(0, 1, 10.0), "further failures of the bus were left out: 1 in 10 s"),
        (events.EmergencyMessage(3, 0x8611, 0x21, 0x0102030405, 2, 9.6), "reset` (2 times again in 10 s)"),
        (events.EmergencyMessage(3, 0x8611, 0x21, 0x0102030405), "(error register 0x21, data 01 02 03 04 05); check"),
        (events.DriveErrorCode(1, 3, 2, 0x2310), "joint2 (slave 3, axis 2): the drive's error code is 0x2310: cont"),
        (events.SlavesLeftOp(2, 2, 0x14, 0x1B, 1, 4), "`watchdog_ms`; it left OP 4 times since the last report"),
        (events.StateNotReached(2, 8, 4, 0), "slave 2 (drive1) did not reach OP: it is in SAFE-OP; it gave no reason"),
        (events.OtherSlaveAnswers(2, 3), "slave 2 (drive1): at its place answers slave 3 (drive2)"),
        (events.DamagedFrames(7, 0, 1, 0), "errors enter behind slave 7 (drive6): 1 damaged frame since "),
    ],
)
def test_what_happens_beside_the_cycle_has_its_sentence(event: Message, part: str) -> None:
    assert part in NAMES.message(event)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_kind_crosses_memory_unchanged(family: Kinds[Any]) -> None:
    for kind in family:
        memory, sent = bytearray(PAYLOAD_SIZE), example(kind)
        sent.pack_into(memory, 0)
        assert family.unpack_from(kind.number, bytes(memory), 0) == sent


@pytest.mark.parametrize("family", FAMILIES)
def test_numbers_and_names_are_unique(family: Kinds[Any]) -> None:
    kinds = list(family)
    assert len({kind.number for kind in kinds}) == len({kind.name for kind in kinds}) == len(kinds)


def test_a_number_that_no_kind_has_is_malformed() -> None:
    with pytest.raises(MalformedMessage, match="12345"):
        COMMANDS.unpack_from(12345, bytes(PAYLOAD_SIZE), 0)


def test_a_field_without_a_meaning_is_malformed() -> None:
    kind = COMMANDS.named("set_drive_mode")
    assert kind is not None
    with pytest.raises(MalformedMessage, match="set_drive_mode"):
        COMMANDS.unpack_from(kind.number, b"\xff" * PAYLOAD_SIZE, 0)


def test_a_second_kind_with_the_same_number_is_refused() -> None:
    with pytest.raises(ValueError, match="18 is that of drive_fault"):
        type("Another", (DriveFault,), {"__module__": __name__, "__annotations__": {}}, number=18)


def test_the_reaction_and_its_key_stand_in_the_message_of_a_fault() -> None:
    message = NAMES.message(EmergencyStopActivated())
    assert "quick stop, then torque off (stops.emergency_stop in assistive_arm.yaml)" in message
