"""The limits in force, as the gateway knows them: shown, changed as one transaction, kept for the next gateway."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from rtcp.config.model import ArmConfig
from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.ipc.commands import SetLimits
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import limits_file
from rtcp.motion.limits import LEAST_PART, Corners, Limits, Values, rows

_JOINT_KEYS = {
    "min": "low",
    "max": "high",
    "velocity": "velocity",
    "acceleration": "acceleration",
    "jerk": "jerk",
    "torque": "torque",
}
_ENDS = ("min", "max")
ALL = "joints"
"""Stands for every joint in a key."""


class LimitSettings:
    """Shows and changes the limits.

    Args:
        channel: the way to the loop.
        limits: in force; changed here when the loop has accepted the change.
        directory: the runtime directory, where they are kept as long as the loop lives.
    """

    def __init__(self, channel: CommandChannel, limits: Limits, directory: Path) -> None:
        self._channel = channel
        self._config = channel.config
        self._limits = limits
        self._file = limits_file(directory)
        if kept := _read(self._file, channel.observer.loop_pid):
            limits.apply(kept)

    def show(self) -> Json:
        """Return what is in force beside what is configured."""
        config = self._config
        return {
            "joint_names": [joint.name for joint in config.joints],
            "limits": _shown(config, now(self._limits)),
            "configured": _shown(config, self._limits.widest),
            "cartesian": {
                name: getattr(config.cartesian, name)
                for name in (
                    "speed", "acceleration", "jerk", "angular_speed", "angular_acceleration", "angular_jerk",
                )
            } | {"singularity": dataclasses.asdict(config.cartesian.singularity)},
        }  # fmt: skip

    async def change(self, caller: Caller, changes: Mapping[str, float]) -> Json:
        """Change limits, all or none; keys as `joint2.max`, `joints.velocity`, `box.min.x`, `user.max.z`."""
        new = changed(self._config, now(self._limits), changes)
        async with self._channel.lease(caller) as lease:
            plan = rows(new)
            slot = self._channel.observer.write_plan(plan)
            await self._channel.send(lease, SetLimits(slot, len(plan)))
            self._limits.apply(new)
            _write(self._file, new, self._channel.observer.loop_pid)
        return self.show()


def now(limits: Limits) -> Values:
    """Return the limits in force."""
    joints = {name: tuple(getattr(limits, name)) for name in _JOINT_KEYS.values()}
    return Values(**joints, box=limits.box, keep_out=limits.keep_out)


def changed(config: ArmConfig, values: Values, changes: Mapping[str, float]) -> Values:
    """Return `values` with `changes`.

    Raises:
        RtcpError: `invalid`, naming each key or number that is none.
    """
    if not changes:
        raise RtcpError("invalid", f"changes: found none, give a key and a number, as {_example(config)}")
    names = [joint.name for joint in config.joints]
    per_joint, boxes = _lists(config, values)
    wrong = []
    for key, number in changes.items():
        if type(number) not in (int, float) or not abs(number) <= sys.float_info.max:
            wrong.append(f"{key}: found {json.dumps(number)[:60]}, allowed is a finite number")
            continue
        head, _, rest = key.rpartition(".") if key.rpartition(".")[2] in _JOINT_KEYS else (key, "", "")
        which, _, end = head.rpartition(".")
        box, _, side = which.rpartition(".")
        if rest and (head in names or head == ALL):
            numbers = per_joint[_JOINT_KEYS[rest]]
            for joint in range(len(names)) if head == ALL else (names.index(head),):
                numbers[joint] = number
                wrong += _joint_beyond(config, joint, rest, number)
        elif box in boxes and side in _ENDS and end in ("x", "y", "z"):
            boxes[box][3 * _ENDS.index(side) + "xyz".index(end)] = number
            wrong += _corner_beyond(config, box, side, end, number)
        else:
            wrong.append(f"{key}: there is no such limit; allowed are {_example(config)}")
    if wrong := wrong or [*_empty(names, per_joint, boxes)]:
        raise RtcpError("invalid", "\n".join(wrong))
    joints = {name: tuple(numbers) for name, numbers in per_joint.items()}
    inner = _corners(boxes.pop("box")) if values.box is not None else None
    return Values(**joints, box=inner, keep_out=tuple(_corners(corners) for corners in boxes.values()))


def _lists(config: ArmConfig, values: Values) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return limits as lists to change: of the joints by attribute, of the boxes by name, the inner one first."""
    boxes = {} if values.box is None else {"box": list(values.box)}
    named = zip((one.name for one in config.cartesian.keep_out), values.keep_out, strict=True)
    boxes |= {name: list(corners) for name, corners in named}
    return {name: list(getattr(values, name)) for name in _JOINT_KEYS.values()}, boxes


