"""Reading and writing the object dictionary with the rights and checks of the SDO services (ETG.1000.6, 5.6.2)."""

from __future__ import annotations

from rtcp.virtual.abort import AbortCode
from rtcp.virtual.encoding import SIGNED, byte_size, decode, encode, from_bits, to_bits
from rtcp.virtual.objects import Access, DictionaryObject, Entry, ObjectCode, ObjectDictionary, SdoAbort, Value

_READ = {2: Access.READ_PREOP, 4: Access.READ_SAFEOP, 8: Access.READ_OP}
_WRITE = {2: Access.WRITE_PREOP, 4: Access.WRITE_SAFEOP, 8: Access.WRITE_OP}
_STATE = 0x0F
_COUNT_BITS = 16
"""Subindex 0 and a byte of padding, at the head of a complete access that begins with subindex 0."""


def read(objects: ObjectDictionary, index: int, subindex: int, complete: bool, state: int) -> bytes:
    """Return the bytes of one entry, or (`complete`) of an object from `subindex` 0 or 1 on.

    Complete access returns as many entries as subindex 0 tells; those that may not be read are sent as zero. `state` is
    the AL state (2 PRE-OP, 4 SAFE-OP, 8 OP), its error flag ignored.

    Raises:
        SdoAbort: absent, write-only, or not to be read in the AL state `state`.
    """
    found = objects.object(index)
    if not complete or found.code == ObjectCode.VARIABLE:
        entry = objects[index, subindex]
        _check_right(entry, Access.RO, _READ.get(state & _STATE, Access(0)), AbortCode.WRITE_ONLY)
        return encode(entry, entry.value)
    _check_first(subindex)
    entries = [found.entries[0]] if subindex == 0 else []
    entries += _members(found, int(found.entries[0].value))
    right = _READ.get(state & _STATE, Access(0))
    if entries and not any(entry.access & right for entry in entries):
        known = next((entry for entry in entries if entry.access & Access.RO), entries[0])
        _check_right(known, Access.RO, right, AbortCode.WRITE_ONLY)
    image = offset = 0
    for entry in entries:
        if entry.access & right:
            image |= to_bits(entry) << offset
        offset += entry.bit_length if entry.subindex else _COUNT_BITS
    return image.to_bytes((offset + 7) // 8, "little")


def check_download(objects: ObjectDictionary, index: int, subindex: int, complete: bool, state: int, size: int) -> None:
    """Refuse a download of `size` bytes that cannot succeed whatever the bytes are.

    Raises:
        SdoAbort: absent, read-only, not to be written in the AL state `state`, or a size that does not fit.
    """
    found = objects.object(index)
    if not complete or found.code == ObjectCode.VARIABLE:
        entry = objects[index, subindex]
        _check_right(entry, Access.WO, _WRITE.get(state & _STATE, Access(0)), AbortCode.READ_ONLY)
        if size > byte_size(entry):
            raise SdoAbort(AbortCode.TOO_LONG)
        # Strings have a largest length, all others one length.
        if size < byte_size(entry) and not entry.is_bytes:
            raise SdoAbort(AbortCode.TOO_SHORT)
        return
    _check_first(subindex)
    entries = [entry for entry in found.entries.values() if entry.access & Access.WO]
    for entry in entries or [found.entries[0]]:
        _check_right(entry, Access.WO, _WRITE.get(state & _STATE, Access(0)), AbortCode.READ_ONLY)
    whole = sum(entry.bit_length for entry in _members(found, found.highest_subindex))
    if size > ((_COUNT_BITS if subindex == 0 else 0) + whole + 7) // 8:
        raise SdoAbort(AbortCode.TOO_LONG)


def write(objects: ObjectDictionary, index: int, subindex: int, complete: bool, state: int, data: bytes) -> None:
    """Store `data` in one entry, or (`complete`) in an object from `subindex` 0 or 1 on.

    Complete access is all or nothing; read-only entries in its data are passed over. Where subindex 0 can be written
    (PDO assignment and mapping) it is cleared first and written last.

    Raises:
        SdoAbort: as `check_download`, or a value out of its range, or refused by the entry's `on_write`.
    """
    check_download(objects, index, subindex, complete, state, len(data))
    found = objects.object(index)
    if complete and found.code != ObjectCode.VARIABLE:
        _write_object(found, subindex, data)
    else:
        entry = objects[index, subindex]
        _store(entry, decode(entry, data))


def _write_object(found: DictionaryObject, first: int, data: bytes) -> None:
    count = found.entries[0]
    counted = bool(count.access & Access.WO)
    members = _members(found, found.highest_subindex if counted else int(count.value))
    offset = 0
    if first == 0:
        if len(data) < _COUNT_BITS // 8:
            raise SdoAbort(AbortCode.TOO_SHORT)
        offset = _COUNT_BITS
        if counted:
            _check_range(count, data[0])
            members = _members(found, data[0])
    elif counted:
        members = _that_fit(members, 8 * len(data))
    size = (offset + sum(entry.bit_length for entry in members) + 7) // 8
    if len(data) != size:
        raise SdoAbort(AbortCode.TOO_LONG if len(data) > size else AbortCode.TOO_SHORT)
    image = int.from_bytes(data, "little")
    values: list[tuple[Entry, Value]] = [(count, 0)] if counted and first == 0 else []
    for entry in members:
        if entry.access & Access.WO:
            values.append((entry, from_bits(entry, image >> offset & ((1 << entry.bit_length) - 1))))
        offset += entry.bit_length
    if counted and first == 0:
        values.append((count, data[0]))
    before = [(entry, entry.value) for entry in found.entries.values()]
    try:
        for entry, value in values:
            _store(entry, value)
    except SdoAbort:
        for entry, value in before:
            entry.value = value
        raise


def _members(found: DictionaryObject, last: int) -> list[Entry]:
    """Return the entries of subindices 1 to `last`, in order."""
    return [found.entries[subindex] for subindex in sorted(found.entries) if 0 < subindex <= last]


def _that_fit(entries: list[Entry], bits: int) -> list[Entry]:
    """Return as many of `entries`, from the first on, as have room in `bits`."""
    taken = []
    for entry in entries:
        bits -= entry.bit_length
        if bits < 0:
            break
        taken.append(entry)
    return taken


def _check_first(subindex: int) -> None:
    """Complete access begins with subindex 0 or 1 (ETG.1000.6, 5.6.2.1)."""
    if subindex > 1:
        raise SdoAbort(AbortCode.UNSUPPORTED_ACCESS)


def _check_right(entry: Entry, any_state: Access, right: Access, never: AbortCode) -> None:
    """Refuse with `never` what no AL state allows, with 0x08000022 what another one would."""
    if not entry.access & any_state:
        raise SdoAbort(never)
    if not entry.access & right:
        raise SdoAbort(AbortCode.DEVICE_STATE)


def _check_range(entry: Entry, value: Value) -> None:
    """Refuse a number beyond the entry's limits, or beyond its bits where these do not fill bytes (BOOLEAN)."""
    if isinstance(value, bytes):
        return
    if entry.maximum is not None and value > entry.maximum:
        raise SdoAbort(AbortCode.VALUE_TOO_HIGH)
    if entry.minimum is not None and value < entry.minimum:
        raise SdoAbort(AbortCode.VALUE_TOO_LOW)
    if isinstance(value, int) and entry.data_type not in SIGNED and value >> entry.bit_length:
        raise SdoAbort(AbortCode.VALUE_TOO_HIGH)


def _store(entry: Entry, value: Value) -> None:
    _check_range(entry, value)
    if entry.on_write is not None:
        entry.on_write(entry, value)
    entry.value = value
