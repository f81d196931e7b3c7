"""The bus behind pysoem: a network interface, real or one end of the virtual segment's pair."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from pysoem import pysoem

from rtcp.config.drive_limits import with_limits
from rtcp.config.model import ArmConfig, DeviceDescription, SlaveConfig
from rtcp.esi.model import Device, EsiError
from rtcp.esi.sii import read_sii
from rtcp.fieldbus import al_state
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import LARGEST_MAILBOX, MailboxInfo, PdoInfo, SlaveInfo, SlaveState, slave_label, station_of
from rtcp.fieldbus.clocks import clocks_of, measure_delays, start_clocks
from rtcp.fieldbus.describe import describe_device, pdos_of_eeprom
from rtcp.fieldbus.drive_settings import check_settings
from rtcp.fieldbus.eeprom import (
    BOOTSTRAP_WORD,
    Progress,
    eeprom_to_device,
    eeprom_to_master,
    read_eeprom,
    write_eeprom,
)
from rtcp.fieldbus.errors import BusError, Refused
from rtcp.fieldbus.foe import FoeClient, bootstrap_mailbox, enter_boot
from rtcp.fieldbus.image import MOST_SLAVES, Places, limit_faults, read_places
from rtcp.fieldbus.interface import PromiscuousMode, check_interface, check_name, claim, enter
from rtcp.fieldbus.mailbox import Mailbox, Mailboxes, SdoClient
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.other_masters import OtherMasters, other_master_words
from rtcp.fieldbus.pdo import ASSIGN, ImageLayout, assignments, entries_of, layout, mapping_of, mapping_text
from rtcp.fieldbus.process_data import FrameBarrier, ReferenceFrame, SoemProcessData
from rtcp.fieldbus.registers import PATIENT_TRIES, TRIES, Register, RegisterPort, attach_filter, finish
from rtcp.fieldbus.scan import describe, eeprom_sync_managers, name_of, read_mailbox, read_serial, watchdog_off
from rtcp.fieldbus.slave_setup import (
    SlaveRestorer,
    by_alias,
    configure_slave,
    identity_faults,
    read_set_up,
    trigger_watchdog,
)
from rtcp.fieldbus.supervision import SlaveWatcher, SupervisedBus
from rtcp.fieldbus.system_time import SystemTime
from rtcp.fieldbus.topology import Topology, port_states
from rtcp.ipc.events import EmergencyMessage, Event

_LEAVE_OP_S, _INIT_S = 0.2, 1.0
_BELOW_SAFEOP = 0x03
"""Bits of the AL state that INIT, PRE-OP and BOOT have, OP and SAFE-OP have not."""
_MAP_ATTEMPTS = 8
_DISCOVERY_ATTEMPTS = 4
"""Attempts of `_PATIENCE_US` each: a host that runs master and slaves may stall for longer than one."""
_MAILBOXES, _MAILBOXES_SIZE = 2, 16
"""Sync managers of a slave's mailboxes, and the bytes of their registers (ETG.1000.4, 6.7)."""
_SYNC_MANAGER = struct.Struct("<HHBBBB")
_RECEIVES, _SENDS = 0x26, 0x22
"""Control byte of a mailbox's sync manager: one buffer, written by the master with an event for the slave, or read."""


_SOEM_LAST_INDEX = 15
_SDO_TIMEOUT_US = 700_000
_ANSWER_US, _PATIENCE_US = 40_000, 500_000
"""Time until SOEM repeats a frame, and until it gives up, us; outside the cycle."""


