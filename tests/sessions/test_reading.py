"""The product's reading of frames: by the device files and the geometry of any arm, and what only it can find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from kinematics import forward
from rtcp.config.loader import load
from rtcp.config.model import ArmConfig, InputsConfig, OutputsConfig
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.ipc.commands import SetTool
from rtcp.ipc.states import State
from rtcp.testing.sessions import run_session
from rtcp.testing.sessions.checker import INCONSISTENT_S, Bounds, FrameChecker, Kind, Reading, reading_of
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.run import AnySession
from rtcp.testing.sessions.session import Session
from rtcp.testing.simulation import Frame
from tests.control.test_nine_joints import nine_joints
from tests.control.test_standard_drives import arm_of
from tests.drive_esi import ARMS
from tests.sessions.oracle import configuration, deepest, reading
from tests.two_tools import two_tools

Arm = tuple[ArmConfig, SegmentConfig | None]


def without_box(directory: Path) -> Arm:
    config = configuration()
    segment = load_segment(config.source.parent / config.bus.segment)
    bare = replace(
        config, slaves=config.slaves[1:], inputs=InputsConfig(), outputs=OutputsConfig(), gripper=None
    )  # fmt: skip
    return bare, replace(segment, slaves=segment.slaves[1:])


OTHERS: dict[str, Callable[[Path], Arm]] = {
    **{name: lambda directory, name=name: arm_of(directory, name) for name in ARMS},  # type: ignore[misc]
    "nine joints": lambda directory: (load(nine_joints(directory)), None),
    "no IO box": without_box,
    "two tools": lambda directory: (load(two_tools(directory)), None),
}


@pytest.mark.parametrize("name", OTHERS)
def test_sessions_of_other_arms_move_them_and_break_no_limit(name: str, tmp_path: Path) -> None:
    config, segment = OTHERS[name](tmp_path)

    def compare(session: AnySession, error: Exception | None) -> None:
        # The record is a cycle ahead of the frame.
        sent = session.commander.simulation.observer.latest()["sent_position"][0]
        assert session.commander.commanded == pytest.approx(list(sent), abs=2e-3)

    results = [run_session(seed, config, 1.5, segment, compare) for seed in (4, 7, 13)]
    assert [(result.outcome, result.violation) for result in results] == [("passed", "")] * 3
    assert max(result.largest_speed for result in results) > 0.1


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """Every frame of a session in which the arm moves."""
    session = Session(Random(13), configuration())
    seen: list[Frame] = []
    check = session.commander.simulation.on_frame

    def see(frame: Frame) -> None:
        seen.append(frame)
        check(frame)

    session.commander.simulation.on_frame = see
    session.run(1.5)
    session.commander.close()
    return seen


def test_it_reads_frames_and_places_the_bodies_as_the_facts_have_them(frames: list[Frame]) -> None:
    ours, facts = reading_of(configuration()), reading()
    places = set()
    for frame in frames[::40]:
        q = []
        for one, other in zip(ours.joints, facts.joints, strict=True):
            assert one.slot == other.slot
            sample = one.decode(frame.sent[one.slot], frame.received[one.slot])
            assert sample == pytest.approx(other.decode(frame.sent[one.slot], frame.received[one.slot]))
            q.append(sample.position)
        bounds = Bounds.configured(configuration())
        assert ours.workspaces[0].deepest(bounds, q) == pytest.approx(deepest(bounds, q), abs=1e-4)
        places.add(tuple(q))
    assert len(places) > 10


def test_the_bodies_of_the_tool_that_the_arm_has_are_checked(tmp_path: Path) -> None:
    config, bent = load(two_tools(tmp_path)), [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]
    x, y, z = forward(config.models[1], bent).position
    commander = Commander(config, 1, bent, reading_of(config))
    try:
        commander.enable()
        commander.simulation.bring_to(State.HOLDING, 2.0)
        # Of the checker alone: the loop has the boxes of the configuration.
        commander.bounds.keep_out = ((x - 0.05, y - 0.05, z - 0.05, x + 0.05, y + 0.05, z + 0.05),)
        commander.checker.changed()
        commander.wait(200)
        assert commander.checker.violations == []
        assert commander.send(SetTool(1))
        commander.wait(200)
        assert {violation.kind for violation in commander.checker.violations} == {Kind.ZONE, Kind.BODY}
    finally:
        commander.close()


@pytest.mark.parametrize(
    ("wanted", "shown", "kind"),
    [(State.HOLDING, State.READY, Kind.TORQUE_IN_STATE), (State.READY, State.HOLDING, Kind.NO_TORQUE_IN_STATE)],
)
def test_a_state_that_contradicts_the_drives_for_long_is_found(wanted: State, shown: State, kind: Kind) -> None:
    session = Session(Random(5), configuration())
    commander = session.commander
    try:
        commander.start()
        if wanted is State.HOLDING:
            commander.enable()
            commander.simulation.bring_to(wanted)
            commander.wait(50)
        last: list[Frame] = []
        commander.simulation.on_frame = last.append
        commander.wait(1)
    finally:
        commander.close()
    period_s = session.period_s
    expected = commander.simulation.data.expected_wkc
    for state, kinds in ((wanted, []), (shown, [kind])):
        checker = FrameChecker(
            Bounds.configured(configuration()), period_s, Reading(reading_of(configuration()).joints), expected
        )  # fmt: skip
        for _ in range(round(1.5 * INCONSISTENT_S / period_s)):
            checker.check(last[0], state)
        assert [violation.kind for violation in checker.violations] == kinds
