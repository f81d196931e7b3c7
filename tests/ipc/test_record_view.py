"""Reading the newest record of another platform: fields by name, never a torn one, never one of another version."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.record_view import RecordView, RecordViewError
from rtcp.ipc.schema import arm_schema

PERIOD_NS = 1_000_000


@pytest.fixture
def board(tmp_path: Path) -> Blackboard:
    return Blackboard(tmp_path / "blackboard", arm_schema(6), PERIOD_NS)


def values(board: Blackboard, **given: Any) -> list[Any]:
    """Return the numbers of a record, 0 but for those given."""
    numbers: list[Any] = []
    for field in board.schema.fields[1:]:
        value = given.get(field.name, [0] * field.count if field.shape else 0)
        numbers += value if field.shape else [value]
    return numbers


def test_fields_of_the_newest_record_by_name(board: Blackboard) -> None:
    view, read = RecordView(board.path, ("state", "actual_position", "time_ns")), [0.0] * 8
    assert not view.read(read)
    for number in range(1, 4):
        board.publish(values(board, state=number, time_ns=10 * number, actual_position=[number + 0.5] * 6))
        assert view.read(read)
        assert read == [number, *[number + 0.5] * 6, 10 * number]


def test_a_record_that_is_being_written_is_none(board: Blackboard) -> None:
    view, read = RecordView(board.path, ("state",)), [0]
    board.publish(values(board, state=5))
    head = board._words
    from rtcp.ipc.layout import RECORDS_AT

    at = RECORDS_AT + (1 & view._mask) * view._size
    before = head[at]
    head[at] = 0
    assert not view.read(read)
    head[at] = before
    assert view.read(read)


def test_a_record_that_is_overwritten_while_it_is_read_is_none(board: Blackboard) -> None:
    view, read = RecordView(board.path, ("state",)), [0]
    board.publish(values(board, state=5))
    ((offset, count, unpack),) = view._fields

    def overtaken(memory: Any, at: int) -> Any:
        for _ in range(view._mask + 1):
            board.publish(values(board, state=6))
        return unpack(memory, at)

    view._fields = [(offset, count, overtaken)]
    assert not view.read(read)
    view._fields = [(offset, count, unpack)]
    assert view.read(read)
    assert read == [6]


@pytest.mark.parametrize("damage", ["missing", "short", "magic", "field"])
def test_what_is_no_blackboard_of_a_cell_is_refused(board: Blackboard, damage: str) -> None:
    path, name = board.path, "state"
    if damage == "missing":
        path = path.with_name("none")
    elif damage == "short":
        path.write_bytes(b"x")
    elif damage == "magic":
        with path.open("r+b") as file:
            file.write(b"\0" * 8)
    else:
        name = "step_motion"
    with pytest.raises(RecordViewError, match=str(path)):
        RecordView(path, (name,))