class SoemBus:
    """`Bus` over pysoem. One thread exchanges process data; another may call the other methods meanwhile."""

    def __init__(
        self,
        interface: str,
        receive_fraction: float = 0.3,
        *,
        namespace_pid: int | None = None,
        state_timeout_s: float = 5.0,
    ) -> None:
        """Prepare a bus; nothing is touched before `open`.

        Args:
            interface: network interface.
            receive_fraction: how long an answer is waited for, as a fraction of the period.
            namespace_pid: process whose network (and user) namespace has the interface.
            state_timeout_s: seconds for a slave to change its state on the way to SAFE-OP.
        """
        self.interface = interface
        self.notes: list[str] = []
        self.system_time = SystemTime()
        self.devices: tuple[DeviceDescription, ...] = ()
        """Descriptions of the slaves after `configure`, with the own values of drives (`check_settings`)."""
        self._fraction = receive_fraction
        self._pid = namespace_pid
        self._state_timeout_s = state_timeout_s
        self._master: Any = None
        self._socket: socket.socket | None = None
        self._claim: socket.socket | None = None
        self._promiscuous: PromiscuousMode | None = None
        self._others: OtherMasters | None = None
        self._port: RegisterPort | None = None
        self._barrier: FrameBarrier | None = None
        self._reference: ReferenceFrame | None = None
        self._names: list[str] = []
        self._infos: list[MailboxInfo | None] = []
        self._serials: list[int] = []
        self._boxes: Mailboxes | None = None
        self._restorer: SlaveRestorer | None = None
        self._topology: Topology | None = None

    def __enter__(self) -> SoemBus:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def port(self) -> RegisterPort:
        """The port for registers; raises BusError while the bus is closed."""
        if self._port is None:
            raise BusError(f"the bus on {self.interface} is not open")
        return self._port

    @property
    def _mailboxes(self) -> Mailboxes:
        if self._port is None or self._boxes is None:
            raise BusError(f"the bus on {self.interface} is not open")
        return self._boxes

    def open(self) -> None:
        """Join the namespace, open the interface.

        Raises:
            BusError: no such interface, the interface is down, or no right to open it.
        """
        if self._master is not None:
            return
        if self._pid is not None:
            enter(self._pid)
        check_interface(self.interface)
        self._claim = claim(self.interface)
        try:
            self._others = OtherMasters(self.interface)
            self._port = RegisterPort(self.interface)
            self._port.tries = PATIENT_TRIES
            self._barrier = FrameBarrier(self.interface)
            self._promiscuous = PromiscuousMode(self.interface)
            self._master, self._socket = open_master(self.interface)
        except BaseException:
            self.close()
            raise

    def other_master(self) -> str:
        """Return the sentence for a second master that was heard since the bus was opened; empty: none was."""
        address = "" if self._others is None else self._others.address()
        return other_master_words(address) if address else ""

    @contextlib.contextmanager
    def naming_other_master(self) -> Iterator[None]:
        """Add `other_master` to a BusError as its probable cause."""
        try:
            yield
        except BusError as error:
            cause = self.other_master()
            if not cause or isinstance(error, Refused):
                raise
            raise BusError(*error.sentences, cause) from error

    def scan(self) -> tuple[SlaveInfo, ...]:
        """Find the slaves, bring them to PRE-OP, measure delays; return their descriptions.

        Raises:
            BusError: no slave answers.
        """
        self._discover()
        self._to_preop()
        labels = {i: slave_label(i, name) for i, name in enumerate(self._names, 1)}
        try:
            delays: dict[int, int] = measure_delays(self.port, labels, clocks_of(self.port, labels))
        except BusError:
            # A scan is for a bus that is not in order, too.
            delays = {}
        slaves = self._describe()
        tree = Topology.of([info.ports for info in slaves])
        return tuple(
            replace(
                info,
                delay_ns=delays.get(info.position),
                parent=tree.parent(info.position),
                parent_port=tree.port(info.position),
                watchdog_off=watchdog_off(self.port, station_of(info.position)),
            )
            for info in slaves
        )

    def _describe(self) -> tuple[SlaveInfo, ...]:
        return tuple(
            describe(slave, self._mailboxes.sdo(i + 1), self.port, station_of(i + 1), self._infos[i], self._serials[i])
            for i, slave in enumerate(self._master.slaves)
        )

    def configure(self, slaves: Sequence[SlaveConfig], period_ns: int) -> SoemProcessData:
        """Bring the slaves from INIT to SAFE-OP as configured, with outputs of zero.

        Args:
            slaves: the slaves expected, in the order of the cable.
            period_ns: the cycle.

        Raises:
            BusError: the bus differs from the configuration, or a slave refuses.
        """
        if faults := limit_faults(slaves):
            raise BusError(*faults)
        failures = [0] * len(slaves)
        for attempt in range(1, _MAP_ATTEMPTS + 1):
            # SOEM appends to a mapping that it has begun: each attempt starts from INIT.
            self._set_up(slaves, period_ns, failures)
            misread = self._map(slaves)
            if not misread:
                break
            if attempt == _MAP_ATTEMPTS:
                raise BusError(*(sentence for sentences in misread.values() for sentence in sentences))
            for position in misread:
                failures[position - 1] += 1
        places = read_places(self.port, slaves)
        self._trigger_watchdogs(slaves)
        self.system_time, reference = start_clocks(self._master, self.port, slaves, period_ns)
        self._reference = None if reference is None else ReferenceFrame(self.interface, station_of(reference))
        data = self._process_data(places, period_ns)
        # Valid outputs, all zero, are in the slaves' buffers before any of them may use them.
        data.send()
        data.receive()
        self.request_state(AlState.SAFEOP)
        if refused := self.wait_for_state(AlState.SAFEOP, self._state_timeout_s):
            raise BusError(*refused)
        set_ups = [
            read_set_up(self.port, position, config.name, serial)
            for position, (config, serial) in enumerate(zip(slaves, self._serials, strict=True), 1)
        ]
        self._topology = self._read_topology()
        sdo = self._mailboxes.sdo
        self._restorer = SlaveRestorer(self.port, slaves, set_ups, sdo, period_ns, self.system_time)
        # From here on a cycle runs, and the watcher needs to learn of losses soon.
        self.port.tries = TRIES
        return data

    def _read_topology(self) -> Topology:
        status = [self.port.read(station, Register.DL_STATUS, 2) for station in self._stations(None)]
        return Topology.of([port_states(int.from_bytes(register or b"", "little")) for register in status])

    def _set_up(self, slaves: Sequence[SlaveConfig], period_ns: int, failures: Sequence[int]) -> None:
        """Bring the slaves from INIT to PRE-OP, each set up as configured; raises BusError.

        SOEM reads a slave's mapping by complete access first; after a failure it alternates with single subindices:
        some slaves answer complete access wrongly, and single subindices take many frames, any of which may be lost.
        For several slaves of one identity it reads the first one's mapping, and copies it where it knows no mailbox.
        """
        self.notes.clear()
        self._discover()
        faults = identity_faults(self._master.slaves, slaves)
        if faults:
            raise BusError(*faults)
        self._names[:] = [config.name for config in slaves]
        for position, (info, config) in enumerate(zip(self._infos, slaves, strict=True), 1):
            label = slave_label(position, config.name)
            if config.device.coe and (info is None or "CoE" not in info.protocols):
                faults.append(
                    f"{label}: its EEPROM lists no CoE mailbox (words 0x18 to 0x1C, and category 41), but its device's "
                    "file says `coe: true`: write the maker's image with `rtcp eeprom write`, or, if the device has no "
                    "CoE, say `coe: false`"
                )
            elif info is not None and not info.fits:
                size = max(info.receive_size, info.send_size)
                faults.append(
                    f"{label}: its EEPROM gives a mailbox of {size} bytes; SOEM has room for {LARGEST_MAILBOX}"
                )
            elif info is not None and info.of_sync_managers:
                self.notes.append(
                    f"{label}: its EEPROM gives no mailbox sizes (words 0x18 to 0x1B); those of its sync managers are "
                    f"used: {info.receive_size} bytes at 0x{info.receive_start:04X} to the slave, "
                    f"{info.send_size} bytes at 0x{info.send_start:04X} from it"
                )
        if faults:
            raise BusError(*faults)
        first_of: dict[tuple[object, ...], int] = {}
        for i, (config, slave) in enumerate(zip(slaves, self._master.slaves, strict=True)):
            device = config.device
            first = first_of.setdefault((slave.man, slave.id, slave.rev, device.rpdo, device.tpdo), i)
            # Without CoE SOEM would use SoE, where it does not recognize an error reply: 11 s for a slave.
            if not device.coe or (failures[i] <= failures[first] and i != first):
                self._hide_mailbox(slave, i + 1)
            elif failures[i] % 2 or not device.complete_access:
                slave._disable_complete_access()
        if faults := [*self._eeprom_faults(slaves), *self._to_preop()]:
            raise BusError(*faults)
        devices: list[DeviceDescription] = []
        for i, config in enumerate(slaves):
            try:
                sdo, station = self._mailboxes.sdo(i + 1), station_of(i + 1)
                self.notes += finish(configure_slave(sdo, self.port, station, config, period_ns))
                device, notes = finish(check_settings(sdo, config))
                devices.append(device)
                self.notes += notes
            except BusError as error:
                faults += error.sentences
        if faults:
            raise BusError(*faults)
        self.devices = tuple(devices)

    def _eeprom_faults(self, slaves: Sequence[SlaveConfig]) -> list[str]:
        """Return a sentence for each slave without CoE whose EEPROM maps other objects than its device's file."""
        faults = []
        known: dict[tuple[int, int, int], tuple[tuple[PdoInfo, ...], tuple[PdoInfo, ...]]] = {}
        for position, (config, slave) in enumerate(zip(slaves, self._master.slaves, strict=True), 1):
            device, identity = config.device, (slave.man, slave.id, slave.rev)
            if device.coe or not (device.rpdo or device.tpdo):
                continue
            if identity not in known:
                try:
                    known[identity] = pdos_of_eeprom(read_sii(self.read_eeprom(position, lambda part: None)))
                except EsiError as error:
                    faults.append(f"{slave_label(position, config.name)}: its EEPROM cannot be read: {error}")
                    continue
            for key, pdos, own in zip(("rpdo", "tpdo"), (device.rpdo, device.tpdo), known[identity], strict=True):
                mapping = tuple((pdo.index, tuple((e.index, e.sub_index, e.bits) for e in pdo.entries)) for pdo in own)
                # An EEPROM need not list PDOs; their lengths are compared all the same.
                if mapping and entries_of(mapping) != entries_of(mapping_of(pdos)):
                    faults.append(
                        f"{slave_label(position, config.name)}: the PDOs in its EEPROM differ from the device's file "
                        f"(key `{key}`): expected {mapping_text(mapping_of(pdos))}, found {mapping_text(mapping)}; "
                        "`rtcp device new --from-bus` describes it as it is"
                    )
        return faults

    def _hide_mailbox(self, slave: Any, position: int) -> None:
        """Let SOEM forget the mailbox of a slave that is in INIT; its registers keep it. Raises BusError."""
        if self._infos[position - 1] is None:
            return
        label = slave_label(position, self._names[position - 1])
        registers = self.port.read(station_of(position), Register.SYNC_MANAGER, _MAILBOXES_SIZE)
        if registers is None:
            raise BusError(f"{label} stopped answering while it was set up")
        self._amend_mailbox(slave, position, (0, 0), (0, 0), registers)

    def _set_mailbox(self, position: int, info: MailboxInfo) -> None:
        """Program the mailbox of a slave in INIT whose EEPROM gave SOEM no sizes, and tell SOEM. Raises BusError."""
        receive, send = (info.receive_start, info.receive_size), (info.send_start, info.send_size)
        registers = _SYNC_MANAGER.pack(*receive, _RECEIVES, 0, 1, 0) + _SYNC_MANAGER.pack(*send, _SENDS, 0, 1, 0)
        self._amend_mailbox(self._master.slaves[position - 1], position, receive, send, registers)

    def _amend_mailbox(
        self, slave: Any, position: int, receive: tuple[int, int], send: tuple[int, int], registers: bytes
    ) -> None:
        """Change start and size of the mailboxes that SOEM knows of a slave; then write the registers of both."""
        station, label = station_of(position), slave_label(position, self._names[position - 1])
        for mailbox, area in (("out", receive), ("in", send)):
            # This writes the registers first, in a frame that is not repeated; SOEM's own data change only after that.
            for _ in range(PATIENT_TRIES):
                with contextlib.suppress(pysoem.WkcError):
                    slave.amend_mbx(mailbox, *area)
                    break
        # An ESC takes address and length of a sync manager only while it is off.
        self.port.put(station, Register.SYNC_MANAGER, bytes(_MAILBOXES_SIZE), label)
        self.port.put(station, Register.SYNC_MANAGER, registers, label)

    def _discover(self) -> None:
        if self._master is None:
            raise BusError(f"the bus on {self.interface} is not open")
        answering = self.port.read_all(Register.AL_STATUS, 1).wkc
        if answering > MOST_SLAVES:
            raise BusError(f"{answering} slaves answer on {self.interface}; SOEM has room for {MOST_SLAVES}")
        # Also stops SYNC0 and SYNC1 that the last run left active, and resets FMMUs and sync managers (SOEM#60).
        if not any(self._master.config_init() > 0 for _ in range(_DISCOVERY_ATTEMPTS)):
            raise BusError(f"no slave answers on {self.interface}: check the cable and the slaves' supply")
        slaves = self._master.slaves
        self._names = [name_of(slave) for slave in slaves]
        self._infos = [
            read_mailbox(slave, partial(eeprom_sync_managers, self.port, station_of(position)))
            for position, slave in enumerate(slaves, 1)
        ]
        self._serials = [read_serial(slave) for slave in slaves]
        self._boxes = Mailboxes(self.port, self._names, self._infos)
        for position, info in enumerate(self._infos, 1):
            eeprom_to_device(self.port, station_of(position))
            if info is not None and info.of_sync_managers:
                self._set_mailbox(position, info)
        left = self.port.read_all(Register.DC_ACTIVATION, 1).data
        if any(left):
            raise BusError(f"SYNC0 of a slave on {self.interface} is still active and cannot be switched off")

    def _to_preop(self) -> tuple[str, ...]:
        stations = self._stations(None)
        al_state.request_state(self.port, stations, AlState.PREOP)
        return al_state.wait_for_state(self.port, stations, AlState.PREOP, self._state_timeout_s)

    def _map(self, slaves: Sequence[SlaveConfig]) -> dict[int, list[str]]:
        """Let SOEM lay out the process image; return sentences for each position whose images have a wrong length.

        Only the lengths decide, not the errors that SOEM reports: the mappings were compared entry by entry before, and
        SOEM corrects many errors by reading again.
        """
        reported: dict[int, list[str]] = {}
        # Where words 0x18 to 0x1B of the EEPROM are 0, SOEM knows no protocol, and takes the PDOs from the EEPROM, too.
        stations = [
            station_of(position)
            for position, (entry, info) in enumerate(zip(slaves, self._infos, strict=True), 1)
            if not entry.device.coe or (info is not None and info.of_sync_managers)
        ]
        for station in stations:
            # Their PDOs are in the EEPROM only, and SOEM assumes that the master still owns it after reading.
            eeprom_to_master(self.port, station)
        try:
            self._master.config_map()
        except pysoem.ConfigMapError as error:
            for fault in error.error_list:
                # SOEM also lists emergencies, as errors without a type.
                if isinstance(fault, pysoem.SdoError):
                    cause = f"object 0x{fault.index:04X}:{fault.subindex}: {fault.desc}"
                elif isinstance(fault, (pysoem.MailboxError, pysoem.PacketError)):
                    cause = _words(fault)
                else:
                    continue
                reported.setdefault(fault.slave_pos, []).append(cause)
        for station in stations:
            eeprom_to_device(self.port, station)
        faults: dict[int, list[str]] = {}
        for position, (config, slave) in enumerate(zip(slaves, self._master.slaves, strict=True), 1):
            images: dict[str, tuple[ImageLayout, bytes]] = {
                "rpdo": (layout(config.device.rpdo), slave.output), "tpdo": (layout(config.device.tpdo), slave.input)
            }  # fmt: skip
            for key, (expected, image) in images.items():
                if len(image) != expected.bytes:
                    # SOEM may report the same error hundreds of times.
                    causes = "; ".join(dict.fromkeys(reported.get(position, ())))
                    objects = " and ".join(
                        f"0x{ASSIGN + manager:04X}" for name, manager, _ in assignments(config.device) if name == key
                    )
                    origin = f"the PDO mapping assigned through {objects}" if config.device.coe else "the PDOs"
                    faults.setdefault(position, []).append(
                        f"{slave_label(position, config.name)}: SOEM could not read {origin} (key `{key}`): expected "
                        f"{expected.bytes} bytes, found {len(image)}"
                        + ("" if config.device.coe else " in its EEPROM")
                        + (f" ({causes})" if causes else "")
                    )
        return faults

    def _trigger_watchdogs(self, slaves: Sequence[SlaveConfig]) -> None:
        faults: list[str] = []
        for position, (config, mailbox) in enumerate(zip(slaves, self._infos, strict=True), 1):
            try:
                self.notes += trigger_watchdog(self.port, position, config, 0 if mailbox is None else _MAILBOXES)
            except BusError as error:
                faults += error.sentences
        if faults:
            raise BusError(*faults)

    def _process_data(self, places: Sequence[Places], period_ns: int) -> SoemProcessData:
        assert self._socket is not None
        assert self._barrier is not None
        period_us = period_ns / 1000
        receive_us = max(1, round(self._fraction * period_us))
        barrier_us = max(1, round(min(receive_us, 0.75 * period_us - receive_us)))
        return SoemProcessData(
            self._master, self._master.slaves, places, self._socket.fileno(), self._barrier, receive_us, barrier_us,
            self._reference,
        )  # fmt: skip

    def request_state(self, state: AlState, positions: Iterable[int] | None = None) -> None:
        """Request `state` of the slaves at `positions` (from 1), None: of all; nothing is waited for."""
        al_state.request_state(self.port, self._stations(positions), state)

    def wait_for_state(
        self, state: AlState, timeout_s: float, positions: Iterable[int] | None = None
    ) -> tuple[str, ...]:
        """Wait until the slaves are in `state`; return a sentence for each that is not."""
        return al_state.wait_for_state(self.port, self._stations(positions), state, timeout_s)

    def acknowledge(self, position: int) -> None:
        """Acknowledge a slave's error; it stays in the state that it is in."""
        al_state.acknowledge(self.port, station_of(position))

    def read_states(self) -> tuple[SlaveState, ...]:
        """Return the AL status of every slave; one frame while all are in OP."""
        all_of_them = self.port.read_all(Register.AL_STATUS, 2)
        in_op = all_of_them.wkc == len(self._names) and all_of_them.data == b"\x08\x00"
        result = []
        for position, name in enumerate(self._names, 1):
            station = station_of(position)
            state, error, code = (AlState.OP, False, 0) if in_op else al_state.read_al(self.port, station)
            result.append(SlaveState(position, station, name, state, error, code))
        return tuple(result)

    def emergencies(self) -> tuple[EmergencyMessage, ...]:
        """Return the emergency messages that came since the last call; without any it takes one frame."""
        return self._mailboxes.emergencies()

    def sdo(self, position: int) -> SdoClient:
        """Return SDO access to a slave, also in steps; raises BusError where there is no such slave."""
        return self._mailboxes.sdo(position)

    def discover(self) -> tuple[SlaveInfo, ...]:
        """Find the slaves, bring them to INIT with their mailboxes programmed; return their descriptions in INIT.

        Raises:
            BusError: no slave answers.
        """
        self._discover()
        return self._describe()

    def position_of(self, name: str, slaves: Sequence[SlaveConfig], present: Sequence[SlaveInfo]) -> int:
        """Return the position of the slave that the configuration calls `name`.

        With a station alias it may hang anywhere; without one the whole bus has to match the configuration.

        Args:
            name: a name in `slaves`.
            slaves: the slaves of the configuration.
            present: the slaves on the bus.

        Raises:
            BusError: it is not there, or another device is in its place.
        """
        wanted = next(slave for slave in slaves if slave.name == name)
        if not wanted.alias:
            ordered = by_alias(slaves, present)
            if faults := identity_faults(self._master.slaves, ordered):
                remedy = f"which slave is {name} is not certain without a station alias: give its position instead"
                raise BusError(*faults, remedy)
            return ordered.index(wanted) + 1
        by_alias([wanted], present)
        position = next(info.position for info in present if info.alias == wanted.alias)
        info, device = present[position - 1], wanted.device
        if (info.vendor_id, info.product_code) != (device.vendor_id, device.product_id):
            raise BusError(
                f"{slave_label(position, info.name)} has the station alias {wanted.alias} of {name}, but is vendor "
                f"0x{info.vendor_id:08X}, product 0x{info.product_code:08X}; expected {device.name} (vendor "
                f"0x{device.vendor_id:08X}, product 0x{device.product_id:08X}): give its position to reach it"
            )
        return position

    def boot(self, position: int) -> None:
        """Bring a slave to BOOT, where its firmware is written; `foe` then uses the slave's BOOT mailboxes.

        Raises:
            BusError: it has no BOOT, or refuses it.
        """
        station, label = station_of(position), slave_label(position, self._names[position - 1])
        words = read_eeprom(self.port, station, label, lambda part: None, 2 * BOOTSTRAP_WORD + 8)[2 * BOOTSTRAP_WORD :]
        mailbox = bootstrap_mailbox(words)
        if mailbox is None:
            raise BusError(f"{label}: its EEPROM lists no mailboxes for BOOT (words 0x14 to 0x17)")
        enter_boot(self.port, station, label, mailbox, self._state_timeout_s)
        self._infos[position - 1] = mailbox

    def foe(self, position: int) -> FoeClient:
        """Return access to the files of a slave; raises BusError where there is no such slave."""
        self._mailboxes.sdo(position)
        info = self._infos[position - 1]
        mailbox = None
        if info is not None and info.fits and "FoE" in info.protocols:
            mailbox = Mailbox(self.port, station_of(position), info)
        return FoeClient(mailbox, position, self._names[position - 1], *self._mailboxes.access(position))

    def describe_device(self, position: int, progress: Progress) -> Device:
        """Return the description of a slave in PRE-OP, source BUS; raises BusError or EsiError.

        Args:
            position: position on the cable, from 1.
            progress: receives the fraction that was read, 0 to 1.
        """
        sdo, info = self._mailboxes.sdo(position), self._infos[position - 1]
        has_coe = info is not None and info.has_coe
        eeprom = self.read_eeprom(position, (lambda part: progress(part / 10)) if has_coe else progress)
        origin = f"bus {self.interface}, {slave_label(position, self._names[position - 1])}"
        return describe_device(sdo, has_coe, eeprom, origin, lambda part: progress(0.1 + 0.9 * part))

    def with_eeprom_pdos(self, slave: SlaveInfo) -> SlaveInfo:
        """Add the PDOs that the EEPROM assigns to a slave without assignment objects; return any other unchanged."""
        if slave.outputs or slave.inputs:
            return slave
        with contextlib.suppress(EsiError):
            outputs, inputs = pdos_of_eeprom(read_sii(self.read_eeprom(slave.position, lambda part: None)))
            bits = [sum(pdo.bits for pdo in pdos) for pdos in (outputs, inputs)]
            return replace(slave, outputs=outputs, inputs=inputs, output_bits=bits[0], input_bits=bits[1])
        return slave

    def read_eeprom(self, position: int, progress: Progress, size: int | None = None) -> bytes:
        """Return the EEPROM of a slave, or its first `size` bytes; raises BusError."""
        label = slave_label(position, self._names[position - 1])
        return read_eeprom(self.port, station_of(position), label, progress, size)

    def write_eeprom(self, position: int, image: bytes, progress: Progress) -> int:
        """Write into the EEPROM of a slave from word 0 on; return how many words differed; raises BusError."""
        label = slave_label(position, self._names[position - 1])
        return write_eeprom(self.port, station_of(position), label, image, progress)

    def release(self) -> None:
        """Close everything and leave the slaves in their states."""
        self._names = []
        self.close()

    def note_written(self, position: int, index: int, sub_index: int, data: bytes) -> None:
        """Note an SDO that a client has written, for the slave's next set-up."""
        assert self._restorer is not None, "only a configured bus has something to restore"
        self._restorer.note_written(position, index, sub_index, data)

    def watcher(self, report: Callable[[Event], None]) -> SlaveWatcher:
        """Return the watcher of the configured slaves, all of them in OP; `report` receives its events."""
        assert self._restorer is not None, "only a configured bus has something to restore"
        return SlaveWatcher(self.port, len(self._names), self._restorer, report, self._topology, self._others)

    def _stations(self, positions: Iterable[int] | None) -> dict[int, str]:
        wanted = range(1, len(self._names) + 1) if positions is None else positions
        return {station_of(position): slave_label(position, self._names[position - 1]) for position in wanted}

    def close(self) -> None:
        """Bring the slaves back to INIT, switch SYNC off, close everything; may be called at any time, also twice."""
        try:
            if self._port is not None and self._names:
                self._to_init(self._port)
        except BusError as error:
            self.notes.append(f"the slaves on {self.interface} could not be brought back to INIT: {error}")
        finally:
            # The claim last: the next master must not start while this one still cleans up.
            sockets = (self._others, self._port, self._barrier, self._reference, self._socket)
            for part in (*sockets, self._master, self._promiscuous, self._claim):
                if part is not None:
                    part.close()
            self._others = self._port = self._barrier = self._reference = None
            self._socket = self._claim = self._promiscuous = self._master = None
            self._names = []

    def _to_init(self, port: RegisterPort) -> None:
        everyone = self._stations(None)
        # Drives come to rest on the way from OP to SAFE-OP. A slave below SAFE-OP would refuse that with an AL error.
        reported = port.read_all(Register.AL_STATUS, 2)
        if reported.wkc < 0:
            raise BusError("no frame comes back")
        if reported.data[0] & _BELOW_SAFEOP == 0:
            al_state.broadcast_state(port, AlState.SAFEOP)
            al_state.wait_for_state(port, everyone, AlState.SAFEOP, _LEAVE_OP_S)
        elif in_op := {
            station: label for station, label in everyone.items() if al_state.read_al(port, station)[0] is AlState.OP
        }:
            al_state.request_state(port, in_op, AlState.SAFEOP)
            al_state.wait_for_state(port, in_op, AlState.SAFEOP, _LEAVE_OP_S)
        al_state.broadcast_state(port, AlState.INIT)
        left = al_state.wait_for_state(port, everyone, AlState.INIT, _INIT_S)
        port.write_all(Register.DC_ACTIVATION, b"\0")
        if left:
            raise BusError(*left)


