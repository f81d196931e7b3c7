"""What no single type can say: rules between the values of a file and between files.

They work on plain values, as many of them as have the right form, so that a mistake elsewhere hides none of theirs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from rtcp.config.document import Finding, KeyPath, dotted
from rtcp.config.model import CycleConfig, DeviceDescription, PdoEntry

BITS = {
    "bool": 1, "int8": 8, "uint8": 8, "int16": 16, "uint16": 16, "int32": 32, "uint32": 32, "int64": 64, "uint64": 64,
    "float32": 32, "float64": 64,
}  # fmt: skip

_NUMERIC = tuple(name for name in BITS if name != "bool")
_INTEGERS = tuple(name for name in _NUMERIC if "int" in name)

# The channels that a driver of each kind reads and writes, and the types that it can take them in. CiA 402-2 fixes
# 0x6040 and 0x6041 as UINT16, 0x6060 and 0x6061 as INT8; the other widths are the device's own choice.
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
    "io": {"rpdo": {"outputs": ("uint16",)}, "tpdo": {"inputs": ("uint16",), "counter": ("int32",)}},
}

# ETG.1000.6: the object ranges of receive and transmit PDO mappings.
PDO_RANGE = {"rpdo": (0x1600, 0x17FF), "tpdo": (0x1A00, 0x1BFF)}

MOST_AXES = 10
"""Joints, a gripper's among them, that a command has room for."""

LONGEST_INTERFACE = 15
"""Characters of a network interface's name (IFNAMSIZ less the closing zero)."""


