"""A loop that is played: it takes commands from a real blackboard, and is where a motion leads after a few cycles."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.runtime.arguments import Arguments
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.carrier import CommandFailed
from rtcp.runtime.codes import MotionMode, Refusal
from rtcp.runtime.held import Caller
from rtcp.runtime.layout import (
    PER_JOINT,
    PLAN_COLUMNS,
    SCALARS,
    SERVICE_LENGTH_AT,
    SERVICE_STATE_AT,
    SERVICE_TEXT_AT,
)
from rtcp.runtime.machine import Command, State
from rtcp.runtime.observer import Observer
from rtcp.runtime.picture import Picture
from rtcp.runtime.session import Session
from rtcp.runtime.verbs import Verbs

T = TypeVar("T")
JOINTS = 6
_FIELDS = [name for name, _ in SCALARS[1:]]
_AWAY_CYCLES = 10
BEGINS_MOTION = (
    Command.MOVE, Command.LINE, Command.TRAJECTORY, Command.JOG, Command.VELOCITY, Command.TORQUE, Command.STREAM,
)  # fmt: skip


class PlayedLoop:
    """Publishes a record a millisecond; `commands` are those that it took: number, then the twelve numbers."""

    def __init__(self, path: Path, q: Sequence[float]) -> None:
        self.board = Blackboard(path, JOINTS, 500_000)
        self.commands: list[tuple[float, ...]] = []
        self.plans: list[list[list[float]]] = []
        self.written: list[tuple[int, int, str]] = []
        self.refusals: dict[Command, tuple[Refusal, int, float, float]] = {}
        self.ends: dict[Command, Sequence[float]] = {}
        self.state = State.HOLDING
        self.motion = MotionMode.JOINT
        self.q = list(q)
        self._lease = 0
        self._cycles_left = 0
        self._ended = threading.Event()
        self._publish()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.board.close()

    def _publish(self) -> None:
        record: list[float] = [0] * (len(_FIELDS) + len(PER_JOINT) * JOINTS)
        record[_FIELDS.index("state")] = self.state
        record[_FIELDS.index("motion")] = self.motion
        for at, (name, _) in enumerate(PER_JOINT):
            if name in ("position", "target"):
                record[len(_FIELDS) + at * JOINTS : len(_FIELDS) + (at + 1) * JOINTS] = self.q
        self.board.publish(record)

    def _run(self) -> None:
        while not self._ended.wait(0.001):
            if self.board.command_waits():
                self._take()
            self._serve()
            held, renewed, duration = self.board.lease()
            if self.state is State.MOVING:
                self._cycles_left -= 1
                if self._cycles_left <= 0 or held != self._lease or time.monotonic_ns() - renewed > duration:
                    self.state = State.HOLDING
            self._publish()

    def _take(self) -> None:
        number, lease, kind, *numbers = self.board.take_command()
        command = Command(int(kind))
        refusal = self.refusals.get(command)
        self.commands.append((int(kind), *numbers))
        if command in (Command.LINE, Command.TRAJECTORY, Command.LIMITS):
            plan = self.board.plan(int(numbers[0]))
            self.plans.append([
                list(plan[row * PLAN_COLUMNS : (row + 1) * PLAN_COLUMNS]) for row in range(int(numbers[1]))
            ])  # fmt: skip
        if refusal is None and command in BEGINS_MOTION:
            self.state, self._lease = State.MOVING, int(lease)
            ends = command in (Command.MOVE, Command.LINE, Command.TRAJECTORY)
            self._cycles_left = _AWAY_CYCLES if ends else 1_000_000
            self.q = list(numbers[:JOINTS]) if command is Command.MOVE else list(self.ends.get(command, self.q))
        self.board.answer(int(number), *(refusal or ()))

    def _serve(self) -> None:
        words, memory = self.board.words, self.board.memory
        if words[SERVICE_STATE_AT] != 1:
            return
        request = json.loads(bytes(memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + words[SERVICE_LENGTH_AT]]))
        if request["do"] == "sdo_write":
            self.written.append((request["index"], request["subindex"], request["hex"]))
        memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + 2] = b"{}"
        words[SERVICE_LENGTH_AT] = 2
        words[SERVICE_STATE_AT] = 2

    def taken(self, command: Command) -> list[tuple[float, ...]]:
        """Return the numbers of all commands of a kind."""
        return [numbers for kind, *rest in self.commands if kind == command for numbers in [tuple(rest)]]


class Played:
    """The gateway's verbs in front of a played loop."""

    def __init__(self, directory: Path, q: Sequence[float], *, bus: str = "virtual", lease_s: float = 0.5) -> None:
        self.config: ArmConfig = dataclasses.replace(load(default_config()), lease_s=lease_s)
        self.directory = directory
        self.loop = PlayedLoop(directory / "board", q)
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
def played(directory: Path, q: Sequence[float], *, bus: str = "virtual", lease_s: float = 0.5) -> Iterator[Played]:
    """Play a loop meanwhile."""
    made = Played(directory, q, bus=bus, lease_s=lease_s)
    try:
        yield made
    finally:
        made.end()
