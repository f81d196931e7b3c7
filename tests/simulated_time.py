"""Simulated time for code on asyncio, as fast as the host allows and independent of how fast that is.

The clocks of the module `time` stand still while something is to be done. When every task waits, they jump to the
instant that the next one waits for. Sockets within this process work; another process or thread has no part in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import selectors
import time
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, TypeVar
from unittest.mock import patch

T = TypeVar("T")
_WORK_S = 0.001
"""Time that work in another thread takes, s."""
_sleep = time.sleep


class Clock:
    """The clocks of `time`; they begin at the host's."""

    def __init__(self) -> None:
        self._now_ns = time.monotonic_ns()
        self._ahead_ns = time.time_ns() - self._now_ns

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self._now_ns += math.ceil(seconds * 1e9)

    @contextlib.contextmanager
    def shown(self) -> Iterator[Clock]:
        """Let all code of this process see this clock."""
        clocks: dict[str, Callable[..., object]] = {
            "monotonic_ns": lambda: self._now_ns,
            "monotonic": lambda: self._now_ns * 1e-9,
            "time_ns": lambda: self._now_ns + self._ahead_ns,
            "time": lambda: (self._now_ns + self._ahead_ns) * 1e-9,
            "sleep": self.advance,
        }
        with contextlib.ExitStack() as replaced:
            for name, clock in clocks.items():
                replaced.enter_context(patch.object(time, name, clock))
            yield self


def run(work: Coroutine[Any, Any, T], clock: Clock | None = None) -> T:
    """Run a coroutine as `asyncio.run` does, in simulated time."""
    with (clock or Clock()).shown() as shown:
        loop = _Loop(shown)
        try:
            return loop.run_until_complete(work)
        finally:
            for task in (left := asyncio.all_tasks(loop)):
                task.cancel()
            if left:
                loop.run_until_complete(asyncio.wait(left))
            loop.run_until_complete(loop.shutdown_asyncgens())
            loop.close()


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self, clock: Clock) -> None:
        super().__init__(_Selector(clock))

    def run_in_executor(self, executor: Any, function: Any, *arguments: Any) -> Any:  # type: ignore[override]
        """Call the function in this thread; a sleep takes its time, everything else `_WORK_S`."""
        is_sleep = function in (time.sleep, _sleep)
        result: asyncio.Future[Any] = self.create_future()

        def work() -> None:
            if result.done():
                return
            try:
                result.set_result(None if is_sleep else function(*arguments))
            except Exception as error:
                result.set_exception(error)

        self.call_later(arguments[0] if is_sleep else _WORK_S, work)
        return result


class _Selector(selectors.DefaultSelector):
    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> Any:
        """Return what is ready; if nothing is, let the time until the next timer pass."""
        ready = super().select(0)
        if not ready and timeout is None:
            return super().select(None)  # only another thread can go on
        if not ready and timeout:
            self._clock.advance(timeout)
        return ready
