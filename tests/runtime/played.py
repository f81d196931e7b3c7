"""The gateway's verbs, in this process, in front of a played loop."""

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
from rtcp.gateway.arguments import Arguments
from rtcp.gateway.carrier import CommandFailed
from rtcp.gateway.held import Caller
from rtcp.gateway.picture import Picture
from rtcp.gateway.verbs import Verbs
from rtcp.ipc.codes import MotionMode
from rtcp.ipc.machine import State
from rtcp.ipc.observer import Observer
from rtcp.ipc.session import Session
from tests.runtime.played_loop import Loop

T = TypeVar("T")


class Played:
    """The gateway's verbs in front of a played loop."""

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
        self.loop = Loop(directory / "board", q, State.HOLDING)
        self.observer = Observer(directory / "board")
        session = Session(self.config, bus, "ecat0", 0, time.monotonic_ns())
        self.picture = Picture(self.observer, session, {})
        self.verbs = Verbs(self.observer, self.picture, self.config, bus, directory)

    def show(self, *, motion: MotionMode | None = None, state: State | None = None) -> None:
        """Let the loop be in another mode or state, and return when its records say so."""
        self.loop.motion = self.loop.motion if motion is None else motion
        self.loop.state = self.loop.state if state is None else state
        seen = self.observer.head
        while self.observer.head < seen + 2:
            time.sleep(0.001)

    async def call(self, verb: str, args: dict[str, Any], client: str = "one", connection: int = 1) -> dict[str, Any]:
        """Ask as a client's request does."""

        async def tell(progress: dict[str, Any]) -> None:
            pass

        return await self.verbs.table[verb](Caller(client, connection), Arguments(args), tell)

    def ask(self, verb: str, **args: Any) -> dict[str, Any]:
        """Ask, in an event loop of its own."""
        return self.run(lambda: self.call(verb, args))

    def refused(self, verb: str, **args: Any) -> CommandFailed:
        """Ask and return the refusal."""
        try:
            answer = self.ask(verb, **args)
        except CommandFailed as failed:
            return failed
        raise AssertionError(f"{verb} was not refused: {answer}")

    def run(self, work: Callable[[], Awaitable[T]]) -> T:
        """Do something in an event loop, while the picture is followed as the gateway does."""

        async def whole() -> T:
            following = asyncio.create_task(self._follow())
            try:
                return await work()
            finally:
                following.cancel()

        return asyncio.run(whole())

    async def _follow(self) -> None:
        while True:
            self.picture.follow()
            await asyncio.sleep(0.005)

    def end(self) -> None:
        self.observer.close()
        self.loop.end()


@contextlib.contextmanager
def played(directory: Path, q: Sequence[float], **options: Any) -> Iterator[Played]:
    """Play a loop meanwhile; options as of `Played`."""
    made = Played(directory, q, **options)
    try:
        yield made
    finally:
        made.end()
