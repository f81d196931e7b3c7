"""Set-up of one slave: in PRE-OP before the cycle, and again beside it after the slave has lost its set-up.

Everything written is read back. `SlaveRestorer` does for one slave beside the cycle what `SoemBus.configure` does
through SOEM for all: SOEM's choices (FMMUs, sync managers, delays) are copied after `configure` and written back.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rtcp.config.model import DeviceDescription, SlaveConfig, StartupSdo
from rtcp.fieldbus.al_state import AlState, read_al, request_state
from rtcp.fieldbus.bus import SlaveInfo, slave_label, station_of
from rtcp.fieldbus.clocks import forget_drift, settle_clock, start_sync, take_over_time
from rtcp.fieldbus.eeprom import eeprom_to_device, eeprom_to_master, reading_words
from rtcp.fieldbus.errors import BusError, ForeignSlave, SdoAborted, ValueNotKept
from rtcp.fieldbus.interpolation_time import OtherInterpolationTime, set_interpolation_time
from rtcp.fieldbus.mailbox import ABSENT, SdoClient
from rtcp.fieldbus.pdo import ASSIGN, STRUCT_CODES, assignments, compare_mapping, write_mapping
from rtcp.fieldbus.registers import FEATURE_DC, Register, RegisterPort, Steps
from rtcp.fieldbus.scaling import compare_scaling
from rtcp.fieldbus.scan import name_of
from rtcp.fieldbus.system_time import SystemTime
from rtcp.ipc.codes import ERROR_BIT, refusal

_FMMUS_SIZE = 0x80
_SYNC_MANAGER_SIZE, _SYNC_MANAGER_COUNT = 8, 8
_CONTROL, _ACTIVATE = 4, 6
"""Bytes of a sync manager's registers (ETG.1000.4, 6.7.2)."""
_MODE, _MAILBOX = 0x03, 0x02
"""Mode of a sync manager in its control register, and that of a mailbox (ETG.1000.4, 6.7.2)."""
_DIRECTION, _MASTER_WRITES, _WATCHDOG_TRIGGER = 0x0C, 0x04, 0x40
"""Bits of a sync manager's control register (ETG.1000.4, 6.7.2)."""
_SII_VENDOR, _SII_PRODUCT, _SII_SERIAL = 0x08, 0x0A, 0x0E
"""Word addresses in the EEPROM (ETG.2010, table 2)."""
_STATE_S = 3.0
"""Time for one change of the AL state, s."""


@dataclass(frozen=True)
class SlaveSetup:
    """Contents of a slave's registers after `configure`."""

    fmmus: bytes
    sync_managers: tuple[bytes, ...]
    """Eight bytes each, status and the slave's own byte left out."""
    delay: bytes | None
    """Propagation delay from the reference clock, content of register 0x0928; None: it has no clock."""
    serial: int
    """Serial number in its EEPROM; 0: it has none."""
    mailboxes: int
    """Number of mailbox sync managers, from 0 on."""


def read_set_up(port: RegisterPort, position: int, name: str, serial: int) -> SlaveSetup:
    """Return a slave's set-up from its registers; `serial`: its serial number. Raises BusError: no answer."""
    station = station_of(position)
    fmmus = port.read(station, Register.FMMU, _FMMUS_SIZE)
    managers = port.read(station, Register.SYNC_MANAGER, _SYNC_MANAGER_SIZE * _SYNC_MANAGER_COUNT)
    features = port.read(station, Register.FEATURES, 2)
    if fmmus is None or managers is None or features is None:
        raise BusError(f"{slave_label(position, name)} stopped answering while its set-up was read")
    own = [managers[at : at + _SYNC_MANAGER_SIZE] for at in range(0, len(managers), _SYNC_MANAGER_SIZE)]
    return SlaveSetup(
        fmmus,
        tuple(registers[:5] + bytes((0, registers[_ACTIVATE] & 1, 0)) for registers in own),
        port.read(station, Register.DC_DELAY, 4) if features[0] & FEATURE_DC else None,
        serial,
        sum(registers[_CONTROL] & _MODE == _MAILBOX for registers in own[:2]),
    )


def provisional_of(position: int) -> int:
    """Return the provisional address of a slave that has lost its own, until it is identified."""
    return 0x2000 + position


