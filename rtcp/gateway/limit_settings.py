"""The limits in force: reported, changed as one transaction, and kept for the next gateway."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

from rtcp.config.model import SUPERVISION, ArmConfig
from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.gateway.method import method
from rtcp.ipc.commands import SetLimits
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import limits_file
from rtcp.ipc.schema import FIRST_CONE
from rtcp.motion.limits import (
    FIELDS,
    WIDENABLE,
    Cone,
    Corners,
    Limits,
    Values,
    WrongLimit,
    rows,
    wrong_limits,
)

_JOINT_KEYS = {{"low": "min", "high": "max"}.get(name, name): name for name in FIELDS}
_ENDS = ("min", "max")
ALL = "joints"
"""Name for all joints in a key."""


class LimitSettings:
    """Reports and changes the limits.

    Args:
        channel: to the loop.
        limits: in force; changed here when the loop has accepted the change.
        directory: the runtime directory, which keeps them as long as the loop lives.
    """

    def __init__(self, channel: CommandChannel, limits: Limits, directory: Path) -> None:
        self._channel = channel
        self._config = channel.config
        self._limits = limits
        self._file = limits_file(directory)
        if kept := _read(self._file, channel.observer.loop_pid):
            limits.apply(kept)

    @method(at_once=True)
    async def limits(self, caller: Caller) -> Json:
        """Return the `limits` in force beside those that are `configured`, and how far they can be widened."""
        config = self._config
        return {
            "joint_names": [joint.name for joint in config.joints],
            "limits": _as_json(config, self._limits.now),
            "configured": _as_json(config, self._limits.widest),
            "absolute": _as_json(config, self._limits.absolute),
            "cartesian": {
                name: getattr(config.cartesian, name)
                for name in (
                    "speed", "acceleration", "jerk", "angular_speed", "angular_acceleration", "angular_jerk",
                )
            } | {"singularity": dataclasses.asdict(config.cartesian.singularity)},
        }  # fmt: skip

    @method()
    async def set_limits(self, caller: Caller, changes: dict[str, Any], widen: bool = False) -> Json:
        """Narrow limits, all or none; keys as `joint2.max`, `joints.velocity`, `box.min.x`, `supervision.torque`.

        With `widen`, without torque: up to the keys `absolute` of the file. Returns as `limits`.
        """
        new = changed(self._config, self._limits.now, changes, widen=widen)
        async with self._channel.lease(caller) as lease:
            plan = rows(new)
            slot = self._channel.observer.write_plan(plan)
            await self._channel.send(lease, SetLimits(slot, len(plan), widen))
            self._limits.apply(new)
            _write(self._file, new, self._channel.observer.loop_pid)
        return await self.limits(caller)


def changed(config: ArmConfig, values: Values, changes: Mapping[str, float], *, widen: bool = False) -> Values:
    """Return `values` with `changes`, within the absolute limits if they may `widen`, else within the configured ones.

    Raises:
        RtcpError: `invalid`, naming each invalid key or number.
    """
    if not changes:
        raise RtcpError("invalid", f"changes: found none, give a key and a number, as {_example(config)}")
    widest = Values.absolute(config) if widen else Values.configured(config).or_wider(values)
    wrong, refused, new = [], [], values
    for key, number in changes.items():
        if type(number) not in (int, float) or not abs(number) <= sys.float_info.max:
            wrong.append(f"{key}: found {json.dumps(number)[:60]}, allowed is a finite number")
            continue
        try:
            new = _put(config, new, key, number)
        except KeyError:
            wrong.append(f"{key}: there is no such limit; allowed are {_example(config)}")
        # After each key, because a later one may replace its number, or make room for it.
        refused += [limit for limit in wrong_limits(widest, new) if not limit.no_room]
    refused += wrong_limits(widest, new)
    wrong += dict.fromkeys(_sentence(config, limit, widen) for limit in refused)
    if wrong:
        raise RtcpError("invalid", "\n".join(wrong))
    return new


def _put(config: ArmConfig, values: Values, key: str, number: float) -> Values:
    """Return `values` with a finite number at a key; raises KeyError."""
    names = [joint.name for joint in config.joints]
    per_joint, boxes = _lists(config, values)
    whole, _, name = key.rpartition(".")
    cones = [cone.name for cone in config.cartesian.cones]
    if whole == "supervision" and name in SUPERVISION:
        thresholds = dict(zip(SUPERVISION, values.supervision, strict=True)) | {name: number}
        speed, torque, following_error = thresholds.values()
        return replace(values, supervision=(speed, torque, following_error))
    if whole in cones and name == "angle":
        named = zip(cones, values.cones, strict=True)
        turned = tuple(cone._replace(angle=number) if cone_name == whole else cone for cone_name, cone in named)
        return replace(values, cones=turned)
    head, _, rest = key.rpartition(".") if name in _JOINT_KEYS else (key, "", "")
    which, _, end = head.rpartition(".")
    box, _, side = which.rpartition(".")
    if rest and (head in names or head == ALL):
        for joint in range(len(names)) if head == ALL else (names.index(head),):
            per_joint[_JOINT_KEYS[rest]][joint] = number
    elif box in boxes and side in _ENDS and end in ("x", "y", "z"):
        boxes[box][3 * _ENDS.index(side) + "xyz".index(end)] = number
    else:
        raise KeyError(key)
    joints: dict[str, Any] = {name: tuple(numbers) for name, numbers in per_joint.items()}
    inner = _corners(boxes.pop("box")) if values.box is not None else None
    keep_out = tuple(_corners(corners) for corners in boxes.values())
    return Values(**joints, box=inner, keep_out=keep_out, cones=values.cones, supervision=values.supervision)


def _sentence(config: ArmConfig, wrong: WrongLimit, widen: bool) -> str:
    """Return the message for a limit that cannot be set: its key, its value and the allowed range."""
    name = next((key for key, name in _JOINT_KEYS.items() if name == wrong.name), wrong.name)
    if wrong.axis >= 0:
        part, where = config.joints[wrong.axis].name, f"joints[{wrong.axis}]"
        allowed = f"{wrong.low:g} to {wrong.high:g}"
    elif wrong.axis == -2:
        part = where = "supervision"
        allowed = f"{wrong.low:g} to {wrong.high:g}"
    elif wrong.box >= FIRST_CONE:
        part, where = config.cartesian.cones[wrong.box - FIRST_CONE].name, "cartesian.cones"
        allowed = f"{wrong.low:g} to {wrong.high:g}"
    else:
        part = "box" if wrong.box < 0 else config.cartesian.keep_out[wrong.box].name
        where = "cartesian.box" if wrong.box < 0 else "cartesian.keep_out"
        allowed = f"at least {wrong.low:g}" if wrong.high == inf else f"at most {wrong.high:g}"
    text = f"{part}.{name}: found {wrong.found:g}, allowed is"
    if wrong.no_room:
        return f"{text} less than {part}.{name.replace('min', 'max')}, which is {wrong.high:g}"
    widenable, file = wrong.name in WIDENABLE, config.source.name
    if widen and widenable:
        return f"{text} {allowed} ({where}.absolute in {file})"
    but = ", except with --widen up to its key absolute" if widenable else ""
    return f"{text} {allowed} ({where} in {file}: this limit is only narrowed while running{but})"


def _lists(config: ArmConfig, values: Values) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return limits as mutable lists: of the joints by attribute, of the boxes by name, the inner one first."""
    boxes = {} if values.box is None else {"box": list(values.box)}
    named = zip((box.name for box in config.cartesian.keep_out), values.keep_out, strict=True)
    boxes |= {name: list(corners) for name, corners in named}
    return {name: list(getattr(values, name)) for name in FIELDS}, boxes


