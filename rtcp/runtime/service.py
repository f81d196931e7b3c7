"""The ordinary thread beside the cycle: the way to OP and back to it, slave states, emergencies, SDO access.

It shares a few plain attributes with the cycle (one writer each) and never holds the interpreter while it waits.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from typing import Any

from rtcp.fieldbus.alstatus import AlState
from rtcp.fieldbus.bus import Bus, BusError, SlaveState
from rtcp.realtime.scheduling import thread_beside
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.layout import SERVICE_LENGTH_AT, SERVICE_STATE_AT, SERVICE_TEXT_AT, SERVICE_TEXT_SIZE

_TURN_S = 0.01
_WATCH_TURNS = 10
"""Slave states are read every 100 ms: a slave that is lost shows in the working counter of its cycle, and each turn
that holds the interpreter is one for which the cycle may have to wait."""
_RECOVER_S = 2.0
_LOCK_S = 15.0
_ERROR_CODE = 0x603F
_ERROR_BIT = 0x10


def _nothing() -> None:
    pass


class Service(threading.Thread):
    """Watches the slaves and does for the cycle what takes time.

    Args:
        bus: the configured bus.
        blackboard: where slave states and sentences go and requests come from.
        drive_positions: position on the cable of each joint's drive.
        joint_names: their names.
        op_timeout_s: how long the slaves may take from SAFE-OP to OP.
        cycle_cpu: CPU of the cycle, which this thread keeps off.
        cycle_priority: the cycle's; this thread's is one below, so that nobody else's work holds it up in mid-turn.
    """

    def __init__(
        self,
        bus: Bus,
        blackboard: Blackboard,
        drive_positions: Sequence[int],
        joint_names: Sequence[str],
        op_timeout_s: float,
        cycle_cpu: int,
        cycle_priority: int,
    ) -> None:
        super().__init__(name="service", daemon=True)
        self._bus = bus
        self._blackboard = blackboard
        self._drive_positions = drive_positions
        self._joint_names = joint_names
        self._op_timeout_s = op_timeout_s
        self._cycle_cpu = cycle_cpu
        self._cycle_priority = cycle_priority
        self._op_wanted = False
        self._op_reached = False
        self._recovery_wanted = False
        self._park_wanted = False
        self._parked = False
        self._explain = -1
        self._end = threading.Event()
        self.all_op = False
        """Whether every slave was in OP when last looked at; written here, read by the cycle."""
        self.lost_slave = 0
        """Position of a slave that has left OP; 0: none."""
        self.refused: tuple[str, ...] = ()
        """Why OP was not reached at the start; the cycle then ends."""
        self.on_op: Callable[[], None] = _nothing
        """Called once, from this thread, when all slaves are in OP for the first time."""
        self.on_refused: Callable[[], None] = _nothing
        """Called once, from this thread, when the start has failed or the thread cannot go on."""

    # -- what the cycle asks: a plain store each ----------------------------------------------------------------

    def want_op(self) -> None:
        """Ask for OP; may be said every cycle."""
        self._op_wanted = True

    def recover(self) -> None:
        """Ask for the slaves that left OP to be brought back."""
        self.all_op = False
        self._recovery_wanted = True

    def park(self) -> None:
        """Ask for all slaves to be taken to PRE-OP, as an emergency stop ends; `recover` brings them back."""
        self.all_op = False
        self._park_wanted = True

    def explain_drive(self, axis: int) -> None:
        """Ask for the drive's error code to be read and put into words."""
        self._explain = axis

    def finish(self) -> None:
        """End the thread and wait for it."""
        self._end.set()
        if self.is_alive():
            self.join(timeout=3.0)

    # -- the thread ---------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Take turns until `finish`. A defect in here ends the loop: nobody would watch the slaves."""
        try:
            self._take_turns()
        except Exception as error:
            sentence = f"the service thread met a defect ({type(error).__name__}: {error}): the loop ends"
            self._blackboard.text(sentence)
            self.refused = (sentence,)
            self.on_refused()
            raise

    def _take_turns(self) -> None:
        thread_beside(self._cycle_cpu, self._cycle_priority - 1)
        turn = 0
        while not self._end.wait(_TURN_S):
            turn += 1
            try:
                self._turn(turn)
            except BusError as error:
                for sentence in error.sentences:
                    self._blackboard.text(sentence)
        self._tell_states(self._bus.read_states())

    def _turn(self, turn: int) -> None:
        if not self._op_reached and not self.refused:
            self._start(turn)
        if self._park_wanted:
            self._park_wanted = False
            self._park()
        if self._recovery_wanted:
            self._recovery_wanted = False
            self._recover()
        if self._explain >= 0:
            axis, self._explain = self._explain, -1
            self._say_error(axis)
        self._answer_request()
        if turn % _WATCH_TURNS == 0:
            self._watch()
            for emergency in self._bus.emergencies():
                self._blackboard.text(emergency.sentence())

    def _start(self, turn: int) -> None:
        if self._op_wanted:
            self._bus.request_state(AlState.OP)
            self.refused = self._bus.wait_for_state(AlState.OP, self._op_timeout_s)
            self._tell_states(self._bus.read_states())
            self._op_reached = not self.refused
        elif turn * _TURN_S > _LOCK_S:
            self.refused = (
                f"the cycle did not lock onto the reference clock within {_LOCK_S:g} s: the frames come too unevenly "
                "or do not come back (see `rtcp status`, bus.send_phase)",
            )
        if self._op_reached:
            self.all_op = True
            self.on_op()
        elif self.refused:
            self.on_refused()

    def _watch(self) -> None:
        states = self._bus.read_states()
        self._tell_states(states)
        if not self.all_op or all(slave.state is AlState.NONE for slave in states):
            # Where nobody answers it is the wire or the first slave: the cycle counts the lost frames and says so.
            return
        for slave in states:
            if slave.state is not AlState.OP:
                self._blackboard.text(f"slave {slave.position} ({slave.name}) left OP: it is in {slave.words()}")
                self.all_op = False
                self.lost_slave = slave.position

    def _tell_states(self, states: Sequence[SlaveState]) -> None:
        for slave in states:
            self._blackboard.slave(slave.position, slave.state | (_ERROR_BIT if slave.error else 0), slave.code)

    def _park(self) -> None:
        self._parked = True
        self._bus.request_state(AlState.PREOP)
        for sentence in self._bus.wait_for_state(AlState.PREOP, _RECOVER_S):
            self._blackboard.text(sentence)
        self._tell_states(self._bus.read_states())

    def _recover(self) -> None:
        if self._parked:
            # They have kept their set-up: PRE-OP, in which they were put, loses none of it.
            self._parked = False
            waiting = [slave.position for slave in self._bus.read_states() if slave.state is AlState.PREOP]
            self._bus.request_state(AlState.SAFEOP, waiting)
            self._bus.wait_for_state(AlState.SAFEOP, _RECOVER_S, waiting)
        states = self._bus.read_states()
        fallen = [slave for slave in states if slave.state is not AlState.OP or slave.error]
        hopeless = [slave for slave in fallen if slave.state is not AlState.SAFEOP and slave.state is not AlState.OP]
        for slave in hopeless:
            self._blackboard.text(
                f"slave {slave.position} ({slave.name}) is in {slave.words()} and has lost its set-up: "
                "`rtcp stop`, then `rtcp start`"
            )
        if hopeless:
            return
        for slave in fallen:
            self._bus.acknowledge(slave.position)
        positions = [slave.position for slave in fallen]
        if positions:
            self._bus.request_state(AlState.OP, positions)
        refused = self._bus.wait_for_state(AlState.OP, _RECOVER_S)
        for sentence in refused:
            self._blackboard.text(sentence)
        self._tell_states(self._bus.read_states())
        if not refused:
            self.lost_slave = 0
            self.all_op = True

    def _say_error(self, axis: int) -> None:
        name, position = self._joint_names[axis], self._drive_positions[axis]
        code = int.from_bytes(self._bus.sdo_read(position, _ERROR_CODE, 0), "little")
        if code:
            self._blackboard.text(f"{name} (slave {position}): the drive's error code is 0x{code:04X}")

    def _answer_request(self) -> None:
        memory, words = self._blackboard.memory, self._blackboard.words
        if words[SERVICE_STATE_AT] != 1:
            return
        length = words[SERVICE_LENGTH_AT]
        try:
            answer = self._serve(json.loads(bytes(memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + length])))
        except BusError as error:
            answer = {"error": "; ".join(error.sentences)}
        except Exception as error:
            # Whatever is wrong with a request, it must not end the thread that watches the slaves.
            answer = {"error": f"the request is not of the service's form: {type(error).__name__} {error}"}
        text = json.dumps(answer).encode()
        if len(text) > SERVICE_TEXT_SIZE:
            text = json.dumps({"error": f"the answer is {len(text)} bytes long, {SERVICE_TEXT_SIZE} fit"}).encode()
        memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + len(text)] = text
        words[SERVICE_LENGTH_AT] = len(text)
        words.fence()
        words[SERVICE_STATE_AT] = 2

    def _serve(self, request: dict[str, Any]) -> dict[str, Any]:
        position, index, subindex = int(request["slave"]), int(request["index"]), int(request["subindex"])
        if not (0 <= index <= 0xFFFF and 0 <= subindex <= 0xFF):
            raise BusError(f"object {index}:{subindex} does not exist: index 0 to 65535, subindex 0 to 255")
        if request["do"] == "sdo_read":
            return {"hex": self._bus.sdo_read(position, index, subindex).hex()}
        if request["do"] == "sdo_write":
            self._bus.sdo_write(position, index, subindex, bytes.fromhex(request["hex"]))
            return {}
        raise ValueError(f"{request['do']!r} is neither sdo_read nor sdo_write")
