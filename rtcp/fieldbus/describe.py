"""Device description of a live slave, from its EEPROM, its registers, and its object dictionary by SDO information."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace

from rtcp.config.scaling import BOUNDING_OBJECTS, OBJECTS_PER_AXIS
from rtcp.esi import model, types
from rtcp.esi.sii import read_sii
from rtcp.fieldbus.bus import PdoEntryInfo, PdoInfo, slave_label
from rtcp.fieldbus.eeprom import Progress
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.pdo import ASSIGN, reading_assignment
from rtcp.fieldbus.registers import finish

_LIST, _OBJECT, _ENTRY = 1, 3, 5
"""Services of SDO information (ETG.1000.6, 5.6.3): list of objects, object description, entry description."""
_ALL_OBJECTS = 1
_DESCRIPTION = struct.Struct("<HHBB")
"""Index, data type, highest subindex, object code; the name follows."""
_ENTRY_DESCRIPTION = struct.Struct("<HBBHHH")
"""Index, subindex, value info, data type, bits, access; the name follows where no value info was requested."""
_READ, _WRITE, _RX, _TX = 0x07, 0x38, 0x40, 0x80
"""Access: read and write in PRE-OP, SAFE-OP and OP, mappable in RxPDOs and TxPDOs."""
_WRITE_STATES = ((0x08, "P"), (0x10, "S"), (0x20, "O"))
_CODES = {code.value: code for code in model.ObjectCode}
_AXES = range(0x6000, 0xA000)
_UNITS = {0x6075, 0x6076, 0x608F, 0x6091, 0x6092, 0x60A9, *BOUNDING_OBJECTS}
"""Objects of the first axis of a drive with its units and bounds, whose values a device's file needs."""
_COUNT = 0
"""Subindex of the number of entries."""


def pdos_of_eeprom(device: model.Device) -> tuple[tuple[PdoInfo, ...], tuple[PdoInfo, ...]]:
    """Return the RxPDOs and the TxPDOs that an EEPROM assigns to sync managers."""

    def info(pdo: model.Pdo) -> PdoInfo:
        entries = (PdoEntryInfo(entry.index, entry.sub_index, entry.bits, entry.name) for entry in pdo.entries)
        return PdoInfo(pdo.index, tuple(entries))

    outputs, inputs = (tuple(map(info, device.assigned(outputs))) for outputs in (True, False))
    return outputs, inputs


def describe_device(sdo: SdoClient, has_coe: bool, eeprom: bytes, origin: str, progress: Progress) -> model.Device:
    """Return the description of a slave in PRE-OP, with its present PDO assignment, and a drive's present units.

    Args:
        sdo: SDO access to it.
        has_coe: whether it supports CoE.
        eeprom: its EEPROM.
        origin: the bus and its position, in words.
        progress: receives the fraction of the object dictionary that was read, 0 to 1.

    Raises:
        BusError: it stopped answering.
        EsiError: its EEPROM is too short.
    """
    device = replace(read_sii(eeprom, origin), source=model.Source.BUS, origin=origin)
    if not has_coe:
        return device
    objects = tuple(_read_objects(sdo, progress))
    names = {(item.index, entry.sub_index): entry for item in objects for entry in item.entries}
    assigned = _assignments(sdo, device)
    if not assigned:
        return replace(device, objects=objects)
    pdos: dict[bool, list[model.Pdo]] = {True: [], False: []}
    for number, mapped in assigned.items():
        outputs = device.sync_managers[number].type is model.SyncManagerType.OUTPUTS
        pdos[outputs] += [_pdo(pdo, number, names, objects) for pdo in mapped]
    return replace(
        device,
        objects=objects,
        rx_pdos=_with_the_others(pdos[True], device.rx_pdos),
        tx_pdos=_with_the_others(pdos[False], device.tx_pdos),
    )


def _with_the_others(assigned: Sequence[model.Pdo], known: Sequence[model.Pdo]) -> tuple[model.Pdo, ...]:
    """Return the assigned PDOs, completed from the EEPROM, and the EEPROM's other PDOs, which can be assigned."""
    listed = {pdo.index: pdo for pdo in known}
    now = [
        replace(listed[pdo.index], entries=pdo.entries, sync_manager=pdo.sync_manager) if pdo.index in listed else pdo
        for pdo in assigned
    ]
    there = {pdo.index for pdo in assigned}
    return (*now, *(replace(pdo, sync_manager=None) for pdo in known if pdo.index not in there))


