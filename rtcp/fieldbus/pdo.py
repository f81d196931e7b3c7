"""Layout of a process image: the bits of each channel (ETG.1000.6, 5.6.5; little endian, no gaps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from rtcp.config.model import DeviceDescription, Pdo
from rtcp.fieldbus.bus import PdoEntryInfo, PdoInfo, slave_label
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import ABSENT, SdoClient
from rtcp.fieldbus.registers import Steps

STRUCT_CODES: dict[str, str] = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip
"""Type -> code of the `struct` module."""


ASSIGN = 0x1C10
"""PDO assignment object of sync manager 0; those of the others follow (ETG.1000.6, 5.6.7.4)."""
OUTPUTS, INPUTS = 2, 3
"""Usual sync managers of process data: of a device with a mailbox and one for each direction."""
RX_ASSIGN, TX_ASSIGN = ASSIGN + OUTPUTS, ASSIGN + INPUTS
Mapping = tuple[tuple[int, tuple[tuple[int, int, int], ...]], ...]
"""PDOs in order, each its index and its entries (index, subindex, bits)."""


@dataclass(frozen=True)
class Channel:
    """A mapped object and its place in the image; index 0 is padding."""

    name: str
    index: int
    sub_index: int
    type: str
    factor: float
    bit_offset: int
    bits: int
    unit: str = ""
    offset: float = 0.0
    """SI value at 0 counts."""
    limits: tuple[float, float] = (-inf, inf)
    """Least and greatest value sent of an output, counts."""


@dataclass(frozen=True)
class ImageLayout:
    """The outputs or the inputs of one slave."""

    channels: tuple[Channel, ...]
    bits: int

    @property
    def bytes(self) -> int:
        """Length in bytes, rounded up."""
        return (self.bits + 7) // 8

    def find(self, name: str) -> Channel | None:
        """Return the channel with this name, None where there is none."""
        return next((channel for channel in self.channels if channel.name == name and channel.index), None)


def assignments(device: DeviceDescription) -> list[tuple[str, int, list[Pdo]]]:
    """Return key, sync manager and PDOs of each assignment; a direction without PDOs has the usual one, empty."""
    return [
        (key, manager, group)
        for key, pdos, usual in (("rpdo", device.rpdo, OUTPUTS), ("tpdo", device.tpdo, INPUTS))
        for manager, group in (by_sync_manager(pdos, usual) or {usual: []}).items()
    ]


def by_sync_manager(pdos: Sequence[Pdo], usual: int) -> dict[int, list[Pdo]]:
    """Return the PDOs of one direction by sync manager, in the order of its number.

    Args:
        pdos: the PDOs.
        usual: sync manager of PDOs that name none.
    """
    groups: dict[int, list[Pdo]] = {}
    for pdo in pdos:
        groups.setdefault(usual if pdo.sync_manager is None else pdo.sync_manager, []).append(pdo)
    return dict(sorted(groups.items()))


def layout(pdos: Sequence[Pdo]) -> ImageLayout:
    """Return the layout of `pdos`, assigned in this order; each sync manager begins at a whole byte.

    A channel of a PDO that is assigned several times is there as often.
    """
    channels = []
    offset = 0
    for group in by_sync_manager(pdos, 0).values():
        offset = -(-offset // 8) * 8
        for entry in (entry for pdo in group for _ in range(pdo.samples) for entry in pdo.channels):
            channels.append(
                Channel(
                    entry.name, entry.index, entry.sub_index, entry.type, entry.factor, offset, entry.length,
                    entry.unit, entry.offset, entry.counts_range if entry.is_number else Channel.limits,
                )
            )  # fmt: skip
            offset += entry.length
    return ImageLayout(tuple(channels), offset)


def mapping_of(pdos: Sequence[Pdo]) -> Mapping:
    """Return the mapping of a description's `pdos`."""
    return tuple(
        (pdo.index, tuple((e.index, e.sub_index if e.index else 0, e.length) for e in pdo.channels))
        for whole in pdos
        for pdo in whole.assigned
    )


def entries_of(mapping: Mapping) -> list[tuple[int, int, int]]:
    """Return the entries of a mapping in one list, with adjacent paddings joined."""
    joined: list[tuple[int, int, int]] = []
    for entry in (entry for _, entries in mapping for entry in entries):
        if joined and not entry[0] and not joined[-1][0]:
            joined[-1] = 0, 0, joined[-1][2] + entry[2]
        else:
            joined.append(entry if entry[0] else (0, 0, entry[2]))
    return joined


