"""`rtcp enable`, `disable`, `reset`, `mode`, `move`, `output`: what sets the arm in motion and stops it."""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from rtcp.cli.connection import ask, connect
from rtcp.cli.outcome import CommandError, ExitCode, interruption_code, orderly_signals
from rtcp.cli.output import console, report
from rtcp.runtime.client import ControlClient

NUMBERS_AS_WRITTEN = {"ignore_unknown_options": True}
"""Lets `-0.5` through to the arguments; `refuse_options` then finds the misspelt options among them."""

_LOOKS_LIKE_A_NUMBER = re.compile(r"-(\d|\.\d|inf|nan)", re.IGNORECASE)

SILENCE_S = 10.0
"""A move that says nothing for so long is given up; progress comes several times a second."""


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    for command in (_enable, _disable, _reset, _mode, _output):
        app.command(command.__name__[1:])(command)
    app.command("move", context_settings=NUMBERS_AS_WRITTEN)(_move)


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
            number = float(value)
        except ValueError:
            wrong.append(f"joint {joint}: {value!r} is not a number (rad)")
            continue
        if not math.isfinite(number):
            wrong.append(f"joint {joint}: {value} is not finite; a position is a finite number of rad")
        numbers.append(number)
    if wrong:
        raise CommandError("\n".join(wrong))
    return numbers


def _enable() -> None:
    """Enable the drives; the arm holds where it is."""
    ask("enable", "enable")
    report("enabled: the drives hold the arm where it is")


def _disable() -> None:
    """Disable the drives."""
    ask("disable", "disable")
    report("disabled: the drives are without torque")


def _reset() -> None:
    """Reset a fault; enabling is a step of its own."""
    with connect("reset") as client:
        client.call("reset")
        holds = client.call("status").get("state") == "holding"
    # A reset leaves the arm without torque: one that holds had nothing to reset.
    report(
        "nothing to reset: the arm is enabled and holds" if holds else "reset: no fault is left; `rtcp enable` goes on"
    )


def _mode(name: Annotated[str, typer.Argument(metavar="NAME", help="csp, csv or cst.")]) -> None:
    """Choose the drives' mode."""
    ask("mode", "mode", {"name": name.lower()})
    report(f"mode {name.lower()}")


def _output(
    number: Annotated[int, typer.Argument(metavar="N", help="Output of the IO box, from 1.")],
    value: Annotated[str, typer.Argument(metavar="on|off")],
) -> None:
    """Switch a digital output of the IO box."""
    switched = {"on": True, "1": True, "off": False, "0": False}.get(value.lower())
    if switched is None:
        raise CommandError(f"{value!r} is no state of an output: on or off")
    ask("output", "output", {"number": number, "value": switched})
    report(f"output {number} is {'on' if switched else 'off'}")


def _move(
    positions: Annotated[list[str], typer.Argument(metavar="Q1..Q6", help="Joint positions, rad, base to tool.")],
    speed: Annotated[
        float | None, typer.Option("--speed", help="Speed limit of the fastest joint, rad/s; configured if absent.")
    ] = None,
) -> None:
    """Move the joints and return when they are there; Ctrl-C stops the arm."""
    refuse_options(positions, ("--speed", "--help", "-h"))
    target = joint_values(positions)
    if speed is not None and not (math.isfinite(speed) and speed > 0):
        raise CommandError(f"--speed {speed:g} is not allowed: a finite number of rad/s above 0")
    with orderly_signals(), connect("move") as client:
        _same_number(target, client.call("status"))
        try:
            with _progress() as follow:
                result = move(client, target, speed, follow)
        except KeyboardInterrupt as interruption:
            client.close()
            raise CommandError(
                "interrupted: the connection is closed, so the arm comes to a controlled stop",
                interruption_code(interruption),
            ) from None
    report(arrival(result))


def move(
    client: ControlClient,
    target: Sequence[float],
    speed: float | None,
    follow: Callable[[Mapping[str, Any]], None],
) -> dict[str, Any]:
    """Move to `target`, rad, over an open connection and return the result once the joints are there.

    Raises:
        ControlError: as the platform ended the move.
    """
    return client.call("move", {"q": list(target), "speed": speed}, follow, timeout_s=SILENCE_S)


def arrival(result: Mapping[str, Any]) -> str:
    """Return the sentence on a finished move, with the largest error of a joint where it is known."""
    error = result.get("error")
    return f"there, largest error {error:.6f} rad" if isinstance(error, int | float) else "there"


def _same_number(target: Sequence[float], status: Mapping[str, Any]) -> None:
    joints = status.get("joints")
    positions = joints.get("position") if isinstance(joints, dict) else None
    if isinstance(positions, list) and positions and len(positions) != len(target):
        raise CommandError(
            f"{len(target)} positions for an arm of {len(positions)} joints: give {len(positions)} numbers, rad",
            ExitCode.USAGE,
        )


@contextmanager
def _progress() -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Give a function that shows progress: a bar on a terminal, a line every tenth of the way elsewhere."""
    if not sys.stdout.isatty():
        yield _line_reporter()
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (TextColumn("moving"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"))
    with Progress(*columns, console=console()) as bar:
        task = bar.add_task("move", total=1.0, left="")

        def follow(progress: Mapping[str, Any]) -> None:
            bar.update(task, completed=_fraction(progress), left=_remaining(progress))

        yield follow
        bar.update(task, completed=1.0, left="")


def _line_reporter() -> Callable[[Mapping[str, Any]], None]:
    shown = -1

    def follow(progress: Mapping[str, Any]) -> None:
        nonlocal shown
        tenth = int(_fraction(progress) * 10)
        if tenth > shown:
            shown = tenth
            report(f"moving: {_fraction(progress):4.0%} {_remaining(progress)}".rstrip())

    return follow


def _fraction(progress: Mapping[str, Any]) -> float:
    value = progress.get("fraction")
    return min(1.0, max(0.0, float(value))) if isinstance(value, int | float) else 0.0


def _remaining(progress: Mapping[str, Any]) -> str:
    value = progress.get("remaining_s")
    return f"{value:.1f} s left" if isinstance(value, int | float) else ""
