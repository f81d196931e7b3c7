"""Supervision of the slaves beside the cycle: who left OP, and what is done to bring it back.

While all is well a turn is one frame. No turn waits for a slave: what takes time is a request whose outcome the next
turns see, or a restoration in steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol

from rtcp.fieldbus.al_state import ERROR_BIT, STATE_NAMES, AlState, refusal
from rtcp.fieldbus.bus import Bus
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.port_errors import ErrorCounters
from rtcp.fieldbus.recovery import LONG_AGO, REPORT_INTERVAL_S, MonitoredSlave, SlaveRecovery
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort, T
from rtcp.fieldbus.slave_setup import SlaveRestorer
from rtcp.fieldbus.topology import Topology

_PARK_S = 3.0
_SILENCE_S = 0.25
_RARELY_S = 0.1
"""Interval at which error counters and parked slaves are read, s."""


def _runs(words: Iterable[tuple[MonitoredSlave, T]]) -> Iterator[tuple[MonitoredSlave, MonitoredSlave, T]]:
    """Yield the first and the last of each run of neighbours of which the same is said, and that."""
    run: list[MonitoredSlave] = []
    shared: T | None = None
    for slave, text in words:
        if run and shared is not None and (text != shared or slave.position != run[-1].position + 1):
            yield run[0], run[-1], shared
            run = []
        run.append(slave)
        shared = text
    if run and shared is not None:
        yield run[0], run[-1], shared


def _fall_count(falls: int) -> str:
    return f"; it left OP {falls} times since the last report" if falls > 1 else ""


def _slaves_named(first: MonitoredSlave, last: MonitoredSlave) -> str:
    return first.label if first is last else f"{first.label} to {last.label}"


class SlaveWatcher:
    """Watches the slaves of a segment that has reached OP; one thread calls it, about every 10 ms.

    Args:
        port: the port for registers.
        names: the slaves' names in the order of the cable.
        restorer: sets up a slave again.
        report: receives the messages.
        topology: the tree of the slaves; None: a chain.
    """

    def __init__(
        self,
        port: RegisterPort,
        names: Sequence[str],
        restorer: SlaveRestorer,
        report: Callable[[str], None],
        topology: Topology | None = None,
    ) -> None:
        self._port = port
        self._topology = topology or Topology.chain(len(names))
        self._report = report
        self.slaves = tuple(MonitoredSlave(position, name) for position, name in enumerate(names, 1))
        self.errors = ErrorCounters(port, names, report, self._topology)
        self._recovery = SlaveRecovery(port, self.slaves, restorer, report, self._topology)
        self._rarely_at = 0.0
        self._answered_at = time.monotonic()
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
        for slave in self.slaves:
            self._recovery.drop(slave)
            # A slave in restoration has to be set up again: its progress is unknown.
            slave.kept = slave.kept or slave.was_in_op
            slave.was_in_op = False
            slave.leaving = True
        # Noted for all first: the interface may be gone, and back while they are still to be parked.
        for slave in self.slaves:
            slave.leaving = self._recovery.request(slave, AlState.PREOP, acknowledge=slave.error)

    def resume(self) -> None:
        """Bring back whatever is not in OP, without the pauses that are left."""
        self._parked_at = None
        for slave in self.slaves:
            slave.pause_until = 0.0
            slave.failed = slave.flaps = 0
            slave.fall_reported_at = LONG_AGO

    def turn(self) -> int:
        """Look at the slaves and take a step with those that need it.

        Returns:
            Position of a slave that has left OP since the last turn; 0: none.

        Raises:
            BusError: the interface is gone.
        """
        now = time.monotonic()
        data, wkc = self._port.exchange(DatagramCommand.BRD, 0, Register.AL_STATUS, bytes(2), timeout_s=0.01, tries=1)
        if wkc < 0:
            self._note_silence(now)
            return 0
        self._note_answer(now)
        self._answered_at, answered_before = now, self._answered_at
        left = 0
        if self._parked_at is None:
            left = self._look_at_all(data == b"\x08\0" and wkc >= len(self.slaves), now, answered_before)
            if not self.all_op:
                self._recovery.take_steps(now, wkc, self.op_allowed)
        if now >= self._rarely_at:
            self._rarely_at = now + _RARELY_S
            if self._parked_at is not None:
                self._keep_parked(now - self._parked_at > _PARK_S)
            self.errors.read_next()
            self.errors.report_due()
        return left

    # -- looking --------------------------------------------------------------------------------------------------

    def _look_at_all(self, all_in_op: bool, now: float, answered_before: float) -> int:
        if all_in_op and self.all_op:
            return 0
        if all_in_op:
            found = [(AlState.OP, False, 0)] * len(self.slaves)
        else:
            # Half a look would be taken for what all of them are in.
            looks = [self._look(slave) for slave in self.slaves]
            found = [look for look in looks if look is not None]
            if len(found) < len(looks):
                return 0
        for slave, (state, error, code) in zip(self.slaves, found, strict=True):
            slave.update(state, error, code)
        left = [slave for slave in self.slaves if slave.was_in_op and not slave.well]
        for slave in left:
            slave.was_in_op = False
            slave.lost += 1
            slave.unreported += 1
            slave.left_at = answered_before
            self._recovery.note_fall(slave, now)
        self._report_left([slave for slave in self.slaves if self._fall_is_due(slave, now)], now)
        self._report_back([slave for slave in self.slaves if slave.well and self._note_return(slave, now)], now)
        self.all_op = all(slave.well for slave in self.slaves)
        return left[0].position if left else 0

    def _look(self, slave: MonitoredSlave) -> tuple[AlState, bool, int] | None:
        """Read a slave's state, whether it shows an error, its code; None where the frame did not come back."""
        found = (AlState.NONE, False, 0)
        # A frame that was damaged unnoticed must not stop the arm: who was in OP is asked twice.
        for _ in range(2 if slave.was_in_op else 1):
            data, wkc = self._port.exchange(DatagramCommand.FPRD, slave.station, Register.AL_STATUS, bytes(6), tries=1)
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

    def _note_return(self, slave: MonitoredSlave, now: float) -> bool:
        """Note that a slave is well; return whether to report that: its fall was reported."""
        if not slave.was_in_op:
            slave.back_at = now
        slave.was_in_op = True
        slave.kept = False
        slave.unfinished = False
        slave.failed = 0
        self._recovery.drop(slave)
        if slave.left_at is None:
            return False
        slave.recovered += 1
        if not slave.return_due:
            slave.left_at = None
            return False
        slave.return_due = False
        return True

    def _fall_is_due(self, slave: MonitoredSlave, now: float) -> bool:
        return slave.unreported > 0 and not slave.well and now - slave.fall_reported_at >= REPORT_INTERVAL_S

    def _report_left(self, left: Sequence[MonitoredSlave], now: float) -> None:
        lost = {slave.position for slave in left if slave.state is AlState.NONE}
        for first, last, (words, _) in _runs(
            (slave, (slave.words() + _fall_count(slave.unreported), self._topology.first_lost(slave.position, lost)
                     if slave.position in lost else 0))
            for slave in left
        ):  # fmt: skip
            if first.state is not AlState.NONE:
                where = "it is in" if first is last else "each is in"
                self._report(f"{_slaves_named(first, last)} left OP: {where} {words}")
                continue
            parent = self._topology.parent(first.position)
            before = self.slaves[parent - 1].label if parent else "the master"
            what = "it does not answer" if first is last else "none of them answers"
            check = f"check the supply of {first.label} and the cable between {before} and {first.label}"
            self._report(f"{_slaves_named(first, last)} left OP: {what}; {check}{_fall_count(first.unreported)}")
        for slave in left:
            slave.fall_reported_at, slave.unreported, slave.return_due = now, 0, True

    def _report_back(self, back: Sequence[MonitoredSlave], now: float) -> None:
        for first, last, after in _runs((slave, f"{now - (slave.left_at or now):.1f} s") for slave in back):
            are = "is" if first is last else "are"
            self._report(
                f"{_slaves_named(first, last)} {are} back in OP after {after}; the arm does not move before "
                "`rtcp reset` and `rtcp enable`"
            )
        for slave in back:
            slave.left_at = None

    def _note_silence(self, now: float) -> None:
        self._silent_since = self._silent_since or now
        if now - self._silent_since < _SILENCE_S or self._silence_told:
            return
        # Which slave left OP shows when they answer again; the cycle counts the lost frames and stops the arm.
        self._silence_told = True
        self.all_op = False
        for slave in self.slaves:
            slave.state, slave.error, slave.code = AlState.NONE, False, 0
        self._report(
            f"no slave answers: check the cable between the master and {self.slaves[0].label}, and that slave's supply"
        )

    def _note_answer(self, now: float) -> None:
        if self._silence_told and self._silent_since is not None:
            self._report(f"slaves answer again, after {now - self._silent_since:.1f} s without any")
        self._silent_since = None
        self._silence_told = False

    def _keep_parked(self, late: bool) -> None:
        for slave in self.slaves:
            look = self._look(slave)
            if look is None:
                return
            slave.update(*look)
            at_home = slave.state in (AlState.PREOP, AlState.SAFEOP, AlState.OP)
            # What lost its supply meanwhile is set up again when it is brought back.
            slave.kept = slave.kept and at_home
            if not at_home or (slave.state is AlState.PREOP and not slave.error):
                continue
            self._recovery.request(slave, AlState.PREOP, acknowledge=slave.error)
            if late:
                found = slave.state | (ERROR_BIT if slave.error else 0)
                self._recovery.report_limited(slave, refusal(slave.label, AlState.PREOP, found, slave.code))


class SupervisedBus(Bus, Protocol):
    """A bus on a wire: slaves are lost and recovered while the cycle runs."""

    def sdo(self, position: int) -> SdoClient:
        """Return SDO access to a slave, also in steps."""

    def watcher(self, report: Callable[[str], None]) -> SlaveWatcher:
        """Return the watcher of the configured slaves, all of them in OP; `report` receives its messages."""
