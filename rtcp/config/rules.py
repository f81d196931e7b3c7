"""Rules between the values of a file and between files: what no single type can state.

A rule yields findings: the key path below its object and the rest of the sentence. See `validation.rule` for when it
runs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields

from rtcp.config.document import Finding, KeyPath, dotted
from rtcp.config.find import registered
from rtcp.config.model import (
    BITS,
    MODE_CHANNELS,
    MOST_AXES,
    PLATFORM_PARTS,
    VIRTUAL,
    ArmConfig,
    ArmFile,
    Box,
    DeviceDescription,
    EthercatBus,
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
    integer_range,
)
from rtcp.config.scaling import BOUNDING_OBJECTS, FACTOR_TOLERANCE, OBJECTS_PER_AXIS, QUANTITIES, DriveScaling
from rtcp.config.validation import EVERY_KEY, rule

_NUMERIC = tuple(name for name in BITS if name != "bool")
_INTEGERS = tuple(name for name in _NUMERIC if "int" in name)
_LONGEST = {"bits": 64, "bytes": 248}
"""Bits of a channel at most; an entry's length is one byte (ETG.1000.6, 5.6.5)."""

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
"""Channels that only some modes of a drive need (`MODE_CHANNELS`, `_drive_mode`), and only some boxes have."""
OTHER_PDOS = {"rpdo": ("tpdo", 0x1A00, 0x1BFF), "tpdo": ("rpdo", 0x1600, 0x17FF)}
"""The other direction and its objects (ETG.1000.6); devices have PDOs outside both ranges too."""
_OF_OUTPUTS: tuple[str, ...] = ("min", "max", "safe")
_OF_INPUTS: tuple[str, ...] = ("modulo",)
_ALL = (*_OF_OUTPUTS, *_OF_INPUTS, "offset")
"""Keys of a channel that have a meaning in one direction, and all that a channel with a fixed meaning has not."""
MODES_OF_OPERATION, CSP = 0x6060, 8
"""Object of the drive mode and its value for cyclic synchronous position (CiA 402-2, clause 10.1)."""
JOYSTICK_TERMINALS = ("forward", "backward", "left", "right", "mode_up", "mode_down")
LONGEST_INTERFACE = 15
"""Characters of a network interface's name (IFNAMSIZ less the closing zero)."""

_ALL_JOINTS = "joints"
_BASE = (0.0, 0.0, 0.0)

Position = tuple[float, float, float]
Place = tuple[KeyPath, object]
"""Where a value is, and the value."""


def _repeated(places: Iterable[Place], what: str) -> Iterator[Finding]:
    first: dict[object, KeyPath] = {}
    for where, value in places:
        if (before := first.setdefault(value, where)) != where:
            found = f'the text "{value}"' if isinstance(value, str) else f"{value}"
            yield where, f"found {found}, the {what} of {dotted(before)}; each needs its own"


def _min_below_max(low: float, high: float) -> str:
    return "" if low < high else f"found min {low:g} and max {high:g}; min must be less than max"


# -- devices -----------------------------------------------------------------------------------------------------------


@rule(PdoEntry)
def _entry(entry: PdoEntry) -> Iterator[Finding]:
    if entry.index and entry.factor == 0:
        yield ("factor",), "found 0, allowed is any number but 0"
    if entry.min is not None and entry.max is not None and (text := _min_below_max(entry.min, entry.max)):
        yield (), text
    elif entry.factor and entry.is_number and entry.length and not entry.range[0] <= entry.safe <= entry.range[1]:
        low, high = entry.range
        yield ("safe",), f"found {entry.safe:g}, allowed is {low:g} to {high:g}, the range of the channel"
    if entry.type == "bool" and entry.index and (entry.factor, entry.offset) != (1.0, 0.0):
        key = "factor" if entry.factor != 1 else "offset"
        yield (key,), f"found {getattr(entry, key):g} with the type bool, allowed is none: it is 0 or 1; leave it out"
    if entry.modulo and not ("int" in entry.type or entry.type == "bits"):
        yield ("modulo",), f"found {entry.modulo} with the type {entry.type}, allowed is an integer type"
    if entry.index and entry.name == PdoEntry.name:
        yield (), f"the key name is missing; it must be a text of 1 to 64 characters other than {PdoEntry.name}"
    longest = _LONGEST.get(entry.type)
    if longest is None:
        if entry.bits is not None:
            text = f"found {entry.bits}, but the type {entry.type} has {BITS[entry.type]} bits; leave it out"
            yield ("bits",), f"{text}, or write the type bits or bytes"
    elif entry.bits is None:
        yield (), f"the key bits is missing; the type {entry.type} needs a length of 1 to {longest}"
    elif entry.type == "bytes" and (entry.bits % 8 or entry.bits > longest):
        yield ("bits",), f"found {entry.bits}, allowed is a multiple of 8 from 8 to {longest} for the type bytes"
    elif entry.index and entry.bits > longest:
        yield ("bits",), f"found {entry.bits}, allowed is 1 to {longest} for a channel of the type {entry.type}"


