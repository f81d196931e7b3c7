"""Where a joint's zero is, as clients set it: in the loop and in the file alike, or in neither."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.config.zero import read_zeros, state_directory, zero_file
from rtcp.ipc.codes import Refusal
from rtcp.ipc.machine import Command
from tests.runtime.played import Played, played

from .test_gripper import DRIVEN

Q = [0.25, 0.2, 1.0, 0.0, 0.4, 0.0]


@pytest.fixture
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Played]:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    with played(tmp_path, Q) as made:
        yield made


def test_a_joint_stands_at_its_zero_where_it_is(arm: Played) -> None:
    answer = arm.ask("zero", joint="joint1")
    assert (answer["joint"], answer["offset"], answer["before"]) == ("joint1", 0.25, 0.0)
    assert [numbers[:2] for numbers in arm.loop.taken(Command.ZERO)] == [(0.0, 0.25)]
    assert read_zeros(arm.config) == (0.25, 0, 0, 0, 0, 0)


def test_a_joint_stands_at_what_it_is_said_to_be_and_a_second_time_counts_from_there(arm: Played) -> None:
    arm.ask("zero", joint="joint2", at=0.05)
    assert read_zeros(arm.config)[1] == pytest.approx(0.15)
    # The played loop still shows 0.2: now beyond the offset that is in force.
    arm.ask("zero", joint="joint2", at=0.1)
    assert read_zeros(arm.config)[1] == pytest.approx(0.25)


def test_what_the_loop_refuses_is_in_no_file(arm: Played) -> None:
    arm.loop.refusals[Command.ZERO] = (Refusal.HAS_TORQUE, -1, 0.0, 0.0)
    failed = arm.refused("zero", joint="joint1")
    assert failed.kind == "refused"
    assert "the drives have torque: `rtcp disable` first" in str(failed)
    assert not zero_file(arm.config.name).exists()


def test_what_cannot_be_kept_in_the_file_is_taken_back_from_the_loop(arm: Played, tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where the folder should be")
    failed = arm.refused("zero", joint="joint1")
    assert failed.kind == "refused"
    assert str(tmp_path / "state") in str(failed)
    offsets = [numbers[1] for numbers in arm.loop.taken(Command.ZERO)]
    assert offsets in ([], [0.25, 0.0])


def test_the_zero_of_a_grippers_joint_is_refused_and_where_it_stands_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    with played(tmp_path, Q, config=DRIVEN) as arm:
        failed = arm.refused("zero", joint="finger")
        assert failed.kind == "refused"
        assert str(failed) == (
            "finger: the zero of the gripper's joint is not set by a command; its offset stands in "
            f"{tmp_path}/state/assistive-arm.zero.yaml"
        )
        assert arm.loop.commands == []


@pytest.mark.parametrize("verb", ["zero", "home"])
def test_a_joint_that_is_none_is_named_with_those_that_there_are(arm: Played, verb: str) -> None:
    failed = arm.refused(verb, joint="joint7")
    assert failed.kind == "invalid"
    assert "found 'joint7', allowed is one of joint1, joint2" in str(failed)
    assert arm.loop.commands == []


def test_no_test_keeps_offsets_where_the_arm_at_this_host_has_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    assert state_directory().is_relative_to(tmp_path_factory.getbasetemp())
