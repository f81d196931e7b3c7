"""`rtcp jog`: the tool or a joint moves while a key is held, or for a time."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Callable
from typing import Annotated

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, positive, refuse_options
from rtcp.cli.connection import connect
from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.keys import ESCAPE, HeldKey, Keys
from rtcp.cli.output import report
from rtcp.cli.progress import stopping
from rtcp.cli.renewal import Renewal
from rtcp.config.plain_number import plain_number
from rtcp.ipc.client import ControlClient

AXES = ("x", "y", "z", "rx", "ry", "rz")
TURN_S = 0.05
"""So often a jog is said again."""
HOLD_S = 0.25
"""So long it counts: a client that is stopped or cut off moves the arm no longer than that, and never again."""
LONGEST_S = 60.0
BACKWARDS = ("down", "left", "-")
QUITS = ("q", ESCAPE, "\x04")
_JOINT = re.compile(r"joint([1-9]\d?)")
Say = Callable[[float, float], None]
"""Says the jog: its direction, and when that was wanted, s of CLOCK_MONOTONIC."""


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("jog", context_settings=NUMBERS_AS_WRITTEN)(_jog)


def _jog(
    axis: Annotated[str, typer.Argument(metavar="AXIS", help="x, y, z, rx, ry, rz of the tool; joint1 .. joint6.")],
    speed: Annotated[
        str, typer.Argument(metavar="SPEED", help="m/s; rad/s of a turn or a joint; negative: the other way.")
    ],
    frame: Annotated[str, typer.Option("--frame", metavar="base|tool", help="Whose x, y, z they are.")] = "base",
    seconds: Annotated[
        float | None, typer.Option("--seconds", metavar="N", help="Move for so long, s, without keys.")
    ] = None,
) -> None:
    """Move while a key is held (down, left or - : the other way; q ends); Ctrl-C stops the arm."""  # fmt: skip
    refuse_options([axis, speed], ("--frame", "--seconds", "--help", "-h"))
    at, joints = _axis(axis)
    wanted = _speed(speed, joints or at >= 3)
    if frame not in ("base", "tool"):
        raise CommandError(f"--frame {frame} is not known: base or tool")
    positive("--seconds", seconds, "s", LONGEST_S)
    if seconds is None and not sys.stdin.isatty():
        raise CommandError("there is no terminal whose keys could be held: give --seconds N")
    with stopping(client := connect("jog")):
        count = len(client.call("status").get("joint_names") or AXES) if joints else len(AXES)
        if at >= count:
            raise CommandError(f"{axis} does not exist: joint1 to joint{count}")

        def say(direction: float, now: float) -> None:
            speeds = [0.0] * count
            speeds[at] = direction * wanted
            arguments = {"v": speeds, "frame": "joints" if joints else frame, "hold_s": HOLD_S, "t": now}
            client.call("jog", arguments)

        if seconds is not None:
            _for_a_time(client, say, seconds)
        else:
            report(f"hold a key to move {axis} at {wanted:g} (down, left or -: the other way), q ends")
            _while_held(client, say)
        _show_end(client)


def _for_a_time(client: ControlClient, say: Say, seconds: float) -> None:
    until = time.monotonic() + seconds
    renewal = Renewal(HOLD_S)
    while True:
        now = time.monotonic()
        if missed := renewal.missed(now):
            client.call("halt")
            raise CommandError(
                f"the jog was not said again for {missed:.1f} s: the arm had stopped, and stays so", ExitCode.FAULT
            )
        if now >= until:
            break
        say(1.0, now)
        time.sleep(max(0.0, min(TURN_S, until - now)))
    client.call("halt")


def _while_held(client: ControlClient, say: Say) -> None:
    key = HeldKey()
    renewal = Renewal(HOLD_S)
    moves = False
    due = time.monotonic()
    with Keys() as keys:
        while True:
            pressed = keys.read(due - time.monotonic())
            now = time.monotonic()
            if pressed in QUITS:
                break
            missed = renewal.missed(now)
            if missed:
                report(f"the keys were not looked at for {missed:.1f} s: what was pressed meanwhile does not count")
                key.release()
            elif pressed:
                key.press(pressed, now)
            if now < due:
                continue
            due = now + TURN_S
            held = key.held(now)
            if held:
                say(-1.0 if held in BACKWARDS else 1.0, now)
                moves = True
                continue
            if moves:
                client.call("halt")
                moves = False
                renewal.missed(time.monotonic())  # the halt's wait is no silence
            elif not missed:
                continue
            # A key that was pressed while nobody looked, be it during the halt, must not move the arm now.
            if not keys.drain().isdisjoint(QUITS):
                break
    if moves:
        client.call("halt")


def _show_end(client: ControlClient) -> None:
    joints = client.call("status").get("joints") or {}
    shown = " ".join(f"{value:.4f}" for value in joints.get("position") or ())
    report(f"stopped at {shown} rad")


def _axis(axis: str) -> tuple[int, bool]:
    """Return the place of an axis, from 0, and whether it is a joint's."""
    name = axis.lower()
    if name in AXES:
        return AXES.index(name), False
    found = _JOINT.fullmatch(name)
    if found is None:
        raise CommandError(f"{axis!r} is no axis: {', '.join(AXES)}, or joint1 to joint6")
    return int(found[1]) - 1, True


def _speed(speed: str, turns: bool) -> float:
    unit = "rad/s" if turns else "m/s"
    try:
        found = plain_number(speed)
    except ValueError:
        raise CommandError(f"{speed!r} is not a number ({unit})") from None
    if not math.isfinite(found) or found == 0:
        raise CommandError(f"speed {speed} is not allowed: a finite number of {unit}, not 0")
    return found
