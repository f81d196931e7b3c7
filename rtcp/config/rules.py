"""Rules between the values of a file and between files, which no single type can state.

A rule yields findings, with the key path below its object. See `validation.rule` for when it runs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Protocol

from rtcp.config.drive_limits import factor_of
from rtcp.config.find import registered
from rtcp.config.findings import Finding, KeyPath, dotted
from rtcp.config.model import (
    BEYOND_FULL,
    BITS,
    ENDLESS,
    MODE_CHANNELS,
    MOST_AXES,
    PLATFORM_PARTS,
    UNLIMITED_TORQUE,
    VIRTUAL,
    AnalogStickConfig,
    ArmConfig,
    ArmFile,
    AxisMode,
    Box,
    DeviceDescription,
    EthercatBus,
    ExternalAxis,
    GripperConfig,
    HasBox,
    InputsConfig,
    Joint,
    KeepOut,
    Kinematics,
    MechanicalLimit,
    MotionFile,
    NamedPose,
    NamedTerminal,
    OutputsConfig,
    Pdo,
    PdoEntry,
    Point,
    Range,
    StartupSdo,
    Step,
    Stop,
    Tool,
    Travel,
    integer_range,
)
from rtcp.config.scaling import BOUNDING_OBJECTS, FACTOR_TOLERANCE, OBJECTS_PER_AXIS, QUANTITIES, DriveScaling
from rtcp.config.validation import EVERY_KEY, Place, repeated, rule

_NUMERIC = tuple(name for name in BITS if name != "bool")
_INTEGERS = tuple(name for name in _NUMERIC if "int" in name)
_LONGEST = {"bits": 64, "bytes": 248}
"""Most bits of a channel; an entry's length is one byte (ETG.1000.6, 5.6.5)."""

# The channels that a driver of each kind reads and writes, and their types. CiA 402-2 fixes 0x6040 and 0x6041 as
# UINT16, 0x6060 and 0x6061 as INT8; the other widths are the device's own choice.
CHANNELS: dict[str, dict[str, dict[str, tuple[str, ...]]]] = {
    "cia402": {
        "rpdo": {
            "controlword": ("uint16",),
            "target_position": _INTEGERS,
            "target_velocity": _INTEGERS,
            "target_torque": _INTEGERS,
            "modes_of_operation": ("int8",),
        },
        "tpdo": {
            "statusword": ("uint16",),
            "position": _NUMERIC,
            "velocity": _NUMERIC,
            "torque": _NUMERIC,
            "modes_of_operation_display": ("int8",),
        },
    },
    "encoder": {"tpdo": {"position": _NUMERIC}},
    "io": {"rpdo": {"outputs": ("uint16",)}, "tpdo": {"inputs": ("uint16",), "counter": ("int32",)}},
}
OPTIONAL = {
    "target_velocity", "target_torque", "velocity", "torque", "modes_of_operation", "modes_of_operation_display",
    "counter",
}  # fmt: skip
"""Channels that only some modes of a drive need (`MODE_CHANNELS`, `_drive_mode`), or only some boxes have."""
OTHER_PDOS = {"rpdo": ("tpdo", 0x1A00, 0x1BFF), "tpdo": ("rpdo", 0x1600, 0x17FF)}
"""The other direction and its objects (ETG.1000.6); devices have PDOs outside both ranges too."""
_OF_OUTPUTS: tuple[str, ...] = ("min", "max", "safe")
_OF_INPUTS: tuple[str, ...] = ("modulo",)
"""Keys of a channel that apply to one direction."""
MODES_OF_OPERATION, CSP = 0x6060, 8
"""Object of the drive mode and its value for cyclic synchronous position (CiA 402-2, clause 10.1)."""
JOYSTICK_TERMINALS = ("forward", "backward", "left", "right", "mode_up", "mode_down")
LONGEST_INTERFACE = 15
"""Characters of a network interface's name (IFNAMSIZ less the closing zero)."""

_ALL_JOINTS = "joints"
_BASE = (0.0, 0.0, 0.0)

Position = tuple[float, float, float]


def _order(low: float, high: float, of: str = "") -> Iterator[Finding]:
    if not low < high:
        yield Finding((), "out_of_order", min=low, max=high, of=of)


def _within(where: KeyPath, value: float, low: float, high: float, of: str) -> Iterator[Finding]:
    if not low <= value <= high:
        yield Finding(where, "outside", found=value, low=low, high=high, of=of)


# -- devices -----------------------------------------------------------------------------------------------------------


@rule(PdoEntry)
def _entry(entry: PdoEntry) -> Iterator[Finding]:
    if entry.index and entry.factor == 0:
        yield Finding(("factor",), "zero")
    if entry.min is not None and entry.max is not None and not entry.min < entry.max:
        yield from _order(entry.min, entry.max)
    elif entry.factor and entry.is_number and entry.length and entry.safe is not None:
        yield from _within(("safe",), entry.safe, *entry.range, "the range of the channel")
    if entry.type == "bool" and entry.index and (entry.factor, entry.offset) != (1.0, 0.0):
        key = "factor" if entry.factor != 1 else "offset"
        yield Finding((key,), "bool_scaled", found=getattr(entry, key))
    if entry.modulo and not ("int" in entry.type or entry.type == "bits"):
        yield Finding(("modulo",), "modulo_of_type", found=entry.modulo, type=entry.type)
    if entry.index and entry.name == PdoEntry.name:
        need = f"it must be a text of 1 to 64 characters other than {PdoEntry.name}"
        yield Finding((), "missing", key="name", need=need)
    longest = _LONGEST.get(entry.type)
    if longest is None:
        if entry.bits is not None:
            yield Finding(("bits",), "bits_fixed", found=entry.bits, type=entry.type, bits=BITS[entry.type])
    elif entry.bits is None:
        yield Finding((), "missing", key="bits", need=f"the type {entry.type} needs a length of 1 to {longest}")
    elif entry.type == "bytes" and (entry.bits % 8 or entry.bits > longest):
        wanted = f"a multiple of 8 from 8 to {longest} for the type bytes"
        yield Finding(("bits",), "bits_of_bytes", found=entry.bits, allowed=wanted)
    elif entry.index and entry.bits > longest:
        wanted = f"1 to {longest} for a channel of the type {entry.type}"
        yield Finding(("bits",), "too_many_bits", found=entry.bits, allowed=wanted)


@rule(StartupSdo)
def _startup_value(sdo: StartupSdo) -> Iterator[Finding]:
    if sdo.type == "bytes":
        if not re.fullmatch(r"([0-9a-fA-F]{2} ?)+", sdo.data):
            wanted = 'a text of bytes in hexadecimal, as "54 41 4E 4B", for the type bytes'
            yield Finding(("data",), "no_bytes", found=sdo.data or None, allowed=wanted)
        if sdo.value is not None:
            yield Finding(("value",), "value_of_bytes", found=sdo.value, allowed="the key data for the type bytes")
        if sdo.complete and sdo.sub_index > 1:
            yield Finding(("sub_index",), "complete_access", found=sdo.sub_index, allowed="0 or 1 with complete access")
        return
    for key in ("data", "complete"):
        if getattr(sdo, key):
            yield Finding((key,), "only_for_bytes", type=sdo.type)
    if sdo.value is None:
        yield Finding((), "missing", key="value", need=f"the type {sdo.type} needs it")
    if sdo.value is None or sdo.type.startswith("float"):
        return
    low, high = integer_range(sdo.type)
    if not low <= sdo.value <= high or sdo.value != int(sdo.value):
        wanted = f"an integer from {low} to {high}, the range of {sdo.type}"
        yield Finding(("value",), "outside_type", found=sdo.value, allowed=wanted)


