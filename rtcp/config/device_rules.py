"""Rules between the values of a device file: its PDOs, its start-up SDOs, its clock and its watchdog.

As in `rules`, they work on plain values, as many of them as have the right form.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rtcp.config.document import Finding, KeyPath
from rtcp.config.model import DeviceDescription
from rtcp.config.rules import BITS, entries, integer_range, number, text

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


def name_padding(data: object) -> None:
    """Give padding, entries of index 0, the name that it need not have."""
    for direction in PDO_RANGE:
        for _, pdo in entries(data, direction):
            for _, channel in entries(pdo, "channels"):
                if number(channel, "index") == 0:
                    channel.setdefault("name", "padding")


def device_findings(data: object) -> list[Finding]:
    """Return the mistakes of a device file that concern more than one value."""
    findings: list[Finding] = []
    for direction in PDO_RANGE:
        findings += _pdo_findings(data, direction)
    for i, sdo in entries(data, "sdo"):
        kind, value = text(sdo, "type"), number(sdo, "value")
        if kind in BITS and value is not None and not _fits(kind, value):
            low, high = integer_range(kind)
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


def _fits(kind: str, value: float) -> bool:
    if kind.startswith("float"):
        return True
    low, high = integer_range(kind)
    return low <= value <= high and value == int(value)
