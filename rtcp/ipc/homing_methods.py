"""What a drive does in each homing method (object 0x6098; CiA 402-2 and IEC 61800-7-201, homing mode)."""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

HOMING_METHOD: Final = 0x6098
HOME_OFFSET: Final = 0x607C
PRESENT_POSITION: Final = frozenset({35, 37})
"""Methods that move nothing: the present position becomes the home."""
_WITHOUT_INDEX_PULSE: Final = 16
"""Methods 17 to 30 are methods 1 to 14 without the index pulse."""

_TO_LIMIT = "turns in {direction} direction to the {direction} limit switch, then back"
_TO_HOME = "turns to the edge of the {direction} home switch, in the direction that the switch's level says"
_PAST_HOME = "turns in {direction} direction, back at a limit switch, until it finds the home switch"
_P, _N = "positive", "negative"
# Method -> way, its direction, the edge at which the home is, the side of the edge on which its index pulse is
_SEARCHES: dict[int, tuple[str, str, str, str]] = {
    1: (_TO_LIMIT, _N, "edge of the negative limit switch", _P),
    2: (_TO_LIMIT, _P, "edge of the positive limit switch", _N),
    3: (_TO_HOME, _P, "edge of the positive home switch", _N),
    4: (_TO_HOME, _P, "edge of the positive home switch", _P),
    5: (_TO_HOME, _N, "edge of the negative home switch", _P),
    6: (_TO_HOME, _N, "edge of the negative home switch", _N),
    7: (_PAST_HOME, _P, "negative edge of the home switch", _N),
    8: (_PAST_HOME, _P, "negative edge of the home switch", _P),
    9: (_PAST_HOME, _P, "positive edge of the home switch", _N),
    10: (_PAST_HOME, _P, "positive edge of the home switch", _P),
    11: (_PAST_HOME, _N, "positive edge of the home switch", _P),
    12: (_PAST_HOME, _N, "positive edge of the home switch", _N),
    13: (_PAST_HOME, _N, "negative edge of the home switch", _P),
    14: (_PAST_HOME, _N, "negative edge of the home switch", _N),
}


def _described() -> dict[int, str]:
    texts = {0: "does nothing: no homing method is chosen"}
    for method, (way, direction, edge, side) in _SEARCHES.items():
        begin = way.format(direction=direction)
        texts[method] = f"{begin}: its home is the first index pulse on the {side} side of the {edge}"
        texts[method + _WITHOUT_INDEX_PULSE] = f"{begin}: its home is the {edge}, approached from the {side} side"
    for method, direction in ((33, _N), (34, _P)):
        texts[method] = f"turns in {direction} direction: its home is the next index pulse"
    for method in PRESENT_POSITION:
        texts[method] = "does not move: it declares the present position to be its home"
    return texts


HOMING_METHODS = MappingProxyType(_described())
"""What the drive does, by the method; directions are those of the drive."""


def homing_text(method: int | None) -> str:
    """Return what the drive does in a method; None: the drive does not tell it."""
    if method is None:
        return "homes by a method that it does not tell: it has no 0x6098"
    if method in HOMING_METHODS:
        return HOMING_METHODS[method]
    if method < 0:
        return "homes by a method of its maker: see the manual of the drive"
    return "homes by a method that the standard reserves: see the manual of the drive"