@rule(DeviceDescription, "kind")
def _kind(device: DeviceDescription) -> Iterator[Finding]:
    # By name alone: the loop loads the driver, and the configuration must not import it.
    kinds = sorted(registered("rtcp.devices"))
    if device.kind not in kinds:
        yield Finding(("kind",), "choice", found=device.kind, allowed=f"one of {', '.join(kinds)}")


@rule(DeviceDescription, "rpdo", "kind")
def _rpdo(device: DeviceDescription) -> Iterator[Finding]:
    return _pdos("rpdo", device.rpdo, device)


@rule(DeviceDescription, "tpdo", "kind")
def _tpdo(device: DeviceDescription) -> Iterator[Finding]:
    return _pdos("tpdo", device.tpdo, device)


@rule(DeviceDescription, "rpdo", "tpdo", "kind")
def _one_name(device: DeviceDescription) -> Iterator[Finding]:
    outputs = {entry.name for entry in device.outputs} if device.has_channels else set()
    for i, pdo in enumerate(device.tpdo):
        for j, entry in enumerate(pdo.channels):
            if entry.is_number and entry.name in outputs:
                yield Finding(("tpdo", i, "channels", j, "name"), "output_and_input", found=entry.name)


@rule(DeviceDescription, "assign_activate")
def _dc_word(device: DeviceDescription) -> Iterator[Finding]:
    word = device.assign_activate
    if word and word & 0x0300 != 0x0300:
        yield Finding(("assign_activate",), "no_sync0", found=word)


@rule(DeviceDescription, "sync0_factor", "sync0_cycle_us")
def _sync0_cycle(device: DeviceDescription) -> Iterator[Finding]:
    if device.sync0_factor == 0 and device.sync0_cycle_us == 0:
        yield Finding(("sync0_cycle_us",), "no_cycle", found=0, allowed="a cycle above 0 us where sync0_factor is 0")


@rule(DeviceDescription, "coe", "sdo")
def _without_coe(device: DeviceDescription) -> Iterator[Finding]:
    if device.sdo and not device.coe:
        yield Finding(("sdo",), "without_coe", found=len(device.sdo))


@rule(DeviceDescription, "rpdo", "tpdo")
def _sync_managers(device: DeviceDescription) -> Iterator[Finding]:
    used: dict[int | None, str] = {}
    for direction, pdos in (("rpdo", device.rpdo), ("tpdo", device.tpdo)):
        for i, pdo in enumerate(pdos):
            where = (direction, i, "sync_manager")
            if (pdo.sync_manager is None) != (pdos[0].sync_manager is None):
                yield Finding(where, "some_sync_managers", image=direction)
            elif pdo.sync_manager is not None and used.setdefault(pdo.sync_manager, direction) != direction:
                yield Finding(where, "shared_sync_manager", found=pdo.sync_manager)


@rule(DeviceDescription, "rpdo", "tpdo", "sdo", "kind")
def _drive_mode(device: DeviceDescription) -> Iterator[Finding]:
    """A drive whose PDOs lack the mode of operation, or its display, stays in the mode of a start-up SDO: CSP."""
    if device.kind != "cia402":
        return
    for axis in device.axes:
        of = "" if device.axes == (1,) else f" of axis {axis}"
        channels = device.of_axis(axis)
        sent, received = (
            {entry.name for pdo in pdos for entry in pdo.channels if entry.index}
            for pdos in (channels.rpdo, channels.tpdo)
        )
        index = MODES_OF_OPERATION + (axis - 1) * OBJECTS_PER_AXIS
        if len(device.axes) > 1 and not (sent and received):
            yield Finding(("tpdo" if sent else "rpdo",), "one_direction", of=of)
        elif "modes_of_operation" in sent and "modes_of_operation_display" in received:
            continue
        elif device.startup(MODES_OF_OPERATION, axis) != CSP:
            key, kind = ("tpdo", "mode_not_shown") if "modes_of_operation" in sent else ("rpdo", "no_csp")
            yield Finding((key,), kind, of=of, index=index, value=CSP)


@rule(DeviceDescription, "rpdo", "tpdo", "scaling", "kind")
def _scaling(device: DeviceDescription) -> Iterator[Finding]:
    scaling, axes = device.scaling, device.axes
    if scaling and device.kind != "cia402":
        yield Finding(("scaling",), "scaling_of_kind", kind=device.kind)
    elif len(scaling) > 1 and len(scaling) != axes[-1]:
        wanted = f"one for all axes, or one for each of {axes[-1]}"
        yield Finding(("scaling",), "size", found=len(scaling), allowed=wanted)
    if axes != tuple(range(1, len(axes) + 1)):
        yield Finding((), "axes_with_gap", axes=" and ".join(map(str, axes)))
    elif len(axes) > 1 and device.kind in CHANNELS and device.kind != "cia402":
        yield Finding((), "several_axes", axes=len(axes))


@rule(DeviceDescription, "limits", "rpdo", "tpdo", "kind")
def _limit_objects(device: DeviceDescription) -> Iterator[Finding]:
    """Yield limits of a device that is no drive, of another axis, or without a factor."""
    for i, entry in enumerate(device.limits):
        where, factor = ("limits", i), factor_of(device, entry)
        if device.kind != "cia402":
            if device.kind in CHANNELS:
                yield Finding(where, "scaling_of_kind", kind=device.kind)
        elif entry.axis not in device.axes:
            yield Finding((*where, "axis"), "axis", found=entry.axis, allowed=" or ".join(map(str, device.axes)))
        elif not factor:
            wanted = "a number other than 0: no channel of the axis has one for it"
            yield Finding((*where, "factor"), "range", found=entry.factor, allowed=wanted)


@rule(DeviceDescription, "rpdo", "tpdo", "kind")
def _drive_channels(device: DeviceDescription) -> Iterator[Finding]:
    """Yield factors that turn a joint against its position, and limits that leave an enabled drive without torque."""
    if device.kind != "cia402":
        return
    channels = [
        (pdo.axis_of(entry), (direction, i, "channels", j), entry)
        for direction, pdos in (("rpdo", device.rpdo), ("tpdo", device.tpdo))
        for i, pdo in enumerate(pdos)
        for j, entry in enumerate(pdo.channels)
        if entry.index
    ]
    positions = {
        axis: (where, entry) for axis, where, entry in reversed(channels) if QUANTITIES.get(entry.name) == "position"
    }
    for axis, where, entry in channels:
        bound = BOUNDING_OBJECTS.get(entry.index - (axis - 1) * OBJECTS_PER_AXIS)
        if bound is not None and where[0] == "rpdo" and not entry.safe and not (entry.safe is None and device.coe):
            yield Finding((*where, "safe"), "safe_zero", channel=entry.name, bound=bound)
        quantity = QUANTITIES.get(entry.name)
        if quantity is None or axis not in positions:
            continue
        of, first = positions[axis]
        if quantity == "position" and not math.isclose(entry.factor, first.factor, rel_tol=FACTOR_TOLERANCE):
            alike = "positions of an axis have the same factor"
        elif (entry.factor < 0) != (first.factor < 0):
            alike = "factors of an axis have the same sign"
        else:
            continue
        of_first = {"first": first.factor, "of": f"{first.name} ({dotted(of)})"}
        yield Finding((*where, "factor"), "unlike", found=entry.factor, channel=entry.name, **of_first, alike=alike)


@rule(DriveScaling)
def _of_drive(scaling: DriveScaling) -> Iterator[Finding]:
    if scaling.external_gear_ratio == 0:
        yield Finding(("external_gear_ratio",), "zero")
    if (scaling.rated_current is None) != (scaling.torque_constant is None):
        key = "torque_constant" if scaling.torque_constant is None else "rated_current"
        yield Finding((), "missing", key=key, need="rated_current and torque_constant belong together")
    if scaling.rated_torque is not None and scaling.rated_current is not None:
        yield Finding(("rated_torque",), "two_torques")


