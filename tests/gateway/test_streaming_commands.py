"""Commands that last only while more of them follow, and the lease that stays with their connection."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest

from rtcp.ipc.commands import ApplyTorque, Command, Jog, MoveAtVelocity, SetOutput, StreamPosition
from rtcp.ipc.errors import Refused, TimedOut
from rtcp.ipc.events import BoxReached
from rtcp.ipc.refusals import StreamPointDropped, WrongState
from rtcp.ipc.states import ControlMode, JogFrame, State
from tests.gateway.fake_platform import FakePlatform

Q = [0.0, 0.2, 1.0, 0.0, 0.4, 0.0]
SIX = (0.01, 0.02, 0.03, 0.0, 0.0, 0.1)
LEASE_S = 0.4
OPTIONS = {"lease_s": LEASE_S}
JOG: dict[str, Any] = {"velocity": list(SIX), "frame": "base"}


METHODS: dict[str, tuple[str, dict[str, Any], Command]] = {
    "jog, base": ("jog", {"velocity": SIX, "hold_s": 0.3}, Jog(SIX, JogFrame.BASE, 0.3)),
    "jog, tool": ("jog", {"velocity": SIX, "frame": "tool"}, Jog(SIX, JogFrame.TOOL, 0.25)),
    "jog, joints": ("jog", {"velocity": SIX, "frame": "joints"}, Jog(SIX, JogFrame.JOINTS, 0.25)),
    "velocity": ("move_at_velocity", {"velocity": SIX, "hold_s": 0.1}, MoveAtVelocity(SIX, 0.1)),
    "torque": (
        "apply_torque", {"torque": SIX, "stiffness": 0.5, "damping": 1}, ApplyTorque(SIX, 0.5, 1.0, 0.25),
    ),
    "stream": ("stream_position", {"q": SIX, "stamp_s": 12.5}, StreamPosition(SIX, 12.5)),
}  # fmt: skip


@pytest.mark.parametrize(("method", "params", "command"), METHODS.values(), ids=METHODS.keys())
def test_a_streaming_command_reaches_the_loop_as_it_was_sent(
    arm: FakePlatform, method: str, params: dict[str, Any], command: Command
) -> None:
    assert arm.ask(method, **params) == {"state": "moving", "positions": Q}
    assert arm.loop.commands == [command]


WRONG: dict[str, tuple[str, dict[str, Any], str]] = {
    "five numbers": ("jog", {**JOG, "velocity": SIX[:5]}, "velocity: found 5 numbers, allowed are 6"),
    "seven torques": ("apply_torque", {"torque": [0.0] * 7, "stiffness": 0, "damping": 0}, "torque: found 7 numbers"),
    "unknown frame": ("jog", {**JOG, "frame": "world"}, 'frame: found the text "world", allowed is one of base, tool'),
    "no numbers": ("move_at_velocity", {"velocity": True}, "velocity: found true, allowed is a list"),
    "no time stamp": ("stream_position", {"q": SIX}, "the key stamp_s is missing; it must be a number"),
    "hold time": ("jog", {**JOG, "hold_s": "1"}, 'hold_s: found the text "1", allowed is a number'),
    "unknown key": ("jog", {**JOG, "speed": 1}, "speed: this key does not exist; allowed are velocity, frame"),
}


@pytest.mark.parametrize(("method", "params", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_parameter_is_named_and_nothing_is_commanded(
    arm: FakePlatform, method: str, params: dict[str, Any], message: str
) -> None:
    error = arm.error(method, **params)
    assert error.kind == "invalid"
    assert message in str(error)
    assert arm.loop.commands == []


@pytest.mark.parametrize(("method", "params"), [("jog", JOG), ("move_at_velocity", {"velocity": SIX})])
def test_a_command_that_comes_later_than_its_hold_time_has_no_effect(
    arm: FakePlatform, method: str, params: dict[str, Any]
) -> None:
    async def late() -> None:
        with pytest.raises(TimedOut, match=r"it came 2\.5 s after it was sent, and lasts for 0\.3 s only"):
            await arm.call(method, {**params, "hold_s": 0.3, "sent_s": time.monotonic() - 2.5})
        assert arm.loop.commands == []
        await arm.call(method, {**params, "hold_s": 0.3, "sent_s": time.monotonic() - 0.29})

    arm.run(late)
    assert len(arm.loop.commands) == 1


def test_a_jog_of_the_joints_is_a_velocity_in_control_mode_velocity(arm: FakePlatform) -> None:
    arm.show(control_mode=ControlMode.VELOCITY)
    arm.ask("jog", velocity=SIX, frame="joints")
    assert arm.loop.kinds == [MoveAtVelocity]


def test_the_lease_stays_with_the_connection_and_another_is_refused_with_the_holders_name(arm: FakePlatform) -> None:
    async def two() -> None:
        await arm.call("jog", JOG, "rtcp jog (pid 7)", connection=1)
        with pytest.raises(Refused, match=r"the arm is commanded by rtcp jog \(pid 7\)") as raised:
            await arm.call("jog", JOG, "rtcp jog (pid 8)", connection=2)
        assert (raised.value.reason, raised.value.fields) == ("lease_held", {"holder": "rtcp jog (pid 7)"})
        await arm.call("jog", JOG, "rtcp jog (pid 7)", connection=1)

    arm.run(two)
    assert len(arm.loop.received(Jog)) == 2


def test_the_lease_is_kept_while_the_jog_is_repeated(arm: FakePlatform) -> None:
    async def long() -> None:
        for _ in range(4):
            await arm.call("jog", JOG, connection=1)
            await asyncio.sleep(0.95 * LEASE_S)
            assert arm.observer.holder() == "one"

    arm.run(long)


def test_a_pause_longer_than_the_lease_lets_another_command_the_arm(arm: FakePlatform) -> None:
    async def pause() -> None:
        await arm.call("jog", JOG, "one", connection=1)
        await asyncio.sleep(1.01 * LEASE_S)
        assert arm.loop.state is State.HOLDING
        await arm.call("jog", JOG, "two", connection=2)
        with pytest.raises(Refused, match="the arm is commanded by two"):
            await arm.call("jog", JOG, "one", connection=1)

    arm.run(pause)


def test_a_connection_that_closes_releases_its_lease_at_once(arm: FakePlatform) -> None:
    async def close() -> None:
        await arm.call("jog", JOG, "one", connection=1)
        await arm.methods.end_connection(1)
        assert arm.observer.holder() == ""
        await arm.call("jog", JOG, "two", connection=2)
        await arm.methods.end_connection(1)
        assert arm.observer.holder() == "two"

    arm.run(close)


def test_another_command_of_the_same_connection_waits_until_the_arm_rests(arm: FakePlatform) -> None:
    async def then() -> None:
        await arm.call("jog", JOG, connection=1)
        assert arm.loop.state is State.MOVING
        await arm.call("set_output", {"output": 5, "value": True}, connection=1)

    arm.run(then)
    assert arm.loop.commands[1:] == [SetOutput(5, True)]
    assert arm.loop.state is State.HOLDING


def test_a_refused_point_of_a_stream_has_its_name_and_fields(arm: FakePlatform) -> None:
    arm.loop.refusals[StreamPosition] = StreamPointDropped(0.3)
    error = arm.error("stream_position", q=SIX, stamp_s=1.0)
    assert (error.kind, error.reason, error.fields) == ("refused", "stream_point_dropped", {"late_s": 0.3})
    assert "the target came 0.3 s late or out of order: it was dropped" in str(error)


def test_a_refusal_after_a_guard_has_ended_the_jog_names_the_guards_event(arm: FakePlatform) -> None:
    async def ended() -> None:
        await arm.call("jog", JOG)
        arm.loop.board.event(BoxReached(0, 0.01))
        arm.loop.state = State.STOPPED_BY_LIMIT
        arm.loop.refusals[Jog] = WrongState(Jog.number, State.STOPPED_BY_LIMIT)
        await arm.call("jog", JOG)

    with pytest.raises(Exception, match=r"the motion has ended: the arm stopped 0\.01 m from") as raised:
        arm.run(ended)
    assert raised.value.reason == "box_reached"  # type: ignore[attr-defined]
