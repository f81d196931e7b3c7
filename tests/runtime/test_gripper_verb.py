"""The verb `gripper` with a drive of its own, before a played loop: it returns when the gripper rests, and where."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.codes import Code, Command, Refusal
from tests.runtime.played import Played, played

from .test_gripper import DRIVEN

Q = [0.0] * 6
AXIS = 6
BEGINS = (Code.GRIPPER, -1, 0.0)


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Played]:
    with played(tmp_path, Q, config=DRIVEN) as made:
        yield made


@pytest.mark.parametrize(("opened", "position"), [(False, 0.0), (True, 1.4)])
def test_it_returns_where_the_gripper_rests(arm: Played, opened: bool, position: float) -> None:
    arm.loop.tells[Command.GRIPPER] = [BEGINS, (Code.GRIPPER_AT, AXIS, position, 0.0)]
    assert arm.ask("gripper", open=opened) == {"position": position, "holds": False}
    assert [numbers[0] for numbers in arm.loop.taken(Command.GRIPPER)] == [float(opened)]


def test_it_returns_that_the_gripper_holds_something(arm: Played) -> None:
    arm.loop.tells[Command.GRIPPER] = [BEGINS, (Code.GRIPPER_AT, AXIS, 0.5, 1.0)]
    assert arm.ask("gripper", open=False) == {"position": 0.5, "holds": True}


def test_the_end_of_an_earlier_way_is_not_taken_for_its_own(arm: Played) -> None:
    earlier = (Code.GRIPPER_AT, AXIS, 1.4, 0.0)
    arm.loop.tells[Command.GRIPPER] = [earlier, BEGINS, (Code.GRIPPER_AT, AXIS, 0.0, 0.0)]
    assert arm.ask("gripper", open=False)["position"] == 0.0


def test_a_stop_on_its_way_is_no_success(arm: Played) -> None:
    arm.loop.tells[Command.GRIPPER] = [BEGINS, (Code.GRIPPER_AT, AXIS, 0.71234, 0.0)]
    failed = arm.refused("gripper", open=False)
    assert (failed.kind, str(failed)) == (
        "refused", "finger was stopped at 0.7123 rad, on its way to where it is closed, 0 rad"
    )  # fmt: skip


def test_a_fault_before_it_rests_is_said(arm: Played) -> None:
    arm.loop.tells[Command.GRIPPER] = [BEGINS, (Code.OVER_SPEED, AXIS, 1.7, 1.5), (Code.GRIPPER_AT, AXIS, 0.7, 0.0)]
    failed = arm.refused("gripper", open=False)
    assert failed.kind == "fault"
    assert str(failed).startswith("finger")


def test_what_the_loop_refuses_is_said(arm: Played) -> None:
    arm.loop.refusals[Command.GRIPPER] = (Refusal.GRIPPER_RESTS, -1, 0.0, 0.0)
    assert str(arm.refused("gripper", open=False)) == "the gripper's drive is not enabled: `rtcp enable` first"


def test_one_on_an_output_has_been_told_and_no_more(tmp_path: Path) -> None:
    with played(tmp_path, Q) as arm:
        assert arm.ask("gripper", open=True) == {}
