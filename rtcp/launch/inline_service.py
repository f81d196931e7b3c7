"""The service thread's part in simulated time: in turns, between two cycles, without a thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from rtcp.config.model import ArmConfig
from rtcp.control.bus_service import BusService
from rtcp.control.cycle import position_of
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.blackboard import Blackboard
from rtcp.launch.inprocess import InProcessBus

_WATCH_TURNS = 10
_ERROR_CODE = 0x603F
_ERROR_BIT = 0x10


class InlineService(BusService):
    """Does in turns of simulated time what the service thread does: the way to OP, to PRE-OP and back, the watch."""

    def __init__(self, bus: InProcessBus, blackboard: Blackboard, config: ArmConfig) -> None:
        positions = [position_of(config, axis) for axis in config.axes]
        names = [axis.name for axis in config.axes]
        super().__init__(cast(Any, bus), blackboard, positions, names, config.bus.op_timeout_s, 0, 1)
        self._segment = bus
        self._board = blackboard
        self._positions = positions
        self._names = names
        self._wanted: list[Callable[[], None]] = []
        self._op_asked = False
        self._axis = -1
        self.comes_back = True
        """Whether slaves that were lost come back when asked."""

    def want_op(self) -> None:
        """Ask for OP; may be said every cycle."""
        if not self._op_asked:
            self._op_asked = True
            self._wanted.append(self._start_all)

    def recover(self) -> None:
        """Ask for the slaves that left OP to be brought back."""
        self.all_op = False
        self._wanted.append(self._bring_back)

    def park(self) -> None:
        """Ask for all slaves to be taken to PRE-OP."""
        self.all_op = False
        self._wanted.append(self._park_all)

    def explain_drive(self, axis: int) -> None:
        """Ask for the drive's error code to be put into words."""
        self._axis = axis

    def take_turn(self, turn: int) -> None:
        """Do what was asked; now and then look at the slaves."""
        wanted, self._wanted = self._wanted, []
        for do in wanted:
            do()
        if self._axis >= 0:
            axis, self._axis = self._axis, -1
            code = int.from_bytes(self._segment.sdo_read(self._positions[axis], _ERROR_CODE, 0), "little")
            if code:
                self._board.text(f"{self._names[axis]}: the drive's error code is 0x{code:04X}")
        if turn % _WATCH_TURNS == 0:
            self._look()

    def _start_all(self) -> None:
        self._segment.request_state(AlState.OP)
        self._await_op()

    def _await_op(self) -> None:
        """Slaves enter OP with their next outputs and SYNC0."""
        self.refused = self._segment.wait_for_state(AlState.OP, 0.0)
        self.all_op = not self.refused
        if self.refused and not any(slave.error for slave in self._segment.slaves):
            self.refused = ()
            self._wanted.append(self._await_op)

    def _park_all(self) -> None:
        self._segment.request_state(AlState.PREOP)

    def _bring_back(self) -> None:
        if not self.comes_back:
            return
        bus = self._segment
        for slave in bus.slaves:
            if slave.error:
                bus.acknowledge(slave.position)
            if slave.state is AlState.PREOP:
                bus.request_state(AlState.SAFEOP, [slave.position])
            if slave.state is AlState.SAFEOP:
                bus.request_state(AlState.OP, [slave.position])
        if bus.wait_for_state(AlState.OP, 0.0):
            self._wanted.append(self._bring_back)
            return
        self.lost_slave = 0
        self.all_op = True

    def _look(self) -> None:
        for state in self._segment.read_states():
            self._board.slave(state.position, state.state | (_ERROR_BIT if state.error else 0), state.code)
            if self.all_op and state.state is not AlState.OP:
                self._board.text(f"slave {state.position} ({state.name}) left OP: it is in {state.words()}")
                self.all_op = False
                self.lost_slave = state.position
        for emergency in self._segment.emergencies():
            self._board.text(emergency.sentence(), is_problem=emergency.is_problem)
