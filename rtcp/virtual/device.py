"""Base class of device models: objects, identity, options and time steps.

A model is a subclass of `DeviceModel`: class attributes describe it, `define` adds its objects, `step` advances time.
The segment's file names it by an entry point of `rtcp.virtual_models` or as `module:Class`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from math import isfinite
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, cast

from rtcp.config.find import load_class, registered
from rtcp.config.findings import Finding
from rtcp.config.model import PluginError
from rtcp.virtual.objects import DataType, Entry, ObjectDictionary, SdoAbort, Value
from rtcp.virtual.pdo import ASSIGN, PdoImage, SyncManager, SyncManagerLayout, SyncManagerType, room
from rtcp.virtual.protocol import RAM_SIZE, REGISTER_SPACE, MailboxType

MailboxHandler = Callable[[bytes, int], Iterable[bytes]]
"""Answers a mailbox message: takes the message without mailbox header and the largest size of an answer."""
ENTRY_POINTS = "rtcp.virtual_models"
"""Entry point group of device models."""
LONGEST_QUEUE = 16
"""Upper bound on queued emergency messages; the oldest are dropped."""


@dataclass(frozen=True)
class Identity:
    """Identity of a device, for its SII and object 0x1018."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int
    name: str
    """Name of the device, for SII string 1 and object 0x1008."""
    group: str
    order_code: str


@dataclass(frozen=True)
class Emergency:
    """An emergency message (ETG.1000.6, 5.6.4): error code, error register, five manufacturer-specific bytes."""

    error_code: int
    error_register: int
    data: bytes = bytes(5)


@dataclass(frozen=True)
class Option:
    """A number in `options` of the segment's file: default (None: set by the model), range and meaning."""

    default: float | None
    low: float
    high: float
    meaning: str
    whole: bool = False
    listed: bool = True
    """True: messages that list the options include it."""


class OptionError(ValueError):
    """A model or an option that does not exist or is out of range, with the `findings`."""

    def __init__(self, *findings: Finding) -> None:
        super().__init__("; ".join(finding.text for finding in findings))
        self.findings = findings


@dataclass
class SlaveFaults:
    """Faults of a slave's firmware and clock; they outlast a power cycle."""

    refusals: list[tuple[int, int]] = field(default_factory=list)
    """AL states that the slave refuses to enter, with the AL status code."""
    hangs: int = 0
    """Above 0: the firmware ignores AL control."""
    sdo_delays: list[int] = field(default_factory=list)
    """Delays of SDO answers, ns; the longest applies."""
    sdo_aborts: list[tuple[int, int]] = field(default_factory=list)
    """Objects (index, 0: all) whose services are aborted, and the abort code."""
    sync0_losses: int = 0
    """Above 0: no SYNC0 pulses."""
    drift_ppm: float = 0.0
    """Additional drift of the clock."""

    def refusal(self, state: int) -> int:
        """Return the AL status code with which the slave refuses to enter `state`; 0: no refusal."""
        return next((code for refused, code in self.refusals if refused == state), 0)

    def sdo_abort(self, index: int) -> int:
        """Return the abort code for services of object `index`; 0: none."""
        return next((code for refused, code in self.sdo_aborts if refused in (0, index)), 0)

    def sdo_delay(self) -> int:
        """Return the delay of SDO answers, ns."""
        return max(self.sdo_delays, default=0)


class Roles(NamedTuple):
    """Numbers of the sync managers of a slave by use; without virtual ones, which have no registers."""

    mailboxes: tuple[int, int] | None
    """Sync managers written and read by the master; None: no mailbox."""
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]


def roles_of(layout: Sequence[SyncManager]) -> Roles:
    """Return the roles of the sync managers in `layout`."""

    def of(wanted: SyncManagerType) -> tuple[int, ...]:
        return tuple(n for n, manager in enumerate(layout) if manager.type == wanted)

    receive, send = of(SyncManagerType.MAILBOX_RECEIVE), of(SyncManagerType.MAILBOX_SEND)
    mailboxes = (receive[0], send[0]) if receive and send else None
    return Roles(mailboxes, of(SyncManagerType.OUTPUTS), of(SyncManagerType.INPUTS))


