"""The limits in force: reported, changed as one transaction, and kept for the next gateway."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import Any

from rtcp.config.model import ArmConfig
from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.gateway.method import method
from rtcp.ipc.commands import SetLimits
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import limits_file
from rtcp.motion.limits import FIELDS, Corners, Limits, Values, WrongLimit, rows, wrong_limits

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
        """Return the `limits` in force beside those that are `configured`."""
        config = self._config
        return {
            "joint_names": [joint.name for joint in config.joints],
            "limits": _as_json(config, now(self._limits)),
            "configured": _as_json(config, self._limits.widest),
            "cartesian": {
                name: getattr(config.cartesian, name)
                for name in (
                    "speed", "acceleration", "jerk", "angular_speed", "angular_acceleration", "angular_jerk",
                )
            } | {"singularity": dataclasses.asdict(config.cartesian.singularity)},
        }  # fmt: skip

    @method()
    async def set_limits(self, caller: Caller, changes: dict[str, Any]) -> Json:
        """Narrow limits, all or none; keys as `joint2.max`, `joints.velocity`, `box.min.x`. Returns as `limits`."""
        new = changed(self._config, now(self._limits), changes)
        async with self._channel.lease(caller) as lease:
            plan = rows(new)
            slot = self._channel.observer.write_plan(plan)
            await self._channel.send(lease, SetLimits(slot, len(plan)))
            self._limits.apply(new)
            _write(self._file, new, self._channel.observer.loop_pid)
        return await self.limits(caller)


def now(limits: Limits) -> Values:
    """Return the limits in force."""
    joints = {name: tuple(getattr(limits, name)) for name in FIELDS}
    return Values(**joints, box=limits.box, keep_out=limits.keep_out)


def changed(config: ArmConfig, values: Values, changes: Mapping[str, float]) -> Values:
    """Return `values` with `changes`.

    Raises:
        RtcpError: `invalid`, naming each invalid key or number.
    """
    if not changes:
        raise RtcpError("invalid", f"changes: found none, give a key and a number, as {_example(config)}")
    widest = Values.configured(config)
    wrong, limits, new = [], [], values
    for key, number in changes.items():
        if type(number) not in (int, float) or not abs(number) <= sys.float_info.max:
            wrong.append(f"{key}: found {json.dumps(number)[:60]}, allowed is a finite number")
            continue
        try:
            new = _put(config, new, key, number)
        except KeyError:
            wrong.append(f"{key}: there is no such limit; allowed are {_example(config)}")
        # After each key, because a later one may replace its number, or make room for it.
        limits += [limit for limit in wrong_limits(widest, new) if not limit.no_room]
    limits += wrong_limits(widest, new)
    wrong += dict.fromkeys(_sentence(config, limit) for limit in limits)
    if wrong:
        raise RtcpError("invalid", "\n".join(wrong))
    return new


def _put(config: ArmConfig, values: Values, key: str, number: float) -> Values:
    """Return `values` with a finite number at a key; raises KeyError."""
    names = [joint.name for joint in config.joints]
    per_joint, boxes = _lists(config, values)
    head, _, rest = key.rpartition(".") if key.rpartition(".")[2] in _JOINT_KEYS else (key, "", "")
    which, _, end = head.rpartition(".")
    box, _, side = which.rpartition(".")
    if rest and (head in names or head == ALL):
        for joint in range(len(names)) if head == ALL else (names.index(head),):
            per_joint[_JOINT_KEYS[rest]][joint] = number
    elif box in boxes and side in _ENDS and end in ("x", "y", "z"):
        boxes[box][3 * _ENDS.index(side) + "xyz".index(end)] = number
    else:
        raise KeyError(key)
    joints = {name: tuple(numbers) for name, numbers in per_joint.items()}
    inner = _corners(boxes.pop("box")) if values.box is not None else None
    return Values(**joints, box=inner, keep_out=tuple(_corners(corners) for corners in boxes.values()))


def _sentence(config: ArmConfig, wrong: WrongLimit) -> str:
    """Return the message for a limit that cannot be set: its key, its value and the allowed range."""
    name = next((key for key, name in _JOINT_KEYS.items() if name == wrong.name), wrong.name)
    if wrong.axis >= 0:
        part, where = config.joints[wrong.axis].name, f"joints[{wrong.axis}]"
        allowed = f"{wrong.low:g} to {wrong.high:g}"
    else:
        part = "box" if wrong.box < 0 else config.cartesian.keep_out[wrong.box].name
        where = "cartesian.box" if wrong.box < 0 else "cartesian.keep_out"
        allowed = f"at least {wrong.low:g}" if wrong.high == inf else f"at most {wrong.high:g}"
    text = f"{part}.{name}: found {wrong.found:g}, allowed is"
    if wrong.no_room:
        return f"{text} less than {part}.{name.replace('min', 'max')}, which is {wrong.high:g}"
    return f"{text} {allowed} ({where} in {config.source.name}: limits are only narrowed while running)"


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
    return f"{joints} and {boxes[-1]}.min.x (boxes: {', '.join(boxes)})" if boxes else joints


def _corners(six: list[float]) -> Corners:
    a, b, c, d, e, f = six
    return a, b, c, d, e, f


def _as_json(config: ArmConfig, values: Values) -> Json:
    boxes = zip((box.name for box in config.cartesian.keep_out), values.keep_out, strict=True)
    return {
        **{key: list(getattr(values, name)) for key, name in _JOINT_KEYS.items()},
        "box": None if values.box is None else _ends(values.box),
        "keep_out": {name: _ends(corners) for name, corners in boxes},
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
        return Values(**joints, box=box, keep_out=tuple(_corners(corners) for corners in values["keep_out"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
