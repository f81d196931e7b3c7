"""Numbers of samples of a property by default; `RTCP_SLOW=1` runs all of them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TypeVar

Case = TypeVar("Case")
SLOW = "RTCP_SLOW" in os.environ
"""Whether every case runs; else a share of the samples."""


def examples(full: int) -> int:
    """Return the number of examples of a property."""
    return full if SLOW else max(full // 6, 5)


def some(cases: Iterable[Case], every: int = 3) -> list[Case]:
    """Return every third of the cases, or all."""
    full = list(cases)
    return full if SLOW else full[::every]
