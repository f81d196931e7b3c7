"""The bus `inprocess`: the virtual segment without sockets, in simulated time, deterministic.

It implements `rtcp.fieldbus.bus` (Bus, ProcessData). A small master writes registers and objects of the slaves
directly, sets them up with the code of the real bus, and passes one LRW frame a cycle through the segment: AL states,
watchdogs, SYNC0 supervision and working counters are the segment's. Omitted: drift and delay of the clocks (all show
the simulated time plus one offset), and the duration of services.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from random import Random
from types import SimpleNamespace
from typing import Any, cast

from mypy_extensions import mypyc_attr

from rtcp.config.model import DeviceDescription, SlaveConfig
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import PortErrors, SlaveInfo, SlaveState, slave_label, station_of
from rtcp.fieldbus.clocks import sync_cycles
from rtcp.fieldbus.drive_settings import check_settings
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import parse_emergency
from rtcp.fieldbus.pdo import layout as image_of
from rtcp.fieldbus.registers import Steps, finish
from rtcp.fieldbus.slave_setup import configure_slave, identity_faults, with_written
from rtcp.ipc.codes import state_name
from rtcp.ipc.events import EmergencyMessage
from rtcp.virtual import coe, protocol
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.objects import SdoAbort
from rtcp.virtual.protocol import AlState as VirtualAlState
from rtcp.virtual.segment import Segment
from rtcp.virtual.slave import Slave

_EPOCH_NS = 1_000_000_000
"""Least time of the reference clock at the begin, ns."""
_MAILBOX_HEADER = 6


class InProcessSlave:
    """The master's view of a slave of the segment; also its SDO client and its register port."""

    def __init__(self, slave: Slave, bus: InProcessBus, position: int) -> None:
        self.virtual = slave
        self.device = slave.device
        self.position = position
        self.name = slave.device.identity.name
        self._bus = bus

    @property
    def state(self) -> AlState:
        """AL state that the slave reports."""
        return AlState(int(self.virtual.esc.state))

    @property
    def error(self) -> bool:
        """Error flag of the AL status."""
        return bool(self.virtual.esc.get(protocol.Register.AL_STATUS, 2) & protocol.ERROR_FLAG)

    @property
    def code(self) -> int:
        """AL status code."""
        return self.virtual.esc.get(protocol.Register.AL_STATUS_CODE, 2)

    @property
    def output_bytes(self) -> int:
        """Length of its outputs by the PDO assignment."""
        return sum(self.length(index) for index in self.device.roles.outputs)

    @property
    def input_bytes(self) -> int:
        """Length of its inputs by the PDO assignment."""
        return sum(self.length(index) for index in self.device.roles.inputs)

    def length(self, index: int) -> int:
        """Length of a sync manager's data by its PDO assignment, bytes."""
        image = self.device.image(index)
        return 0 if image is None else image.byte_length

    def status(self) -> SlaveState:
        """Return its AL status."""
        return SlaveState(
            self.position, station_of(self.position), self.name, self.state, self.error, self.code
        )  # fmt: skip

    # -- registers and objects, for `configure_slave` -------------------------------------------------------------

    def read(self, station: int, address: int, length: int) -> bytes | None:
        """Read registers; `station` is ignored."""
        return self.virtual.esc.read(address, length, self._bus.now_ns)

    def write(self, station: int, address: int, data: bytes) -> bool:
        """Write registers and let the firmware act on them."""
        written = self.virtual.esc.write(address, data, self._bus.now_ns)
        self._bus.segment.settle(self._bus.now_ns)
        return written

    def reading(self, index: int, subindex: int, complete: bool = False) -> Steps[bytes]:
        """Read an object; raises SdoAborted, or BusError in INIT."""
        try:
            return coe.read(self.device.objects, index, subindex, complete, self._mailbox_state())
        except SdoAbort as abort:
            raise self._aborted("read", index, subindex, abort) from abort
        yield

    def writing(self, index: int, subindex: int, data: bytes, complete: bool = False) -> Steps[None]:
        """Write an object; raises as `reading`."""
        try:
            coe.write(self.device.objects, index, subindex, complete, self._mailbox_state(), data)
        except SdoAbort as abort:
            raise self._aborted("write", index, subindex, abort) from abort
        return
        yield

    def reading_int(self, index: int, subindex: int) -> Steps[int]:
        """Read an object as an unsigned integer."""
        return int.from_bytes((yield from self.reading(index, subindex)), "little")

    def writing_int(self, index: int, subindex: int, value: int, length: int) -> Steps[None]:
        """Write an unsigned integer of `length` bytes."""
        return self.writing(index, subindex, value.to_bytes(length, "little"))

    def _mailbox_state(self) -> int:
        if self.device.roles.mailboxes is None or self.device.coe is None:
            raise BusError(f"{slave_label(self.position, self.name)} has no CoE: its device file needs `coe: false`")
        if self.state < AlState.PREOP:
            raise BusError(f"{slave_label(self.position, self.name)} is in INIT, where it has no mailbox")
        return int(self.state)

    def _aborted(self, verb: str, index: int, subindex: int, abort: SdoAbort) -> SdoAborted:
        where = slave_label(self.position, self.name)
        text = f"{where} refused to {verb} 0x{index:04X}:{subindex} with abort code 0x{abort.code:08X}"
        return SdoAborted(text, abort.code)

    def emergencies(self) -> Iterable[EmergencyMessage]:
        """Yield the emergency messages in its mailbox."""
        if self.device.roles.mailboxes is None:
            return
        mailbox = self.virtual.esc.sync_managers[self.device.roles.mailboxes[1]]
        while mailbox.enabled and mailbox.full:
            message = self.read(0, mailbox.start, mailbox.length) or b""
            self._bus.segment.settle(self._bus.now_ns)
            emergency = parse_emergency(message[_MAILBOX_HEADER:], self.position)
            if emergency is not None:
                yield emergency


