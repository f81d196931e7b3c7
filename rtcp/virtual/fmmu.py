"""Logical addressing: FMMUs, and the copies of a logical datagram (ETG.1000.4, 6.6).

`transfer` is the definition: it applies a datagram slave by slave, bit by bit where an FMMU requires that.
`compile_plan` analyses a cyclic datagram once and reduces it to slice copies where FMMUs map whole buffers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from rtcp.virtual.esc import Esc, SyncManager
from rtcp.virtual.protocol import FMMU_COUNT, FMMU_SIZE, DatagramCommand, Register

READS = frozenset((DatagramCommand.LRD, DatagramCommand.LRW))
WRITES = frozenset((DatagramCommand.LWR, DatagramCommand.LRW))


@dataclass(frozen=True)
class Fmmu:
    """An active FMMU: maps `bits` bits from logical bit `logical` to physical bit `physical`."""

    logical: int
    physical: int
    bits: int
    readable: bool
    writable: bool


@dataclass(frozen=True)
class Overlap:
    """The part of an FMMU in a datagram, from bit `at` of its data and bit `physical` of the memory."""

    at: int
    physical: int
    bits: int

    @property
    def aligned(self) -> bool:
        """Whether it consists of whole bytes on both sides."""
        return not (self.at | self.physical | self.bits) & 7

    @property
    def last(self) -> int:
        """Last bit in the memory."""
        return self.physical + self.bits - 1


def active_fmmus(esc: Esc) -> list[Fmmu]:
    """Return the active FMMUs of a slave in numerical order."""
    active = []
    for number in range(FMMU_COUNT):
        base = Register.FMMU + FMMU_SIZE * number
        raw = esc.memory[base : base + FMMU_SIZE]
        length = int.from_bytes(raw[4:6], "little")
        if not raw[12] & 1 or not length:
            continue
        bits = 8 * (length - 1) + (raw[7] & 7) + 1 - (raw[6] & 7)
        active.append(Fmmu(
            logical=8 * int.from_bytes(raw[0:4], "little") + (raw[6] & 7),
            physical=8 * int.from_bytes(raw[8:10], "little") + (raw[10] & 7),
            bits=bits,
            readable=bool(raw[11] & 1),
            writable=bool(raw[11] & 2),
        ))  # fmt: skip
    return active


def overlap(fmmu: Fmmu, address: int, length: int) -> Overlap | None:
    """Return the part of `fmmu` in a datagram of `length` bytes at logical `address`."""
    first = max(fmmu.logical, 8 * address)
    last = min(fmmu.logical + fmmu.bits, 8 * (address + length))
    if last <= first:
        return None
    return Overlap(first - 8 * address, fmmu.physical + first - fmmu.logical, last - first)


def copy_bits(source: bytes | bytearray, source_bit: int, target: bytearray, target_bit: int, bits: int) -> None:
    """Copy `bits` bits, least significant first within a byte; other bits stay."""
    first, end = source_bit >> 3, source_bit + bits + 7 >> 3
    mask = (1 << bits) - 1
    value = int.from_bytes(source[first:end], "little") >> (source_bit & 7) & mask
    first, end, shift = target_bit >> 3, target_bit + bits + 7 >> 3, target_bit & 7
    whole = int.from_bytes(target[first:end], "little") & ~(mask << shift) | value << shift
    target[first:end] = whole.to_bytes(end - first, "little")


def touched(esc: Esc, address: int, length: int) -> Parts:
    """Return the parts of a slave's FMMUs in a datagram of `length` bytes at logical `address`."""
    return [(fmmu, part) for fmmu in active_fmmus(esc) if (part := overlap(fmmu, address, length)) is not None]


def transfer(esc: Esc, command: int, parts: Parts, data: bytearray, t: int) -> int:
    """Apply a logical datagram's `data` to a slave; return its share of the working counter."""
    incoming = bytes(data)
    read = wrote = False
    for fmmu, part in parts:
        first, end = part.physical // 8, (part.physical + part.bits + 7) // 8
        if end > len(esc.memory):
            # Nothing is mapped beyond the memory.
            continue
        if command in READS and fmmu.readable:
            content = esc.read(first, end - first, t)
            if content is not None:
                copy_bits(content, part.physical - 8 * first, data, part.at, part.bits)
                read = True
        if command in WRITES and fmmu.writable:
            changed = esc.memory[first:end]
            copy_bits(incoming, part.at, changed, part.physical - 8 * first, part.bits)
            wrote |= esc.write(first, bytes(changed), t)
    return read + (2 * wrote if command == DatagramCommand.LRW else wrote)


Parts = list[tuple[Fmmu, Overlap]]
"""FMMUs and their parts in a datagram."""


class Copy(NamedTuple):
    """Copy of `size` bytes between `at` in the datagram's data and `image` in the segment's process image."""

    at: int
    image: int
    size: int


class BitCopy(NamedTuple):
    """Copy of some bits between byte `at` of the datagram's data and byte `image` of the process image."""

    at: int
    shift: int
    """Position of the lowest bit in the datagram's byte."""
    mask: int
    """The bits, from bit 0 on."""
    image: int
    image_shift: int
    image_others: int
    """Mask of the image byte's other bits."""