@rule(StartupSdo)
def _startup_value(sdo: StartupSdo) -> Iterator[Finding]:
    if sdo.type == "bytes":
        if not re.fullmatch(r"([0-9a-fA-F]{2} ?)+", sdo.data):
            text = f'found the text "{sdo.data}"' if sdo.data else "the key is missing"
            yield ("data",), f'{text}, allowed are bytes in hexadecimal, as "54 41 4E 4B", for the type bytes'
        if sdo.value is not None:
            yield ("value",), f"found {sdo.value:g}, allowed is the key data for the type bytes"
        if sdo.complete and sdo.sub_index > 1:
            yield ("sub_index",), f"found {sdo.sub_index}, allowed is 0 or 1 with complete access"
        return
    for key in ("data", "complete"):
        if getattr(sdo, key):
            yield (key,), f"found with the type {sdo.type}, allowed is the type bytes"
    if sdo.value is None:
        yield (), f"the key value is missing; the type {sdo.type} needs it"
    if sdo.value is None or sdo.type.startswith("float"):
        return
    low, high = integer_range(sdo.type)
    if not low <= sdo.value <= high or sdo.value != int(sdo.value):
        yield ("value",), f"found {sdo.value:g}, allowed is an integer from {low} to {high}, the range of {sdo.type}"


@rule(DeviceDescription, "kind")
def _kind(device: DeviceDescription) -> Iterator[Finding]:
    # By name alone: a driver is loaded by the loop, which stands above the configuration.
    kinds = sorted(registered("rtcp.devices"))
    if device.kind not in kinds:
        yield ("kind",), f'found the text "{device.kind}", allowed is one of {", ".join(kinds)}'


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
                text = f'found the text "{entry.name}", an output\'s name too; each channel of the device needs its own'
                yield ("tpdo", i, "channels", j, "name"), text


@rule(DeviceDescription, "assign_activate")
def _dc_word(device: DeviceDescription) -> Iterator[Finding]:
    word = device.assign_activate
    if word and word & 0x0300 != 0x0300:
        wanted = "0 for no distributed clocks, or a word that activates SYNC0, as 0x0300 or 0x0700"
        yield ("assign_activate",), f"found {word:#06x}, allowed is {wanted}"


@rule(DeviceDescription, "sync0_factor", "sync0_cycle_us")
def _sync0_cycle(device: DeviceDescription) -> Iterator[Finding]:
    if device.sync0_factor == 0 and device.sync0_cycle_us == 0:
        yield ("sync0_cycle_us",), "found 0, allowed is a cycle above 0 us where sync0_factor is 0"


@rule(DeviceDescription, "coe", "sdo")
def _without_coe(device: DeviceDescription) -> Iterator[Finding]:
    if device.sdo and not device.coe:
        yield ("sdo",), f"found {len(device.sdo)} entries, but the device has no CoE (coe: false); leave them out"


@rule(DeviceDescription, "rpdo", "tpdo")
def _sync_managers(device: DeviceDescription) -> Iterator[Finding]:
    used: dict[int | None, str] = {}
    for direction, pdos in (("rpdo", device.rpdo), ("tpdo", device.tpdo)):
        for i, pdo in enumerate(pdos):
            where = (direction, i, "sync_manager")
            if (pdo.sync_manager is None) != (pdos[0].sync_manager is None):
                yield where, f"found it in some PDOs of the {direction} only; give it for all of them, or for none"
            elif pdo.sync_manager is not None and used.setdefault(pdo.sync_manager, direction) != direction:
                yield where, f"found {pdo.sync_manager}, a sync manager of the rpdo; each carries one direction"


@rule(DeviceDescription, "rpdo", "tpdo", "sdo", "kind")
def _drive_mode(device: DeviceDescription) -> Iterator[Finding]:
    """A drive whose PDOs have no mode of operation stays in the one that a start-up SDO sets."""
    if device.kind != "cia402":
        return
    for axis in device.axes:
        of = "" if device.axes == (1,) else f" of axis {axis}"
        channels = device.of_axis(axis)
        sent, shown = (
            {entry.name for pdo in pdos for entry in pdo.channels if entry.index}
            for pdos in (channels.rpdo, channels.tpdo)
        )
        index = MODES_OF_OPERATION + (axis - 1) * OBJECTS_PER_AXIS
        if len(device.axes) > 1 and not (sent and shown):
            yield ("tpdo" if sent else "rpdo",), f"found no channels{of}; an axis needs some in both directions"
        elif "modes_of_operation" not in sent and device.startup(MODES_OF_OPERATION, axis) != CSP:
            text = f"found no channel named modes_of_operation{of}; without it the start-up SDO "
            yield ("rpdo",), f"{text}{{index: {index:#x}, sub_index: 0, type: int8, value: {CSP}}} (CSP) must be in sdo"
        elif "modes_of_operation" in sent and "modes_of_operation_display" not in shown:
            text = f"found no channel named modes_of_operation_display{of} beside modes_of_operation in rpdo; "
            yield ("tpdo",), f"{text}allowed are both, or neither: else it is unknown in which mode the drive is"


@rule(DeviceDescription, "rpdo", "tpdo", "scaling", "kind")
def _scaling(device: DeviceDescription) -> Iterator[Finding]:
    scaling, axes = device.scaling, device.axes
    if scaling and device.kind != "cia402":
        yield ("scaling",), f"found with kind {device.kind}, allowed is kind cia402"
    elif len(scaling) > 1 and len(scaling) != axes[-1]:
        text = f"found a list of {len(scaling)}, allowed is one for all axes, or one for each of {axes[-1]}"
        yield ("scaling",), text
    if axes != tuple(range(1, len(axes) + 1)):
        yield (), f"found channels of axis {' and '.join(map(str, axes))}; axes are counted from 1, without a gap"
    elif len(axes) > 1 and device.kind in CHANNELS and device.kind != "cia402":
        yield (), f"found channels of {len(axes)} axes, allowed is kind cia402 for a device with several"


