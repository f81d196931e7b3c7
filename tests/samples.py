"""Numbers of samples of a property: few by default, all with `RTCP_THOROUGH=1`, which `make test-all` sets."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TypeVar

Case = TypeVar("Case")
THOROUGH = "RTCP_THOROUGH" in os.environ
"""Whether every sample runs; else a share of the samples."""


def examples(full: int) -> int:
    """Return the number of examples of a property."""
    return full if THOROUGH else min(full, max(full // 10, 3))


def some(cases: Iterable[Case], every: int = 3) -> list[Case]:
    """Return every third of the cases, or all."""
    full = list(cases)
    return full if THOROUGH else full[::every]
