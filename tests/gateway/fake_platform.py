"""The methods of the gateway in front of a fake loop, in this process and in simulated time."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.gateway.command_channel import Caller
from rtcp.gateway.methods import Methods
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import limits_file
from rtcp.ipc.session import Session
from rtcp.ipc.states import ControlMode, State
from tests import simulated_time
from tests.gateway.fake_loop import FakeLoop
from tests.simulated_time import Clock

T = TypeVar("T")


class FakePlatform:
    """All methods of the control socket in front of a fake loop."""

    def __init__(
        self,
        directory: Path,
        q: Sequence[float],
        *,
        bus: str = "virtual",
        lease_s: float = 0.5,
        config: ArmConfig | None = None,
    ) -> None:
        self.config = dataclasses.replace(config or load(default_config()), lease_s=lease_s)
        self.directory = directory
        self.clock = Clock()
        self.loop = FakeLoop(directory / "board", q, State.HOLDING)
        self.observer = Observer(directory / "board")
        self.session = Session(self.config, bus, "ecat0", 0, time.monotonic_ns())
        self.snapshot = StatusSnapshot(self.observer, self.session, {})
        self.methods: Methods

    def reset(self, q: Sequence[float]) -> None:
        """Hold at `q`, with nothing received."""
        self.loop.clear()
        self.loop.q = list(q)
        limits_file(self.directory).unlink(missing_ok=True)
        self.show(state=State.HOLDING)

    def show(self, *, control_mode: ControlMode | None = None, state: State | None = None) -> None:
        """Set mode or state of the loop and of its latest record."""
        self.loop.control_mode = self.loop.control_mode if control_mode is None else control_mode
        self.loop.state = self.loop.state if state is None else state
        self.loop.turn()
        self.snapshot.follow()

    async def call(self, method: str, params: dict[str, Any], client: str = "one", connection: int = 1) -> Any:
        """Call a method as a client's request does."""
        return await self.methods.call(method, Caller(client, connection), params)

    def ask(self, method: str, **params: Any) -> Any:
        """Call a method in an event loop of its own."""
        return self.run(lambda: self.call(method, params))

    def error(self, method: str, **params: Any) -> RtcpError:
        """Call a method; return its error."""
        try:
            answer = self.ask(method, **params)
        except RtcpError as error:
            return error
        raise AssertionError(f"{method} did not fail: {answer}")

    def run(self, work: Callable[[], Awaitable[T]]) -> T:
        """Run a coroutine while the loop publishes and the gateway's tasks read the blackboard."""

        async def end_platform() -> list[str]:
            return []

        async def whole() -> T:
            # Locks and events belong to one event loop.
            self.methods = Methods(self.observer, self.snapshot, self.session, self.directory, end_platform)
            following = [asyncio.create_task(self._follow()), asyncio.create_task(self.methods.channel.follow())]
            try:
                return await work()
            finally:
                for connection in (1, 2) if self.observer.holder() else ():
                    await self.methods.end_connection(connection)
                for task in following:
                    task.cancel()

        return simulated_time.run(whole(), self.clock)

    async def _follow(self) -> None:
        while True:
            for _ in range(5):
                self.loop.turn()
                await asyncio.sleep(0.001)
            self.snapshot.follow()

    def end(self) -> None:
        self.observer.close()
        self.loop.end()


@contextlib.contextmanager
def fake_platform(directory: Path, q: Sequence[float], **options: Any) -> Iterator[FakePlatform]:
    """Run a fake platform meanwhile; options as of `FakePlatform`."""
    made = FakePlatform(directory, q, **options)
    try:
        yield made
    finally:
        made.end()
