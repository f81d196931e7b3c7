"""Fills in the keys that `rtcp device new` leaves without a value."""

from __future__ import annotations

import re
from collections.abc import Mapping

FIGURES: Mapping[str, object] = {
    "encoder_increments": 65536, "gear_ratio": 1, "external_gear_ratio": 1, "feed_constant": 0,
    "velocity_unit": "counts/s", "velocity_at": "motor", "rated_torque": 1.0, "torque_at": "motor",
    "assign_activate": 0x0300,
}  # fmt: skip
"""Of a drive about which nothing is to be said."""
_EMPTY = re.compile(r"(\w+):(?= +# REQUIRED)")


def filled(text: str, figures: Mapping[str, object] = FIGURES) -> str:
    """Return the text of a device's file with its figures; raises KeyError for one that is asked for and not there."""
    return _EMPTY.sub(lambda key: f"{key[0]} {figures[key[1]]}", text)
