"""The cyclic frames of a capture for the checker: outputs, and the answers that came in time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rtcp.motion.limits import Corners, Values
from rtcp.testing.sessions.checker import FrameChecker
from rtcp.testing.simulation import Frame
from tests.e2e.wire import BOX_IN, BOX_OUT, DRIVE, DRIVES, LRW, datagrams, frames

NOP = 0
BARRIER_INDEX = 0xF0
"""Index of the barrier frame that the master sends after an exchange without an answer in time."""
OUTPUTS = BOX_OUT + DRIVES * DRIVE.size
INPUTS = BOX_IN + DRIVES * DRIVE.size
EXPECTED_WKC = 3 * (DRIVES + 1)
"""ETG.1000.4: each slave that takes part in an LRW adds 1 for reading and 2 for writing."""


class _Exchange:
    """A sent frame and its answer."""

    def __init__(self, now_ns: int, index: int, sent: bytes) -> None:
        self.now_ns, self.index, self.sent = now_ns, index, sent
        self.received: bytes | None = None
        self.wkc = -1
        self.taken = True
        """Whether the master sent no barrier frame behind it: it has taken the answer."""


def exchanges(path: Path) -> Iterator[Frame]:
    """Yield every cyclic frame that reached the segment, in order; one slave's bytes after the other's.

    The working counter is -1 where the master heard no answer: none came, or a barrier frame followed it.
    All frames that are captured have been heard by the slaves.
    """
    under_way: deque[_Exchange] = deque()
    last = bytes(INPUTS)
    for when, answer, got in frames(path):
        for command, index, data, wkc in datagrams(got):
            if command == NOP and index == BARRIER_INDEX and not answer and under_way:
                under_way[-1].taken = False
            if command != LRW or len(data) != OUTPUTS + INPUTS:
                continue
            if answer:
                _answered(under_way, index, data, wkc)
            else:
                under_way.append(_Exchange(when, index, data[:OUTPUTS]))
        # The newest is kept: whether a barrier frame follows is not known yet. So is what may be answered late.
        while len(under_way) > 1 and (under_way[0].received is not None or len(under_way) > _LATEST):
            last = under_way[0].received or last
            yield _frame(under_way.popleft(), last)
    for exchange in under_way:
        last = exchange.received or last
        yield _frame(exchange, last)


_LATEST = 8192
"""Most frames that may wait for a stopped segment."""


def _answered(under_way: deque[_Exchange], index: int, data: bytes, wkc: int) -> None:
    # The newest that fits: SOEM's index comes again after 16 frames, and the segment answers no frame that is so old.
    has_answer = False
    for exchange in reversed(under_way):
        if exchange.received is not None:
            return
        if has_answer:
            # Frames do not overtake one another: older ones get no answer any more.
            exchange.received = b""
        elif exchange.index == index and exchange.sent == data[:OUTPUTS]:
            has_answer, exchange.received, exchange.wkc = True, data[OUTPUTS:], wkc


def _frame(exchange: _Exchange, last: bytes) -> Frame:
    received = bool(exchange.received) and exchange.taken
    return Frame(
        exchange.now_ns,
        _split(exchange.sent, BOX_OUT),
        True,
        exchange.wkc if received else -1,
        _split(last, BOX_IN),
    )


def _split(image: bytes, box: int) -> tuple[bytes, ...]:
    size = DRIVE.size
    return (image[:box], *(image[at : at + size] for at in range(box, box + DRIVES * size, size)))


# -- limits that change while frames go by: when exactly is not known, so the wider of both hold meanwhile ----------

_JOINT_KEYS = {"min": "low", "max": "high", "velocity": "velocity", "acceleration": "acceleration", "torque": "torque"}


@dataclass(frozen=True)
class Change:
    """New limits, in force from some frame between two instants (ns, CLOCK_MONOTONIC) on."""

    asked_ns: int
    done_ns: int
    new: Values


class Limiter:
    """Gives the checker the limits of the time of each frame.

    Args:
        checker: whose bounds are kept up to date.
        first: in force before all changes.
        changes: in their order.
        slack_ns: so long before and after the question and the answer the wider limits hold, too.
    """

    def __init__(self, checker: FrameChecker, first: Values, changes: Iterable[Change], slack_ns: int) -> None:
        self._checker = checker
        self._now = first
        self._changes = [*changes]
        self._slack_ns = slack_ns
        self._between = False

    def at(self, now_ns: int) -> None:
        """Put the limits of `now_ns` into the checker's bounds."""
        while self._changes:
            change = self._changes[0]
            if now_ns < change.asked_ns - self._slack_ns:
                return
            if now_ns <= change.done_ns + self._slack_ns:
                if not self._between:
                    self._between = True
                    self._checker.bounds.put(wider(self._now, change.new))
                return
            self._now, self._between = change.new, False
            del self._changes[0]
            self._checker.bounds.put(self._now)
            self._checker.changed()


def wider(a: Values, b: Values) -> Values:
    """Return limits that allow everything that one of two allows."""
    return replace(
        a,
        low=tuple(map(min, a.low, b.low)),
        high=tuple(map(max, a.high, b.high)),
        **{
            name: tuple(map(max, getattr(a, name), getattr(b, name))) for name in ("velocity", "acceleration", "torque")
        },
        box=None if a.box is None or b.box is None else _hull(a.box, b.box),
        keep_out=tuple(_common(box, other_box) for box, other_box in zip(a.keep_out, b.keep_out, strict=True)),
    )


def _hull(a: Corners, b: Corners) -> Corners:
    return (*map(min, a[:3], b[:3]), *map(max, a[3:], b[3:]))  # type: ignore[return-value]


def _common(a: Corners, b: Corners) -> Corners:
    return (*map(max, a[:3], b[:3]), *map(min, a[3:], b[3:]))  # type: ignore[return-value]


def from_answer(shown: Mapping[str, Any], jerk: tuple[float, ...]) -> Values:
    """Return the limits that an answer to `limits` on the control socket shows (its key `limits`)."""
    limits = {name: tuple(shown[key]) for key, name in _JOINT_KEYS.items()}
    return Values(
        **limits, jerk=jerk, box=_corners(shown["box"]), keep_out=tuple(map(_box, shown["keep_out"].values()))
    )


def _box(box: Mapping[str, Any]) -> Corners:
    return (*box["min"], *box["max"])


def _corners(box: Mapping[str, Any] | None) -> Corners | None:
    return None if box is None else _box(box)