@rule(DeviceDescription, "rpdo", "tpdo", "kind")
def _drive_channels(device: DeviceDescription) -> Iterator[Finding]:
    """What would turn a joint another way than its position shows, or leave an enabled drive without torque."""
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
        if bound is not None and where[0] == "rpdo" and entry.safe == 0:
            text = (
                f"found 0 for {entry.name} ({bound}), which the drive is always sent: enabled it would have no torque, "
            )
            yield (*where, "safe"), f"{text}or no motion; allowed is any other value"
        quantity = QUANTITIES.get(entry.name)
        if quantity is None or axis not in positions:
            continue
        of, first = positions[axis]
        said = f"found {entry.factor:.10g} for {entry.name}, and {first.factor:.10g} for {first.name} ({dotted(of)})"
        if quantity == "position" and not math.isclose(entry.factor, first.factor, rel_tol=FACTOR_TOLERANCE):
            yield (*where, "factor"), f"{said}; all positions of an axis have the same factor"
        elif (entry.factor < 0) != (first.factor < 0):
            yield (*where, "factor"), f"{said}; all factors of an axis have the same sign"


@rule(DriveScaling)
def _of_drive(scaling: DriveScaling) -> Iterator[Finding]:
    if scaling.external_gear_ratio == 0:
        yield ("external_gear_ratio",), "found 0, allowed is any number but 0"
    if (scaling.rated_current is None) != (scaling.torque_constant is None):
        key = "torque_constant" if scaling.torque_constant is None else "rated_current"
        yield (), f"the key {key} is missing: rated_current and torque_constant belong together"
    if scaling.rated_torque is not None and scaling.rated_current is not None:
        yield ("rated_torque",), "found beside rated_current, allowed is one of them: what torques are thousandths of"


def _pdos(direction: str, pdos: Sequence[Pdo], device: DeviceDescription) -> Iterator[Finding]:
    kind = device.kind
    other, low, high = OTHER_PDOS[direction]
    first: dict[int, int] = {}
    axes: dict[int, dict[str, tuple[KeyPath, PdoEntry]]] = {}
    for i, pdo in enumerate(pdos):
        # Some devices with a fixed mapping call their inputs RxPDOs.
        if low <= pdo.index <= high and device.configurable_pdos:
            text = f"found {pdo.index:#06x}, one of the objects of a {other} ({low:#x} to {high:#x})"
            yield (direction, i, "index"), f"{text}; allowed is one of a {direction}"
        elif first.setdefault(pdo.index, i) != i:
            text = f"found {pdo.index:#06x}, the index of {direction}[{first[pdo.index]}]; each needs its own"
            yield (direction, i, "index"), text
        for j, entry in enumerate(pdo.channels):
            where = (direction, i, "channels", j)
            names = axes.setdefault(pdo.axis_of(entry), {}) if entry.index else {}
            if entry.index and names.setdefault(entry.name, (where, entry))[1] is not entry:
                text = f'found the text "{entry.name}" again; each channel of the {direction} needs its own'
                yield (*where, "name"), text
    needed = CHANNELS.get(kind, {}).get(direction, {})
    if kind == "coupler" and pdos:
        yield (direction,), "found PDOs; a coupler has no process data: leave it out"
    for i, pdo in enumerate(pdos):
        for j, entry in enumerate(pdo.channels):
            unused = _OF_OUTPUTS if direction == "tpdo" else _OF_INPUTS
            if kind == "io" or (kind == "cia402" and entry.name in needed):
                unused = (*_OF_OUTPUTS, *_OF_INPUTS, "offset")
            for key in unused:
                if getattr(entry, key) != getattr(PdoEntry, key):
                    text = (
                        f"found with {entry.name} in {direction} of kind {kind}, where it has no meaning; leave it out"
                    )
                    yield (direction, i, "channels", j, key), text
    for axis, names in (axes or {1: {}}).items():
        if missing := [name for name in needed if name not in names and name not in OPTIONAL]:
            there = f"its channels are {', '.join(names)}" if names else "it has no channels"
            those = f"{'a channel' if len(missing) == 1 else 'channels'} named {', '.join(missing)}"
            of = f" of axis {axis}" if len(axes) > 1 else ""
            yield (direction,), f"kind {kind} needs {those}{of}; {there}"
        for name in needed.keys() & names.keys():
            place, entry = names[name]
            if entry.type not in needed[name]:
                wanted = "any type but bool" if needed[name] is _NUMERIC else " or ".join(needed[name])
                yield (*place, "type"), f"found {entry.type} for {name}, allowed is {wanted}"


def period_findings(device: DeviceDescription, period_us: float) -> Iterator[Finding]:
    """Yield the mistakes of a device under a cycle period, us."""
    cycles = f"the cycle period is {period_us:g} us"
    shortest, watchdog = 2 * period_us / 1000, device.watchdog_ms
    # A drive keeps its last target until the watchdog expires: 100 ms is the ESC's default, 10 cycles for slower buses.
    longest = max(100.0, 10 * period_us / 1000) if device.kind == "cia402" else math.inf
    if watchdog <= shortest:
        wanted = f"more than 2 cycles, {shortest:g} ms ({cycles}): one late frame must not trip it"
        yield ("watchdog_ms",), f"found {watchdog:g} ms, allowed is {wanted}"
    elif watchdog > longest:
        wanted = f"at most {longest:g} ms ({cycles}): until it expires the drive keeps its last target"
        yield ("watchdog_ms",), f"found {watchdog:g} ms, allowed is {wanted}"
    if abs(device.sync0_shift_us) >= period_us:
        wanted = f"less than one cycle in either direction ({cycles})"
        yield ("sync0_shift_us",), f"found {device.sync0_shift_us:g} us, allowed is {wanted}"


