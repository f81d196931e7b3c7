"""A device's file (`config/devices/NAME.yaml`) made of its description, with comments for its user."""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import isclose

from rtcp.config.model import BITS
from rtcp.config.scaling import (
    BOUNDING_OBJECTS,
    OBJECTS_PER_AXIS,
    QUICK_STOP_OPTION,
    SOURCES,
    TORQUE_UNITS,
    VELOCITY_UNITS,
    TorqueUnit,
)
from rtcp.esi import units
from rtcp.esi.dictionary import complete
from rtcp.esi.model import DcMode, Device, EsiError, ObjectEntry, Pdo, PdoEntry, Source, SyncManagerType
from rtcp.esi.types import Kind, decode, resolve

_DRIVE_PROFILE = 402
MAPPINGS = {True: range(0x1600, 0x1800), False: range(0x1A00, 0x1C00)}
"""Usual indices of PDOs, by whether they are outputs (ETG.1000.6)."""
_MOST_AXES, _BYTE, _WORD = 8, 8, 16
_AXES = range(0x6000, 0x6000 + _MOST_AXES * OBJECTS_PER_AXIS)
_MAPPED_OBJECTS = {
    True: (0x6040, 0x607A, 0x60FF, 0x6071, 0x6060),
    False: (0x6041, 0x6064, 0x606C, 0x6077, 0x6061),
}
"""Objects of a drive that are mapped if the device allows it, by whether they are outputs."""
_DRIVE_CHANNELS = {
    0x6040: "controlword",
    0x6041: "statusword",
    0x6060: "modes_of_operation",
    0x6061: "modes_of_operation_display",
    0x6064: "position",
    0x606C: "velocity",
    0x6071: "target_torque",
    0x6077: "torque",
    0x607A: "target_position",
    0x60B0: "position_offset",
    0x60B1: "velocity_offset",
    0x60B2: "torque_offset",
    0x60F4: "following_error",
    0x60FF: "target_velocity",
}
"""Channel names of a drive's objects (IEC 61800-7-201), those of the first axis. All are variables of whole numbers;
some descriptions give them a subindex, or the type of an array."""
_UNSIGNED, _MODES = (0x6040, 0x6041), (0x6060, 0x6061)
"""Those of them without a sign, and those of one byte. The others have a sign, whatever a description says."""
_STATE_WORDS = tuple(index % OBJECTS_PER_AXIS for index in _UNSIGNED)
_NEEDED = {True: (0x6040, 0x607A), False: (0x6041, 0x6064)}
"""Objects that the driver of a drive needs, by whether they are outputs."""
_MODE_OBJECT, _CSP = 0x6060, 8
_MOTOR_SPEED = 0x6080
_TORQUES, _VELOCITIES = (0x6071, 0x6077, 0x60B2), (0x606C, 0x60FF, 0x60B1)
"""Objects whose factor needs the rated torque, and the unit of velocities."""
_RAMP_AND_HOLD = 6
"""Value of the quick stop option code, 0x605A."""
_SYNC0 = 0x0200
"""Bit of AssignActivate that activates SYNC0."""
_DRIVE_WATCHDOG_MS, _WATCHDOG_MS = 20, 100
_ANALOG_BITS = 16
"""Shortest analog value."""
_COUNTER = re.compile(r"counter value|encoder value|encoder position|^position$|^position value", re.IGNORECASE)
_CHANNEL = re.compile(r"(?:channel|ch\.?)\s*(\d+)", re.IGNORECASE)
_WIDTH = 118


def file_text(
    device: Device,
    kind: str | None = None,
    mode: str | None = None,
    samples: int | None = None,
    pdos: Sequence[int] = (),
) -> str:
    """Return the text of the device's file. A figure that the description lacks is a required key without a value.

    Args:
        device: its description, with its modules in place.
        kind: the driver; None: the one that fits its process data.
        mode: name of the clock mode; None: the one that fits.
        samples: values a cycle of the PDOs of that mode that take several; None: as the mode says.
        pdos: indices of the PDOs to assign in place of the default ones of their direction; empty: those that fit.

    Raises:
        EsiError: it has no such mode or PDO, or does not take so many values.
    """
    in_mode = device if mode is None else _in_mode(device, mode, samples)
    completed = complete(with_pdos(in_mode, pdos) if pdos else for_drive(in_mode))
    return "\n".join(_lines(completed, kind or kind_of(completed), mode is not None)) + "\n"


