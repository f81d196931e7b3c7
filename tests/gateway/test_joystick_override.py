"""The joystick of the virtual IO box: the inputs that it forces, and for how long."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.gateway.joystick_override import forced
from rtcp.ipc.errors import Refused, RtcpError
from rtcp.ipc.states import State
from tests.gateway.fake_platform import FakePlatform, fake_platform
from tests.two_boxes import two_boxes

Q = [0.0] * 6
MASK, LEVELS = (0x2000, 1), (0x2000, 2)


def written(arm: FakePlatform) -> list[tuple[int, int]]:
    """Subindex and number of each write, without the hold time (subindex 3)."""
    for index, _, _ in arm.loop.written:
        assert index == 0x2000
    return [(sub, int.from_bytes(bytes.fromhex(value), "little")) for _, sub, value in arm.loop.written if sub != 3]


CODES = {
    "neutral": ([], 63), "forward": (["forward"], 62), "backward": (["backward"], 61), "left": (["left"], 59),
    "right": (["right"], 55), "paddle up": (["mode_up"], 47), "paddle down": (["mode_down"], 31),
    "two directions at once": (["forward", "left"], 58),
}  # fmt: skip


@pytest.mark.parametrize(("pressed", "byte"), CODES.values(), ids=CODES.keys())
def test_each_position_makes_the_byte_of_the_device_description(pressed: list[str], byte: int) -> None:
    config = load(default_config())
    mask, levels = forced(config, pressed, None)["io"]
    assert (mask, levels) == (0x3F, byte)
    # As a byte, all eight inputs are forced: those beside the lines too, for bytes that are no code.
    assert forced(config, [], byte) == {"io": (0xFF, byte)}


def test_toggle_and_emergency_stop_are_forced_to_the_level_that_means_them() -> None:
    config = load(default_config())
    assert forced(config, ["chair"], 63) == {"io": (0x1FF, 63)}
    assert forced(config, ["emergency_stop"], 63) == {"io": (0x2FF, 63)}


def test_each_of_two_boxes_is_forced_and_released(tmp_path: Path) -> None:
    config = load(two_boxes(tmp_path / "config"))
    assert forced(config, ["left", "enabling_switch"], None) == {"io": (0x3F, 59), "desk": (1, 1)}
    with fake_platform(tmp_path, Q, config=config) as arm:

        async def force() -> None:
            await arm.call("joystick", {"byte": 62})
            await arm.call("joystick", {"pressed": ["enabling_switch"], "byte": 62})
            await arm.call("joystick", {"byte": None})

        arm.run(force)
        requests = [
            (request["slave"], request["subindex"], int(request["hex"][:2], 16)) for request in arm.loop.requests
        ]
        io, desk = 1, 8
        assert [request for request in requests if request[1] != 3] == [
            (desk, 1, 0), (io, 2, 62), (io, 1, 0xFF), (desk, 2, 1), (desk, 1, 1), (io, 1, 0), (desk, 1, 0),
        ]  # fmt: skip
        assert [request[0] for request in requests if request[1] == 3] == [io, desk], (
            "each is told when to release by itself"
        )


@pytest.mark.parametrize(
    ("pressed", "byte", "kind", "message"),
    [
        (["ahead"], None, "invalid", 'pressed: found the text "ahead", allowed are forward'),
        ([], 256, "invalid", "byte: found 256, allowed is 0 to 255"),
        (["enabling_switch"], None, "refused", "inputs.enabling_switch is missing"),
    ],
)
def test_what_cannot_be_pressed_is_named(pressed: list[str], byte: int | None, kind: str, message: str) -> None:
    with pytest.raises(RtcpError) as raised:
        forced(load(default_config()), pressed, byte)
    assert raised.value.kind == kind
    assert message in str(raised.value)


def test_levels_are_written_before_the_mask_and_only_what_changes_is_written(arm: FakePlatform) -> None:
    async def force() -> None:
        await arm.call("joystick", {"byte": 61})
        await arm.call("joystick", {"byte": 61})
        await arm.call("joystick", {"byte": 62})

    arm.run(force)
    assert written(arm) == [(2, 61), (1, 0xFF), (2, 62)]
    # The hold time is written before any input is forced.
    assert arm.loop.written[0] == (0x2000, 3, (1500).to_bytes(2, "little").hex())


def test_inputs_are_forced_while_the_arm_moves(arm: FakePlatform) -> None:
    arm.show(state=State.STOPPING)
    arm.ask("joystick", byte=61)
    assert written(arm) == [(2, 61), (1, 0xFF)]


def test_nothing_pressed_holds_the_joystick_neutral_and_leaves_the_other_inputs_alone(arm: FakePlatform) -> None:
    arm.ask("joystick", pressed=[])
    assert written(arm) == [(2, 63), (1, 0x3F)]


@pytest.mark.parametrize("params", [{}, {"byte": 62}], ids=["release", "force"])
def test_a_second_client_is_refused_with_the_name_of_the_holder(arm: FakePlatform, params: dict[str, int]) -> None:
    async def force() -> None:
        await arm.call("joystick", {"byte": 61}, "rtcp joystick (pid 7)", connection=1)
        with pytest.raises(Refused, match=r"the joystick is held by rtcp joystick \(pid 7\)"):
            await arm.call("joystick", params, "another", connection=2)

    arm.run(force)
    assert written(arm) == [(2, 61), (1, 0xFF)]


def test_a_closed_connection_releases(arm: FakePlatform) -> None:
    async def force() -> None:
        await arm.call("joystick", {"byte": 61}, connection=1)
        await arm.methods.end_connection(2)
        assert written(arm)[-1] == (1, 0xFF)
        await arm.methods.end_connection(1)

    arm.run(force)
    assert written(arm)[-1] == (1, 0)


def test_what_is_not_repeated_is_released_after_its_hold_time(arm: FakePlatform) -> None:
    async def force() -> None:
        watching = asyncio.create_task(arm.methods.joystick_override.watch())
        await arm.call("joystick", {"byte": 61, "hold_s": 0.2})
        await asyncio.sleep(0.15)
        await arm.call("joystick", {"byte": 61, "hold_s": 0.2})
        await asyncio.sleep(0.19)
        assert written(arm)[-1] == (1, 0xFF)
        await asyncio.sleep(0.07)
        assert written(arm)[-1] == (1, 0)
        watching.cancel()

    arm.run(force)


@pytest.mark.parametrize("hold_s", [0, -1, 1.5])
def test_a_hold_time_beyond_a_second_is_refused(arm: FakePlatform, hold_s: float) -> None:
    assert "allowed is a number greater than 0 and at most 1" in str(arm.error("joystick", byte=61, hold_s=hold_s))
    assert arm.loop.written == []


def test_inputs_of_a_real_bus_are_not_forced(tmp_path: Path) -> None:
    with fake_platform(tmp_path, Q, bus="eth0") as arm:
        failed = arm.error("joystick", byte=61)
        assert failed.kind == "refused"
        assert "inputs are forced on the virtual bus only, not on eth0" in str(failed)
        assert arm.loop.written == []
