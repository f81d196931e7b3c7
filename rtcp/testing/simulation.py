"""The loop on the in-process bus: the real parts of `rtcp.control` behind a real blackboard, in simulated time.

Configuration, seed and calls determine every result, to the bit.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

from rtcp.config.drive_limits import with_limits
from rtcp.config.model import ArmConfig
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.control.bus_service import BusService
from rtcp.control.cycle import Cycle, address_of, make_discipline, record_schema
from rtcp.control.partners import Partners
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.supervision import SupervisedBus
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.closing import Closing
from rtcp.ipc.commands import Command, Enable
from rtcp.ipc.events import SlavesLeftOp
from rtcp.ipc.layout import LEASE_DURATION_AT, LEASE_ID_AT, LEASE_RENEWED_AT
from rtcp.ipc.names import Names
from rtcp.ipc.observer import Answer, EventRecord, Observer
from rtcp.ipc.states import State
from rtcp.testing.bus import InProcessBus
from rtcp.virtual.arm import make_arm
from rtcp.virtual.descriptions import Descriptions
from rtcp.virtual.models import CubemarsDrive, DiewuIoBox

NAME = "inprocess"
"""Name of the bus."""
_SHARED_MEMORY = Path("/dev/shm")
_BEGIN_NS = 1_000_000_000
_POLL_NS = 10_000_000
_RENEWALS = 5
"""Renewals of a commander per lease duration."""


class Frame(NamedTuple):
    """Data on the bus in a cycle."""

    now_ns: int
    sent: tuple[bytes, ...]
    """Outputs of each slave."""
    heard: bool
    """Whether the outputs reached the slaves."""
    wkc: int
    """Working counter of the answer, -1: none."""
    received: tuple[bytes, ...]
    """Inputs of each slave in the last received answer."""


class Simulation(Closing):
    """An arm, its loop and a commander in one process; `cycle` runs one cycle.

    Args:
        config: the arm; its bus becomes `inprocess`, on which no limit is widened.
        seed: seed of the bus.
        positions: positions of the joints at power-on, rad, shape (n,); None: those of the segment's file.
        segment: the slaves; None: the configured segment.
        follow_clock: whether the loop follows the reference clock; if not, the start is 0.3 s shorter at 1 ms.
        partners: the arm's partners in a cell.

    Raises:
        ConfigError: the segment's file is invalid.
        BusError: the segment does not fit the configuration.
        ValueError: `positions` has not one number a joint.
    """

    def __init__(
        self,
        config: ArmConfig,
        seed: int = 0,
        *,
        positions: Sequence[float] | None = None,
        segment: SegmentConfig | None = None,
        follow_clock: bool = True,
        partners: Partners | None = None,
    ) -> None:
        self.config = config = replace(config, bus=replace(config.bus, interface=NAME))
        self.names = Names(config)
        self.period_ns = round(config.cycle.period_us * 1000)
        segment = load_segment(config.source.parent / config.bus.segment) if segment is None else segment
        devices = _devices(config, segment, positions)
        self.bus = InProcessBus(devices, seed, _BEGIN_NS)
        self.bus.segment.arm = make_arm(segment, devices)
        self.data = self.bus.configure(with_limits(config), self.period_ns)
        self.config = config = config.with_devices(self.bus.devices)
        self.models = [device for device in map(self._model, config.joints) if isinstance(device, CubemarsDrive)]
        self.box = next((s.device for s in self.bus.slaves if isinstance(s.device, DiewuIoBox)), None)
        memory = _SHARED_MEMORY if _SHARED_MEMORY.is_dir() else None
        directory = Path(tempfile.mkdtemp(prefix="rtcp-simulation-", dir=memory))
        # Also where this constructor fails, or nobody closes the simulation.
        self._remove = weakref.finalize(self, shutil.rmtree, directory, ignore_errors=True)
        self.path = path = directory / "blackboard"
        """File of the blackboard."""
        self.board = Blackboard(path, record_schema(config, partners), self.period_ns, is_resident=False)
        self.observer = Observer(path)
        self.service = InlineService(self.bus, self.board, config)
        discipline = make_discipline(config) if follow_clock else None
        self.now_ns = _BEGIN_NS
        self.loop = Cycle(config, self.data, self.board, self.service, discipline, lambda: self.now_ns, partners)
        # The phase of the cycle that the clock's discipline would reach.
        clock = self.now_ns + self.bus.offset_ns
        self._planned = self.now_ns - clock % self.period_ns + round((1 + config.ethercat.send_phase) * self.period_ns)
        self._poll_at = self.now_ns + _POLL_NS
        self._polls = 0
        self._renew_at = 0
        self._lease_ns = round(config.lease_s * 1e9)
        self.lease = 0
        """Lease of the commands; 0: none."""
        self.on_frame: Callable[[Frame], None] | None = None
        """Called after each cycle."""
        self.before_cycle: Callable[[], None] | None = None
        """Called before each cycle."""

    def close(self) -> None:
        """Close the blackboard and remove its file; may be called again."""
        self.observer.close()
        # A remaining view keeps the mapping, not the file.
        with contextlib.suppress(BufferError):
            self.board.close()
        self._remove()

    def unlink(self) -> None:
        """Remove the blackboard's file, which both ends have open: a process that is killed leaves none behind."""
        self._remove()

    def _model(self, joint: Any) -> object:
        slot = next(slot for slot, slave in enumerate(self.config.slaves) if slave.name == joint.slave)
        return self.bus.slaves[slot].device

    @property
    def state(self) -> State:
        """The machine's state."""
        return self.loop.machine.state

    @property
    def done(self) -> bool:
        """Whether the loop has ended."""
        return self.loop.machine.closed

    @property
    def events(self) -> list[EventRecord]:
        """Events on the blackboard, oldest first."""
        return self.observer.events_since(0)

    # -- time -------------------------------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Run one cycle."""
        if self.before_cycle is not None:
            self.before_cycle()
        now = self.now_ns = self._planned
        self.bus.advance_to(now)
        if now >= self._poll_at:
            self._poll_at += _POLL_NS
            self._polls += 1
            self.service.take_turn(self._polls)
        if self.lease and now >= self._renew_at:
            self._renew_at = now + self._lease_ns // _RENEWALS
            self.board.words[LEASE_RENEWED_AT] = now
        data, watcher = self.data, self.on_frame
        if watcher is None:
            self._planned = self.loop.cycle(now, now)
            return
        sent = tuple(data.outputs)
        self._planned = self.loop.cycle(now, now)
        watcher(Frame(now, sent, data.heard, data.wkc, tuple(data.inputs)))

    @property
    def due_ns(self) -> int:
        """Instant of the next cycle, ns."""
        return self._planned

    def run(self, seconds: float) -> None:
        """Run the cycles of this time, s."""
        until = self.now_ns + round(seconds * 1e9)
        while self._planned <= until:
            self.cycle()

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Run until `condition`, at most `seconds`; return whether it was met."""
        end = self.now_ns + round(seconds * 1e9)
        while not condition():
            if self._planned > end:
                return False
            self.cycle()
        return True

    # -- a commander ------------------------------------------------------------------------------------------------

    def hold(self) -> None:
        """Bring the arm from power-on to holding, under a lease."""
        self.bring_to(State.READY)
        self.acquire()
        self.do(Enable())
        self.bring_to(State.HOLDING)

    def bring_to(self, state: State, seconds: float = 5.0) -> None:
        """Run until the machine is in a state.

        Raises:
            RuntimeError: it is not reached; with the last events.
        """
        if not self.until(lambda: self.state is state, seconds):
            last = [self.names.message(record.event) for record in self.events[-1:]]
            raise RuntimeError(f"not in state {state.words} after {seconds:g} s, but {self.state.words} {last}")

    def do(self, command: Command) -> None:
        """Send a command.

        Raises:
            RuntimeError: it is refused, with the reason.
        """
        if refusal := self.send(command).refusal:
            raise RuntimeError(self.names.message(refusal))

    def acquire(self) -> None:
        """Acquire a lease, renewed from now on."""
        words = self.board.words
        words[LEASE_ID_AT] = 0
        words[LEASE_DURATION_AT] = self._lease_ns
        words[LEASE_RENEWED_AT] = self.now_ns
        words[LEASE_ID_AT] = self.lease = self.now_ns
        self._renew_at = 0

    def fall_silent(self) -> None:
        """Stop the renewal of the lease; commands under it are accepted until it expires, and then refused."""
        self._renew_at = 1 << 62

    def send(self, command: Command, lease: int | None = None) -> Answer:
        """Send a command, run one cycle and return the answer."""
        number = self.observer.command(self.lease if lease is None else lease, command)
        self.cycle()
        answer = self.observer.answer(number)
        if answer is None:
            raise RuntimeError(f"the loop did not answer {command.name}")
        return answer


def _devices(config: ArmConfig, segment: SegmentConfig, positions: Sequence[float] | None) -> list[Any]:
    options = [dict(slave.options) for slave in segment.slaves]
    slots = {slave.name: slot for slot, slave in enumerate(config.slaves)}
    if positions is not None and len(positions) != len(config.joints):
        raise ValueError(f"positions: found {len(positions)} numbers, allowed are {len(config.joints)}: one a joint")
    for joint, position in zip(config.joints, positions or (), strict=False):
        slot = slots[joint.slave]
        if slot >= len(options):
            break  # the bus says that slaves are missing
        of_axis = "" if segment.slaves[slot].model else f"axis{joint.axis}_"
        options[slot][f"{of_axis}initial_position"] = position
    descriptions = Descriptions(segment.source.parent)
    return [
        descriptions.make(replace(slave, options=chosen)) for slave, chosen in zip(segment.slaves, options, strict=True)
    ]


_WATCH_POLLS = 10


class _InlineMaster(Master):
    """The in-process bus, which the simulation starts itself."""

    def __init__(self, config: ArmConfig, bus: InProcessBus) -> None:
        super().__init__(config, NAME, 0)
        self._bus = bus

    @staticmethod
    def check_interface(name: str) -> None:
        """Accept every name: no interface is opened."""

    @property
    def supervised(self) -> SupervisedBus:
        """The virtual slaves."""
        return cast(SupervisedBus, self._bus)

    def start(self, directory: Path, report: Callable[[str], None]) -> ProcessData:
        """Bring the slaves to SAFE-OP."""
        data = self._bus.configure(self.config.slaves, round(self.config.cycle.period_us * 1000))
        self.config = self.config.with_devices(self._bus.devices)
        return data

    def close(self) -> None:
        """Do nothing: there is no interface."""


class InlineService(BusService):
    """The service thread's work, polled in simulated time: transitions to OP, to PRE-OP and back, supervision."""

    def __init__(self, bus: InProcessBus, blackboard: Blackboard, config: ArmConfig) -> None:
        addresses = [address_of(config, axis) for axis in config.axes]
        master = _InlineMaster(config, bus)
        super().__init__(master, blackboard, addresses, config.bus.op_timeout_s, 0, 1)
        self._segment = bus
        self._board = blackboard
        self._wanted: list[Callable[[], None]] = []
        self._op_asked = False
        self.comes_back = True
        """Whether lost slaves come back on request."""

    def want_op(self) -> None:
        """Request OP; may be called every cycle."""
        if not self._op_asked:
            self._op_asked = True
            self._wanted.append(self._start_all)

    def recover(self) -> None:
        """Request the recovery of slaves that left OP."""
        self.all_op = False
        self._wanted.append(self._bring_back)

    def park(self) -> None:
        """Request PRE-OP of all slaves."""
        self.all_op = False
        self._wanted.append(self._park_all)

    def take_turn(self, poll: int) -> None:
        """Carry out the requests; every `_WATCH_POLLS` polls read the states of the slaves."""
        wanted, self._wanted = self._wanted, []
        for do in wanted:
            do()
        self._serve_sdo_requests(poll)
        if poll % _WATCH_POLLS == 0:
            self._poll_states()

    def _start_all(self) -> None:
        self._segment.request_state(AlState.OP)
        self._await_op()

    def _await_op(self) -> None:
        """Wait for OP, which slaves enter with their next outputs and SYNC0."""
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

    def _poll_states(self) -> None:
        for state in self._segment.read_states():
            self._board.slave(state.position, state.al_status, state.code)
            if self.all_op and state.state is not AlState.OP:
                at = state.position
                self._board.event(SlavesLeftOp(at, at, state.al_status, state.code, at - 1, 1))
                self.all_op = False
                self.lost_slave = state.position
        for emergency in self._segment.emergencies():
            self._board.event(emergency)