class SlaveRestorer:
    """Sets up single slaves again, in steps of a few frames each."""

    def __init__(
        self,
        port: RegisterPort,
        slaves: Sequence[SlaveConfig],
        set_ups: Sequence[SlaveSetup],
        sdo: Callable[[int], SdoClient],
        period_ns: int,
        system_time: SystemTime,
    ) -> None:
        """Prepare for a configured segment.

        Args:
            port: the port for registers.
            slaves: the slaves of the configuration, in the order of the cable.
            set_ups: their registers after `configure`.
            sdo: returns SDO access to the slave at a position.
            period_ns: period of the cycle, ns.
            system_time: time of the segment, kept up to date by the cycle.
        """
        self._port = port
        self._system_time = system_time
        self._slaves = list(slaves)
        self._set_ups = set_ups
        self._sdo = sdo
        self._period_ns = period_ns
        self._clocks = tuple(i for i, set_up in enumerate(set_ups, 1) if set_up.delay is not None)

    def note_written(self, position: int, index: int, sub_index: int, data: bytes) -> None:
        """Note an SDO that a client has written: a limit of a joint is written again when the slave is restored."""
        self._slaves[position - 1] = with_written(self._slaves[position - 1], index, sub_index, data)

    def restore(self, position: int, place: int | None) -> Steps[None]:
        """Set up the slave at `position` and bring it to SAFE-OP.

        Args:
            position: its position on the cable, from 1.
            place: its place in the frame's path, from 1, if it lost its supply and has no station address. None: it has
                one.

        Raises:
            ForeignSlave: another device answers there.
            BusError: it refuses a service, or stops answering.
        """
        port, station, config = self._port, station_of(position), self._slaves[position - 1]
        set_up, label = self._set_ups[position - 1], self._label(position)
        address = station
        if place is not None:
            # Its place changes when slaves before it come or go, so it gets an address at once.
            address = provisional_of(position)
            self._write_address(position, address, partial(port.write_at, place), partial(port.read_at, place))
            yield from self._identify(position, address)
        if set_up.delay is not None:
            # SYNC0 first: it must not run while the time is set. The address last: the frames of the cycle read the
            # reference clock by its address, and every other slave follows its time.
            port.put(address, Register.DC_ACTIVATION, b"\0", label)
            others = [clock for clock in self._clocks if clock != position]
            always = place is not None
            take_over_time(port, address, label, set_up.delay, others, self._system_time, always=always)
        if place is not None:
            self._write_address(position, station, partial(port.write, address), partial(port.read, station))
        if set_up.delay is not None:
            forget_drift(port, station, label)
        yield
        yield from self._change_state(position, AlState.INIT)
        port.put(station, Register.SYNC_MANAGER, bytes(_SYNC_MANAGER_SIZE * _SYNC_MANAGER_COUNT), label)
        port.put(station, Register.FMMU, bytes(_FMMUS_SIZE), label)
        self._write_sync_managers(position, range(set_up.mailboxes))
        if not eeprom_to_device(port, station):
            raise BusError(f"{label} did not take its EEPROM back")
        yield from self._change_state(position, AlState.PREOP)
        yield from configure_slave(self._sdo(position), port, station, config, self._period_ns)
        self._write_sync_managers(position, range(set_up.mailboxes, _SYNC_MANAGER_COUNT))
        port.put(station, Register.FMMU, set_up.fmmus, label)
        if config.device.assign_activate:
            if position != self._clocks[0]:
                yield from settle_clock(port, station, label)
            start_sync(port, station, label, config.device, self._period_ns, self._system_time)
        yield
        yield from self._change_state(position, AlState.SAFEOP)

    def _label(self, position: int) -> str:
        return slave_label(position, self._slaves[position - 1].name)

    def _identify(self, position: int, station: int) -> Steps[None]:
        vendor = yield from self._reading_eeprom(position, station, _SII_VENDOR)
        product = yield from self._reading_eeprom(position, station, _SII_PRODUCT)
        device = self._slaves[position - 1].device
        if (vendor, product) != (device.vendor_id, device.product_id):
            raise ForeignSlave(
                f"{self._label(position)}: at its place answers another device (vendor 0x{vendor:08X}, product "
                f"0x{product:08X}), expected {device.name} (vendor 0x{device.vendor_id:08X}, product "
                f"0x{device.product_id:08X}): it is left alone; put the right one there"
            )
        # Two swapped drives of one type would move each other's joint.
        expected = self._set_ups[position - 1].serial
        if expected and (serial := (yield from self._reading_eeprom(position, station, _SII_SERIAL))) != expected:
            raise ForeignSlave(
                f"{self._label(position)}: at its place answers another {device.name} (serial number {serial}), "
                f"expected serial number {expected}: it is left alone; put the right one there, or start anew with "
                "this one"
            )

    def _reading_eeprom(self, position: int, station: int, word: int) -> Steps[int]:
        """Return four bytes of the EEPROM from `word` on; takes the access, which the device may have at power-on."""
        label = self._label(position)
        if not eeprom_to_master(self._port, station):
            raise BusError(
                f"{label} did not take the request for its EEPROM in register 0x{Register.EEPROM_CONFIG:04X}"
            )
        return int.from_bytes((yield from reading_words(self._port, station, word, label))[:4], "little")

    def _write_address(
        self,
        position: int,
        station: int,
        write: Callable[[int, bytes], bool],
        read: Callable[[int, int], bytes | None],
    ) -> None:
        data = station.to_bytes(2, "little")
        if not write(Register.STATION_ADDRESS, data) or read(Register.STATION_ADDRESS, 2) != data:
            raise BusError(f"{self._label(position)} does not keep its station address")

    def _write_sync_managers(self, position: int, numbers: range) -> None:
        port, station, label = self._port, station_of(position), self._label(position)
        for number in numbers:
            setting = self._set_ups[position - 1].sync_managers[number]
            if any(setting):
                address = Register.SYNC_MANAGER + number * _SYNC_MANAGER_SIZE
                port.put(station, address, setting, label)
                # The control byte contains the trigger of the process-data watchdog.
                if port.read(station, address, _CONTROL + 1) != setting[: _CONTROL + 1]:
                    raise BusError(f"{label} does not keep sync manager {number} (register 0x{address:04X})")

    def _change_state(self, position: int, state: AlState) -> Steps[None]:
        """Request `state`, which acknowledges an error, and wait for it; raises BusError where that fails."""
        port, station = self._port, station_of(position)
        request_state(port, (station,), state)
        deadline = time.monotonic() + _STATE_S
        while True:
            yield
            reached, error, code = read_al(port, station)
            if reached is state and not error:
                return
            # An old error may still show until the slave has processed the request.
            late = time.monotonic() >= deadline
            if late or reached is AlState.NONE or (error and time.monotonic() >= deadline - _STATE_S + 0.1):
                raise BusError(refusal(self._label(position), state, reached | (ERROR_BIT if error else 0), code))