def mapping_text(mapping: Mapping) -> str:
    """Return a mapping in words, with its length."""
    bits = sum(entry[2] for _, entries in mapping for entry in entries)
    listed = "; ".join(
        f"0x{pdo:04X}: " + (", ".join(f"0x{index:04X}:{sub}/{width}" for index, sub, width in entries) or "nothing")
        for pdo, entries in mapping
    )
    return f"{bits} bits ({listed or 'no PDO'})"


def write_mapping(sdo: SdoClient, assignment: int, pdos: Sequence[Pdo]) -> Steps[None]:
    """Write PDO mapping and assignment: counts to 0, then the entries, then the counts (ETG.1000.6, 5.6.5.2)."""
    mapping = mapping_of(pdos)
    yield from sdo.writing_int(assignment, 0, 0, 1)
    fixed = {pdo.index for whole in pdos if whole.fixed for pdo in whole.assigned}
    for pdo, entries in dict.fromkeys(mapping):  # each once, however often it is assigned
        if pdo in fixed:
            continue
        yield from sdo.writing_int(pdo, 0, 0, 1)
        for i, (index, sub_index, bits) in enumerate(entries, 1):
            yield from sdo.writing_int(pdo, i, index << 16 | sub_index << 8 | bits, 4)
        yield from sdo.writing_int(pdo, 0, len(entries), 1)
    for i, (pdo, _) in enumerate(mapping, 1):
        yield from sdo.writing_int(assignment, i, pdo, 2)
    yield from sdo.writing_int(assignment, 0, len(mapping), 1)


def compare_mapping(sdo: SdoClient, assignment: int, pdos: Sequence[Pdo], key: str) -> Steps[None]:
    """Read the mapping and compare it; raises BusError where it differs; `key`: key in the device's file.

    Of the second and further values of a fixed PDO only the lengths count: some devices number the objects of these
    values in another way than their ESI.
    """
    expected = mapping_of(pdos)
    further = {pdo.index for whole in pdos if whole.fixed for pdo in whole.assigned[1:]} - {pdo.index for pdo in pdos}
    try:
        actual = tuple(
            (pdo.index, tuple((e.index, e.sub_index, e.bits) for e in pdo.entries))
            for pdo in (yield from reading_assignment(sdo, assignment))
        )
    except SdoAborted as error:
        if error.code not in ABSENT or expected:
            raise
        return
    if _comparable(actual, further) != _comparable(expected, further):
        raise BusError(
            f"{slave_label(sdo.position, sdo.name)}: the mapping assigned through 0x{assignment:04X} differs from "
            f"the device's file (key `{key}`): expected {mapping_text(expected)}, found {mapping_text(actual)}"
        )


def _comparable(mapping: Mapping, further: set[int]) -> list[tuple[int, tuple[tuple[int, ...], ...]]]:
    # Some devices assign PDOs without entries.
    return [
        (pdo, tuple(entry[2:] if pdo in further else entry for entry in entries)) for pdo, entries in mapping if entries
    ]


def reading_assignment(sdo: SdoClient, assignment: int) -> Steps[tuple[PdoInfo, ...]]:
    """Return the PDOs that 0x1C12 or 0x1C13 lists, with their entries; names are empty.

    Raises:
        BusError: the slave refuses or does not answer.
    """
    pdos = []
    for number in range(1, (yield from _reading(sdo, assignment, 0, 0xFF)) + 1):
        pdo = yield from _reading(sdo, assignment, number, 0xFFFF)
        entries = []
        for i in range(1, (yield from _reading(sdo, pdo, 0, 0xFF)) + 1):
            mapped = yield from sdo.reading_int(pdo, i)
            entries.append(PdoEntryInfo(mapped >> 16, mapped >> 8 & 0xFF, mapped & 0xFF, ""))
        pdos.append(PdoInfo(pdo, tuple(entries)))
    return tuple(pdos)


def _reading(sdo: SdoClient, index: int, subindex: int, most: int) -> Steps[int]:
    value = yield from sdo.reading_int(index, subindex)
    if value > most:
        where = slave_label(sdo.position, sdo.name)
        raise BusError(f"{where}: 0x{index:04X}:{subindex} reads as 0x{value:X}, at most 0x{most:X} is possible")
    return value
