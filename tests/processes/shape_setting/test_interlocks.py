"""The table of the interlocks: every state of its rows in every mode, the latch, and no restart."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from rtcp.processes.shape_setting.interlocks import (
    OPERATOR,
    TABLE,
    Cell,
    Interlocks,
    Mode,
    Row,
    Rule,
    first_row,
    markdown,
    violated,
)

FAULT_FREE = (
    1 << Row.KEY | 1 << Row.BUTTON | 1 << Row.ROBOT_CIRCUIT | 1 << Row.ARMS_PERMITTED | 1 << Row.ARMS_ENGAGED
    | 1 << Row.PLATFORM | 1 << Row.COMMANDER | 1 << Row.FUSE | 1 << Row.INSULATION
)  # fmt: skip
"""Inputs that permit heat in both modes."""


def permitted(mode: Mode, is_true: dict[str, npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
    """Whether heat is permitted, written independently of the table."""
    if mode is Mode.OFF:
        return np.zeros_like(is_true["key"])
    if mode is Mode.MANUAL:
        operator = is_true["button"] & ~is_true["button_discrepancy"]
    else:
        robot = is_true["robot_circuit"] & ~is_true["circuit_discrepancy"]
        operator = robot & is_true["arms_permitted"] & is_true["arms_engaged"] & ~is_true["arm_lost"]
    electric = (
        is_true["over_current"] | is_true["over_voltage"] | is_true["open_circuit"] | is_true["short_circuit"]
        | ~is_true["insulation"] | is_true["relay_feedback"] | is_true["gate_feedback"] | ~is_true["fuse"]
    )  # fmt: skip
    measured = is_true["implausible_temperature"] | is_true["excess_heat"] | is_true["steep_gradient"]
    supervised = is_true["lost_cycle"] | is_true["stale_input"]
    platform = is_true["platform"] & is_true["commander"]
    key = is_true["key"] & ~is_true["key_discrepancy"]
    return key & operator & platform & ~electric & ~measured & ~supervised


@pytest.mark.parametrize("mode", Mode)
def test_in_every_state_of_all_rows_heat_is_permitted_exactly_by_the_rules(mode: Mode) -> None:
    names = [row.name.lower() for row in Row if row is not Row.NONE]
    chunk = 1 << 19
    for start in range(0, 1 << len(names), chunk):
        holds = np.arange(start, start + chunk)
        is_true = {name: holds >> bit & 1 == 1 for bit, name in enumerate(names)}
        assert np.array_equal(violated(mode, holds) == 0, permitted(mode, is_true))  # type: ignore[arg-type]


def test_each_row_stands_once_in_the_table_in_the_order_of_its_bit() -> None:
    assert [rule.row for rule in TABLE] == list(range(len(TABLE)))
    assert {rule.row for rule in TABLE} | {Row.NONE} == set(Row)


def closed(mode: Mode) -> Interlocks:
    interlocks = Interlocks()
    interlocks.update(mode, FAULT_FREE)
    assert interlocks.close(FAULT_FREE)
    return interlocks


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.AUTO])
@pytest.mark.parametrize("rule", TABLE, ids=lambda rule: rule.row.name.lower())
def test_a_violated_row_opens_the_relay_and_only_another_start_closes_it(rule: Rule, mode: Mode) -> None:
    row, cell = rule.row, rule.cells[mode]
    interlocks = closed(mode)
    interlocks.update(mode, FAULT_FREE ^ 1 << row)
    assert interlocks.closed == (cell is Cell.IGNORED)
    if cell is not Cell.IGNORED:
        assert interlocks.cause is row
        assert interlocks.forbids(FAULT_FREE ^ 1 << row)
    for _ in range(3):
        interlocks.update(mode, FAULT_FREE)
        assert interlocks.closed == (cell is Cell.IGNORED)
    is_operators = OPERATOR >> row & 1 == 1
    assert interlocks.close(FAULT_FREE) == (cell is Cell.IGNORED or is_operators)


def test_a_fault_latches_until_it_is_reset_with_its_cause_gone_and_the_reset_starts_nothing() -> None:
    interlocks, burst = closed(Mode.AUTO), FAULT_FREE & ~(1 << Row.FUSE)
    interlocks.update(Mode.AUTO, burst)
    assert interlocks.reset(burst) == 1 << Row.FUSE
    assert interlocks.reset(FAULT_FREE) == 0
    interlocks.update(Mode.AUTO, FAULT_FREE)
    assert not interlocks.closed
    assert interlocks.close(FAULT_FREE)


def test_a_welded_relay_latches_with_the_key_at_off_and_prevents_the_next_start() -> None:
    interlocks = Interlocks()
    interlocks.update(Mode.OFF, FAULT_FREE | 1 << Row.RELAY_FEEDBACK)
    interlocks.update(Mode.MANUAL, FAULT_FREE)
    assert not interlocks.close(FAULT_FREE)
    assert first_row(interlocks.forbids(FAULT_FREE)) is Row.RELAY_FEEDBACK


def test_what_concerns_heat_alone_latches_only_while_the_relay_is_commanded() -> None:
    interlocks = Interlocks()
    interlocks.update(Mode.AUTO, FAULT_FREE | 1 << Row.LOST_CYCLE | 1 << Row.ARM_LOST)
    assert interlocks.latched == 0
    assert not interlocks.close(FAULT_FREE | 1 << Row.ARM_LOST)


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.MANUAL])
def test_a_change_of_the_mode_opens_the_relay_even_where_the_new_mode_would_permit_it(mode: Mode) -> None:
    interlocks = closed(Mode.AUTO)
    assert interlocks.update(mode, FAULT_FREE)
    assert not interlocks.closed
    assert interlocks.cause is Row.KEY
    interlocks.update(Mode.AUTO, FAULT_FREE)
    assert not interlocks.closed


def test_the_page_shows_every_row_with_its_three_cells() -> None:
    lines = markdown().splitlines()
    assert len(lines) == 2 + len(TABLE)
    assert "| no heat | must hold | must hold | ends heating |" in lines[2]
    assert all(line.count("|") == 7 for line in lines)
