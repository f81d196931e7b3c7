"""Options and arguments that several commands share, and parsing of numbers, also negative ones."""

from __future__ import annotations

import difflib
import ipaddress
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.cli.output import CommandError
from rtcp.config.cell import is_platform_name
from rtcp.config.numbers import angle, plain_number


def option(name: str, metavar_or_help: str = "", help: str = "") -> Any:
    """Declare an option: its name, for all but switches and plain numbers its metavar, and its help."""
    if not help:
        return typer.Option(name, help=metavar_or_help)
    return typer.Option(name, metavar=metavar_or_help or None, help=help)


def choose_platform(name: str | None) -> None:
    """Let this process start or reach the platform with this name; None: the one of the environment.

    Raises:
        CommandError: no platform may have this name.
    """
    chosen = os.environ.get("RTCP_NAME", "") if name is None else name
    if (chosen or name) and not is_platform_name(chosen):
        raise CommandError(f'--name: found the text "{chosen}", allowed is a letter, then letters, digits, - and _')
    if chosen:
        os.environ["RTCP_NAME"] = chosen


def as_written(metavar: str, help: str = "") -> Any:
    """Declare an argument of a command with `NUMBERS_AS_WRITTEN`; an option that was misspelt is refused there."""
    return typer.Argument(metavar=metavar, help=help, callback=_refuse_options)


def _refuse_options(context: typer.Context, values: Any) -> Any:
    """Refuse an option that was passed among numbers.

    Raises:
        CommandError: names the option and the command's own that is nearest.
    """
    options = [name for parameter in context.command.params for name in parameter.opts if name.startswith("-")]
    known = [*options, *context.help_option_names]
    for value in [values] if isinstance(values, str) else values or ():
        if not value.startswith("-") or _NUMBER.match(value):
            continue
        option = value.split("=", 1)[0]
        if option in known:
            raise CommandError(f"{option} is after --, which ends the options: put it before --")
        if option in RENAMED_OPTIONS:
            raise CommandError(f"{option} is now {RENAMED_OPTIONS[option]}")
        near = difflib.get_close_matches(option, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
        raise CommandError(f"no such option: {option} ({hint})")
    return values


ConfigFile = Annotated[
    Path | None, option("--config", "FILE", "File of the arm. Default: $RTCP_CONFIG, /etc/rtcp, the packaged one.")
]
BusName = Annotated[
    str | None,
    option("--bus", "virtual|NAME", "virtual, or a network interface. Default: the running one's, the configured one."),
]
PlatformName = Annotated[
    str | None, option("--name", "NAME", "Name of the platform, as of an arm of a cell. Default: $RTCP_NAME, none.")
]
Poll = Annotated[bool, option("--poll", "The virtual segment polls: it answers faster and keeps one CPU busy.")]
AsJson = Annotated[bool, option("--json", "Print JSON, SI units.")]

NUMBERS_AS_WRITTEN = {"ignore_unknown_options": True}
"""Passes `-0.5` through to the arguments, which are declared by `as_written`."""
JOINTS = 6
POSE = ("x", "y", "z", "rx", "ry", "rz")
PICTURES = (".png", ".svg", ".pdf")
RENAMED_OPTIONS = {"--each": "--unsynchronized"}
"""Options of version 0.1 -> their successors."""
_NUMBER = re.compile(r"-(\d|\.\d|inf|nan|pi(/|$))", re.IGNORECASE)


def refuse_old_name(app: typer.Typer, old: str, new: str) -> None:
    """Answer a command's name of version 0.1 with its new one; exit code 2."""

    def refuse() -> None:
        raise CommandError(f"{old} is now `{new}`")

    app.command(old, hidden=True, context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(refuse)


def joint_values(values: Sequence[str], option: str = "") -> list[float]:
    """Return joint positions, rad; fractions of pi are accepted.

    Raises:
        CommandError: names each joint whose value is not a finite number.
    """
    return _numbers(values, [(f"{option}joint {joint}", "rad") for joint in range(1, len(values) + 1)])


def pose_values(values: Sequence[str]) -> list[float]:
    """Return a tool pose: x, y, z in m and rx, ry, rz in rad; fractions of pi are accepted for angles.

    Raises:
        CommandError: names each value that is not a finite number, or the number of values.
    """
    if len(values) != len(POSE):
        raise CommandError(f"{len(values)} numbers for a pose of {len(POSE)}: give {' '.join(map(str.upper, POSE))}")
    return _numbers(values, [(name, "rad" if name.startswith("r") else "m") for name in POSE])


def number(value: str, name: str, unit: str = "") -> float:
    """Return a finite number.

    Raises:
        CommandError: names the value's meaning and unit.
    """
    return _numbers([value], [(name, unit)])[0]


def _numbers(values: Sequence[str], names: Sequence[tuple[str, str]]) -> list[float]:
    numbers, wrong = [], []
    for value, (name, unit) in zip(values, names, strict=True):
        try:
            parsed = plain_number(angle(value) if unit == "rad" else value)
        except ValueError:
            wrong.append(f"{name}: {value!r} is not a number" + (f" ({unit})" if unit else ""))
            continue
        if not math.isfinite(parsed):
            wrong.append(f"{name}: {value} is not finite; a finite number{f' of {unit}' if unit else ''} is needed")
        numbers.append(parsed)
    if wrong:
        raise CommandError("\n".join(wrong))
    return numbers


def finite(name: str, value: float, unit: str) -> None:
    """Refuse a value of an option that is not finite; raises CommandError."""
    if not math.isfinite(value):
        raise CommandError(f"{name} {value} is not allowed: a finite number of {unit}")


def positive(name: str, value: float | None, unit: str, most: float = math.inf) -> None:
    """Refuse a value that is not above 0, not finite, or above `most`; None is allowed.

    Raises:
        CommandError: names the option, the value and the allowed range.
    """
    if value is not None and not (math.isfinite(value) and 0 < value <= most):
        bound = "" if most == math.inf else f", at most {most:g}"
        raise CommandError(f"{name} {value:g} is not allowed: a finite number of {unit} above 0{bound}")


def check_picture(option: str, file: Path) -> None:
    """Refuse a picture file whose ending names no known format; raises CommandError."""
    if file.suffix.lower() not in PICTURES:
        raise CommandError(f"{option} {file}: the ending must be one of {', '.join(PICTURES)}")


def is_loopback(host: str) -> bool:
    """Return whether an address to listen at is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