def _in_mode(device: Device, name: str, count: int | None) -> Device:
    """Return a device with one clock mode first, and the PDOs assigned that this mode assigns."""
    mode = next((mode for mode in device.dc_modes if mode.name == name), None)
    if mode is None:
        names = ", ".join(mode.name for mode in device.dc_modes) or "none"
        raise EsiError(device.origin, f"it has no clock mode {name!r}; there are: {names}")
    others = [following for following in device.dc_modes if following is not mode]
    if count is not None:
        mode = _with_samples(device, mode, count)
    samples = dict(mode.samples)
    manager_of = {index: manager for manager, indices in mode.pdos for index in indices}
    managers = {manager for manager, _ in mode.pdos}

    def assigned_by(pdos: tuple[Pdo, ...]) -> tuple[Pdo, ...]:
        return tuple(
            replace(pdo, sync_manager=manager_of.get(pdo.index), samples=samples.get(pdo.index, 1))
            if pdo.index in manager_of or pdo.sync_manager in managers
            else pdo
            for pdo in pdos
        )

    return replace(
        device, dc_modes=(mode, *others), rx_pdos=assigned_by(device.rx_pdos), tx_pdos=assigned_by(device.tx_pdos)
    )


def _with_samples(device: Device, mode: DcMode, count: int) -> DcMode:
    """Return a clock mode with `count` values a cycle, SYNC0 for each and SYNC1 once a cycle."""
    named = {index for _, indices in mode.pdos for index in indices}
    pdos = [pdo for pdo in (*device.rx_pdos, *device.tx_pdos) if pdo.index in named and pdo.most_samples > 1]
    if not pdos:
        raise EsiError(device.origin, f"clock mode {mode.name} assigns no PDO of several values a cycle (OSMax)")
    for pdo in pdos:
        if not pdo.fewest_samples <= count <= pdo.most_samples:
            allowed = f"allowed are {pdo.fewest_samples} to {pdo.most_samples} (OSMin, OSMax)"
            raise EsiError(device.origin, f"found {count} values a cycle of PDO 0x{pdo.index:04X}, {allowed}")
    sync1 = -1 if mode.sync1_factor > 1 else mode.sync1_factor
    samples = tuple((pdo.index, count) for pdo in pdos)
    return replace(mode, samples=samples, sync0_factor=-count, sync0_cycle=0, sync1_factor=sync1)


def with_pdos(device: Device, indices: Sequence[int]) -> Device:
    """Return a device with these PDOs assigned in their order, in place of the default ones of their direction.

    Raises:
        EsiError: it has no such PDO, or two of them exclude each other.
    """
    known = {pdo.index: pdo for pdo in (*device.rx_pdos, *device.tx_pdos) if not pdo.virtual}
    listed = ", ".join(f"0x{index:04X}" for index in known) or "none"
    for index in indices:
        if index not in known:
            raise EsiError(device.origin, f"it has no PDO 0x{index:04X}; there are: {listed}")
        if clash := known[index].excludes & set(indices):
            those = " and ".join(f"0x{other:04X}" for other in sorted(clash))
            raise EsiError(device.origin, f"PDO 0x{index:04X} excludes {those}: choose one of them")

    def assigned(pdos: tuple[Pdo, ...], outputs: bool) -> tuple[Pdo, ...]:
        own = {pdo.index: pdo for pdo in pdos}
        chosen = [own[index] for index in dict.fromkeys(indices) if index in own]
        if not chosen:
            return pdos
        usual = _usual_sync_manager(device, outputs)
        first = [replace(p, sync_manager=usual if p.sync_manager is None else p.sync_manager) for p in chosen]
        # A mandatory PDO stays, before those that were chosen.
        kept = [pdo for pdo in pdos if pdo.mandatory and pdo.sync_manager is not None and pdo not in chosen]
        others = [pdo for pdo in pdos if pdo not in chosen and pdo not in kept]
        return (*kept, *first, *(replace(pdo, sync_manager=None) for pdo in others))

    return replace(device, rx_pdos=assigned(device.rx_pdos, True), tx_pdos=assigned(device.tx_pdos, False))


def kind_of(device: Device) -> str:
    """Return the driver that fits a device by its default process data."""
    rx, tx = (entries_of(device.assigned(outputs)) for outputs in (True, False))
    if not rx and not tx:
        return "coupler"
    coe = device.coe
    if _axes(device) and (coe is not None or {*_MODES} <= {entry.index for entry in (*rx, *tx)}):
        return "cia402"
    if _is_drive(device):
        return "generic"
    if _counter(device) is not None:
        return "encoder"
    values = [entry for entry in (*rx, *tx) if entry.bits >= _ANALOG_BITS]
    if values and all(resolve(entry.type, entry.bits).kind in (Kind.SIGNED, Kind.REAL) for entry in values):
        return "analog"
    return "generic"


