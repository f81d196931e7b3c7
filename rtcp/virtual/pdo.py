"""Process data objects: sync managers, PDO assignment and mapping, process images (ETG.1000.6, 5.6.5 and 5.6.7.4)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import repeat
from typing import NamedTuple

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
    from_bits,
    struct_code,
    to_bits,
)
from rtcp.virtual.protocol import RAM_SIZE, REGISTER_SPACE

SM_TYPES = 0x1C00
"""Sync manager communication type (ETG.1000.6, table 67)."""
RX_ASSIGN = 0x1C12
TX_ASSIGN = 0x1C13
RX_MAPPINGS = range(0x1600, 0x1800)
TX_MAPPINGS = range(0x1A00, 0x1C00)
BUFFERS = 3
"""Number of buffers in buffered mode (ETG.1000.4, 6.7.1)."""
MAX_BYTES = 256
"""Upper bound on the process image of SM2 in `SyncManagerLayout`: three buffers fit before SM3."""
MAX_INPUT_BYTES = (REGISTER_SPACE + RAM_SIZE - 0x1400) // BUFFERS
"""The same for SM3, up to the memory's end."""
MAX_MAPPED = 16
"""Least capacity of a writable mapping object of a model, entries."""
MAX_ASSIGNED = 4
"""Least capacity of a writable assignment object of a model, PDOs."""
ASSIGN = 0x1C10
"""0x1C10 + n is the PDO assignment of sync manager n (ETG.1000.6, 5.6.7.4)."""

Mapped = tuple[int, int, int]
"""A mapped entry: index (0: a gap), subindex, bits."""
Buffer = bytes | bytearray | memoryview


class SyncManagerType(IntEnum):
    """Use of a sync manager (ETG.1000.6, 5.6.7.4; same numbers in the SII, ETG.2010)."""

    UNUSED = 0
    MAILBOX_RECEIVE = 1
    MAILBOX_SEND = 2
    OUTPUTS = 3
    INPUTS = 4


@dataclass(frozen=True)
class SyncManager:
    """Default settings of one sync manager, by its registers (ETG.1000.4, 6.7.2)."""

    start: int
    """Physical start address in the ESC's memory."""
    length: int
    """Bytes; 0: by the PDO assignment."""
    control: int
    """Mode (0: three buffers, 2: mailbox), direction (4: the master writes), interrupt 0x20, watchdog trigger 0x40."""
    type: SyncManagerType
    activate: int = 0x01

    @property
    def buffers(self) -> int:
        """Number of buffers in the memory: one as a mailbox or in one-buffer mode."""
        return 1 if self.control & 0x03 == 0x02 else BUFFERS


class SyncManagerLayout(NamedTuple):
    """The four sync managers of a slave with mailbox, for its SII."""

    mailbox_receive: SyncManager = SyncManager(0x1000, 128, 0x26, SyncManagerType.MAILBOX_RECEIVE)
    """SM0: the master writes, the slave receives."""
    mailbox_send: SyncManager = SyncManager(0x1080, 128, 0x22, SyncManagerType.MAILBOX_SEND)
    """SM1: the slave sends, the master reads."""
    outputs: SyncManager = SyncManager(0x1100, 0, 0x64, SyncManagerType.OUTPUTS)
    """SM2: RxPDOs, triggers the process-data watchdog."""
    inputs: SyncManager = SyncManager(0x1400, 0, 0x20, SyncManagerType.INPUTS)
    """SM3: TxPDOs."""


def room(layout: Sequence[SyncManager], index: int, memory_end: int) -> int:
    """Return the bytes available to sync manager `index`: up to the next one in the memory, or its end."""
    own = layout[index]
    ends = [manager.start for n, manager in enumerate(layout) if n != index and manager.start > own.start]
    return max(0, min([*ends, memory_end]) - own.start) // own.buffers


