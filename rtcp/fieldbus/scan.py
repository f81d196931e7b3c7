"""Description of a slave from its registers (ETG.1000.4), EEPROM (ETG.1000.6, 5.4; ETG.2010), object dictionary."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rtcp.esi.model import SyncManager, SyncManagerType
from rtcp.esi.sii import END, HEADER_BYTES, SYNC_MANAGERS, read_sync_managers
from rtcp.fieldbus.al_state import AlState, read_al
from rtcp.fieldbus.bus import MailboxInfo, PdoInfo, SlaveInfo, SyncManagerInfo
from rtcp.fieldbus.describe import read_entry
from rtcp.fieldbus.eeprom import eeprom_to_device, eeprom_to_master, reading_words
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.pdo import RX_ASSIGN, TX_ASSIGN, reading_assignment
from rtcp.fieldbus.port_errors import ERROR_COUNTERS_SIZE, read_port_errors
from rtcp.fieldbus.registers import FEATURE_DC, Register, RegisterPort, finish
from rtcp.fieldbus.topology import port_states
from rtcp.ipc.codes import ERROR_BIT, code_meaning, state_name

_DEVICE_NAME = 0x1008
_SII_SERIAL, _SII_RECEIVE, _SII_SEND, _SII_PROTOCOLS = 0x0E, 0x18, 0x1A, 0x1C
_EEPROM_US = 500_000
"""Timeout for a word of the EEPROM, us: a shared host may be off its CPU for longer than pysoem's 20 ms."""
_SMALLEST_MAILBOX = 16
"""Smallest valid mailbox, bytes: headers and an SDO (ETG.1000.6, 5.6.2)."""
_PROTOCOLS = ("AoE", "EoE", "CoE", "FoE", "SoE", "VoE")
"""Bits 0 to 5 of SII word 0x1C (ETG.2010, table 4)."""
_SYNC_MANAGER = struct.Struct("<HHBBBB")
_MOST_CATEGORIES, _SYNC_MANAGERS_WORDS = 64, 32
"""Most categories of an EEPROM that are read; size of eight sync managers in it, words."""


def read_mailbox(slave: Any, sync_managers: Callable[[], Sequence[SyncManager]]) -> MailboxInfo | None:
    """Return the mailbox according to the EEPROM of pysoem's `slave`, None where it has no valid one.

    Some EEPROMs list the protocols and no sizes (SOEM#459): the sizes are then those of its `sync_managers`.
    """
    receive_start, receive_size = struct.unpack("<HH", slave.eeprom_read(_SII_RECEIVE, _EEPROM_US))
    send_start, send_size = struct.unpack("<HH", slave.eeprom_read(_SII_SEND, _EEPROM_US))
    send_size = send_size or receive_size
    bits = slave.eeprom_read(_SII_PROTOCOLS, _EEPROM_US)[0]
    protocols = tuple(name for i, name in enumerate(_PROTOCOLS) if bits >> i & 1)
    if sizeless := bool(not receive_size and protocols):
        managers = sync_managers()[:2]
        kinds = (SyncManagerType.MAILBOX_RECEIVE, SyncManagerType.MAILBOX_SEND)
        if tuple(manager.type for manager in managers) == kinds:
            receive_start, receive_size = managers[0].start, managers[0].length
            send_start, send_size = managers[1].start, managers[1].length
    if min(receive_size, send_size) < _SMALLEST_MAILBOX:
        return None
    return MailboxInfo(receive_start, receive_size, send_start, send_size, protocols, sizeless)


def name_of(slave: Any) -> str:
    """Return the name in the EEPROM of pysoem's `slave`, decoded as UTF-8, else as Latin-1."""
    try:
        return str(slave.name)
    except UnicodeDecodeError as error:
        return error.object.decode("latin-1")


def read_serial(slave: Any) -> int:
    """Return the serial number in the EEPROM of pysoem's `slave`."""
    return int.from_bytes(slave.eeprom_read(_SII_SERIAL, _EEPROM_US), "little")


def _with_names(sdo: SdoClient, pdos: tuple[PdoInfo, ...]) -> tuple[PdoInfo, ...]:
    """Return the PDOs with the names of their entries, where the slave supports SDO information."""
    offered = True

    def name(index: int, sub_index: int) -> str:
        nonlocal offered
        if index and offered:
            try:
                entry = read_entry(sdo, index, sub_index)
            except SdoAborted:
                return ""
            except BusError:
                offered = False
            else:
                return "" if entry is None else entry.name
        return ""

    return tuple(
        replace(pdo, entries=tuple(replace(e, name=name(e.index, e.sub_index)) for e in pdo.entries)) for pdo in pdos
    )