@mypyc_attr(native_class=False)  # tests replace its methods
class InProcessData:
    """The process image (ProcessData): one LRW frame for all slaves. `InProcessBus.configure` makes it.

    `lose` drops frames; `heard` tells whether the last `send` reached the slaves.
    """

    def __init__(self, bus: InProcessBus) -> None:
        slaves = bus.slaves
        self._bus = bus
        self._random = bus.random
        self._lengths = [slave.output_bytes for slave in slaves]
        inputs = [slave.input_bytes for slave in slaves]
        self.expected_wkc = sum(2 * bool(out) + bool(in_) for out, in_ in zip(self._lengths, inputs, strict=True))
        self.missed = 0
        self.stale = 0
        self.heard = False
        self.wkc = -1
        """Result of the last `receive`."""
        self.outputs = [bytes(length) for length in self._lengths]
        """Outputs of each slave in the next `send`."""
        self._data_at = protocol.FIRST_DATAGRAM + protocol.DATAGRAM_HEADER
        self._inputs_at = self._data_at + sum(self._lengths)
        self._places = []
        at = self._inputs_at
        for length in inputs:
            self._places.append((at, at + length))
            at += length
        self._counter_at = at
        length = at - self._data_at
        header = protocol.HEADER.pack(protocol.DatagramCommand.LRW, 0, 0, 0, length, 0)
        frame_header = (length + protocol.DATAGRAM_HEADER + protocol.COUNTER | protocol.TYPE_DATAGRAMS << 12).to_bytes(
            2, "little"
        )
        ethernet = b"\xff" * 6 + b"\x01" * 6 + protocol.ETHERTYPE.to_bytes(2, "big")
        self._empty = bytearray(ethernet + frame_header + header + bytes(length + protocol.COUNTER))
        self._answer: bytearray | None = None
        self.inputs = [bytes(length) for length in inputs]
        """Inputs of each slave in the last answer."""
        self._lost_out = self._lost_back = 0
        self.dc_time = self._shown = bus.now_ns + bus.offset_ns

    def lose(self, cycles: int, heard: bool | None = None) -> None:
        """Lose the next `cycles` frames: on the way back (`heard`) or out; None: at random. 0: lose no more."""
        if not cycles:
            self._lost_back = self._lost_out = 0
        if self._random.random() < 0.5 if heard is None else heard:
            self._lost_back = max(self._lost_back, cycles)
        else:
            self._lost_out = max(self._lost_out, cycles)

    def send(self) -> None:
        """Send the outputs."""
        self._answer = None
        self.heard = not self._lost_out
        if self._lost_out:
            self._lost_out -= 1
            return
        frame, now = self._empty[:], self._bus.now_ns
        frame[self._data_at : self._inputs_at] = b"".join(self.outputs)
        self._shown = now + self._bus.offset_ns
        answered = self._bus.segment.process(frame, len(frame), now)
        self._bus.settle()
        if self._lost_back:
            self._lost_back -= 1
        elif answered:
            self._answer = frame

    def receive(self) -> int:
        """Return the working counter of the answer, -1: none; inputs and `dc_time` then stay."""
        answer = self._answer
        if answer is None:
            self.missed += 1
            self.wkc = -1
            return -1
        self.inputs = [bytes(answer[first:end]) for first, end in self._places]
        self.dc_time = self._shown
        self.wkc = answer[self._counter_at] | answer[self._counter_at + 1] << 8
        return self.wkc

    def input(self, index: int) -> bytes:
        """Return the inputs of slave `index` of the last answer."""
        return self.inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of slave `index` for the next `send`; data of another length is ignored."""
        if len(data) == self._lengths[index]:
            self.outputs[index] = data


class InProcessBus:
    """A segment and its master in one object; its user advances the time by `advance_to` between two exchanges.

    Args:
        devices: the models in the order of the cable.
        seed: seed of the reference clock's offset and of the direction in which a frame is lost.
        now_ns: initial time, ns.
    """

    def __init__(self, devices: Sequence[DeviceModel], seed: int = 0, now_ns: int = 0) -> None:
        self.random = Random(seed)
        self.notes: list[str] = []
        self.devices: tuple[DeviceDescription, ...] = ()
        """Descriptions of the slaves after `configure`, with the own values of drives (`check_settings`)."""
        self.now_ns = now_ns
        self.offset_ns = _EPOCH_NS + self.random.randrange(_EPOCH_NS)
        """Reference clock minus simulated time, ns."""
        clock_ns = now_ns + self.offset_ns
        for device in devices:
            device.join(devices)
        virtual = [Slave(device, b"", 0.0, clock_ns, 0, now_ns) for device in devices]
        self.segment = Segment(virtual, now_ns)
        self.slaves = [InProcessSlave(slave, self, position) for position, slave in enumerate(virtual, 1)]
        self._configs: list[SlaveConfig] = []
        self._period_ns = 0

    # -- Bus --------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Do nothing: there is no interface."""

    def scan(self) -> tuple[SlaveInfo, ...]:
        """Bring the slaves to PRE-OP and return their descriptions."""
        self.request_state(AlState.PREOP)
        return tuple(map(_info, self.slaves))

    def configure(self, slaves: Sequence[SlaveConfig], period_ns: int) -> InProcessData:
        """Compare the segment with `slaves`, set the slaves up, bring them to SAFE-OP with all outputs 0.

        Raises:
            BusError: the bus differs from the configuration, or a slave refuses.
        """
        identities = [(slave.device.identity, slave) for slave in self.slaves]
        pysoem_like = [SimpleNamespace(man=who.vendor_id, id=who.product_code, name=who.name) for who, _ in identities]
        if faults := identity_faults(pysoem_like, slaves):
            raise BusError(*faults)
        self._configs, self._period_ns = list(slaves), period_ns
        self.notes = [note for slave in self.slaves for note in self.set_up(slave.position)]
        checked = [
            finish(check_settings(cast(Any, slave), config)) for slave, config in zip(self.slaves, slaves, strict=True)
        ]
        self.devices = tuple(device for device, _ in checked)
        self.notes += [note for _, notes in checked for note in notes]
        self.request_state(AlState.SAFEOP)
        if refused := self.wait_for_state(AlState.SAFEOP, 0.0):
            raise BusError(*refused)
        return InProcessData(self)

    def note_written(self, position: int, index: int, sub_index: int, data: bytes) -> None:
        """Note an SDO that a client has written, for the slave's next set-up."""
        self._configs[position - 1] = with_written(self._configs[position - 1], index, sub_index, data)

    def set_up(self, position: int) -> list[str]:
        """Bring a slave to PRE-OP and configure it; return tolerated deviations. Raises BusError where it refuses."""
        slave, config = self._slave(position), self._configs[position - 1]
        slave.name = config.name
        self.request_state(AlState.PREOP, [position])
        client = cast(Any, slave)
        notes = finish(configure_slave(client, client, 0, config, self._period_ns))
        # From the configuration: later slaves may still have another mapping.
        outputs = [image_of(entry.device.rpdo).bytes for entry in self._configs]
        inputs = [image_of(entry.device.tpdo).bytes for entry in self._configs]
        actual, expected = (slave.output_bytes, slave.input_bytes), (outputs[position - 1], inputs[position - 1])
        if actual != expected:
            raise BusError(
                f"{slave_label(position, config.name)} has {actual[0]} bytes of outputs and {actual[1]} of inputs, its "
                f"device file {expected[0]} and {expected[1]} (keys `rpdo` and `tpdo`)"
            )
        roles = slave.device.roles
        self._map(slave, roles.outputs, sum(outputs[: position - 1]), 0)
        self._map(slave, roles.inputs, sum(outputs) + sum(inputs[: position - 1]), len(roles.outputs))
        device = config.device
        clock = slave.virtual.clock
        if device.assign_activate and clock is not None:
            shift = round(device.sync0_shift_us * 1000)
            clock_ns = self.now_ns + self.offset_ns
            offset = clock_ns - clock.local(self.now_ns)
            slave.write(0, protocol.Register.DC_OFFSET, offset.to_bytes(8, "little", signed=True))
            sync0, after = sync_cycles(device, self._period_ns)
            start = clock_ns + (shift - clock_ns) % max(sync0, self._period_ns)
            slave.write(0, protocol.Register.DC_START_TIME, start.to_bytes(8, "little"))
            slave.write(0, protocol.Register.DC_SYNC0_CYCLE, sync0.to_bytes(4, "little") + after.to_bytes(4, "little"))
            slave.write(0, protocol.Register.DC_ACTIVATION, bytes((device.assign_activate >> 8,)))
        return notes

    def _map(self, slave: InProcessSlave, managers: Sequence[int], logical: int, first: int) -> None:
        """Configure the sync managers of a direction, in order, and their FMMUs from number `first` on
        (ETG.1000.4, 6.6 and 6.7)."""
        for fmmu, index in enumerate(managers, first):
            manager, length = slave.device.sync_managers[index], slave.length(index)
            if not length:
                continue
            start = manager.start.to_bytes(2, "little")
            head = start + length.to_bytes(2, "little")
            slave.write(
                0, protocol.Register.SYNC_MANAGER + protocol.SM_SIZE * index, head + bytes((manager.control, 0, 1, 0))
            )
            direction = 1 if index in slave.device.roles.inputs else 2
            setting = logical.to_bytes(4, "little") + length.to_bytes(2, "little") + b"\x00\x07"
            slave.write(
                0,
                protocol.Register.FMMU + protocol.FMMU_SIZE * fmmu,
                setting + start + bytes((0, direction, 1, 0, 0, 0)),
            )
            logical += length

    def request_state(self, state: int, positions: Iterable[int] | None = None) -> None:
        """Request `state` of the slaves at `positions`, None: of all; a lower state acknowledges an error."""
        for slave in self._at(positions):
            if state >= AlState.PREOP and slave.state == AlState.INIT:
                for number in slave.device.roles.mailboxes or ():
                    manager = slave.device.sync_managers[number]
                    head = manager.start.to_bytes(2, "little") + manager.length.to_bytes(2, "little")
                    settings = head + bytes((manager.control, 0, 1, 0))
                    slave.write(0, protocol.Register.SYNC_MANAGER + protocol.SM_SIZE * number, settings)
            acknowledge = protocol.ERROR_FLAG if slave.error and state < slave.state else 0
            slave.write(0, protocol.Register.AL_CONTROL, (int(state) | acknowledge).to_bytes(2, "little"))
        self.settle()

    def wait_for_state(self, state: int, timeout_s: float, positions: Iterable[int] | None = None) -> tuple[str, ...]:
        """Return a sentence for each slave that is not in `state`; no time passes."""
        return tuple(
            f"{slave_label(slave.position, slave.name)} is in {slave.status().words()}, {state_name(int(state))} was "
            "requested"
            for slave in self._at(positions)
            if slave.state != state or slave.error
        )

    def acknowledge(self, position: int) -> None:
        """Acknowledge a slave's error: clears the error indication, keeps the state."""
        slave = self._slave(position)
        slave.write(0, protocol.Register.AL_CONTROL, (int(slave.state) | protocol.ERROR_FLAG).to_bytes(2, "little"))

    def read_states(self) -> tuple[SlaveState, ...]:
        """Return the AL status of every slave."""
        return tuple(slave.status() for slave in self.slaves)

    def emergencies(self) -> tuple[EmergencyMessage, ...]:
        """Return the emergency messages that came since the last call."""
        return tuple(emergency for slave in self.slaves for emergency in slave.emergencies())

    def sdo(self, position: int) -> InProcessSlave:
        """Return SDO access to a slave."""
        return self._slave(position)

    def sdo_read(self, position: int, index: int, subindex: int) -> bytes:
        """Return an object's value; raises SdoAborted, or BusError where there is no mailbox or no such slave."""
        return finish(self._slave(position).reading(index, subindex))

    def sdo_write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object's value; raises as `sdo_read`."""
        finish(self._slave(position).writing(index, subindex, data))

    def close(self) -> None:
        """Bring the slaves back to INIT; may be called at any time, also twice."""
        self.request_state(AlState.INIT)

    # -- time and faults --------------------------------------------------------------------------------------------

    def advance_to(self, now_ns: int) -> None:
        """Advance the time to `now_ns`, with every event of the segment at its instant."""
        segment = self.segment
        while segment.next_event <= now_ns:
            self.now_ns = max(self.now_ns, segment.next_event)
            segment.tick(self.now_ns)
            while segment.busy:
                segment.step_one()
        self.now_ns = max(now_ns, self.now_ns)

    def settle(self) -> None:
        """Let the slaves process the master's writes, and step their devices."""
        segment = self.segment
        segment.settle(self.now_ns)
        while segment.busy:
            segment.step_one()

    def drop(self, position: int, state: int, code: int) -> None:
        """Let a slave leave its state by itself, with an AL status code."""
        self._slave(position).virtual.application.fall(VirtualAlState(state), code)

    def restart(self, position: int) -> None:
        """Switch a slave's supply off and on again."""
        self.segment.topology.restart(self._slave(position).virtual, self.now_ns)
        self.segment.rewire()

    def _slave(self, position: int) -> InProcessSlave:
        if not 1 <= position <= len(self.slaves):
            raise BusError(f"there is no slave {position}; the bus has slaves 1 to {len(self.slaves)}")
        return self.slaves[position - 1]

    def _at(self, positions: Iterable[int] | None) -> list[InProcessSlave]:
        return self.slaves if positions is None else [self._slave(position) for position in positions]


def _info(slave: InProcessSlave) -> SlaveInfo:
    identity, status = slave.device.identity, slave.status()
    return SlaveInfo(
        slave.position, status.station, identity.name, identity.vendor_id, identity.product_code, identity.revision,
        identity.serial, 0, status.words(), status.code, "", True, None, (), (), 8 * slave.output_bytes,
        8 * slave.input_bytes, (), 0, slave.device.supports_dc, 0, (), slave.position - 1,
        1, PortErrors(),
    )  # fmt: skip