def _counter(device: Device) -> PdoEntry | None:
    """Return the one input that counts turns; None: there is none, or there are several."""
    counters = [
        entry
        for entry in entries_of(device.assigned(False))
        if entry.bits >= _ANALOG_BITS and _COUNTER.search(entry.name)
    ]
    return counters[0] if len(counters) == 1 else None


def for_drive(device: Device) -> Device:
    """Return a drive with PDOs assigned that its driver supports, if the default assignment lacks an object.

    These are other PDOs of the description that have the objects, else one PDO is mapped from the objects that may be
    mapped. A device that has neither is returned unchanged.
    """
    if not _is_drive(device):
        return device
    if _axes(device):
        return _with_mode_display(device)
    rx, tx = (_chosen(device, device.rx_pdos if outputs else device.tx_pdos, outputs) for outputs in (True, False))
    return device if rx is None or tx is None else _with_mode_display(replace(device, rx_pdos=rx, tx_pdos=tx))


def _with_mode_display(device: Device) -> Device:
    """Return a drive with the mode of operation display in a TxPDO, if its mode is in an RxPDO and this is possible."""
    rx, tx = ({entry.index for entry in entries_of(device.assigned(outputs))} for outputs in (True, False))
    if _MODE_OBJECT not in rx or _MODE_OBJECT + 1 in tx:
        return device
    manager, there = _usual_sync_manager(device, outputs=False), {pdo.index for pdo in device.assigned(False)}
    display = _object(device, _MODE_OBJECT + 1, 0)
    can_map = device.coe is not None and device.coe.pdo_configuration
    tx_pdos = list(device.tx_pdos)
    for at, pdo in enumerate(tx_pdos):
        if _MODE_OBJECT + 1 in {entry.index for entry in pdo.entries} and not pdo.excludes & there:
            tx_pdos[at] = replace(pdo, sync_manager=manager)
            return replace(device, tx_pdos=tuple(tx_pdos))
    for at, pdo in enumerate(tx_pdos):
        if pdo.index in there and not pdo.fixed and can_map and display is not None:
            entry = PdoEntry(_MODE_OBJECT + 1, 0, display.bits, display.name, display.type)
            tx_pdos[at] = replace(pdo, entries=(*pdo.entries, entry))
            break
    return replace(device, tx_pdos=tuple(tx_pdos))


def _is_drive(device: Device) -> bool:
    mapped = {entry.index for entry in entries_of((*device.rx_pdos, *device.tx_pdos))}
    return device.profile == _DRIVE_PROFILE or {0x6040, 0x6041} <= mapped


def _chosen(device: Device, pdos: tuple[Pdo, ...], outputs: bool) -> tuple[Pdo, ...] | None:
    """Return `pdos` with one assigned that has the objects a drive needs; None: none can be assigned or mapped."""
    needed = {*_NEEDED[outputs]}
    if needed <= {entry.index for entry in entries_of(device.assigned(outputs))}:
        return pdos
    manager = _usual_sync_manager(device, outputs)
    if fitting := [pdo for pdo in pdos if needed <= {entry.index for entry in pdo.entries} and not pdo.virtual]:
        best = min(fitting, key=lambda pdo: (pdo.bits, pdo.index))
        return tuple(replace(pdo, sync_manager=manager if pdo is best else None) for pdo in pdos)
    coe = device.coe
    if coe is None or not coe.pdo_configuration:
        return None
    entries = []
    for index in _MAPPED_OBJECTS[outputs]:
        entry = _object(device, index, 0)
        if entry is not None and (entry.rx_mappable if outputs else entry.tx_mappable):
            entries.append(PdoEntry(index, 0, entry.bits, entry.name, entry.type))
    free = next((pdo for pdo in pdos if not pdo.fixed), Pdo(0x1600 if outputs else 0x1A00, "", ()))
    if not needed <= {entry.index for entry in entries}:
        return None
    mapped = replace(free, entries=tuple(entries), sync_manager=manager)
    return (mapped, *(replace(pdo, sync_manager=None) for pdo in pdos if pdo is not free))


def entries_of(pdos: Sequence[Pdo]) -> list[PdoEntry]:
    """Return the entries of PDOs that are not padding."""
    return [entry for pdo in pdos for entry in pdo.entries if entry.index]