# -- the arm -----------------------------------------------------------------------------------------------------------


@rule(Range)
@rule(MechanicalLimit)
def _range(limits: Range | MechanicalLimit) -> Iterator[Finding]:
    if text := _min_below_max(limits.min, limits.max):
        yield (), text


@rule(Box)
@rule(KeepOut)
def _corners(box: Box | KeepOut) -> Iterator[Finding]:
    for axis, low, high in zip("xyz", box.min, box.max, strict=True):
        if text := _min_below_max(low, high):
            yield (), text.replace(";", f" in {axis};")


@rule(GripperConfig)
def _gripper(gripper: GripperConfig) -> Iterator[Finding]:
    joint = gripper.joint
    ends = (("open_position", gripper.open_position), ("closed_position", gripper.closed_position))
    if (gripper.output is None) == (joint is None):
        found = "neither output nor joint" if joint is None else "both output and joint"
        yield (), f"found {found}, allowed is one of them: a digital output, or a drive of its own"
        return
    if joint is None:
        for key, end in ends:
            if end is not None:
                yield (key,), "this key belongs to a gripper with a joint, not to one on an output"
        return
    if gripper.closed is not None:
        yield ("closed",), "this key belongs to a gripper on an output, not to one with a joint"
    low, high = joint.position.min, joint.position.max
    for key, end in ends:
        if end is None:
            yield (), f"the key {key} is missing; it must be a number inside gripper.joint.position"
        elif not low <= end <= high:
            yield (key,), f"found {end:g}, allowed is {low:g} to {high:g}, gripper.joint.position"
    if gripper.closed_position is not None and gripper.closed_position == gripper.open_position:
        yield ("closed_position",), f"found {gripper.closed_position:g}, the open_position; the two must differ"


def axes_of(arm: ArmFile | ArmConfig) -> Iterator[tuple[KeyPath, Joint]]:
    """Yield everything that drives move with its place: the joints, then the gripper's joint where it has one."""
    yield from ((("joints", i), joint) for i, joint in enumerate(arm.joints))
    if arm.gripper and arm.gripper.joint:
        yield ("gripper", "joint"), arm.gripper.joint


@rule(ArmFile, "slaves")
def _slave_names(arm: ArmFile) -> Iterator[Finding]:
    yield from _repeated(((("slaves", i, "name"), slave.name) for i, slave in enumerate(arm.slaves)), "name")
    aliases = ((("slaves", i, "alias"), slave.alias) for i, slave in enumerate(arm.slaves) if slave.alias)
    yield from _repeated(aliases, "alias")
    for i, slave in enumerate(arm.slaves):
        if slave.name in PLATFORM_PARTS:
            yield ("slaves", i, "name"), f'found the text "{slave.name}", the name of a part of the platform'


@rule(ArmFile, "joints", "gripper")
def _axis_names(arm: ArmFile) -> Iterator[Finding]:
    axes = list(axes_of(arm))
    yield from _repeated((((*where, "name"), joint.name) for where, joint in axes), "name")
    yield from _repeated((((*where, "slave"), joint.place) for where, joint in axes), "slave")
    if len(axes) > MOST_AXES:
        yield ("gripper", "joint"), f"found beside {len(axes) - 1} joints, allowed are {MOST_AXES} in all"
    for where, joint in axes:
        if joint.name == _ALL_JOINTS:
            yield (*where, "name"), f'found the text "{_ALL_JOINTS}", which in the key of a limit means all joints'


@rule(ArmFile, "bus")
def _interface(arm: ArmFile) -> Iterator[Finding]:
    name = arm.bus.interface
    if not isinstance(arm.bus, EthercatBus):
        return
    if len(name) > LONGEST_INTERFACE or "/" in name or any(map(str.isspace, name)):
        wanted = f"{VIRTUAL}, or a network interface of at most {LONGEST_INTERFACE} characters without spaces and /"
        yield ("bus", "interface"), f'found the text "{name}", allowed is {wanted}'


@rule(ArmFile, "control_mode", "inputs")
def _control_mode(arm: ArmFile) -> Iterator[Finding]:
    joystick = arm.inputs.joystick is not None
    if text := missing_for(arm.control_mode, geometry=arm.kinematics is not None, joystick=joystick):
        yield ("control_mode",), text


def missing_for(control_mode: str, *, geometry: bool, joystick: bool) -> str:
    """Return the sentence for a control mode whose needs the arm does not meet; empty where it does."""
    if control_mode in ("cartesian", "joystick") and not geometry:
        return f'found the text "{control_mode}", which needs the arm\'s geometry: the key kinematics is missing'
    if control_mode == "joystick" and not joystick:
        return f'found the text "{control_mode}", which needs a joystick: the key inputs.joystick is missing'
    return ""