def _assignments(sdo: SdoClient, device: model.Device) -> dict[int, tuple[PdoInfo, ...]]:
    """Return the PDOs of each sync manager of process data that has an assignment object."""
    kinds = (model.SyncManagerType.OUTPUTS, model.SyncManagerType.INPUTS)
    by_manager = {}
    for number, manager in enumerate(device.sync_managers):
        if manager.type in kinds:
            try:
                by_manager[number] = finish(reading_assignment(sdo, ASSIGN + number))
            except SdoAborted:
                continue
    return by_manager


def _pdo(
    pdo: PdoInfo,
    number: int,
    names: dict[tuple[int, int], model.ObjectEntry],
    objects: Sequence[model.DictionaryObject],
) -> model.Pdo:
    entries = []
    for entry in pdo.entries:
        known = names.get((entry.index, entry.sub_index)) if entry.index else None
        kind = known.type if known is not None else types.of_bits(entry.bits).name if entry.index else ""
        entries.append(
            model.PdoEntry(entry.index, entry.sub_index, entry.bits, known.name if known is not None else "", kind)
        )
    name = next((item.name for item in objects if item.index == pdo.index), "")
    count = names.get((pdo.index, _COUNT))
    return model.Pdo(pdo.index, name, tuple(entries), number, fixed=count is not None and not count.writable)


def _read_objects(sdo: SdoClient, progress: Progress) -> Iterator[model.DictionaryObject]:
    """Yield the objects of the dictionary; none where the slave offers no SDO information."""
    try:
        listed = finish(sdo.information(_LIST, struct.pack("<H", _ALL_OBJECTS)))
    except SdoAborted:
        return
    indices = [index for (index,) in struct.iter_unpack("<H", listed[2 : len(listed) // 2 * 2])]
    for at, index in enumerate(indices, 1):
        # Some slaves list objects that they do not describe; these are left out.
        try:
            item = _read_object(sdo, index)
        except SdoAborted:
            item = None
        if item is not None:
            yield _with_values(sdo, item) if _is_unit(index) else item
        progress(at / len(indices))


def _is_unit(index: int) -> bool:
    """Whether an object states what an axis of a drive counts in, or limits it."""
    return index in _AXES and _AXES.start + index % OBJECTS_PER_AXIS in _UNITS


def _with_values(sdo: SdoClient, item: model.DictionaryObject) -> model.DictionaryObject:
    """Return an object with the values that the slave has now."""

    def value(entry: model.ObjectEntry) -> bytes | None:
        try:
            return finish(sdo.reading(item.index, entry.sub_index)) if entry.readable else None
        except SdoAborted:
            return None

    return replace(item, entries=tuple(replace(entry, default=value(entry)) for entry in item.entries))


def _read_object(sdo: SdoClient, index: int) -> model.DictionaryObject | None:
    data = finish(sdo.information(_OBJECT, struct.pack("<H", index)))
    if len(data) < _DESCRIPTION.size:
        return None
    described, _, highest, code = _DESCRIPTION.unpack_from(data)
    if described != index:
        where = slave_label(sdo.position, sdo.name)
        raise BusError(f"{where}: asked for object 0x{index:04X}, it described 0x{described:04X}")
    kind = _CODES.get(code, model.ObjectCode.RECORD if highest else model.ObjectCode.VARIABLE)
    entries = []
    for sub_index in range(highest + 1 if kind is not model.ObjectCode.VARIABLE else 1):
        try:
            entry = read_entry(sdo, index, sub_index)
        except SdoAborted:
            continue  # a record may have gaps
        if entry is not None:
            entries.append(entry)
    return model.DictionaryObject(index, _text(data[_DESCRIPTION.size :]), kind, tuple(entries))


def read_entry(sdo: SdoClient, index: int, sub_index: int) -> model.ObjectEntry | None:
    """Return the description of an entry; None: the answer is empty or describes a gap. Raises BusError."""
    data = finish(sdo.information(_ENTRY, struct.pack("<HBB", index, sub_index, 0)))
    if len(data) < _ENTRY_DESCRIPTION.size:
        return None
    _, _, _, kind, bits, access = _ENTRY_DESCRIPTION.unpack_from(data)
    if not kind and not bits:
        return None
    return model.ObjectEntry(
        sub_index,
        _text(data[_ENTRY_DESCRIPTION.size :]),
        types.of_number(kind, bits).name,
        bits,
        readable=bool(access & _READ),
        writable=bool(access & _WRITE),
        write_states="" if access & _WRITE == _WRITE else "".join(name for bit, name in _WRITE_STATES if access & bit),
        rx_mappable=bool(access & _RX),
        tx_mappable=bool(access & _TX),
    )


def _text(data: bytes) -> str:
    return data.rstrip(b"\0").decode("latin-1")
