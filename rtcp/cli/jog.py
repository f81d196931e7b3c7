"""`rtcp jog` and `rtcp joystick`: motion while a key is held, or for a time; both renew a command that expires."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from rtcp.api import Robot, Status
from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, POSE, number, option, positive, refuse_old_name, refuse_options
from rtcp.cli.connection import connect, stoppable
from rtcp.cli.errors import SUSPENDING, CommandError, ExitCode, interruption_code, signals_raise
from rtcp.cli.keyboard import QUIT, HeldKey, Keyboard, RenewalCheck
from rtcp.cli.output import emit, report

JOG_INTERVAL_S, JOG_HOLD_S = 0.05, 0.25
"""Interval of jog commands, and how long one is valid: a client that stalls moves the arm no longer than that."""
JOYSTICK_INTERVAL_S, JOYSTICK_HOLD_S = 0.08, 0.4
"""The same of forced joystick inputs."""
PADDLE_S = 0.15
"""Length of a tap on a paddle: longer than its debounce time."""
LONGEST_JOG_S, LONGEST_JOYSTICK_S = 60.0, 3600.0
SHOW_INTERVAL_S = 0.25
BACKWARD = ("down", "left", "-")
_JOINT = re.compile(r"joint([1-9]\d?)")
Jog = Callable[[float, float], None]
"""Sends a jog: its direction, and the instant at which it was wanted, s of CLOCK_MONOTONIC."""

INPUTS = {
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
"""Words of the command line -> inputs of the IO box."""
ARROWS = {"up": "forward", "down": "backward", "left": "left", "right": "right"}
PADDLES = {"+": "mode_up", "-": "mode_down"}
SWITCHES = {"t": "chair", "e": "emergency_stop"}


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("jog", context_settings=NUMBERS_AS_WRITTEN)(_jog)
    app.command("joystick")(_joystick)
    refuse_old_name(app, "stick", "rtcp joystick")


# -- jog ------------------------------------------------------------------------------------------------------------


def _jog(
    axis: Annotated[str, typer.Argument(metavar="AXIS", help="x, y, z, rx, ry, rz of the tool; joint1 .. joint6.")],
    speed: Annotated[str, typer.Argument(metavar="SPEED", help="m/s; rad/s of rotations and joints; may be negative.")],
    frame: Annotated[str, option("--frame", "base|tool", "Frame of x, y, z.")] = "base",
    seconds: Annotated[float | None, option("--seconds", "N", "Move for N seconds, without keys.")] = None,
) -> None:
    """Move while a key is held (down, left and - move backward, q ends); Ctrl-C stops the arm."""
    refuse_options([axis, speed], ("--frame", "--seconds"))
    at, of_joint = _axis(axis)
    wanted = number(speed, "SPEED", "rad/s" if of_joint or at >= 3 else "m/s")
    if wanted == 0:
        raise CommandError(f"SPEED {speed} is not allowed: a number other than 0")
    if frame not in ("base", "tool"):
        raise CommandError(f"--frame {frame} is not known: base or tool")
    positive("--seconds", seconds, "s", LONGEST_JOG_S)
    if seconds is None and not sys.stdin.isatty():
        raise CommandError("standard input is not a terminal, so no key can be held: give --seconds N")
    with stoppable("jog") as robot:
        count = len(robot.status().joint_names) if of_joint else len(POSE)
        if at >= count:
            raise CommandError(f"{axis} does not exist: joint1 to joint{count}")

        def jog(direction: float, now: float) -> None:
            speeds = [0.0] * count
            speeds[at] = direction * wanted
            robot.jog(speeds, "joints" if of_joint else frame, JOG_HOLD_S, now)

        if seconds is not None:
            _jog_for(robot, jog, seconds)
        else:
            report(f"hold a key to move {axis} at {wanted:g} (down, left or -: backward), q ends")
            _jog_by_keys(robot, jog)
        stopped = robot.status().positions
    report(f"stopped at {' '.join(f'{position:.4f}' for position in stopped)} rad")


def _axis(axis: str) -> tuple[int, bool]:
    """Return the index of an axis, from 0, and whether it is a joint."""
    name = axis.lower()
    if name in POSE:
        return POSE.index(name), False
    found = _JOINT.fullmatch(name)
    if found is None:
        raise CommandError(f"{axis!r} is not an axis: {', '.join(POSE)}, or joint1 to joint6")
    return int(found[1]) - 1, True


def _jog_for(robot: Robot, jog: Jog, seconds: float) -> None:
    until = time.monotonic() + seconds
    renewal = RenewalCheck(JOG_HOLD_S)
    while True:
        now = time.monotonic()
        if late_s := renewal.overdue(now):
            robot.halt()
            raise CommandError(
                f"the jog was not renewed for {late_s:.1f} s: the arm had stopped and stays stopped", ExitCode.FAULT
            )
        if now >= until:
            break
        jog(1.0, now)
        time.sleep(max(0.0, min(JOG_INTERVAL_S, until - now)))
    robot.halt()


def _jog_by_keys(robot: Robot, jog: Jog) -> None:
    key, renewal = HeldKey(), RenewalCheck(JOG_HOLD_S)
    moving = False
    due = time.monotonic()
    with Keyboard() as keyboard:
        while True:
            pressed = keyboard.read(due - time.monotonic())
            now = time.monotonic()
            if pressed in QUIT:
                break
            late_s = renewal.overdue(now)
            if late_s:
                report(f"the keyboard was not read for {late_s:.1f} s: keys pressed meanwhile are ignored")
                key.release()
            elif pressed:
                key.press(pressed, now)
            if now < due:
                continue
            due = now + JOG_INTERVAL_S
            if held := key.held(now):
                jog(-1.0 if held in BACKWARD else 1.0, now)
                moving = True
                continue
            if moving:
                robot.halt()
                moving = False
                renewal.overdue(time.monotonic())  # the halt's wait is not a stall
            elif not late_s:
                continue
            # A key that was pressed during the stall or the halt must not move the arm now.
            if not keyboard.drain().isdisjoint(QUIT):
                break
    if moving:
        robot.halt()


# -- joystick -------------------------------------------------------------------------------------------------------


def _joystick(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[POSITION..]",
            help=f"{', '.join(INPUTS)} (one or more), byte N, or release. Default: by keys.",
        ),
    ] = None,
    seconds: Annotated[float, option("--seconds", "N", "Release after N seconds.")] = 1.0,
) -> None:
    """Operate the joystick of the virtual arm: arrows, + - (paddles), t (toggle), e (emergency stop), q (quit)."""
    positive("--seconds", seconds, "s", LONGEST_JOYSTICK_S)
    if not words:
        if not sys.stdin.isatty():
            raise CommandError(
                f"standard input is not a terminal: give a position, as {', '.join(INPUTS)}, byte N or release"
            )
        with connect("joystick") as robot:
            _force_by_keys(robot)
        return
    pressed, byte = _position(words)
    try:
        with signals_raise(*SUSPENDING), connect("joystick") as robot:
            if words == ["release"]:
                robot.joystick()
            else:
                _force_for(robot, pressed, byte, seconds)
    except KeyboardInterrupt as interruption:
        raise CommandError("interrupted: the joystick is released", interruption_code(interruption)) from None
    report("the joystick is released")


def _position(words: Sequence[str]) -> tuple[list[str], int | None]:
    """Return the inputs that are pressed, or the whole input byte."""
    if words[0] == "byte":
        if len(words) != 2 or not (words[1].isascii() and words[1].isdecimal()) or int(words[1]) > 255:
            raise CommandError(f"{' '.join(words)} is not allowed: one number from 0 to 255")
        return [], int(words[1])
    if list(words) == ["release"]:
        return [], None
    if unknown := [word for word in words if word not in INPUTS]:
        raise CommandError(f"{unknown[0]!r} is not a joystick position: {', '.join(INPUTS)}, byte N or release")
    return [INPUTS[word] for word in words], None


def _force(robot: Robot, pressed: Sequence[str], byte: int | None, now: float) -> None:
    robot.joystick(*pressed, byte=byte, hold_s=JOYSTICK_HOLD_S, sent_s=now)


def _force_for(robot: Robot, pressed: Sequence[str], byte: int | None, seconds: float) -> None:
    until = time.monotonic() + seconds
    renewal = RenewalCheck(JOYSTICK_HOLD_S)
    while (now := time.monotonic()) < until:
        if late_s := renewal.overdue(now):
            raise CommandError(
                f"the joystick was not renewed for {late_s:.1f} s: it was released and stays released", ExitCode.FAULT
            )
        _force(robot, pressed, byte, now)
        time.sleep(max(0.0, min(JOYSTICK_INTERVAL_S, until - now)))


def _force_by_keys(robot: Robot) -> None:
    report("arrows: the joystick, while held; +, -: mode paddles; t: arm or wheelchair; e: emergency stop; q: quit")
    key, renewal = HeldKey(), RenewalCheck(JOYSTICK_HOLD_S)
    switched: set[str] = set()
    paddle, paddle_until, shown_at = "", 0.0, 0.0
    due = time.monotonic()
    with Keyboard() as keyboard:
        while True:
            pressed = keyboard.read(due - time.monotonic())
            now = time.monotonic()
            if pressed in QUIT:
                break
            if renewal.overdue(now):
                # Keys pressed during the stall must not move the arm now.
                key.release()
                pressed, paddle_until = "", now
                if not keyboard.drain().isdisjoint(QUIT):
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
            due = now + JOYSTICK_INTERVAL_S
            held = key.held(now)
            inputs = [*([paddle] if now < paddle_until else [ARROWS[held]] if held else []), *sorted(switched)]
            _force(robot, inputs, None, now)
            if now - shown_at > SHOW_INTERVAL_S:
                shown_at = now
                _show(robot.status(), inputs)
    emit("")


def _show(status: Status, inputs: Sequence[str]) -> None:
    modes = f"{status.raw['control_mode']}, {status.raw['joystick']['mode']}"
    line = f"{status.raw['state']}, {modes}: {' '.join(inputs) or 'neutral'}"
    sys.stdout.write(f"\r{line[:79]:79}")
    sys.stdout.flush()
