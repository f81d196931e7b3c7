"""Entries as the numbers that they are: what a model keeps of its objects for its steps."""

from __future__ import annotations

from typing import Protocol, cast

from rtcp.virtual.objects import ObjectDictionary


class Number(Protocol):
    """An entry whose value is known to be an int."""

    value: int


def number(objects: ObjectDictionary, index: int, subindex: int = 0) -> Number:
    """Return the entry as a number; raises SdoAbort where it does not exist."""
    return cast(Number, objects[index, subindex])