_DIVIDER = 2498
"""Watchdog divider of 100 us: (2498 + 2) * 40 ns (ETG.1000.4, 6.3)."""


def by_alias(slaves: Sequence[SlaveConfig], present: Sequence[SlaveInfo]) -> tuple[SlaveConfig, ...]:
    """Return the slaves of the configuration in the order of the cable, with aliases at the positions that have them.

    Raises:
        BusError: no slave, or more than one, has an alias of the configuration.
    """
    at = {slave.alias: [info.position for info in present if info.alias == slave.alias] for slave in slaves}
    there = ", ".join(f"slave {info.position} ({info.name}) has {info.alias}" for info in present if info.alias)
    faults = []
    for slave in slaves:
        if slave.alias and not at[slave.alias]:
            faults.append(
                f"{slave.name}: no slave has the station alias {slave.alias} (key `slaves`): "
                f"{there or 'none has any'}; `rtcp alias set` writes one"
            )
        elif slave.alias and len(at[slave.alias]) > 1:
            places = " and ".join(f"slave {position}" for position in at[slave.alias])
            faults.append(f"{slave.name}: {places} have the station alias {slave.alias}; `rtcp alias set` changes one")
    if faults:
        raise BusError(*faults)
    placed = {at[slave.alias][0]: slave for slave in slaves if slave.alias}
    if not placed or len(present) != len(slaves):
        return tuple(slaves)
    others = iter([slave for slave in slaves if not slave.alias])
    return tuple(placed.get(info.position) or next(others) for info in present)


