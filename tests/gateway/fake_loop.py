"""A fake loop on a blackboard: it accepts every command, and every motion ends at once."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import Command, Halt, MotionCommand, MoveJoints, RunLines, RunTrajectory, SetLimits, SetZero
from rtcp.ipc.events import Arrived, Event, ZeroSet
from rtcp.ipc.layout import PLAN_COLUMNS, SERVICE_LENGTH_AT, SERVICE_STATE_AT, SERVICE_TEXT_AT
from rtcp.ipc.refusals import Malformed, Refusal
from rtcp.ipc.schema import Field, RecordSchema, arm_schema
from rtcp.ipc.states import ControlMode, State
from tests.records import numbers

C = TypeVar("C", bound=Command)
JOINTS = 6
GRIPPER_AT = 0.4
BOX = tuple(Field(f"io_{which}", "uint16", part="io") for which in ("inputs", "outputs"))
_FOR_EVER = 1_000_000_000


class FakeLoop:
    """Publishes a record a turn, answers commands and requests for the service thread.

    What came: `commands`, `plans`, `requests`. What a test may set: `state`, `control_mode`, `q`, `inputs`; by kind
    of command `refusals`, `ends` (where it leads) and `reports` (events that it leads to at once);
    `event_at_the_end` of a motion that ends by itself, `ends_in`, the state then, and `moves_for`, its duration in
    turns.
    """

    def __init__(self, path: Path, q: Sequence[float] = (0.0,) * JOINTS, state: State = State.READY) -> None:
        self.board = Blackboard(path, RecordSchema((*arm_schema(JOINTS).fields, *BOX)), 500_000)
        self.commands: list[Command] = []
        self.plans: list[list[list[float]]] = []
        self.requests: list[dict[str, Any]] = []
        self._lease = 0
        self._set_up(q, state)
        self._publish()

    def _set_up(self, q: Sequence[float], state: State) -> None:
        self.refusals: dict[type[Command], Refusal] = {}
        self.ends: dict[type[Command], Sequence[float]] = {}
        self.reports: dict[type[Command], Sequence[Event]] = {}
        self.objects: dict[int, dict[str, Any]] = {}
        """Answers to SDO reads by index."""
        self.event_at_the_end: Event | None = Arrived()
        self.ends_in = State.HOLDING
        self.moves_for = 40
        self._left = 0
        self.control_mode = ControlMode.JOINT
        self.speed_override = 1.0
        self.state = state
        self.q = list(q)
        self.inputs = self.outputs = 0
        self.fields: dict[str, Any] = {}
        """Further fields of the records."""

    def clear(self) -> None:
        """Reset received commands and settings."""
        for came in (self.commands, self.plans, self.requests):
            came.clear()
        self._set_up((0.0,) * JOINTS, State.READY)
        # A test may have stopped it with a clock that was set ahead.
        self.board._stopped_ns = 0

    def end(self) -> None:
        self.board.close()

    def received(self, kind: type[C]) -> list[C]:
        """Return all commands of a kind."""
        return [command for command in self.commands if isinstance(command, kind)]

    @property
    def kinds(self) -> list[type[Command]]:
        return [type(command) for command in self.commands]

    @property
    def written(self) -> list[tuple[int, int, str]]:
        """The written objects: index, subindex, bytes in hexadecimal."""
        writes = [request for request in self.requests if request["do"] == "sdo_write"]
        return [(write["index"], write["subindex"], write["hex"]) for write in writes]

    def turn(self) -> None:
        """Answer what waits and publish a record; called once a millisecond."""
        if self.board.command_waits():
            self._handle()
        self._serve()
        self._move()
        self._publish()

    def _move(self) -> None:
        if not self._left:
            return
        self._left -= 1
        lease, renewed, duration = self.board.lease()
        if lease != self._lease or time.monotonic_ns() - renewed > duration:
            self._left = 0
            self.state = State.HOLDING
        elif self._left == 0:
            if self.event_at_the_end is not None:
                self.board.event(self.event_at_the_end)
            self.state = self.ends_in

    def _publish(self) -> None:
        record: dict[str, Any] = {"time_ns": time.monotonic_ns(), "state": self.state}
        record |= {"control_mode": self.control_mode, "speed_override": self.speed_override}
        record |= dict.fromkeys(("actual_position", "commanded_position", "sent_position"), self.q)
        record |= {"io_inputs": self.inputs, "io_outputs": self.outputs, **self.fields}
        self.board.publish(numbers(self.board.schema, **record))

    def _handle(self) -> None:
        number, lease, command = self.board.take_command()
        assert not isinstance(command, Malformed)
        self.board.answer(number, command if isinstance(command, Refusal) else self._carry_out(command, lease))

    def _carry_out(self, command: Command, lease: int) -> Refusal | None:
        self.commands.append(command)
        if isinstance(command, RunLines | RunTrajectory | SetLimits):
            rows = list(self.board.plan(command.slot))
            self.plans.append([rows[at * PLAN_COLUMNS : (at + 1) * PLAN_COLUMNS] for at in range(command.rows)])
        refusal = self.refusals.get(type(command))
        if refusal is None:
            if isinstance(command, SetZero):
                stands = self.q[command.axis] if command.axis < len(self.q) else GRIPPER_AT
                self.board.event(ZeroSet(command.axis, command.offset, stands))
            for event in self.reports.get(type(command), ()):
                self.board.event(event)
            if isinstance(command, MotionCommand):
                self._begin(command, lease)
            elif isinstance(command, Halt) and self.state is State.ENABLING:
                self.state = State.READY
        return refusal

    def _begin(self, command: MotionCommand, lease: int) -> None:
        leads: Sequence[float] = self.q
        if isinstance(command, MoveJoints):
            leads = command.q
        elif isinstance(command, RunTrajectory):
            leads = self.plans[-1][-1][1 : 1 + JOINTS]
        self.q = list(self.ends.get(type(command), leads))
        self.state, self._lease = State.MOVING, lease
        self._left = _FOR_EVER if command.renewed else self.moves_for

    def _serve(self) -> None:
        words, memory = self.board.words, self.board.memory
        if words[SERVICE_STATE_AT] != 1:
            return
        self.requests.append(json.loads(bytes(memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + words[SERVICE_LENGTH_AT]])))
        request = self.requests[-1]
        answer = json.dumps(self.objects.get(request.get("index", 0), {"hex": "2a"})).encode()
        memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + len(answer)] = answer
        words[SERVICE_LENGTH_AT] = len(answer)
        words[SERVICE_STATE_AT] = 2


class RunningLoop(FakeLoop):
    """The same in a thread, for a gateway in another process: a turn takes about a millisecond."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        super().end()

    def _run(self) -> None:
        while not self._ended.wait(0.001):
            self.turn()
