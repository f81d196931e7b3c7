"""Slaves made from an ESI file or an SII image: objects, PDOs, sync managers, clock and mailbox protocols.

A behaviour gives the device its function; without one it only serves its dictionary.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from rtcp.config.findings import Finding
from rtcp.esi import types
from rtcp.esi.dictionary import complete
from rtcp.esi.model import Device, ObjectEntry, Pdo, PdoEntry
from rtcp.esi.sii import crc
from rtcp.virtual.behaviour import Behaviour, Runner
from rtcp.virtual.device import CoeFeatures, DeviceModel, Identity, OptionError
from rtcp.virtual.foe import FoeServer
from rtcp.virtual.objects import (
    AbortCode,
    Access,
    DataType,
    DictionaryObject,
    Entry,
    ObjectCode,
    ObjectDictionary,
    SdoAbort,
    Value,
    bounds,
)
from rtcp.virtual.pdo import (
    ASSIGN,
    SM_TYPES,
    PdoImage,
    SyncManager,
    SyncManagerType,
    define_sync_manager_types,
    mapped_bits,
    restrict,
)
from rtcp.virtual.protocol import RAM_SIZE, REGISTER_SPACE, MailboxType

LARGEST_RAM = 0xF000
"""Upper bound on the RAM, bytes: addresses have 16 bits."""
_LONGEST_GAP = 248
_OBJECT = re.compile(r"0x([0-9A-Fa-f]{4})(?::(\d{1,3}))?")
_FIRST_OBJECT = 0x1000
"""Lowest object index; a PDO maps the data types below it as padding (ETG.1000.6, table 64)."""
_BEYOND = 0x1_0000
"""First internal number of PDOs without an index, or with the same one as another PDO."""
_WRITE = {"P": Access.WRITE_PREOP, "S": Access.WRITE_SAFEOP, "O": Access.WRITE_OP}
_COMPATIBILITY = 0x06040043
"""Abort code: general parameter incompatibility."""
_MAPPED = Access.RXPDO | Access.TXPDO
_LAST_INDEX, _MOST_ASSIGNED = 0xFFFF, 0xFF
"""Highest index of an object, and most entries of a PDO assignment (ETG.1000.6, 5.6.7.4)."""


class DescribedDevice(DeviceModel):
    """A device made from its description.

    Args:
        device: the description, with its modules.
        image: its EEPROM image; `alias` and checksum are inserted.
        behaviour: class of its behaviour, or None.
        options: of the behaviour, those of every model, and, as `0x6091:1`, values of objects that it has stored.
    """

    def __init__(self, device: Device, image: Callable[[int], bytes], behaviour: type[Behaviour] | None = None,
                 **options: object) -> None:  # fmt: skip
        self.description = device = device if device.coe is None else complete(device)
        self._image = image
        mailbox = device.mailbox
        self.sync_managers = _layout(device)
        self.supports_dc = bool(device.dc_modes)
        self.sync_activations = frozenset(mode.assign_activate >> 8 for mode in device.dc_modes) - {0}
        self.physics = _ports(device.physics)
        coe = device.coe
        self.coe = None if coe is None else CoeFeatures(coe.sdo_information, coe.complete_access)
        self.smallest_mailbox = min([34, *(m.length for m in self.sync_managers if _is_mailbox(m) and m.length)])
        if mailbox is not None and mailbox.foe:
            self.bootstrap = _bootstrap(device.bootstrap)
        self.options = {} if behaviour is None else behaviour.options
        self._assignments: dict[int, list[int]] = {}
        """Numbers of the default PDOs of each sync manager."""
        self._stored = {name: options.pop(name) for name in tuple(options) if name.startswith("0x")}
        """Values of objects that the device has stored, by `0xINDEX` or `0xINDEX:SUB`."""
        super().__init__(**options)
        self.runner = Runner(self, behaviour)
        self.files = None if mailbox is None or not mailbox.foe else FoeServer(self.runner)
        if self.files is not None:
            self.mailbox_protocols[MailboxType.FOE] = self.files

    def make_identity(self) -> Identity:
        """Return the identity from the description; the serial number is an option."""
        device = self.description
        identity = device.identity
        return Identity(
            identity.vendor_id, identity.product_code, identity.revision, int(self.option("serial")),
            device.name, device.group, device.type,
        )  # fmt: skip

    def eeprom(self, alias: int) -> bytes:
        """Return its EEPROM image."""
        return self._image(alias)

    # -- objects ----------------------------------------------------------------------------------------------------

    def define(self, objects: ObjectDictionary) -> None:
        """Add the objects of the dictionary and those required by the PDOs."""
        device = self.description
        identity = objects.object(0x1018)
        for item in device.objects:
            entries = {entry.sub_index: _entry(item.index, entry) for entry in item.entries}
            if entries:
                objects.add(DictionaryObject(item.index, item.name, ObjectCode(item.code), entries))
        for subindex, entry in identity.entries.items():
            if (0x1018, subindex) in objects:
                objects[0x1018, subindex].value = entry.value
        numbers = self._define_pdos(objects)
        self._make_room(objects)
        if self.coe is not None or (SM_TYPES, 0) not in objects:
            define_sync_manager_types(objects, self.sync_managers)
        for index in self.roles.outputs + self.roles.inputs:
            self._define_assignment(objects, index, numbers)
        self._store(objects)

    def _store(self, objects: ObjectDictionary) -> None:
        """Give the objects that options name their stored values; raises OptionError."""
        findings = []
        for name, value in self._stored.items():
            match = _OBJECT.fullmatch(name)
            address = (int(match[1], 16), int(match[2] or "0")) if match else (-1, 0)
            if address not in objects or objects[address].is_bytes or objects[address].is_float:
                text = f"{self.description.name} has no object {name!r} with a number; written as 0x6091:1"
                findings.append(Finding(("options", name), "unknown_option", text=text))
                continue
            entry = objects[address]
            low, high = bounds(entry)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                allowed = f"a whole number from {low} to {high}"
                findings.append(Finding(("options", name), "range", found=value, allowed=allowed))
                continue
            entry.value = value
        if findings:
            raise OptionError(*findings)

    def _define_pdos(self, objects: ObjectDictionary) -> dict[int, Pdo]:
        """Add the mapping object of every PDO and its mapped entries; return the PDOs by the number of this object."""
        numbers: dict[int, Pdo] = {}
        pdos = [(pdo, Access.RXPDO) for pdo in self._pdos(outputs=True)]
        pdos += [(pdo, Access.TXPDO) for pdo in self._pdos(outputs=False)]
        own = frozenset(pdo.index for pdo, _ in pdos)
        for pdo, wanted in pdos:
            if pdo.virtual:
                continue
            number = pdo.index if pdo.index and pdo.index not in numbers else _BEYOND + len(numbers)
            numbers[number] = pdo
            if pdo.sync_manager is not None:
                self._assignments.setdefault(pdo.sync_manager, []).append(number)
            mapped = [mapping for entry in pdo.entries for mapping in _mappings(objects, entry, wanted, own)]
            self._define_mapping(objects, number, pdo, wanted, mapped)
        return numbers

    def _pdos(self, outputs: bool) -> list[Pdo]:
        """Return the PDOs of a direction, those of further values of a cycle (OSIndexInc) last."""
        device = self.description
        pdos = list(device.rx_pdos if outputs else device.tx_pdos)
        taken = {pdo.index for pdo in pdos}
        for pdo in [pdo for pdo in pdos if pdo.sample_increment]:
            counts = [count for mode in device.dc_modes for index, count in mode.samples if index == pdo.index]
            for number in range(1, max([pdo.most_samples, *counts])):
                shift = number * pdo.sample_increment
                index, entries = pdo.index + number, tuple(_moved(entry, shift) for entry in pdo.entries)
                if index not in taken and all(entry.index <= _LAST_INDEX for entry in entries):
                    further = replace(pdo, index=index, entries=entries, sync_manager=None, mandatory=False)
                    pdos.append(further)
        return pdos

    def _define_mapping(
        self, objects: ObjectDictionary, number: int, pdo: Pdo, wanted: Access, mapped: Sequence[int]
    ) -> None:
        described = objects.object(number) if (number, 0) in objects else None
        places = 0 if described is None else described.highest_subindex
        free = not pdo.fixed and self._writable(described, "pdo_configuration")
        values = [*mapped, *[0] * (max(places, 16 if free else 0) - len(mapped))]
        entries = [Entry(number, n, f"Mapped object {n}", DataType.UNSIGNED32, v) for n, v in enumerate(values, 1)]
        mapping = objects.record(number, pdo.name or f"PDO mapping 0x{number:04X}", entries)
        restrict(mapping, len(mapped), not free, lambda value: mapped_bits(objects, value, wanted), LARGEST_RAM)

    def _writable(self, described: DictionaryObject | None, feature: str) -> bool:
        """Whether the master may change a mapping or an assignment, by the dictionary or the mailbox description."""
        mailbox = self.description.mailbox
        if mailbox is None or mailbox.coe is None:
            return False
        in_dictionary = described is not None and bool(described.entries[0].access & Access.WO)
        return in_dictionary or bool(getattr(mailbox.coe, feature))

    def _define_assignment(self, objects: ObjectDictionary, manager: int, numbers: Mapping[int, Pdo]) -> None:
        """Add the PDO assignment of a sync manager, with its rules on mandatory and mutually exclusive PDOs."""
        index = ASSIGN + manager
        outputs = manager in self.roles.outputs
        pdos = self._pdos(outputs)
        own = {number: pdo for number, pdo in numbers.items() if pdo in pdos}
        assigned = self._assignments.get(manager, [])
        wanted = Access.RXPDO if outputs else Access.TXPDO
        described = objects.object(index) if (index, 0) in objects else None
        free = self._writable(described, "pdo_assignment")
        # A clock mode may assign a PDO several times.
        repeated = max((sum(count for _, count in mode.samples) for mode in self.description.dc_modes), default=0)
        repeated = max(repeated, sum(pdo.most_samples - 1 for pdo in own.values() if not pdo.sample_increment))
        places = 0 if described is None else described.highest_subindex
        room = max(len(assigned), min(len(own) + repeated, _MOST_ASSIGNED) if free else 0, places)
        values = [*assigned, *[0] * (room - len(assigned))]
        entries = [Entry(index, n, f"Assigned PDO {n}", DataType.UNSIGNED16, v) for n, v in enumerate(values, 1)]
        assignment = objects.record(index, f"PDO assignment of SM{manager}", entries, code=ObjectCode.ARRAY)
        default = frozenset(assigned)

        def bits_of(number: int) -> int:
            if number not in own:
                raise SdoAbort(AbortCode.NOT_MAPPABLE if number in numbers else AbortCode.NO_OBJECT)
            mapping = objects.object(number)
            used = range(1, int(mapping.entries[0].value) + 1)
            return sum(mapped_bits(objects, int(mapping.entries[n].value), wanted) for n in used)

        def accept(chosen: Sequence[int]) -> None:
            others = frozenset(chosen)
            if not others:
                return
            for number in chosen:
                # Some descriptions have mutually exclusive default PDOs; these are accepted.
                if (own[number].excludes & others) - (default if number in default else frozenset()):
                    raise SdoAbort(_COMPATIBILITY)
            if any(own[number].mandatory and number not in others for number in assigned):
                raise SdoAbort(_COMPATIBILITY)

        restrict(assignment, len(assigned), not free, bits_of, LARGEST_RAM, accept)

    def _make_room(self, objects: ObjectDictionary) -> None:
        """Determine the memory of the sync managers, and whether they overlap."""
        areas = []
        for n, manager in enumerate(self.sync_managers):
            if manager.type in (SyncManagerType.OUTPUTS, SyncManagerType.INPUTS):
                words = [
                    int(entry.value)
                    for number in self._assignments.get(n, [])
                    for subindex, entry in objects.object(number).entries.items()
                    if 0 < subindex <= int(objects[number, 0].value)
                ]
                bits = sum(objects.mappings[word][1] if word in objects.mappings else word & 0xFF for word in words)
                length = (bits + 7) // 8
            else:
                length = manager.length
            if manager.type != SyncManagerType.UNUSED:
                areas.append((manager.start, manager.start + length * manager.buffers))
        boot = self.bootstrap or (0, 0, 0, 0)
        end = max([REGISTER_SPACE + RAM_SIZE, *(end for _, end in areas), boot[0] + boot[1], boot[2] + boot[3]])
        self.ram_size = min(LARGEST_RAM, -(-(end - REGISTER_SPACE) // 1024) * 1024)
        self.shares_memory = any(
            first[1] > second[0] for first, second in pairwise(sorted(area for area in areas if area[0] < area[1]))
        )

    def lay_out(self, index: int) -> PdoImage:
        """Return the process image of sync manager `index`; with overlapping ones, each may fill the whole memory."""
        if not self.shares_memory:
            return super().lay_out(index)
        return PdoImage.from_assignment(self.objects, ASSIGN + index, index in self.roles.outputs, self.ram_size)

    # -- function -----------------------------------------------------------------------------------------------

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass for the behaviour."""
        self.runner.step(dt)

    def power_on(self) -> None:
        """Power on: reset the objects to their defaults and restart the behaviour."""
        super().power_on()
        self.runner.start()

    def set_outputs_valid(self, valid: bool) -> None:
        """Set whether the outputs are valid; invalid ones become 0 unless the behaviour keeps them."""
        super().set_outputs_valid(valid)
        if not valid and not self.runner.keeps_outputs:
            try:
                self._clear_outputs()
            except Exception as error:
                self.failed(error)
        self.runner.outputs_valid(valid)

    def _clear_outputs(self) -> None:
        for index in self.roles.outputs:
            image = self.image(index)
            for entry in () if image is None else image.entries:
                entry.value = bytes(len(entry.value)) if isinstance(entry.value, bytes) else 0

    def failed(self, error: Exception) -> None:
        """Report a failure caused by the behaviour, which changed something without its methods."""
        self.runner.fail("the slave", error)

    def open_mailbox(self, receive_size: int, send_size: int) -> None:
        """Reset FoE: no transfer is in progress."""
        if self.files is not None:
            self.files.open(receive_size)

    def state_changed(self, before: int, after: int) -> None:
        """Notify the behaviour."""
        self.runner.state_changed(before, after)