class PdoImage:
    """The process image of a sync manager: the bit positions of its entries.

    Later changes of the mapping do not affect it.
    """

    __slots__ = ("_bits", "_numbers", "_struct", "bit_length", "byte_length", "entries")

    def __init__(self, fields: Sequence[tuple[Entry | None, int]]) -> None:
        """Lay out `fields`, each an entry (None: a gap) and its number of bits, from bit 0."""
        self.bit_length = sum(bits for _, bits in fields)
        self.byte_length = (self.bit_length + 7) // 8
        self.entries = tuple(entry for entry, _ in fields if entry is not None)
        self._struct = _compile(fields)
        # An entry of a PDO that is assigned several times is there as often, each with its number.
        seen: dict[int, int] = {}
        numbers = []
        for used in self.entries:
            seen[id(used)] = number = seen.get(id(used), -1) + 1
            numbers.append(number)
        self._numbers = numbers if any(numbers) else None
        """None: no entry is there twice."""
        self._bits: list[tuple[Entry, int, int]] = []
        offset = 0
        for entry, bits in fields:
            if entry is not None:
                self._bits.append((entry, offset, (1 << bits) - 1))
            offset += bits

    @classmethod
    def from_assignment(cls, objects: ObjectDictionary, assignment: int, outputs: bool | None = None,
                        most: int | None = None) -> PdoImage:  # fmt: skip
        """Return the image of the PDOs listed in `assignment`.

        `outputs`: their direction (None: 0x1C12 has outputs); `most`: upper bound on its size, bytes (None: that of
        `SyncManagerLayout`).

        Raises:
            SdoAbort: an object, a subindex or a mapping does not exist or is not mappable.
            ValueError: the image exceeds `most`.
        """
        if outputs is None:
            outputs = assignment == RX_ASSIGN
        if most is None:
            most = MAX_BYTES if outputs else MAX_INPUT_BYTES
        wanted = Access.RXPDO if outputs else Access.TXPDO
        mappings = [mapping for pdo in listed(objects, assignment) for mapping in listed(objects, pdo)]
        image = cls([_field(objects, mapping, wanted) for mapping in mappings])
        if image.byte_length > most:
            raise ValueError(
                f"the PDOs assigned in 0x{assignment:04X} take {image.byte_length} bytes, allowed are {most}"
            )
        return image

    def unpack(self, data: Buffer, offset: int = 0) -> None:
        """Store the values of `data` (`byte_length` bytes from `offset`) in the entries.

        Raises:
            struct.error: `data` is too short (for an image of whole bytes).
        """
        if self._struct is not None:
            for entry, value in zip(self.entries, self._struct.unpack_from(data, offset)):  # noqa: B905
                entry.value = value
            return
        image = int.from_bytes(data[offset : offset + self.byte_length], "little")
        for entry, shift, mask in self._bits:
            entry.value = from_bits(entry, image >> shift & mask)

    def pack(self, target: bytearray | memoryview, offset: int = 0) -> None:
        """Write the entries' values to `target` at `offset`; gaps become zero.

        Raises:
            struct.error: a value out of its type's range, or `target` too short.
        """
        if self._struct is not None and self._numbers is None:
            self._struct.pack_into(target, offset, *[entry.value for entry in self.entries])
            return
        image = 0
        for number, (entry, shift, mask) in zip(self._numbers or repeat(0), self._bits):  # noqa: B905
            newest = entry.value
            if number < len(entry.samples):
                entry.value = entry.samples[number]
            image |= (to_bits(entry) & mask) << shift
            entry.value = newest
        target[offset : offset + self.byte_length] = image.to_bytes(self.byte_length, "little")


def _compile(fields: Sequence[tuple[Entry | None, int]]) -> struct.Struct | None:
    """Return one struct for all of `fields`; None: some are not whole bytes."""
    codes = []
    for entry, bits in fields:
        if entry is not None and entry.bit_length != bits:
            return None
        code = struct_code(entry) if entry is not None else (f"{bits // 8}x" if bits % 8 == 0 else None)
        if code is None:
            return None
        codes.append(code)
    return struct.Struct("<" + "".join(codes))


def listed(objects: ObjectDictionary, index: int) -> list[int]:
    """Return the values of the used subindices of an assignment or mapping object.

    Raises:
        SdoAbort: the object does not exist, or subindex 0 exceeds its entries.
    """
    count = int(objects[index, 0].value)
    return [int(objects[index, subindex].value) for subindex in range(1, count + 1)]


def split_mapping(mapping: int) -> Mapped:
    """Return index, subindex and bits of an entry of a mapping object (ETG.1000.6, table 73)."""
    return mapping >> 16, mapping >> 8 & 0xFF, mapping & 0xFF


def _field(objects: ObjectDictionary, mapping: int, wanted: Access) -> tuple[Entry | None, int]:
    """Return entry (None: a gap) and bits of a mapping."""
    index, subindex, bits = split_mapping(mapping)
    if mapping in objects.mappings:
        return objects.mappings[mapping]
    if index == 0:
        # A gap; with 0 bits, an unused subindex of the mapping object.
        if subindex or not bits:
            raise SdoAbort(AbortCode.NO_OBJECT)
        return None, bits
    entry = objects[index, subindex]
    if not entry.access & wanted:
        raise SdoAbort(AbortCode.NOT_MAPPABLE)
    if entry.bit_length != bits:
        raise SdoAbort(AbortCode.PDO_LENGTH)
    return entry, bits