def _joint_beyond(config: ArmConfig, joint: int, key: str, number: float) -> Iterator[str]:
    """Say where a joint's limit is wider than the configuration's, or too narrow to be one."""
    widest = Values.configured(config)
    low, high = widest.low[joint], widest.high[joint]
    if key not in _ENDS:
        high = getattr(widest, _JOINT_KEYS[key])[joint]
        low = LEAST_PART * high
    if not low <= number <= high:
        yield (
            f"{config.joints[joint].name}.{key}: found {number:g}, allowed is {low:g} to {high:g} "
            f"(joints[{joint}] in {config.source.name}: limits are only narrowed while running)"
        )


def _corner_beyond(config: ArmConfig, box: str, side: str, end: str, number: float) -> Iterator[str]:
    """Say where a box allows more than the configuration's."""
    widest = _lists(config, Values.configured(config))[1][box]
    bound = widest[3 * _ENDS.index(side) + "xyz".index(end)]
    at_least = (side == "min") is (box == "box")
    if number < bound if at_least else number > bound:
        where = "cartesian.box" if box == "box" else "cartesian.keep_out"
        yield (
            f"{box}.{side}.{end}: found {number:g}, allowed is at {'least' if at_least else 'most'} {bound:g} "
            f"({where} in {config.source.name}: limits are only narrowed while running)"
        )


def _empty(names: list[str], joints: Mapping[str, list[float]], boxes: Mapping[str, list[float]]) -> Iterator[str]:
    """Say which ranges and boxes have no room between their ends."""
    ends = zip(names, joints["low"], joints["high"], strict=True)
    ranges = [(name, "", low, high) for name, low, high in ends]
    for name, six in boxes.items():
        ranges += [(name, f".{axis}", low, high) for axis, low, high in zip("xyz", six[:3], six[3:], strict=True)]
    for name, axis, low, high in ranges:
        if not low < high:
            yield f"{name}.min{axis}: found {low:g}, allowed is less than {name}.max{axis}, which is {high:g}"


def _example(config: ArmConfig) -> str:
    keys = ", ".join(_JOINT_KEYS)
    joints = f"{config.joints[0].name}.KEY or {ALL}.KEY (KEY: {keys})"
    boxes = [*_lists(config, Values.configured(config))[1]]
    return f"{joints} and {boxes[-1]}.min.x (boxes: {', '.join(boxes)})" if boxes else joints


def _corners(six: list[float]) -> Corners:
    a, b, c, d, e, f = six
    return a, b, c, d, e, f


def _shown(config: ArmConfig, values: Values) -> Json:
    boxes = zip((one.name for one in config.cartesian.keep_out), values.keep_out, strict=True)
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
    """Return what was kept for this loop; the limits of an earlier one are over with it."""
    try:
        kept = json.loads(path.read_text())
        if kept["loop"] != loop:
            return None
        values = kept["values"]
        box = None if values["box"] is None else _corners(values["box"])
        joints = {name: tuple(values[name]) for name in _JOINT_KEYS.values()}
        return Values(**joints, box=box, keep_out=tuple(_corners(one) for one in values["keep_out"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