@dataclass
class Plan:
    """Compiled effect of a logical datagram, valid until FMMUs, sync managers or AL states change."""

    outputs: list[Copy] = field(default_factory=list)
    """Copies from the frame to the output image."""
    inputs: list[Copy] = field(default_factory=list)
    """Copies from the input image to the frame, after all outputs."""
    output_bits: list[BitCopy] = field(default_factory=list)
    """As `outputs`, for slaves that share a byte of the datagram."""
    input_bits: list[BitCopy] = field(default_factory=list)
    counter: int = 0
    """What the copies add to the working counter."""
    shares: list[tuple[Esc, int]] = field(default_factory=list)
    """Share of each slave in `counter`."""
    written: list[tuple[Esc, SyncManager]] = field(default_factory=list)
    """Buffers completed by the copies."""
    by_transfer: list[tuple[Esc, Parts]] = field(default_factory=list)
    """Slaves, in the order of the wire, that need `transfer`."""


def _exact_buffer(esc: Esc, part: Overlap) -> SyncManager | None:
    """Return the buffered sync manager whose area is `part`, or whose single byte contains `part`; None: none."""
    for manager in esc.sync_managers:
        if not manager.enabled or manager.mailbox or manager.ecat_event:
            continue
        if part.aligned and part.physical == 8 * manager.start and part.bits == 8 * manager.length:
            return manager
        within_a_byte = (part.at & 7) + part.bits <= 8
        if manager.length == 1 and within_a_byte and part.physical >> 3 == manager.start == part.last >> 3:
            return manager
    return None


def _bit_copy(part: Overlap, image: int) -> BitCopy:
    shift, mask = part.physical & 7, (1 << part.bits) - 1
    return BitCopy(part.at >> 3, part.at & 7, mask, image, shift, 0xFF & ~(mask << shift))


def _join(copies: list[Copy]) -> list[Copy]:
    joined: list[Copy] = []
    for copy in sorted(copies, key=lambda copy: copy.at):
        last = joined[-1] if joined else None
        if last is not None and last.at + last.size == copy.at and last.image + last.size == copy.image:
            joined[-1] = last._replace(size=last.size + copy.size)
        else:
            joined.append(copy)
    return joined


def compile_plan(slaves: Sequence[Esc], images: dict[SyncManager, int], command: int, address: int,
                 length: int) -> Plan:  # fmt: skip
    """Return the plan of a logical datagram; `images`: offset of each buffer in the process image of its direction."""
    plan = Plan()
    used: list[tuple[Esc, Parts]] = []
    touched_bits: list[tuple[int, int, int]] = []
    for position, esc in enumerate(slaves):
        parts = touched(esc, address, length)
        if not parts:
            continue
        used.append((esc, parts))
        touched_bits += [(part.at, part.at + part.bits, position) for _, part in parts]
        if not _fast(plan, esc, parts, images, command):
            plan.by_transfer.append((esc, parts))
    # Slaves that share bits of the datagram need `transfer` in their order.
    if _shared(touched_bits):
        return Plan(by_transfer=used)
    plan.outputs = _join(plan.outputs)
    plan.inputs = _join(plan.inputs)
    return plan


def _shared(touched_bits: list[tuple[int, int, int]]) -> bool:
    """Whether two slaves share bits; `touched_bits` has first bit, end and slave of each part."""
    end, owner = 0, -1
    for first, last, slave in sorted(touched_bits):
        if slave == owner:
            end = max(end, last)
        elif first < end:
            return True
        else:
            end, owner = last, slave
    return False


def _fast(plan: Plan, esc: Esc, parts: Parts, images: dict[SyncManager, int],
          command: int) -> bool:  # fmt: skip
    """Add a slave's parts to `plan` if each has an exact buffer; otherwise leave the plan unchanged."""
    outputs: list[Copy | BitCopy] = []
    inputs: list[Copy | BitCopy] = []
    written: list[tuple[Esc, SyncManager]] = []
    for fmmu, part in parts:
        manager = _exact_buffer(esc, part)
        if manager is None:
            return False
        place = images[manager]
        copy = Copy(part.at // 8, place, manager.length) if part.aligned else _bit_copy(part, place)
        if manager.locked:
            continue
        if manager.master_writes and fmmu.writable and command in WRITES:
            outputs.append(copy)
            written.append((esc, manager))
        elif not manager.master_writes and fmmu.readable and command in READS:
            inputs.append(copy)
    plan.outputs += [copy for copy in outputs if isinstance(copy, Copy)]
    plan.output_bits += [copy for copy in outputs if isinstance(copy, BitCopy)]
    plan.inputs += [copy for copy in inputs if isinstance(copy, Copy)]
    plan.input_bits += [copy for copy in inputs if isinstance(copy, BitCopy)]
    plan.written += written
    share = bool(inputs) + bool(outputs) * (2 if command == DatagramCommand.LRW else 1)
    plan.counter += share
    plan.shares.append((esc, share))
    return True