class SoemMaster(Master):
    """A bus of kind `ethercat`."""

    def __init__(self, config: ArmConfig, interface: str, namespace_pid: int) -> None:
        super().__init__(config, interface, namespace_pid)
        fraction = config.ethercat.receive_fraction
        self._bus = SoemBus(interface, fraction, namespace_pid=namespace_pid or None)

    @staticmethod
    def check_interface(name: str) -> None:
        """Raise BusError where no interface has this name, or it is the loopback."""
        check_name(name)

    @property
    def supervised(self) -> SupervisedBus:
        """The slaves on the cable."""
        return self._bus

    def start(self, directory: Path, report: Callable[[str], None]) -> SoemProcessData:
        """Find the slaves, compare them with the configuration, bring them to SAFE-OP."""
        bus = self._bus
        bus.open()
        with bus.naming_other_master():
            data = self._configure(directory, report)
        for note in (*bus.notes, *filter(None, [bus.other_master()])):
            report(note)
        report("all slaves in SAFE-OP")
        return data

    def _configure(self, directory: Path, report: Callable[[str], None]) -> SoemProcessData:
        bus = self._bus
        slaves = bus.scan()
        report(f"{len(slaves)} slaves on {self.interface}")
        (directory / "scan.json").write_text(json.dumps([asdict(slave) for slave in slaves]))
        self.config = replace(self.config, slaves=by_alias(self.config.slaves, slaves))
        data = bus.configure(with_limits(self.config), round(self.config.cycle.period_us * 1000))
        self.config = self.config.with_devices(bus.devices)
        return data

    def close(self) -> None:
        """Bring the slaves back to INIT, close everything."""
        before = len(self._bus.notes)
        self._bus.close()
        self.notes += self._bus.notes[before:]


