"""The faults that are active on a segment, when each began, when it ends, and those that a script still holds."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.config.faults import ONCE, Planned
from rtcp.virtual.faults import slaves
from rtcp.virtual.faults.frame_faults import Send
from rtcp.virtual.faults.frames import FOR_EVER, FRAME_FAULTS, Frames
from rtcp.virtual.faults.slaves import FaultRefused, Undo
from rtcp.virtual.segment import Segment

MOST_ACTIVE = 50

Report = Callable[[str], None]


@dataclass(frozen=True)
class _Active:
    """A fault that has begun; instants in ns."""

    planned: Planned
    since: int
    until: int
    undo: Undo


class FaultRegistry:
    """Begins and ends faults. Nothing happens by itself: `tick` is to be called when `due` has come.

    `send` puts a frame on the cable to the master. The times of `script` count from instant `t`; what a segment refuses
    of it is told to `report`. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, segment: Segment, send: Send, t: int, script: Sequence[Planned] = (),
                 report: Report = print) -> None:  # fmt: skip
        self.frames = Frames(send)
        """What happens to frames; look at its `active` before each of them."""
        self.due = FOR_EVER
        """Instant of the next call of `tick` that is needed."""
        self._segment = segment
        self._report = report
        self._active: dict[int, _Active] = {}
        self._last = 0
        self._script = deque((t + round(planned.at * 1e9), planned) for planned in script)
        self._look_ahead()

    def begin(self, planned: Planned, t: int) -> int:
        """Let a fault begin at instant `t`, whatever its `at` says; return its number.

        Raises:
            FaultRefused: a fault that this segment cannot have, or too many at once.
        """
        self._drop_passed()
        if len(self._active) >= MOST_ACTIVE:
            raise FaultRefused(f"{MOST_ACTIVE} faults are active already: clear some of them first")
        undo = self._make(planned, t)
        self._last += 1
        if not isinstance(planned.fault, ONCE) and not _over(undo):
            until = FOR_EVER if planned.lasts is None else t + round(planned.lasts * 1e9)
            self._active[self._last] = _Active(planned, t, until, undo)
        self._look_ahead()
        return self._last

    def _make(self, planned: Planned, t: int) -> Undo:
        if isinstance(planned.fault, FRAME_FAULTS):
            return self.frames.begin(planned.fault, t)
        return slaves.begin(self._segment, planned.fault, t, planned.lasts)

    def clear(self, number: int | None, t: int) -> list[int]:
        """End a fault, or all that are active when None; return the numbers of those that were.

        Raises:
            FaultRefused: no active fault has this number.
        """
        self._drop_passed()
        if number is not None and number not in self._active:
            if 0 < number <= self._last:
                raise FaultRefused(f"fault {number} is not active any more")
            known = ", ".join(map(str, self._active)) or "none"
            raise FaultRefused(f"there was no fault {number}; active now: {known}")
        cleared = list(self._active) if number is None else [number]
        # The last one first: each finds the segment as it was when it began.
        for each in reversed(cleared):
            self._active.pop(each).undo(t)
        self._look_ahead()
        return cleared

    def tick(self, now: int) -> None:
        """End the faults whose time is over, begin those of the script that are due, send the frames that are due."""
        self._drop_passed()
        for number in reversed([number for number, each in self._active.items() if each.until <= now]):
            self._active.pop(number).undo(now)
        while self._script and self._script[0][0] <= now:
            _, planned = self._script.popleft()
            try:
                self.begin(planned, now)
            except FaultRefused as error:
                self._report(f"the script's fault {planned.fault.name} at {planned.at:g} s is left out: {error}")
        if self.frames.due <= now:
            self.frames.tick(now)
        self._look_ahead()

    def answers(self, frame: bytes, t: int) -> None:
        """Send, keep or lose the answer to a frame that came at `t`."""
        self.frames.answers(frame, t)
        self.due = min(self.due, self.frames.due)

    def listing(self, t: int) -> list[dict[str, Any]]:
        """Return the active faults: number, mapping, how long for and for how long to come, what each has done."""
        self._drop_passed()
        return [
            {
                "id": number,
                "fault": each.planned.as_mapping(),
                "since_s": (t - each.since) * 1e-9,
                "left_s": None if each.until == FOR_EVER else max(0, each.until - t) * 1e-9,
                "counts": getattr(each.undo, "counts", {}),
            }
            for number, each in self._active.items()
        ]

    def _drop_passed(self) -> None:
        """Forget bursts that have passed."""
        for number in [number for number, each in self._active.items() if _over(each.undo)]:
            del self._active[number]

    def _look_ahead(self) -> None:
        due = self.frames.due
        if self._script:
            due = min(due, self._script[0][0])
        for each in self._active.values():
            due = min(due, each.until)
        self.due = due


def _over(undo: Undo) -> bool:
    return bool(getattr(undo, "over", False))
