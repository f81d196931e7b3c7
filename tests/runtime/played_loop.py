"""The loop's part of a blackboard, played: it takes every command, and arrives at once where a move leads."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.layout import PER_JOINT, PLAN_COLUMNS, SCALARS, SERVICE_LENGTH_AT, SERVICE_STATE_AT, SERVICE_TEXT_AT
from rtcp.runtime.machine import Command, State

JOINTS = 6
FIELDS = len(SCALARS) - 1 + len(PER_JOINT) * JOINTS
SCALAR_AT = {name: at for at, (name, _) in enumerate(SCALARS[1:])}
JOINTS_AT = {name: len(SCALARS) - 1 + at * JOINTS for at, (name, _) in enumerate(PER_JOINT)}
MOVES_FOR = 40
"""A motion lasts so many turns of about a millisecond."""


class Loop:
    """Answers commands (with `refusal` while it is set) and requests for the service thread.

    `commands`, `plans` and `requests` are what came; `event_at_the_end` is told at the end of every motion.
    """

    def __init__(self, path: Path) -> None:
        self.board = Blackboard(path, JOINTS, 500_000)
        self.commands: list[tuple[float, ...]] = []
        self.plans: list[list[list[float]]] = []
        self.requests: list[dict[str, Any]] = []
        self.refusal: tuple[float, ...] = ()
        self.event_at_the_end: tuple[float, ...] = ()
        self.ends_in = State.HOLDING
        self._record: list[float] = [0] * FIELDS
        self._left = 0
        self.state = State.READY
        self._ended = threading.Event()
        self.board.publish(self._record)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def state(self) -> State:
        return State(int(self._record[SCALAR_AT["state"]]))

    @state.setter
    def state(self, state: State) -> None:
        self._record[SCALAR_AT["state"]] = state

    def set_motion(self, motion: int) -> None:
        self._record[SCALAR_AT["motion"]] = motion

    def stand_at(self, q: list[float]) -> None:
        for name in ("position", "target"):
            self._record[JOINTS_AT[name] : JOINTS_AT[name] + JOINTS] = q

    def clear(self) -> None:
        self.commands.clear()
        self.plans.clear()
        self.requests.clear()
        self.refusal, self.event_at_the_end, self.ends_in = (), (), State.HOLDING
        self._left = 0
        self.set_motion(1)
        self.state = State.READY
        self.stand_at([0.0] * JOINTS)

    def _run(self) -> None:
        words, memory = self.board.words, self.board.memory
        while not self._ended.wait(0.001):
            if self.board.command_waits():
                self._take()
            if words[SERVICE_STATE_AT] == 1:
                end = SERVICE_TEXT_AT + words[SERVICE_LENGTH_AT]
                self.requests.append(json.loads(memory[SERVICE_TEXT_AT:end]))
                memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + 13] = b'{"hex": "2a"}'
                words[SERVICE_LENGTH_AT] = 13
                words[SERVICE_STATE_AT] = 2
            if self._left:
                self._left -= 1
                if self._left == 0:
                    if self.event_at_the_end:
                        self.board.event(*self.event_at_the_end)  # type: ignore[arg-type]
                    self.state = self.ends_in
            self._record[SCALAR_AT["time_ns"]] = time.monotonic_ns()
            self.board.publish(self._record)

    def _take(self) -> None:
        number, _, *command = self.board.take_command()
        self.commands.append(tuple(command))
        kind, *numbers = command
        if kind in (Command.LINE, Command.TRAJECTORY, Command.LIMITS):
            rows = self.board.plan(int(numbers[0])).tolist()
            self.plans.append([rows[at * PLAN_COLUMNS : (at + 1) * PLAN_COLUMNS] for at in range(int(numbers[1]))])
        if not self.refusal:
            if kind == Command.MOVE:
                self.stand_at(numbers[:JOINTS])
            if kind == Command.TRAJECTORY:
                self.stand_at(self.plans[-1][-1][1 : 1 + JOINTS])
            if kind in (Command.MOVE, Command.LINE, Command.TRAJECTORY):
                self.state = State.MOVING
                self._left = MOVES_FOR
        self.board.answer(int(number), *self.refusal)  # type: ignore[arg-type]

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.board.close()
