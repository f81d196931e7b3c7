"""Messages of the heater: each is made of its fields, and crosses shared memory unchanged."""

from __future__ import annotations

from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.commands import COMMANDS, Command, ProcessCommand
from rtcp.ipc.events import EVENTS, Event
from rtcp.ipc.message import PAYLOAD_SIZE, Message
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import REFUSALS
from rtcp.processes.shape_setting import messages
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.messages import ArmHeater, HeatRod, MeasureResistance, StartHeating, StopHeating

NAMES = Names(load(default_config()))
KINDS: list[type[Message]] = [
    kind for family in (COMMANDS, EVENTS, REFUSALS) for kind in family if kind.__module__ == messages.__name__
]


def example(kind: type[Message]) -> Message:
    values: list[Any] = [
        next(iter(field)) if hasattr(field, "__members__") else field(1) for field in kind.field_types.values()
    ]  # fmt: skip
    return kind(*values)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_message_is_complete_and_crosses_memory_unchanged(kind: type[Message]) -> None:
    memory, sent = bytearray(PAYLOAD_SIZE), example(kind)
    sent.pack_into(memory, 0)
    assert kind.kinds.unpack_from(kind.number, bytes(memory), 0) == sent
    if not issubclass(kind, Command):
        assert not set(NAMES.message(sent)) & {"{", "}", "\n"}
    if issubclass(kind, Event):
        assert 127 <= kind.number <= 149


def test_the_configuration_names_every_command_and_only_stop_needs_no_lease() -> None:
    commands = [kind for kind in KINDS if issubclass(kind, Command)]
    assert set(ShapeSettingConfig.COMMANDS) == set(commands)
    assert [kind for kind in commands if not kind.needs_lease] == [StopHeating]
    assert {kind for kind in commands if issubclass(kind, ProcessCommand)} == {
        ArmHeater, MeasureResistance, StartHeating, HeatRod,
    }  # fmt: skip
