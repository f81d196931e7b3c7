"""When a segment that polls sleeps for the kernel's share of the CPU; time is simulated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.virtual import server
from rtcp.virtual.faults.fault import FOR_EVER
from rtcp.virtual.server import Server, StopRequest

PERIOD, STEP, SHARE = 500_000, 3_000, 0.075
FRAME = bytearray(60)
FRAME[12:14] = b"\x88\xa4"


class Cable:
    """Brings a frame every `PERIOD` ns; `ages` are the times that frames waited, ns."""

    def __init__(self, stop: StopRequest, frames: int) -> None:
        self.now, self.due, self.frames, self.stop = 0, PERIOD, frames, stop
        self.ages: list[int] = []
        self.asleep = 0

    def monotonic_ns(self) -> int:
        self.now += STEP
        return self.now

    def sleep(self, seconds: float) -> None:
        self.asleep += round(seconds * 1e9)
        self.now += round(seconds * 1e9)

    def recvmsg_into(self, buffers: list[memoryview], ancillary: int) -> tuple[int, list[bytes], int, None]:
        self.now += STEP
        if self.now < self.due:
            raise BlockingIOError
        self.ages.append(self.now - self.due)
        self.due += PERIOD
        self.stop.requested = len(self.ages) == self.frames
        buffers[0][: len(FRAME)] = FRAME
        return len(FRAME), [], 0, None

    def send(self, frame: object) -> None:
        pass

    def fileno(self) -> int:
        return -1


def test_a_segment_that_polls_sleeps_right_after_a_frame_and_keeps_none_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = StopRequest()
    cable = Cable(stop, 4000)
    monkeypatch.setattr(server, "time", cable)
    polling: Any = Server.__new__(Server)
    polling._socket = cable
    polling._truth = None
    polling.registry = SimpleNamespace(frames=SimpleNamespace(active=False), due=FOR_EVER)
    polling.segment = SimpleNamespace(
        process=lambda *frame: True, settle=lambda t: None, next_event=FOR_EVER, busy=False
    )  # fmt: skip
    polling.serve(stop, True, None, SHARE)
    assert max(cable.ages) <= 3 * STEP
    assert cable.asleep >= 0.9 * SHARE * cable.now