def _pdos(direction: str, pdos: Sequence[Pdo], device: DeviceDescription) -> Iterator[Finding]:
    kind = device.kind
    opposite, low, high = OTHER_PDOS[direction]
    first: dict[int, int] = {}
    axes: dict[int, dict[str, tuple[KeyPath, PdoEntry]]] = {}
    for i, pdo in enumerate(pdos):
        # Some devices with a fixed mapping call their inputs RxPDOs.
        if low <= pdo.index <= high and device.configurable_pdos:
            of_index = {"other": opposite, "low": low, "high": high, "image": direction}
            yield Finding((direction, i, "index"), "index_of_other", found=pdo.index, **of_index)
        else:
            for each in dict.fromkeys(part.index for part in pdo.assigned):
                if first.setdefault(each, i) != i:
                    yield Finding(
                        (direction, i, "index"), "repeated_index", found=each, of=f"{direction}[{first[each]}]"
                    )
                    break
        if pdo.samples > 1 and (direction != "tpdo" or kind not in ("analog", "generic")):
            text = f"found {pdo.samples}, allowed is more than 1 for inputs of the kinds analog and generic alone"
            yield Finding((direction, i, "samples"), "samples", text=text)
        part = pdo.assigned[-1]
        last = max((part.index, *(entry.index for entry in part.channels)))
        if last > 0xFFFF:
            text = f"found an object of index 0x{last:X} for the last of {pdo.samples} values, allowed is 0xFFFF"
            yield Finding((direction, i, "sample_increment"), "samples", text=text)
        for j, entry in enumerate(pdo.channels):
            where = (direction, i, "channels", j)
            if pdo.samples > 1 and (entry.modulo or entry.type == "bytes"):
                text = f"{entry.name}: found a counter or an array, which has no mean: give it a PDO with samples 1"
                yield Finding(where, "samples", text=text)
            names = axes.setdefault(pdo.axis_of(entry), {}) if entry.index else {}
            if entry.index and names.setdefault(entry.name, (where, entry))[1] is not entry:
                yield Finding((*where, "name"), "repeated_channel", found=entry.name, image=direction)
    needed = CHANNELS.get(kind, {}).get(direction, {})
    if kind == "coupler" and pdos:
        yield Finding((direction,), "pdos_of_coupler")
    for i, pdo in enumerate(pdos):
        for j, entry in enumerate(pdo.channels):
            unused = _OF_OUTPUTS if direction == "tpdo" else _OF_INPUTS
            if kind == "io" or (kind == "cia402" and entry.name in needed):
                unused = (*_OF_OUTPUTS, *_OF_INPUTS, "offset")
            for key in unused:
                if getattr(entry, key) != getattr(PdoEntry, key):
                    of_key = {"channel": entry.name, "image": direction, "kind": kind}
                    wraps = key == "modulo" and (kind, entry.name) == ("cia402", "position")
                    code = "position_wraps" if wraps else "no_meaning"
                    yield Finding((direction, i, "channels", j, key), code, **of_key)
    for axis, names in (axes or {1: {}}).items():
        if missing := [name for name in needed if name not in names and name not in OPTIONAL]:
            there = f"its channels are {', '.join(names)}" if names else "it has no channels"
            those = f"{'a channel' if len(missing) == 1 else 'channels'} named {', '.join(missing)}"
            of = f" of axis {axis}" if len(axes) > 1 else ""
            yield Finding((direction,), "channels_lacking", kind=kind, lacking=f"{those}{of}", there=there)
        for name in needed.keys() & names.keys():
            place, entry = names[name]
            if entry.type not in needed[name]:
                wanted = "any type but bool" if needed[name] is _NUMERIC else " or ".join(needed[name])
                yield Finding((*place, "type"), "type_of_channel", found=entry.type, channel=name, allowed=wanted)


def period_findings(device: DeviceDescription, period_us: float) -> Iterator[Finding]:
    """Yield the mistakes of a device under a cycle period, us."""
    cycles = f"(the cycle period is {period_us:g} us)"
    shortest, watchdog = 2 * period_us / 1000, device.watchdog_ms
    # A drive keeps its last target until the watchdog expires: 100 ms is the ESC's default, 10 cycles for slower buses.
    longest = max(100.0, 10 * period_us / 1000) if device.kind == "cia402" else math.inf
    if watchdog <= shortest:
        wanted = f"more than 2 cycles, {shortest:g} ms {cycles}: one late frame must not trip it"
        yield Finding(("watchdog_ms",), "watchdog_too_short", found=watchdog, unit=" ms", allowed=wanted)
    elif watchdog > longest:
        wanted = f"at most {longest:g} ms {cycles}: until it expires the drive keeps its last target"
        yield Finding(("watchdog_ms",), "watchdog_too_long", found=watchdog, unit=" ms", allowed=wanted)
    if abs(device.sync0_shift_us) >= period_us:
        wanted = f"less than one cycle in either direction {cycles}"
        yield Finding(("sync0_shift_us",), "shift_too_long", found=device.sync0_shift_us, unit=" us", allowed=wanted)
    if device.assign_activate and device.sync0_factor < 0 and round(period_us * 1000) % -device.sync0_factor:
        wanted = f"a part of whole ns {cycles}: otherwise SYNC0 drifts away from the frames"
        yield Finding(("sync0_factor",), "sync0_part", found=device.sync0_factor, allowed=wanted)


# -- the arm -----------------------------------------------------------------------------------------------------------


@rule(Range)
@rule(Travel)
@rule(MechanicalLimit)
def _range(limits: Range | MechanicalLimit) -> Iterator[Finding]:
    return _order(limits.min, limits.max)


@rule(Box)
@rule(KeepOut)
def _corners(box: Box | KeepOut) -> Iterator[Finding]:
    for axis, low, high in zip("xyz", box.min, box.max, strict=True):
        yield from _order(low, high, f" in {axis}")


@rule(GripperConfig)
def _gripper(gripper: GripperConfig) -> Iterator[Finding]:
    joint = gripper.joint
    ends = (("open_position", gripper.open_position), ("closed_position", gripper.closed_position))
    if (gripper.output is None) == (joint is None):
        keys = "neither output nor joint" if joint is None else "both output and joint"
        yield Finding((), "one_of_both", found=keys, allowed="one of them: a digital output, or a drive of its own")
        return
    if joint is None:
        for key, end in ends:
            if end is not None:
                yield Finding((key,), "other_gripper", of="with a joint", found="on an output")
        return
    if gripper.closed is not None:
        yield Finding(("closed",), "other_gripper", of="on an output", found="with a joint")
    low, high = joint.position.min, joint.position.max
    for key, end in ends:
        if end is None:
            yield Finding((), "missing", key=key, need="it must be a number inside gripper.joint.position")
        else:
            yield from _within((key,), end, low, high, "gripper.joint.position")
    if gripper.closed_position is not None and gripper.closed_position == gripper.open_position:
        yield Finding(("closed_position",), "ends_alike", found=gripper.closed_position)


def axes_of(arm: ArmFile | ArmConfig) -> Iterator[tuple[KeyPath, Joint]]:
    """Yield all driven axes with their places: joints, the gripper's joint if it has one, external axes."""
    yield from ((("joints", i), joint) for i, joint in enumerate(arm.joints))
    if arm.gripper and arm.gripper.joint:
        yield ("gripper", "joint"), arm.gripper.joint
    yield from ((("external_axes", i), axis.joint) for i, axis in enumerate(arm.external_axes))


@rule(ArmFile, "slaves")
def _slave_names(arm: ArmFile) -> Iterator[Finding]:
    yield from repeated(((("slaves", i, "name"), slave.name) for i, slave in enumerate(arm.slaves)), "name")
    aliases = ((("slaves", i, "alias"), slave.alias) for i, slave in enumerate(arm.slaves) if slave.alias)
    yield from repeated(aliases, "alias")
    for i, slave in enumerate(arm.slaves):
        if slave.name in PLATFORM_PARTS:
            yield Finding(("slaves", i, "name"), "name_of_part", found=slave.name)