def open_master(interface: str) -> tuple[Any, socket.socket]:
    """Return pysoem's master, open, and a duplicate of its packet socket, which no longer blocks.

    Raises:
        BusError: the interface cannot be opened.
    """
    timeouts = pysoem.settings.timeouts
    # By default SOEM waits 2 ms for an answer: a shared host, or a segment in software, may be off its CPU for longer.
    # In a mailbox SOEM then takes the answer to one SDO for the answer to the next, and its map fails.
    timeouts.ret = _ANSWER_US
    timeouts.safe = timeouts.eeprom = _PATIENCE_US
    master = pysoem.Master()
    master.sdo_read_timeout = master.sdo_write_timeout = _SDO_TIMEOUT_US
    # We request the states ourselves, so that a refusal is reported with its code.
    master.manual_state_change = 1
    before = _sockets()
    try:
        master.open(interface)
    except ConnectionError as error:
        raise BusError(f"interface {interface} cannot be opened by the EtherCAT master: {error}") from error
    opened = [fd for fd, _ in _sockets() - before]
    if len(opened) != 1:
        master.close()
        raise BusError(f"the master's packet socket on {interface} was not found among the open descriptors")
    duplicate = socket.socket(fileno=os.dup(opened[0]))
    # Both descriptors are one socket. Blocking, an empty receive would last a jiffy or two: 4 to 8 ms (SOEM#451).
    duplicate.setblocking(False)
    attach_filter(duplicate, 0, _SOEM_LAST_INDEX)
    return master, duplicate


def _words(fault: Any) -> str:
    """Return pysoem's text of an error; pysoem lacks texts for some codes of a packet error."""
    try:
        return str(fault.desc)
    except KeyError:
        return f"packet error {fault.error_code}"


def _sockets() -> set[tuple[int, str]]:
    sockets = set()
    for name in os.listdir("/proc/self/fd"):
        # The descriptor of the listing itself is gone by now.
        with contextlib.suppress(FileNotFoundError):
            target = os.readlink(f"/proc/self/fd/{name}")
            if target.startswith("socket:"):
                sockets.add((int(name), target))
    return sockets
