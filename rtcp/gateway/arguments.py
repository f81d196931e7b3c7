"""The arguments of a request on the control socket: taken as what they are, never made into what they should be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypeVar

from rtcp.gateway.carrier import CommandFailed

T = TypeVar("T")
_LONGEST_SHOWN = 60


class Arguments:
    """What a client gave, as JSON has it: true, 1.9, 1.0 and "1" are no integers. Ranges are checked further on.

    Every method raises CommandFailed (`invalid`) with the key, what was found and what is allowed.
    """

    def __init__(self, given: Mapping[str, Any], within: str = "") -> None:
        self._given = given
        self._within = within

    def has(self, key: str) -> bool:
        """Return whether there is something, and not null."""
        return self._given.get(key) is not None

    def integer(self, key: str) -> int:
        """Return an integer."""
        return self._of(int, key, "an integer")

    def truth(self, key: str) -> bool:
        """Return true or false."""
        return self._of(bool, key, "true or false")

    def text(self, key: str) -> str:
        """Return a text."""
        return self._of(str, key, "a text")

    def truth_or_false(self, key: str) -> bool:
        """Return true or false; False where there is none."""
        return self.truth(key) if key in self._given else False

    def integer_or_none(self, key: str) -> int | None:
        """Return an integer; None for null and where there is none."""
        return None if self._given.get(key) is None else self.integer(key)

    def texts(self, key: str) -> list[str]:
        """Return a list of texts."""
        allowed = "a list of texts"
        given = self._of(list, key, allowed)
        if not all(type(value) is str for value in given):
            raise self._wrong(key, allowed)
        return given

    def rows(self, key: str) -> list[list[float]]:
        """Return a list of lists of numbers."""
        allowed = "a list of lists of numbers"
        try:
            return [[_number(value) for value in _list(row)] for row in self._of(list, key, allowed)]
        except (TypeError, OverflowError):
            raise self._wrong(key, allowed) from None

    def objects(self, key: str) -> list[Arguments]:
        """Return a list of objects, each to be taken apart in its turn."""
        allowed = "a list of objects"
        given = self._of(list, key, allowed)
        if not all(type(value) is dict for value in given):
            raise self._wrong(key, allowed)
        return [Arguments(value, f"{key}[{at}].") for at, value in enumerate(given)]

    def named_numbers(self, key: str) -> dict[str, float]:
        """Return an object of numbers."""
        allowed = "an object of numbers"
        try:
            return {name: _number(value) for name, value in self._of(dict, key, allowed).items()}
        except (TypeError, OverflowError):
            raise self._wrong(key, allowed) from None

    def number(self, key: str) -> float:
        """Return a number."""
        found = self.number_or_none(key)
        if found is None:
            raise CommandFailed("invalid", f"{self._within}{key} is missing; it must be a number")
        return found

    def numbers(self, key: str) -> list[float]:
        """Return a list of numbers."""
        allowed = "a list of numbers"
        try:
            return [_number(value) for value in self._of(list, key, allowed)]
        except (TypeError, OverflowError):
            raise self._wrong(key, allowed) from None

    def number_or_none(self, key: str) -> float | None:
        """Return a number; None for null and where there is none."""
        if self._given.get(key) is None:
            return None
        try:
            return _number(self._given[key])
        except (TypeError, OverflowError):
            raise self._wrong(key, "a number") from None

    def _of(self, kind: type[T], key: str, allowed: str) -> T:
        if key not in self._given:
            raise CommandFailed("invalid", f"{self._within}{key} is missing; it must be {allowed}")
        value = self._given[key]
        # Not isinstance: to Python, true is an integer.
        if type(value) is not kind:
            raise self._wrong(key, allowed)
        return value

    def _wrong(self, key: str, allowed: str) -> CommandFailed:
        shown = json.dumps(self._given[key])
        if len(shown) > _LONGEST_SHOWN:
            shown = shown[: _LONGEST_SHOWN - 3] + "..."
        return CommandFailed("invalid", f"{self._within}{key}: found {shown}, allowed is {allowed}")


def _list(value: object) -> list[Any]:
    if type(value) is not list:
        raise TypeError
    return value


def _number(value: int | float) -> float:
    """Return a number of JSON as a float; raises TypeError for what is none, OverflowError beyond the largest."""
    if type(value) not in (int, float):
        raise TypeError
    return float(value)
