"""Rules between the values that say how the arm is operated: boxes, terminals, what a motion needs.

As in `rules`, they work on plain values, as many of them as have the right form.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from rtcp.config.document import Finding, KeyPath, dotted
from rtcp.config.geometry import Kinematics
from rtcp.config.model import DeviceDescription
from rtcp.config.operation import CartesianConfig, JogConfig, JoystickConfig
from rtcp.config.rules import axes, entries, number, text

STICK = ("forward", "backward", "left", "right", "mode_up", "mode_down")
"""Keys of the stick's terminals."""
_INPUTS = ("arm_toggle", "enabling_switch", "emergency_stop")
_OUTPUTS = ("state_lamp", "motion_lamp", "heartbeat")
_AXES = "xyz"
_ALL_JOINTS = "joints"

Point = tuple[float, float, float]


def operation_findings(data: object) -> list[Finding]:
    """Return the mistakes between the values of an arm's file that say how it is operated; boxes apart."""
    twice = (*_used_twice(_inputs(data), "input"), *_used_twice(_outputs(data), "output"))
    return [*_motion(data), *_speeds(data), *_gripper(data), *twice]


def terminal_findings(data: object, devices: Mapping[str, DeviceDescription]) -> list[Finding]:
    """Return the terminals with a meaning for which there is no IO box; `device_rules` sees to 16 of each."""
    named = [devices.get(text(slave, "device") or "") for _, slave in entries(data, "slaves")]
    if any(device is None or device.kind == "io" for device in named):
        return []
    return [
        (where, f"found {kind} {found:g}, but no slave is of kind io; leave it out for such an arm")
        for kind, terminals in (("input", _inputs(data)), ("output", _outputs(data)))
        for where, found in terminals
    ]


def motion_lacks(motion: str | None, *, geometry: bool, stick: bool) -> str:
    """Return what is said of a `motion` whose needs the arm does not meet; nothing where it does."""
    if motion in ("cartesian", "joystick") and not geometry:
        return f'found the text "{motion}", which needs the arm\'s geometry: the key kinematics is missing'
    if motion == "joystick" and not stick:
        return f'found the text "{motion}", which needs the stick\'s terminals: the key inputs.joystick is missing'
    return ""


def box_findings(data: object, part: Kinematics | None) -> list[Finding]:
    """Return the mistakes in the boxes of `cartesian`; `part`: the arm's geometry, None where it has mistakes too."""
    boxes: list[tuple[KeyPath, dict[str, Any]]] = []
    cartesian = _part(data, "cartesian")
    if isinstance(box := cartesian.get("box"), dict):
        boxes.append((("cartesian", "box"), box))
    boxes += [(("cartesian", "keep_out", i), entry) for i, entry in entries(data, "cartesian", "keep_out")]
    findings: list[Finding] = []
    first: dict[str, int] = {}
    for where, box in boxes:
        if isinstance(data, dict) and data.get("kinematics") is None:
            findings.append((where, "found a box, which needs the arm's geometry: the key kinematics is missing"))
            continue
        low, high = _corner(box, "min"), _corner(box, "max")
        if low is None or high is None:
            continue
        turned = [axis for axis, least, most in zip(_AXES, low, high, strict=True) if not least < most]
        for axis in turned:
            least, most = low[_AXES.index(axis)], high[_AXES.index(axis)]
            findings.append((where, f"found min {least:g} and max {most:g} in {axis}; min must be less than max"))
        if not turned and part is not None:
            findings += _placed(where, low, high, part, keep_out=len(where) == 3)
    for i, entry in entries(data, "cartesian", "keep_out"):
        name = text(entry, "name")
        if name is not None and first.setdefault(name, i) != i:
            found = f'found the text "{name}", the name that cartesian.keep_out[{first[name]}] has'
            findings.append((("cartesian", "keep_out", i, "name"), f"{found}; each needs its own"))
    findings += _names_of_limits(data)
    return findings + (_nothing_left(boxes) if not findings else [])


