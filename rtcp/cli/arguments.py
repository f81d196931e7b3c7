"""Numbers on the command line: negative ones among options, joint positions, poses."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence

import typer

from rtcp.cli.errors import CommandError
from rtcp.config.plain_number import plain_number

NUMBERS_AS_WRITTEN = {"ignore_unknown_options": True}
"""Lets `-0.5` through to the arguments; `refuse_options` then finds the misspelt options among them."""

POSE = ("x", "y", "z", "rx", "ry", "rz")

RENAMED_OPTIONS = {"--each": "--unsynchronized"}
"""Options of version 0.1 -> their successors."""

_LOOKS_LIKE_A_NUMBER = re.compile(r"-(\d|\.\d|inf|nan)", re.IGNORECASE)


def refuse_old_name(app: typer.Typer, old: str, new: str) -> None:
    """Answer a command's name of version 0.1 with its new one; exit code 2."""

    def refuse() -> None:
        raise CommandError(f"{old} is now `{new}`")

    app.command(old, hidden=True, context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(refuse)


def refuse_options(values: Sequence[str], known: Sequence[str]) -> None:
    """Refuse what stands among numbers and was meant as an option.

    Raises:
        CommandError: naming the option and the known one that is nearest.
    """
    for value in values:
        if value.startswith("-") and not _LOOKS_LIKE_A_NUMBER.match(value):
            option = value.split("=", 1)[0]
            if option in known:
                raise CommandError(f"{option} stands behind --, which ends the options: write it before")
            if option in RENAMED_OPTIONS:
                raise CommandError(f"{option} is now {RENAMED_OPTIONS[option]}")
            near = difflib.get_close_matches(option, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
            raise CommandError(f"no such option: {option} ({hint})")


def joint_values(values: Sequence[str]) -> list[float]:
    """Return joint positions, rad, as numbers.

    Raises:
        CommandError: naming each joint whose value is not a finite number.
    """
    numbers, wrong = [], []
    for joint, value in enumerate(values, 1):
        try:
            number = plain_number(value)
        except ValueError:
            wrong.append(f"joint {joint}: {value!r} is not a number (rad)")
            continue
        if not math.isfinite(number):
            wrong.append(f"joint {joint}: {value} is not finite; a position is a finite number of rad")
        numbers.append(number)
    if wrong:
        raise CommandError("\n".join(wrong))
    return numbers


def pose_values(values: Sequence[str]) -> list[float]:
    """Return a tool pose: x, y, z in m and rx, ry, rz in rad, or as -pi/2.

    Raises:
        CommandError: naming each number that is none, or how many were given.
    """
    from rtcp.config.geometry import angle

    if len(values) != len(POSE):
        raise CommandError(f"{len(values)} numbers for a pose of {len(POSE)}: give {' '.join(map(str.upper, POSE))}")
    numbers, wrong = [], []
    for name, value in zip(POSE, values, strict=True):
        unit = "rad" if name.startswith("r") else "m"
        try:
            number = plain_number(angle(value) if unit == "rad" else value)
        except ValueError:
            wrong.append(f"{name}: {value!r} is not a number ({unit})")
            continue
        if not math.isfinite(number):
            wrong.append(f"{name}: {value} is not finite; a finite number of {unit} is needed")
        numbers.append(number)
    if wrong:
        raise CommandError("\n".join(wrong))
    return numbers


def positive(option: str, value: float | None, unit: str, most: float = math.inf) -> None:
    """Refuse a value of an option that is not above 0, not finite, or above `most`; None is none.

    Raises:
        CommandError: naming the option, the value and what is allowed.
    """
    if value is not None and not (math.isfinite(value) and 0 < value <= most):
        bound = "" if most == math.inf else f", at most {most:g}"
        raise CommandError(f"{option} {value:g} is not allowed: a finite number of {unit} above 0{bound}")
