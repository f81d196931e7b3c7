"""Faults of the virtual segment in words: the kinds there are, and those that are active."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, get_type_hints

from rtcp.config.checking import allowed
from rtcp.config.faults import FAULTS

_IN_HEX = ("code", "index")


@dataclass(frozen=True)
class Kind:
    """A kind of fault: what it is, and what is allowed for each of its keys."""

    name: str
    says: str
    keys: dict[str, str]


def kinds() -> list[Kind]:
    """Return every kind of fault that there is."""
    return [
        Kind(name, str(kind.__doc__).partition("\n")[0], {field.name: _allowed(kind, field) for field in fields(kind)})
        for name, kind in FAULTS.items()
    ]


def _allowed(kind: Any, field: Any) -> str:
    text = allowed(get_type_hints(kind, include_extras=True)[field.name])
    if field.default is MISSING:
        return text
    if field.default is None:
        return f"{text} (rate or burst)"
    return f"{text} ({_shown(field.name, field.default)} if left out)"


def _shown(key: str, value: Any) -> str:
    return f"0x{value:04X}" if key in _IN_HEX else f"{value:g}" if isinstance(value, float) else str(value)


def named(fault: Mapping[str, Any]) -> str:
    """Return a fault as commands name it."""
    own = [f"{key}={_shown(key, value)}" for key, value in fault.items() if key not in ("fault", "at", "lasts")]
    return " ".join([fault["fault"], *own])


def line_of(active: Mapping[str, Any]) -> str:
    """Return the line of an active fault: its number, what it is, since when, for how long, what it has done."""
    left = "until it is cleared" if active["left_s"] is None else f"{active['left_s']:.1f} s to come"
    done = "".join(f", {count} {what.replace('_', ' ')}" for what, count in active["counts"].items())
    return f"fault {active['id']}: {named(active['fault'])}, for {active['since_s']:.1f} s, {left}{done}"