@rule(ArmFile, "jog", "cartesian")
def _jog_speeds(arm: ArmFile) -> Iterator[Finding]:
    for key in ("speed", "angular_speed"):
        speed, most = getattr(arm.jog, key), getattr(arm.cartesian, key)
        if speed > most:
            yield ("jog", key), f"this is {speed:g}, allowed is at most {most:g}, cartesian.{key}"


@rule(ArmFile, "inputs")
def _input_terminals(arm: ArmFile) -> Iterator[Finding]:
    return _repeated_by_box(_inputs(arm), "input")


@rule(ArmFile, "outputs", "gripper")
def _output_terminals(arm: ArmFile) -> Iterator[Finding]:
    return _repeated_by_box(_outputs(arm), "output")


Terminals = Iterator[tuple[KeyPath, HasBox, tuple[Place, ...]]]
"""What hangs on a box: its section, its key `box`, and its terminals."""


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
    if found := tuple((where, number) for where, number in lamps if number is not None):
        yield ("outputs",), arm.outputs, found
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
    names = [((section, "named", i, "name"), one.name) for section, named in sections for i, one in enumerate(named)]
    yield from _repeated(names, "name")
    functions = {one.name for kind in (InputsConfig, OutputsConfig) for one in fields(kind)} | set(JOYSTICK_TERMINALS)
    for where, name in names:
        if name in functions or "." in name:
            yield where, f'found the text "{name}", allowed is a name without a dot that is not that of a function'


def _repeated_by_box(terminals: Terminals, what: str) -> Iterator[Finding]:
    boxes: dict[str | None, list[Place]] = {}
    users = [(user, places) for _, user, places in terminals]
    named = {user.box for user, _ in users} - {None}
    only = next(iter(named)) if len(named) == 1 else None  # what names no box hangs on the only one
    for user, places in users:
        boxes.setdefault(user.box or only, []).extend(places)
    for of_box in boxes.values():
        yield from _repeated(of_box, what)


def drive_findings(arm: ArmFile, devices: Mapping[str, DeviceDescription]) -> Iterator[Finding]:
    """Yield the mistakes between joints and the slaves that move them; `devices`: the valid ones by name."""
    slaves = {slave.name: slave for slave in arm.slaves}
    for where, joint in axes_of(arm):
        slave = slaves.get(joint.slave)
        device = devices.get(slave.device) if slave else None
        if slave is None:
            text = f'found the text "{joint.slave}", which is no slave; allowed are the names under slaves: '
            yield (*where, "slave"), text + ", ".join(slaves)
        elif device is not None and device.kind == "io":
            text = f'found the text "{joint.slave}", which moves no joint: its device {slave.device} is of kind '
            yield (*where, "slave"), f"{text}{device.kind}; allowed is kind cia402"
        elif device is not None and joint.axis not in device.axes:
            text = f"found {joint.axis}, allowed is {' or '.join(map(str, device.axes))}, the axes of {slave.device}"
            yield (*where, "axis"), text
        elif device is not None:
            device = device.of_axis(joint.axis)
            missing: list[str] = []
            for needed, pdos in zip(MODE_CHANNELS[arm.drive_mode], (device.rpdo, device.tpdo), strict=True):
                mapped = {entry.name for pdo in pdos for entry in pdo.channels}
                missing += [name for name in needed if name not in mapped]
            if missing:
                text = (
                    f"its device {slave.device} maps no {', '.join(missing)}, which drive_mode {arm.drive_mode} needs"
                )
                yield (*where, "slave"), text
            yield from _beyond_the_wire(where, joint, device)


def terminal_findings(arm: ArmFile, devices: Mapping[str, DeviceDescription]) -> Iterator[Finding]:
    """Yield terminals without an IO box, or without a word on which one; `devices`: the valid ones by name."""
    found = [devices.get(slave.device) for slave in arm.slaves]
    if None in found:
        return
    boxes = [slave.name for slave in arm.slaves if devices[slave.device].is_box]
    for kind, terminals in (("input", _inputs(arm)), ("output", _outputs(arm))):
        for where, user, places in terminals:
            if not boxes:
                for place, number in places:
                    yield place, f"found {kind} {number}, but no slave is of kind io; leave it out for such an arm"
            elif user.box is not None and user.box not in boxes:
                allowed = ", ".join(boxes) or "none: no slave is of kind io"
                yield (*where, "box"), f'found the text "{user.box}", which is no IO box; allowed is {allowed}'
            elif user.box is None and len(boxes) > 1:
                yield (*where, "box"), f"the key is missing; with several IO boxes it must be one of {', '.join(boxes)}"


def _beyond_the_wire(axis: KeyPath, joint: Joint, device: DeviceDescription) -> Iterator[Finding]:
    """Limits that the drive's process data cannot express: a target near them would wrap around."""
    position = joint.position
    limits: tuple[tuple[KeyPath, tuple[float, ...], str], ...] = (
        (("position", "min"), (position.min,), "target_position"),
        (("position", "max"), (position.max,), "target_position"),
        (("velocity",), (-joint.velocity, joint.velocity), "target_velocity"),
        (("torque",), (-joint.torque, joint.torque), "target_torque"),
    )
    for where, ends, name in limits:
        low, high = device.wire_range(name)
        if not all(low <= end <= high for end in ends):
            entry = next(entry for pdo in device.rpdo for entry in pdo.channels if entry.name == name)
            why = f"{name} of {device.name} is {entry.type} with factor {entry.factor:g}"
            found = f"{'+-' if len(ends) == 2 else ''}{ends[-1]:g}"
            yield (*axis, *where), f"found {found}, allowed is {low:g} to {high:g}: {why}"