def _lines(device: Device, kind: str, has_mode: bool) -> Iterator[str]:
    identity = device.identity
    yield from _comment(
        f"{device.name}{f' ({device.type})' if device.type else ''}"
        + (f", {device.vendor_name}" if device.vendor_name else "")
        + f": revision 0x{identity.revision:08X}, by {device.source.value}, {_file_name(device.origin)}."
    )
    yield from _comment("Made by `rtcp device new`. Lines marked REQUIRED need a value, lines marked CHECK a person.")
    yield ""
    yield f"name: {_quoted(device.name or f'0x{identity.product_code:08X}')}"
    yield f"kind: {kind}" + _kind_note(device, kind)
    yield f"vendor_id: 0x{identity.vendor_id:08X}"
    yield f"product_id: 0x{identity.product_code:08X}"
    yield ""
    yield from _clock_lines(device, kind == "cia402", has_mode)
    watchdog = _DRIVE_WATCHDOG_MS if kind == "cia402" else _WATCHDOG_MS
    note = (
        "CHECK: without outputs for so long the drive stops; 5 to 10 cycles" if kind == "cia402" else "without outputs"
    )
    yield f"watchdog_ms: {watchdog}             # ms; {note}"
    for n in sorted({pdo.sync_manager or 0 for pdo in device.assigned(True)}):
        manager = device.sync_managers[n] if n < len(device.sync_managers) else None
        if manager is not None and manager.lacks_watchdog:
            off = f"control byte 0x{manager.control:02X}"
            yield f"# Sync manager {n} leaves the watchdog off ({off}): switched on at the start."
    coe = device.coe
    if coe is None:
        yield "coe: false                  # it has no object dictionary: its mapping is that of its EEPROM"
    configurable = coe is not None and coe.pdo_assignment and not _calls_inputs_outputs(device)
    said = "the PDOs below are assigned and mapped at the start" if configurable else "fixed: compared, never written"
    yield f"configurable_pdos: {str(configurable).lower():10}# {said}"
    if coe is not None and not coe.complete_access:
        yield "complete_access: false"
    yield ""
    yield from _startup_lines(device, kind)
    if kind == "cia402":
        yield from _scaling_lines(device)
    names: Counter[str] = Counter()
    for key, outputs in (("rpdo", True), ("tpdo", False)):
        yield from _pdo_lines(device, kind, key, device.assigned(outputs), outputs, names, configurable)
        yield from _others(device, key, outputs)


def _kind_note(device: Device, kind: str) -> str:
    if kind != "cia402" and _is_drive(device):
        needed = ", ".join(f"0x{index:04X}" for outputs in (True, False) for index in _NEEDED[outputs])
        return f"     # CHECK: a drive whose PDOs lack one of {needed}: it can move no joint"
    return "     # CHECK: by the names of its inputs; else generic" if kind == "encoder" else ""


def _clock_lines(device: Device, is_drive: bool, has_mode: bool) -> Iterator[str]:
    modes = device.dc_modes
    chosen = modes[0] if modes else None
    if chosen is None and is_drive and device.source is not Source.ESI:
        yield from _required("assign_activate", "its EEPROM names no clock mode")
        return
    if is_drive and not has_mode:
        chosen = next((mode for mode in modes if mode.assign_activate & 0x0100), chosen)
    if chosen is not None and not chosen.assign_activate & _SYNC0:
        chosen = next((mode for mode in modes if not mode.assign_activate), replace(chosen, assign_activate=0))
    word = 0 if chosen is None else chosen.assign_activate
    yield f"assign_activate: 0x{word:04X}     # " + (
        "it has no distributed clock" if chosen is None else _mode_text(chosen)
    )
    if chosen is not None:
        if chosen.sync0_cycle:
            yield f"sync0_factor: 0\nsync0_cycle_us: {chosen.sync0_cycle / 1000:g}"
        elif chosen.sync0_factor not in (0, 1):
            yield f"sync0_factor: {chosen.sync0_factor}"
        if chosen.sync0_shift:
            yield f"sync0_shift_us: {chosen.sync0_shift / 1000:g}"
        if chosen.assign_activate & 0x0400:
            if chosen.sync1_cycle:
                yield f"sync1_cycle_us: {chosen.sync1_cycle / 1000:g}"
            elif chosen.sync1_factor:
                yield f"sync1_factor: {chosen.sync1_factor}"
            if chosen.sync1_shift:
                yield f"sync1_shift_us: {chosen.sync1_shift / 1000:g}"
    for mode in modes:
        if mode is not chosen:
            yield f"# assign_activate: 0x{mode.assign_activate:04X}   # {_mode_text(mode)}"


def _mode_text(mode: DcMode) -> str:
    return mode.name + (f": {mode.description}" if mode.description and mode.description != mode.name else "")


