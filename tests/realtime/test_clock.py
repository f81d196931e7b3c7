"""Sleeping until an instant."""

from __future__ import annotations

import signal
import time
from time import monotonic_ns

from rtcp.realtime.scheduling import Sleeper


def test_it_never_wakes_early() -> None:
    sleeper = Sleeper()
    for _ in range(20):
        instant = monotonic_ns() + 2_000_000
        sleeper.until(instant)
        assert monotonic_ns() >= instant


def test_an_instant_in_the_past_returns_at_once() -> None:
    before = time.process_time()
    Sleeper().until(monotonic_ns() - 10**9)
    assert time.process_time() >= before


def test_a_signal_does_not_shorten_the_sleep() -> None:
    before = signal.signal(signal.SIGALRM, lambda number, frame: None)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        instant = monotonic_ns() + 60_000_000
        Sleeper().until(instant)
        assert monotonic_ns() >= instant
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
