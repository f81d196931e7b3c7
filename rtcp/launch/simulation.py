"""The loop on the in-process bus: the real parts of `rtcp.control` behind a real blackboard, in simulated time.

Everything that happens follows from the configuration, the seed and the calls, to the bit.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, cast

from rtcp.config.model import ArmConfig
from rtcp.config.scaling import OBJECTS_PER_AXIS
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.control.bus_service import BusService
from rtcp.control.cycle import Cycle, address_of, make_discipline, record_schema
from rtcp.control.partners import Partners
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.errors import SdoAborted
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.supervision import SupervisedBus
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import Command
from rtcp.ipc.layout import LEASE_DURATION_AT, LEASE_ID_AT, LEASE_RENEWED_AT
from rtcp.ipc.observer import Answer, EventRecord, Observer
from rtcp.ipc.states import State
from rtcp.launch.inprocess import InProcessBus
from rtcp.virtual.arm import make_arm
from rtcp.virtual.descriptions import Descriptions
from rtcp.virtual.models import CubemarsDrive, DiewuIoBox

NAME = "inprocess"
"""Name of the bus."""
_SHARED_MEMORY = Path("/dev/shm")
_BEGIN_NS = 1_000_000_000
_TURN_NS = 10_000_000
_RENEWALS = 5
"""A commander renews its lease so many times as often as it runs out."""


class Frame(NamedTuple):
    """What went over the bus in a cycle."""

    now_ns: int
    sent: tuple[bytes, ...]
    """Outputs of each slave."""
    heard: bool
    """Whether they reached the slaves."""
    wkc: int
    """Working counter of the answer, -1 without one."""
    received: tuple[bytes, ...]
    """Inputs of each slave, of the last answer that came."""


class Simulation:
    """An arm, its loop and a commander in one process; `cycle` lets one cycle pass.

    Args:
        config: the arm; its bus becomes `inprocess`, on which no limit is widened.
        seed: of what is left to chance on the bus.
        positions: rad, shape (n,), where the joints stand at power-on; None: as the segment's file says.
        segment: the slaves; None: the segment that the configuration names.
        follow_clock: whether the loop follows the reference clock; without, the start is 0.3 s shorter at 1 ms.
        partners: of the arm in a cell.

    Raises:
        ConfigError: of the segment's file.
        BusError: the segment does not fit the configuration.
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
        self.period_ns = round(config.cycle.period_us * 1000)
        segment = load_segment(config.source.parent / config.bus.segment) if segment is None else segment
        devices = _devices(config, segment, positions)
        self.bus = InProcessBus(devices, seed, _BEGIN_NS)
        self.bus.segment.arm = make_arm(segment, devices)
        self.data = self.bus.configure(config.slaves, self.period_ns)
        self.models = [device for device in map(self._model, config.joints) if isinstance(device, CubemarsDrive)]
        self.box = next((s.device for s in self.bus.slaves if isinstance(s.device, DiewuIoBox)), None)
        memory = _SHARED_MEMORY if _SHARED_MEMORY.is_dir() else None
        self._directory = Path(tempfile.mkdtemp(prefix="rtcp-simulation-", dir=memory))
        self.path = path = self._directory / "blackboard"
        """File of the blackboard."""
        self.board = Blackboard(path, record_schema(config, partners), self.period_ns)
        self.observer = Observer(path)
        self.service = InlineService(self.bus, self.board, config)
        discipline = make_discipline(config) if follow_clock else None
        self.now_ns = _BEGIN_NS
        self.loop = Cycle(config, self.data, self.board, self.service, discipline, lambda: self.now_ns, partners)
        # The instant in the cycle that the clock's discipline would have found.
        shown = self.now_ns + self.bus.offset_ns
        self._planned = self.now_ns - shown % self.period_ns + round((1 + config.ethercat.send_phase) * self.period_ns)
        self._turn_at = self.now_ns + _TURN_NS
        self._turns = 0
        self._renew_at = 0
        self._lease_ns = round(config.lease_s * 1e9)
        self.lease = 0
        """The lease that commands are given under; 0: none is held."""
        self.on_frame: Callable[[Frame], None] | None = None
        """Called after each cycle."""

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:  # fmt: skip
        self.close()

    def close(self) -> None:
        """Free the memory."""
        self.observer.close()
        # Whoever still holds a view of it keeps the mapping, not the file.
        with contextlib.suppress(BufferError):
            self.board.close()
        shutil.rmtree(self._directory, ignore_errors=True)

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
        """What happened, oldest first, as far as the blackboard remembers."""
        return self.observer.events_since(0)

    # -- time -------------------------------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Let one cycle pass."""
        now = self.now_ns = self._planned
        self.bus.advance_to(now)
        if now >= self._turn_at:
            self._turn_at += _TURN_NS
            self._turns += 1
            self.service.take_turn(self._turns)
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
        """When the next cycle is due."""
        return self._planned

    def run(self, seconds: float) -> None:
        """Let so much time pass, in whole cycles."""
        until = self.now_ns + round(seconds * 1e9)
        while self._planned <= until:
            self.cycle()

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Let time pass until `condition`, at most `seconds`; return whether it came."""
        end = self.now_ns + round(seconds * 1e9)
        while not condition():
            if self._planned > end:
                return False
            self.cycle()
        return True

    # -- a commander ------------------------------------------------------------------------------------------------

    def acquire(self) -> None:
        """Acquire a lease, renewed from now on."""
        words = self.board.words
        words[LEASE_ID_AT] = 0
        words[LEASE_DURATION_AT] = self._lease_ns
        words[LEASE_RENEWED_AT] = self.now_ns
        words[LEASE_ID_AT] = self.lease = self.now_ns
        self._renew_at = 0

    def fall_silent(self) -> None:
        """Renew the lease no longer; commands are still given under it until it has run out, and then refused."""
        self._renew_at = 1 << 62

    def send(self, command: Command, lease: int | None = None) -> Answer:
        """Send a command, let one cycle pass and return the answer."""
        number = self.observer.command(self.lease if lease is None else lease, command)
        self.cycle()
        answer = self.observer.answer(number)
        if answer is None:
            raise RuntimeError(f"the loop did not answer {command.name}")
        return answer


def _devices(config: ArmConfig, segment: SegmentConfig, positions: Sequence[float] | None) -> list[Any]:
    options = [dict(slave.options) for slave in segment.slaves]
    slots = {slave.name: slot for slot, slave in enumerate(config.slaves)}
    for joint, position in zip(config.joints, positions or (), strict=False):
        slot = slots[joint.slave]
        of_axis = "" if segment.slaves[slot].model else f"axis{joint.axis}_"
        options[slot][f"{of_axis}initial_position"] = position
    descriptions = Descriptions(segment.source.parent)
    return [
        descriptions.make(replace(slave, options=chosen)) for slave, chosen in zip(segment.slaves, options, strict=True)
    ]


_WATCH_TURNS = 10
_ERROR_CODE = 0x603F
_ERROR_BIT = 0x10


class _InlineMaster(Master):
    """The in-process bus, which the simulation starts itself."""

    def __init__(self, config: ArmConfig, bus: InProcessBus) -> None:
        super().__init__(config, NAME, 0)
        self._bus = bus

    @staticmethod
    def check_interface(name: str) -> None:
        """Accept every name: none is opened."""

    @property
    def supervised(self) -> SupervisedBus:
        """The virtual slaves."""
        return cast(SupervisedBus, self._bus)

    def start(self, directory: Path, report: Callable[[str], None]) -> ProcessData:
        """Bring the slaves to SAFE-OP."""
        return self._bus.configure(self.config.slaves, round(self.config.cycle.period_us * 1000))

    def close(self) -> None:
        """Do nothing: the simulation keeps no wire open."""


class InlineService(BusService):
    """Does in turns of simulated time what the service thread does: the way to OP, to PRE-OP and back, the watch."""

    def __init__(self, bus: InProcessBus, blackboard: Blackboard, config: ArmConfig) -> None:
        addresses = [address_of(config, axis) for axis in config.axes]
        names = [axis.name for axis in config.axes]
        master = _InlineMaster(config, bus)
        super().__init__(master, blackboard, addresses, names, config.bus.op_timeout_s, 0, 1)
        self._segment = bus
        self._board = blackboard
        self._addresses = addresses
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
            position, of_slave = self._addresses[axis]
            index, code = _ERROR_CODE + (of_slave - 1) * OBJECTS_PER_AXIS, 0
            with contextlib.suppress(SdoAborted):
                code = int.from_bytes(self._segment.sdo_read(position, index, 0), "little")
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
