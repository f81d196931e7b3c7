"""The bus `inprocess`: the device models without sockets and frames, in simulated time, the same in every run.

It offers what `rtcp.fieldbus.bus` describes (Bus, ProcessData) and shares no code with it: states, facts and errors are
types of this side with the same fields. One exchange: outputs reach the slaves' buffers, inputs that were there before
come back; at the SYNC0 that follows, the drives take their outputs over and step by one cycle; a slave without SYNC0
does so right after the frame. Watchdog, sync error counter and the working counter of a slave that left OP are as on
the wire. Left out: drift and delay of the clocks (all show the simulated time and one offset), and the time that
services take: state changes and SDO are done when asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from random import Random
from typing import NamedTuple

from rtcp.config.model import SlaveConfig
from rtcp.launch.inprocess_data import InProcessData
from rtcp.launch.inprocess_slave import InProcessError, InProcessSlave, identity_faults
from rtcp.virtual.al_state import AlStatusCode
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.protocol import State

_EPOCH_NS = 1_000_000_000
"""The reference clock shows at least this at the start of time."""


class SlaveFacts(NamedTuple):
    """What a scan tells of a slave."""

    position: int
    name: str
    vendor_id: int
    product_code: int
    revision: int
    serial: int
    state: str
    has_coe: bool
    output_bits: int
    input_bits: int
    dc: bool


class SlaveState(NamedTuple):
    """What a slave's AL status says."""

    position: int
    station: int
    name: str
    state: State
    error: bool
    code: int

    def words(self) -> str:
        """Return state and code in words."""
        name = self.state.name.replace("_", "-")
        return f"{name} + ERROR (0x{self.code:04X})" if self.error else name


class Emergency(NamedTuple):
    """An emergency message as it came from a slave."""

    position: int
    name: str
    error_code: int
    error_register: int
    data: bytes

    def sentence(self) -> str:
        """Return the message in words."""
        return f"slave {self.position} ({self.name}) sent emergency 0x{self.error_code:04X}"


class InProcessBus:
    """A segment and its master in one object; whoever uses it moves the time by `advance_to` between two exchanges.

    Args:
        devices: the models in the order of the cable.
        seed: of what is left to chance: the reference clock's offset, and which way a lost frame was going.
        now_ns: the instant at which time begins.
    """

    def __init__(self, devices: Sequence[DeviceModel], seed: int = 0, now_ns: int = 0) -> None:
        self.slaves = [InProcessSlave(device, position) for position, device in enumerate(devices, 1)]
        self._random = Random(seed)
        self.notes: list[str] = []
        self.now_ns = now_ns
        self.offset_ns = _EPOCH_NS + self._random.randrange(_EPOCH_NS)
        """Reference clock less simulated time."""
        self._data: InProcessData | None = None

    # -- Bus --------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Nothing is to be opened."""

    def scan(self) -> tuple[SlaveFacts, ...]:
        """Bring the slaves to PRE-OP and tell what is known of them."""
        self.request_state(State.PRE_OP)
        return tuple(map(_facts, self.slaves))

    def configure(self, slaves: Sequence[SlaveConfig], period_ns: int) -> InProcessData:
        """Compare the slaves with `slaves`, set them up, bring them to SAFE-OP with outputs of zero.

        Raises:
            InProcessError: what is on the bus differs from the configuration, or a slave refuses.
        """
        if faults := identity_faults(self.slaves, slaves):
            raise InProcessError(*faults)
        self.request_state(State.PRE_OP)
        self.notes = [
            note
            for slave, config in zip(self.slaves, slaves, strict=True)
            for note in slave.configure(config, period_ns)
        ]
        self.request_state(State.SAFE_OP)
        self._data = InProcessData(self.slaves, period_ns, self.now_ns, self.offset_ns, self._random)
        return self._data

    def request_state(self, state: int, positions: Iterable[int] | None = None) -> None:
        """Request `state` of the slaves at `positions`, None: of all; what can be done is done at once."""
        for slave in self._at(positions):
            slave.request(State(int(state)), self._data is not None and self._data.fed(slave))
        self._changed()

    def wait_for_state(self, state: int, timeout_s: float, positions: Iterable[int] | None = None) -> tuple[str, ...]:
        """Return a sentence for each slave that is not in `state`; no time passes."""
        wanted = State(int(state))
        return tuple(
            f"{slave.label} is in {_state(slave).words()}, {wanted.name.replace('_', '-')} was requested"
            for slave in self._at(positions)
            if slave.state != wanted or slave.error
        )

    def acknowledge(self, position: int) -> None:
        """Acknowledge a slave's error: it stays in the state that it is in, without the error indication."""
        self._slave(position).acknowledge()
        self._changed()

    def read_states(self) -> tuple[SlaveState, ...]:
        """Return what every slave's AL status says."""
        return tuple(map(_state, self.slaves))

    def emergencies(self) -> tuple[Emergency, ...]:
        """Return the emergency messages that came since the last call."""
        found = []
        for slave in self.slaves:
            waiting = slave.device.emergencies
            while waiting:
                one = waiting.popleft()
                found.append(Emergency(slave.position, slave.name, one.error_code, one.error_register, one.data))
        return tuple(found)

    def sdo_read(self, position: int, index: int, subindex: int) -> bytes:
        """Return an object's value; raises InProcessError, with the abort code where the slave refused."""
        return self._slave(position).read(index, subindex)

    def sdo_write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object's value; raises as `sdo_read`."""
        self._slave(position).write(index, subindex, data)

    def close(self) -> None:
        """Bring the slaves back to INIT; may be called at any time, also twice."""
        self.request_state(State.INIT)

    # -- time and mishaps -------------------------------------------------------------------------------------------

    def advance_to(self, now_ns: int) -> None:
        """Let time pass up to `now_ns`: every SYNC0 on the way steps its drives."""
        if self._data is not None:
            self._data.pass_time(now_ns)
        self.now_ns = max(now_ns, self.now_ns)

    def drop(self, position: int, state: int, code: int) -> None:
        """Let a slave leave its state by itself, with an AL status code."""
        slave = self._slave(position)
        slave.fall(State(state), AlStatusCode(code))
        self._changed()

    def _changed(self) -> None:
        if self._data is not None:
            self._data.count()

    def _slave(self, position: int) -> InProcessSlave:
        if not 1 <= position <= len(self.slaves):
            raise InProcessError(f"there is no slave {position}; the bus has slaves 1 to {len(self.slaves)}")
        return self.slaves[position - 1]

    def _at(self, positions: Iterable[int] | None) -> list[InProcessSlave]:
        return self.slaves if positions is None else [self._slave(position) for position in positions]


def _facts(slave: InProcessSlave) -> SlaveFacts:
    identity = slave.device.identity
    return SlaveFacts(
        slave.position, identity.name, identity.vendor_id, identity.product_code, identity.revision, identity.serial,
        _state(slave).words(), True, 8 * slave.output_bytes, 8 * slave.input_bytes, slave.device.supports_dc,
    )  # fmt: skip


def _state(slave: InProcessSlave) -> SlaveState:
    return SlaveState(slave.position, 0x1000 + slave.position, slave.name, slave.state, slave.error, int(slave.code))
