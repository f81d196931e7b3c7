"""The loop's part of a blackboard, played: it takes every command, and is at once where a motion leads."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import MotionMode
from rtcp.ipc.layout import PER_JOINT, PLAN_COLUMNS, SCALARS, SERVICE_LENGTH_AT, SERVICE_STATE_AT, SERVICE_TEXT_AT
from rtcp.ipc.machine import Command, State

JOINTS = 6
_FIELDS = len(SCALARS) - 1 + len(PER_JOINT) * JOINTS
_SCALAR_AT = {name: at for at, (name, _) in enumerate(SCALARS[1:])}
_JOINTS_AT = {name: len(SCALARS) - 1 + at * JOINTS for at, (name, _) in enumerate(PER_JOINT)}
_MOVES_FOR = 40
"""A motion that ends by itself lasts so many turns of about a millisecond."""
_FOR_EVER = 1_000_000_000
_ENDS = frozenset({Command.MOVE, Command.LINE, Command.TRAJECTORY})
_LASTS = frozenset({Command.JOG, Command.VELOCITY, Command.TORQUE, Command.STREAM})
"""What goes on until the lease under which it was given ends."""


class Loop:
    """Publishes a record a millisecond, answers commands and requests for the service thread.

    What came: `commands` (number, then the twelve numbers), `plans`, `requests`. What a test may set: `state`,
    `motion`, `q`; by command `refusals`, `ends` (where it leads) and `tells` (events that it leads to at once);
    `event_at_the_end` of a motion that ends by itself, and `ends_in`, the state then.
    """

    def __init__(self, path: Path, q: Sequence[float] = (0.0,) * JOINTS, state: State = State.READY) -> None:
        self.board = Blackboard(path, JOINTS, 500_000)
        self.commands: list[tuple[float, ...]] = []
        self.plans: list[list[list[float]]] = []
        self.requests: list[dict[str, Any]] = []
        self._lease = 0
        self._left = 0
        self._ended = threading.Event()
        self._set_up(q, state)
        self._publish()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _set_up(self, q: Sequence[float], state: State) -> None:
        self.refusals: dict[Command, tuple[float, ...]] = {}
        self.ends: dict[Command, Sequence[float]] = {}
        self.tells: dict[Command, Sequence[tuple[float, ...]]] = {}
        self.event_at_the_end: tuple[float, ...] = ()
        self.ends_in = State.HOLDING
        self._left = 0
        self.motion = MotionMode.JOINT
        self.state = state
        self.q = list(q)

    def clear(self) -> None:
        """Forget what came and what was set."""
        for came in (self.commands, self.plans, self.requests):
            came.clear()
        self._set_up((0.0,) * JOINTS, State.READY)

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.board.close()

    def taken(self, command: Command) -> list[tuple[float, ...]]:
        """Return the numbers of all commands of a kind."""
        return [tuple(numbers) for kind, *numbers in self.commands if kind == command]

    @property
    def written(self) -> list[tuple[int, int, str]]:
        """The objects that were written: index, subindex, bytes in hexadecimal."""
        return [(one["index"], one["subindex"], one["hex"]) for one in self.requests if one["do"] == "sdo_write"]

    def _run(self) -> None:
        while not self._ended.wait(0.001):
            if self.board.command_waits():
                self._take()
            self._serve()
            self._go_on()
            self._publish()

    def _go_on(self) -> None:
        if not self._left:
            return
        self._left -= 1
        held, renewed, duration = self.board.lease()
        if held != self._lease or time.monotonic_ns() - renewed > duration:
            self._left = 0
            self.state = State.HOLDING
        elif self._left == 0:
            if self.event_at_the_end:
                self.board.event(*self.event_at_the_end)  # type: ignore[arg-type]
            self.state = self.ends_in

    def _publish(self) -> None:
        record: list[float] = [0] * _FIELDS
        record[_SCALAR_AT["time_ns"]] = time.monotonic_ns()
        record[_SCALAR_AT["state"]] = self.state
        record[_SCALAR_AT["motion"]] = self.motion
        for name in ("position", "target"):
            record[_JOINTS_AT[name] : _JOINTS_AT[name] + JOINTS] = self.q
        self.board.publish(record)

    def _take(self) -> None:
        number, lease, kind, *numbers = self.board.take_command()
        command = Command(int(kind))
        self.commands.append((int(kind), *numbers))
        if command in (Command.LINE, Command.TRAJECTORY, Command.LIMITS):
            rows = list(self.board.plan(int(numbers[0])))
            self.plans.append([rows[at * PLAN_COLUMNS : (at + 1) * PLAN_COLUMNS] for at in range(int(numbers[1]))])
        refusal = self.refusals.get(command, ())
        if not refusal:
            self._carry_out(command, int(lease), numbers)
        self.board.answer(int(number), *refusal)  # type: ignore[arg-type]

    def _carry_out(self, command: Command, lease: int, numbers: Sequence[float]) -> None:
        for event in self.tells.get(command, ()):
            self.board.event(*event)  # type: ignore[arg-type]
        if command not in _ENDS | _LASTS:
            return
        leads = {Command.MOVE: numbers[:JOINTS]}
        if command is Command.TRAJECTORY:
            leads[command] = self.plans[-1][-1][1 : 1 + JOINTS]
        self.q = list(self.ends.get(command, leads.get(command, self.q)))
        self.state, self._lease = State.MOVING, lease
        self._left = _MOVES_FOR if command in _ENDS else _FOR_EVER

    def _serve(self) -> None:
        words, memory = self.board.words, self.board.memory
        if words[SERVICE_STATE_AT] != 1:
            return
        self.requests.append(json.loads(bytes(memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + words[SERVICE_LENGTH_AT]])))
        answer = b'{"hex": "2a"}'
        memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + len(answer)] = answer
        words[SERVICE_LENGTH_AT] = len(answer)
        words[SERVICE_STATE_AT] = 2
