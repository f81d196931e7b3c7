"""The limits in force, as the gateway knows them: shown, changed as one transaction, kept for the next gateway."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtcp.config.model import ArmConfig
from rtcp.motion.limits import Corners, Limits, Values, rows
from rtcp.runtime.carrier import Carrier, CommandFailed
from rtcp.runtime.machine import Command

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


class LimitKeeper:
    """Shows and changes the limits.

    Args:
        carrier: the way to the loop.
        limits: what is in force; changed here when the loop has taken it.
        directory: the runtime directory, where it is kept as long as the loop lives.
    """

    def __init__(self, carrier: Carrier, limits: Limits, directory: Path) -> None:
        self._carrier = carrier
        self._config = carrier.config
        self._limits = limits
        self._file = directory / "limits.json"
        if kept := _read(self._file, carrier.observer.loop_pid):
            limits.apply(kept)

    def show(self) -> dict[str, Any]:
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

    async def change(self, client: str, changes: Mapping[str, float]) -> dict[str, Any]:
        """Change limits, all or none; keys as `joint2.max`, `joints.velocity`, `box.min.x`, `user.max.z`."""
        new = changed(self._config, now(self._limits), changes)
        async with self._carrier.lease(client) as lease:
            plan = rows(new)
            slot = self._carrier.observer.write_plan(plan)
            await self._carrier.give(lease, Command.LIMITS, [slot, len(plan)])
            self._limits.apply(new)
            _write(self._file, new, self._carrier.observer.loop_pid)
        return self.show()


def now(limits: Limits) -> Values:
    """Return the limits in force."""
    joints = {name: tuple(getattr(limits, name)) for name in _JOINT_KEYS.values()}
    return Values(**joints, box=limits.box, keep_out=limits.keep_out)


def changed(config: ArmConfig, values: Values, changes: Mapping[str, float]) -> Values:
    """Return `values` with `changes`.

    Raises:
        CommandFailed: `invalid`, naming each key or number that is none.
    """
    if not changes:
        raise CommandFailed("invalid", f"no limit was named: give a key and a number, as {_example(config)}")
    per_joint = {name: list(getattr(values, name)) for name in _JOINT_KEYS.values()}
    boxes: dict[str, list[float]] = {} if values.box is None else {"box": list(values.box)}
    keep_out = [one.name for one in config.cartesian.keep_out]
    boxes |= {name: list(corners) for name, corners in zip(keep_out, values.keep_out, strict=True)}
    names = [joint.name for joint in config.joints]
    wrong = []
    for key, number in changes.items():
        if not math.isfinite(number):
            wrong.append(f"{key}: found {number}, allowed is a finite number")
            continue
        head, _, rest = key.rpartition(".") if key.rpartition(".")[2] in _JOINT_KEYS else (key, "", "")
        which, _, end = head.rpartition(".")
        box, _, side = which.rpartition(".")
        if rest and (head in names or head == ALL):
            numbers = per_joint[_JOINT_KEYS[rest]]
            for joint in range(len(names)) if head == ALL else (names.index(head),):
                numbers[joint] = number
        elif box in boxes and side in _ENDS and end in ("x", "y", "z"):
            boxes[box][3 * _ENDS.index(side) + "xyz".index(end)] = number
        else:
            wrong.append(f"{key}: there is no such limit; allowed are {_example(config)}")
    if wrong:
        raise CommandFailed("invalid", "\n".join(wrong))
    joints = {name: tuple(numbers) for name, numbers in per_joint.items()}
    inner = _corners(boxes["box"]) if "box" in boxes else None
    return Values(**joints, box=inner, keep_out=tuple(_corners(boxes[name]) for name in keep_out))


def _example(config: ArmConfig) -> str:
    keys = ", ".join(_JOINT_KEYS)
    boxes = ["box", *(one.name for one in config.cartesian.keep_out)]
    return f"{config.joints[0].name}.KEY or {ALL}.KEY (KEY: {keys}) and {boxes[-1]}.min.x (boxes: {', '.join(boxes)})"


def _corners(six: list[float]) -> Corners:
    a, b, c, d, e, f = six
    return a, b, c, d, e, f


def _shown(config: ArmConfig, values: Values) -> dict[str, Any]:
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
    except (OSError, ValueError, KeyError, TypeError):
        return None