@rule(ExternalAxis)
def _external_axis(axis: ExternalAxis) -> Iterator[Finding]:
    if axis.position is None and "position" in axis.modes and "homing" in axis.modes:
        yield Finding(("modes",), "home_without_ends")
    elif axis.position is not None:
        low, high = axis.position.min, axis.position.max
        if max(-low, high) >= ENDLESS:
            yield Finding(("position",), "range", found=max(-low, high), allowed=f"less than {ENDLESS:g}")


@rule(ArmFile, "slaves", "external_axes")
def _parts_of_axes(arm: ArmFile) -> Iterator[Finding]:
    """Yield external axes with the name of another part: both would have the same fields in the record."""
    taken = PLATFORM_PARTS | {slave.name for slave in arm.slaves}
    for i, axis in enumerate(arm.external_axes):
        if axis.name in taken:
            yield Finding(("external_axes", i, "name"), "name_of_part", found=axis.name)


@rule(ArmFile, "joints", "gripper", "external_axes")
def _axis_names(arm: ArmFile) -> Iterator[Finding]:
    axes = list(axes_of(arm))
    yield from repeated((((*where, "name"), joint.name) for where, joint in axes), "name")
    yield from repeated((((*where, "slave"), joint.place) for where, joint in axes), "slave")
    if len(axes) > MOST_AXES:
        yield Finding(axes[-1][0], "too_many_axes", joints=len(axes) - 1, allowed=f"{MOST_AXES} in all")
    for where, joint in axes:
        if joint.name == _ALL_JOINTS:
            yield Finding((*where, "name"), "limit_key", found=_ALL_JOINTS, means="all joints")


@rule(ArmFile, "bus")
def _interface(arm: ArmFile) -> Iterator[Finding]:
    name = arm.bus.interface
    if not isinstance(arm.bus, EthercatBus):
        return
    if len(name) > LONGEST_INTERFACE or "/" in name or any(map(str.isspace, name)):
        wanted = f"{VIRTUAL}, or a network interface of at most {LONGEST_INTERFACE} characters without spaces and /"
        yield Finding(("bus", "interface"), "interface", found=name, allowed=wanted)


@rule(ArmFile, "control_mode", "inputs")
def _control_mode(arm: ArmFile) -> Iterator[Finding]:
    joystick = arm.inputs.joystick is not None
    yield from missing_for(arm.control_mode, geometry=arm.kinematics is not None, joystick=joystick)


def missing_for(control_mode: str, *, geometry: bool, joystick: bool) -> Iterator[Finding]:
    """Yield the sections that the arm's file lacks for a control mode."""
    where = ("control_mode",)
    if control_mode in ("cartesian", "joystick") and not geometry:
        yield Finding(where, "needs", found=control_mode, need="the arm's geometry", key="kinematics")
    elif control_mode == "joystick" and not joystick:
        yield Finding(where, "needs", found=control_mode, need="a joystick", key="inputs.joystick")


@rule(ArmFile, "jog", "cartesian")
def _jog_speeds(arm: ArmFile) -> Iterator[Finding]:
    for key in ("speed", "angular_speed"):
        speed, most = getattr(arm.jog, key), getattr(arm.cartesian, key)
        if speed > most:
            yield Finding(("jog", key), "above", found=speed, high=most, of=f"cartesian.{key}")


@rule(ArmFile, "inputs")
def _input_terminals(arm: ArmFile) -> Iterator[Finding]:
    return _repeated_by_box(_inputs(arm), "input")


@rule(ArmFile, "outputs", "gripper")
def _output_terminals(arm: ArmFile) -> Iterator[Finding]:
    return _repeated_by_box(_outputs(arm), "output")


Terminals = Iterator[tuple[KeyPath, HasBox, tuple[Place, ...]]]
"""Sections with terminals on a box: keys of the section, the object with the key `box`, and the terminals."""


def _inputs(arm: ArmFile) -> Terminals:
    if joystick := arm.inputs.joystick:
        places = tuple((("inputs", "joystick", key), getattr(joystick, key)) for key in JOYSTICK_TERMINALS)
        yield ("inputs", "joystick"), joystick, places
    for key in ("arm_toggle", "enabling_switch", "emergency_stop"):
        if terminal := getattr(arm.inputs, key):
            yield ("inputs", key), terminal, ((("inputs", key, "number"), terminal.number),)
    yield from _named("inputs", arm.inputs.named)


def _outputs(arm: ArmFile) -> Terminals:
    lamps = ((("outputs", key), getattr(arm.outputs, key)) for key in ("state_lamp", "motion_lamp", "heartbeat"))
    if places := tuple((where, number) for where, number in lamps if number is not None):
        yield ("outputs",), arm.outputs, places
    if arm.gripper and arm.gripper.output is not None:
        yield ("gripper",), arm.gripper, ((("gripper", "output"), arm.gripper.output),)
    yield from _named("outputs", arm.outputs.named)


def _named(section: str, terminals: Sequence[NamedTerminal]) -> Terminals:
    for i, terminal in enumerate(terminals):
        where = (section, "named", i)
        yield where, terminal, (((*where, "number"), terminal.number),)


@rule(ArmFile, "inputs", "outputs")
def _terminal_names(arm: ArmFile) -> Iterator[Finding]:
    sections = (("inputs", arm.inputs.named), ("outputs", arm.outputs.named))
    names = [((section, "named", i, "name"), item.name) for section, named in sections for i, item in enumerate(named)]
    yield from repeated(names, "name")
    functions = {key.name for kind in (InputsConfig, OutputsConfig) for key in fields(kind)} | set(JOYSTICK_TERMINALS)
    for where, name in names:
        if name in functions or "." in name:
            wanted = "a name without a dot that is not that of a function"
            yield Finding(where, "name_of_function", found=name, allowed=wanted)


def _repeated_by_box(terminals: Terminals, noun: str) -> Iterator[Finding]:
    boxes: dict[str | None, list[Place]] = {}
    users = [(user, places) for _, user, places in terminals]
    named = {user.box for user, _ in users} - {None}
    only = next(iter(named)) if len(named) == 1 else None  # terminals without a box are on the only one
    for user, places in users:
        boxes.setdefault(user.box or only, []).extend(places)
    for of_box in boxes.values():
        yield from repeated(of_box, noun)


def drive_findings(
    arm: ArmFile, devices: Mapping[str, DeviceDescription], unusual: Container[KeyPath]
) -> Iterator[Finding]:
    """Yield the mistakes between joints and the slaves that move them.

    Args:
        arm: the arm's file.
        devices: the valid ones by name.
        unusual: keys whose value is marked as intended.
    """
    slaves = {slave.name: slave for slave in arm.slaves}
    for where, joint in axes_of(arm):
        slave = slaves.get(joint.slave)
        device = devices.get(slave.device) if slave else None
        if slave is None:
            yield Finding((*where, "slave"), "no_slave", found=joint.slave, allowed=[*slaves])
        elif device is not None and device.kind == "io":
            of = {"device": slave.device, "kind": device.kind}
            yield Finding((*where, "slave"), "moves_no_joint", found=joint.slave, **of)
        elif device is not None and joint.axis not in device.axes:
            wanted = f"{' or '.join(map(str, device.axes))}, the axes of {slave.device}"
            yield Finding((*where, "axis"), "axis", found=joint.axis, allowed=wanted)
        elif device is not None:
            device = device.of_axis(joint.axis)
            missing: list[str] = []
            # The scaling of a drive is in rad.
            in_metres = where[0] == "external_axes" and arm.external_axes[int(where[1])].unit == "m"
            if not in_metres and (*where, "velocity") not in unusual:
                yield from _above_the_drive(where, joint, device)
            if where[0] == "external_axes":
                yield from _external_drive(where, arm.external_axes[int(where[1])], slave.device, device)
                continue
            for needed, pdos in zip(MODE_CHANNELS[arm.drive_mode], (device.rpdo, device.tpdo), strict=True):
                mapped = {entry.name for pdo in pdos for entry in pdo.channels}
                missing += [name for name in needed if name not in mapped]
            if missing:
                of = {"device": slave.device, "drive_mode": arm.drive_mode}
                yield Finding((*where, "slave"), "not_mapped", lacking=missing, **of)
            mapped = {entry.name for entry in device.outputs}
            if where[0] == "joints" and (missing := [n for n in arm.feed_forward.channels if n not in mapped]):
                yield Finding((*where, "slave"), "no_offset", lacking=missing, device=slave.device)
            yield from _beyond_the_wire(where, joint, device, arm.feed_forward.channels if where[0] == "joints" else ())


