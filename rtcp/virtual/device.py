"""What a device model is to the slave that carries it: objects, an identity, options, and time that passes.

A model is a subclass of `DeviceModel`: class attributes say what it is, `define` adds its objects, `step` passes time.
It is found by name among the entry points `rtcp.virtual_models`, or as `module:Class` of the segment file.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from math import isfinite
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol, cast

from rtcp.config.document import Finding, shown
from rtcp.config.find import load_class, registered
from rtcp.config.model import PluginError
from rtcp.virtual.objects import DataType, Entry, ObjectDictionary, SdoAbort
from rtcp.virtual.pdo import ASSIGN, PdoImage, SyncManager, SyncManagerLayout, SyncManagerType, room
from rtcp.virtual.protocol import RAM_SIZE, REGISTER_SPACE, MailboxType

MailboxHandler = Callable[[bytes, int], Iterable[bytes]]
"""Answers a mailbox message: it gets the message without its mailbox header, and the most bytes of an answer."""
ENTRY_POINTS = "rtcp.virtual_models"
"""Entry points of device models, by the name that a segment's file uses."""
LONGEST_QUEUE = 16
"""Emergency messages that wait; the oldest are dropped where nobody reads the mailbox."""


@dataclass(frozen=True)
class Identity:
    """Identity of a device as in its SII and object 0x1018."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int
    name: str
    """Name of the device, as in SII string 1 and object 0x1008."""
    group: str
    order_code: str


@dataclass(frozen=True)
class Emergency:
    """An emergency message (ETG.1000.6, 5.6.4): error code, error register, five bytes of the manufacturer."""

    error_code: int
    error_register: int
    data: bytes = bytes(5)


@dataclass(frozen=True)
class Option:
    """A number in `options` of the segment's file: default (None: it follows from the model), range and meaning."""

    default: float | None
    low: float
    high: float
    meaning: str
    whole: bool = False
    listed: bool = True
    """Whether a sentence on what there is names it."""


class OptionError(ValueError):
    """A model or an option that does not exist or is out of range; `findings` hold the key and the sentence of each."""

    def __init__(self, *findings: Finding) -> None:
        super().__init__("; ".join(text for _, text in findings))
        self.findings = findings


@dataclass
class SlaveFaults:
    """Faults of a slave's firmware and clock; they stay with the slave while it has no supply."""

    refusals: list[tuple[int, int]] = field(default_factory=list)
    """AL states that the slave refuses to enter, and the AL status code it reports."""
    hangs: int = 0
    """Above 0: the firmware ignores AL control."""
    sdo_delays: list[int] = field(default_factory=list)
    """Delays of SDO answers, ns; the longest applies."""
    sdo_aborts: list[tuple[int, int]] = field(default_factory=list)
    """Objects (index, 0: all) whose services are aborted, and the abort code."""
    sync0_losses: int = 0
    """Above 0: no SYNC0 comes."""
    drift_ppm: float = 0.0
    """Drift of the clock beyond its own."""

    def refusal(self, state: int) -> int:
        """AL status code with which the slave refuses to enter `state`; 0: it does not refuse."""
        return next((code for refused, code in self.refusals if refused == state), 0)

    def sdo_abort(self, index: int) -> int:
        """Abort code for services of object `index`; 0: they are served."""
        return next((code for refused, code in self.sdo_aborts if refused in (0, index)), 0)

    def sdo_delay(self) -> int:
        """Delay of the answer to an SDO, ns."""
        return max(self.sdo_delays, default=0)


class Roles(NamedTuple):
    """Numbers of the sync managers of a slave by their use; virtual ones, which stand for registers, have none."""

    mailboxes: tuple[int, int] | None
    """The one that the master writes and the one that it reads; None: no mailbox."""
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]


def roles_of(layout: Sequence[SyncManager]) -> Roles:
    """Return the use of each sync manager of `layout`."""

    def of(wanted: SyncManagerType) -> tuple[int, ...]:
        return tuple(n for n, manager in enumerate(layout) if manager.type == wanted)

    receive, send = of(SyncManagerType.MAILBOX_RECEIVE), of(SyncManagerType.MAILBOX_SEND)
    mailboxes = (receive[0], send[0]) if receive and send else None
    return Roles(mailboxes, of(SyncManagerType.OUTPUTS), of(SyncManagerType.INPUTS))


@dataclass(frozen=True)
class CoeFeatures:
    """What a device's CoE can do beside single SDOs (ETG.1000.6, table 21)."""

    sdo_information: bool = True
    complete_access: bool = True


FULL_COE = CoeFeatures()


class Number(Protocol):
    """An entry whose value is known to be an int."""

    value: int