@rule(ArmFile, "home", "joints")
def _home(arm: ArmFile) -> Iterator[Finding]:
    home, joints = arm.home or (), arm.joints
    if home and len(home) != len(joints):
        yield ("home",), f"found {len(home)} numbers, allowed are {len(joints)}, one a joint"
    for i, (q, joint) in enumerate(zip(home, joints)):  # noqa: B905 the count is checked above
        low, high = joint.position.min, joint.position.max
        if not low <= q <= high:
            yield ("home", i), f"found {q:g}, allowed is {low:g} to {high:g}, the position of {joint.name}"


# -- geometry and boxes ------------------------------------------------------------------------------------------------


@rule(ArmFile, "kinematics", "joints")
def _joints_of_kinematics(arm: ArmFile) -> Iterator[Finding]:
    part = arm.kinematics
    if part is None:
        return
    if len(arm.joints) != len(part.dh):
        text = f"found beside {len(arm.joints)} joints, allowed are {len(part.dh)}; leave it out for such an arm"
        yield ("kinematics",), text
    for i, (joint, limit) in enumerate(zip(arm.joints, part.limits or ())):  # noqa: B905 the count is checked above
        place = f"kinematics.limits[{i}]"
        low, high = joint.position.min, joint.position.max
        if low < limit.min:
            text = f"found {low:g}, allowed is at least {limit.min:g}, the joint's mechanical end in {place}"
            yield ("joints", i, "position", "min"), text
        if high > limit.max:
            text = f"found {high:g}, allowed is at most {limit.max:g}, the joint's mechanical end in {place}"
            yield ("joints", i, "position", "max"), text
        if limit.velocity is not None and joint.velocity > limit.velocity:
            text = f"found {joint.velocity:g}, allowed is at most {limit.velocity:g}, the velocity in {place}"
            yield ("joints", i, "velocity"), text


@rule(Kinematics)
def _tools(part: Kinematics) -> Iterator[Finding]:
    tools = part.tools
    if tools and part.tool != Tool():
        yield ("tool",), "found beside tools: move it into the list, as its first"
    yield from _repeated(((("tools", i, "name"), tool.name) for i, tool in enumerate(tools)), "name")
    for i, tool in enumerate(tools):
        if tool.mass and part.links is None:
            yield ("tools", i, "mass"), f"found {tool.mass:g} beside links of unknown mass: it needs the key links"
        if part.bodies is not None and tool.bodies is None:
            text = "the key bodies is missing; where the arm's are named, so are the tool's: a list, [] for none"
            yield ("tools", i), text


@rule(ArmFile, "cartesian", "kinematics")
def _boxes(arm: ArmFile) -> Iterator[Finding]:
    tool, part = arm.cartesian.box, arm.kinematics
    boxes: list[tuple[KeyPath, Box | KeepOut]] = [(("cartesian", "box"), tool)] if tool else []
    boxes += [(("cartesian", "keep_out", i), box) for i, box in enumerate(arm.cartesian.keep_out)]
    for where, box in boxes:
        if part is None:
            yield where, "found a box, which needs the arm's geometry: the key kinematics is missing"
        elif text := _misplaced(box, part):
            yield where, text
        elif tool and isinstance(box, KeepOut) and _holds(box, tool):
            yield where, "found a box around all of cartesian.box: the tool has no place left"


@rule(ArmFile, "cartesian", "joints", "gripper")
def _box_names(arm: ArmFile) -> Iterator[Finding]:
    """Names with which the key of a limit, as joint2.max or user.max.z, has two meanings."""
    boxes = arm.cartesian.keep_out
    yield from _repeated(((("cartesian", "keep_out", i, "name"), box.name) for i, box in enumerate(boxes)), "name")
    taken = {"box": "cartesian.box", _ALL_JOINTS: "all joints"}
    taken |= {joint.name: dotted(where) for where, joint in axes_of(arm) if joint.name not in taken}
    for i, box in enumerate(boxes):
        if box.name in taken:
            text = f'found the text "{box.name}", which in the key of a limit means {taken[box.name]}'
            yield ("cartesian", "keep_out", i, "name"), text
        elif "." in box.name:
            text = f'found the text "{box.name}", allowed is one without a dot: dots separate the parts of a key'
            yield ("cartesian", "keep_out", i, "name"), text


def shoulder_and_reach(part: Kinematics) -> tuple[Position, float]:
    """Return a point that no joint moves, the origin of frame 1 (m), and how far from it the tool can be at most, m."""
    row = part.dh[0]
    shoulder = (row.a, 0.0 - math.sin(row.alpha) * row.d, math.cos(row.alpha) * row.d)
    longest = max(math.hypot(*tool.position) for tool in part.every_tool)
    return shoulder, sum(math.hypot(row.a, row.d) for row in part.dh[1:]) + longest


def _misplaced(box: Box | KeepOut, part: Kinematics) -> str:
    shoulder, reach = shoulder_and_reach(part)
    nearest = [min(max(c, low), high) for c, low, high in zip(shoulder, box.min, box.max, strict=True)]
    away = math.dist(shoulder, nearest)
    if away > reach:
        what = "the arm never meets it" if isinstance(box, KeepOut) else "the tool is never inside"
        text = f"found a box that begins {away:.3f} m from the shoulder, allowed is at most {reach:.3f} m"
        return f"{text}, the arm's reach: {what}"
    if isinstance(box, KeepOut) and _meets(_BASE, shoulder, box):
        at = ", ".join(f"{coordinate:g}" for coordinate in shoulder)
        text = "found a box around the arm's base, allowed is one beside it"
        return f"{text}: the base is at (0, 0, 0), the shoulder at ({at})"
    return ""