def _calls_inputs_outputs(device: Device) -> bool:
    """Whether a PDO has an index of the other direction: its mapping is not changed."""
    return any(pdo.index in MAPPINGS[not outputs] for outputs in (True, False) for pdo in device.assigned(outputs))


def _startup_lines(device: Device, kind: str) -> Iterator[str]:
    written: list[str] = []
    mapping = {pdo.index for pdo in (*device.rx_pdos, *device.tx_pdos)}
    for command in device.init_commands:
        if command.index in mapping or 0x1C10 <= command.index <= 0x1C2F:
            continue  # the mapping below sets it
        if not command.data:
            continue
        if kind == "cia402" and command.index % OBJECTS_PER_AXIS == _MODE_OBJECT % OBJECTS_PER_AXIS:
            continue  # below
        entry = _object(device, command.index, command.sub_index)
        kept = None if entry is None else resolve(entry.type, entry.bits)
        name = (command.comment or ("" if entry is None else entry.name)).strip()
        signed = kept is not None and kept.kind is Kind.SIGNED
        as_bytes = kept is not None and kept.kind in (Kind.TEXT, Kind.BYTES)
        if command.complete_access or as_bytes or len(command.data) not in (1, 2, 4, 8):
            content = f'type: bytes, data: "{command.data.hex(" ")}"' + ", complete: true" * command.complete_access
        else:
            number = int.from_bytes(command.data, "little", signed=signed)
            content = f"type: {'int' if signed else 'uint'}{8 * len(command.data)}, value: {number}"
        written.append(
            f"  - {{index: 0x{command.index:04X}, sub_index: {command.sub_index}, {content}"
            + (f", name: {_quoted(name)}" if name else "")
            + "}"
        )
    axes = (_axes(device) or (1,)) if kind == "cia402" else ()
    for axis in axes:
        index = _MODE_OBJECT + (axis - 1) * OBJECTS_PER_AXIS
        if not _switches_mode(device, axis):
            mode = _object(device, index, 0)
            bits = _BYTE if mode is None else mode.bits
            written.append(
                f"  - {{index: 0x{index:04X}, sub_index: 0, type: int{bits}, value: {_CSP}, name: modes of operation}}"
                "   # CSP"
            )
    set_by_file = {command.index for command in device.init_commands}
    for axis in axes:
        index = QUICK_STOP_OPTION + (axis - 1) * OBJECTS_PER_AXIS
        if index not in set_by_file and _object(device, index, 0) is not None:
            written.append(
                f"  - {{index: 0x{index:04X}, sub_index: 0, type: int16, value: {_RAMP_AND_HOLD}, "
                "name: quick stop option code, optional: true}   # CHECK: 6: ramp down, then hold; 2 drops the torque"
            )
    if written:
        yield "# Start-up SDOs, written in PRE-OP in this order and read back, in the device's own units."
        if any(line.startswith("  - ") for line in written):
            yield "sdo:"
        yield from written
        yield ""


def _scaling_lines(device: Device) -> Iterator[str]:
    yield "# What the drive counts in; compared with the drive's own objects at the start (docs/drives.md)."
    yield "scaling:"
    for axis in _axes(device) or (1,):
        base = (axis - 1) * OBJECTS_PER_AXIS
        mapped = {entry.index - base for outputs in (True, False) for entry in entries_of(device.assigned(outputs))}
        yield from _ratio_line(device, 0x608F + base, "  - encoder_increments", "increments per motor revolution")
        gear = _ratio(device, 0x6091 + base)
        yield from _ratio_line(device, 0x6091 + base, "    gear_ratio", "motor revolutions per output revolution")
        if gear in (None, 1.0):
            yield from _required(
                "    external_gear_ratio", "output revolutions per joint revolution, by a further gear"
            )
        if _has_object(device, 0x6092 + base):
            yield from _ratio_line(device, 0x6092 + base, "    feed_constant", "position counts per output revolution")
        if mapped & {*_VELOCITIES}:
            yield from _velocity_lines(device, 0x60A9 + base, gear)
        if speed := _default(device, _MOTOR_SPEED + base, 0):
            where = f"{_origin(device, _MOTOR_SPEED + base)}, which by the standard is in rpm"
            yield f"    max_motor_speed: {speed:.10g}     # CHECK: rpm; {where}"
        if mapped & {*_TORQUES}:
            yield from _torque_lines(device, 0x6076 + base)
    yield ""