def _example(config: ArmConfig) -> str:
    keys = ", ".join(_JOINT_KEYS)
    joints = f"{config.joints[0].name}.KEY or {ALL}.KEY (KEY: {keys})"
    boxes = [*_lists(config, Values.configured(config))[1]]
    cones = [cone.name for cone in config.cartesian.cones]
    text = f"{joints} and {boxes[-1]}.min.x (boxes: {', '.join(boxes)})" if boxes else joints
    text += f", {cones[-1]}.angle (cones: {', '.join(cones)})" if cones else ""
    return f"{text}, supervision.KEY (KEY: {', '.join(SUPERVISION)})"


def _corners(six: list[float]) -> Corners:
    a, b, c, d, e, f = six
    return a, b, c, d, e, f


def _as_json(config: ArmConfig, values: Values) -> Json:
    boxes = zip((box.name for box in config.cartesian.keep_out), values.keep_out, strict=True)
    return {
        **{key: list(getattr(values, name)) for key, name in _JOINT_KEYS.items()},
        "box": None if values.box is None else _ends(values.box),
        "keep_out": {name: _ends(corners) for name, corners in boxes},
        "cones": {
            named.name: {"axis": named.axis, "direction": list(cone[1:4]), "angle": cone.angle}
            for named, cone in zip(config.cartesian.cones, values.cones, strict=True)
        },
        "supervision": dict(zip(SUPERVISION, values.supervision, strict=True)),
    }


def _ends(box: Corners) -> dict[str, list[float]]:
    return {"min": list(box[:3]), "max": list(box[3:])}


def _write(path: Path, values: Values, loop: int) -> None:
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps({"loop": loop, "values": dataclasses.asdict(values)}))
    fresh.replace(path)


def _read(path: Path, loop: int) -> Values | None:
    """Return the limits kept for this loop; None for those of an earlier loop."""
    try:
        kept = json.loads(path.read_text())
        if kept["loop"] != loop:
            return None
        values = kept["values"]
        box = None if values["box"] is None else _corners(values["box"])
        joints = {name: tuple(values[name]) for name in FIELDS}
        keep_out = tuple(_corners(corners) for corners in values["keep_out"])
        cones, (speed, torque, error) = tuple(Cone(*cone) for cone in values["cones"]), values["supervision"]
        return Values(**joints, box=box, keep_out=keep_out, cones=cones, supervision=(speed, torque, error))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