def _sync_managers(port: RegisterPort, station: int) -> tuple[SyncManagerInfo, ...]:
    data = port.read(station, Register.SYNC_MANAGER, 4 * _SYNC_MANAGER.size)
    if data is None:
        return ()
    managers = []
    for number, (start, length, control, _status, activate, _pdi) in enumerate(_SYNC_MANAGER.iter_unpack(data)):
        if start:
            managers.append(SyncManagerInfo(number, start, length, control, bool(activate & 1)))
    return tuple(managers)


def eeprom_sync_managers(port: RegisterPort, station: int) -> tuple[SyncManager, ...]:
    """Return the sync managers in a slave's EEPROM; none if it is unreadable."""

    def read(word: int) -> bytes:
        return finish(reading_words(port, station, word, ""))[:4]

    word = HEADER_BYTES // 2
    eeprom_to_master(port, station)
    try:
        for _ in range(_MOST_CATEGORIES):
            number, words = struct.unpack("<HH", read(word))
            word += 2
            if number == END:
                break
            if number == SYNC_MANAGERS:
                content = b"".join(read(at) for at in range(word, word + min(words, _SYNC_MANAGERS_WORDS), 2))
                return read_sync_managers(content)
            word += words
    except BusError:
        pass
    finally:
        eeprom_to_device(port, station)
    return ()


def watchdog_off(port: RegisterPort, station: int) -> tuple[int, ...]:
    """Return the sync managers whose outputs, by the EEPROM, do not trigger the watchdog; none if it is unreadable."""
    return tuple(n for n, manager in enumerate(eeprom_sync_managers(port, station)) if manager.lacks_watchdog)


def describe(
    slave: Any, sdo: SdoClient, port: RegisterPort, station: int, mailbox: MailboxInfo | None, serial: int
) -> SlaveInfo:
    """Return the description of a slave; fields that it does not provide are empty.

    Args:
        slave: pysoem's slave, in PRE-OP where it has a mailbox.
        sdo: SDO access to it.
        port: the port for its registers.
        station: its configured address.
        mailbox: its mailbox according to the EEPROM.
        serial: the serial number in its EEPROM.
    """

    def register(address: int, length: int) -> int:
        return int.from_bytes(port.read(station, address, length) or b"", "little")

    counters = port.read(station, Register.ERROR_COUNTERS, ERROR_COUNTERS_SIZE) or bytes(ERROR_COUNTERS_SIZE)
    state, error, code = read_al(port, station)
    has_coe = mailbox is not None and mailbox.has_coe
    name = name_of(slave)
    outputs: tuple[PdoInfo, ...] = ()
    inputs: tuple[PdoInfo, ...] = ()
    if has_coe and state in {AlState.PREOP, AlState.SAFEOP, AlState.OP}:
        # SOEM reads the EEPROM's strings once for all slaves of one identity, whose names may differ.
        with contextlib.suppress(BusError):
            name = sdo.read(_DEVICE_NAME, 0).rstrip(b"\0").decode("latin-1")
        try:
            outputs = _with_names(sdo, finish(reading_assignment(sdo, RX_ASSIGN)))
            inputs = _with_names(sdo, finish(reading_assignment(sdo, TX_ASSIGN)))
        except BusError:
            # Without assignment objects (ETG.1000.6, 5.6.7.4) the PDOs are fixed in the EEPROM.
            outputs, inputs = (), ()
    dc = bool(register(Register.FEATURES, 2) & FEATURE_DC)
    return SlaveInfo(
        position=sdo.position,
        station=station,
        name=name,
        vendor_id=slave.man,
        product_code=slave.id,
        revision=slave.rev,
        serial=serial,
        alias=register(Register.STATION_ALIAS, 2),
        state=state_name(state | (ERROR_BIT if error else 0)),
        al_status_code=code,
        al_status=code_meaning(code),
        has_coe=has_coe,
        mailbox=mailbox,
        outputs=outputs,
        inputs=inputs,
        output_bits=sum(pdo.bits for pdo in outputs),
        input_bits=sum(pdo.bits for pdo in inputs),
        sync_managers=_sync_managers(port, station),
        fmmus=register(Register.FMMU_COUNT, 1),
        dc=dc,
        delay_ns=None,
        ports=port_states(register(Register.DL_STATUS, 2)),
        parent=0,
        parent_port=0,
        port_errors=read_port_errors(counters),
    )
