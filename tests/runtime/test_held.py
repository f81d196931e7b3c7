"""Motions that have to be asked for again and again, and the lease that stays with their connection."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.gateway.carrier import CommandFailed
from rtcp.gateway.held import Caller
from rtcp.ipc.codes import MotionMode, Refusal
from rtcp.ipc.machine import Command, State
from tests.runtime.played import Played, played

Q = [0.0, 0.2, 1.0, 0.0, 0.4, 0.0]
SIX = [0.01, 0.02, 0.03, 0.0, 0.0, 0.1]
LEASE_S = 0.4
JOG = {"v": SIX, "frame": "base"}


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Played]:
    with played(tmp_path, Q, lease_s=LEASE_S) as made:
        yield made


VERBS: dict[str, tuple[str, dict[str, Any], Command, tuple[float, ...]]] = {
    "jog in the base's frame": ("jog", {**JOG, "hold_s": 0.3}, Command.JOG, (*SIX, 0, 0, 0, 0, 0.0, 0.3)),
    "jog in the tool's frame": ("jog", {"v": SIX, "frame": "tool"}, Command.JOG, (*SIX, 0, 0, 0, 0, 1.0, 0.25)),
    "jog of the joints": ("jog", {"v": SIX, "frame": "joints"}, Command.JOG, (*SIX, 0, 0, 0, 0, 2.0, 0.25)),
    "velocity": ("velocity", {"numbers": SIX, "hold_s": 0.1}, Command.VELOCITY, (*SIX, 0, 0, 0, 0, 0, 0.1)),
    "torque": ("torque", {"numbers": SIX, "hold_s": 0.1}, Command.TORQUE, (*SIX, 0, 0, 0, 0, 0, 0.1)),
    "torque with impedance": (
        "torque", {"numbers": SIX, "stiffness": 0.5, "damping": 1}, Command.TORQUE, (*SIX, 0, 0, 0, 0.5, 1.0, 0.25),
    ),
    "stream": ("stream", {"q": SIX, "t": 12.5}, Command.STREAM, (*SIX, 0, 0, 0, 0, 0, 12.5)),
}  # fmt: skip


@pytest.mark.parametrize(("verb", "args", "command", "numbers"), VERBS.values(), ids=VERBS.keys())
def test_the_numbers_stand_where_the_loop_reads_them(
    arm: Played, verb: str, args: dict[str, Any], command: Command, numbers: tuple[float, ...]
) -> None:
    answer = arm.ask(verb, **args)
    assert arm.loop.commands == [(command, *numbers)]
    assert answer == {"state": "moving", "q": Q}


WRONG: dict[str, tuple[str, dict[str, Any], str]] = {
    "five speeds": ("jog", {"v": SIX[:5], "frame": "base"}, "v: found 5 numbers, allowed are 6"),
    "an unknown frame": ("jog", {"v": SIX, "frame": "world"}, "frame: found 'world', allowed is one of base, tool, j"),
    "no frame": ("jog", {"v": SIX}, "frame is missing; it must be a text"),
    "speeds as a truth": ("velocity", {"numbers": True}, "numbers: found true, allowed is a list of numbers"),
    "seven torques": ("torque", {"numbers": [*SIX, 0.0]}, "numbers: found 7 numbers, allowed are 6"),
    "a target without its time": ("stream", {"q": SIX}, "t is missing; it must be a number"),
    "a hold as a text": ("jog", {**JOG, "hold_s": "1"}, 'hold_s: found "1", allowed is a number'),
}


@pytest.mark.parametrize(("verb", "args", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_an_argument_of_another_form_is_one_sentence_and_nothing_is_commanded(
    arm: Played, verb: str, args: dict[str, Any], sentence: str
) -> None:
    failed = arm.refused(verb, **args)
    assert failed.kind == "invalid"
    assert sentence in str(failed)
    assert arm.loop.commands == []


@pytest.mark.parametrize(("verb", "args"), [("jog", JOG), ("stick", {"byte": 62})])
def test_what_comes_later_than_it_counts_is_not_carried_out(arm: Played, verb: str, args: dict[str, Any]) -> None:
    failed = arm.refused(verb, **args, hold_s=0.3, t=time.monotonic() - 2.5)
    assert failed.kind == "timeout"
    assert "it came 2.5 s after it was said, and counts for 0.3 s only" in str(failed)
    assert arm.loop.commands == []
    assert arm.loop.requests == []


def test_what_comes_in_time_is_carried_out(arm: Played) -> None:
    arm.ask("jog", **JOG, hold_s=1.0, t=time.monotonic())
    assert len(arm.loop.taken(Command.JOG)) == 1


def test_joints_are_jogged_as_joint_speeds_where_the_arm_is_in_mode_velocity(arm: Played) -> None:
    arm.show(motion=MotionMode.VELOCITY)
    arm.ask("jog", v=SIX, frame="joints")
    assert [kind for kind, *_ in arm.loop.commands] == [Command.VELOCITY]


def test_the_lease_stays_with_the_connection_and_another_is_refused_with_the_holders_name(arm: Played) -> None:
    async def two() -> None:
        await arm.call("jog", JOG, "rtcp jog (pid 7)", connection=1)
        with pytest.raises(CommandFailed, match=r"the arm is commanded by rtcp jog \(pid 7\)"):
            await arm.call("jog", JOG, "rtcp jog (pid 8)", connection=2)
        await arm.call("jog", JOG, "rtcp jog (pid 7)", connection=1)

    arm.run(two)
    assert len(arm.loop.taken(Command.JOG)) == 2


def test_the_lease_is_kept_for_as_long_as_the_jog_is_said_again(arm: Played) -> None:
    async def long() -> None:
        until = time.monotonic() + 3 * LEASE_S
        while time.monotonic() < until:
            await arm.call("jog", JOG, connection=1)
            assert arm.observer.holder() == "one"
            await asyncio.sleep(LEASE_S / 4)

    arm.run(long)


def test_a_pause_of_the_leases_time_gives_the_arm_to_another(arm: Played) -> None:
    async def pause() -> None:
        await arm.call("jog", JOG, "one", connection=1)
        await asyncio.sleep(LEASE_S + 0.1)
        assert arm.loop.state is State.HOLDING
        await arm.call("jog", JOG, "two", connection=2)
        with pytest.raises(CommandFailed, match="the arm is commanded by two"):
            await arm.call("jog", JOG, "one", connection=1)

    arm.run(pause)


def test_a_connection_that_closes_gives_its_lease_back_at_once(arm: Played) -> None:
    async def close() -> None:
        await arm.call("jog", JOG, "one", connection=1)
        await arm.verbs.gone(1)
        assert arm.observer.holder() == ""
        await arm.call("jog", JOG, "two", connection=2)
        await arm.verbs.gone(1)
        assert arm.observer.holder() == "two"

    arm.run(close)


def test_another_command_of_the_same_connection_waits_until_its_motion_has_come_to_rest(arm: Played) -> None:
    async def then() -> None:
        await arm.call("jog", JOG, connection=1)
        assert arm.loop.state is State.MOVING
        await arm.call("output", {"number": 5, "value": True}, connection=1)

    arm.run(then)
    assert [kind for kind, *_ in arm.loop.commands] == [Command.JOG, Command.OUTPUT]
    assert arm.loop.state is State.HOLDING


def test_what_the_loop_refuses_of_a_stream_is_told_in_its_sentence(arm: Played) -> None:
    arm.loop.refusals[Command.STREAM] = (Refusal.STREAM_DROPPED, -1, 0.3, 0.0)
    failed = arm.refused("stream", q=SIX, t=1.0)
    assert failed.kind == "refused"
    assert "the target came 0.3 s late or out of order: it was dropped" in str(failed)


def test_a_caller_is_its_name_and_its_connection() -> None:
    caller = Caller("rtcp jog", 3)
    assert (caller, caller.connection) == ("rtcp jog", 3)
