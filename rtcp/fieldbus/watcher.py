"""The slave watcher: looks at all slaves about every 10 ms and lets `Care` deal with those that are not in OP.

While all is well a turn is one frame. No turn waits for a slave: what takes time is a request whose outcome the next
turns see, or a restoration in steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence

from rtcp.fieldbus.alstatus import ERROR_BIT, STATE_NAMES, AlState, refusal
from rtcp.fieldbus.care import Care
from rtcp.fieldbus.charges import LONG_AGO, SAY_AGAIN_S, Charge
from rtcp.fieldbus.port_errors import ErrorCounters
from rtcp.fieldbus.registers import Command, RegisterPort
from rtcp.fieldbus.restore import Restorer
from rtcp.fieldbus.states import AL_STATUS

_PARK_S = 3.0
_SILENCE_S = 0.25
_RARELY_S = 0.1
"""Error counters, and slaves that are parked, are looked at so often."""


def _runs(words: Iterable[tuple[Charge, str]]) -> Iterator[tuple[Charge, Charge, str]]:
    """Yield the first and the last of neighbours of whom the same is to be said, and what."""
    run: list[Charge] = []
    said = ""
    for charge, text in words:
        if run and (text != said or charge.position != run[-1].position + 1):
            yield run[0], run[-1], said
            run = []
        run.append(charge)
        said = text
    if run:
        yield run[0], run[-1], said


def _how_often(falls: int) -> str:
    return f"; it left OP {falls} times since that was last told" if falls > 1 else ""


def _who(first: Charge, last: Charge) -> str:
    return first.label if first is last else f"{first.label} to {last.label}"


class Watcher:
    """Watches the slaves of a segment that has reached OP; one thread calls it, about every 10 ms.

    Args:
        port: the port for registers.
        names: the slaves' names in the order of the cable.
        restorer: sets up a slave again.
        say: takes the sentences.
    """

    def __init__(
        self, port: RegisterPort, names: Sequence[str], restorer: Restorer, say: Callable[[str], None]
    ) -> None:  # fmt: skip
        self._port = port
        self._say = say
        self.slaves = tuple(Charge(position, name) for position, name in enumerate(names, 1))
        self.errors = ErrorCounters(port, names, say)
        self._care = Care(port, self.slaves, restorer, say)
        self._rarely_at = 0.0
        self._heard_at = time.monotonic()
        self._silent_since: float | None = None
        self._silence_told = False
        self._parked_at: float | None = None
        self.all_op = True
        """Whether every slave was in OP at the last look."""
        self.op_allowed = True
        """Whether OP may be asked for: not while outputs come at other instants than SYNC0 wants them."""

    @property
    def silent(self) -> bool:
        """Whether no frame comes back at present."""
        return self._silent_since is not None

    def park(self) -> None:
        """Take all slaves to PRE-OP and leave them there until `resume`."""
        self._parked_at = time.monotonic()
        self.all_op = False
        for charge in self.slaves:
            self._care.drop(charge)
            # A slave that was being brought back has to be set up again: nobody knows how far it got.
            charge.kept = charge.kept or charge.was_in_op
            charge.was_in_op = False
            charge.leaving = True
        # Noted for all first: the interface may be gone, and back while they are still to be parked.
        for charge in self.slaves:
            charge.leaving = self._care.request(charge, AlState.PREOP, acknowledge=charge.error)

    def resume(self) -> None:
        """Bring back whatever is not in OP, without the pauses that are left."""
        self._parked_at = None
        for charge in self.slaves:
            charge.pause_until = 0.0
            charge.failed = charge.flaps = 0
            charge.fall_told_at = LONG_AGO

    def turn(self) -> int:
        """Look at the slaves and take a step with those that need it.

        Returns:
            Position of a slave that has left OP since the last turn; 0: none.

        Raises:
            BusError: the interface is gone.
        """
        now = time.monotonic()
        data, wkc = self._port.exchange(Command.BRD, 0, AL_STATUS, bytes(2), timeout_s=0.01, tries=1)
        if wkc < 0:
            self._note_silence(now)
            return 0
        self._note_sound(now)
        self._heard_at, heard_before = now, self._heard_at
        left = 0
        if self._parked_at is None:
            left = self._look_at_all(data == b"\x08\0" and wkc >= len(self.slaves), now, heard_before)
            if not self.all_op:
                self._care.take_steps(now, wkc, self.op_allowed)
        if now >= self._rarely_at:
            self._rarely_at = now + _RARELY_S
            if self._parked_at is not None:
                self._keep_parked(now - self._parked_at > _PARK_S)
            self.errors.read_next()
            self.errors.tell()
        return left

    # -- looking --------------------------------------------------------------------------------------------------

    def _look_at_all(self, all_in_op: bool, now: float, heard_before: float) -> int:
        if all_in_op and self.all_op:
            return 0
        if all_in_op:
            found = [(AlState.OP, False, 0)] * len(self.slaves)
        else:
            # Half a look would be taken for what all of them are in.
            looks = [self._look(charge) for charge in self.slaves]
            found = [look for look in looks if look is not None]
            if len(found) < len(looks):
                return 0
        for charge, (state, error, code) in zip(self.slaves, found, strict=True):
            charge.take(state, error, code)
        left = [charge for charge in self.slaves if charge.was_in_op and not charge.well]
        for charge in left:
            charge.was_in_op = False
            charge.lost += 1
            charge.untold += 1
            charge.left_at = heard_before
            self._care.note_fall(charge, now)
        self._tell_left([charge for charge in self.slaves if self._fall_is_due(charge, now)], now)
        self._tell_back([charge for charge in self.slaves if charge.well and self._note_return(charge, now)], now)
        self.all_op = all(charge.well for charge in self.slaves)
        return left[0].position if left else 0

    def _look(self, charge: Charge) -> tuple[AlState, bool, int] | None:
        """Read a slave's state, whether it shows an error, its code; None where the frame did not come back."""
        found = (AlState.NONE, False, 0)
        # A frame that was damaged unnoticed must not stop the arm: who was in OP is asked twice.
        for _ in range(2 if charge.was_in_op else 1):
            data, wkc = self._port.exchange(Command.FPRD, charge.station, AL_STATUS, bytes(6), tries=1)
            if wkc < 0:
                return None
            status = int.from_bytes(data[:2], "little") if wkc else 0
            base = status & 0x0F
            # What is no state of the standard is as good as INIT: it answers, and has to be set up.
            state = AlState(base) if base in STATE_NAMES else AlState.INIT
            found = state, bool(status & ERROR_BIT), int.from_bytes(data[4:6], "little") if wkc else 0
            if found[:2] == (AlState.OP, False):
                break
        return found

    def _note_return(self, charge: Charge, now: float) -> bool:
        """Note that a slave is well; return whether that is to be told: it had been lost, and this was told."""
        if not charge.was_in_op:
            charge.back_at = now
        charge.was_in_op = True
        charge.kept = False
        charge.unfinished = False
        charge.failed = 0
        self._care.drop(charge)
        if charge.left_at is None:
            return False
        charge.recovered += 1
        if not charge.return_due:
            charge.left_at = None
            return False
        charge.return_due = False
        return True

    def _fall_is_due(self, charge: Charge, now: float) -> bool:
        return charge.untold > 0 and not charge.well and now - charge.fall_told_at >= SAY_AGAIN_S

    def _tell_left(self, left: Sequence[Charge], now: float) -> None:
        for first, last, words in _runs((charge, charge.words() + _how_often(charge.untold)) for charge in left):
            if first.state is not AlState.NONE:
                where = "it is in" if first is last else "each is in"
                self._say(f"{_who(first, last)} left OP: {where} {words}")
                continue
            before = "the master" if first.position == 1 else self.slaves[first.position - 2].label
            what = "it does not answer" if first is last else "none of them answers"
            check = f"check the supply of {first.label} and the cable between {before} and {first.label}"
            self._say(f"{_who(first, last)} left OP: {what}; {check}{_how_often(first.untold)}")
        for charge in left:
            charge.fall_told_at, charge.untold, charge.return_due = now, 0, True

    def _tell_back(self, back: Sequence[Charge], now: float) -> None:
        for first, last, after in _runs((charge, f"{now - (charge.left_at or now):.1f} s") for charge in back):
            are = "is" if first is last else "are"
            self._say(
                f"{_who(first, last)} {are} back in OP after {after}; the arm does not move before `rtcp reset` and "
                "`rtcp enable`"
            )
        for charge in back:
            charge.left_at = None

    def _note_silence(self, now: float) -> None:
        self._silent_since = self._silent_since or now
        if now - self._silent_since < _SILENCE_S or self._silence_told:
            return
        # Which slave left OP shows when they are heard again; the cycle counts the lost frames and stops the arm.
        self._silence_told = True
        self.all_op = False
        for charge in self.slaves:
            charge.state, charge.error, charge.code = AlState.NONE, False, 0
        self._say(
            f"no slave answers: check the cable between the master and {self.slaves[0].label}, and that slave's supply"
        )

    def _note_sound(self, now: float) -> None:
        if self._silence_told and self._silent_since is not None:
            self._say(f"slaves answer again, after {now - self._silent_since:.1f} s without any")
        self._silent_since = None
        self._silence_told = False

    def _keep_parked(self, late: bool) -> None:
        for charge in self.slaves:
            look = self._look(charge)
            if look is None:
                return
            charge.take(*look)
            at_home = charge.state in (AlState.PREOP, AlState.SAFEOP, AlState.OP)
            # What lost its supply meanwhile is set up again when it is brought back.
            charge.kept = charge.kept and at_home
            if not at_home or (charge.state is AlState.PREOP and not charge.error):
                continue
            self._care.request(charge, AlState.PREOP, acknowledge=charge.error)
            if late:
                found = charge.state | (ERROR_BIT if charge.error else 0)
                self._care.tell(charge, refusal(charge.label, AlState.PREOP, found, charge.code))