def _ports(physics: str) -> str:
    """Return the ports; a device with a single port gets a second one, to fit anywhere in a chain."""
    if any(kind != " " for kind in physics[1:]):
        return physics
    return (physics.strip() or "Y")[0] * 2


def _is_mailbox(manager: SyncManager) -> bool:
    return manager.type in (SyncManagerType.MAILBOX_RECEIVE, SyncManagerType.MAILBOX_SEND)


def _layout(device: Device) -> tuple[SyncManager, ...]:
    """Return the sync managers; virtual ones, and mailboxes of a device without mailbox protocols, are unused."""
    process_data = (SyncManagerType.OUTPUTS, SyncManagerType.INPUTS)
    assigned = [{pdo.sync_manager for pdo in pdos if not pdo.virtual} for pdos in (device.rx_pdos, device.tx_pdos)]

    def kind(n: int, manager_type: SyncManagerType, virtual: bool) -> SyncManagerType:
        if virtual or (device.mailbox is None and manager_type not in process_data):
            return SyncManagerType.UNUSED
        carries = [wanted for wanted, managers in zip(process_data, assigned, strict=True) if n in managers]
        # Some descriptions declare inputs as outputs.
        return carries[0] if manager_type in process_data and len(carries) == 1 else manager_type

    return tuple(
        SyncManager(m.start, m.length, m.control, kind(n, SyncManagerType(m.type), m.virtual), int(m.enabled))
        for n, m in enumerate(device.sync_managers[:8])
    )