def _meets(start: Position, end: Position, box: KeepOut) -> bool:
    """Return whether the straight line between two points meets a box (the method of slabs)."""
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
Magnitude = tuple[KeyPath, float, float, str, tuple[str, float]]
"""Key, value, largest plausible magnitude, unit, and the likely other unit with its factor."""


def implausible(arm: ArmFile) -> Iterator[Finding]:
    """Yield a warning for each value that is allowed, but plausible only in another unit."""
    for where, value, most, unit, (likely, factor) in _magnitudes(arm):
        if abs(value) > most:
            yield (
                where,
                (
                    f"found {value:g} {unit}, plausible is at most {most:.4g} {unit}: "
                    f"if this is in {likely}, write {value * factor:.6g}"
                ),
            )


def _magnitudes(arm: ArmFile) -> Iterator[Magnitude]:
    for where, joint in axes_of(arm):
        yield (*where, "position", "min"), joint.position.min, _TWO_TURNS, "rad", _DEGREES
        yield (*where, "position", "max"), joint.position.max, _TWO_TURNS, "rad", _DEGREES
        yield (*where, "velocity"), joint.velocity, _TWO_TURNS, "rad/s", _DEGREES
        yield (*where, "acceleration"), joint.acceleration, 200.0, "rad/s^2", _DEGREES
    least = arm.cartesian.singularity
    for key, value, unit, likely in (
        ("shoulder", least.shoulder, "m", _MILLIMETRES),
        ("elbow", least.elbow, "rad", _DEGREES),
        ("wrist", least.wrist, "rad", _DEGREES),
    ):
        yield ("cartesian", "singularity", key), value, 1.0, unit, likely
    yield ("cartesian", "clearance"), arm.cartesian.clearance, 1.0, "m", _MILLIMETRES
    if arm.kinematics is None:
        return
    for i, row in enumerate(arm.kinematics.dh):
        for key in ("a", "d"):
            yield ("kinematics", "dh", i, key), getattr(row, key), 5.0, "m", _MILLIMETRES
    for i, limit in enumerate(arm.kinematics.limits or ()):
        for key in ("min", "max"):
            yield ("kinematics", "limits", i, key), getattr(limit, key), _TWO_TURNS, "rad", _DEGREES
        yield ("kinematics", "limits", i, "velocity"), limit.velocity or 0.0, _TWO_TURNS, "rad/s", _DEGREES
    for i, link in enumerate(arm.kinematics.links or ()):
        yield ("kinematics", "links", i, "mass"), link.mass, 200.0, "kg", _GRAMS
        yield ("kinematics", "links", i, "centre"), max(map(abs, link.centre)), 5.0, "m", _MILLIMETRES
    yield ("kinematics", "tool", "position"), max(map(abs, arm.kinematics.tool.position)), 5.0, "m", _MILLIMETRES
    for i, tool in enumerate(arm.kinematics.tools):
        yield ("kinematics", "tools", i, "mass"), tool.mass, 200.0, "kg", _GRAMS
        for key in ("position", "centre"):
            yield ("kinematics", "tools", i, key), max(map(abs, getattr(tool, key))), 5.0, "m", _MILLIMETRES
    for i, body in enumerate(arm.kinematics.bodies or ()):
        for key in ("start", "end"):
            yield ("kinematics", "bodies", i, key), max(map(abs, getattr(body, key))), 5.0, "m", _MILLIMETRES
        yield ("kinematics", "bodies", i, "radius"), body.radius, 1.0, "m", _MILLIMETRES


# -- motion files ------------------------------------------------------------------------------------------------------


@rule(Point)
def _point(point: Point) -> Iterator[Finding]:
    if point.a is not None and point.v is None:
        yield ("a",), "a needs v beside it"


@rule(Stop)
def _stop(stop: Stop) -> Iterator[Finding]:
    if (stop.pose is None) == (stop.q is None):
        yield (), f"found {'neither' if stop.pose is None else 'both'} of pose and q; one of them is needed"
    if stop.angle is not None and stop.via is None:
        yield ("angle",), "an angle needs via beside it"
    if stop.by_joints and stop.via is not None:
        yield ("by_joints",), "found via beside it, allowed is one of them"


@rule(NamedPose)
def _named_pose(pose: NamedPose) -> Iterator[Finding]:
    if (pose.pose is None) == (pose.q is None):
        yield (), f"found {'neither' if pose.pose is None else 'both'} of pose and q; one of them is needed"


MOST_PLANNED_STEPS = 10_000
"""Steps of a program, those of its parts with them."""
_MOST_DEPTH = 50
"""Parts in parts."""
_VERBS = ("move", "line", "arc", "gripper", "output", "wait_for", "wait_s", "tool", "run")
_OF_VERBS = {
    "via": ("arc",),
    "angle": ("arc",),
    "speed": ("move", "line", "arc"),
    "blend": ("move", "line", "arc"),
    "value": ("output", "wait_for"),
    "timeout_s": ("wait_for",),
    "times": ("run",),
}
"""Keys of a step, and those of which one has to stand beside each."""