def _above_the_drive(axis: KeyPath, joint: Joint, device: DeviceDescription) -> Iterator[Finding]:
    """Yield a speed limit that the motor cannot reach: it is in another unit, or the gear ratio is wrong."""
    scaling = device.scaling_of(joint.axis)
    if scaling is not None and scaling.max_speed is not None and joint.velocity > scaling.max_speed:
        of = {"device": device.name, "rpm": scaling.max_motor_speed, "high": scaling.max_speed}
        yield Finding((*axis, "velocity"), "above_drive", found=joint.velocity, **of)


_AXIS_CHANNELS: dict[AxisMode, tuple[str, ...]] = {
    "position": ("target_position", "profile_velocity"),
    "velocity": ("target_velocity",),
    "homing": (),
}
"""Channels of rpdo that a mode of an external axis needs, beside `modes_of_operation`."""


def _external_drive(where: KeyPath, axis: ExternalAxis, key: str, device: DeviceDescription) -> Iterator[Finding]:
    """Yield the channels that the drive of an external axis lacks, and limits that its process data cannot express."""
    sent = {entry.name for entry in device.outputs}
    shown = {entry.name for pdo in device.tpdo for entry in pdo.channels}
    needed = [name for mode in axis.modes for name in _AXIS_CHANNELS[mode]]
    missing = [name for name in dict.fromkeys(["modes_of_operation", *needed]) if name not in sent]
    missing += [name for name in ("velocity", "modes_of_operation_display") if name not in shown]
    if device.kind != "cia402":
        of = {"device": key, "kind": device.kind}
        yield Finding((*where, "slave"), "moves_no_joint", found=axis.slave, **of)
    elif missing:
        yield Finding((*where, "slave"), "axis_not_mapped", lacking=missing, device=key, modes=axis.modes)
    else:
        # No target of torque is sent, and an axis without ends has no largest target.
        joint = replace(axis.joint, position=axis.position or Range(0.0, 0.0), torque=0.0)
        yield from _beyond_the_wire(where, joint, device, ())


def terminal_findings(arm: ArmFile, devices: Mapping[str, DeviceDescription]) -> Iterator[Finding]:
    """Yield terminals without an IO box, or with several to choose from, and channels of a stick that no slave sends.

    Args:
        arm: the arm's file.
        devices: the valid ones by name.
    """
    if any(slave.device not in devices for slave in arm.slaves):
        return
    yield from _stick_channels(arm, devices)
    boxes = [slave.name for slave in arm.slaves if devices[slave.device].is_box]
    for kind, terminals in (("input", _inputs(arm)), ("output", _outputs(arm))):
        for where, user, places in terminals:
            if not boxes:
                for place, number in places:
                    yield Finding(place, "no_box_at_all", found=number, kind=kind)
            elif user.box is not None and user.box not in boxes:
                yield Finding((*where, "box"), "no_box", found=user.box, allowed=boxes)
            elif user.box is None and len(boxes) > 1:
                need = f"with several IO boxes it must be one of {', '.join(boxes)}"
                yield Finding(where, "missing", key="box", need=need)


@rule(AnalogStickConfig)
def _analog_stick(stick: AnalogStickConfig) -> Iterator[Finding]:
    """Yield axes without an inclination, or whose cut wire, which reads 0, would be one; and a channel of two axes."""
    for key, axis in (("forward", stick.forward), ("left", stick.left)):
        full, rest = abs(axis.full), abs(axis.neutral)
        if axis.full == 0.0:
            yield Finding((key, "full"), "range", found=0.0, allowed="any other number")
        elif stick.dead_zone * full < rest <= BEYOND_FULL * full:
            yield Finding((key, "neutral"), "cut_wire", found=axis.neutral, low=BEYOND_FULL * full)
    if stick.left.channel == stick.forward.channel:
        yield Finding(("left", "channel"), "repeated", what="channel", found=stick.left.channel, of="forward")


def _stick_channels(arm: ArmFile, devices: Mapping[str, DeviceDescription]) -> Iterator[Finding]:
    """Yield axes of the analog stick whose channel no slave sends."""
    analog = None if arm.inputs.joystick is None else arm.inputs.joystick.analog
    if analog is None:
        return
    sends = {
        f"{slave.name}.{entry.name}"
        for slave in arm.slaves
        if devices[slave.device].has_channels
        for entry in devices[slave.device].inputs
    }
    for key, axis in (("forward", analog.forward), ("left", analog.left)):
        if axis.channel not in sends:
            wanted = f"one of {', '.join(sorted(sends))}" if sends else "a channel of a device of kind analog"
            where = ("inputs", "joystick", "analog", key, "channel")
            yield Finding(where, "channel", found=axis.channel, allowed=wanted)


def _beyond_the_wire(
    axis: KeyPath, joint: Joint, device: DeviceDescription, offsets_used: Sequence[str]
) -> Iterator[Finding]:
    """Yield limits that the drive's process data cannot express: a target near them would wrap around."""
    position, wide = joint.absolute.position or joint.position, joint.absolute
    velocity, torque = wide.velocity or joint.velocity, wide.torque or joint.torque
    offsets = tuple(
        ((key,), (-bound, bound), f"{key}_offset")
        for key, bound in (("velocity", velocity), ("torque", torque))
        if f"{key}_offset" in offsets_used
    )
    limits: tuple[tuple[KeyPath, tuple[float, ...], str], ...] = (
        *offsets,
        (("position", "min"), (position.min,), "target_position"),
        (("position", "max"), (position.max,), "target_position"),
        (("position", "min"), (position.min,), "position"),
        (("position", "max"), (position.max,), "position"),
        (("velocity",), (-velocity, velocity), "target_velocity"),
        (("torque",), (-torque, torque), "target_torque"),
    )
    found: set[KeyPath] = set()
    for where, ends, name in limits:
        widened: KeyPath = ("absolute",) if getattr(wide, str(where[0])) is not None else ()
        low, high = device.wire_range(name)
        if where not in found and not all(low <= end <= high for end in ends):
            found.add(where)
            entry = device.channel(name)
            assert entry is not None
            of = f"{name} of {device.name} is {entry.type} with factor {entry.factor:g}"
            if entry.type.startswith("uint") and min(ends) < 0:
                of += "; if the drive counts below 0 in two's complement, write the signed type"
            sign = "+-" if len(ends) == 2 else ""
            yield Finding(
                (*axis, *widened, *where), "beyond_wire", sign=sign, found=ends[-1], low=low, high=high, of=of
            )


@rule(ArmFile, "rest_pose", "joints")
def _rest_pose(arm: ArmFile) -> Iterator[Finding]:
    pose, joints = arm.rest_pose or (), arm.joints
    if pose and len(pose) != len(joints):
        yield Finding(("rest_pose",), "count", found=len(pose), allowed=len(joints), of="one a joint")
    for i, (q, joint) in enumerate(zip(pose, joints)):  # noqa: B905 the count is checked above
        yield from _within(("rest_pose", i), q, joint.position.min, joint.position.max, f"the position of {joint.name}")


