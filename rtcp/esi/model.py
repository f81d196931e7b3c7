"""The description of a device, from an ESI file, an SII image, or a scan of the bus.

Terms are those of ETG.2000 (ESI) and ETG.1000.6. Lengths in bits unless a field says otherwise, times in ns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum


class EsiError(Exception):
    """A description that cannot be read, written or assembled; `origin` is the file and line, or the device."""

    def __init__(self, origin: str, problem: str) -> None:
        super().__init__(f"{origin}: {problem}")
        self.origin = origin
        self.problem = problem


class LookupFailure(EsiError):
    """No device, or several, match; `candidates` lists those that match, or where there are none the existing ones."""

    def __init__(self, origin: str, problem: str, candidates: tuple[str, ...], several: bool) -> None:
        super().__init__(origin, problem)
        self.candidates = candidates
        self.several = several


class Source(Enum):
    """Source of a description."""

    ESI = "ESI"
    SII = "SII"
    BUS = "bus"


class SyncManagerType(IntEnum):
    """Use of a sync manager (ETG.1000.6, 5.6.7.4; same numbers in the SII)."""

    UNUSED = 0
    MAILBOX_RECEIVE = 1
    """The master writes, the slave receives."""
    MAILBOX_SEND = 2
    OUTPUTS = 3
    INPUTS = 4


class FmmuUse(IntEnum):
    """Use of an FMMU (ETG.1000.6, table 23)."""

    UNUSED = 0
    OUTPUTS = 1
    INPUTS = 2
    MAILBOX_STATE = 3


class ObjectCode(IntEnum):
    """Kinds of CoE objects (ETG.1000.6, table 62)."""

    VARIABLE = 7
    ARRAY = 8
    RECORD = 9


@dataclass(frozen=True)
class Identity:
    """Identity of a device, object 0x1018."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int = 0


@dataclass(frozen=True)
class SyncManager:
    """A sync manager's default setting (ETG.1000.4, 6.7.2)."""

    start: int
    """Start address in the ESC's memory; below 0x1000 it lies in registers (0x0F00: digital outputs)."""
    length: int
    """Default length, bytes; a hint where PDOs are assigned: their sum counts."""
    control: int
    """Mode (0: three buffers, 2: mailbox, 1: one buffer), direction (4: the master writes), 0x40: watchdog trigger."""
    type: SyncManagerType
    enabled: bool = True
    virtual: bool = False
    """True: represents registers mapped by an FMMU without a sync manager."""
    minimum: int | None = None
    """Smallest length, bytes."""
    maximum: int | None = None
    """Largest length, bytes."""
    op_only: bool = False
    """It is enabled in OP only."""

    @property
    def lacks_watchdog(self) -> bool:
        """Whether it carries outputs that do not trigger the process-data watchdog."""
        return self.type is SyncManagerType.OUTPUTS and not self.virtual and not self.control & 0x40


@dataclass(frozen=True, slots=True)
class PdoEntry:
    """A mapped object; index 0 is padding."""

    index: int
    sub_index: int
    bits: int
    name: str = ""
    type: str = ""
    """Data type as the description names it (UINT, BIT2, INT24, `ARRAY [0..30] OF BYTE`); empty: not given."""
    depends_on_slot: bool = False
    """In a module: its index grows with the slot."""


