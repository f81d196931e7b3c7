"""`rtcp joystick`: a joystick in the terminal, or its positions by name, for the virtual IO box."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from rtcp.cli.arguments import positive, refuse_old_name
from rtcp.cli.connection import connect
from rtcp.cli.errors import SUSPENDING, CommandError, ExitCode, interruption_code, orderly_signals
from rtcp.cli.keys import ESCAPE, HeldKey, Keys
from rtcp.cli.output import emit, report
from rtcp.cli.renewal import Renewal
from rtcp.ipc.client import ControlClient

TURN_S = 0.08
HOLD_S = 0.4
"""So long inputs stay forced when nothing more is heard."""
PADDLE_S = 0.15
"""A tap on a paddle lasts so long: longer than its debounce."""
LONGEST_S = 3600.0
SHOWN_EVERY_S = 0.25

NAMES = {
    "forward": "forward",
    "backward": "backward",
    "left": "left",
    "right": "right",
    "up": "mode_up",
    "down": "mode_down",
    "chair": "chair",
    "estop": "emergency_stop",
    "enable": "enabling_switch",
}
"""Words of the command line -> inputs as the gateway names them."""

ARROWS = {"up": "forward", "down": "backward", "left": "left", "right": "right"}
PADDLES = {"+": "mode_up", "-": "mode_down"}
SWITCHES = {"t": "chair", "e": "emergency_stop"}
QUITS = ("q", ESCAPE, "\x04")


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("joystick")(_joystick)
    refuse_old_name(app, "stick", "rtcp joystick")


def _joystick(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[POSITION..]",
            help=f"{', '.join(NAMES)} (several at once are possible), byte N, or release; none: by keys.",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="N", help="How long, s; then it lets go.")] = 1.0,
) -> None:
    """Play the joystick of the virtual arm: arrows, + and - (paddles), t (toggle), e (emergency stop), q (end)."""
    positive("--seconds", seconds, "s", LONGEST_S)
    if not words:
        if not sys.stdin.isatty():
            raise CommandError(f"there is no terminal to play in: give a position, as {', '.join(NAMES)}, byte N")
        with connect("joystick") as client:
            _play(client)
        return
    pressed, byte = _position(words)
    try:
        with orderly_signals(*SUSPENDING), connect("joystick") as client:
            if words == ["release"]:
                _force(client, [], None, HOLD_S, time.monotonic())
            else:
                _hold(client, pressed, byte, seconds)
    except KeyboardInterrupt as interruption:
        raise CommandError("interrupted: the joystick is released", interruption_code(interruption)) from None
    report("the joystick is released")


def _position(words: Sequence[str]) -> tuple[list[str], int | None]:
    if words[0] == "byte":
        if len(words) != 2 or not (words[1].isascii() and words[1].isdecimal()) or not 0 <= int(words[1]) <= 255:
            raise CommandError(f"{' '.join(words)} is not allowed: one number from 0 to 255")
        return [], int(words[1])
    if list(words) == ["release"]:
        return [], None
    unknown = [word for word in words if word not in NAMES]
    if unknown:
        raise CommandError(f"{unknown[0]!r} is no position of the stick: {', '.join(NAMES)}, byte N or release")
    return [NAMES[word] for word in words], None


def _force(client: ControlClient, pressed: Sequence[str], byte: int | None, hold_s: float, now: float) -> None:
    client.call("stick", {"pressed": list(pressed), "byte": byte, "hold_s": hold_s, "t": now})


def _hold(client: ControlClient, pressed: Sequence[str], byte: int | None, seconds: float) -> None:
    until = time.monotonic() + seconds
    renewal = Renewal(HOLD_S)
    while (now := time.monotonic()) < until:
        if missed := renewal.missed(now):
            raise CommandError(
                f"the stick was not said again for {missed:.1f} s: it had been let go, and stays so", ExitCode.FAULT
            )
        _force(client, pressed, byte, HOLD_S, now)
        time.sleep(max(0.0, min(TURN_S, until - now)))


def _play(client: ControlClient) -> None:
    """Let the keys be the stick, until q."""
    report("arrows: the stick, while held; +, -: mode paddles; t: toggle arm or chair; e: emergency stop; q: end")
    key, renewal = HeldKey(), Renewal(HOLD_S)
    switched: set[str] = set()
    paddle, paddle_until, shown_at = "", 0.0, 0.0
    due = time.monotonic()
    with Keys() as keys:
        while True:
            pressed = keys.read(due - time.monotonic())
            now = time.monotonic()
            if pressed in QUITS:
                break
            if renewal.missed(now):
                # What was pressed while nobody looked must not move the arm now.
                key.release()
                pressed, paddle_until = "", now
                if not keys.drain().isdisjoint(QUITS):
                    break
            if pressed in ARROWS:
                key.press(pressed, now)
            elif pressed:
                key.release()
            if pressed in PADDLES:
                paddle, paddle_until = PADDLES[pressed], now + PADDLE_S
            elif pressed in SWITCHES:
                switched ^= {SWITCHES[pressed]}
            if now < due:
                continue
            due = now + TURN_S
            held = key.held(now)
            stick = [paddle] if now < paddle_until else [ARROWS[held]] if held else []
            _force(client, [*stick, *sorted(switched)], None, HOLD_S, now)
            if now - shown_at > SHOWN_EVERY_S:
                shown_at = now
                _show(client.call("status"), stick, switched)
    emit("")


def _show(status: dict[str, Any], stick: Sequence[str], switched: set[str]) -> None:
    mode = (status.get("stick") or {}).get("mode", "-")
    shown = " ".join([*stick, *sorted(switched)]) or "neutral"
    line = f"{status.get('state', '-')}, {status.get('motion', '-')}, {mode}: {shown}"
    sys.stdout.write(f"\r{line[:79]:79}")
    sys.stdout.flush()
