"""Numbers as people write them."""

from __future__ import annotations


def plain_number(written: object) -> float:
    """Return a number, or the one that a text says in digits, sign, point and exponent.

    0_1 and digits of other scripts, which Python would take, are slips of the keyboard here.

    Raises:
        ValueError: it says none.
    """
    if isinstance(written, str):
        if "_" in written or not written.isascii():
            raise ValueError(f"{written!r} is not a number")
        return float(written)
    if isinstance(written, int | float):
        return float(written)
    raise ValueError(f"{written!r} is not a number")
