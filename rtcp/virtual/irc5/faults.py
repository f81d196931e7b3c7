"""Faults of a unit's datagrams in one direction."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from random import Random

SHARES = ("lost", "doubled", "old")
"""Faults that affect a share of the datagrams, 0 to 1."""
_REMEMBERED = 25
"""Datagrams that may be repeated as old ones: 0.1 s."""


class DatagramFaults:
    """Path of datagrams with the faults set here. The same seed gives the same losses."""

    def __init__(self, seed: int) -> None:
        self._random = Random(seed)
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._cycle = 0
        self.clear()

    def clear(self) -> None:
        """End all faults; delayed datagrams still arrive."""
        self.silent = False
        self.late = 0
        """Delay, cycles."""
        self.shares = dict.fromkeys(SHARES, 0.0)

    def cycle(self, datagrams: Iterable[bytes]) -> list[bytes]:
        """Take the datagrams sent in a cycle and return those that arrive in it."""
        self._cycle += 1
        for datagram in datagrams:
            self._sent.append(datagram)
            if self.silent or self._happens("lost"):
                continue
            arriving = self._random.choice(self._sent) if self._happens("old") else datagram
            for _ in range(2 if self._happens("doubled") else 1):
                self._under_way.append((self._cycle + self.late, arriving))
        arrived = [datagram for due, datagram in self._under_way if due <= self._cycle]
        self._under_way = deque(entry for entry in self._under_way if entry[0] > self._cycle)
        return arrived

    def _happens(self, kind: str) -> bool:
        share = self.shares[kind]
        return share > 0.0 and self._random.random() < share