@dataclass(frozen=True, slots=True)
class Pdo:
    """A process data object."""

    index: int
    name: str
    entries: tuple[PdoEntry, ...]
    sync_manager: int | None = None
    """Default sync manager; None: assignable, but not assigned."""
    fixed: bool = False
    """Its entries cannot be changed."""
    mandatory: bool = False
    """Its assignment cannot be removed."""
    virtual: bool = False
    excludes: frozenset[int] = frozenset()
    """PDOs that cannot be assigned together with it."""
    depends_on_slot: bool = False
    """In a module: its index grows with the slot."""
    overwritten_by_module: bool = False
    """A module's PDO of the same index takes its place."""
    samples: int = 1
    """Times that it is assigned."""
    sample_increment: int = 0
    """Above 0: each further sample has a PDO of its own, of the next index, whose objects' indices grow by this."""
    fewest_samples: int = 1
    most_samples: int = 1
    """Fewest and most samples that the device takes; 1 of a PDO without oversampling."""

    @property
    def bits(self) -> int:
        """Length in bits."""
        return sum(entry.bits for entry in self.entries)


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """A subindex of an object."""

    sub_index: int
    name: str
    type: str
    """Data type as the description names it; a base type, never an array's or a record's name."""
    bits: int
    readable: bool = True
    writable: bool = False
    """In some state; `write_states` says in which."""
    write_states: str = ""
    """States in which it can be written, of P (PRE-OP), S (SAFE-OP), O (OP); empty: all."""
    rx_mappable: bool = False
    tx_mappable: bool = False
    default: bytes | None = None
    """Value at power-on, little endian; None: 0. Of a text or an array it may be shorter than `bits`."""
    minimum: bytes | None = None
    maximum: bytes | None = None
    unit: int | None = None
    """Unit in the notation of ETG.1004."""


@dataclass(frozen=True, slots=True)
class DictionaryObject:
    """An object of the object dictionary."""

    index: int
    name: str
    code: ObjectCode
    entries: tuple[ObjectEntry, ...]
    """By rising subindex, subindex 0 among them."""
    depends_on_slot: bool = False
    """In a module: its index grows with the slot."""


@dataclass(frozen=True)
class InitCommand:
    """An SDO that the device expects at a transition."""

    transitions: tuple[str, ...]
    """`IP`, `PS`, `SO`, ..."""
    index: int
    sub_index: int
    data: bytes
    complete_access: bool = False
    fixed: bool = False
    """Its data cannot be changed."""
    comment: str = ""
    depends_on_slot: bool = False
    """In a module: its index grows with the slot."""


@dataclass(frozen=True)
class Coe:
    """CoE details (ETG.1000.6, table 21)."""

    sdo_information: bool = False
    pdo_assignment: bool = False
    """0x1C12 and 0x1C13 can be written."""
    pdo_configuration: bool = False
    """0x1600.. and 0x1A00.. can be written."""
    pdo_upload: bool = False
    complete_access: bool = False
    segmented: bool = False
    ds402_channels: int = 0


@dataclass(frozen=True)
class Mailbox:
    """The mailbox and the protocols that it carries; its addresses are those of the sync managers."""

    coe: Coe | None = None
    foe: bool = False
    eoe: bool = False
    aoe: bool = False
    soe: bool = False
    voe: bool = False
    data_link_layer: bool = False
    """It repeats a lost answer (ETG.1000.4, 6.7.1)."""


@dataclass(frozen=True)
class DcMode:
    """An operation mode of distributed clocks (ETG.2010, table 15). A cycle of 0 with a factor follows the master's."""

    name: str
    assign_activate: int
    """The word for registers 0x0980 and 0x0981."""
    description: str = ""
    sync0_cycle: int = 0
    sync0_factor: int = 1
    """Above 0: multiple of the master's cycle, below: its divisor; 0: not given."""
    sync0_shift: int = 0
    sync1_cycle: int = 0
    sync1_factor: int = 0
    """Above 0: multiple of SYNC0's cycle, below: of the master's."""
    sync1_shift: int = 0
    pdos: tuple[tuple[int, tuple[int, ...]], ...] = field(default=(), compare=False)
    """Sync managers whose PDOs it assigns in place of the default ones, and these; an EEPROM does not hold them."""
    samples: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    """PDOs that it assigns several times over, for several values a cycle (oversampling), and how often."""


@dataclass(frozen=True)
class Slot:
    """A place for modules."""

    name: str
    idents: tuple[int, ...]
    """Modules that may stand there, by ident; empty: `classes` decides."""
    minimum: int
    maximum: int
    pdo_increment: int = 0
    index_increment: int = 0
    classes: tuple[str, ...] = ()
    default: int | None = None
    """Ident of the default module."""


@dataclass(frozen=True)
class Module:
    """A module for a slot; its indices are those of slot 0."""

    ident: int
    name: str
    rx_pdos: tuple[Pdo, ...] = ()
    tx_pdos: tuple[Pdo, ...] = ()
    objects: tuple[DictionaryObject, ...] = ()
    init_commands: tuple[InitCommand, ...] = ()
    module_class: str = ""
    profile: int | None = None
    """Device profile number, 402 for a drive's axis."""
    origin: str = ""
    """File and line."""


