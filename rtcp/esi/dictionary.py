"""The complete object dictionary of a device: missing objects are made from its identity and PDOs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from rtcp.esi import model, types
from rtcp.esi.modules import IDENT_LIST

DETECTED_IDENTS = 0xF050
"""Detected module ident list (ETG.5001.1)."""
SYNC_MANAGER_TYPES = 0x1C00
ASSIGNMENTS = 0x1C10
"""PDO assignment of sync manager 0 (ETG.1000.6, table 67); the others follow."""
MAPPINGS = range(0x1400, 0x1C00)
"""Indices of PDOs that have an object; others are telegrams of other profiles."""
CONFIGURABLE_ENTRIES = 32
"""Least capacity of a configurable PDO, entries."""


def default_assignment(device: model.Device) -> dict[int, tuple[model.Pdo, ...]]:
    """Return the PDOs that each sync manager carries by default, by its number, in the order of the description."""
    assignment: dict[int, tuple[model.Pdo, ...]] = {}
    for pdo in (*device.assigned(outputs=True), *device.assigned(outputs=False)):
        number = pdo.sync_manager or 0
        assignment[number] = (*assignment.get(number, ()), pdo)
    return assignment


def complete(device: model.Device) -> model.Device:
    """Return the device with a dictionary of all objects that a master reads.

    Objects of the description keep their names, types and rights. Identity, mapping and assignment get their values
    from the device's identity and PDOs, which contradict the dictionaries of many files.
    """
    objects = {item.index: item for item in device.objects}
    for obj in _communication_objects(device):
        objects[obj.index] = _merged(objects.get(obj.index), obj, values_of_made=True)
    for obj in _mapped_objects(device):
        objects[obj.index] = _merged(objects.get(obj.index), obj, values_of_made=False)
    for command in device.init_commands:
        if command.index not in MAPPINGS and command.data and not command.complete_access:
            objects[command.index] = _commanded(objects.get(command.index), command)
    return replace(device, objects=tuple(_counted(objects[index]) for index in sorted(objects)))


def _merged(
    described: model.DictionaryObject | None, added: model.DictionaryObject, values_of_made: bool
) -> model.DictionaryObject:
    """Return the described object with the missing entries of the added one."""
    if described is None:
        return added
    entries = {entry.sub_index: entry for entry in added.entries}
    for entry in described.entries:
        own = entries.get(entry.sub_index)
        if own is None:
            entries[entry.sub_index] = replace(entry, default=None) if values_of_made else entry
            continue
        default = own.default if values_of_made or entry.default is None else entry.default
        entries[entry.sub_index] = replace(
            entry,
            default=default if default is None or entry.bits > 64 else default.ljust((entry.bits + 7) // 8, b"\0"),
            rx_mappable=entry.rx_mappable or own.rx_mappable,
            tx_mappable=entry.tx_mappable or own.tx_mappable,
        )
    code = described.code
    if code is model.ObjectCode.VARIABLE and len(entries) > 1:
        code = added.code
    return replace(described, code=code, entries=tuple(entries[number] for number in sorted(entries)))


_OF_LENGTH = {1: "USINT", 2: "UINT", 4: "UDINT", 8: "ULINT"}


def _commanded(described: model.DictionaryObject | None, command: model.InitCommand) -> model.DictionaryObject:
    """Return the object of a start-up command: it exists and is writable."""
    size, number = len(command.data), command.sub_index
    written = model.ObjectEntry(
        number, command.comment, _OF_LENGTH.get(size, "OCTET_STRING"), 8 * size, default=bytes(size)
    )
    if described is None:
        code = model.ObjectCode.RECORD if number else model.ObjectCode.VARIABLE
        described = model.DictionaryObject(command.index, command.comment, code, ())
    entries = {entry.sub_index: entry for entry in described.entries}
    if described.code is not model.ObjectCode.VARIABLE:
        entries.setdefault(0, model.ObjectEntry(0, "SubIndex 000", "USINT", 8))
    entry = entries.get(number, written)
    entries[number] = entry if entry.writable else replace(entry, writable=True, write_states="")
    return replace(described, entries=tuple(entries[number] for number in sorted(entries)))


def _counted(item: model.DictionaryObject) -> model.DictionaryObject:
    """Return an object with the number of entries in a subindex 0 without a value."""
    first = item.entries[0]
    if item.code is model.ObjectCode.VARIABLE or first.sub_index != 0 or first.default is not None or first.bits != 8:
        return item
    count = replace(first, default=bytes([item.entries[-1].sub_index]))
    return replace(item, entries=(count, *item.entries[1:]))


def _variable(
    index: int, name: str, type_name: str, default: bytes, bits: int = 0, writable: bool = False
) -> model.DictionaryObject:
    bits = bits or types.resolve(type_name, 0).bits or 8 * len(default)
    entry = model.ObjectEntry(0, name, type_name, bits, writable=writable, default=default)
    return model.DictionaryObject(index, name, model.ObjectCode.VARIABLE, (entry,))


def _list(
    index: int,
    name: str,
    type_name: str,
    values: list[int],
    room: int = 0,
    write_states: str | None = None,
    code: model.ObjectCode = model.ObjectCode.ARRAY,
    names: Callable[[int], str] = lambda number: f"SubIndex {number:03d}",
) -> model.DictionaryObject:
    """Return an object of numbers of a type; with `write_states` they and their number can be written there."""
    bits = types.resolve(type_name, 0).bits
    writable = write_states is not None
    states = write_states or ""
    count = model.ObjectEntry(
        0, "SubIndex 000", "USINT", 8, writable=writable, write_states=states, default=bytes([min(len(values), 255)])
    )
    entries = [
        model.ObjectEntry(
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
    return model.DictionaryObject(index, name, code, (count, *entries))


def _communication_objects(device: model.Device) -> list[model.DictionaryObject]:
    identity = device.identity
    coe = (device.mailbox or model.Mailbox()).coe or model.Coe()
    profile = device.profile or 0
    kind = profile | 0x0002_0000 if profile == 402 else profile  # a servo drive (CiA 402-1)
    values = [identity.vendor_id, identity.product_code, identity.revision, identity.serial]
    parts = ("Vendor ID", "Product code", "Revision", "Serial number")
    record = model.ObjectCode.RECORD
    objects = [
        _list(0x1018, "Identity", "UDINT", values, code=record, names=lambda number: parts[number - 1]),
        _list(SYNC_MANAGER_TYPES, "Sync manager type", "USINT", [sync.type for sync in device.sync_managers]),
    ]
    present = {item.index for item in device.objects}
    texts = ((0x1008, "Device name", device.name), (0x1009, "Hardware version", ""), (0x100A, "Software version", ""))
    objects += [
        _variable(index, name, "STRING", text.encode()[:255], bits=8 * max(len(text.encode()[:255]), 1))
        for index, name, text in texts
        if index not in present
    ]
    if 0x1000 not in present:
        objects.append(_variable(0x1000, "Device type", "UDINT", kind.to_bytes(4, "little")))
    for pdo in reversed((*device.rx_pdos, *device.tx_pdos)):  # of an index that occurs twice, the first counts
        if pdo.index in MAPPINGS:
            mapping = [entry.index << 16 | entry.sub_index << 8 | min(entry.bits, 255) for entry in pdo.entries]
            free = coe.pdo_configuration and not pdo.fixed
            room = CONFIGURABLE_ENTRIES if free else 0
            states = "P" if free else None
            objects.append(_list(pdo.index, pdo.name or "PDO", "UDINT", mapping, room, states, record))
    assignment = default_assignment(device)
    for number, sync in enumerate(device.sync_managers):
        indices = [pdo.index for pdo in assignment.get(number, ())]
        process_data = sync.type in (model.SyncManagerType.OUTPUTS, model.SyncManagerType.INPUTS)
        of_direction = device.rx_pdos if sync.type is model.SyncManagerType.OUTPUTS else device.tx_pdos
        states = "P" if coe.pdo_assignment and process_data else None
        room = len(of_direction) if states else 0
        name = f"Sync manager {number} PDO assignment"
        objects.append(_list(ASSIGNMENTS + number, name, "UINT", indices, room, states))
    if device.slots:
        places = dict(device.modules)
        idents = [places.get(number, 0) for number in range(max(places) + 1)] if places else []
        objects.append(_list(IDENT_LIST, "Configured module ident list", "UDINT", idents, 254, "P"))
        objects.append(_list(DETECTED_IDENTS, "Detected module ident list", "UDINT", idents))
    return objects


def _mapped_objects(device: model.Device) -> list[model.DictionaryObject]:
    """Return an object for each index that a PDO maps."""
    entries: dict[int, dict[int, model.ObjectEntry]] = {}
    names: dict[int, str] = {}
    for pdos, outputs in ((device.rx_pdos, True), (device.tx_pdos, False)):
        for pdo in pdos:
            for entry in pdo.entries:
                if not entry.index:
                    continue
                base = types.resolve(entry.type, entry.bits)
                size = (entry.bits + 7) // 8
                mapped = model.ObjectEntry(
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
                present = of_index.setdefault(entry.sub_index, mapped)
                if present is not mapped:
                    of_index[entry.sub_index] = replace(
                        present if present.bits >= mapped.bits else mapped,
                        writable=present.writable or outputs,
                        rx_mappable=present.rx_mappable or outputs,
                        tx_mappable=present.tx_mappable or not outputs,
                    )
                names.setdefault(entry.index, pdo.name)
    objects = []
    for index, parts in entries.items():
        if set(parts) == {0}:
            objects.append(model.DictionaryObject(index, parts[0].name, model.ObjectCode.VARIABLE, (parts[0],)))
            continue
        count = model.ObjectEntry(0, "SubIndex 000", "USINT", 8, default=bytes([max(parts)]))
        parts.setdefault(0, count)
        ordered = tuple(parts[number] for number in sorted(parts))
        objects.append(
            model.DictionaryObject(index, names[index] or f"0x{index:04X}", model.ObjectCode.RECORD, ordered)
        )
    return objects
