"""The object dictionary of a device, complete: what its description leaves out is made of its identity and PDOs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from rtcp.esi import types
from rtcp.esi.model import (
    Coe,
    Device,
    DictionaryObject,
    InitCommand,
    Mailbox,
    ObjectCode,
    ObjectEntry,
    Pdo,
    SyncManagerType,
)
from rtcp.esi.modules import IDENT_LIST

DETECTED_IDENTS = 0xF050
"""Detected module ident list (ETG.5001.1)."""
SYNC_MANAGER_TYPES = 0x1C00
ASSIGNMENTS = 0x1C10
"""PDO assignment of sync manager 0 (ETG.1000.6, table 67); the others follow."""
MAPPINGS = range(0x1400, 0x1C00)
"""Indices of PDOs that have an object; others are telegrams of other profiles."""
CONFIGURABLE_ENTRIES = 32
"""Entries that a PDO whose mapping can be changed takes, where the description names fewer."""


def default_assignment(device: Device) -> dict[int, tuple[Pdo, ...]]:
    """Return the PDOs that each sync manager carries by default, by its number, in the order of the description."""
    assignment: dict[int, tuple[Pdo, ...]] = {}
    for pdo in (*device.assigned(outputs=True), *device.assigned(outputs=False)):
        number = pdo.sync_manager or 0
        assignment[number] = (*assignment.get(number, ()), pdo)
    return assignment


def complete(device: Device) -> Device:
    """Return a device whose dictionary holds all that a master reads of it.

    Objects of the description keep their names, types and rights. Identity, mapping and assignment have the values that
    the device's identity and PDOs give them, which the dictionaries of many files contradict.
    """
    objects = {item.index: item for item in device.objects}
    for made in _communication_objects(device):
        objects[made.index] = _merged(objects.get(made.index), made, values_of_made=True)
    for made in _mapped_objects(device):
        objects[made.index] = _merged(objects.get(made.index), made, values_of_made=False)
    for command in device.init_commands:
        if command.index not in MAPPINGS and command.data and not command.complete_access:
            objects[command.index] = _commanded(objects.get(command.index), command)
    return replace(device, objects=tuple(_counted(objects[index]) for index in sorted(objects)))


def _merged(given: DictionaryObject | None, made: DictionaryObject, values_of_made: bool) -> DictionaryObject:
    """Return a given object with the entries of the made one that it lacks."""
    if given is None:
        return made
    entries = {entry.sub_index: entry for entry in made.entries}
    for entry in given.entries:
        other = entries.get(entry.sub_index)
        if other is None:
            entries[entry.sub_index] = replace(entry, default=None) if values_of_made else entry
            continue
        default = other.default if values_of_made or entry.default is None else entry.default
        entries[entry.sub_index] = replace(
            entry,
            default=default if default is None or entry.bits > 64 else default.ljust((entry.bits + 7) // 8, b"\0"),
            rx_mappable=entry.rx_mappable or other.rx_mappable,
            tx_mappable=entry.tx_mappable or other.tx_mappable,
        )
    code = given.code
    if code is ObjectCode.VARIABLE and len(entries) > 1:
        code = made.code
    return replace(given, code=code, entries=tuple(entries[number] for number in sorted(entries)))


_OF_LENGTH = {1: "USINT", 2: "UINT", 4: "UDINT", 8: "ULINT"}


def _commanded(given: DictionaryObject | None, command: InitCommand) -> DictionaryObject:
    """Return the object that the description itself writes at the start: it is there, and takes the value."""
    size, number = len(command.data), command.sub_index
    made = ObjectEntry(number, command.comment, _OF_LENGTH.get(size, "OCTET_STRING"), 8 * size, default=bytes(size))
    if given is None:
        code = ObjectCode.RECORD if number else ObjectCode.VARIABLE
        given = DictionaryObject(command.index, command.comment, code, ())
    entries = {entry.sub_index: entry for entry in given.entries}
    if given.code is not ObjectCode.VARIABLE:
        entries.setdefault(0, ObjectEntry(0, "SubIndex 000", "USINT", 8))
    entry = entries.get(number, made)
    entries[number] = entry if entry.writable else replace(entry, writable=True, write_states="")
    return replace(given, entries=tuple(entries[number] for number in sorted(entries)))


def _counted(item: DictionaryObject) -> DictionaryObject:
    """Return an object whose subindex 0, where it has no value, counts the others."""
    first = item.entries[0]
    if item.code is ObjectCode.VARIABLE or first.sub_index != 0 or first.default is not None or first.bits != 8:
        return item
    count = replace(first, default=bytes([item.entries[-1].sub_index]))
    return replace(item, entries=(count, *item.entries[1:]))


def _variable(
    index: int, name: str, type_name: str, default: bytes, bits: int = 0, writable: bool = False
) -> DictionaryObject:
    bits = bits or types.resolve(type_name, 0).bits or 8 * len(default)
    entry = ObjectEntry(0, name, type_name, bits, writable=writable, default=default)
    return DictionaryObject(index, name, ObjectCode.VARIABLE, (entry,))


def _list(
    index: int,
    name: str,
    type_name: str,
    values: list[int],
    room: int = 0,
    write_states: str | None = None,
    code: ObjectCode = ObjectCode.ARRAY,
    names: Callable[[int], str] = lambda number: f"SubIndex {number:03d}",
) -> DictionaryObject:
    """Return an object of numbers of a type; with `write_states` they and their number can be written there."""
    bits = types.resolve(type_name, 0).bits
    writable = write_states is not None
    states = write_states or ""
    count = ObjectEntry(
        0, "SubIndex 000", "USINT", 8, writable=writable, write_states=states, default=bytes([min(len(values), 255)])
    )
    entries = [
        ObjectEntry(
            number,
            names(number),
            type_name,
            bits,
            writable=writable,
            write_states=states,
            default=(values[number - 1] if number <= len(values) else 0).to_bytes(bits // 8, "little"),
        )
        for number in range(1, min(max(len(values), room), 255) + 1)
    ]
    return DictionaryObject(index, name, code, (count, *entries))


def _communication_objects(device: Device) -> list[DictionaryObject]:
    identity = device.identity
    coe = (device.mailbox or Mailbox()).coe or Coe()
    profile = device.profile or 0
    kind = profile | 0x0002_0000 if profile == 402 else profile  # a servo drive (CiA 402-1)
    values = [identity.vendor_id, identity.product_code, identity.revision, identity.serial]
    parts = ("Vendor ID", "Product code", "Revision", "Serial number")
    record = ObjectCode.RECORD
    made = [
        _list(0x1018, "Identity", "UDINT", values, code=record, names=lambda number: parts[number - 1]),
        _list(SYNC_MANAGER_TYPES, "Sync manager type", "USINT", [sync.type for sync in device.sync_managers]),
    ]
    given = {item.index for item in device.objects}
    texts = ((0x1008, "Device name", device.name), (0x1009, "Hardware version", ""), (0x100A, "Software version", ""))
    made += [
        _variable(index, name, "STRING", text.encode()[:255], bits=8 * max(len(text.encode()[:255]), 1))
        for index, name, text in texts
        if index not in given
    ]
    if 0x1000 not in given:
        made.append(_variable(0x1000, "Device type", "UDINT", kind.to_bytes(4, "little")))
    for pdo in reversed((*device.rx_pdos, *device.tx_pdos)):  # of an index that occurs twice, the first counts
        if pdo.index in MAPPINGS:
            mapping = [entry.index << 16 | entry.sub_index << 8 | min(entry.bits, 255) for entry in pdo.entries]
            free = coe.pdo_configuration and not pdo.fixed
            room = CONFIGURABLE_ENTRIES if free else 0
            states = "P" if free else None
            made.append(_list(pdo.index, pdo.name or "PDO", "UDINT", mapping, room, states, record))
    assignment = default_assignment(device)
    for number, sync in enumerate(device.sync_managers):
        indices = [pdo.index for pdo in assignment.get(number, ())]
        process_data = sync.type in (SyncManagerType.OUTPUTS, SyncManagerType.INPUTS)
        of_direction = device.rx_pdos if sync.type is SyncManagerType.OUTPUTS else device.tx_pdos
        states = "P" if coe.pdo_assignment and process_data else None
        room = len(of_direction) if states else 0
        name = f"Sync manager {number} PDO assignment"
        made.append(_list(ASSIGNMENTS + number, name, "UINT", indices, room, states))
    if device.slots:
        places = dict(device.modules)
        idents = [places.get(number, 0) for number in range(max(places) + 1)] if places else []
        made.append(_list(IDENT_LIST, "Configured module ident list", "UDINT", idents, 254, "P"))
        made.append(_list(DETECTED_IDENTS, "Detected module ident list", "UDINT", idents))
    return made


def _mapped_objects(device: Device) -> list[DictionaryObject]:
    """Return an object for each index that a PDO maps."""
    entries: dict[int, dict[int, ObjectEntry]] = {}
    names: dict[int, str] = {}
    for pdos, outputs in ((device.rx_pdos, True), (device.tx_pdos, False)):
        for pdo in pdos:
            for entry in pdo.entries:
                if not entry.index:
                    continue
                base = types.resolve(entry.type, entry.bits)
                size = (entry.bits + 7) // 8
                made = ObjectEntry(
                    sub_index=entry.sub_index,
                    name=entry.name,
                    type=base.name,
                    bits=entry.bits,
                    writable=outputs,
                    rx_mappable=outputs,
                    tx_mappable=not outputs,
                    default=bytes(size),
                )
                of_index = entries.setdefault(entry.index, {})
                present = of_index.setdefault(entry.sub_index, made)
                if present is not made:
                    of_index[entry.sub_index] = replace(
                        present if present.bits >= made.bits else made,
                        writable=present.writable or outputs,
                        rx_mappable=present.rx_mappable or outputs,
                        tx_mappable=present.tx_mappable or not outputs,
                    )
                names.setdefault(entry.index, pdo.name)
    objects = []
    for index, parts in entries.items():
        if set(parts) == {0}:
            objects.append(DictionaryObject(index, parts[0].name, ObjectCode.VARIABLE, (parts[0],)))
            continue
        count = ObjectEntry(0, "SubIndex 000", "USINT", 8, default=bytes([max(parts)]))
        parts.setdefault(0, count)
        ordered = tuple(parts[number] for number in sorted(parts))
        objects.append(DictionaryObject(index, names[index] or f"0x{index:04X}", ObjectCode.RECORD, ordered))
    return objects
