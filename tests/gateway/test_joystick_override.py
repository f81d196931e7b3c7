"""The joystick without hardware: which inputs of the virtual IO box are forced, when, and until when."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
from rtcp.gateway.carrier import CommandFailed
from rtcp.gateway.stick_forcer import forced
from tests.runtime.played import Played, played

from rtcp.config import default_config, load
from rtcp.ipc.machine import State

Q = [0.0] * 6
MASK, LEVELS = (0x2000, 1), (0x2000, 2)


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Played]:
    with played(tmp_path, Q) as made:
        yield made


def written(arm: Played) -> list[tuple[int, int]]:
    """What was written, subindex and number, but for how long the box holds it (subindex 3)."""
    for index, _, _ in arm.loop.written:
        assert index == 0x2000
    return [(sub, int.from_bytes(bytes.fromhex(value), "little")) for _, sub, value in arm.loop.written if sub != 3]


CODES = {
    "neutral": ([], 63), "forward": (["forward"], 62), "backward": (["backward"], 61), "left": (["left"], 59),
    "right": (["right"], 55), "paddle up": (["mode_up"], 47), "paddle down": (["mode_down"], 31),
    "two directions at once": (["forward", "left"], 58),
}  # fmt: skip


@pytest.mark.parametrize(("pressed", "byte"), CODES.values(), ids=CODES.keys())
def test_what_is_pressed_makes_the_byte_of_the_facts(pressed: list[str], byte: int) -> None:
    config = load(default_config())
    mask, levels = forced(config, pressed, None)
    assert (mask, levels) == (0x3F, byte)
    # As a byte, all eight inputs are forced: those beside the lines too, for bytes that are no code.
    assert forced(config, [], byte) == (0xFF, byte)


def test_toggle_and_emergency_stop_are_forced_to_the_level_that_means_them() -> None:
    config = load(default_config())
    assert forced(config, ["chair"], 63) == (0x1FF, 63)
    assert forced(config, ["emergency_stop"], 63) == (0x2FF, 63)


@pytest.mark.parametrize(
    ("pressed", "byte", "kind", "sentence"),
    [
        (["ahead"], None, "invalid", "pressed: found 'ahead', allowed are forward"),
        ([], 256, "invalid", "byte: found 256, allowed is 0 to 255"),
        (["enabling_switch"], None, "refused", "inputs.enabling_switch is missing"),
    ],
)
def test_what_cannot_be_pressed_is_one_sentence(pressed: list[str], byte: int | None, kind: str, sentence: str) -> None:
    with pytest.raises(CommandFailed) as raised:
        forced(load(default_config()), pressed, byte)
    assert raised.value.kind == kind
    assert sentence in str(raised.value)


def test_levels_are_written_before_the_mask_that_lets_them_count(arm: Played) -> None:
    async def force() -> None:
        await arm.call("stick", {"byte": 61})
        await arm.call("stick", {"byte": 61})
        await arm.call("stick", {"byte": 62})

    arm.run(force)
    assert written(arm) == [(2, 61), (1, 0xFF), (2, 62)]


def test_inputs_are_forced_while_the_arm_moves(arm: Played) -> None:
    arm.show(state=State.STOPPING)
    arm.ask("stick", byte=61)
    assert written(arm) == [(2, 61), (1, 0xFF)]


def test_null_lets_go(arm: Played) -> None:
    async def force() -> None:
        await arm.call("stick", {"byte": 61})
        await arm.call("stick", {"byte": None})

    arm.run(force)
    assert written(arm)[-1] == (1, 0)


def test_nothing_pressed_holds_the_stick_neutral_and_leaves_the_other_inputs_alone(arm: Played) -> None:
    arm.ask("stick", pressed=[])
    assert written(arm) == [(2, 63), (1, 0x3F)]


def test_only_who_holds_the_stick_can_let_it_go(arm: Played) -> None:
    async def force() -> None:
        await arm.call("stick", {"byte": 61}, "rtcp joystick (pid 7)", connection=1)
        with pytest.raises(CommandFailed, match=r"the stick is held by rtcp joystick \(pid 7\)"):
            await arm.call("stick", {}, "another", connection=2)

    arm.run(force)
    assert written(arm)[-1] == (1, 0xFF)


def test_a_closed_connection_lets_go(arm: Played) -> None:
    async def force() -> None:
        await arm.call("stick", {"byte": 61}, connection=1)
        await arm.verbs.gone(2)
        assert written(arm)[-1] == (1, 0xFF)
        await arm.verbs.gone(1)

    arm.run(force)
    assert written(arm)[-1] == (1, 0)


def test_what_is_not_said_again_is_let_go_after_its_time(arm: Played) -> None:
    async def force() -> None:
        watching = asyncio.create_task(arm.verbs.stick.watch())
        await arm.call("stick", {"byte": 61, "hold_s": 0.2})
        await asyncio.sleep(0.1)
        assert written(arm)[-1] == (1, 0xFF)
        await asyncio.sleep(0.3)
        watching.cancel()

    arm.run(force)
    assert written(arm)[-1] == (1, 0)


def test_a_second_client_is_refused_with_the_name_of_who_holds_the_stick(arm: Played) -> None:
    async def force() -> None:
        await arm.call("stick", {"byte": 61}, "rtcp joystick (pid 7)", connection=1)
        with pytest.raises(CommandFailed, match=r"the stick is held by rtcp joystick \(pid 7\)"):
            await arm.call("stick", {"byte": 62}, "another", connection=2)

    arm.run(force)
    assert written(arm) == [(2, 61), (1, 0xFF)]


@pytest.mark.parametrize("hold_s", [0, -1, 1.5])
def test_a_hold_of_more_than_a_second_is_refused(arm: Played, hold_s: float) -> None:
    assert "allowed is more than 0 and at most 1" in str(arm.refused("stick", byte=61, hold_s=hold_s))
    assert arm.loop.written == []


def test_a_real_bus_has_no_inputs_that_could_be_forced(tmp_path: Path) -> None:
    with played(tmp_path, Q, bus="eth0") as arm:
        failed = arm.refused("stick", byte=61)
        assert failed.kind == "refused"
        assert "inputs are forced on the virtual bus only, not on eth0" in str(failed)
        assert arm.loop.written == []