def entries(data: object, *keys: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the mappings in a list of mappings, with their place in it; nothing where the form is another."""
    for key in keys:
        data = data.get(key) if isinstance(data, dict) else None
    if isinstance(data, list | tuple):
        yield from ((i, entry) for i, entry in enumerate(data) if isinstance(entry, dict))


def axes(data: object) -> list[tuple[KeyPath, dict[str, Any]]]:
    """Return all that drives move, each with its place: the joints, and the gripper's joint where it has one."""
    found: list[tuple[KeyPath, dict[str, Any]]] = [(("joints", i), joint) for i, joint in entries(data, "joints")]
    gripper = data.get("gripper") if isinstance(data, dict) else None
    driven = gripper.get("joint") if isinstance(gripper, dict) else None
    return [*found, (("gripper", "joint"), driven)] if isinstance(driven, dict) else found


def number(data: object, key: str) -> float | None:
    """Return the number under a key; None where there is none."""
    value = data.get(key) if isinstance(data, dict) else None
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def text(data: object, key: str) -> str | None:
    """Return the text under a key; None where there is none."""
    value = data.get(key) if isinstance(data, dict) else None
    return value if isinstance(value, str) else None


def period_us(data: object) -> float | None:
    """Return the cycle period of an arm's file, us; None where it is not a number."""
    cycle = data.get("cycle", {}) if isinstance(data, dict) else {}
    return number(cycle, "period_us") if isinstance(cycle, dict) and "period_us" in cycle else CycleConfig.period_us


def devices_named(data: object) -> dict[str, KeyPath]:
    """Return the devices that an arm's file names, each with the first place."""
    named: dict[str, KeyPath] = {}
    for i, slave in entries(data, "slaves"):
        if device := text(slave, "device"):
            named.setdefault(device, ("slaves", i, "device"))
    return named


def name_padding(data: object) -> None:
    """Give padding, entries of index 0, the name that it need not have."""
    for direction in PDO_RANGE:
        for _, pdo in entries(data, direction):
            for _, channel in entries(pdo, "channels"):
                if number(channel, "index") == 0:
                    channel.setdefault("name", "padding")


def arm_findings(data: object) -> list[Finding]:
    """Return the mistakes of an arm's file that concern more than one value."""
    slaves: list[tuple[KeyPath, dict[str, Any]]] = [(("slaves", i), slave) for i, slave in entries(data, "slaves")]
    findings = _repeated(slaves, "name") + _repeated(axes(data), "name") + _repeated(axes(data), "slave")
    if len(axes(data)) > MOST_AXES and axes(data)[-1][0] == ("gripper", "joint"):
        told = f"found beside {len(axes(data)) - 1} joints, allowed are {MOST_AXES} in all"
        findings.append((("gripper", "joint"), told))
    for where, joint in axes(data):
        position = joint.get("position")
        low, high = number(position, "min"), number(position, "max")
        if low is not None and high is not None and not low < high:
            findings.append(((*where, "position"), f"found min {low} and max {high}; min must be less than max"))
    bus = data.get("bus") if isinstance(data, dict) else None
    interface = text(bus, "interface")
    if interface and (len(interface) > LONGEST_INTERFACE or "/" in interface or any(map(str.isspace, interface))):
        wanted = f"virtual, or a network interface of at most {LONGEST_INTERFACE} characters without spaces and /"
        findings.append((("bus", "interface"), f'found the text "{interface}", allowed is {wanted}'))
    return findings


def joint_findings(data: object, devices: Mapping[str, DeviceDescription]) -> list[Finding]:
    """Return the mistakes between the joints and the slaves that move them."""
    slaves = {name: slave for _, slave in entries(data, "slaves") if (name := text(slave, "name"))}
    findings: list[Finding] = []
    for axis, joint in axes(data):
        name = text(joint, "slave")
        if name is None:
            continue
        where = (*axis, "slave")
        if name not in slaves:
            known = f"allowed are the names under slaves: {', '.join(slaves)}" if slaves else "no slave has a name"
            findings.append((where, f'found the text "{name}", which is no slave; {known}'))
            continue
        device = devices.get(text(slaves[name], "device") or "")
        if device is None:
            continue
        if device.kind != "cia402":
            kind = f"its device {slaves[name]['device']} is of kind {device.kind}"
            findings.append((where, f'found the text "{name}", which moves no joint: {kind}; allowed is kind cia402'))
            continue
        findings += _beyond_the_wire(axis, joint, device)
    return findings


def device_findings(data: object) -> list[Finding]:
    """Return the mistakes of a device file that concern more than one value."""
    findings: list[Finding] = []
    for direction in PDO_RANGE:
        findings += _pdo_findings(data, direction)
    for i, sdo in entries(data, "sdo"):
        kind, value = text(sdo, "type"), number(sdo, "value")
        if kind in BITS and value is not None and not _fits(kind, value):
            low, high = _range(kind)
            wanted = f"an integer from {low} to {high}, the range of {kind}"
            findings.append((("sdo", i, "value"), f"found {value}, allowed is {wanted}"))
    word = number(data, "assign_activate")
    if word and int(word) & 0x0300 != 0x0300:
        wanted = "0 for no distributed clocks, or a word that switches SYNC0 on, as 0x0300 or 0x0700"
        findings.append((("assign_activate",), f"found {int(word):#06x}, allowed is {wanted}"))
    return findings


def period_findings(data: object, period: float) -> list[Finding]:
    """Return the mistakes of a device file under a cycle period, us."""
    findings: list[Finding] = []
    cycles = f"the cycle period is {period:g} us"
    watchdog = number(data, "watchdog_ms")
    if watchdog is None and isinstance(data, dict) and "watchdog_ms" not in data:
        watchdog = DeviceDescription.watchdog_ms
    # A drive keeps its last target until the watchdog expires: 100 ms is the ESC's default, 10 cycles for slower buses.
    longest = max(100.0, 10 * period / 1000) if text(data, "kind") == "cia402" else None
    shortest = 2 * period / 1000
    if watchdog is not None and watchdog > 0:
        if watchdog <= shortest:
            wanted = f"more than 2 cycles, {shortest:g} ms ({cycles})"
            findings.append(
                (("watchdog_ms",), f"found {watchdog:g} ms, allowed is {wanted}: one late frame must not trip it")
            )
        elif longest is not None and watchdog > longest:
            wanted = f"at most {longest:g} ms ({cycles})"
            reason = "until it expires the drive keeps its last target"
            findings.append((("watchdog_ms",), f"found {watchdog:g} ms, allowed is {wanted}: {reason}"))
    shift = number(data, "sync0_shift_us")
    if shift is not None and abs(shift) >= period:
        wanted = f"less than one cycle either way ({cycles})"
        findings.append((("sync0_shift_us",), f"found {shift:g} us, allowed is {wanted}"))
    return findings


def _repeated(found: list[tuple[KeyPath, dict[str, Any]]], key: str) -> list[Finding]:
    findings: list[Finding] = []
    first: dict[str, KeyPath] = {}
    for where, entry in found:
        value = text(entry, key)
        if value is not None and (place := first.setdefault(value, where)) != where:
            told = f'found the text "{value}", the {key} that {dotted(place)} has; each needs its own'
            findings.append(((*where, key), told))
    return findings


def _beyond_the_wire(axis: KeyPath, joint: dict[str, Any], device: DeviceDescription) -> list[Finding]:
    """Limits that the drive's process data cannot express: a target near them would wrap around."""
    channels = {channel.name: channel for pdo in device.rpdo for channel in pdo.channels}
    position = joint.get("position")
    limits: tuple[tuple[KeyPath, float | None, str], ...] = (
        (("position", "min"), number(position, "min"), "target_position"),
        (("position", "max"), number(position, "max"), "target_position"),
        (("velocity",), number(joint, "velocity"), "target_velocity"),
        (("torque",), number(joint, "torque"), "target_torque"),
    )
    findings: list[Finding] = []
    for where, limit, name in limits:
        channel = channels.get(name)
        if limit is None or channel is None or channel.type.startswith("float"):
            continue
        low, high = _reach(channel)
        # A speed or torque limit holds both ways.
        ends = (limit,) if where[0] == "position" else (-limit, limit)
        if not all(low <= end <= high for end in ends):
            why = f"{name} of {device.name} is {channel.type} with factor {channel.factor:g}"
            found = f"{limit:g}" if len(ends) == 1 else f"+-{limit:g}"
            findings.append(((*axis, *where), f"found {found}, allowed is {low:g} to {high:g}: {why}"))
    return findings


def wire_range(device: DeviceDescription, name: str) -> tuple[float, float]:
    """Return what a channel to a device can say, SI; without bounds where the channel is a float or not there."""
    found = [channel for pdo in device.rpdo for channel in pdo.channels if channel.name == name]
    if not found or found[0].type.startswith("float"):
        return -math.inf, math.inf
    return _reach(found[0])


def _reach(channel: PdoEntry) -> tuple[float, float]:
    low, high = _range(channel.type)
    ends = (low * channel.factor, high * channel.factor)
    return min(ends), max(ends)


def _pdo_findings(data: object, direction: str) -> list[Finding]:
    findings: list[Finding] = []
    low, high = PDO_RANGE[direction]
    seen: dict[float, int] = {}
    names: dict[str, tuple[KeyPath, dict[str, Any]]] = {}
    bits = 0
    complete = isinstance(data, dict) and isinstance(data.get(direction), list)
    for i, pdo in entries(data, direction):
        index = number(pdo, "index")
        if index is not None and not low <= index <= high:
            wanted = f"{low:#x} to {high:#x}, the objects of a {direction}"
            findings.append(((direction, i, "index"), f"found {int(index):#06x}, allowed is {wanted}"))
        elif index is not None and seen.setdefault(index, i) != i:
            place = f"{direction}[{seen[index]}]"
            findings.append(
                ((direction, i, "index"), f"found {int(index):#06x}, which {place} has; each needs its own")
            )
        for j, channel in entries(pdo, "channels"):
            where: KeyPath = (direction, i, "channels", j)
            kind = text(channel, "type")
            complete = complete and kind in BITS
            bits += BITS.get(kind or "", 0)
            if number(channel, "index") == 0:
                continue
            if number(channel, "factor") == 0:
                findings.append(((*where, "factor"), "found 0, allowed is any number but 0"))
            name = text(channel, "name")
            if name is None:
                continue
            if name in names:
                findings.append(
                    ((*where, "name"), f'found the text "{name}" again; each channel of the {direction} needs its own')
                )
            else:
                names[name] = (where, channel)
    if complete and bits % 8:
        wanted = "whole bytes; fill up with padding (`{index: 0, sub_index: 0, type: bool}`)"
        findings.append(((direction,), f"found {bits} bits in all, allowed are {wanted}"))
    return findings + _needed(data, direction, names)


def _needed(data: object, direction: str, names: Mapping[str, tuple[KeyPath, dict[str, Any]]]) -> list[Finding]:
    kind = text(data, "kind") or ""
    needed = CHANNELS.get(kind, {}).get(direction, {})
    findings: list[Finding] = []
    missing = [name for name in needed if name not in names]
    if missing and isinstance(data, dict) and direction in data:
        there = f"its channels are {', '.join(names)}" if names else "it has no channels"
        those = f"{'a channel' if len(missing) == 1 else 'channels'} named {', '.join(missing)}"
        findings.append(((direction,), f"kind {kind} needs {those}; {there}"))
    for name, types in needed.items():
        where, channel = names.get(name, ((), {}))
        found = text(channel, "type")
        if found in BITS and found not in types:
            wanted = "any type but bool" if types is _NUMERIC else " or ".join(types)
            findings.append(((*where, "type"), f"found {found} for {name}, allowed is {wanted}"))
    return findings


def _range(kind: str) -> tuple[int, int]:
    bits = BITS[kind]
    return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind.startswith("int") else (0, 2**bits - 1)


def _fits(kind: str, value: float) -> bool:
    if kind.startswith("float"):
        return True
    low, high = _range(kind)
    return low <= value <= high and value == int(value)