def _bootstrap(data: bytes) -> tuple[int, int, int, int] | None:
    words = [int.from_bytes(data[n : n + 2], "little") for n in range(0, 8, 2)]
    if len(data) < 8 or not words[1] or not words[3]:
        return None
    return words[0], words[1], words[2], words[3]


def _data_type(base: types.BaseType) -> DataType:
    try:
        return DataType(base.number)
    except ValueError:
        return DataType.OCTET_STRING


def _number(base: types.BaseType, data: bytes | None) -> float | None:
    """Return a limit; None: missing or not a number."""
    value = None if data is None else types.decode(base, data)
    return value if isinstance(value, int | float) else None


def _value(base: types.BaseType, data: bytes | None, bits: int) -> Value:
    if base.kind is types.Kind.TEXT:
        return (data or b"")[: bits // 8].rstrip(b"\0")
    if base.kind is types.Kind.BYTES:
        return (data or b"")[: (bits + 7) // 8].ljust((bits + 7) // 8, b"\0")
    value = types.decode(base, data or b"")
    return value if isinstance(value, int | float) else 0


def _entry(index: int, entry: ObjectEntry) -> Entry:
    """Return an entry of the dictionary with its default, rights and range."""
    bits = entry.bits or 8 * len(entry.default or b"")
    base = types.resolve(entry.type, bits)
    access = Access.RO if entry.readable else Access(0)
    if entry.writable:
        states = [_WRITE[state] for state in entry.write_states.upper() if state in _WRITE]
        for state in states or [Access.WO]:
            access |= state
    access |= (Access.RXPDO if entry.rx_mappable else Access(0)) | (Access.TXPDO if entry.tx_mappable else Access(0))
    low, high = _number(base, entry.minimum), _number(base, entry.maximum)
    if low is not None and high is not None and low > high:
        low = high = None
    data_type = _data_type(base)
    new = Entry(
        index, entry.sub_index, entry.name, data_type, _value(base, entry.default, bits), access,
        bit_length=bits, minimum=low, maximum=high,
    )  # fmt: skip
    if base.kind in (types.Kind.TEXT, types.Kind.BYTES) and not new.is_bytes:
        new.data_type = DataType.OCTET_STRING
    return new


def _mappings(objects: ObjectDictionary, entry: PdoEntry, wanted: Access, pdos: frozenset[int]) -> Iterable[int]:
    """Yield the mappings of a PDO's entry, several for a long gap; add a missing mapped object.

    An entry that maps the mapping object of one of the `pdos`, as in some descriptions, gets its own value.
    """
    if entry.index < _FIRST_OBJECT or entry.bits > 0xFF:
        remaining = entry.bits
        while remaining > 0:
            yield min(remaining, _LONGEST_GAP)
            remaining -= _LONGEST_GAP
        return
    word = entry.index << 16 | entry.sub_index << 8 | entry.bits
    if entry.index in pdos:
        base = types.resolve(entry.type, entry.bits)
        value = _value(base, None, entry.bits)
        hidden = Entry(entry.index, entry.sub_index, entry.name, _data_type(base), value, bit_length=entry.bits)
        objects.mappings[word] = hidden, entry.bits
        yield word
        return
    target = _mapped_entry(objects, entry, wanted)
    if target.bit_length != entry.bits:
        objects.mappings[word] = target, entry.bits
    yield word


def _moved(entry: PdoEntry, shift: int) -> PdoEntry:
    return replace(entry, index=entry.index + shift) if entry.index else entry


def _mapped_entry(objects: ObjectDictionary, entry: PdoEntry, wanted: Access) -> Entry:
    """Return the mapped entry; created if the dictionary lacks it."""
    index, subindex = entry.index, entry.sub_index
    if (index, subindex) not in objects:
        base = types.resolve(entry.type, entry.bits)
        access = Access.RO if wanted == Access.TXPDO else Access.RW
        new = Entry(index, subindex, entry.name, _data_type(base), _value(base, None, entry.bits), access,
                     bit_length=entry.bits)  # fmt: skip
        if (index, 0) in objects:
            obj = objects.object(index)
            obj.entries[subindex] = new
            obj.code = ObjectCode.RECORD
            obj.entries = dict(sorted(obj.entries.items()))
        elif subindex:
            objects.record(index, entry.name, [new])
        else:
            objects.add(DictionaryObject(index, entry.name, ObjectCode.VARIABLE, {0: new}))
        obj = objects.object(index)
        if obj.code != ObjectCode.VARIABLE and not obj.entries[0].access & _MAPPED:
            obj.entries[0].value = max(int(obj.entries[0].value or 0), obj.highest_subindex)
    target = objects[index, subindex]
    target.access |= wanted
    return target


def with_alias(image: bytes, alias: int) -> bytes:
    """Return an EEPROM image with a station alias and its checksum; alias 0: unchanged."""
    if not alias:
        return image
    head = bytearray(image[:16])
    head[8:10] = alias.to_bytes(2, "little")
    head[14] = crc(bytes(head[:14]))
    return bytes(head) + image[16:]