def _required(key: str, said: str) -> Iterator[str]:
    """Yield a key whose value the description lacks, below a comment on where it is: the file is refused without."""
    indent = key[: len(key) - len(key.lstrip())]
    text = f"{said}: see {SOURCES[key.lstrip(' -')]}"
    yield from textwrap.wrap(text, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}#   ")
    yield f"{key}:     # REQUIRED"


def _ratio_line(device: Device, index: int, key: str, said: str) -> Iterator[str]:
    ratio = _ratio(device, index)
    # A feed constant of 1 is what a drive shows that does not use the object.
    if ratio is None or (ratio == 1.0 and key.endswith("feed_constant")):
        yield from _required(key, said)
    else:
        yield f"{key}: {ratio:.10g}     # {said}; {_origin(device, index)}"


def _origin(device: Device, index: int) -> str:
    return f"0x{index:04X}, " + ("read from the drive" if device.source is Source.BUS else "default")


def _torque_lines(device: Device, index: int) -> Iterator[str]:
    rated, unit = _default(device, index, 0), _torque_unit(device, index)
    if rated:
        yield f"    rated_torque: {rated * TORQUE_UNITS[unit]:.10g}     # Nm; {_origin(device, index)}"
    else:
        yield from _required("    rated_torque", "Nm")
    if unit != "mNm":
        yield f"    rated_torque_unit: {unit}"
    yield from _required("    torque_at", "motor or output, the shaft of the rated torque, which no object tells")


def _torque_unit(device: Device, index: int) -> TorqueUnit:
    entry = _object(device, index, 0)
    unit = None if entry is None or entry.unit is None else units.unit(entry.unit)
    fitting = (name for name, factor in TORQUE_UNITS.items() if unit is not None and isclose(factor, unit.factor))
    return next(fitting, "mNm") if unit is not None and unit.si == "Nm" else "mNm"


def _velocity_lines(device: Device, index: int, gear: float | None) -> Iterator[str]:
    code = _default(device, index, 0)
    unit = None if code is None else VELOCITY_UNITS.get(int(code))
    if unit is not None:
        yield f"    velocity_unit: {unit}     # {_origin(device, index)}"
    else:
        found = "" if code is None else f"; 0x{index:04X} is 0x{int(code):08X}, a unit that is not known here"
        yield from _required("    velocity_unit", f"one of {', '.join(sorted(VELOCITY_UNITS.values()))}{found}")
    if unit not in ("counts/s", "0.1 counts/s") and gear != 1.0:
        yield from _required("    velocity_at", "motor or output, the shaft whose revolutions per minute they are")


def _switches_mode(device: Device, axis: int) -> bool:
    """Whether the process data of an axis set its mode, and show it, as bytes: else it stays in one mode."""
    shift = (axis - 1) * OBJECTS_PER_AXIS
    return all(
        any((entry.index, entry.bits) == (index + shift, _BYTE) for entry in entries_of(device.assigned(outputs)))
        for outputs, index in zip((True, False), _MODES, strict=True)
    )


def _ratio(device: Device, index: int) -> float | None:
    """Return the value of a ratio, subindex 1 by 2; None: unknown."""
    above, below = _default(device, index, 1), _default(device, index, 2)
    return None if above is None else above / (below or 1.0)


def _has_object(device: Device, index: int) -> bool:
    return any(described.index == index for described in device.objects)


def _default(device: Device, index: int, sub: int) -> float | None:
    entry = _object(device, index, sub)
    if entry is None or entry.default is None:
        return None
    value = decode(resolve(entry.type, entry.bits), entry.default)
    return float(value) if isinstance(value, int | float) and value else None


def _axes(device: Device) -> tuple[int, ...]:
    """Return the axes of a drive whose needed objects are all assigned."""
    there = {
        (entry.index, outputs)
        for outputs in (True, False)
        for entry in entries_of(device.assigned(outputs))
        if (entry.bits == _WORD if entry.index % OBJECTS_PER_AXIS in _STATE_WORDS else entry.bits >= _WORD)
    }
    bases = range(0, _MOST_AXES * OBJECTS_PER_AXIS, OBJECTS_PER_AXIS)
    return tuple(
        n
        for n, base in enumerate(bases, 1)
        if all((index + base, outputs) in there for outputs in (True, False) for index in _NEEDED[outputs])
    )


