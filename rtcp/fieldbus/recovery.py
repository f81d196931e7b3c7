"""Recovery of slaves that are not in OP: what is known of each, the table of actions, one small step a turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from rtcp.fieldbus.al_state import ERROR_BIT, AlState, is_emulated, refusal
from rtcp.fieldbus.bus import SlaveState, slave_label, station_of
from rtcp.fieldbus.errors import BusError, ForeignSlave
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort, Steps
from rtcp.fieldbus.slave_setup import SlaveRestorer, provisional_of
from rtcp.fieldbus.topology import PortState, Topology, port_states

LONG_AGO = float("-inf")
REPORT_INTERVAL_S = 10.0
"""Least interval between two reports about one slave, s; the first one comes at once."""


class Action(Enum):
    """What is done with a slave."""

    NOTHING = "nothing"
    ACKNOWLEDGE = "acknowledge its error"
    REQUEST_SAFEOP = "request SAFE-OP"
    REQUEST_OP = "request OP"
    REQUEST_PREOP = "request PRE-OP: the slave is parked"
    RECONFIGURE = "set the slave up again"
    MARK_LOST = "mark the slave lost; recover it when it answers again"


# (state, error) -> what is done; any other state that answers is RECONFIGURE.
TABLE: dict[tuple[AlState, bool], Action] = {
    (AlState.OP, False): Action.NOTHING,
    (AlState.OP, True): Action.ACKNOWLEDGE,
    (AlState.SAFEOP, True): Action.ACKNOWLEDGE,
    (AlState.SAFEOP, False): Action.REQUEST_OP,
    (AlState.NONE, False): Action.MARK_LOST,
}


def action_for(state: AlState, error: bool) -> Action:
    """Return the action for a slave in `state`."""
    return TABLE.get((state, error), Action.RECONFIGURE)


@dataclass
class MonitoredSlave:
    """State, counters and pending work of one slave; written by the watcher and the recovery."""

    position: int
    name: str
    state: AlState = AlState.OP
    error: bool = False
    code: int = 0
    lost: int = 0
    """Times that it left OP."""
    recovered: int = 0
    """Times that it came back to OP."""
    left_at: float | None = None
    was_in_op: bool = True
    back_at: float = LONG_AGO
    """Instant of its last return to OP (time.monotonic), s."""
    flaps: int = 0
    """Times in a row that it left OP within 1 s of its return."""
    kept: bool = False
    """It is parked in PRE-OP and keeps its set-up."""
    leaving: bool = False
    """PRE-OP was requested and it has not left OP yet."""
    provisional: bool = False
    """It lost its address, and its restoration has given it another one for the time until it is known."""
    unfinished: bool = False
    """A restoration was started and has not ended."""
    work: Steps[None] | None = None
    asked: tuple[Action, AlState, bool, float] | None = None
    """Requested action, state and error at the request, deadline."""
    failed: int = 0
    pause_until: float = 0.0
    probe_at: float = 0.0
    reported_at: float = LONG_AGO
    fall_reported_at: float = LONG_AGO
    unreported: int = 0
    """Times that it left OP since the last report of that."""
    return_due: bool = False
    """Its return is to be reported, because its fall was."""

    @property
    def label(self) -> str:
        """Name in messages."""
        return slave_label(self.position, self.name)

    @property
    def station(self) -> int:
        """Configured station address."""
        return station_of(self.position)

    @property
    def well(self) -> bool:
        """Whether it is in OP without an error, and not on its way to PRE-OP."""
        return self.state is AlState.OP and not self.error and not self.leaving

    def update(self, state: AlState, error: bool, code: int) -> None:
        """Store the state that its AL status shows."""
        self.state, self.error, self.code = state, error, code
        if state not in (AlState.OP, AlState.NONE):
            self.leaving = False

    def words(self) -> str:
        """Return its state, with the AL status code, in words."""
        return SlaveState(self.position, self.station, self.name, self.state, self.error, self.code).words()


_REQUESTS = {
    Action.REQUEST_OP: AlState.OP,
    Action.REQUEST_SAFEOP: AlState.SAFEOP,
    Action.REQUEST_PREOP: AlState.PREOP,
}
_TRIES = 3
"""Refusals before a slave is set up again."""
_PAUSE_S, _LONGEST_PAUSE_S, _FOREIGN_PAUSE_S = 1.0, 5.0, 10.0
_PATIENCE_S = 3.0
_WELL_S = 1.0
"""A slave that leaves OP sooner than this after its return has not recovered, s."""
_PROBE_S = 0.05
_POLL_S = 0.0003
_STEPS_S = 0.003
"""Time for restorations in one turn, s; several steps fit where a slave answers at once."""


class SlaveRecovery:
    """Carries out the table's action for each slave.

    Args:
        port: the port for registers.
        slaves: the slaves in the order of the cable.
        restorer: sets up a slave again.
        report: receives the messages.
        topology: the tree of the slaves.
    """

    def __init__(
        self,
        port: RegisterPort,
        slaves: Sequence[MonitoredSlave],
        restorer: SlaveRestorer,
        report: Callable[[str], None],
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
        if slave.asked is not None:
            action, state_then, error_then, until = slave.asked
            same = (state, error) == (state_then, error_then)
            if same and now < until:
                return
            slave.asked = None
            if same or (action in _REQUESTS and error):
                self._fail(slave, now, _REQUESTS.get(action, state))
                return
        if now < slave.pause_until:
            return
        action = action_for(state, error)
        if slave.kept and state is AlState.PREOP and not error:
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
            slave.asked = action, state, error, now + _PAUSE_S
            self.request(slave, state, acknowledge=True)
        else:
            slave.asked = action, state, error, now + _PATIENCE_S
            self.request(slave, _REQUESTS[action], acknowledge=error)

    def request(self, slave: MonitoredSlave, state: AlState, *, acknowledge: bool = False) -> bool:
        """Request `state` of a slave; return False where it certainly did not receive that."""
        word = state | (ERROR_BIT if acknowledge and not is_emulated(self._port, slave.station) else 0)
        data = word.to_bytes(2, "little")
        return self._port.exchange(DatagramCommand.FPWR, slave.station, Register.AL_CONTROL, data, tries=1).wkc != 0

    def note_fall(self, slave: MonitoredSlave, now: float) -> None:
        """Note that a slave left OP; one that does so repeatedly is brought back after pauses, and set up again."""
        if now - slave.back_at < _WELL_S:
            slave.flaps += 1
            slave.pause_until = now + min(_PAUSE_S * slave.flaps, _LONGEST_PAUSE_S)
        else:
            slave.flaps = 0
            slave.reported_at = LONG_AGO
        slave.failed = slave.flaps

    def _fail(self, slave: MonitoredSlave, now: float, wanted: AlState) -> None:
        slave.failed += 1
        slave.kept = False
        slave.pause_until = now + _PAUSE_S
        found = slave.state | (ERROR_BIT if slave.error else 0)
        self.report_limited(slave, refusal(slave.label, wanted, found, slave.code) + "; it is asked again every second")

    def _probe(self, slave: MonitoredSlave, now: float) -> None:
        """Look whether a slave that lost its address has come back to its place."""
        slave.asked = None
        slave.kept = False
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
        other = next((one for one in self._slaves if one.station == station), None)
        if other is None:
            self._start_restoration(slave, place)
        elif other is not slave:
            slave.pause_until = now + _PAUSE_S
            self.report_limited(
                slave, f"{slave.label}: at its place answers {other.label}: put the cables back in their order"
            )

    def _place_of(self, slave: MonitoredSlave) -> int | None:
        """Return at which place in the frame's way a lost slave would answer, from 1; None: it cannot be there now.

        Places count who answers. Whoever is lost and hangs at a slave that answers, behind a port with a link, is there
        without an address: the first of them in the frame's way gets one first, the places behind it are not known yet.
        """
        addressed = {other.position for other in self._slaves if other is not slave and self._has_address(other)}
        if self._reached <= len(addressed):
            return None
        for other in self._slaves:
            if other.position not in addressed and self._is_linked(other):
                return 1 + sum(position < slave.position for position in addressed) if other is slave else None
        return None

    def _has_address(self, slave: MonitoredSlave) -> bool:
        """Whether a slave answers at its own address, or at the one that its restoration has given it."""
        if slave.state is not AlState.NONE:
            return True
        if (
            slave.provisional
            and self._port.read(provisional_of(slave.position), Register.AL_STATUS, 2, tries=1) is None
        ):
            slave.provisional = False
        return slave.provisional

    def _is_linked(self, slave: MonitoredSlave) -> bool:
        """Whether the slave before it answers and has a link to it."""
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
        slave.asked = None
        slave.kept = False
        slave.unfinished = True
        slave.provisional = place is not None
        what = "it was without supply" if place is not None else f"it is in {slave.words()}"
        if slave.failed == 0 and slave.flaps == 0:
            self._report(f"{slave.label} is set up again: {what}")
        slave.work = self._restorer.restore(slave.position, place)

    def _continue_restoration(self, slave: MonitoredSlave, until: float) -> None:
        work = slave.work
        assert work is not None
        try:
            next(work)
            while time.monotonic() < until:
                time.sleep(_POLL_S)
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
            self.report_limited(slave, "; ".join(error.sentences))

    def drop(self, slave: MonitoredSlave) -> None:
        """Abandon the pending request or restoration of a slave."""
        slave.asked = None
        if slave.work is not None:
            slave.work.close()
            slave.work = None

    def report_limited(self, slave: MonitoredSlave, sentence: str) -> None:
        """Report something about a slave, at most every 10 s."""
        now = time.monotonic()
        if now - slave.reported_at >= REPORT_INTERVAL_S:
            slave.reported_at = now
            self._report(sentence)
