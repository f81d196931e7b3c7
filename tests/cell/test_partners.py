"""What an arm takes from the newest record of a partner: a blackboard in shared memory, and no loop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.cell import Share
from rtcp.control.cycle import record_schema
from rtcp.control.partners import Partners
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.schema import FLAG_EMERGENCY_STOP, FLAG_MOTION_ALLOWED
from rtcp.ipc.states import State
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState
from rtcp.motion.step_group import StepPhase

from .random_steps import cell_of

CELL = cell_of()
NOW = 50_000_000_000
OF_ANOTHER_CELL = CELL.digest ^ 1


class Beside:
    """The arm `left` and the records of its partner `right`."""

    def __init__(self, path: Path, cell: Any = CELL) -> None:
        self.partners = Partners(cell, "left")
        (self.record,) = self.partners.group.members
        self._schema = record_schema(cell.member("right").config, Partners(cell, "right"))
        self._board = Blackboard(path, self._schema, 2_000_000)
        self._fields: dict[str, Any] = {"time_ns": NOW, "state": State.HOLDING, "step_cell": cell.digest}
        self._fields["acceleration_limit"] = [1.0] * 6
        self.partners.files[0] = path
        self.partners.open()

    def reads(self, *, now: int = NOW, **fields: Any) -> Partners:
        """Let the partner publish these fields, with others as before, and the arm read them."""
        self._fields.update(fields)
        values: list[Any] = []
        for field in self._schema.fields:
            given = self._fields.get(field.name, 0)
            values += given if isinstance(given, list) else [given] * field.count
        self._board.publish(values[1:])
        self.partners.read(now)
        return self.partners

    def close(self) -> None:
        self.partners.close()
        self._board.close()


@pytest.fixture
def beside(path: Path) -> Iterator[Beside]:
    made = Beside(path)
    yield made
    made.close()


@pytest.mark.parametrize("state", State)
def test_a_partner_is_stopped_in_the_emergency_stop_and_until_its_reset_is_done(beside: Beside, state: State) -> None:
    partners = beside.reads(state=state)
    stopped = state in (State.EMERGENCY_STOP, State.RESETTING)
    assert (partners.pressed, partners.stopped) == (-1, 0 if stopped else -1)
    partners = beside.reads(flags=FLAG_EMERGENCY_STOP)
    assert (partners.pressed, partners.stopped) == (0, 0)
    partners = beside.reads(flags=0, state=State.READY)
    assert (partners.pressed, partners.stopped) == (-1, -1)


def test_an_emergency_stop_that_is_not_shared_concerns_its_own_arm_only(path: Path) -> None:
    beside = Beside(path, cell_of(share=Share(emergency_stop=False)))
    partners = beside.reads(state=State.EMERGENCY_STOP, flags=FLAG_EMERGENCY_STOP)
    assert (partners.pressed, partners.stopped) == (-1, -1)
    beside.close()


def test_a_partner_of_another_cell_is_foreign_and_permits_no_motion(beside: Beside) -> None:
    for cell, foreign in ((CELL.digest, -1), (OF_ANOTHER_CELL, 0), (CELL.digest, -1)):
        partners = beside.reads(step_cell=cell, flags=FLAG_MOTION_ALLOWED)
        assert (partners.group.foreign, beside.record.motion_allowed) == (foreign, foreign < 0)
    assert not beside.reads(flags=0).group.members[0].motion_allowed


@pytest.mark.parametrize(("age_ns", "known"), [(0, True), (999_999_999, True), (1_000_000_000, False)])
def test_a_record_of_a_second_ago_says_nothing_of_the_button_or_the_cell(
    beside: Beside, age_ns: int, known: bool
) -> None:
    partners = beside.reads(now=NOW + age_ns, state=State.EMERGENCY_STOP, flags=FLAG_EMERGENCY_STOP)
    assert (partners.pressed, partners.stopped) == ((0, 0) if known else (-1, -1))
    partners = beside.reads(now=NOW + age_ns, step_cell=OF_ANOTHER_CELL)
    assert partners.group.foreign == (0 if known else -1)


@pytest.mark.parametrize("shared", [True, False])
def test_a_silent_partner_counts_as_pressed_and_permits_no_motion(path: Path, shared: bool) -> None:
    beside = Beside(path, cell_of(share=Share(emergency_stop=shared)))
    for age_ns, silent in ((500_000_000, False), (500_000_001, True), (1 << 62, True)):
        partners = beside.reads(now=NOW + age_ns, flags=FLAG_MOTION_ALLOWED)
        assert (partners.unread, beside.record.motion_allowed) == (0 if silent and shared else -1, not silent)
    beside.close()


def test_a_partner_that_has_not_run_yet_counts_as_pressed_if_it_has_a_button() -> None:
    for button, unread in ((True, 0), (False, -1)):
        cell = cell_of()
        inputs = cell.arms[1].config.inputs
        config = replace(cell.arms[1].config, inputs=inputs if button else replace(inputs, emergency_stop=None))
        cell = replace(cell, arms=(cell.arms[0], replace(cell.arms[1], config=config)))
        partners = Partners(cell, "left")
        partners.read(NOW)
        assert partners.unread == unread


def test_a_record_of_the_far_future_is_not_taken(beside: Beside) -> None:
    assert beside.reads(time_ns=NOW + 1_000_000_000).group.members[0].time_ns == NOW + 1_000_000_000
    beside.reads(time_ns=NOW + 1_000_000_001, state=State.FAULT)
    assert (beside.record.time_ns, beside.record.state) == (NOW + 1_000_000_000, State.HOLDING)


def test_every_field_of_a_record_is_taken(beside: Beside) -> None:
    vectors = [[0.1 * n + part for n in range(6)] for part in (1.0, -2.0, 3.0)]
    beside.reads(
        state=State.MOVING, step_motion=7, step_phase=StepPhase.BRAKING, step_brake_ns=9, step_path_s=0.5,
        commanded_position=vectors[0], commanded_velocity=vectors[1], acceleration_limit=vectors[2],
    )  # fmt: skip
    record = beside.record
    assert [record.position, record.velocity, record.acceleration] == vectors
    assert (record.state, record.motion, record.phase) == (State.MOVING, 7, StepPhase.BRAKING)
    assert (record.brake_ns, record.path_s, record.cell) == (9, 0.5, CELL.digest)


def test_the_guard_brakes_a_partner_by_its_acceleration_in_force_and_after_its_silence(beside: Beside) -> None:
    config = CELL.member("left").config
    limits = Limits(config)
    guard = beside.partners.watch(ArmState(6), limits, 0.001)
    assert guard is not None
    assert guard._own.acceleration is limits.acceleration
    (partner,) = guard._partners
    assert partner is not None
    assert partner.acceleration is beside.record.acceleration
    assert (guard._period_s, guard._delay_s) == (0.001, CELL.longest_silence_s + CELL.slowest_s)
    assert guard._clearance == CELL.clearance


def test_the_new_records_of_a_partner_are_in_place_before_the_old_ones_are_released(beside: Beside, path: Path) -> None:
    partners, in_place = beside.partners, []

    class Old:
        def __del__(self) -> None:
            # In the loop another thread reads here, while the mapping of the old records is released.
            in_place.append(partners._views[0])

    views: list[Any] = partners._views
    views[0] = Old()
    path.rename(path.with_name(f"{path.name}.old"))
    Beside(path).close()
    partners.open()
    path.with_name(f"{path.name}.old").unlink()
    assert [type(view).__name__ for view in in_place] == ["RecordView"]
