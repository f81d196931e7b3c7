"""Motions of external axes as clients call them; the loop is fake."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.gateway.command_channel import Caller
from rtcp.ipc import commands
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import AxisAtRest, AxisFailed, Event, Homed, HomedElsewhere, HomingFailed
from rtcp.ipc.refusals import AxisNotHomed
from rtcp.ipc.schema import axis_fields
from rtcp.ipc.states import State
from tests.gateway import fake_loop
from tests.gateway.fake_platform import FakePlatform, fake_platform

CONFIG = load(default_config())
AXES = load(default_config().parent / "linear_axis.yaml").external_axes
RAIL, BELT = 6, 7


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakePlatform]:
    fields = [field for axis in AXES for field in axis_fields(axis)]
    monkeypatch.setattr("tests.gateway.fake_loop.BOX", (*fake_loop.BOX, *fields))
    with fake_platform(tmp_path, [0.0] * 6, config=replace(CONFIG, external_axes=AXES)) as made:
        yield made


def test_a_motion_returns_where_the_axis_is(bench: FakePlatform) -> None:
    # The end of an earlier motion of the other axis is not the end of this one.
    bench.loop.reports[commands.MoveAxis] = [AxisAtRest(RAIL, 0.3, True), AxisAtRest(BELT, 0.9, False)]
    bench.loop.reports[commands.HomeAxis] = [Homed(RAIL, 0.01)]
    assert bench.ask("move_axis", axis="rail", position=0.3, speed=0.1) == {"position": 0.3}
    bench.loop.objects[0x607C] = {"hex": "f0d8ffff"}
    assert bench.ask("home_axis", axis="rail") == {"position": 0.01}
    assert bench.loop.commands == [commands.MoveAxis(RAIL, 0.3, 0.1), commands.HomeAxis(RAIL, -1.0)]


@pytest.mark.parametrize(
    ("method", "events", "kind", "message"),
    [
        ("move_axis", [AxisAtRest(RAIL, 0.21, False)], "refused", "rail was stopped at 0.21 m, before it was at 0.3 m"),
        ("move_axis", [AxisAtRest(RAIL, 0.1, True)], "refused", "rail was stopped at 0.1 m, before it was at 0.3 m"),
        ("move_axis", [AxisFailed(RAIL, 0x27, 1), AxisAtRest(RAIL, 0.0, False)], "fault", "rail is halted: its drive"),
        ("move_axis", [], "refused", "move_axis was ended by another command: the drives are disabled"),
        ("home_axis", [HomingFailed(RAIL, 0x27, 6)], "fault", "rail: homing failed"),
        ("home_axis", [HomedElsewhere(RAIL, 0.5, 0.0)], "fault", "it shows 0.5 m and its home offset (0x607C) is 0 m"),
        ("home_axis", [AxisAtRest(RAIL, 0.1, False)], "refused", "rail: homing was stopped; it is not homed"),
    ],
)
def test_a_motion_that_ends_early_says_why(
    bench: FakePlatform, method: str, events: list[Event], kind: str, message: str
) -> None:
    bench.loop.reports[commands.MoveAxis] = bench.loop.reports[commands.HomeAxis] = events
    error = bench.error(method, axis="rail", **({"position": 0.3} if method == "move_axis" else {}))
    assert error.kind == kind
    assert message in error.message


def test_an_unknown_axis_and_a_refusal_of_the_loop_are_answered(bench: FakePlatform) -> None:
    assert (
        'found the text "belts", allowed is one of rail, belt'
        in bench.error("run_axis", axis="belts", velocity=0.1).message
    )
    bench.loop.refusals[commands.RunAxis] = AxisNotHomed(RAIL)
    assert bench.error("run_axis", axis="rail", velocity=0.1).message.startswith("rail is not homed")
    assert bench.observer.holder() == ""


def test_a_run_keeps_the_lease_until_the_axis_rests_and_other_motions_share_it(bench: FakePlatform) -> None:
    loop = bench.loop

    async def run() -> None:
        loop.fields = {"belt_moving": 1}
        await bench.call("run_axis", {"axis": "belt", "velocity": 0.1, "hold_s": 60.0})
        await bench.call("run_axis", {"axis": "belt", "velocity": 0.2, "hold_s": 60.0})
        await bench.call("move_joints", {"q": [0.1] * 6})
        assert bench.observer.holder() == "one"
        with pytest.raises(RtcpError, match="one") as held:
            await bench.call("move_axis", {"axis": "rail", "position": 0.1}, "two", 2)
        assert held.value.reason == "lease_held"
        loop.fields = {}
        await bench.call("stop_axis", {"axis": "belt"}, "two", 2)

    bench.run(run)
    bench.show(state=State.HOLDING)
    assert [type(command) for command in loop.commands] == [
        commands.RunAxis, commands.RunAxis, commands.MoveJoints, commands.StopAxis,
    ]  # fmt: skip
    assert bench.observer.holder() == ""


def test_a_run_reports_on_and_a_client_that_no_longer_reads_loses_its_lease(bench: FakePlatform) -> None:
    reports: list[object] = []
    hung = False

    async def run() -> None:
        nonlocal hung
        bench.loop.fields = {"belt_moving": 1}
        caller = Caller("one", 1, reports.append, lambda seconds: hung)
        await bench.methods.call("run_axis", caller, {"axis": "belt", "velocity": 0.1, "hold_s": 3600.0})
        answered = len(reports)
        await asyncio.sleep(0.6)
        assert len(reports) > answered
        assert bench.observer.holder() == "one"
        hung = True
        await asyncio.sleep(0.6)
        assert not bench.observer.holder()

    bench.run(run)


def test_a_connection_that_closes_releases_the_lease_of_its_runs(bench: FakePlatform) -> None:
    async def run() -> None:
        bench.loop.fields = {"belt_moving": 1}
        await bench.call("run_axis", {"axis": "belt", "velocity": 0.1, "hold_s": 60.0})
        assert bench.observer.holder() == "one"
        await bench.methods.end_connection(1)
        assert bench.observer.holder() == ""

    bench.run(run)
