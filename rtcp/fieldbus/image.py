"""SOEM's layout of the process image: limits, checked before it maps, and the place of each slave's images.

SOEM checks none of its limits, gives a slave of several sync managers FMMUs of wrong lengths, and lets neighbours with
fewer than 8 bits share a byte. pysoem reports neither the bit nor that an image crosses into a second byte. The places
are therefore read from the FMMUs that SOEM wrote (ETG.1000.4, 6.6).
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.bus import slave_label, station_of
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.pdo import INPUTS, OUTPUTS, by_sync_manager, layout
from rtcp.fieldbus.registers import Register, RegisterPort

MOST_SLAVES, LARGEST_IMAGE, MOST_FMMUS = 199, 4096, 4
"""Limits of SOEM and pysoem: slaves of a segment, bytes of the process image, FMMUs of a slave."""
_FMMU = struct.Struct("<IHBBHBBB3x")
_READ, _WRITE = 1, 2
_SYNC_MANAGER = struct.Struct("<HH4x")
_SYNC_MANAGERS = 8


class Place(NamedTuple):
    """Place of the outputs or the inputs of a slave in the process image."""

    first: int
    """First bit."""
    bits: int
    """Length in bits; 0: it has none."""

    @property
    def is_small(self) -> bool:
        """Whether it has 1 to 7 bits, and may share its byte with a neighbour."""
        return 0 < self.bits < 8


class Places(NamedTuple):
    """Places of a slave's outputs and inputs."""

    outputs: Place
    inputs: Place


