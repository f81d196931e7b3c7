"""Logical addressing: FMMUs, and the copies that a logical datagram needs (ETG.1000.4, 6.6).

What a datagram means is defined by `transfer`, bit by bit where an FMMU asks for it. `compile_plan` finds the datagrams
that are nothing but whole process images, once, and turns them into slice copies.
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
    """One active FMMU: `bits` bits from logical bit `logical` on stand for those from physical bit `physical` on."""

    logical: int
    physical: int
    bits: int
    readable: bool
    writable: bool


@dataclass(frozen=True)
class Overlap:
    """The bits of an FMMU that a datagram touches, from bit `at` in its data and bit `physical` in the memory on."""

    at: int
    physical: int
    bits: int

    @property
    def aligned(self) -> bool:
        """Whether it is whole bytes on both sides."""
        return not (self.at | self.physical | self.bits) & 7

    @property
    def last(self) -> int:
        """Its last bit in the memory."""
        return self.physical + self.bits - 1


def active_fmmus(esc: Esc) -> list[Fmmu]:
    """The active FMMUs of a slave in the order of their numbers."""
    found = []
    for number in range(FMMU_COUNT):
        base = Register.FMMU + FMMU_SIZE * number
        raw = esc.memory[base : base + FMMU_SIZE]
        length = int.from_bytes(raw[4:6], "little")
        if not raw[12] & 1 or not length:
            continue
        bits = 8 * (length - 1) + (raw[7] & 7) + 1 - (raw[6] & 7)
        found.append(Fmmu(
            logical=8 * int.from_bytes(raw[0:4], "little") + (raw[6] & 7),
            physical=8 * int.from_bytes(raw[8:10], "little") + (raw[10] & 7),
            bits=bits,
            readable=bool(raw[11] & 1),
            writable=bool(raw[11] & 2),
        ))  # fmt: skip
    return found


def overlap(fmmu: Fmmu, address: int, length: int) -> Overlap | None:
    """The part of `fmmu` that a datagram of `length` bytes at logical `address` touches."""
    first = max(fmmu.logical, 8 * address)
    last = min(fmmu.logical + fmmu.bits, 8 * (address + length))
    if last <= first:
        return None
    return Overlap(first - 8 * address, fmmu.physical + first - fmmu.logical, last - first)


def copy_bits(source: bytes | bytearray, source_bit: int, target: bytearray, target_bit: int, bits: int) -> None:
    """Copy `bits` bits, least significant first within a byte; the bits around them stay."""
    first, end = source_bit >> 3, source_bit + bits + 7 >> 3
    mask = (1 << bits) - 1
    value = int.from_bytes(source[first:end], "little") >> (source_bit & 7) & mask
    first, end, shift = target_bit >> 3, target_bit + bits + 7 >> 3, target_bit & 7
    whole = int.from_bytes(target[first:end], "little") & ~(mask << shift) | value << shift
    target[first:end] = whole.to_bytes(end - first, "little")


def touched(esc: Esc, address: int, length: int) -> Parts:
    """Return what a datagram of `length` bytes at logical `address` touches of a slave's FMMUs."""
    return [(fmmu, part) for fmmu in active_fmmus(esc) if (part := overlap(fmmu, address, length)) is not None]


def transfer(esc: Esc, command: int, parts: Parts, data: bytearray, t: int) -> int:
    """Let one slave handle a logical datagram's `data`; return what it adds to the working counter."""
    incoming = bytes(data)
    read = wrote = False
    for fmmu, part in parts:
        first, end = part.physical // 8, (part.physical + part.bits + 7) // 8
        if end > len(esc.memory):
            # An FMMU that reaches beyond the memory maps nothing there.
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
"""FMMUs and the part of each that a datagram touches."""


class Copy(NamedTuple):
    """Copy `size` bytes between `at` in the datagram's data and `image` in the segment's process image."""

    at: int
    image: int
    size: int


class BitCopy(NamedTuple):
    """Copy some bits of one byte, `at` in the datagram's data, to or from one byte, `image` in the process image."""

    at: int
    shift: int
    """Place of the lowest bit in the datagram's byte."""
    mask: int
    """The bits, from bit 0 on."""
    image: int
    image_shift: int
    image_others: int
    """The bits of the image's byte that are not copied."""


@dataclass
class Plan:
    """What a logical datagram does while FMMUs, sync managers and AL states stay as they are."""

    outputs: list[Copy] = field(default_factory=list)
    """From the frame into the image of outputs."""
    inputs: list[Copy] = field(default_factory=list)
    """From the image of inputs into the frame, after all outputs were taken out."""
    output_bits: list[BitCopy] = field(default_factory=list)
    """As `outputs`, of slaves that share a byte of the datagram with their neighbours."""
    input_bits: list[BitCopy] = field(default_factory=list)
    counter: int = 0
    """What the copies add to the working counter."""
    shares: list[tuple[Esc, int]] = field(default_factory=list)
    """What each slave has in `counter`."""
    written: list[tuple[Esc, SyncManager]] = field(default_factory=list)
    """Buffers that the copies complete."""
    others: list[tuple[Esc, Parts]] = field(default_factory=list)
    """Slaves, in the order of the wire, that need `transfer`."""


def _exact_buffer(esc: Esc, part: Overlap) -> SyncManager | None:
    """The buffered sync manager whose whole area `part` is, or some bits of its only byte, if it is one."""
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
    for copy in sorted(copies, key=lambda found: found.at):
        last = joined[-1] if joined else None
        if last is not None and last.at + last.size == copy.at and last.image + last.size == copy.image:
            joined[-1] = last._replace(size=last.size + copy.size)
        else:
            joined.append(copy)
    return joined


def compile_plan(slaves: Sequence[Esc], images: dict[SyncManager, int], command: int, address: int,
                 length: int) -> Plan:  # fmt: skip
    """Work out the copies of a logical datagram; `images` gives each buffer's place in the image of its direction."""
    plan = Plan()
    used: list[tuple[Esc, Parts]] = []
    taken: list[tuple[int, int, int]] = []
    for position, esc in enumerate(slaves):
        parts = touched(esc, address, length)
        if not parts:
            continue
        used.append((esc, parts))
        taken += [(part.at, part.at + part.bits, position) for _, part in parts]
        if not _fast(plan, esc, parts, images, command):
            plan.others.append((esc, parts))
    # Where slaves share bits of the datagram their order matters: then all go the exact way, one after another.
    if _shared(taken):
        return Plan(others=used)
    plan.outputs = _join(plan.outputs)
    plan.inputs = _join(plan.inputs)
    return plan


def _shared(taken: list[tuple[int, int, int]]) -> bool:
    """Whether two slaves touch the same bits; `taken` holds first bit, end and slave of each part."""
    end, owner = 0, -1
    for first, last, slave in sorted(taken):
        if slave == owner:
            end = max(end, last)
        elif first < end:
            return True
        else:
            end, owner = last, slave
    return False


def _fast(plan: Plan, esc: Esc, parts: Parts, images: dict[SyncManager, int],
          command: int) -> bool:  # fmt: skip
    """Add one slave's part to `plan` if whole buffers are all it has; otherwise leave the plan alone."""
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