@rule(Step)
def _step(step: Step) -> Iterator[Finding]:
    found = [verb for verb in _VERBS if getattr(step, verb) is not None]
    if len(found) != 1:
        yield (), f"found {' and '.join(found) or 'none of them'}, allowed is one of {', '.join(_VERBS)}"
        return
    for key, verbs in _OF_VERBS.items():
        default = next(one.default for one in fields(Step) if one.name == key)
        if getattr(step, key) != default and found[0] not in verbs:
            yield (key,), f"found beside {found[0]}, allowed beside {' or '.join(verbs)}"
    if step.arc is not None and step.via is None:
        yield ("arc",), "an arc needs via beside it"


@rule(MotionFile, "poses", "program", "parts")
def _program(motion: MotionFile) -> Iterator[Finding]:
    poses, parts = [one.name for one in motion.poses], [one.name for one in motion.parts]
    for key, names in (("poses", poses), ("parts", parts)):
        for at, name in enumerate(names):
            if name in names[:at]:
                yield (key, at, "name"), f'found "{name}" twice, allowed is once'
    lists: list[tuple[tuple[str | int, ...], tuple[Step, ...]]] = [(("program",), motion.program)]
    lists += [(("parts", at, "steps"), part.steps) for at, part in enumerate(motion.parts)]
    for where, steps in lists:
        for at, step in enumerate(steps):
            for key in ("move", "line", "arc", "via", "run"):
                name, allowed = getattr(step, key), parts if key == "run" else poses
                if name is not None and name not in allowed:
                    yield (*where, at, key), f'found "{name}", allowed is one of {", ".join(allowed) or "none"}'
    if any(step.tool is not None for _, steps in lists for step in steps):
        places = {one.name for one in motion.poses if one.pose is None}
        for where, steps in lists:
            for at, step in enumerate(steps):
                if step.via in places:
                    text = f'found "{step.via}", which has q; with several tools allowed is one with pose'
                    yield (*where, at, "via"), text
    calls = {part.name: {step.run for step in part.steps if step.run is not None} for part in motion.parts}
    circles = [at for at, name in enumerate(parts) if name in _reached(calls, name)]
    for at in circles:
        yield ("parts", at, "steps"), f'the part "{parts[at]}" runs itself; parts may only run others'
    if circles:
        return
    by_name = {part.name: part.steps for part in motion.parts}
    if (count := _planned_steps(motion.program, by_name)) > MOST_PLANNED_STEPS:
        text = f"found {'endless' if count == math.inf else f'{count:g}'} steps with those of all parts, a part that"
        yield ("program",), f"{text} repeats counted twice; allowed are {MOST_PLANNED_STEPS}"
        return
    if any(step.tool is not None for _, steps in lists for step in steps):
        first = next(_tools_and_motions(motion.program, by_name, len(parts)), None)
        if first is not None and first.tool is None:
            text = "a step chooses a tool, found a motion before the first choice; allowed is a tool before all motions"
            yield ("program",), text


def _reached(calls: Mapping[str, set[str]], name: str) -> set[str]:
    """Return the parts that a part runs, and those that they run."""
    reached, ahead = set[str](), set(calls[name])
    while ahead:
        part = ahead.pop()
        if part not in reached:
            reached.add(part)
            ahead |= calls.get(part, set())
    return reached


def _planned_steps(program: Sequence[Step], parts: Mapping[str, tuple[Step, ...]]) -> float:
    """Return the number of steps that are planned: of a part that repeats twice; infinite: parts are too deep."""
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
    """Yield in their order the steps that move or choose a tool, also of parts; `depth`: of parts in parts, at most."""
    for step in steps:
        if step.run is not None and depth > 0:
            yield from _tools_and_motions(parts.get(step.run, ()), parts, depth - 1)
        elif step.tool is not None or step.move or step.line or step.arc:
            yield step


@rule(MotionFile, EVERY_KEY)
def _one_form(motion: MotionFile) -> Iterator[Finding]:
    found = [key for key in ("trajectory", "path", "program") if getattr(motion, key)]
    if not (found or motion.poses):
        yield (), "none of trajectory, path, program and poses has entries; one of them is needed"
    if len(found) > 1:
        yield (found[1],), f"a file holds one of trajectory, path and program, found {' and '.join(found)}"
    if motion.parts and not motion.program:
        yield ("parts",), "found without program, allowed beside it"
    if motion.poses and (motion.trajectory or motion.path):
        yield ("poses",), "found beside a trajectory or a path, allowed is a program"
    if motion.trajectory and motion.speed is not None:
        yield ("speed",), "a speed is for a path; a trajectory's follows from its times"


@rule(MotionFile, "trajectory")
def _points(motion: MotionFile) -> Iterator[Finding]:
    points = motion.trajectory
    for i, point in enumerate(points):
        where, first, before = ("trajectory", i), points[0], points[max(i - 1, 0)]
        if i and not point.t > before.t:
            yield (*where, "t"), f"found {point.t:g} after {before.t:g}; times must rise"
        for key in ("q", "v", "a"):
            numbers, as_first = getattr(point, key), getattr(first, key)
            if numbers is not None and len(numbers) != len(first.q):
                text = f"found {len(numbers)} numbers, allowed are {len(first.q)}, as the first point has"
                yield (*where, key), text
            if (numbers is None) != (as_first is None):
                yield (*where, key), f"{key} must be given for all points or for none"
