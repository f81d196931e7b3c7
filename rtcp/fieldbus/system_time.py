"""The system time of a segment. A file of its own because the cycle uses it, and is compiled."""

from __future__ import annotations

from typing import Final

RANGE_32: Final = 1 << 32


class SystemTime:
    """System time of the segment, ns, with more bits than its clocks may have: those of 32 bits wrap every 4.29 s.

    All clocks are set to it, every SYNC0 lies on its grid, and the loop follows it. After the start it depends on no
    clock of the host but CLOCK_MONOTONIC.
    """

    def __init__(self, offset_ns: int | None = None) -> None:
        self.offset_ns = offset_ns
        """System time less CLOCK_MONOTONIC, ns; the loop keeps it up to date. None: the first reading sets it."""

    def extended(self, reading_ns: int, read_ns: int) -> int:
        """Return what a clock showed at `read_ns` (CLOCK_MONOTONIC), extended to the system time, ns.

        A reading below 2^32 counts as the low 32 bits; larger ones are complete.
        """
        if self.offset_ns is None or not 0 <= reading_ns < RANGE_32:
            return reading_ns
        near = read_ns + self.offset_ns
        return near + (reading_ns - near + RANGE_32 // 2) % RANGE_32 - RANGE_32 // 2
