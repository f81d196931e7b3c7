"""Checks plain values against a frozen dataclass: pydantic finds what is wrong, this module says what is allowed."""

from __future__ import annotations

import difflib
import json
import types
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import ConfigDict, TypeAdapter, ValidationError

from rtcp.config.document import Finding, KeyPath

T = TypeVar("T")


@dataclass(frozen=True)
class AlsoText:
    """Beside the type of a number that a text may stand for too: which texts, in words."""

    words: str


# Strict: "500" and true are no numbers, 2.5 is no integer. The loss of a silent conversion is the point.
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Checker(Generic[T]):
    """Makes objects of one frozen dataclass out of plain values, or says all that is wrong with them."""

    def __init__(self, kind: type[T]) -> None:
        self.kind = kind
        # Pydantic takes a configuration for a dataclass only from outside: from the list around it.
        around: Any = types.GenericAlias(list, (kind,))
        self._adapter: TypeAdapter[Any] = TypeAdapter(around, config=_STRICT)

    def check(self, data: object) -> tuple[T | None, list[Finding]]:
        """Return the object, or None and every mistake."""
        try:
            # By way of JSON, whose strict reading turns lists into tuples and mappings into dataclasses.
            made: list[T] = self._adapter.validate_json(json.dumps([data]))
        except ValidationError as error:
            found = error.errors(include_url=False)
            # Pydantic counts the sound entries of a list: one with wrong entries is not too short for that.
            counted = [
                detail
                for detail in found
                if detail["type"] != "too_short" or len(detail["input"]) < detail["ctx"]["min_length"]
            ]
            return None, [self._finding(detail["type"], detail["loc"][1:], detail["input"]) for detail in counted]
        return made[0], []

    def _finding(self, reason: str, where: KeyPath, found: object) -> Finding:
        if reason == "missing":
            return where[:-1], f"the key {where[-1]} is missing; it must be {allowed(annotation(self.kind, where))}"
        if reason == "unexpected_keyword_argument":
            return where, unknown_key(str(where[-1]), keys(annotation(self.kind, where[:-1])))
        wanted = annotation(self.kind, where)
        if reason in ("too_short", "too_long") and isinstance(found, list) and found:
            return where, f"found a list of {len(found)}, allowed is {allowed(wanted)}"
        return where, f"found {shown(found)}, allowed is {allowed(wanted)}{_hint(wanted, found)}"


def annotation(kind: object, where: KeyPath) -> object:
    """Return the type, with its bounds, of the value at a key path below a dataclass."""
    for key in where:
        bare = _bare(kind)
        kind = get_args(bare)[0] if isinstance(key, int) else get_type_hints(bare, include_extras=True)[key]
    return kind


def keys(kind: object) -> list[str]:
    """Return the keys of a dataclass."""
    bare: Any = _bare(kind)
    return [field.name for field in fields(bare)]


def unknown_key(key: str, known: list[str], what: str = "key") -> str:
    """Return the sentence for a key, or another name, that means nothing here."""
    close = difflib.get_close_matches(key, known, n=1)
    guess = f"did you mean {close[0]}? " if close else ""
    return f"this {what} is not known here; {guess}allowed are {', '.join(known)}"


def allowed(kind: object) -> str:
    """Return in words what a type with its bounds allows: `an integer from 0 to 255`."""
    bounds = {type(bound): bound for bound in _bounds(kind)}
    bare = _bare(kind)
    if get_origin(bare) is Literal:
        return f"one of {', '.join(str(choice) for choice in get_args(bare))}"
    if bare in (int, float):
        also = f", or {bounds[AlsoText].words}" if AlsoText in bounds else ""
        return ("an integer" if bare is int else "a number") + _span(bounds) + also
    if bare is bool:
        return "true or false"
    if bare is str:
        return "a text" + (f" of 1 to {bounds[MaxLen].max_length} characters" if MaxLen in bounds else "")
    if get_origin(bare) is tuple:
        if MinLen in bounds and MaxLen in bounds and bounds[MinLen].min_length == bounds[MaxLen].max_length:
            of = {float: "numbers", int: "integers"}.get(_bare(get_args(bare)[0]), "entries")
            return f"a list of {bounds[MinLen].min_length} {of}"
        if MinLen in bounds and MaxLen in bounds:
            return f"a list of {bounds[MinLen].min_length} to {bounds[MaxLen].max_length} entries"
        return "a list" + (" with at least one entry" if MinLen in bounds else "")
    if is_dataclass(bare):
        return f"a mapping with the keys {', '.join(keys(bare))}"
    return "a mapping"


def shown(found: object) -> str:
    """Return a value as a sentence names it."""
    if isinstance(found, bool):
        return "true" if found else "false"
    if found is None:
        return "nothing"
    if isinstance(found, str):
        return f'the text "{found if len(found) <= 60 else found[:57] + "..."}"'
    if isinstance(found, dict):
        return "a mapping"
    if isinstance(found, list):
        return "an empty list" if not found else "a list"
    return str(found)


def _bare(kind: object) -> Any:
    if get_origin(kind) is Annotated:
        return _bare(get_args(kind)[0])
    if get_origin(kind) in (Union, types.UnionType):
        return _bare(next(choice for choice in get_args(kind) if choice is not type(None)))
    return kind


def _bounds(kind: object) -> Iterable[Any]:
    if get_origin(kind) is Annotated:
        return get_args(kind)[1:]
    if get_origin(kind) in (Union, types.UnionType):
        return _bounds(get_args(kind)[0])
    return ()


def _span(bounds: dict[type, Any]) -> str:
    if Ge in bounds and Le in bounds:
        return f" from {bounds[Ge].ge} to {bounds[Le].le}"
    limits = []
    if Gt in bounds:
        limits.append(f"greater than {bounds[Gt].gt}")
    if Ge in bounds:
        limits.append(f"of at least {bounds[Ge].ge}")
    if Lt in bounds:
        limits.append(f"less than {bounds[Lt].lt}")
    if Le in bounds:
        limits.append(f"at most {bounds[Le].le}")
    return " " + " and ".join(limits) if limits else ""


def _hint(wanted: object, found: object) -> str:
    """Return what YAML may have made of a value that looks right to its writer."""
    bare = _bare(wanted)
    if isinstance(found, str) and bare in (int, float):
        try:
            float(int(found, 0)) if found[:2].lower() == "0x" else float(found)
        except ValueError:
            unit = found.split()
            return "; write the number alone, the key names its unit" if len(unit) == 2 else ""
        leading_zero = len(found) > 1 and found[0] == "0" and found[1].isdigit()
        return f"; write it without {'leading zeros' if leading_zero else 'quotes'}"
    if isinstance(found, str) and bare is bool and found.lower() in ("yes", "no", "on", "off"):
        return "; yes, no, on and off are texts here"
    if isinstance(found, (int, float, bool)) and bare is str:
        return "; write it in quotes"
    return ""
