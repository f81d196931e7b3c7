"""How many samples of a property run by default; `RTCP_SLOW=1` runs all of them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TypeVar

Case = TypeVar("Case")
SLOW = "RTCP_SLOW" in os.environ
"""Whether every case runs; else a share of the samples."""


def examples(full: int) -> int:
    """How many examples of a property run."""
    return full if SLOW else max(full // 6, 5)


def some(cases: Iterable[Case], every: int = 3) -> list[Case]:
    """Every third of the cases, or all."""
    found = list(cases)
    return found if SLOW else found[::every]
