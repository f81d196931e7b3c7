"""The ordinary thread beside the cycle: the way to OP, the slave watcher's turns, emergencies, SDO errands.

It shares a few plain attributes with the cycle (one writer each) and never holds the interpreter while it waits.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from rtcp.fieldbus.alstatus import AlState
from rtcp.fieldbus.bus import BusError, SlaveState, WatchedBus
from rtcp.fieldbus.watcher import Watcher
from rtcp.realtime.scheduling import thread_beside
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.errands import Errands

_TELL_S = 0.1
"""Slave states and counters go to the blackboard, and emergencies are looked for, so often."""
_LOCK_S = 15.0
_SAY_AGAIN_S = 10.0
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
        watch_s: how long it rests between two turns.
    """

    def __init__(
        self,
        bus: WatchedBus,
        blackboard: Blackboard,
        drive_positions: Sequence[int],
        joint_names: Sequence[str],
        op_timeout_s: float,
        cycle_cpu: int,
        cycle_priority: int,
        watch_s: float = 0.01,
    ) -> None:
        super().__init__(name="service", daemon=True)
        self._bus = bus
        self._blackboard = blackboard
        self._errands = Errands(bus, blackboard)
        self._watcher: Watcher | None = None
        self._drive_positions = drive_positions
        self._joint_names = joint_names
        self._op_timeout_s = op_timeout_s
        self._cycle_cpu = cycle_cpu
        self._cycle_priority = cycle_priority
        self._watch_s = watch_s
        self._tell_turns = max(round(_TELL_S / watch_s), 1)
        self._op_wanted = False
        self._recovery_wanted = False
        self._park_wanted = False
        self._parked = False
        self._explain = -1
        self._complaint: tuple[str, ...] = ()
        self._complained_at = 0.0
        self._end = threading.Event()
        self.all_op = False
        """Whether every slave is in OP, and was since the start or the last `recover`; read by the cycle."""
        self.lost_slave = 0
        """Position of a slave that has left OP; 0: none. It stays until `recover`, however soon the slave is back."""
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
        while not self._end.wait(self._watch_s):
            turn += 1
            # Each part by itself: what one of them meets keeps none of the others from its turn.
            for part in (self._watch, self._run_errands, self._listen):
                try:
                    part(turn)
                except BusError as error:
                    self._complain(error)
        self._tell_states(self._bus.read_states())

    def _complain(self, error: BusError) -> None:
        """Say what failed; what fails again in every turn, as where the interface is gone, is said now and then."""
        now = time.monotonic()
        if error.sentences != self._complaint or now - self._complained_at > _SAY_AGAIN_S:
            self._complaint, self._complained_at = error.sentences, now
            for sentence in error.sentences:
                self._blackboard.text(sentence)

    def _watch(self, turn: int) -> None:
        watcher = self._watcher
        if watcher is None:
            if not self.refused:
                self._start(turn)
            return
        if self._park_wanted:
            self._park_wanted = False
            self._parked = True
            self.all_op = False
            watcher.park()
        if self._recovery_wanted:
            self._recovery_wanted = False
            self._parked = False
            self.lost_slave = 0
            watcher.resume()
        was_well = watcher.all_op
        left = watcher.turn()
        if left and self.all_op:
            self.lost_slave = left
            self.all_op = False
        elif watcher.all_op and not (self.lost_slave or self._parked or self._recovery_wanted or self._park_wanted):
            self.all_op = True
        if turn % self._tell_turns == 0 or not (was_well and watcher.all_op):
            self._tell_health(watcher)

    def _start(self, turn: int) -> None:
        if self._op_wanted:
            self._bus.request_state(AlState.OP)
            self.refused = self._bus.wait_for_state(AlState.OP, self._op_timeout_s)
            self._tell_states(self._bus.read_states())
            if not self.refused:
                self._watcher = self._bus.watcher(self._blackboard.text)
                self.all_op = True
                self.on_op()
        elif turn * self._watch_s > _LOCK_S:
            self.refused = (
                f"the cycle did not lock onto the reference clock within {_LOCK_S:g} s: the frames come too unevenly "
                "or do not come back (see `rtcp status`, bus.send_phase)",
            )
        elif turn % self._tell_turns == 0:
            self._tell_states(self._bus.read_states())
        if self.refused:
            self.on_refused()

    def _run_errands(self, turn: int) -> None:
        if self._explain >= 0:
            axis, self._explain = self._explain, -1
            self._errands.explain(self._joint_names[axis], self._drive_positions[axis])
        self._errands.take_steps()

    def _listen(self, turn: int) -> None:
        if turn % self._tell_turns == 0 and not (self._watcher is not None and self._watcher.silent):
            for emergency in self._bus.emergencies():
                self._blackboard.text(emergency.sentence())

    def _tell_states(self, states: Sequence[SlaveState]) -> None:
        for slave in states:
            self._blackboard.slave(slave.position, slave.state | (_ERROR_BIT if slave.error else 0), slave.code)

    def _tell_health(self, watcher: Watcher) -> None:
        for slave, errors in zip(watcher.slaves, watcher.errors.of, strict=True):
            self._blackboard.slave(slave.position, slave.state | (_ERROR_BIT if slave.error else 0), slave.code)
            self._blackboard.health(
                slave.position, slave.lost, slave.recovered, errors.rx, errors.forwarded, errors.links
            )