def limit_faults(slaves: Sequence[SlaveConfig]) -> list[str]:
    """Return a sentence for each limit of SOEM that the configuration exceeds."""
    faults = []
    if len(slaves) > MOST_SLAVES:
        faults.append(f"the configuration (key `slaves`) lists {len(slaves)} slaves; SOEM has room for {MOST_SLAVES}")
    size = sum(layout(pdos).bytes for slave in slaves for pdos in (slave.device.rpdo, slave.device.tpdo))
    if size > LARGEST_IMAGE:
        faults.append(
            f"the process data of all slaves have {size} bytes; SOEM has room for {LARGEST_IMAGE}: map fewer objects"
        )
    for position, slave in enumerate(slaves, 1):
        label, device = slave_label(position, slave.name), slave.device
        areas = 0
        for key, pdos, usual in (("rpdo", device.rpdo, OUTPUTS), ("tpdo", device.tpdo, INPUTS)):
            groups = by_sync_manager(pdos, usual)
            areas += len(groups)
            lengths = [layout(group).bits for group in groups.values()]
            needed, reserved = sum((bits + 7) // 8 for bits in lengths), (sum(lengths) + 7) // 8
            if needed != reserved:
                faults.append(
                    f"{label}: the sync managers of key `{key}` carry {' and '.join(map(str, lengths))} bits, which "
                    f"need {needed} bytes; SOEM gives them {reserved}: map whole bytes into all but one of them"
                )
        if areas > MOST_FMMUS:
            faults.append(
                f"{label}: `rpdo` and `tpdo` use {areas} sync managers, each of which needs an FMMU; SOEM has room for "
                f"{MOST_FMMUS} of a slave"
            )
    return faults


class _Fmmu(NamedTuple):
    """A mapping of bytes of the image to bytes of the slave's memory."""

    image: int
    length: int
    memory: int
    kind: int

    def pack(self) -> bytes:
        return _FMMU.pack(self.image, self.length, 0, 7, self.memory, 0, self.kind, 1)

    def covers(self) -> Iterator[tuple[int, int]]:
        return zip(
            range(self.image, self.image + self.length), range(self.memory, self.memory + self.length), strict=True
        )


def read_places(port: RegisterPort, slaves: Sequence[SlaveConfig]) -> list[Places]:
    """Return the places of the images, and correct the FMMUs of slaves with several sync managers for a direction.

    Args:
        port: the port for registers, after SOEM's mapping.
        slaves: the slaves of the configuration.

    Raises:
        BusError: a slave does not answer, or has too few FMMUs.
    """
    return [_read_places(port, position, slave) for position, slave in enumerate(slaves, 1)]


def _read_places(port: RegisterPort, position: int, slave: SlaveConfig) -> Places:
    station, label = station_of(position), slave_label(position, slave.name)
    registers = port.read(station, Register.FMMU, _FMMU.size * MOST_FMMUS)
    managers = port.read(station, Register.SYNC_MANAGER, _SYNC_MANAGER.size * _SYNC_MANAGERS)
    if registers is None or managers is None:
        raise BusError(f"{label} stopped answering while its mapping was read")
    areas = list(_SYNC_MANAGER.iter_unpack(managers))
    mapped_fmmus: list[_Fmmu] = []
    starts: dict[int, int] = {}
    lengths: dict[int, int] = {}
    for image, length, first_bit, last_bit, memory, _, kind, active in _FMMU.iter_unpack(registers):
        if active & 1 and length:
            mapped_fmmus.append(_Fmmu(image, length, memory, kind & (_READ | _WRITE)))
            begin = 8 * image + first_bit
            starts[kind] = min(starts.get(kind, begin), begin)
            lengths[kind] = lengths.get(kind, 0) + 8 * length - 7 + last_bit - first_bit
    wanted: list[_Fmmu] = []
    places = []
    several = False
    for key, pdos, kind in (("rpdo", slave.device.rpdo, _WRITE), ("tpdo", slave.device.tpdo, _READ)):
        bits, first = layout(pdos).bits, starts.get(kind, 0)
        places.append(Place(first, bits))
        # The lengths of longer images were compared before.
        if places[-1].is_small and bits != (mapped := lengths.get(kind, 0)):
            raise BusError(f"{label}: it maps {mapped} bits, its device's file (key `{key}`) {bits}")
        groups = by_sync_manager(pdos, 0)
        several |= len(groups) > 1
        at = first // 8
        for number, group in groups.items() if len(groups) > 1 else ():
            length = layout(group).bytes
            wanted.append(_Fmmu(at, length, group[0].start_address or areas[number][0], kind))
            at += length
        if len(groups) == 1:
            wanted += [fmmu for fmmu in mapped_fmmus if fmmu.kind == kind]
    if several and _bytes_of(mapped_fmmus) != _bytes_of(wanted):
        _rewrite(port, station, label, wanted)
    return Places(*places)


def _bytes_of(fmmus: Sequence[_Fmmu]) -> set[tuple[int, int, int]]:
    return {(fmmu.kind, image, memory) for fmmu in fmmus for image, memory in fmmu.covers()}


def _rewrite(port: RegisterPort, station: int, label: str, fmmus: Sequence[_Fmmu]) -> None:
    """Write one FMMU for each sync manager; raises BusError."""
    count = port.read(station, Register.FMMU_COUNT, 1)
    if count is None or count[0] < len(fmmus):
        has = "does not say how many it has" if count is None else f"has {count[0]}"
        raise BusError(f"{label}: its process data need {len(fmmus)} FMMUs, it {has}")
    data = b"".join(fmmu.pack() for fmmu in fmmus).ljust(_FMMU.size * MOST_FMMUS, b"\0")
    port.put(station, Register.FMMU, data, label)
    if port.read(station, Register.FMMU, len(data)) != data:
        raise BusError(f"{label} does not keep its FMMUs (register 0x{Register.FMMU:04X})")


def missing_counts(places: Sequence[Places]) -> int:
    """Return the deficit of SOEM's expected working counter: it omits slaves whose image begins no byte."""
    uncounted = [[place.is_small and place.first % 8 + place.bits < 8 for place in both] for both in places]
    return sum(2 * outputs + inputs for outputs, inputs in uncounted)


_TIMEOUT_FIELD = 0x5A17C0DE


def image_memory(master: Any) -> memoryview:
    """Return the process image of pysoem's `master`, which itself offers only whole bytes of single slaves.

    The object holds the image, two pointers, and the two timeouts that the pointers refer to. The search looks for a
    timeout of a unique value and the pointer to it: the image ends before the pointers.

    Raises:
        BusError: this build of pysoem has another layout.
    """
    kept = master.sdo_read_timeout
    master.sdo_read_timeout = _TIMEOUT_FIELD
    try:
        content = ctypes.string_at(id(master), type(master).__basicsize__)
    finally:
        master.sdo_read_timeout = kept
    pointers = struct.Struct("@PP")
    at = content.find(_TIMEOUT_FIELD.to_bytes(4, "little"))
    while at >= 0:
        address, begins = id(master) + at, at - pointers.size
        if begins >= LARGEST_IMAGE and pointers.unpack_from(content, begins) == (address, address + 4):
            image = (ctypes.c_ubyte * LARGEST_IMAGE).from_address(id(master) + begins - LARGEST_IMAGE)
            return memoryview(image).cast("B")
        at = content.find(_TIMEOUT_FIELD.to_bytes(4, "little"), at + 1)
    raise BusError(
        "the process image of this build of pysoem cannot be reached, which images of fewer than 8 bits need: add "
        "padding (index 0) to them, or install pysoem 1.1.13"
    )
