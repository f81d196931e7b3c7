"""Numbers as people write them, and the ranges of numbers that keys allow. Imports nothing heavy."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen

_FRACTION_OF_PI = re.compile(r"([-+]?)(?:([1-9]\d{0,3})\*)?pi(?:/([1-9]\d{0,3}))?", re.ASCII)
_FULL_TURN = 2 * math.pi


def angle(written: object) -> object:
    """Return the number of a fraction of pi (`pi`, `-pi/2`, `11*pi/12`), and anything else unchanged."""
    match = _FRACTION_OF_PI.fullmatch(written) if isinstance(written, str) else None
    if match is None:
        return written
    sign, times, parts = match.groups()
    size = int(times or 1) * math.pi / int(parts or 1)
    return -size if sign == "-" else size


def plain_number(written: object) -> float:
    """Return a number, or that of a text of digits, sign, point and exponent.

    Python also accepts `0_1` and digits of other scripts: here they are typing errors.

    Raises:
        ValueError: the value states no number.
    """
    if isinstance(written, str) and "_" not in written and written.isascii():
        return float(written)
    if isinstance(written, int | float):
        return float(written)
    raise ValueError(f"{written!r} is not a number")


@dataclass(frozen=True)
class FractionOfPi:
    """Marks a number that may also be written as a fraction of pi: in a type's `Annotated`, before its bounds."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return pydantic's schema: called only by processes that validate and have loaded pydantic."""
        from pydantic_core import core_schema

        return core_schema.no_info_before_validator_function(angle, handler(source))


U8 = Annotated[int, Ge(0), Le(0xFF)]
U16 = Annotated[int, Ge(0), Le(0xFFFF)]
U32 = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
Factor = Annotated[int, Ge(-1000), Le(1000)]
Terminal = Annotated[int, Ge(1), Le(16)]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Rate = Annotated[float, Ge(0.001)]
Fraction = Annotated[float, Gt(0), Lt(1)]
Name = Annotated[str, MinLen(1), MaxLen(64)]
Length = Annotated[float, Ge(-100), Le(100)]
"""m; a value beyond 100 m is one in millimeters."""
Vector = Annotated[tuple[Length, ...], MinLen(3), MaxLen(3)]
Angle = Annotated[float, FractionOfPi()]
Turn = Annotated[float, FractionOfPi(), Ge(-_FULL_TURN), Le(_FULL_TURN)]
"""rad; a value beyond a full turn is one in degrees."""
Speed = Annotated[float, FractionOfPi(), Gt(0)]
Milliseconds = Annotated[float, Ge(0), Le(1000)]