# -- geometry and boxes ------------------------------------------------------------------------------------------------


@rule(ArmFile, "supervision", "joints")
def _torque_supervision(arm: ArmFile) -> Iterator[Finding]:
    """Yield the first threshold of the measured torque that is beyond what the drive of its joint can give."""
    factor, wide = arm.supervision.torque, arm.supervision.absolute.torque
    for i, joint in enumerate(arm.joints):
        most = joint.drive_torque
        if most is None:
            continue
        of = f"the drive of {joint.name} gives at most joints[{i}].drive_torque"
        torque = joint.absolute.torque or joint.torque
        if most <= joint.torque:
            of = f"the torque of {joint.name}: the drive could not hold what the joint may carry"
            yield Finding(("joints", i, "drive_torque"), "not_more", found=most, low=joint.torque, of=of)
        elif joint.torque * factor >= most:
            yield Finding(("supervision", "torque"), "never_trips", found=factor, high=most / joint.torque, of=of)
        elif joint.torque * (wide or factor) >= most:
            yield Finding(
                ("supervision", "absolute", "torque"), "never_trips", found=wide, high=most / joint.torque, of=of
            )
        elif torque * (wide or factor) >= most:
            high = most / (wide or factor)
            yield Finding(("joints", i, "absolute", "torque"), "never_trips", found=torque, high=high, of=of)
        else:
            continue
        return


@rule(ArmFile, "supervision", "joints")
def _absolute(arm: ArmFile) -> Iterator[Finding]:
    """Yield absolute limits that are narrower than the limits themselves."""
    for i, joint in enumerate(arm.joints):
        where, wide = ("joints", i, "absolute"), joint.absolute
        if wide.position is not None:
            low, high, of = joint.position.min, joint.position.max, f"the position of {joint.name}"
            if wide.position.min > low:
                yield Finding((*where, "position", "min"), "above", found=wide.position.min, high=low, of=of)
            if wide.position.max < high:
                yield Finding((*where, "position", "max"), "below", found=wide.position.max, low=high, of=of)
        for key in ("velocity", "torque"):
            yield from _at_least((*where, key), getattr(wide, key), getattr(joint, key), f"the {key} of {joint.name}")
    for key in ("speed", "torque", "following_error"):
        least, most = getattr(arm.supervision, key), getattr(arm.supervision.absolute, key)
        yield from _at_least(("supervision", "absolute", key), most, least, f"supervision.{key}")


def _at_least(where: KeyPath, wide: float | None, least: float, of: str) -> Iterator[Finding]:
    if wide is not None and wide < least:
        yield Finding(where, "below", found=wide, low=least, of=of)


@rule(ArmFile, "kinematics", "joints")
def _joints_of_kinematics(arm: ArmFile) -> Iterator[Finding]:
    part = arm.kinematics
    if part is None:
        return
    if len(arm.joints) != len(part.dh):
        wanted = f"{len(part.dh)}; leave it out for such an arm"
        yield Finding(("kinematics",), "too_many_axes", joints=len(arm.joints), allowed=wanted)
    for i, (joint, limit) in enumerate(zip(arm.joints, part.limits or ())):  # noqa: B905 the count is checked above
        place = f"kinematics.limits[{i}]"
        end = f"the joint's mechanical end in {place}"
        for keys, its in ((("joints", i), joint), (("joints", i, "absolute"), joint.absolute)):
            where = (*keys, "position")
            if its.position is not None and its.position.min < limit.min:
                yield Finding((*where, "min"), "below", found=its.position.min, low=limit.min, of=end)
            if its.position is not None and its.position.max > limit.max:
                yield Finding((*where, "max"), "above", found=its.position.max, high=limit.max, of=end)
            if limit.velocity is not None and (its.velocity or 0.0) > limit.velocity:
                most = {"found": its.velocity, "high": limit.velocity}
                yield Finding((*keys, "velocity"), "above", **most, of=f"the velocity in {place}")


@rule(Kinematics)
def _tools(part: Kinematics) -> Iterator[Finding]:
    tools = part.tools
    if tools and part.tool != Tool():
        yield Finding(("tool",), "tool_and_tools")
    yield from repeated(((("tools", i, "name"), tool.name) for i, tool in enumerate(tools)), "name")
    for i, tool in enumerate(tools):
        if tool.mass and part.links is None:
            yield Finding(("tools", i, "mass"), "mass_without_links", found=tool.mass)
        if part.bodies is not None and tool.bodies is None:
            need = "where the arm's are named, so are the tool's: a list, [] for none"
            yield Finding(("tools", i), "missing", key="bodies", need=need)


@rule(ArmFile, "cartesian", "kinematics")
def _boxes(arm: ArmFile) -> Iterator[Finding]:
    tool, part = arm.cartesian.box, arm.kinematics
    boxes: list[tuple[KeyPath, Box | KeepOut]] = [(("cartesian", "box"), tool)] if tool else []
    boxes += [(("cartesian", "keep_out", i), box) for i, box in enumerate(arm.cartesian.keep_out)]
    for where, box in boxes:
        if part is None:
            yield Finding(where, "box_needs", need="the arm's geometry", key="kinematics")
        elif misplaced := _misplaced(where, box, part):
            yield misplaced
        elif tool and isinstance(box, KeepOut) and _holds(box, tool):
            yield Finding(where, "box_around_box")


@rule(ArmFile, "cartesian", "kinematics")
def _cones(arm: ArmFile) -> Iterator[Finding]:
    for i, cone in enumerate(arm.cartesian.cones):
        if arm.kinematics is None:
            yield Finding(("cartesian", "cones", i), "box_needs", need="the arm's geometry", key="kinematics")
        if not any(cone.direction):
            yield Finding(("cartesian", "cones", i, "direction"), "no_direction")


@rule(ArmFile, "cartesian", "joints", "gripper")
def _box_names(arm: ArmFile) -> Iterator[Finding]:
    """Yield names that make the key of a limit, as joint2.max or user.max.z, ambiguous."""
    cartesian = arm.cartesian
    named: list[tuple[KeyPath, str]] = [
        (("cartesian", "keep_out", i, "name"), box.name) for i, box in enumerate(cartesian.keep_out)
    ]
    named += [(("cartesian", "cones", i, "name"), cone.name) for i, cone in enumerate(cartesian.cones)]
    yield from repeated(named, "name")
    taken = {"box": "cartesian.box", "supervision": "supervision", _ALL_JOINTS: "all joints"}
    taken |= {joint.name: dotted(where) for where, joint in axes_of(arm) if joint.name not in taken}
    for where, name in named:
        if name in taken:
            yield Finding(where, "limit_key", found=name, means=taken[name])
        elif "." in name:
            wanted = "one without a dot: dots separate the parts of a key"
            yield Finding(where, "dot", found=name, allowed=wanted)


def shoulder_and_reach(part: Kinematics) -> tuple[Position, float]:
    """Return the origin of frame 1, m, which no joint moves, and the tool's largest distance from it, m."""
    row = part.dh[0]
    shoulder = (row.a, 0.0 - math.sin(row.alpha) * row.d, math.cos(row.alpha) * row.d)
    longest = max(math.hypot(*tool.position) for tool in part.every_tool)
    return shoulder, sum(math.hypot(row.a, row.d) for row in part.dh[1:]) + longest


