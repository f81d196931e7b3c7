"""Supervision of the slaves beside the cycle: detects which slaves left OP, and brings them back.

While all slaves are in OP a poll is one frame. No poll waits for a slave: slow actions are requests, whose outcome
later polls read, or restorations in steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Protocol

from rtcp.fieldbus.al_state import AlState, parse_al
from rtcp.fieldbus.bus import Bus
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.other_masters import OtherMasters
from rtcp.fieldbus.port_errors import REPORT_INTERVAL_S, ErrorCounters
from rtcp.fieldbus.recovery import LONG_AGO, MonitoredSlave, SlaveRecovery
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort, T
from rtcp.fieldbus.slave_setup import SlaveRestorer
from rtcp.fieldbus.system_time import SystemTime
from rtcp.fieldbus.topology import Topology
from rtcp.ipc.events import Event, NoSlaveAnswers, OtherMaster, SlavesAnswerAgain, SlavesBackInOp, SlavesLeftOp

_PARK_S = 3.0
_SILENCE_S = 0.25
_RARELY_S = 0.1
"""Interval at which error counters and parked slaves are read, s."""


def _runs(facts: Iterable[tuple[MonitoredSlave, T]]) -> Iterator[tuple[int, int, T]]:
    """Yield the first and the last position of each run of neighbours with equal facts, and the facts."""
    # Within a run the difference of position and list index is constant.
    alike = groupby(enumerate(facts), lambda entry: (entry[1][0].position - entry[0], entry[1][1]))
    for (_, shared), run in alike:
        slaves = [slave for _, (slave, _) in run]
        yield slaves[0].position, slaves[-1].position, shared


class SlaveWatcher:
    """Watches the slaves of a segment that has reached OP; one thread calls it, about every 10 ms.

    Args:
        port: the port for registers.
        count: how many slaves there are.
        restorer: sets up a slave again.
        report: receives the events.
        topology: the tree of the slaves; None: a chain.
        others: hears a second master; None: nothing listens.
    """

    def __init__(
        self,
        port: RegisterPort,
        count: int,
        restorer: SlaveRestorer,
        report: Callable[[Event], None],
        topology: Topology | None = None,
        others: OtherMasters | None = None,
    ) -> None:
        self._port = port
        self._topology = topology or Topology.chain(count)
        self._report = report
        self.slaves = tuple(MonitoredSlave(position) for position in range(1, count + 1))
        self.errors = ErrorCounters(port, count, report, self._topology)
        self._recovery = SlaveRecovery(port, self.slaves, restorer, report, self._topology)
        self._others = others
        self._other_reported_at = LONG_AGO
        self._rarely_at = 0.0
        self._answered_at = time.monotonic()
        self._silent_since: float | None = None
        self._silence_reported = False
        self._parked_at: float | None = None
        self.all_op = True
        """Whether every slave was in OP at the last poll."""
        self.op_allowed = True
        """Whether OP may be requested: not while the outputs are not synchronous to SYNC0."""

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
            # A slave in restoration has to be set up again: its configuration is incomplete.
            slave.keeps_setup = slave.keeps_setup or slave.was_in_op
            slave.was_in_op = False
            slave.leaving = True
        # First note it for all: the interface may fail now, and return while slaves are still to be parked.
        for slave in self.slaves:
            slave.leaving = self._recovery.request(slave, AlState.PREOP, acknowledge=slave.error)

    def resume(self) -> None:
        """Bring back all slaves that are not in OP, without the remaining pauses."""
        self._parked_at = None
        for slave in self.slaves:
            slave.pause_until = 0.0
            slave.failed = slave.flaps = 0
            slave.fall_reported_at = LONG_AGO

    def turn(self) -> int:
        """Poll the states of the slaves and advance the recovery of those that are not in OP.

        Returns:
            Position of a slave that has left OP since the last poll; 0: none.

        Raises:
            BusError: the interface is gone.
        """
        now = time.monotonic()
        if now >= self._rarely_at:
            self._note_other_master(now)
        data, wkc = self._port.exchange(DatagramCommand.BRD, 0, Register.AL_STATUS, bytes(2), timeout_s=0.01, tries=1)
        if wkc < 0:
            self._note_silence(now)
            return 0
        self._note_answer(now)
        self._answered_at, answered_before = now, self._answered_at
        left = 0
        if self._parked_at is None:
            left = self._update_all(data == b"\x08\0" and wkc >= len(self.slaves), now, answered_before)
            if not self.all_op:
                self._recovery.take_steps(now, wkc, self.op_allowed)
        if now >= self._rarely_at:
            self._rarely_at = now + _RARELY_S
            if self._parked_at is not None:
                self._keep_parked(now - self._parked_at > _PARK_S)
            self.errors.read_next()
            self.errors.report_due()
        return left

    # -- polling --------------------------------------------------------------------------------------------------

    def _update_all(self, all_in_op: bool, now: float, answered_before: float) -> int:
        if all_in_op and self.all_op:
            return 0
        if all_in_op:
            answers = [(AlState.OP, False, 0)] * len(self.slaves)
        else:
            # An incomplete poll says nothing about the segment as a whole.
            readings = [self._read_status(slave) for slave in self.slaves]
            answers = [reading for reading in readings if reading is not None]
            if len(answers) < len(readings):
                return 0
        for slave, (state, error, code) in zip(self.slaves, answers, strict=True):
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

    def _read_status(self, slave: MonitoredSlave) -> tuple[AlState, bool, int] | None:
        """Read a slave's state, error indication and AL status code; None where the frame did not come back."""
        status = (AlState.NONE, False, 0)
        # An undetected damaged frame must not stop the arm: a slave that was in OP is read twice.
        for _ in range(2 if slave.was_in_op else 1):
            data, wkc = self._port.exchange(DatagramCommand.FPRD, slave.station, Register.AL_STATUS, bytes(6), tries=1)
            if wkc < 0:
                return None
            # An answer, and no state in it: it has to be set up again.
            status = parse_al(data, AlState.INIT) if wkc else (AlState.NONE, False, 0)
            if status[:2] == (AlState.OP, False):
                break
        return status

    def _note_return(self, slave: MonitoredSlave, now: float) -> bool:
        """Note that a slave is well; return whether to report that, because its fall was reported."""
        if not slave.was_in_op:
            slave.back_at = now
        slave.was_in_op = True
        slave.keeps_setup = False
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
        for first, last, (status, code, falls, _) in _runs(
            (slave, (slave.al_status, slave.code if slave.error else 0, slave.unreported,
                     self._topology.first_lost(slave.position, lost) if slave.position in lost else 0))
            for slave in left
        ):  # fmt: skip
            self._report(SlavesLeftOp(first, last, status, code, self._topology.parent(first), falls))
        for slave in left:
            slave.fall_reported_at, slave.unreported, slave.return_due = now, 0, True

    def _report_back(self, back: Sequence[MonitoredSlave], now: float) -> None:
        for first, last, after_s in _runs((slave, round(now - (slave.left_at or now), 1)) for slave in back):
            self._report(SlavesBackInOp(first, last, after_s))
        for slave in back:
            slave.left_at = None

    def _note_other_master(self, now: float) -> None:
        # Also while no slave answers: a second master may be why.
        if self._others is None or now - self._other_reported_at < REPORT_INTERVAL_S:
            return
        if address := self._others.address():
            self._other_reported_at = now
            self._report(OtherMaster(address))
            self._others.forget()

    def _note_silence(self, now: float) -> None:
        self._silent_since = self._silent_since or now
        if now - self._silent_since < _SILENCE_S or self._silence_reported:
            return
        # Which slave left OP shows when they answer again; the cycle counts the lost frames and stops the arm.
        self._silence_reported = True
        self.all_op = False
        for slave in self.slaves:
            slave.state, slave.error, slave.code = AlState.NONE, False, 0
        self._report(NoSlaveAnswers())

    def _note_answer(self, now: float) -> None:
        if self._silence_reported and self._silent_since is not None:
            self._report(SlavesAnswerAgain(now - self._silent_since))
        self._silent_since = None
        self._silence_reported = False

    def _keep_parked(self, late: bool) -> None:
        for slave in self.slaves:
            status = self._read_status(slave)
            if status is None:
                return
            slave.update(*status)
            at_home = slave.state in (AlState.PREOP, AlState.SAFEOP, AlState.OP)
            # A slave that lost its supply meanwhile is set up again when it is brought back.
            slave.keeps_setup = slave.keeps_setup and at_home
            if not at_home or (slave.state is AlState.PREOP and not slave.error):
                continue
            self._recovery.request(slave, AlState.PREOP, acknowledge=slave.error)
            if late:
                self._recovery.report_refusal(slave, AlState.PREOP)


class SupervisedBus(Bus, Protocol):
    """A bus on a wire: slaves are lost and recovered while the cycle runs."""

    system_time: SystemTime
    """Time of the segment since `configure`."""

    def sdo(self, position: int) -> SdoClient:
        """Return SDO access to a slave, also in steps."""

    def note_written(self, position: int, index: int, sub_index: int, data: bytes) -> None:
        """Note an SDO that a client has written, for the slave's next set-up."""

    def watcher(self, report: Callable[[Event], None]) -> SlaveWatcher:
        """Return the watcher of the configured slaves, all of them in OP; `report` receives its events."""
