"""Interface of a bus: its operations, the process data, and the description of each slave."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.topology import PortState
from rtcp.ipc.codes import ERROR_BIT, status_words
from rtcp.ipc.events import EmergencyMessage


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
    """A PDO that is assigned to a sync manager, and its entries."""

    index: int
    entries: tuple[PdoEntryInfo, ...]

    @property
    def bits(self) -> int:
        """Length in bits."""
        return sum(entry.bits for entry in self.entries)


PORTS = 4
LARGEST_MAILBOX = 1486
"""Largest mailbox that fits one datagram and SOEM's buffers, bytes."""


@dataclass(frozen=True)
class PortErrors:
    """Error counters of a slave, one for each port."""

    rx: list[int] = field(default_factory=lambda: [0] * PORTS)
    """Damaged frames received over the cable of that port."""
    forwarded: list[int] = field(default_factory=lambda: [0] * PORTS)
    """Damaged frames that a slave before it has already counted."""
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
    of_sync_managers: bool = False
    """True: words 0x18 to 0x1B have no sizes, and those of the EEPROM's sync managers are used."""

    @property
    def has_coe(self) -> bool:
        """Whether it supports CoE, and its messages fit a datagram."""
        return "CoE" in self.protocols and self.fits

    @property
    def fits(self) -> bool:
        """Whether its messages fit a datagram."""
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
    """Description of a slave from its registers, its EEPROM and its object dictionary."""

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
    delay_ns: int | None
    """Propagation delay from the reference clock, as measured; None: it has no clock, or was not measured."""
    ports: tuple[PortState, ...]
    """Ports 0 to 3."""
    parent: int
    """Position of the slave before it; 0: the master."""
    parent_port: int
    """Port of the parent at which it hangs."""
    port_errors: PortErrors
    """Error counters of its ports since its power-on, each up to 255."""
    watchdog_off: tuple[int, ...] = ()
    """Sync managers whose outputs do not trigger the process-data watchdog by its EEPROM; `configure` corrects that."""


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

    @property
    def al_status(self) -> int:
        """State and error indication as in the register."""
        return self.state | (ERROR_BIT if self.error else 0)

    def words(self) -> str:
        """Return state and code in words, with a remedy where one is known."""
        return status_words(self.al_status, self.code)


class ProcessData(Protocol):
    """The process image, exchanged once a cycle; only `Bus.configure` makes one."""

    expected_wkc: int
    """Working counter of an exchange in which every slave took part."""
    dc_time: int
    """System time (ns) of the reference clock when the last received frame passed it."""
    missed: int
    """Exchanges without an answer in time, since the start."""
    stale: int
    """Late frames that were dropped, since the start."""

    def send(self) -> None:
        """Send the outputs."""

    def receive(self) -> int:
        """Wait a fraction of the period for the answer; return its working counter, -1: no answer."""

    def input(self, index: int) -> bytes:
        """Return the inputs of slave `index` (from 0, in the order of the configuration) of the last answer."""

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of slave `index`; data of another length is ignored."""


class Bus(Protocol):
    """A segment and its master. Every method raises BusError where the bus or a slave refuses or does not answer."""

    notes: list[str]
    """Deviations that `configure` tolerated, in sentences."""

    def open(self) -> None:
        """Open the bus."""

    def scan(self) -> tuple[SlaveInfo, ...]:
        """Find the slaves, bring them to PRE-OP and return their descriptions."""

    def configure(self, slaves: Sequence[SlaveConfig], period_ns: int) -> ProcessData:
        """Compare the segment with `slaves`, set the slaves up, bring them to SAFE-OP with all outputs 0."""

    def request_state(self, state: AlState, positions: Iterable[int] | None = None) -> None:
        """Request `state` of the slaves at `positions`, None: of all; does not wait."""

    def wait_for_state(
        self, state: AlState, timeout_s: float, positions: Iterable[int] | None = None
    ) -> tuple[str, ...]:
        """Wait until the slaves are in `state`; return a sentence for each that is not."""

    def acknowledge(self, position: int) -> None:
        """Acknowledge a slave's error: clears the error indication, keeps the state."""

    def read_states(self) -> tuple[SlaveState, ...]:
        """Return the AL status of every slave."""

    def emergencies(self) -> tuple[EmergencyMessage, ...]:
        """Return the emergency messages that came since the last call."""

    def close(self) -> None:
        """Bring the slaves back to INIT, switch SYNC off, close the bus; may be called at any time, also twice."""


def slave_label(position: int, name: str) -> str:
    """Return the label of a slave in messages."""
    return f"slave {position} ({name})"


def station_of(position: int) -> int:
    """Return the configured address that SOEM gives the slave at `position` (EC_NODEOFFSET)."""
    return 0x1000 + position