@dataclass(frozen=True)
class Device:
    """A device by its description."""

    identity: Identity
    name: str
    """In English where the description has several languages."""
    source: Source
    origin: str
    """File and line, or bus and position."""
    type: str = ""
    """Order code."""
    vendor_name: str = ""
    group: str = ""
    physics: str = ""
    """Letters of the ports: Y MII, K E-bus, H fast hot connect, blank: none."""
    sync_managers: tuple[SyncManager, ...] = ()
    fmmus: tuple[FmmuUse, ...] = ()
    rx_pdos: tuple[Pdo, ...] = ()
    tx_pdos: tuple[Pdo, ...] = ()
    mailbox: Mailbox | None = None
    objects: tuple[DictionaryObject, ...] = ()
    """The object dictionary; empty: the description has none, see `rtcp.esi.dictionary`."""
    init_commands: tuple[InitCommand, ...] = ()
    dc_modes: tuple[DcMode, ...] = ()
    """The first is the default; empty: no distributed clock."""
    slots: tuple[Slot, ...] = ()
    modules: tuple[tuple[int, int], ...] = ()
    """Place and ident of each module that has been put in, see `rtcp.esi.modules`."""
    eeprom_bytes: int = 0
    """Size of its EEPROM; 0: not given."""
    config_data: bytes = b""
    """First bytes of the EEPROM, at most 14; empty: not given."""
    bootstrap: bytes = b""
    """Words 0x14 to 0x17 of the EEPROM: receive offset and size, send offset and size of the mailboxes in BOOT."""
    profile: int | None = None
    """Device profile number, 402 for drives."""
    station_alias: int = 0
    group_name: str = ""
    channel_profiles: tuple[int, ...] = ()
    """Profile number of each channel, for two axes (402, 402); empty: not given."""
    download_module_idents: bool = False
    """The master writes the idents of the modules to 0xF030 before SAFE-OP."""
    ebus_current: int = 0
    """Current that it takes from the E-bus, mA; below 0: that it feeds."""
    no_lrw: bool = False
    """It does not support the command LRW."""
    unit_symbols: Mapping[int, str] = field(default_factory=dict)
    """Symbols of units of its own, by their notation index, see `rtcp.esi.units`."""
    hidden: bool = False
    """True: replaced by a later revision, and no longer offered by tools."""
    unread: Mapping[str, int] = field(default_factory=dict)
    """Number of unknown elements of the description, by name; each gives a warning."""

    def assigned(self, outputs: bool) -> tuple[Pdo, ...]:
        """Return the PDOs of a direction that are assigned by default, in the order of the process image.

        Registers as process data are among them only without CoE: a master maps them by the EEPROM alone.
        """
        pdos = [pdo for pdo in (self.rx_pdos if outputs else self.tx_pdos) if pdo.sync_manager is not None]
        mapped = (pdo for pdo in pdos if not pdo.virtual or (self.coe is None and self.registers_of(pdo)))
        return tuple(sorted(mapped, key=lambda pdo: pdo.sync_manager or 0))

    def registers_of(self, pdo: Pdo) -> int:
        """Return the registers that the virtual sync manager of a PDO stands for; 0: it has a real one, or none."""
        managers = () if pdo.sync_manager is None else self.sync_managers[pdo.sync_manager :]
        return managers[0].start if managers and managers[0].virtual else 0

    @property
    def coe(self) -> Coe | None:
        """CoE details; None: no CoE."""
        return None if self.mailbox is None else self.mailbox.coe


@dataclass(frozen=True)
class DeviceFile:
    """The devices and modules of an ESI file."""

    path: str
    vendor_id: int
    vendor_name: str
    devices: tuple[Device, ...]
    modules: tuple[Module, ...]
    warnings: tuple[str, ...]
    """A sentence for each deviation that was accepted, with file and line."""
    failures: tuple[str, ...] = ()
    """A sentence for each device or module that could not be read, with file and line."""
