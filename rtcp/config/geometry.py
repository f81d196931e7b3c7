"""The `kinematics:` part of an arm's file: modified Denavit-Hartenberg rows, mechanical limits, masses and the tool.

Lengths in m, angles in rad, masses in kg. An angle is a number or a fraction of pi, as `-pi/2`: what a drawing gives in
degrees is so written exactly.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le
from pydantic import BeforeValidator

from rtcp.config.checking import AlsoText
from rtcp.config.document import Finding, KeyPath
from rtcp.config.model import NotNegative
from rtcp.config.rules import entries, number

JOINTS = 6
"""Rows, limits and masses that there must be: the kinematics is that of arms with so many joints."""

_FRACTION_OF_PI = re.compile(r"([-+]?)(?:([1-9]\d{0,3})\*)?pi(?:/([1-9]\d{0,3}))?", re.ASCII)
_FULL_TURN = 2 * math.pi


def angle(written: object) -> object:
    """Return the number that a fraction of pi stands for (`pi`, `-pi/2`, `11*pi/12`), and all else as it is."""
    found = _FRACTION_OF_PI.fullmatch(written) if isinstance(written, str) else None
    if found is None:
        return written
    sign, times, parts = found.groups()
    size = int(times or 1) * math.pi / int(parts or 1)
    return -size if sign == "-" else size


_read_angle = BeforeValidator(angle)
_as_text = AlsoText("a fraction of pi, as -pi/2 or 11*pi/12")

Angle = Annotated[float, _read_angle, _as_text]
Speed = Annotated[float, _read_angle, _as_text, Gt(0)]
Length = Annotated[float, Ge(-100), Le(100)]
"""Beyond 100 m it is millimetres that were written."""


@dataclass(frozen=True)
class Row:
    """A row of modified (Craig) parameters: T(i-1, i) = Rx(alpha) Tx(a) Rz(q + offset) Tz(d)."""

    alpha: Angle
    a: Length
    d: Length
    offset: Angle = 0.0


@dataclass(frozen=True)
class MechanicalLimit:
    """What a joint can do at all: its range, rad, and its speed, rad/s (None: not known)."""

    min: Angle
    max: Angle
    velocity: Speed | None = None


@dataclass(frozen=True)
class Link:
    """Mass, kg, and centre of mass, m, of the link that moves with a joint, in that joint's frame."""

    mass: NotNegative
    centre: tuple[Length, ...]


@dataclass(frozen=True)
class Tool:
    """From the flange (frame 6) to the tool: position, m, and (rx, ry, rz), rad, with R = Rx(rx) Ry(ry) Rz(rz)."""

    position: tuple[Length, ...] = (0.0, 0.0, 0.0)
    rpy: tuple[Angle, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Kinematics:
    """The arm's geometry; `limits` may be left out beside `joints`, `links` where masses are not known."""

    dh: tuple[Row, ...]
    limits: tuple[MechanicalLimit, ...] | None = None
    links: tuple[Link, ...] | None = None
    tool: Tool = field(default_factory=Tool)


def kinematics_findings(data: object) -> list[Finding]:
    """Return the mistakes of the `kinematics:` part, and between it and the joints, that no single type can say."""
    part = data.get("kinematics") if isinstance(data, dict) else None
    if not isinstance(part, dict):
        return []
    return [*_wrong_counts(part), *_degrees(part), *_limits(data, part)]


def _wrong_counts(part: dict[str, Any]) -> Iterator[Finding]:
    for key, what in (("dh", "rows"), ("limits", "entries"), ("links", "entries")):
        value = part.get(key)
        if isinstance(value, list) and len(value) != JOINTS:
            yield (("kinematics", key), f"found {len(value)} {what}, allowed are {JOINTS}, one for each joint")
    vectors: list[tuple[KeyPath, object, str]] = [
        (("kinematics", "links", i, "centre"), link.get("centre"), "x, y, z") for i, link in entries(part, "links")
    ]
    tool = part.get("tool")
    if isinstance(tool, dict):
        vectors.append((("kinematics", "tool", "position"), tool.get("position"), "x, y, z"))
        vectors.append((("kinematics", "tool", "rpy"), tool.get("rpy"), "rx, ry, rz"))
    for where, value, names in vectors:
        if isinstance(value, list) and len(value) != 3:
            yield (where, f"found {len(value)} numbers, allowed are three: {names}")


def _degrees(part: dict[str, Any]) -> Iterator[Finding]:
    """Angles of the geometry beyond a full turn, which nobody means: they were written in degrees."""
    written: list[tuple[KeyPath, object]] = [
        (("kinematics", "dh", i, key), row.get(key)) for i, row in entries(part, "dh") for key in ("alpha", "offset")
    ]
    tool = part.get("tool")
    rpy = tool.get("rpy") if isinstance(tool, dict) else None
    if isinstance(rpy, list):
        written += [(("kinematics", "tool", "rpy", i), value) for i, value in enumerate(rpy)]
    for where, value in written:
        found = _number(value)
        if found is not None and abs(found) > _FULL_TURN:
            yield (where, f"found {value}, allowed is -2*pi to 2*pi: an angle is in rad; 90 degrees are written pi/2")


def _limits(data: object, part: dict[str, Any]) -> Iterator[Finding]:
    ranges = {i: (_number(limit.get("min")), _number(limit.get("max"))) for i, limit in entries(part, "limits")}
    for i, (low, high) in ranges.items():
        if low is not None and high is not None and not low < high:
            yield (("kinematics", "limits", i), f"found min {low:g} and max {high:g}; min must be less than max")
    joints = data.get("joints") if isinstance(data, dict) else None
    if joints is None:
        if part.get("limits") is None:
            wanted = f"it must be a list of {JOINTS} mappings with the keys min, max, velocity"
            yield (("kinematics",), f"the key limits is missing; {wanted} in a file without joints")
        return
    if isinstance(joints, list) and len(joints) != JOINTS:
        wanted = f"allowed are {JOINTS}; leave it out for such an arm"
        yield (("kinematics",), f"found beside {len(joints)} joints, {wanted}")
    for i, joint in entries(data, "joints"):
        yield from _joint(i, joint, *ranges.get(i, (None, None)), _speed(part, i))


def _joint(
    i: int, joint: dict[str, Any], low: float | None, high: float | None, fastest: float | None
) -> Iterator[Finding]:
    place = f"kinematics.limits[{i}]"
    for key, end in (("min", low), ("max", high)):
        found = number(joint.get("position"), key)
        if found is None or end is None:
            continue
        if found < end if key == "min" else found > end:
            wanted = f"at {'least' if key == 'min' else 'most'} {end:g}, the joint's mechanical end in {place}"
            yield (("joints", i, "position", key), f"found {found:g}, allowed is {wanted}")
    speed = number(joint, "velocity")
    if speed is not None and fastest is not None and speed > fastest:
        yield (("joints", i, "velocity"), f"found {speed:g}, allowed is at most {fastest:g}, the velocity in {place}")


def _speed(part: dict[str, Any], i: int) -> float | None:
    return next((_number(limit.get("velocity")) for j, limit in entries(part, "limits") if j == i), None)


def _number(value: object) -> float | None:
    """Return an angle or speed as a number; None where it is none (the types say that)."""
    return number({"": angle(value)}, "")
