"""Recovery of slaves that are not in OP: state of each slave, table of actions, one small step each poll."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from rtcp.fieldbus.al_state import AlState, is_emulated
from rtcp.fieldbus.bus import station_of
from rtcp.fieldbus.errors import BusError, ForeignSlave
from rtcp.fieldbus.port_errors import REPORT_INTERVAL_S
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort, Steps
from rtcp.fieldbus.slave_setup import SlaveRestorer, provisional_of
from rtcp.fieldbus.topology import PortState, Topology, port_states
from rtcp.ipc.codes import ERROR_BIT
from rtcp.ipc.events import ErrorReported, Event, OtherSlaveAnswers, SlaveSetUpAgain, StateNotReached

LONG_AGO = float("-inf")


class Action(Enum):
    """Recovery action for a slave."""

    NOTHING = "nothing"
    ACKNOWLEDGE = "acknowledge its error"
    REQUEST_SAFEOP = "request SAFE-OP"
    REQUEST_OP = "request OP"
    REQUEST_PREOP = "request PRE-OP: the slave is parked"
    RECONFIGURE = "set the slave up again"
    MARK_LOST = "mark the slave lost; recover it when it answers again"


# (state, error) -> action; RECONFIGURE for any other state of a slave that answers.
TABLE: dict[tuple[AlState, bool], Action] = {
    (AlState.OP, False): Action.NOTHING,
    (AlState.OP, True): Action.ACKNOWLEDGE,
    (AlState.SAFEOP, True): Action.ACKNOWLEDGE,
    (AlState.SAFEOP, False): Action.REQUEST_OP,
    (AlState.NONE, False): Action.MARK_LOST,
}


def action_for(state: AlState, error: bool) -> Action:
    """Return the action of `TABLE` for a slave in `state`."""
    return TABLE.get((state, error), Action.RECONFIGURE)


@dataclass
class MonitoredSlave:
    """State, counters and pending work of one slave; written by the watcher and the recovery."""

    position: int
    state: AlState = AlState.OP
    error: bool = False
    code: int = 0
    lost: int = 0
    """Number of exits from OP."""
    recovered: int = 0
    """Number of returns to OP."""
    left_at: float | None = None
    """Instant of its first exit from OP that is not reported as recovered (time.monotonic), s."""
    was_in_op: bool = True
    """Whether it was in OP at the last poll."""
    back_at: float = LONG_AGO
    """Instant of its last return to OP (time.monotonic), s."""
    flaps: int = 0
    """Number of consecutive exits from OP within 1 s of the return."""
    keeps_setup: bool = False
    """Whether it is parked in PRE-OP with a valid configuration."""
    leaving: bool = False
    """Whether PRE-OP was requested and it has not left OP yet."""
    provisional: bool = False
    """Whether it lost its address and has a provisional one until it is identified."""
    unfinished: bool = False
    """Whether a restoration was started and has not ended."""
    work: Steps[None] | None = None
    pending: tuple[Action, AlState, bool, float] | None = None
    """Requested action, state and error at the request, deadline (time.monotonic, s)."""
    failed: int = 0
    """Number of failed actions in a row."""
    pause_until: float = 0.0
    """No action before this instant (time.monotonic), s."""
    probe_at: float = 0.0
    """Instant of the next `_probe` (time.monotonic), s."""
    reported_at: float = LONG_AGO
    """Instant of the last report of a failed action (time.monotonic), s."""
    fall_reported_at: float = LONG_AGO
    """Instant of the last report of an exit from OP (time.monotonic), s."""
    unreported: int = 0
    """Number of exits from OP since the last report."""
    return_due: bool = False
    """Whether to report its return, because its fall was reported."""

    @property
    def station(self) -> int:
        """Configured station address."""
        return station_of(self.position)

    @property
    def well(self) -> bool:
        """Whether it is in OP without an error, and not on its way to PRE-OP."""
        return self.state is AlState.OP and not self.error and not self.leaving

    def update(self, state: AlState, error: bool, code: int) -> None:
        """Store its AL status."""
        self.state, self.error, self.code = state, error, code
        if state not in (AlState.OP, AlState.NONE):
            self.leaving = False

    @property
    def al_status(self) -> int:
        """State and error indication as in the register."""
        return self.state | (ERROR_BIT if self.error else 0)


_REQUESTS = {
    Action.REQUEST_OP: AlState.OP,
    Action.REQUEST_SAFEOP: AlState.SAFEOP,
    Action.REQUEST_PREOP: AlState.PREOP,
}
_TRIES = 3
"""Refusals before a slave is set up again."""
_PAUSE_S, _LONGEST_PAUSE_S, _FOREIGN_PAUSE_S = 1.0, 5.0, 10.0
"""Pause after a failed action, longest pause, and pause after an answer of another device, s."""
_TRANSITION_S = 3.0
"""Time for a change of state after its request, s."""
_WELL_S = 1.0
"""Least time in OP after which a slave counts as recovered, s."""
_PROBE_S = 0.05
"""Interval between two checks whether a lost slave answers, s."""
_STEP_S = 0.0003
"""Pause between two steps of a restoration, s."""
_STEPS_S = 0.003
"""Time for restorations in one poll, s; several steps fit where a slave answers at once."""


class SlaveRecovery:
    """Carries out the table's action for each slave.

    Args:
        port: the port for registers.
        slaves: the slaves in the order of the cable.
        restorer: sets up a slave again.
        report: receives the events.
        topology: the tree of the slaves.
    """

    def __init__(
        self,
        port: RegisterPort,
        slaves: Sequence[MonitoredSlave],
        restorer: SlaveRestorer,
        report: Callable[[Event], None],
        topology: Topology,
    ) -> None:
        self._port = port
        self._topology = topology
        self._slaves = slaves
        self._restorer = restorer
        self._report = report
        self._reached = len(slaves)
        self._op_allowed = True

    def take_steps(self, now: float, reached: int, op_allowed: bool) -> None:
        """Advance the recovery of every slave that is not in OP.

        Args:
            now: the instant (time.monotonic).
            reached: number of slaves that answer.
            op_allowed: whether OP may be requested; otherwise slaves wait in SAFE-OP.
        """
        self._reached = reached
        self._op_allowed = op_allowed
        until = now + _STEPS_S
        for slave in self._slaves:
            if not slave.well:
                if slave.work is None:
                    self._next_action(slave, now)
                if slave.work is not None:
                    self._continue_restoration(slave, until)

    def _next_action(self, slave: MonitoredSlave, now: float) -> None:
        state, error = slave.state, slave.error
        if slave.pending is not None:
            action, state_then, error_then, until = slave.pending
            unchanged = (state, error) == (state_then, error_then)
            if unchanged and now < until:
                return
            slave.pending = None
            if unchanged or (action in _REQUESTS and error):
                self._fail(slave, now, _REQUESTS.get(action, state))
                return
        if now < slave.pause_until:
            return
        action = action_for(state, error)
        if slave.keeps_setup and state is AlState.PREOP and not error:
            action = Action.REQUEST_SAFEOP
        if (slave.failed >= _TRIES or slave.unfinished) and action is not Action.MARK_LOST:
            action = Action.RECONFIGURE
        if slave.leaving and state is AlState.OP:
            action = Action.REQUEST_PREOP
        if action is Action.REQUEST_OP and not self._op_allowed:
            return
        if action is Action.MARK_LOST:
            self._probe(slave, now)
        elif action is Action.RECONFIGURE:
            self._start_restoration(slave, None)
        elif action is Action.ACKNOWLEDGE:
            slave.pending = action, state, error, now + _PAUSE_S
            self.request(slave, state, acknowledge=True)
        else:
            slave.pending = action, state, error, now + _TRANSITION_S
            self.request(slave, _REQUESTS[action], acknowledge=error)

    def request(self, slave: MonitoredSlave, state: AlState, *, acknowledge: bool = False) -> bool:
        """Request `state` of a slave; return False if no slave processed the frame. A lost frame may have arrived."""
        word = state | (ERROR_BIT if acknowledge and not is_emulated(self._port, slave.station) else 0)
        data = word.to_bytes(2, "little")
        return self._port.exchange(DatagramCommand.FPWR, slave.station, Register.AL_CONTROL, data, tries=1).wkc != 0

    def note_fall(self, slave: MonitoredSlave, now: float) -> None:
        """Record an exit from OP. Repeated ones lead to pauses before the recovery, and then to a new set-up."""
        if now - slave.back_at < _WELL_S:
            slave.flaps += 1
            slave.pause_until = now + min(_PAUSE_S * slave.flaps, _LONGEST_PAUSE_S)
        else:
            slave.flaps = 0
            slave.reported_at = LONG_AGO
        slave.failed = slave.flaps

    def _fail(self, slave: MonitoredSlave, now: float, wanted: AlState) -> None:
        slave.failed += 1
        slave.keeps_setup = False
        slave.pause_until = now + _PAUSE_S
        self.report_refusal(slave, wanted)

    def _probe(self, slave: MonitoredSlave, now: float) -> None:
        """Check whether a slave that lost its address answers at its position again."""
        slave.pending = None
        slave.keeps_setup = False
        if now < slave.probe_at:
            return
        slave.probe_at = now + _PROBE_S
        place = self._place_of(slave)
        if place is None:
            return
        data, wkc = self._port.exchange(
            DatagramCommand.APRD, 1 - place & 0xFFFF, Register.STATION_ADDRESS, bytes(2), tries=1
        )
        if wkc != 1:
            return
        station = int.from_bytes(data, "little")
        answering = next((peer for peer in self._slaves if peer.station == station), None)
        if answering is None:
            self._start_restoration(slave, place)
        elif answering is not slave:
            slave.pause_until = now + _PAUSE_S
            self._report_limited(slave, OtherSlaveAnswers(slave.position, answering.position))

    def _place_of(self, slave: MonitoredSlave) -> int | None:
        """Return at which place, from 1, among the answering slaves a lost slave answers; None: unknown at present.

        A lost slave without an address can answer if its parent answers and has a link to it. Of several such slaves
        only the place of the first is certain: the next one's is known when the first has an address.
        """
        addressed = {peer.position for peer in self._slaves if peer is not slave and self._has_address(peer)}
        if self._reached <= len(addressed):
            return None
        for peer in self._slaves:
            if peer.position not in addressed and self._is_linked(peer):
                return 1 + sum(position < slave.position for position in addressed) if peer is slave else None
        return None

    def _has_address(self, slave: MonitoredSlave) -> bool:
        """Whether a slave answers at its own or its provisional address."""
        if slave.state is not AlState.NONE:
            return True
        if (
            slave.provisional
            and self._port.read(provisional_of(slave.position), Register.AL_STATUS, 2, tries=1) is None
        ):
            slave.provisional = False
        return slave.provisional

    def _is_linked(self, slave: MonitoredSlave) -> bool:
        """Whether its parent answers and has a link to it."""
        parent = self._topology.parent(slave.position)
        if not parent:
            return True
        before = self._slaves[parent - 1]
        if not self._has_address(before):
            return False
        station = provisional_of(parent) if before.state is AlState.NONE else before.station
        status = self._port.read(station, Register.DL_STATUS, 2, tries=1)
        ports = port_states(int.from_bytes(status or b"", "little"))
        return ports[self._topology.port(slave.position)] is PortState.OPEN

    def _start_restoration(self, slave: MonitoredSlave, place: int | None) -> None:
        slave.pending = None
        slave.keeps_setup = False
        slave.unfinished = True
        slave.provisional = place is not None
        if slave.failed == 0 and slave.flaps == 0:
            self._report(SlaveSetUpAgain(slave.position, slave.al_status, slave.code))
        slave.work = self._restorer.restore(slave.position, place)

    def _continue_restoration(self, slave: MonitoredSlave, until: float) -> None:
        work = slave.work
        assert work is not None
        try:
            next(work)
            while time.monotonic() < until:
                time.sleep(_STEP_S)
                next(work)
        except StopIteration:
            slave.work = None
            slave.unfinished = False
            slave.failed = 0
        except BusError as error:
            slave.work = None
            slave.failed += 1
            pause = min(_PAUSE_S * slave.failed, _LONGEST_PAUSE_S)
            slave.pause_until = time.monotonic() + (_FOREIGN_PAUSE_S if isinstance(error, ForeignSlave) else pause)
            self._report_limited(slave, ErrorReported("; ".join(error.sentences)))

    def drop(self, slave: MonitoredSlave) -> None:
        """Abandon the pending request or restoration of a slave."""
        slave.pending = None
        if slave.work is not None:
            slave.work.close()
            slave.work = None

    def report_refusal(self, slave: MonitoredSlave, requested: AlState) -> None:
        """Report that a slave did not reach a state, at most every 10 s."""
        self._report_limited(slave, StateNotReached(slave.position, requested, slave.al_status, slave.code))

    def _report_limited(self, slave: MonitoredSlave, event: Event) -> None:
        now = time.monotonic()
        if now - slave.reported_at >= REPORT_INTERVAL_S:
            slave.reported_at = now
            self._report(event)