def identity_faults(present: Sequence[Any], expected: Sequence[SlaveConfig]) -> list[str]:
    """Return a sentence for each position whose slave differs from the configuration.

    Args:
        present: pysoem's slaves.
        expected: the slaves of the configuration, in the order of the cable.
    """
    faults = []
    if len(present) != len(expected):
        faults.append(f"{len(present)} slaves answer, the configuration (key `slaves`) lists {len(expected)}")
    for position in range(1, max(len(present), len(expected)) + 1):
        slave = present[position - 1] if position <= len(present) else None
        config = expected[position - 1] if position <= len(expected) else None
        if config is None and slave is not None:
            faults.append(f"position {position}: expected nothing, found {_identity_of(slave)}")
        if config is None:
            continue
        device = config.device
        wanted = _identity(device.name, device.vendor_id, device.product_id)
        if slave is None:
            faults.append(f"position {position} ({config.name}): expected {wanted}, found nothing")
        elif (slave.man, slave.id) != (device.vendor_id, device.product_id):
            faults.append(f"position {position} ({config.name}): expected {wanted}, found {_identity_of(slave)}")
    return faults


def _identity(name: str, vendor: int, product: int) -> str:
    return f"{name} (vendor 0x{vendor:08X}, product 0x{product:08X})"


def _identity_of(slave: Any) -> str:
    return _identity(name_of(slave), slave.man, slave.id)


def configure_slave(
    sdo: SdoClient, port: RegisterPort, station: int, config: SlaveConfig, period_ns: int
) -> Steps[list[str]]:
    """Set up one slave in PRE-OP, in steps.

    Returns:
        Sentences on tolerated deviations.

    Raises:
        BusError: the slave refuses a service.
        ValueNotKept: a value reads back differently.
    """
    device = config.device
    notes: list[str] = []
    set_watchdog(port, station, slave_label(sdo.position, sdo.name), device)
    if not device.coe:
        return notes
    for key, manager, pdos in assignments(device):
        assignment = ASSIGN + manager
        if device.configurable_pdos:
            try:
                yield from write_mapping(sdo, assignment, pdos)
            except SdoAborted as error:
                file = config.file or "the device's file"
                sentence = f"{error.sentences[0]}; the device does not take the mapping of {file} (key `{key}`)"
                raise SdoAborted(sentence, error.code) from error
        yield from compare_mapping(sdo, assignment, pdos, key)
    for startup in (*device.sdo, *config.limits):
        notes += yield from write_startup(sdo, startup)
    if device.kind == "cia402":
        # Before any motion: a drive with other units must not come to SAFE-OP.
        notes += yield from compare_scaling(sdo, config)
        profiles = {needs.axis for needs in config.needs if needs.halt_deceleration}
        for axis in device.axes:
            try:
                notes += yield from set_interpolation_time(sdo, period_ns, axis)
            except OtherInterpolationTime as error:
                if axis not in profiles:
                    raise
                notes.append(f"{error}; its own profiles do not use it")
    return notes


def with_written(config: SlaveConfig, index: int, sub_index: int, data: bytes) -> SlaveConfig:
    """Return a slave with the data of an SDO that a client has written, where that holds a limit of a joint.

    A slave that is set up again must not get the limit for the zero offset that the joint had at the start.
    """

    def newest(limit: StartupSdo) -> StartupSdo:
        if (limit.index, limit.sub_index) != (index, sub_index):
            return limit
        return replace(limit, value=int.from_bytes(data, "little", signed=limit.type.startswith("int")))

    return replace(config, limits=tuple(map(newest, config.limits)))


def write_startup(sdo: SdoClient, startup: StartupSdo) -> Steps[list[str]]:
    """Write a start-up SDO and read it back; return a note where the device lacks an optional object."""
    if startup.type == "bytes":
        data = bytes.fromhex(startup.data)
    elif startup.value is None:
        raise BusError(f"{slave_label(sdo.position, sdo.name)}: start-up SDO 0x{startup.index:04X} has no value")
    elif startup.type.startswith("float"):
        data = struct.Struct("<" + STRUCT_CODES[startup.type]).pack(startup.value)
    else:
        data = startup.integer_data
    label = f"0x{startup.index:04X}:{startup.sub_index}" + (f" ({startup.name})" if startup.name else "")
    try:
        yield from _write_and_verify(sdo, startup.index, startup.sub_index, data, label, startup.type, startup.complete)
    except SdoAborted as error:
        if startup.optional and error.code in ABSENT:
            return [f"{slave_label(sdo.position, sdo.name)} has no {label}; it is marked optional and was left out"]
        raise
    return []


