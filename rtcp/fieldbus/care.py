"""What is done with the slaves that are not in OP: one small step a turn, patience and pauses by instants."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rtcp.fieldbus.alstatus import ERROR_BIT, AlState, refusal
from rtcp.fieldbus.bus import BusError
from rtcp.fieldbus.charges import LONG_AGO, SAY_AGAIN_S, Action, Charge, action_for
from rtcp.fieldbus.registers import Command, RegisterPort
from rtcp.fieldbus.restore import STATION, ForeignSlave, Restorer
from rtcp.fieldbus.states import AL_CONTROL

_REQUESTS = {
    Action.REQUEST_OP: AlState.OP,
    Action.REQUEST_SAFEOP: AlState.SAFEOP,
    Action.REQUEST_PREOP: AlState.PREOP,
}
_TRIES = 3
"""So often a slave may refuse before it is set up again."""
_PAUSE_S, _LONGEST_PAUSE_S, _FOREIGN_PAUSE_S = 1.0, 5.0, 10.0
_PATIENCE_S = 3.0
_WELL_S = 1.0
"""A slave that leaves OP sooner than this after it got there has not been well in between."""
_PROBE_S = 0.05
_POLL_S = 0.0003
_STEPS_S = 0.003
"""So long restorations may go on in a turn; where a slave answers at once, several steps fit."""


class Care:
    """Does with each slave what the table says.

    Args:
        port: the port for registers.
        slaves: the slaves in the order of the cable.
        restorer: sets up a slave again.
        say: takes the sentences.
    """

    def __init__(
        self, port: RegisterPort, slaves: Sequence[Charge], restorer: Restorer, say: Callable[[str], None]
    ) -> None:  # fmt: skip
        self._port = port
        self._slaves = slaves
        self._restorer = restorer
        self._say = say
        self._reached = len(slaves)
        self._op_allowed = True

    def take_steps(self, now: float, reached: int, op_allowed: bool) -> None:
        """Take a step with every slave that is not well.

        Args:
            now: the instant (time.monotonic).
            reached: so many slaves answer on the cable.
            op_allowed: whether OP may be asked for; otherwise slaves wait in SAFE-OP.
        """
        self._reached = reached
        self._op_allowed = op_allowed
        until = now + _STEPS_S
        for charge in self._slaves:
            if not charge.well:
                if charge.work is None:
                    self._act(charge, now)
                if charge.work is not None:
                    self._go_on(charge, until)

    def _act(self, charge: Charge, now: float) -> None:
        state, error = charge.state, charge.error
        if charge.asked is not None:
            action, state_then, error_then, until = charge.asked
            same = (state, error) == (state_then, error_then)
            if same and now < until:
                return
            charge.asked = None
            if same or (action in _REQUESTS and error):
                self._fail(charge, now, _REQUESTS.get(action, state))
                return
        if now < charge.pause_until:
            return
        action = action_for(state, error)
        if charge.kept and state is AlState.PREOP and not error:
            action = Action.REQUEST_SAFEOP
        if (charge.failed >= _TRIES or charge.unfinished) and action is not Action.MARK_LOST:
            action = Action.RECONFIGURE
        if charge.leaving and state is AlState.OP:
            action = Action.REQUEST_PREOP
        if action is Action.REQUEST_OP and not self._op_allowed:
            return
        if action is Action.MARK_LOST:
            self._probe(charge, now)
        elif action is Action.RECONFIGURE:
            self._begin(charge, lost_address=False)
        elif action is Action.ACKNOWLEDGE:
            charge.asked = action, state, error, now + _PAUSE_S
            self.request(charge, state, acknowledge=True)
        else:
            charge.asked = action, state, error, now + _PATIENCE_S
            self.request(charge, _REQUESTS[action], acknowledge=error)

    def request(self, charge: Charge, state: AlState, *, acknowledge: bool = False) -> bool:
        """Request `state` of a slave; return False where it has surely not heard. What comes of it shows later."""
        word = state | (ERROR_BIT if acknowledge else 0)
        data = word.to_bytes(2, "little")
        return self._port.exchange(Command.FPWR, charge.station, AL_CONTROL, data, tries=1).wkc != 0

    def note_fall(self, charge: Charge, now: float) -> None:
        """Note that a slave left OP; one that does so again and again is brought back after pauses, and set up."""
        if now - charge.back_at < _WELL_S:
            charge.flaps += 1
            charge.pause_until = now + min(_PAUSE_S * charge.flaps, _LONGEST_PAUSE_S)
        else:
            charge.flaps = 0
            charge.told_at = LONG_AGO
        charge.failed = charge.flaps

    def _fail(self, charge: Charge, now: float, wanted: AlState) -> None:
        charge.failed += 1
        charge.kept = False
        charge.pause_until = now + _PAUSE_S
        found = charge.state | (ERROR_BIT if charge.error else 0)
        self.tell(charge, refusal(charge.label, wanted, found, charge.code) + "; it is asked again every second")

    def _probe(self, charge: Charge, now: float) -> None:
        """Look whether a slave that lost its address has come back to its place."""
        charge.asked = None
        charge.kept = False
        if self._reached < charge.position or now < charge.probe_at:
            return
        charge.probe_at = now + _PROBE_S
        place = 1 - charge.position & 0xFFFF
        data, wkc = self._port.exchange(Command.APRD, place, STATION, bytes(2), tries=1)
        if wkc != 1:
            return
        station = int.from_bytes(data, "little")
        other = next((one for one in self._slaves if one.station == station), None)
        if other is None:
            self._begin(charge, lost_address=True)
        elif other is not charge:
            charge.pause_until = now + _PAUSE_S
            self.tell(charge, f"{charge.label}: at its place answers {other.label}: put the cables back in their order")

    def _begin(self, charge: Charge, *, lost_address: bool) -> None:
        charge.asked = None
        charge.kept = False
        charge.unfinished = True
        what = "it was without supply" if lost_address else f"it is in {charge.words()}"
        if charge.failed == 0 and charge.flaps == 0:
            self._say(f"{charge.label} is set up again: {what}")
        charge.work = self._restorer.restore(charge.position, lost_address)

    def _go_on(self, charge: Charge, until: float) -> None:
        work = charge.work
        assert work is not None
        try:
            next(work)
            while time.monotonic() < until:
                time.sleep(_POLL_S)
                next(work)
        except StopIteration:
            charge.work = None
            charge.unfinished = False
            charge.failed = 0
        except BusError as error:
            charge.work = None
            charge.failed += 1
            pause = min(_PAUSE_S * charge.failed, _LONGEST_PAUSE_S)
            charge.pause_until = time.monotonic() + (_FOREIGN_PAUSE_S if isinstance(error, ForeignSlave) else pause)
            self.tell(charge, "; ".join(error.sentences))

    def drop(self, charge: Charge) -> None:
        """Give up what is under way with a slave."""
        charge.asked = None
        if charge.work is not None:
            charge.work.close()
            charge.work = None

    def tell(self, charge: Charge, sentence: str) -> None:
        """Say something of a slave, at most every 10 s."""
        now = time.monotonic()
        if now - charge.told_at >= SAY_AGAIN_S:
            charge.told_at = now
            self._say(sentence)
