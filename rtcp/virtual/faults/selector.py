"""Which frames a fault strikes."""

from __future__ import annotations

from random import Random
from typing import Protocol


class _Struck(Protocol):
    """A fault that strikes some frames and leaves others alone."""

    @property
    def rate(self) -> float | None: ...
    @property
    def burst(self) -> int | None: ...
    @property
    def seed(self) -> int: ...


class FrameSelector:
    """Which frames a fault strikes: each with the probability of its rate, or the next ones of its burst."""

    def __init__(self, fault: _Struck) -> None:
        self.random = Random(fault.seed)
        self._rate = fault.rate or 0.0
        self._left = fault.burst

    def next(self) -> bool:
        """Whether the next frame is struck."""
        if self._left is None:
            return self.random.random() < self._rate
        if not self._left:
            return False
        self._left -= 1
        return True

    @property
    def passed(self) -> bool:
        """Whether the burst has passed."""
        return self._left == 0
