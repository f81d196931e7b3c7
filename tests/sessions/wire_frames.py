"""The cyclic frames of a capture, as the judge sees frames: what was sent, and what came back to the master in time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path

from rtcp.launch.simulation import Frame
from tests.e2e.wire import BOX_OUT, DRIVE, DRIVES, LRW, datagrams, frames

NOP = 0
FENCE_INDEX = 0xF0
"""Of the numbered frame that the master lets pass after an exchange whose answer did not come in time."""
BOX_IN = 6
OUTPUTS = BOX_OUT + DRIVES * DRIVE.size
INPUTS = BOX_IN + DRIVES * DRIVE.size
EXPECTED_WKC = 3 * (DRIVES + 1)
"""ETG.1000.4: each slave that takes part in an LRW adds 1 for reading and 2 for writing."""


class _Exchange:
    """A frame on its way."""

    def __init__(self, now_ns: int, index: int, sent: bytes) -> None:
        self.now_ns, self.index, self.sent = now_ns, index, sent
        self.received: bytes | None = None
        self.wkc = -1
        self.taken = True
        """Whether the master sent no fence behind it: it has taken the answer for one."""


def exchanges(path: Path) -> Iterator[Frame]:
    """Yield every cyclic frame that reached the segment, in order; one slave's bytes after the other's.

    The working counter is -1 where the master heard no answer: none came, or a fence followed it. All frames that are
    captured have been heard by the slaves.
    """
    under_way: deque[_Exchange] = deque()
    last = bytes(INPUTS)
    for when, answer, got in frames(path):
        for command, index, data, wkc in datagrams(got):
            if command == NOP and index == FENCE_INDEX and not answer and under_way:
                under_way[-1].taken = False
            if command != LRW or len(data) != OUTPUTS + INPUTS:
                continue
            if answer:
                _answered(under_way, index, data, wkc)
            else:
                under_way.append(_Exchange(when, index, data[:OUTPUTS]))
        # The newest is kept: whether a fence follows is not known yet. So is what may be answered late.
        while len(under_way) > 1 and (under_way[0].received is not None or len(under_way) > _LATEST):
            last = under_way[0].received or last
            yield _frame(under_way.popleft(), last)
    for exchange in under_way:
        last = exchange.received or last
        yield _frame(exchange, last)


_LATEST = 8192
"""So many frames may wait for a segment that stands still."""


def _answered(under_way: deque[_Exchange], index: int, data: bytes, wkc: int) -> None:
    # The newest that fits: SOEM's index comes again after 16 frames, and the segment answers no frame that is so old.
    found = False
    for exchange in reversed(under_way):
        if exchange.received is not None:
            return
        if found:
            # Frames do not overtake one another: what is older is not answered any more.
            exchange.received = b""
        elif exchange.index == index and exchange.sent == data[:OUTPUTS]:
            found, exchange.received, exchange.wkc = True, data[OUTPUTS:], wkc


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
