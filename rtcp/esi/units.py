"""Units in the notation of ETG.1004 (as CiA 303-2): exponent, numerator, denominator, one byte each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple


class Unit(NamedTuple):
    """A unit: a value in it times `factor` is one in `si`."""

    text: str
    factor: float
    si: str
    """Unit of the SI; "" for numbers without a unit, `count` for increments."""


_TURN = 2 * math.pi
_PLAIN = {
    0x01: "m", 0x02: "kg", 0x03: "s", 0x04: "A", 0x05: "K", 0x06: "mol", 0x07: "cd", 0x10: "rad", 0x11: "sr",
    0x20: "Hz", 0x21: "N", 0x22: "Pa", 0x23: "J", 0x24: "W", 0x25: "C", 0x26: "V", 0x27: "F", 0x28: "Ω", 0x29: "S",
    0x2A: "Wb", 0x2B: "T", 0x2C: "H", 0x2D: "°C", 0x2E: "lm", 0x2F: "lx", 0x30: "Bq", 0x31: "Gy", 0x32: "Sv",
    0x55: "m/s²", 0x56: "Nm", 0x57: "s²",
}  # fmt: skip
"""Notation index -> unit of the SI (CiA 303-2, 4.1 to 4.4)."""
_OTHERS = {
    0x00: Unit("", 1.0, ""),
    0x40: Unit("gon", _TURN / 400, "rad"),
    0x41: Unit("°", _TURN / 360, "rad"),
    0x42: Unit("'", _TURN / 360 / 60, "rad"),
    0x43: Unit("''", _TURN / 360 / 3600, "rad"),
    0x44: Unit("l", 1e-3, "m³"),
    0x47: Unit("min", 60.0, "s"),
    0x48: Unit("h", 3600.0, "s"),
    0x49: Unit("d", 86400.0, "s"),
    0x4A: Unit("a", 31557600.0, "s"),
    0xB4: Unit("rev", _TURN, "rad"),
    0xB5: Unit("inc", 1.0, "count"),
    0xB6: Unit("rpm", _TURN / 60, "rad/s"),
}
"""Notation index -> further units (CiA 303-2, 4.4; 0xB4 and above as drives use them)."""
_BY_SYMBOL = {
    **{symbol.lower(): Unit(symbol, 1.0, symbol) for symbol in (*_PLAIN.values(), "rad/s")},
    "%": Unit("%", 0.01, ""),
    "1/min": _OTHERS[0xB6],
    "rpm": _OTHERS[0xB6],
    "inc": _OTHERS[0xB5],
    "increments": _OTHERS[0xB5],
}
"""Symbols of a file's own units that are understood."""
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 3: "k", 6: "M", 9: "G"}
_UNPREFIXED = {"", "kg", "°C", "°", "'", "''", "min", "h", "d", "a", "rev", "inc", "rpm", "s²", "m/s²", "gon"}
_QUOTIENTS = {("rev", "min"): "rpm"}
_SI_QUOTIENTS = {"rad/s/s": "rad/s²", "rad/s²/s": "rad/s³"}


def _single(index: int, own: Mapping[int, str]) -> Unit | None:
    if index in own:
        return _BY_SYMBOL.get(own[index].strip().lower(), Unit(own[index], 1.0, own[index]))
    if index in _PLAIN:
        return Unit(_PLAIN[index], 1.0, _PLAIN[index])
    return _OTHERS.get(index)


def unit(notation: int, own: Mapping[int, str] | None = None) -> Unit | None:
    """Return the unit of a notation; `own` are the symbols that a file gives to indices. None: it is not known."""
    exponent = (notation >> 24 & 0xFF ^ 0x80) - 0x80
    above = _single(notation >> 16 & 0xFF, own or {})
    below = _single(notation >> 8 & 0xFF, own or {})
    if above is None or below is None:
        return None
    text = _QUOTIENTS.get((above.text, below.text), f"{above.text or '1'}/{below.text}" if below.text else above.text)
    si = f"{above.si or '1'}/{below.si}" if below.si else above.si
    si = _SI_QUOTIENTS.get(si, si)
    factor = above.factor / below.factor * 10.0**exponent
    if exponent == -2 and not text:
        text = "%"
    elif exponent == -3 and not text:
        text = "‰"
    elif exponent in _PREFIXES and above.text not in _UNPREFIXED and text != "rpm":
        text = _PREFIXES[exponent] + text
    elif exponent:
        text = f"{10.0**exponent:g} {text}".strip()
    return Unit(text, factor, si)