def shoulder_and_reach(part: Kinematics) -> tuple[Point, float]:
    """Return a point that no joint moves, the origin of frame 1 (m), and how far from it the tool can be at most, m."""
    row = part.dh[0]
    shoulder = (row.a, 0.0 - math.sin(row.alpha) * row.d, math.cos(row.alpha) * row.d)
    return shoulder, sum(math.hypot(row.a, row.d) for row in part.dh[1:]) + math.hypot(*part.tool.position)


def _names_of_limits(data: object) -> Iterator[Finding]:
    """Names that would make the key of a limit, as joint2.max or user.max.z, mean two things."""
    taken = {"box": "cartesian.box", _ALL_JOINTS: "all joints"}
    for where, joint in axes(data):
        name = text(joint, "name")
        if name == _ALL_JOINTS:
            yield ((*where, "name"), f'found the text "{name}", which in the key of a limit means all joints')
        elif name is not None:
            taken.setdefault(name, dotted(where))
    for i, entry in entries(data, "cartesian", "keep_out"):
        name = text(entry, "name")
        key = ("cartesian", "keep_out", i, "name")
        if name in taken:
            yield (key, f'found the text "{name}", which in the key of a limit means {taken[name]}')
        elif name is not None and "." in name:
            yield (
                key,
                f'found the text "{name}", allowed is one without a dot: in the key of a limit dots part its words',
            )


def _placed(where: KeyPath, low: Point, high: Point, part: Kinematics, *, keep_out: bool) -> Iterator[Finding]:
    shoulder, reach = shoulder_and_reach(part)
    nearest = tuple(min(max(c, least), most) for c, least, most in zip(shoulder, low, high, strict=True))
    away = math.dist(shoulder, nearest)
    if away > reach:
        what = "the arm never meets it" if keep_out else "the tool is never inside"
        told = f"found a box that begins {away:.3f} m from the shoulder, allowed is at most {reach:.3f} m"
        yield (where, f"{told}, the arm's reach: {what}")
    elif keep_out and _meets((0.0, 0.0, 0.0), shoulder, low, high):
        at = ", ".join(f"{coordinate:g}" for coordinate in shoulder)
        stands = f"the arm stands there, its base at (0, 0, 0) and its shoulder at ({at})"
        yield (where, f"found a box around the arm's base, allowed is one beside it: {stands}")


def _meets(start: Point, end: Point, low: Point, high: Point) -> bool:
    """Return whether the straight line between two points meets a box (the method of slabs)."""
    enter, leave = 0.0, 1.0
    for begin, finish, least, most in zip(start, end, low, high, strict=True):
        way = finish - begin
        if way == 0.0:
            if not least <= begin <= most:
                return False
            continue
        at = sorted(((least - begin) / way, (most - begin) / way))
        enter, leave = max(enter, at[0]), min(leave, at[1])
    return enter <= leave


def _nothing_left(boxes: list[tuple[KeyPath, dict[str, Any]]]) -> list[Finding]:
    """A keep-out box around all of the box that the tool may be in."""
    inner = next((box for where, box in boxes if len(where) == 2), {})
    low, high = _corner(inner, "min"), _corner(inner, "max")
    if low is None or high is None:
        return []
    findings: list[Finding] = []
    for where, box in boxes:
        least, most = _corner(box, "min"), _corner(box, "max")
        if len(where) == 2 or least is None or most is None:
            continue
        if all(a <= b for a, b in zip((*least, *high), (*low, *most), strict=True)):
            findings.append((where, "found a box around all of cartesian.box: it leaves the tool no place to be"))
    return findings


def _motion(data: object) -> Iterator[Finding]:
    there = _part(data, "inputs").get("joystick") is not None
    geometry = isinstance(data, dict) and data.get("kinematics") is not None
    if lacking := motion_lacks(text(data, "motion"), geometry=geometry, stick=there):
        yield (("motion",), lacking)