def _misplaced(where: KeyPath, box: Box | KeepOut, part: Kinematics) -> Finding | None:
    shoulder, reach = shoulder_and_reach(part)
    nearest = [min(max(c, low), high) for c, low, high in zip(shoulder, box.min, box.max, strict=True)]
    away = math.dist(shoulder, nearest)
    if away > reach:
        reason = "the arm never meets it" if isinstance(box, KeepOut) else "the tool is never inside"
        return Finding(where, "box_out_of_reach", found=away, high=reach, what=reason)
    if isinstance(box, KeepOut) and _meets(_BASE, shoulder, box):
        return Finding(where, "box_around_base", shoulder=[f"{coordinate:g}" for coordinate in shoulder])
    return None


def _meets(start: Position, end: Position, box: KeepOut) -> bool:
    """Return whether the straight line between two points meets a box (slab method)."""
    enter, leave = 0.0, 1.0
    for begin, finish, low, high in zip(start, end, box.min, box.max, strict=True):
        if begin == finish:
            if not low <= begin <= high:
                return False
            continue
        first, last = sorted(((low - begin) / (finish - begin), (high - begin) / (finish - begin)))
        enter, leave = max(enter, first), min(leave, last)
    return enter <= leave


def _holds(outer: KeepOut, inner: Box) -> bool:
    return all(a <= b for a, b in zip((*outer.min, *inner.max), (*inner.min, *outer.max), strict=True))


# -- plausibility ------------------------------------------------------------------------------------------------------

_TWO_TURNS = 4 * math.pi
_DEGREES, _MILLIMETRES, _GRAMS = ("degrees", math.radians(1)), ("millimetres", 1e-3), ("grams", 1e-3)
_MILLI_NM = ("mNm", 1e-3)
_USUAL = {"rad": (_TWO_TURNS, _TWO_TURNS, 200.0, _DEGREES), "m": (20.0, 20.0, 50.0, _MILLIMETRES)}
"""Largest usual position, speed and acceleration of a joint or external axis by its unit, and the likely other unit."""
_MOST_TORQUE, _MOST_RATED_TORQUE = 3000.0, 1000.0
"""Largest usual torque limit of a joint, and rated torque of a drive, Nm."""
Magnitude = tuple[KeyPath, float, float, str, tuple[str, float]]
"""Key, value, largest plausible magnitude, unit, and the likely other unit with its factor."""


def implausible(
    of: Any, magnitudes: Callable[[Any], Iterator[Magnitude]], unusual: Container[KeyPath]
) -> Iterator[Finding]:
    """Yield a finding for each value that is plausible only in another unit, and is not marked as `unusual`."""
    for where, value, most, unit, (likely, factor) in magnitudes(of):
        if abs(value) > most and where not in unusual:
            instead = {"likely": likely, "instead": value * factor}
            yield Finding(where, "implausible", found=value, high=most, unit=unit, **instead)


class HasKinematics(Protocol):
    """An arm's file, or one of kinematics alone."""

    @property
    def kinematics(self) -> Kinematics | None:
        """Its geometry."""


def useless_marks(places: Iterable[Magnitude], unusual: Iterable[KeyPath]) -> Iterator[Finding]:
    """Yield the keys that are marked as unusual and have no limit of what is usual."""
    limited = {where for where, *_ in places}
    yield from (Finding(where, "never_unusual") for where in unusual if where not in limited)


def _of_joints(arm: ArmFile) -> Iterator[Magnitude]:
    external: dict[KeyPath, ExternalAxis] = {("external_axes", i): axis for i, axis in enumerate(arm.external_axes)}
    for where, joint in axes_of(arm):
        axis = external.get(where)
        unit = "rad" if axis is None else axis.unit
        furthest, fastest, hardest, likely = _USUAL[unit]
        if axis is None or axis.position is not None:
            yield (*where, "position", "min"), joint.position.min, furthest, unit, likely
            yield (*where, "position", "max"), joint.position.max, furthest, unit, likely
        yield (*where, "velocity"), joint.velocity, fastest, f"{unit}/s", likely
        yield (*where, "acceleration"), joint.acceleration, hardest, f"{unit}/s^2", likely
        if axis is not None:
            continue
        if joint.torque != UNLIMITED_TORQUE:
            yield (*where, "torque"), joint.torque, _MOST_TORQUE, "Nm", _MILLI_NM
        yield (*where, "drive_torque"), joint.drive_torque or 0.0, _MOST_TORQUE, "Nm", _MILLI_NM


def _of_cartesian(arm: ArmFile) -> Iterator[Magnitude]:
    least = arm.cartesian.singularity
    for key, value, unit, likely in (
        ("shoulder", least.shoulder, "m", _MILLIMETRES),
        ("elbow", least.elbow, "rad", _DEGREES),
        ("wrist", least.wrist, "rad", _DEGREES),
    ):
        yield ("cartesian", "singularity", key), value, 1.0, unit, likely
    yield ("cartesian", "clearance"), arm.cartesian.clearance, 1.0, "m", _MILLIMETRES


def of_kinematics(file: HasKinematics) -> Iterator[Magnitude]:
    """Yield the lengths, angles, speeds and masses of an arm's geometry."""
    part = file.kinematics
    if part is None:
        return
    for i, row in enumerate(part.dh):
        for key in ("a", "d"):
            yield ("kinematics", "dh", i, key), getattr(row, key), 5.0, "m", _MILLIMETRES
    for i, limit in enumerate(part.limits or ()):
        for key in ("min", "max"):
            yield ("kinematics", "limits", i, key), getattr(limit, key), _TWO_TURNS, "rad", _DEGREES
        yield ("kinematics", "limits", i, "velocity"), limit.velocity or 0.0, _TWO_TURNS, "rad/s", _DEGREES
    for i, link in enumerate(part.links or ()):
        yield ("kinematics", "links", i, "mass"), link.mass, 200.0, "kg", _GRAMS
        yield ("kinematics", "links", i, "centre"), max(map(abs, link.centre)), 5.0, "m", _MILLIMETRES
    yield ("kinematics", "tool", "position"), max(map(abs, part.tool.position)), 5.0, "m", _MILLIMETRES
    for i, tool in enumerate(part.tools):
        yield ("kinematics", "tools", i, "mass"), tool.mass, 200.0, "kg", _GRAMS
        for key in ("position", "centre"):
            yield ("kinematics", "tools", i, key), max(map(abs, getattr(tool, key))), 5.0, "m", _MILLIMETRES
    for i, body in enumerate(part.bodies or ()):
        for key in ("start", "end"):
            yield ("kinematics", "bodies", i, key), max(map(abs, getattr(body, key))), 5.0, "m", _MILLIMETRES
        yield ("kinematics", "bodies", i, "radius"), body.radius, 1.0, "m", _MILLIMETRES


def of_scaling(device: DeviceDescription) -> Iterator[Magnitude]:
    """Yield the torques and currents of a drive."""
    for i, scaling in enumerate(device.scaling):
        where = ("scaling", i)
        yield (*where, "rated_torque"), scaling.rated_torque or 0.0, _MOST_RATED_TORQUE, "Nm", _MILLI_NM
        yield (*where, "rated_current"), scaling.rated_current or 0.0, 500.0, "A", ("milliamperes", 1e-3)
        yield (*where, "torque_constant"), scaling.torque_constant or 0.0, 50.0, "Nm/A", ("mNm/A", 1e-3)


OF_ARM: dict[tuple[str, ...], Callable[[Any], Iterator[Magnitude]]] = {
    ("joints", "gripper", "external_axes"): _of_joints, ("cartesian",): _of_cartesian, ("kinematics",): of_kinematics,
}  # fmt: skip
"""Values of an arm's file that have a limit of what is usual, by the sections that hold them."""


# -- motion files ------------------------------------------------------------------------------------------------------


@rule(Point)
def _point(point: Point) -> Iterator[Finding]:
    if point.a is not None and point.v is None:
        yield Finding(("a",), "needs_beside", found="a", need="v")


