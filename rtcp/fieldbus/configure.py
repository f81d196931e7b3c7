"""Setting up one slave in PRE-OP: identity, PDO mapping, start-up SDOs, watchdog; everything written is read back."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

from rtcp.config.model import DeviceDescription, Pdo, SlaveConfig, StartupSdo
from rtcp.fieldbus.abort import ABSENT
from rtcp.fieldbus.bus import BusError, SdoAborted, slave_label
from rtcp.fieldbus.pdo import TYPES
from rtcp.fieldbus.registers import RegisterPort
from rtcp.fieldbus.scan import RX_ASSIGN, TX_ASSIGN, name_of, reading_assignment
from rtcp.fieldbus.sdo import SdoClient
from rtcp.fieldbus.steps import Steps

_WATCHDOG_DIVIDER, _WATCHDOG_TIME = 0x0400, 0x0420
_DIVIDER = 2498
"""Watchdog divider of 100 us: (2498 + 2) * 40 ns (ETG.1000.4, 6.3)."""
_INTERPOLATION = 0x60C2
Mapping = tuple[tuple[int, tuple[tuple[int, int, int], ...]], ...]
"""PDOs in order, each its index and its entries (index, subindex, bits)."""


def identity_faults(found: Sequence[Any], expected: Sequence[SlaveConfig]) -> list[str]:
    """Return a sentence for each position where the slaves found differ from the configuration.

    Args:
        found: pysoem's slaves.
        expected: the slaves of the configuration, in the order of the cable.
    """
    faults = []
    if len(found) != len(expected):
        faults.append(f"{len(found)} slaves answer, the configuration (key `slaves`) lists {len(expected)}")
    for position in range(1, max(len(found), len(expected)) + 1):
        slave = found[position - 1] if position <= len(found) else None
        config = expected[position - 1] if position <= len(expected) else None
        if config is None and slave is not None:
            faults.append(f"position {position}: expected nothing, found {_found(slave)}")
        if config is None:
            continue
        device = config.device
        wanted = _identity(device.name, device.vendor_id, device.product_id)
        if slave is None:
            faults.append(f"position {position} ({config.name}): expected {wanted}, found nothing")
        elif (slave.man, slave.id) != (device.vendor_id, device.product_id):
            faults.append(f"position {position} ({config.name}): expected {wanted}, found {_found(slave)}")
    return faults


def _identity(name: str, vendor: int, product: int) -> str:
    return f"{name} (vendor 0x{vendor:08X}, product 0x{product:08X})"


def _found(slave: Any) -> str:
    return _identity(name_of(slave), slave.man, slave.id)


def mapping_of(pdos: Sequence[Pdo]) -> Mapping:
    """Return what `pdos` of a description map."""
    return tuple(
        (pdo.index, tuple((e.index, e.sub_index if e.index else 0, TYPES[e.type][0]) for e in pdo.channels))
        for pdo in pdos
    )  # fmt: skip


def mapping_text(mapping: Mapping) -> str:
    """Return a mapping in words, with its length."""
    bits = sum(entry[2] for _, entries in mapping for entry in entries)
    listed = "; ".join(
        f"0x{pdo:04X}: " + (", ".join(f"0x{index:04X}:{sub}/{width}" for index, sub, width in entries) or "nothing")
        for pdo, entries in mapping
    )
    return f"{bits} bits ({listed or 'no PDO'})"


def configure_slave(
    sdo: SdoClient, port: RegisterPort, station: int, config: SlaveConfig, period_ns: int
) -> Steps[list[str]]:
    """Set up one slave that is in PRE-OP, in steps.

    Returns:
        Sentences on what was tolerated.

    Raises:
        BusError: the slave refuses something, or keeps another value than it was given.
    """
    device = config.device
    notes: list[str] = []
    for assignment, pdos, key in ((RX_ASSIGN, device.rpdo, "rpdo"), (TX_ASSIGN, device.tpdo, "tpdo")):
        if device.configurable_pdos:
            yield from write_mapping(sdo, assignment, mapping_of(pdos))
        yield from compare_mapping(sdo, assignment, mapping_of(pdos), key)
    for startup in device.sdo:
        notes += yield from write_startup(sdo, startup)
    if device.kind == "cia402":
        notes += yield from write_interpolation_time(sdo, period_ns)
    set_watchdog(port, station, slave_label(sdo.position, sdo.name), device)
    return notes


def write_mapping(sdo: SdoClient, assignment: int, mapping: Mapping) -> Steps[None]:
    """Write PDO mapping and assignment: counts to 0, entries, counts (ETG.1000.6, 5.6.5.2)."""
    yield from sdo.writing_int(assignment, 0, 0, 1)
    for pdo, entries in mapping:
        yield from sdo.writing_int(pdo, 0, 0, 1)
        for i, (index, sub_index, bits) in enumerate(entries, 1):
            yield from sdo.writing_int(pdo, i, index << 16 | sub_index << 8 | bits, 4)
        yield from sdo.writing_int(pdo, 0, len(entries), 1)
    for i, (pdo, _) in enumerate(mapping, 1):
        yield from sdo.writing_int(assignment, i, pdo, 2)
    yield from sdo.writing_int(assignment, 0, len(mapping), 1)


def compare_mapping(sdo: SdoClient, assignment: int, expected: Mapping, key: str) -> Steps[None]:
    """Read the mapping and compare it; raises BusError where it differs (`key`: that of the device's file)."""
    try:
        found = tuple(
            (pdo.index, tuple((e.index, e.sub_index, e.bits) for e in pdo.entries))
            for pdo in (yield from reading_assignment(sdo, assignment))
        )
    except SdoAborted as error:
        if error.code not in ABSENT or expected:
            raise
        return
    if found != expected:
        raise BusError(
            f"{slave_label(sdo.position, sdo.name)}: the mapping assigned through 0x{assignment:04X} differs from "
            f"the device's file (key `{key}`): expected {mapping_text(expected)}, found {mapping_text(found)}"
        )


def write_startup(sdo: SdoClient, startup: StartupSdo) -> Steps[list[str]]:
    """Write a start-up SDO and read it back; return a note where the device lacks it and may."""
    code = "B" if startup.type == "bool" else TYPES[startup.type][1]
    packer = struct.Struct("<" + code)
    data = packer.pack(startup.value if code in "fd" else int(startup.value))
    what = f"0x{startup.index:04X}:{startup.sub_index}" + (f" ({startup.name})" if startup.name else "")
    where = slave_label(sdo.position, sdo.name)
    try:
        yield from sdo.writing(startup.index, startup.sub_index, data)
        kept = yield from sdo.reading(startup.index, startup.sub_index)
    except SdoAborted as error:
        if startup.optional and error.code in ABSENT:
            return [f"{where} has no {what}; it is marked optional and was left out"]
        raise
    if kept != data:
        shown = f"{packer.unpack(kept)[0]}" if len(kept) == packer.size else f"bytes {kept.hex(' ')}"
        raise BusError(f"{where}: {what} was set to {packer.unpack(data)[0]} and reads back as {shown}")
    return []


def interpolation_time(period_ns: int) -> tuple[int, int] | None:
    """Return (value, exponent) of 0x60C2 with value * 10^exponent s = `period_ns`, None where it cannot be said.

    The value has 8 bits (CiA 402-2, object 0x60C2), so that 500 us is 5, -4 and 333 us cannot be said.
    """
    value, exponent = period_ns, -9
    while value and value % 10 == 0:
        value, exponent = value // 10, exponent + 1
    return (value, exponent) if 0 < value <= 255 else None


def write_interpolation_time(sdo: SdoClient, period_ns: int) -> Steps[list[str]]:
    """Set 0x60C2 to the period where the drive has it; return a note where that was not possible."""
    where = slave_label(sdo.position, sdo.name)
    said = interpolation_time(period_ns)
    if said is None:
        return [f"{where}: its interpolation time (0x60C2) cannot say {period_ns / 1000:g} us and was left as it is"]
    try:
        for subindex, byte in ((1, said[0].to_bytes(1, "little")), (2, said[1].to_bytes(1, "little", signed=True))):
            yield from sdo.writing(_INTERPOLATION, subindex, byte)
            kept = yield from sdo.reading(_INTERPOLATION, subindex)
            if kept != byte:
                raise BusError(
                    f"{where}: 0x60C2:{subindex} (interpolation time) was set to {byte.hex()}, "
                    f"it reads back as {kept.hex()}"
                )
    except SdoAborted as error:
        if error.code in ABSENT:
            return [f"{where} has no interpolation time (0x60C2)"]
        raise
    return []


def set_watchdog(port: RegisterPort, station: int, label: str, device: DeviceDescription) -> None:
    """Set the process-data watchdog (ETG.1000.4, 6.3; steps of 100 us) and read it back; raises BusError."""
    ticks = max(1, math.ceil(device.watchdog_ms * 10 - 1e-9))
    for address, value in ((_WATCHDOG_DIVIDER, _DIVIDER), (_WATCHDOG_TIME, ticks)):
        data = value.to_bytes(2, "little")
        port.write(station, address, data)
        kept = port.read(station, address, 2)
        if kept != data:
            shown = "nothing" if kept is None else str(int.from_bytes(kept, "little"))
            raise BusError(
                f"{label}: watchdog register 0x{address:04X} was set to {value} (watchdog_ms: {device.watchdog_ms:g}) "
                f"and reads back as {shown}"
            )
