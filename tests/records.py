"""Cycle records that tests make: the numbers of a record by the names of its fields."""

from __future__ import annotations

from typing import Any

from rtcp.ipc.schema import RecordSchema


def numbers(schema: RecordSchema, **given: Any) -> list[Any]:
    """Return what `Blackboard.publish` takes; fields that are not given are 0, one number stands for a whole vector."""
    flat: list[Any] = []
    for field in schema.fields[1:]:
        value = given.pop(field.name, 0)
        flat += [value] * field.count if isinstance(value, (int, float)) else list(value)
    assert not given, f"no fields of the schema: {', '.join(given)}"
    return flat
