"""The bus as the platform sees it: its operations, the process data, and the description of each slave."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.al_state import AlState, code_meaning, code_remedy, state_name
from rtcp.fieldbus.emergency import Emergency
from rtcp.fieldbus.topology import PortState


@dataclass(frozen=True)
class PdoEntryInfo:
    """An entry of a PDO as the slave reports it; index 0 is padding."""

    index: int
    sub_index: int
    bits: int
    name: str
    """Name in the slave's object dictionary; empty where it has none."""


@dataclass(frozen=True)
class PdoInfo:
    """A PDO that is assigned to a sync manager, and what is mapped into it."""

    index: int
    entries: tuple[PdoEntryInfo, ...]

    @property
    def bits(self) -> int:
        """Length in bits."""
        return sum(entry.bits for entry in self.entries)


PORTS = 4
LARGEST_MAILBOX = 1486
"""Bytes of a mailbox that one datagram carries, and that SOEM has room for."""


@dataclass(frozen=True)
class PortErrors:
    """What each of a slave's ports has counted."""

    rx: list[int] = field(default_factory=lambda: [0] * PORTS)
    """Damaged frames that came in over the cable of that port."""
    forwarded: list[int] = field(default_factory=lambda: [0] * PORTS)
    """Damaged frames that somebody before it has already counted."""
    links: list[int] = field(default_factory=lambda: [0] * PORTS)
    """Lost links."""


@dataclass(frozen=True)
class MailboxInfo:
    """The mailbox according to the SII (ETG.1000.6, 5.4: words 0x18 to 0x1C)."""

    receive_start: int
    receive_size: int
    send_start: int
    send_size: int
    protocols: tuple[str, ...]

    @property
    def has_coe(self) -> bool:
        """Whether it speaks CoE, and its messages fit."""
        return "CoE" in self.protocols and self.fits

    @property
    def fits(self) -> bool:
        """Whether a datagram carries its messages."""
        return max(self.receive_size, self.send_size) <= LARGEST_MAILBOX


@dataclass(frozen=True)
class SyncManagerInfo:
    """A sync manager's registers (ETG.1000.4, 6.7)."""

    number: int
    start: int
    length: int
    control: int
    enabled: bool


@dataclass(frozen=True)
class SlaveInfo:
    """What is known of a slave from its registers, its EEPROM and its object dictionary."""

    position: int
    """Position on the cable, from 1."""
    station: int
    """Configured station address."""
    name: str
    vendor_id: int
    product_code: int
    revision: int
    serial: int
    alias: int
    state: str
    """AL state in words."""
    al_status_code: int
    al_status: str
    """The AL status code in words."""
    has_coe: bool
    mailbox: MailboxInfo | None
    outputs: tuple[PdoInfo, ...]
    """RxPDOs assigned through 0x1C12."""
    inputs: tuple[PdoInfo, ...]
    """TxPDOs assigned through 0x1C13."""
    output_bits: int
    input_bits: int
    sync_managers: tuple[SyncManagerInfo, ...]
    fmmus: int
    """Number of FMMUs of its ESC."""
    dc: bool
    """Whether it has a distributed clock."""
    delay_ns: int
    """Propagation delay from the reference clock, as measured."""
    ports: tuple[PortState, ...]
    """Ports 0 to 3."""
    parent: int
    """Position of the slave before it; 0: the master."""
    parent_port: int
    """Port of that slave at which it hangs."""
    port_errors: PortErrors
    """Error counters of its ports since its power-on, each up to 255."""
    watchdog_off: tuple[int, ...] = ()
    """Sync managers whose outputs do not trigger the process-data watchdog by its EEPROM; `configure` lets them."""


@dataclass(frozen=True)
class SlaveState:
    """AL status of a slave; `state` is 0 (`AlState.NONE`) where it does not answer."""

    position: int
    station: int
    name: str
    state: AlState
    error: bool
    """Error indication: the slave left a state on its own or refused one."""
    code: int
    """AL status code."""

    def words(self) -> str:
        """Return state and code in words, with what to do about it where that is known."""
        text = state_name(self.state | (0x10 if self.error else 0))
        if not self.error:
            return text
        remedy = code_remedy(self.code)
        return f"{text} (0x{self.code:04X}: {code_meaning(self.code)})" + (f"; {remedy}" if remedy else "")


class ProcessData(Protocol):
    """The process image, exchanged once a cycle; only `Bus.configure` makes one."""

    expected_wkc: int
    """Working counter of an exchange in which every slave took part."""
    dc_time: int
    """System time (ns) of the reference clock when the last received frame passed it."""
    missed: int
    """Exchanges without an answer in time, since the start."""
    stale: int
    """Late frames that were thrown away, since the start."""

    def send(self) -> None:
        """Send the outputs that were set."""

    def receive(self) -> int:
        """Wait a fraction of the period for the answer; return its working counter, -1 where none came."""

    def input(self, index: int) -> bytes:
        """Return the inputs of slave `index` (from 0, in the order of the configuration) of the last answer."""

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of slave `index`; data of another length is not taken, the former outputs stay."""


class Bus(Protocol):
    """A segment and its master. Every method raises BusError where the bus or a slave does not do what was asked."""

    notes: list[str]
    """Deviations that `configure` tolerated, in sentences."""

    def open(self) -> None:
        """Open the bus."""

    def scan(self) -> tuple[SlaveInfo, ...]:
        """Find the slaves, bring them to PRE-OP and return their descriptions."""

    def configure(self, slaves: Sequence[SlaveConfig], period_ns: int) -> ProcessData:
        """Compare the slaves with `slaves`, set them up, bring them to SAFE-OP with outputs of zero."""

    def request_state(self, state: AlState, positions: Iterable[int] | None = None) -> None:
        """Request `state` of the slaves at `positions`, None: of all; nothing is waited for."""

    def wait_for_state(
        self, state: AlState, timeout_s: float, positions: Iterable[int] | None = None
    ) -> tuple[str, ...]:
        """Wait until the slaves are in `state`; return a sentence for each that is not."""

    def acknowledge(self, position: int) -> None:
        """Acknowledge a slave's error: it stays in the state that it is in, without the error indication."""

    def read_states(self) -> tuple[SlaveState, ...]:
        """Return the AL status of every slave."""

    def emergencies(self) -> tuple[Emergency, ...]:
        """Return the emergency messages that came since the last call."""

    def sdo_read(self, position: int, index: int, subindex: int) -> bytes:
        """Return an object's value."""

    def sdo_write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object's value."""

    def close(self) -> None:
        """Bring the slaves back to INIT, switch SYNC off, close the bus; may be called at any time, also twice."""


def slave_label(position: int, name: str) -> str:
    """Return how sentences name a slave."""
    return f"slave {position} ({name})"


def station_of(position: int) -> int:
    """Return the configured address that SOEM gives the slave at `position` (EC_NODEOFFSET)."""
    return 0x1000 + position
