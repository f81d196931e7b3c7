"""Processing of a frame by the slaves: datagrams, addressing, working counters (ETG.1000.4, clause 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtcp.virtual.esc import Esc, SyncManager
from rtcp.virtual.fmmu import Plan, compile_plan, touched, transfer
from rtcp.virtual.protocol import (
    COUNTER,
    DATAGRAM_HEADER,
    FIRST_DATAGRAM,
    HEADER,
    LENGTH_MASK,
    LOCAL_BIT,
    MORE_FOLLOWS,
    TYPE_DATAGRAMS,
    VLAN_TAG,
    DatagramCommand,
    Register,
)
from rtcp.virtual.slave import Slave

MOST_KNOWN = 256
"""Upper bound on cached addresses, as a master may use any number."""
_AUTO = frozenset((DatagramCommand.APRD, DatagramCommand.APWR, DatagramCommand.APRW, DatagramCommand.ARMW))
_STATION = frozenset((DatagramCommand.FPRD, DatagramCommand.FPWR, DatagramCommand.FPRW, DatagramCommand.FRMW))
_BROADCAST = frozenset((DatagramCommand.BRD, DatagramCommand.BWR, DatagramCommand.BRW))
_FIRST_LOGICAL, _LAST_LOGICAL = int(DatagramCommand.LRD), int(DatagramCommand.LRW)
_MULTIPLE_WRITE = frozenset((DatagramCommand.ARMW, DatagramCommand.FRMW))
_TIME_LENGTHS = (4, 8)
_READS = frozenset(
    (
        DatagramCommand.APRD,
        DatagramCommand.APRW,
        DatagramCommand.FPRD,
        DatagramCommand.FPRW,
        DatagramCommand.BRD,
        DatagramCommand.BRW,
    )
)
_WRITES = frozenset(
    (
        DatagramCommand.APWR,
        DatagramCommand.APRW,
        DatagramCommand.FPWR,
        DatagramCommand.FPRW,
        DatagramCommand.BWR,
        DatagramCommand.BRW,
    )
)
_READ_WRITES = frozenset((DatagramCommand.APRW, DatagramCommand.FPRW, DatagramCommand.BRW))

Miscount = tuple[Slave, Callable[[], bool]]
"""A slave that omits itself from the working counter of a logical datagram if the function returns True."""


class Wire:
    """Answers frames in place; collects their effects on clocks and firmware for `Segment.settle`."""

    def __init__(self, slaves: Sequence[Slave], miscounts: Sequence[Miscount] = (), passing: bool = False) -> None:
        """Connect `slaves`; `miscounts` may change later. A `passing` wire serves a single frame."""
        self.slaves = tuple(slaves)
        self._miscounts = miscounts
        self._passing = passing
        self._escs = tuple(slave.esc for slave in slaves)
        self._plans: dict[tuple[int, int, int], Plan] = {}
        self._places: dict[SyncManager, int] = {}
        self._outputs = bytearray()
        self._inputs = bytearray()
        self._event = 0
        self._stations: dict[int, tuple[Slave, ...]] = {}
        self._orders: dict[tuple[int, int, bool], list[tuple[list[Slave], Slave | None]]] = {}
        self.references: list[tuple[list[Slave], int, int]] = []
        """Clocks to steer: the slaves, the received time (32 bits), the frame's arrival at the first slave."""
        self.completed: list[Plan] = []
        """Logical datagrams that completed, or may have completed, output buffers."""
        if passing:
            return
        for esc in self._escs:
            esc.on_layout = self._plans.clear
            esc.on_address = self._forget_addresses
            esc.on_event = self._collect_events
        self._collect_events()

    def _forget_addresses(self) -> None:
        self._stations.clear()
        self._orders.clear()

    def _collect_events(self) -> None:
        self._event = 0
        for esc in self._escs:
            self._event |= esc.event

    def process(self, frame: bytearray, size: int, t: int) -> bool:
        """Answer in place the frame of `size` bytes that arrived at `t`; False: not an EtherCAT frame of datagrams.

        Processing ends at a datagram that exceeds the frame: it and the rest return unchanged.
        """
        at = FIRST_DATAGRAM
        if size > FIRST_DATAGRAM + VLAN_TAG and frame[12] == 0x81 and not frame[13]:
            at += VLAN_TAG
        if size < at or frame[at - 4] != 0x88 or frame[at - 3] != 0xA4:
            return False
        header = frame[at - 2] | frame[at - 1] << 8
        end = at + (header & LENGTH_MASK)
        if header >> 12 != TYPE_DATAGRAMS or end > size:
            return False
        frame[6] |= LOCAL_BIT
        while at + DATAGRAM_HEADER + COUNTER <= end:
            command, _, address, offset, flags, event = HEADER.unpack_from(frame, at)
            length = flags & LENGTH_MASK
            data = at + DATAGRAM_HEADER
            behind = data + length
            if behind + COUNTER > end:
                break
            if _FIRST_LOGICAL <= command <= _LAST_LOGICAL:
                count = self._logical(frame, command, address | offset << 16, data, length, t)
            elif command in _MULTIPLE_WRITE:
                count = self._multiple(frame, command, at, address, offset, length, t)
            else:
                count = self._physical(frame, command, at, address, offset, length, t)
            if count:
                count += frame[behind] | frame[behind + 1] << 8
                frame[behind] = count & 0xFF
                frame[behind + 1] = count >> 8 & 0xFF
            if self._event:
                event |= self._event
                frame[at + 8] = event & 0xFF
                frame[at + 9] = event >> 8
            if not flags & MORE_FOLLOWS:
                break
            at = behind + COUNTER
        return True

    def _logical(self, frame: bytearray, command: int, address: int, data: int, length: int, t: int) -> int:
        plan = self._plans.get((command, address, length))
        if plan is None:
            plan = self._make_plan(command, address, length)
        image = self._outputs
        for at, place, size in plan.outputs:
            image[place : place + size] = frame[data + at : data + at + size]
        for at, shift, mask, place, image_shift, kept_bits in plan.output_bits:
            image[place] = image[place] & kept_bits | (frame[data + at] >> shift & mask) << image_shift
        image = self._inputs
        for at, place, size in plan.inputs:
            frame[data + at : data + at + size] = image[place : place + size]
        for at, shift, mask, place, image_shift, _ in plan.input_bits:
            byte = frame[data + at] & ~(mask << shift) | (image[place] >> image_shift & mask) << shift
            frame[data + at] = byte
        if plan.written or plan.by_transfer:
            self.completed.append(plan)
        count = plan.counter
        miscounts = self._miscounts
        if plan.by_transfer:
            content = frame[data : data + length]
            for esc, parts in plan.by_transfer:
                share = transfer(esc, command, parts, content, t)
                count += share - self._kept_back(esc, share) if miscounts else share
            frame[data : data + length] = content
        if miscounts:
            count -= sum(self._kept_back(esc, share) for esc, share in plan.shares)
        return count

    def _kept_back(self, esc: Esc, share: int) -> int:
        """Return the part of a slave's working counter share that a fault omits."""
        if share:
            for slave, strikes in self._miscounts:
                if slave.esc is esc and strikes():
                    return share
        return 0

    def _make_plan(self, command: int, address: int, length: int) -> Plan:
        if self._passing:
            # The images belong to the permanent wire.
            return Plan(by_transfer=[(esc, touched(esc, address, length)) for esc in self._escs])
        if len(self._plans) >= MOST_KNOWN:
            self._plans.clear()
        if not self._plans:
            self._lay_out_images()
        plan = compile_plan(self._escs, self._places, command, address, length)
        self._plans[command, address, length] = plan
        return plan

    def _lay_out_images(self) -> None:
        """Put all buffers of a direction, in the order of the wire, into one image: neighbours need a single copy."""
        images = {True: bytearray(), False: bytearray()}
        self._places = {}
        buffered = [m for esc in self._escs for m in esc.sync_managers if m.enabled and not m.mailbox]
        for manager in buffered:
            image = images[manager.master_writes]
            self._places[manager] = len(image)
            image += manager.buffer
        for manager in buffered:
            place = self._places[manager]
            manager.buffer = memoryview(images[manager.master_writes])[place : place + manager.length]
        self._outputs, self._inputs = images[True], images[False]

    def _physical(self, frame: bytearray, command: int, at: int, address: int, offset: int, length: int,
                  t: int) -> int:  # fmt: skip
        """Process a datagram by position, station or broadcast; return the increment of the working counter."""
        if command in _AUTO or command in _BROADCAST:
            self._pass_position(frame, at, address)
        data = at + DATAGRAM_HEADER
        end = data + length
        count = 0
        write_weight = 2 if command in _READ_WRITES else 1
        for slave in self._addressed(command, address):
            incoming = bytes(frame[data:end])
            here = t + slave.delay
            if command in _READS:
                content = slave.esc.read(offset, length, here)
                if content is not None:
                    count += 1
                    if command in _BROADCAST:
                        merged = int.from_bytes(content, "little") | int.from_bytes(incoming, "little")
                        content = merged.to_bytes(length, "little")
                    frame[data:end] = content
            if command in _WRITES and slave.esc.write(offset, incoming, here):
                count += write_weight
        return count

    def _pass_position(self, frame: bytearray, at: int, address: int) -> None:
        """Add one to the position in the datagram for every slave."""
        after = address + len(self.slaves)
        frame[at + 2], frame[at + 3] = after & 0xFF, after >> 8 & 0xFF

    def _addressed(self, command: int, address: int) -> Sequence[Slave]:
        """Return the slaves addressed by position, station or broadcast."""
        if command in _BROADCAST:
            return self.slaves
        if command in _AUTO:
            position = -address & 0xFFFF
            return self.slaves[position : position + 1]
        if command in _STATION:
            addressed = self._stations.get(address)
            if addressed is None:
                addressed = tuple(slave for slave in self.slaves if slave.esc.answers_to(address))
                if len(self._stations) >= MOST_KNOWN:
                    self._stations.clear()
                self._stations[address] = addressed
            return addressed
        return ()

    def _multiple(self, frame: bytearray, command: int, at: int, address: int, offset: int, length: int,
                  t: int) -> int:  # fmt: skip
        """Process ARMW and FRMW: the addressed slave reads, all others write the datagram's present data."""
        data = at + DATAGRAM_HEADER
        end = data + length
        count = 0
        # The clocks are steered after the answer is sent; it does not depend on them.
        steering = offset == Register.DC_SYSTEM_TIME and length in _TIME_LENGTHS
        for followers, reader in self._order(command, address, steering):
            if steering:
                if followers:
                    self.references.append((followers, int.from_bytes(frame[data : data + 4], "little"), t))
                    count += len(followers)
            else:
                content = bytes(frame[data:end])
                count += sum(slave.esc.write(offset, content, t + slave.delay) for slave in followers)
            if reader is None:
                continue
            here = t + reader.delay
            if steering and reader.clock is not None and reader.clock.bits:
                time = reader.clock.shown(reader.clock.system(here))
                frame[data:end] = time.to_bytes(8, "little")[:length]
                count += 1
            elif (read := reader.esc.read(offset, length, here)) is not None:
                frame[data:end] = read
                count += 1
        if command == DatagramCommand.ARMW:
            self._pass_position(frame, at, address)
        return count

    def _order(self, command: int, address: int, steering: bool) -> list[tuple[list[Slave], Slave | None]]:
        """Return groups of writing slaves and the reading one after each; for steering only slaves with a clock."""
        key = (command, address, steering)
        groups = self._orders.get(key)
        if groups is not None:
            return groups
        groups = []
        writers: list[Slave] = []
        readers = self._addressed(command, address)
        for slave in self.slaves:
            if slave in readers:
                groups.append((writers, slave))
                writers = []
            elif not steering or (slave.clock is not None and slave.clock.bits):
                writers.append(slave)
        groups.append((writers, None))
        if len(self._orders) >= MOST_KNOWN:
            self._orders.clear()
        self._orders[key] = groups
        return groups