def _pdo_lines(
    device: Device, kind: str, key: str, pdos: Sequence[Pdo], outputs: bool, names: Counter[str], configurable: bool
) -> Iterator[str]:
    yield f"# {'Master to device' if outputs else 'Device to master'}. SI value = counts * factor."
    filled = [pdo for pdo in pdos if pdo.entries]
    if not filled:
        yield f"{key}: []"
        yield ""
        return
    coe = device.coe
    can_map = coe is not None and coe.pdo_configuration
    usual = _usual_sync_manager(device, outputs)
    named_managers = any(pdo.sync_manager != usual for pdo in filled)
    yield f"{key}:"
    repeated = Counter(name for pdo in filled for name in {entry.name for entry in pdo.entries})
    for pdo in filled:
        marks = [word for word, holds in (("fixed", pdo.fixed), ("mandatory", pdo.mandatory)) if holds]
        if pdo.excludes:
            marks.append("excludes " + ", ".join(f"0x{index:04X}" for index in sorted(pdo.excludes)))
        said = "; ".join([pdo.name, *marks] if pdo.name else marks)
        yield f"  - index: 0x{pdo.index:04X}" + (f"     # {_clean(said)}" if said else "")
        if configurable and (pdo.fixed or not can_map):
            yield "    fixed: true"
        if named_managers:
            yield f"    sync_manager: {pdo.sync_manager}"
        if pdo.samples > 1:
            yield f"    samples: {pdo.samples}     # values a cycle; each channel is their mean"
            if pdo.sample_increment:
                last = pdo.index + pdo.samples - 1
                yield f"    sample_increment: {pdo.sample_increment}     # one PDO each, up to 0x{last:04X}"
        if start := device.registers_of(pdo):
            yield f"    start_address: 0x{start:04X}"
        axis = _axis_of(pdo) if kind == "cia402" else 1
        if axis > 1:
            yield f"    axis: {axis}"
        yield "    channels:"
        for entry in pdo.entries:
            where = f"{prefix_of(pdo)} " if repeated[entry.name] > 1 else ""
            yield from _channel_lines(device, kind, replace(entry, name=where + entry.name), axis, names, key)
    yield ""


def _channel_lines(
    device: Device, kind: str, entry: PdoEntry, axis: int, names: Counter[str], key: str
) -> Iterator[str]:
    if not entry.index:
        yield f"      - {{index: 0, sub_index: 0, {_type_keys('', entry.bits)}}}"
        return
    known, first = None, entry.index - (axis - 1) * OBJECTS_PER_AXIS
    types = _type_keys(entry.type, entry.bits)
    if kind == "cia402" and entry.index in _AXES:
        known = _DRIVE_CHANNELS.get(first)
    elif kind == "encoder" and key == "tpdo" and (entry.index, entry.sub_index) == _place_of(_counter(device)):
        known = "position"
    is_constant = known == "modes_of_operation" and not _switches_mode(device, axis)
    if is_constant:
        known = "mode_sent"
    if kind == "cia402" and known is not None and (first not in _MODES or entry.bits == _BYTE):
        types = _drive_type(first, entry)
    elif known == _DRIVE_CHANNELS[0x6061]:
        known = None
    if known and names[f"{key}.{axis}.{known}"]:
        known = None  # an object that is mapped twice
    own = _identifier(entry)
    if kind == "cia402" and own in _DRIVE_CHANNELS.values():
        own += f"_{entry.index:04x}"  # the driver would take it for the drive's own object
    name = known or _unique(own, names, key, axis)
    if known:
        names[f"{key}.{axis}.{known}"] += 1
    keys = f"index: 0x{entry.index:04X}, sub_index: {entry.sub_index}, {types}, name: {_quoted(name)}"
    if is_constant:
        keys += f", safe: {_CSP}"  # no PDO shows the mode: it is not changed
    described = _object(device, entry.index, entry.sub_index)
    is_bound = kind == "cia402" and key == "rpdo" and first in BOUNDING_OBJECTS
    bound = _default(device, entry.index, entry.sub_index) if is_bound else None
    if bound is not None:
        keys += f", safe: {bound:.10g}"
    unit = None if described is None or described.unit is None or known or is_bound else units.unit(described.unit)
    if unit is not None and unit.si:
        keys += f", factor: {unit.factor:.10g}, unit: {_quoted(unit.si)}"
    said = [_clean(entry.name), _clean(entry.type) if entry.type.upper() not in ("", "BOOL") else ""]
    if described is not None:
        said += _range_text(described)
    if is_bound and bound is None:
        said.append("always sent: the drive's own value, unless the channel has a `safe`")
    elif is_bound:
        said.append("CHECK: always sent; at 0 the drive has no torque")
    yield f"      - {{{keys}}}   # {', '.join(text for text in said if text)}".rstrip(" #")


