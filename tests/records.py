"""Cycle records of tests: the numbers of a record by the names of its fields."""

from __future__ import annotations

from typing import Any

from rtcp.ipc.schema import RecordSchema


def numbers(schema: RecordSchema, **given: Any) -> list[Any]:
    """Return the numbers for `Blackboard.publish`; missing fields are 0, one number fills a whole vector."""
    flat: list[Any] = []
    for field in schema.fields[1:]:
        value = given.pop(field.name, 0)
        flat += [value] * field.count if isinstance(value, (int, float)) else list(value)
    assert not given, f"no fields of the schema: {', '.join(given)}"
    return flat