def _speeds(data: object) -> Iterator[Finding]:
    jog, cartesian = _part(data, "jog"), _part(data, "cartesian")
    for key in ("speed", "angular_speed"):
        found = number(jog, key) if key in jog else getattr(JogConfig, key)
        most = number(cartesian, key) if key in cartesian else getattr(CartesianConfig, key)
        if found is not None and most is not None and found > most:
            default = "" if key in jog else ", its default"
            yield (("jog", key), f"found {found:g}{default}, allowed is at most {most:g}, cartesian.{key}")


def _gripper(data: object) -> Iterator[Finding]:
    gripper = data.get("gripper") if isinstance(data, dict) else None
    if not isinstance(gripper, dict):
        return
    output, joint = gripper.get("output"), gripper.get("joint")
    if (output is None) == (joint is None):
        found = "neither output nor joint" if joint is None else "both output and joint"
        yield (("gripper",), f"found {found}, allowed is one of them: a digital output, or a drive of its own")
    elif output is not None:
        for key in ("open_position", "closed_position"):
            if gripper.get(key) is not None:
                yield (("gripper", key), "this key belongs to a gripper with a joint; here is one on an output")
    else:
        if "closed" in gripper:
            yield (("gripper", "closed"), "this key belongs to a gripper on an output; here is one with a joint")
        yield from _ends(gripper)


def _ends(gripper: dict[str, Any]) -> Iterator[Finding]:
    """Where a gripper with a drive is open and closed: two places inside its range."""
    joint = gripper["joint"]
    reach = joint.get("position") if isinstance(joint, dict) else None
    low, high = number(reach, "min"), number(reach, "max")
    for key in ("open_position", "closed_position"):
        found = number(gripper, key)
        if gripper.get(key) is None:
            yield (("gripper",), f"the key {key} is missing; it must be a number inside gripper.joint.position")
        elif found is not None and low is not None and high is not None and (found < low < high or low < high < found):
            yield (("gripper", key), f"found {found:g}, allowed is {low:g} to {high:g}, gripper.joint.position")
    closed = number(gripper, "closed_position")
    if closed is not None and closed == number(gripper, "open_position"):
        told = f"found {closed:g}, the open_position too; the gripper must have somewhere to go"
        yield (("gripper", "closed_position"), told)


def _inputs(data: object) -> list[tuple[KeyPath, float]]:
    inputs = _part(data, "inputs")
    terminals: list[tuple[KeyPath, float | None]] = []
    stick = inputs.get("joystick")
    if isinstance(stick, dict):
        for key in STICK:
            found = number(stick, key) if key in stick else getattr(JoystickConfig, key)
            terminals.append((("inputs", "joystick", key), found))
    terminals += [(("inputs", key, "number"), number(inputs.get(key), "number")) for key in _INPUTS]
    return [(where, found) for where, found in terminals if found is not None]


def _outputs(data: object) -> list[tuple[KeyPath, float]]:
    outputs, gripper = _part(data, "outputs"), _part(data, "gripper")
    terminals: list[tuple[KeyPath, float | None]] = [(("outputs", key), number(outputs, key)) for key in _OUTPUTS]
    terminals.append((("gripper", "output"), number(gripper, "output")))
    return [(where, found) for where, found in terminals if found is not None]


def _used_twice(terminals: list[tuple[KeyPath, float]], kind: str) -> Iterator[Finding]:
    first: dict[float, KeyPath] = {}
    for where, found in terminals:
        if (before := first.setdefault(found, where)) != where:
            yield (where, f"found {found:g}, the {kind} of {dotted(before)}; each needs its own")


def _part(data: object, key: str) -> dict[str, Any]:
    found = data.get(key) if isinstance(data, dict) else None
    return found if isinstance(found, dict) else {}


def _corner(box: object, key: str) -> Point | None:
    values = box.get(key) if isinstance(box, dict) else None
    if not isinstance(values, list) or len(values) != 3:
        return None
    found = [number({"": value}, "") for value in values]
    x, y, z = (math.nan if value is None else value for value in found)
    return (x, y, z) if all(map(math.isfinite, (x, y, z))) else None