def _write_and_verify(
    sdo: SdoClient, index: int, sub_index: int, data: bytes, label: str, kind: str, complete: bool = False
) -> Steps[None]:
    yield from sdo.writing(index, sub_index, data, complete)
    kept = yield from sdo.reading(index, sub_index, complete)
    if complete:
        kept = kept[: len(data)]  # without entries behind the written ones
    elif kind == "bytes":
        kept = kept.rstrip(b"\0").ljust(len(data), b"\0")  # a text comes back with or without trailing zeros
    if kept != data:
        text = _value_text(kept, kind) if len(kept) == len(data) else f"bytes {kept.hex(' ')}"
        where = slave_label(sdo.position, sdo.name)
        wanted = _value_text(data, kind)
        sentence = f"{where}: {label} was set to {wanted} and reads back as {text}: allowed is the value that was set"
        raise ValueNotKept(sentence, index, sub_index, wanted, text)


def _value_text(data: bytes, kind: str) -> str:
    if kind == "bytes":
        return data.hex(" ")
    if kind.startswith("float"):
        return str(struct.unpack("<" + STRUCT_CODES[kind], data)[0])
    return str(int.from_bytes(data, "little", signed=kind.startswith("int")))


def trigger_watchdog(port: RegisterPort, position: int, config: SlaveConfig, mailboxes: int) -> list[str]:
    """Let every sync manager of outputs trigger the process-data watchdog (ETG.1000.4, 6.7.2: control bit 6).

    SOEM writes the control byte from the EEPROM. Many EEPROMs leave the bit off: the slave then keeps its last outputs
    when the master dies.

    Args:
        port: the port for registers; the slave is mapped and not yet in SAFE-OP.
        position: its position on the cable, from 1.
        config: the slave.
        mailboxes: number of mailbox sync managers, from 0 on.

    Returns:
        A sentence for each sync manager that does not keep the bit.

    Raises:
        BusError: a sync manager of a drive does not keep the bit; or the slave stopped answering.
    """
    station, label = station_of(position), slave_label(position, config.name)
    managers = port.read(station, Register.SYNC_MANAGER, _SYNC_MANAGER_SIZE * _SYNC_MANAGER_COUNT)
    if managers is None:
        raise BusError(f"{label} stopped answering while its process-data watchdog was switched on")
    faults, triggered = [], not config.device.rpdo
    for number in range(mailboxes, _SYNC_MANAGER_COUNT):
        at = number * _SYNC_MANAGER_SIZE
        control, active = managers[at + _CONTROL], managers[at + _ACTIVATE]
        if not active & 1 or control & _DIRECTION != _MASTER_WRITES:
            continue
        wanted, triggered = control | _WATCHDOG_TRIGGER, True
        if control == wanted:
            continue
        address = Register.SYNC_MANAGER + at
        # An ESC accepts the control byte only while the sync manager is off.
        for offset, value in ((_ACTIVATE, 0), (_CONTROL, wanted), (_ACTIVATE, active)):
            port.put(station, address + offset, bytes((value,)), label)
        kept = port.read(station, address + _CONTROL, 1)
        if kept != bytes((wanted,)):
            text = "nothing" if kept is None else f"0x{kept[0]:02X}"
            faults.append(
                f"{label}: the control byte of sync manager {number} was set to 0x{wanted:02X} and reads back as "
                f"{text}: its outputs do not trigger the process-data watchdog"
            )
    if not triggered:
        faults.append(f"{label}: no sync manager carries its outputs: nothing triggers the process-data watchdog")
    if faults and config.device.kind == "cia402":
        raise BusError(*(f"{fault}, and a drive without it keeps moving when the master dies" for fault in faults))
    return [f"{fault}; they stay as they are when the master dies" for fault in faults]


def set_watchdog(port: RegisterPort, station: int, label: str, device: DeviceDescription) -> None:
    """Set the process-data watchdog (ETG.1000.4, 6.3; steps of 100 us) and read it back; raises BusError."""
    ticks = max(1, math.ceil(device.watchdog_ms * 10 - 1e-9))
    for address, value in ((Register.WATCHDOG_DIVIDER, _DIVIDER), (Register.WATCHDOG_PROCESS_DATA, ticks)):
        data = value.to_bytes(2, "little")
        port.write(station, address, data)
        kept = port.read(station, address, 2)
        if kept != data:
            text = "nothing" if kept is None else str(int.from_bytes(kept, "little"))
            raise BusError(
                f"{label}: watchdog register 0x{address:04X} was set to {value} (watchdog_ms: {device.watchdog_ms:g}) "
                f"and reads back as {text}"
            )