def _drive_type(first: int, entry: PdoEntry) -> str:
    """Return the type keys of a drive's object by the standard, which fixes its sign; `first`: its index in axis 1."""
    if resolve(entry.type, entry.bits).kind is Kind.REAL:
        return _type_keys(entry.type, entry.bits)
    written = f"{'uint' if first in _UNSIGNED else 'int'}{entry.bits}"
    return f"type: {written}" if written in BITS else _type_keys(entry.type, entry.bits)


def prefix_of(pdo: Pdo) -> str:
    """Return the prefix of a PDO's channels: `channel 2`, else its name."""
    channel = _CHANNEL.search(pdo.name)
    return f"channel {channel[1]}" if channel else pdo.name or f"x{pdo.index:04x}"


def _place_of(entry: PdoEntry | None) -> tuple[int, int] | None:
    return None if entry is None else (entry.index, entry.sub_index)


def _range_text(entry: ObjectEntry) -> list[str]:
    if entry.minimum is None and entry.maximum is None:
        return []
    data_type = resolve(entry.type, entry.bits)
    if data_type.kind in (Kind.TEXT, Kind.BYTES):
        return []
    low, high = ("" if end is None else str(decode(data_type, end)) for end in (entry.minimum, entry.maximum))
    return [f"{low} to {high}" if low and high else f"at least {low}" if low else f"at most {high}"]


def _others(device: Device, key: str, outputs: bool) -> Iterator[str]:
    """Yield comments on the PDOs that can be assigned instead."""
    there = {pdo.index for pdo in device.assigned(outputs)}
    others = [pdo for pdo in (device.rx_pdos if outputs else device.tx_pdos) if pdo.index not in there]
    if others:
        listed = "; ".join(f"0x{pdo.index:04X} {_clean(pdo.name)} ({pdo.bits} bits)" for pdo in others)
        yield from _comment(f"Further PDOs of {key} (`rtcp device new --pdo`): {listed}")
        yield ""


def _usual_sync_manager(device: Device, outputs: bool) -> int:
    wanted = SyncManagerType.OUTPUTS if outputs else SyncManagerType.INPUTS
    usual = 2 if outputs else 3
    return next((n for n, manager in enumerate(device.sync_managers) if manager.type is wanted), usual)


def _object(device: Device, index: int, sub: int) -> ObjectEntry | None:
    for described in device.objects:
        if described.index == index:
            return next((entry for entry in described.entries if entry.sub_index == sub), None)
    return None


def _axis_of(pdo: Pdo) -> int:
    axes = Counter((entry.index - 0x6000) // OBJECTS_PER_AXIS + 1 for entry in pdo.entries if entry.index in _AXES)
    return axes.most_common(1)[0][0] if axes else 1


def _type_keys(name: str, bits: int) -> str:
    data_type = resolve(name, bits)
    if data_type.kind is Kind.REAL:
        return f"type: float{bits}"
    if data_type.kind in (Kind.TEXT, Kind.BYTES) and not bits % 8:
        return f"type: bytes, bits: {bits}"
    if bits == 1:
        return "type: bool"
    written = f"{'int' if data_type.kind is Kind.SIGNED else 'uint'}{bits}"
    return f"type: {written}" if written in BITS else f"type: bits, bits: {bits}"


def _identifier(entry: PdoEntry) -> str:
    name = re.sub(r"[^a-z0-9]+", "_", entry.name.lower()).strip("_")
    name = name[:48].rstrip("_") or f"x{entry.index:04x}_{entry.sub_index}"
    return "padding_entry" if name == "padding" else name


def _unique(name: str, names: Counter[str], key: str, axis: int) -> str:
    if key == "tpdo" and names[f"rpdo.{axis}.{name}"]:
        return _unique(f"{name}_in", names, key, axis)
    names[f"{key}.{axis}.{name}"] += 1
    count = names[f"{key}.{axis}.{name}"]
    return name if count == 1 else _unique(f"{name}_{count}", names, key, axis)


def _quoted(text: str) -> str:
    """Return a YAML scalar."""
    clean = _clean(text)[:64]
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9 ._/()+-]*[A-Za-z0-9.)]|[A-Za-z]", clean)
    return clean if plain and clean.lower() not in ("null", "true", "false") else f'"{clean}"'


def _file_name(origin: str) -> str:
    return origin.rpartition("/")[2]


def _clean(text: str) -> str:
    return " ".join(re.sub(r'["\\\x00-\x1f\x7f-\x9f\u2028\u2029\ufeff]', " ", text).split())


def _comment(text: str) -> list[str]:
    return textwrap.wrap(_clean(text), _WIDTH, initial_indent="# ", subsequent_indent="#   ")
