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
    low, high = integer_range(channel.type)
    ends = (low * channel.factor, high * channel.factor)
    return min(ends), max(ends)


def integer_range(kind: str) -> tuple[int, int]:
    """Return the smallest and the largest number of an integer type."""
    bits = BITS[kind]
    return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind.startswith("int") else (0, 2**bits - 1)