@rule(Stop)
def _stop(stop: Stop) -> Iterator[Finding]:
    if (stop.pose is None) == (stop.q is None):
        yield _pose_or_q(stop)
    if stop.angle is not None and stop.via is None:
        yield Finding(("angle",), "needs_beside", found="an angle", need="via")
    if stop.by_joints and stop.via is not None:
        yield Finding(("by_joints",), "via_beside")


@rule(NamedPose)
def _named_pose(pose: NamedPose) -> Iterator[Finding]:
    if (pose.pose is None) == (pose.q is None):
        yield _pose_or_q(pose)


def _pose_or_q(entry: Stop | NamedPose) -> Finding:
    return Finding((), "pose_or_q", found="neither" if entry.pose is None else "both")


MOST_PLANNED_STEPS = 10_000
"""Most steps of a program, with those of its parts."""
_MOST_DEPTH = 50
"""Most levels of parts in parts."""
_VERBS = ("move", "line", "arc", "gripper", "axis", "output", "wait_for", "wait_s", "tool", "run")
_OF_VERBS = {
    "via": ("arc",),
    "angle": ("arc",),
    "speed": ("move", "line", "arc", "axis"),
    "position": ("axis",),
    "velocity": ("axis",),
    "time_s": ("axis",),
    "home": ("axis",),
    "blend": ("move", "line", "arc"),
    "value": ("output", "wait_for"),
    "timeout_s": ("wait_for",),
    "times": ("run",),
}
"""Key of a step -> keys, one of which it needs beside it."""


@rule(Step)
def _step(step: Step) -> Iterator[Finding]:
    chosen = [verb for verb in _VERBS if getattr(step, verb) is not None]
    if len(chosen) != 1:
        yield Finding((), "one_of_keys", found=" and ".join(chosen) or "none of them", allowed=_VERBS)
        return
    for key, verbs in _OF_VERBS.items():
        default = next(field.default for field in fields(Step) if field.name == key)
        if getattr(step, key) != default and chosen[0] not in verbs:
            yield Finding((key,), "beside", found=chosen[0], allowed=" or ".join(verbs))
    if step.arc is not None and step.via is None:
        yield Finding(("arc",), "needs_beside", found="an arc", need="via")
    if step.axis is not None:
        yield from _axis_step(step)


def _axis_step(step: Step) -> Iterator[Finding]:
    what = [key for key in ("position", "velocity", "home") if getattr(step, key) not in (None, False)]
    if len(what) != 1:
        yield Finding((), "one_of_keys", found=" and ".join(what) or "none of them", allowed="position, velocity, home")
    elif step.speed is not None and step.position is None:
        yield Finding(("speed",), "beside", found=what[0], allowed="position")
    elif step.time_s is not None and not step.velocity:
        yield Finding(("time_s",), "beside", found=what[0], allowed="a velocity other than 0")
    elif step.velocity and step.time_s is None:
        yield Finding(("velocity",), "needs_beside", found="a velocity other than 0", need="time_s")


@rule(MotionFile, "poses", "program", "parts")
def _program(motion: MotionFile) -> Iterator[Finding]:
    poses, parts = [pose.name for pose in motion.poses], [part.name for part in motion.parts]
    for key, names in (("poses", poses), ("parts", parts)):
        for at, name in enumerate(names):
            if name in names[:at]:
                yield Finding((key, at, "name"), "name_twice", found=name)
    lists: list[tuple[tuple[str | int, ...], tuple[Step, ...]]] = [(("program",), motion.program)]
    lists += [(("parts", at, "steps"), part.steps) for at, part in enumerate(motion.parts)]
    for where, steps in lists:
        for at, step in enumerate(steps):
            for key in ("move", "line", "arc", "via", "run"):
                name, allowed = getattr(step, key), parts if key == "run" else poses
                if name is not None and name not in allowed:
                    yield Finding((*where, at, key), "no_name", found=name, allowed=allowed or "none")
    if any(step.tool is not None for _, steps in lists for step in steps):
        places = {pose.name for pose in motion.poses if pose.pose is None}
        for where, steps in lists:
            for at, step in enumerate(steps):
                if step.via in places:
                    yield Finding((*where, at, "via"), "via_has_q", found=step.via)
    calls = {part.name: {step.run for step in part.steps if step.run is not None} for part in motion.parts}
    circles = [at for at, name in enumerate(parts) if name in _reached(calls, name)]
    for at in circles:
        yield Finding(("parts", at, "steps"), "circle", found=parts[at])
    if circles:
        return
    by_name = {part.name: part.steps for part in motion.parts}
    if (count := _planned_steps(motion.program, by_name)) > MOST_PLANNED_STEPS:
        number = "endless" if count == math.inf else f"{count:g}"
        yield Finding(("program",), "too_many_steps", found=number, allowed=MOST_PLANNED_STEPS)
        return
    if any(step.tool is not None for _, steps in lists for step in steps):
        first = next(_tools_and_motions(motion.program, by_name, len(parts)), None)
        if first is not None and first.tool is None:
            yield Finding(("program",), "motion_before_tool")


def _reached(calls: Mapping[str, set[str]], name: str) -> set[str]:
    """Return the parts that a part runs, directly or by others."""
    reached, ahead = set[str](), set(calls[name])
    while ahead:
        part = ahead.pop()
        if part not in reached:
            reached.add(part)
            ahead |= calls.get(part, set())
    return reached


def _planned_steps(program: Sequence[Step], parts: Mapping[str, tuple[Step, ...]]) -> float:
    """Return the number of planned steps: a repeated part counts twice; infinite: parts are nested too deep."""
    counts: dict[str, float] = {}

    def count(steps: Sequence[Step], depth: int) -> float:
        if depth > _MOST_DEPTH:
            return math.inf
        total = 0.0
        for step in steps:
            if step.run is None:
                total += 1
                continue
            if step.run not in counts:
                counts[step.run] = count(parts.get(step.run, ()), depth + 1)
            total += counts[step.run] * (1 if step.times == 1 else 2)
        return total

    return count(program, 0)


def _tools_and_motions(steps: Sequence[Step], parts: Mapping[str, tuple[Step, ...]], depth: int) -> Iterator[Step]:
    """Yield in their order the steps that move or choose a tool, also of parts; `depth`: most levels of parts."""
    for step in steps:
        if step.run is not None and depth > 0:
            yield from _tools_and_motions(parts.get(step.run, ()), parts, depth - 1)
        elif step.tool is not None or step.move or step.line or step.arc:
            yield step


@rule(MotionFile, EVERY_KEY)
def _one_form(motion: MotionFile) -> Iterator[Finding]:
    forms = [key for key in ("trajectory", "path", "program") if getattr(motion, key)]
    if not (forms or motion.poses):
        yield Finding((), "no_motion")
    if len(forms) > 1:
        yield Finding((forms[1],), "several_motions", found=" and ".join(forms))
    if motion.parts and not motion.program:
        yield Finding(("parts",), "parts_alone")
    if motion.poses and (motion.trajectory or motion.path):
        yield Finding(("poses",), "poses_beside")
    if motion.trajectory and motion.speed is not None:
        yield Finding(("speed",), "speed_of_trajectory")


@rule(MotionFile, "trajectory")
def _points(motion: MotionFile) -> Iterator[Finding]:
    points = motion.trajectory
    for i, point in enumerate(points):
        where, first, before = ("trajectory", i), points[0], points[max(i - 1, 0)]
        if i and not point.t > before.t:
            yield Finding((*where, "t"), "times_fall", found=point.t, before=before.t)
        for key in ("q", "v", "a"):
            numbers, as_first = getattr(point, key), getattr(first, key)
            if numbers is not None and len(numbers) != len(first.q):
                count = {"found": len(numbers), "allowed": len(first.q), "of": "as the first point has"}
                yield Finding((*where, key), "count", **count)
            if (numbers is None) != (as_first is None):
                yield Finding((*where, key), "all_or_none", key=key)