@dataclass(frozen=True)
class CoeFeatures:
    """Optional CoE services of a device (ETG.1000.6, table 21)."""

    sdo_information: bool = True
    complete_access: bool = True


FULL_COE = CoeFeatures()


class FreezableInputs:
    """Mixin of models whose inputs can be frozen."""

    freezes = 0
    """Above 0: the inputs keep their values."""


class DeviceModel:
    """Base of all device models. A model works with objects only; the slave handles frames.

    The slave updates RxPDO-mapped entries before `step` and sends TxPDO-mapped ones after it. A subclass with its own
    `__init__` must call this one first.

    Raises:
        OptionError: an option is unknown or out of range.
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
    """Options in addition to `COMMON_OPTIONS`."""
    supports_dc: bool = True
    """Whether the slave has a distributed clock."""
    uses_sync0: ClassVar[bool] = True
    """True: an active SYNC0 steps the device and is supervised; otherwise process data step it."""
    sync_managers: Sequence[SyncManager] = SyncManagerLayout()
    bootstrap: tuple[int, int, int, int] | None = None
    """Mailboxes in BOOT: start and length of the written and of the read one; None: no BOOT."""
    coe: CoeFeatures | None = FULL_COE
    """CoE services; None: no CoE."""
    smallest_mailbox: int = 34
    """Least size of a mailbox, bytes; SDO information needs 34 (ETG.1020, 8.1)."""
    physics: str = "YY"
    """Ports 0 to 3: Y MII, K E-bus, H MII for fast hot connect, blank none (ETG.2000)."""
    ram_size: int = RAM_SIZE
    """Bytes of process data RAM."""
    shares_memory: bool = False
    """True: its sync managers overlap by design, and the check is off."""
    sync_activations: frozenset[int] = frozenset()
    """Allowed values of the DC activation register 0x0981 in addition to those with SYNC0."""

    def __init__(self, **options: object) -> None:
        self.chosen = _read_options({**COMMON_OPTIONS, **self.options}, options)
        """Value of every option."""
        self.identity = self.make_identity()
        self.emergencies: deque[Emergency] = deque(maxlen=LONGEST_QUEUE)
        """Queue of emergency messages; the slave's mailbox takes them from the left."""
        self.mailbox_protocols: dict[MailboxType, MailboxHandler] = {}
        """Further mailbox protocols, as FoE; a subclass adds them in its `__init__`, and the SII lists them."""
        self.outputs_valid = False
        self.servos: Sequence[Any] = ()
        """Axes of a drive: `rtcp.virtual.models.servo.ServoAxis`."""
        self.failure = 0
        """AL status code that makes the slave leave OP for SAFE-OP; 0: none."""
        self.roles = roles_of(self.sync_managers)
        self.objects = ObjectDictionary()
        self._define_identity()
        self.define(self.objects)
        self._defaults: list[tuple[Entry, Value]] = []
        self.keep_defaults(entry for obj in self.objects for entry in obj.entries.values())

    def keep_defaults(self, entries: Iterable[Entry]) -> None:
        """Take the present values of entries for those at power-on."""
        self._defaults += [(entry, entry.value) for entry in entries]

    def join(self, devices: Sequence[DeviceModel]) -> None:
        """Receive all devices of the segment, in the order of the cable; called once before the first step."""

    def make_identity(self) -> Identity:
        """Return the identity of the class with the serial number of the options."""
        return Identity(
            self.vendor_id, self.product_code, self.revision, int(self.option("serial")),
            self.name, self.group, self.order_code,
        )  # fmt: skip

    def option(self, name: str, otherwise: float = 0.0) -> float:
        """Return the value of an option, or `otherwise` if it has no value."""
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
        """Add the model's objects and PDOs with their power-on values."""
        raise NotImplementedError

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds: read the RxPDO objects, move, write the TxPDO objects."""
        raise NotImplementedError

    def truth(self) -> dict[str, Any]:
        """Return the true state for tests, by name, as JSON values."""
        return {}

    def power_off(self) -> None:
        """Power off: no torque, outputs off; `step` advances only the mechanics."""
        self.set_outputs_valid(False)

    def power_on(self) -> None:
        """Power on: reset every object to its power-on value, without access checks."""
        for entry, value in self._defaults:
            entry.value = value
        self.emergencies.clear()

    def set_outputs_valid(self, valid: bool) -> None:
        """Set whether the outputs are valid (OP) or ignored (safe state)."""
        self.outputs_valid = valid

    def eeprom(self, alias: int) -> bytes:
        """Return its EEPROM image with the station alias; empty: the slave builds it from the objects."""
        return b""

    def failed(self, error: Exception) -> None:
        """Report a failure of the model outside its hooks, as inputs that do not fit their objects."""
        raise error

    def open_mailbox(self, receive_size: int, send_size: int) -> None:
        """Called when the mailbox opens, with its receive and send sizes in bytes, including headers."""

    def state_changed(self, before: int, after: int) -> None:
        """Called after a change of the AL state from `before` to `after`."""

    def image(self, index: int) -> PdoImage | None:
        """Return the process image of sync manager `index` by its PDO assignment; None if it is invalid."""
        try:
            return self.lay_out(index)
        except (SdoAbort, ValueError):
            return None

    def lay_out(self, index: int) -> PdoImage:
        """Return the process image of sync manager `index` by its PDO assignment.

        Raises:
            SdoAbort: a mapped object does not exist or is not mappable.
            ValueError: it exceeds the memory.
        """
        most = room(self.sync_managers, index, REGISTER_SPACE + self.ram_size)
        return PdoImage.from_assignment(self.objects, ASSIGN + index, index in self.roles.outputs, most)

    @property
    def sync_error_limit(self) -> int:
        """Sync error counter limit: 0x10F1:02 (ETG.1020, 21.2) if it exists, else the option; 0: no limit."""
        if (0x10F1, 2) in self.objects:
            return int(self.objects[0x10F1, 2].value)
        return int(self.option("sync_error_limit"))


COMMON_OPTIONS: Mapping[str, Option] = MappingProxyType({
    "serial": Option(1, 0, 0xFFFFFFFF, "serial number (0x1018:4)", whole=True),
    "sync_error_limit": Option(
        4, 0, 0xFFFF, "sync error counter above which SYNC0 without outputs ends OP, 0: never", whole=True
    ),
})  # fmt: skip


def _read_options(table: Mapping[str, Option], options: Mapping[str, object]) -> dict[str, float | None]:
    chosen = {name: option.default for name, option in table.items()}
    findings: list[Finding] = []
    for name, value in options.items():
        option = table.get(name)
        if option is None:
            text = f"the model has no option {name!r}; it has: {_names(table)}"
            findings.append(Finding(("options", name), "unknown_option", text=text))
            continue
        kind = int if option.whole else (int, float)
        sound = isinstance(value, kind) and not isinstance(value, bool)
        if sound and isfinite(cast(float, value)) and option.low <= cast(float, value) <= option.high:
            chosen[name] = cast(float, value)
            continue
        allowed = f"{'a whole number' if option.whole else 'a number'} from {option.low:g} to {option.high:g}"
        findings.append(Finding(("options", name), "range", found=value, allowed=f"{allowed} ({option.meaning})"))
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
        OptionError: unknown model or option, or a value out of range.
    """
    installed = models()
    entry_point = EntryPoint(model, model, ENTRY_POINTS) if ":" in model else installed.get(model)
    if entry_point is None:
        names = ", ".join(sorted(installed))
        allowed = f"one of {names}, or module:Class"
        raise OptionError(Finding(("model",), "choice", found=model, allowed=allowed))
    try:
        model_class = load_class(entry_point, DeviceModel)
    except PluginError as error:
        raise OptionError(Finding(("model",), "plugin", text=str(error))) from error
    return model_class(**options)