def define_pdo_objects(
    objects: ObjectDictionary,
    rx: Mapping[int, Sequence[Mapped]],
    tx: Mapping[int, Sequence[Mapped]],
    assign_rx: Sequence[int],
    assign_tx: Sequence[int],
    fixed: bool,
) -> None:
    """Add the mapping objects `rx` (0x1600..) and `tx` (0x1A00..), 0x1C00, 0x1C12 and 0x1C13 to `objects`.

    Rules for SDO writes, with the abort code: only in PRE-OP (0x08000022); subindex 0 must be 0 before another one is
    written (0x06010003); a mapped entry must exist (0x06020000, 0x06090011), be mappable in this direction
    (0x06040041), have the length of the mapping and fit in the sync manager (0x06040042); an assigned PDO must exist
    (0x06020000) and have this direction (0x06040041). With `fixed` all are read-only (0x06010002).
    """
    define_sync_manager_types(objects, SyncManagerLayout())
    for index, mapped in rx.items():
        _define_mapping(objects, index, f"RxPDO mapping {index - 0x15FF}", mapped, Access.RXPDO, fixed)
    for index, mapped in tx.items():
        _define_mapping(objects, index, f"TxPDO mapping {index - 0x19FF}", mapped, Access.TXPDO, fixed)
    _define_assignment(objects, RX_ASSIGN, "RxPDO assign", assign_rx, rx.keys(), tx.keys(), fixed)
    _define_assignment(objects, TX_ASSIGN, "TxPDO assign", assign_tx, tx.keys(), rx.keys(), fixed)


def define_sync_manager_types(objects: ObjectDictionary, layout: Sequence[SyncManager]) -> None:
    """Add 0x1C00: use of each sync manager."""
    types = [Entry(SM_TYPES, n, f"Type of SM{n - 1}", DataType.UNSIGNED8, int(m.type)) for n, m in enumerate(layout, 1)]
    objects.record(SM_TYPES, "Sync manager type", types, code=ObjectCode.ARRAY)


def _define_mapping(
    objects: ObjectDictionary, index: int, name: str, mapped: Sequence[Mapped], wanted: Access, fixed: bool
) -> None:
    def entry_at(n: int, value: int) -> Entry:
        return Entry(index, n, f"Mapped object {n}", DataType.UNSIGNED32, value)

    values = [at << 16 | subindex << 8 | bits for at, subindex, bits in mapped]
    places = values if fixed else values + [0] * (MAX_MAPPED - len(values))
    mapping = objects.record(index, name, [entry_at(n, value) for n, value in enumerate(places, 1)])
    most = MAX_BYTES if wanted == Access.RXPDO else MAX_INPUT_BYTES
    restrict(mapping, len(values), fixed, lambda value: mapped_bits(objects, value, wanted), most)


def mapped_bits(objects: ObjectDictionary, mapping: int, wanted: Access) -> int:
    """Return the bits of a mapping; raises SdoAbort if it is not mappable in the direction `wanted`."""
    return _field(objects, mapping, wanted)[1]


def _define_assignment(
    objects: ObjectDictionary, index: int, name: str, assigned: Sequence[int],
    own: Collection[int], opposite: Collection[int], fixed: bool,
) -> None:  # fmt: skip
    def entry_at(n: int, value: int) -> Entry:
        return Entry(index, n, f"Assigned PDO {n}", DataType.UNSIGNED16, value)

    def bits_of(pdo: int) -> int:
        if pdo in opposite:
            raise SdoAbort(AbortCode.NOT_MAPPABLE)
        if pdo not in own:
            raise SdoAbort(AbortCode.NO_OBJECT)
        return sum(mapping & 0xFF for mapping in listed(objects, pdo))

    places = [*assigned] if fixed else [*assigned] + [0] * (MAX_ASSIGNED - len(assigned))
    entries = [entry_at(n, pdo) for n, pdo in enumerate(places, 1)]
    most = MAX_BYTES if index == RX_ASSIGN else MAX_INPUT_BYTES
    restrict(objects.record(index, name, entries, code=ObjectCode.ARRAY), len(assigned), fixed, bits_of, most)


def restrict(obj: DictionaryObject, used: int, fixed: bool, bits_of: Callable[[int], int], most: int,
             accept: Callable[[Sequence[int]], None] | None = None) -> None:  # fmt: skip
    """Apply the rules of `define_pdo_objects` to writes of a mapping or an assignment with `used` valid subindices.

    `bits_of` returns the bits of a value, or refuses it; all together take at most `most` bytes. `accept` refuses an
    invalid combination.
    """
    count, *places = obj.entries.values()

    def check_entry(_: Entry, value: Value) -> None:
        if count.value:
            raise SdoAbort(AbortCode.SUBINDEX_0_NOT_ZERO)
        if value:
            bits_of(int(value))

    def check_count(_: Entry, value: Value) -> None:
        wanted = [int(place.value) for place in places[: int(value)]]
        if sum(map(bits_of, wanted)) > 8 * most:
            raise SdoAbort(AbortCode.PDO_LENGTH)
        if accept is not None:
            accept(wanted)

    count.value, count.maximum, count.on_write = used, len(places), check_count
    for place in places:
        place.on_write = check_entry
    for entry in obj.entries.values():
        entry.access = Access.RO if fixed else Access.RW_PREOP