def number(objects: ObjectDictionary, index: int, subindex: int = 0) -> Number:
    """Return an entry that a model keeps for its steps; raises SdoAbort where it does not exist."""
    return cast(Number, objects[index, subindex])


class FreezableInputs:
    """Mixed into a model whose inputs can be frozen."""

    freezes = 0
    """Above 0: the inputs keep their values."""


class DeviceModel:
    """Base of all device models. It knows objects by index and subindex and nothing of frames.

    The slave copies RxPDO-mapped entries in before `step` and TxPDO-mapped ones out after it. A subclass with an
    `__init__` calls this one first.

    Raises:
        OptionError: an option that does not exist or is out of range.
    """

    vendor_id: ClassVar[int] = 0
    product_code: ClassVar[int] = 0
    revision: ClassVar[int] = 0x00010000
    device_type: ClassVar[int] = 0
    """Object 0x1000."""
    name: ClassVar[str] = ""
    group: ClassVar[str] = ""
    order_code: ClassVar[str] = ""
    options: Mapping[str, Option] = MappingProxyType({})
    """Options beside those that every model has (`COMMON_OPTIONS`)."""
    supports_dc: bool = True
    """Whether the slave has a distributed clock."""
    uses_sync0: ClassVar[bool] = True
    """Whether active SYNC0 steps the device and is supervised; else process data step it."""
    sync_managers: Sequence[SyncManager] = SyncManagerLayout()
    bootstrap: tuple[int, int, int, int] | None = None
    """Mailboxes in BOOT: start and length of the one that the master writes, and of the other; None: no BOOT."""
    coe: CoeFeatures | None = FULL_COE
    """None: its mailbox, if it has one, carries other protocols alone."""
    smallest_mailbox: int = 34
    """Fewest bytes of a mailbox; a CoE slave needs 34 for SDO information (ETG.1020, 8.1)."""
    physics: str = "YY"
    """Ports 0, 1, 2, 3: Y MII, K E-bus, H MII for fast hot connect, blank none (ETG.2000)."""
    ram_size: int = RAM_SIZE
    """Bytes of process data RAM."""
    shares_memory: bool = False
    """Whether its own sync managers overlap: then nobody checks that they do not."""
    sync_activations: frozenset[int] = frozenset()
    """Values of the DC activation register 0x0981 that are allowed beside those with SYNC0."""

    def __init__(self, **given: object) -> None:
        self.chosen = _read_options({**COMMON_OPTIONS, **self.options}, given)
        """Value of every option."""
        self.identity = self.make_identity()
        self.emergencies: deque[Emergency] = deque(maxlen=LONGEST_QUEUE)
        """Emergency messages that wait to be sent; the slave's mailbox takes them from the left."""
        self.mailbox_protocols: dict[MailboxType, MailboxHandler] = {}
        """Mailbox protocols beside CoE, as FoE, that a subclass adds in its `__init__`; its SII lists them."""
        self.outputs_valid = False
        self.servos: Sequence[Any] = ()
        """Axes of a drive: `rtcp.virtual.models.servo.ServoAxis`."""
        self.failure = 0
        """AL status code with which the slave is to leave OP for SAFE-OP now; 0: none."""
        self.roles = roles_of(self.sync_managers)
        self.objects = ObjectDictionary()
        self._define_identity()
        self.define(self.objects)
        self._defaults = [(entry, entry.value) for found in self.objects for entry in found.entries.values()]

    def join(self, devices: Sequence[DeviceModel]) -> None:
        """Get to know all devices of the segment, in the order of the cable; called once, before time passes."""

    def make_identity(self) -> Identity:
        """Return its identity: that of the class, with the serial number of the options."""
        return Identity(
            self.vendor_id, self.product_code, self.revision, int(self.option("serial")),
            self.name, self.group, self.order_code,
        )  # fmt: skip

    def option(self, name: str, otherwise: float = 0.0) -> float:
        """Return the value of an option, `otherwise` where it follows from the model."""
        value = self.chosen[name]
        return otherwise if value is None else value

    def _define_identity(self) -> None:
        objects, identity, text = self.objects, self.identity, DataType.VISIBLE_STRING
        unsigned = DataType.UNSIGNED32
        objects.variable(0x1000, "Device type", unsigned, self.device_type)
        objects.variable(0x1001, "Error register", DataType.UNSIGNED8)
        objects.variable(0x1008, "Manufacturer device name", text, identity.name.encode())
        objects.variable(0x1009, "Manufacturer hardware version", text, b"1.0")
        objects.variable(0x100A, "Manufacturer software version", text, b"1.0")
        objects.record(0x1018, "Identity", [
            Entry(0x1018, 1, "Vendor ID", unsigned, identity.vendor_id),
            Entry(0x1018, 2, "Product code", unsigned, identity.product_code),
            Entry(0x1018, 3, "Revision number", unsigned, identity.revision),
            Entry(0x1018, 4, "Serial number", unsigned, identity.serial),
        ])  # fmt: skip

    def define(self, objects: ObjectDictionary) -> None:
        """Add the model's objects and PDOs; their values now are those at power-on."""
        raise NotImplementedError

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass: read the RxPDO objects, move, write the TxPDO objects."""
        raise NotImplementedError

    def truth(self) -> dict[str, Any]:
        """Return what tests ask for past the bus, by name, as JSON has it."""
        return {}

    def power_off(self) -> None:
        """The supply goes: no torque, outputs off; `step` advances only the mechanics."""
        self.set_outputs_valid(False)

    def power_on(self) -> None:
        """The supply comes back: every object has its value of power-on, past access rights and checks."""
        for entry, value in self._defaults:
            entry.value = value
        self.emergencies.clear()

    def set_outputs_valid(self, valid: bool) -> None:
        """Process data outputs become valid (OP), or must be ignored (the safe state)."""
        self.outputs_valid = valid

    def eeprom(self, alias: int) -> bytes:
        """Return its EEPROM image with the station alias; empty: it is made of its objects."""
        return b""

    def failed(self, error: Exception) -> None:
        """Something of the slave outside of its hooks has failed, as inputs that do not fit: an error of the model."""
        raise error

    def open_mailbox(self, receive_size: int, send_size: int) -> None:
        """The mailbox opens: what the master writes at once, and reads, in bytes with all headers."""

    def state_changed(self, before: int, after: int) -> None:
        """The slave went from AL state `before` to `after`."""

    def image(self, index: int) -> PdoImage | None:
        """Return the process image of sync manager `index` by its PDO assignment; None where it cannot be laid out."""
        try:
            return self.lay_out(index)
        except (SdoAbort, ValueError):
            return None

    def lay_out(self, index: int) -> PdoImage:
        """Return the process image of sync manager `index` by its PDO assignment.

        Raises:
            SdoAbort: it maps what does not exist or may not be mapped.
            ValueError: it is longer than the memory has room for.
        """
        most = room(self.sync_managers, index, REGISTER_SPACE + self.ram_size)
        return PdoImage.from_assignment(self.objects, ASSIGN + index, index in self.roles.outputs, most)

    @property
    def sync_error_limit(self) -> int:
        """Sync error counter limit: 0x10F1:02 (ETG.1020, 21.2) where it exists, else the option; 0: no limit."""
        if (0x10F1, 2) in self.objects:
            return number(self.objects, 0x10F1, 2).value
        return int(self.option("sync_error_limit"))


COMMON_OPTIONS: Mapping[str, Option] = MappingProxyType({
    "serial": Option(1, 0, 0xFFFFFFFF, "serial number (0x1018:4)", whole=True),
    "sync_error_limit": Option(
        4, 0, 0xFFFF, "sync error counter above which SYNC0 without outputs ends OP, 0: never", whole=True
    ),
})  # fmt: skip


def _read_options(table: Mapping[str, Option], given: Mapping[str, object]) -> dict[str, float | None]:
    chosen = {name: option.default for name, option in table.items()}
    findings: list[Finding] = []
    for name, value in given.items():
        option = table.get(name)
        if option is None:
            findings.append((("options", name), f"the model has no option {name!r}; it has: {_names(table)}"))
            continue
        kind = int if option.whole else (int, float)
        sound = isinstance(value, kind) and not isinstance(value, bool)
        if sound and isfinite(cast(float, value)) and option.low <= cast(float, value) <= option.high:
            chosen[name] = cast(float, value)
            continue
        allowed = f"{'a whole number' if option.whole else 'a number'} from {option.low:g} to {option.high:g}"
        findings.append((("options", name), f"found {shown(value)}, allowed is {allowed} ({option.meaning})"))
    if findings:
        raise OptionError(*findings)
    return chosen


def _names(table: Mapping[str, Option]) -> str:
    return ", ".join(name for name, option in table.items() if option.listed)


def models() -> dict[str, EntryPoint]:
    """Return the installed device models by name."""
    return registered(ENTRY_POINTS)


def create(model: str, **options: object) -> DeviceModel:
    """Return a new device, powered on; `model` is an installed name or `module:Class`.

    Raises:
        OptionError: an unknown model, or an option that does not exist or is out of range.
    """
    installed = models()
    found = EntryPoint(model, model, ENTRY_POINTS) if ":" in model else installed.get(model)
    if found is None:
        names = ", ".join(sorted(installed))
        raise OptionError((("model",), f'found the text "{model}", allowed is one of {names}, or module:Class'))
    try:
        made = load_class(found, DeviceModel)
    except PluginError as error:
        raise OptionError((("model",), str(error))) from error
    return made(**options)
