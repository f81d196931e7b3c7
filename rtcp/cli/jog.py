"""`rtcp jog` and `rtcp joystick`: motion while a key is held, or for a time; both renew a command that expires.

A terminal reports presses of keys and no releases: a held key shows only by its repetition.
"""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated

import typer

from rtcp.api import ControlMode, Robot, State, Status
from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, POSE, as_written, number, option, positive, refuse_old_name
from rtcp.cli.output import SUSPENDING, CommandError, ExitCode, emit, interruptible, report
from rtcp.cli.platform import connect, stoppable

JOG_INTERVAL_S, JOG_HOLD_S = 0.05, 0.25
"""Interval of jog commands, and how long one is valid: a client that stalls moves the arm no longer than that."""
JOYSTICK_INTERVAL_S, JOYSTICK_HOLD_S = 0.08, 0.4
"""The same for forced joystick inputs."""
PADDLE_S = 0.15
"""Length of a tap on a paddle: longer than its debounce time."""
LONGEST_JOG_S, LONGEST_JOYSTICK_S = 60.0, 3600.0
LONGEST_STOP_S = 10.0
"""Longest wait for an arm that the joystick moved, s."""
SHOW_INTERVAL_S = 0.25
BACKWARD = ("down", "left", "-")
_JOINT = re.compile(r"joint([1-9]\d?)")
_BYTE = re.compile(r"[0-9]{1,5}")
Jog = Callable[[float, float], None]
"""Sends a jog command: direction, 1 or -1, and the instant of the key or renewal, s of CLOCK_MONOTONIC."""

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
REPEATS_WITHIN_S = 1.0
"""Longest time to a keyboard's first repetition (250 to 660 ms is usual)."""
RELEASED_AFTER_S = 0.2
"""A key without another repetition for this long is released."""
ESCAPE = "escape"
QUIT = frozenset({"q", ESCAPE, "\x04"})
_ESCAPE_S = 0.02
_ARROWS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}
_SEQUENCES = {start + end: name for start in (b"\x1b[", b"\x1bO") for end, name in _ARROWS.items()}

commands = typer.Typer()
refuse_old_name(commands, "stick", "rtcp joystick")


# -- the keyboard ---------------------------------------------------------------------------------------------------


class Keyboard:
    """The terminal on standard input, read key by key without echo; its settings are restored on exit."""

    def __init__(self) -> None:
        self._descriptor = sys.stdin.fileno()
        self._pending = b""

    def __enter__(self) -> Keyboard:
        self._settings = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._settings)

    def read(self, timeout_s: float) -> str:
        """Return the next key within `timeout_s`: a letter, the name of an arrow, `escape`; or an empty string.

        Raises:
            EOFError: the terminal was closed.
        """
        if not self._pending:
            if not select.select([self._descriptor], [], [], max(timeout_s, 0.0))[0]:
                return ""
            self._pending = os.read(self._descriptor, 256)
            if not self._pending:
                raise EOFError
        if self._pending == b"\x1b" and select.select([self._descriptor], [], [], _ESCAPE_S)[0]:
            self._pending += os.read(self._descriptor, 256)
        for sequence, name in _SEQUENCES.items():
            if self._pending.startswith(sequence):
                self._pending = self._pending[len(sequence) :]
                return name
        first, self._pending = self._pending[:1], self._pending[1:]
        if first == b"\x1b":
            self._pending = b""  # an unknown sequence is one key, not several letters
            return ESCAPE
        return first.decode("latin-1")

    def drain(self) -> set[str]:
        """Read and return all pending keys: those pressed during a stall, which the caller ignores."""
        typed = set()
        while key := self.read(0.0):
            typed.add(key)
        return typed


class HeldKey:
    """Detects by its repetition that a key is held.

    A key counts as held from its first repetition on. Otherwise a tap would move the arm until that is due, up to 1 s.
    """

    def __init__(self) -> None:
        self._key = ""
        self._last_s = float("-inf")
        self._repeats = False

    def press(self, key: str, now_s: float) -> None:
        """Register a key that arrived at `now_s`."""
        within_s = RELEASED_AFTER_S if self._repeats else REPEATS_WITHIN_S
        self._repeats = key == self._key and now_s - self._last_s <= within_s
        self._key, self._last_s = key, now_s

    def held(self, now_s: float) -> str:
        """Return the key that is held at `now_s`, or an empty string."""
        return self._key if self._repeats and now_s - self._last_s <= RELEASED_AFTER_S else ""

    def release(self) -> None:
        """Forget the key."""
        self._repeats = False
        self._key = ""


class RenewalCheck:
    """Detects that a command was not renewed in time, because its process was suspended or its host stalled.

    The arm has stopped by then and a person may have come near: the command must not continue.

    Args:
        hold_s: how long a command is valid, s.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._last_s: float | None = None

    def overdue(self, now_s: float) -> float:
        """Register a renewal at `now_s`; return the time since the last one, s, where it is too long, else 0.

        `now_s` is an instant before the command is sent, so that a stall during its answer is detected too.
        """
        passed_s = 0.0 if self._last_s is None else now_s - self._last_s
        self._last_s = now_s
        return passed_s if passed_s > self._hold_s else 0.0


# -- jog ------------------------------------------------------------------------------------------------------------


@commands.command("jog", context_settings=NUMBERS_AS_WRITTEN)
def _jog(
    axis: Annotated[str, as_written("AXIS", "x, y, z, rx, ry, rz of the tool; joint1 .. joint6.")],
    speed: Annotated[str, as_written("SPEED", "m/s; rad/s of rotations and joints; may be negative.")],
    frame: Annotated[str, option("--frame", "base|tool", "Frame of x, y, z.")] = "base",
    seconds: Annotated[float | None, option("--seconds", "N", "Move for N seconds, without keys.")] = None,
) -> None:
    """Move while a key is held (down, left and - move backward, q ends); Ctrl-C stops the arm."""
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

        reported: set[str] = set()
        due = time.monotonic() + SHOW_INTERVAL_S

        def jog(direction: float, now: float) -> None:
            nonlocal due
            speeds = [0.0] * count
            speeds[at] = direction * wanted
            robot.jog(speeds, "joints" if of_joint else frame, JOG_HOLD_S, now)
            if now > due:
                due = now + SHOW_INTERVAL_S
                limits = robot.status().raw["limited_by"]
                for name in limits.keys() - reported:
                    report(limits[name])
                reported.update(limits)

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
    match = _JOINT.fullmatch(name)
    if match is None:
        raise CommandError(f"{axis!r} is not an axis: {', '.join(POSE)}, or joint1 to joint6")
    return int(match[1]) - 1, True


def _jog_for(robot: Robot, jog: Jog, seconds: float) -> None:
    try:
        for now in _renewals("jog", JOG_INTERVAL_S, JOG_HOLD_S, seconds, "the arm had stopped and stays stopped"):
            jog(1.0, now)
    except CommandError:
        robot.halt()
        raise
    robot.halt()


def _renewals(command: str, interval_s: float, hold_s: float, seconds: float, lapsed: str) -> Iterator[float]:
    """Yield the instants, s of CLOCK_MONOTONIC, at which a command is renewed.

    Raises:
        CommandError: a renewal came too late; the message ends with `lapsed`, the state of the arm or joystick since.
    """
    until = time.monotonic() + seconds
    renewal = RenewalCheck(hold_s)
    while True:
        now = time.monotonic()
        if late_s := renewal.overdue(now):
            raise CommandError(f"the {command} was not renewed for {late_s:.1f} s: {lapsed}", ExitCode.FAULT)
        if now >= until:
            break
        yield now
        time.sleep(max(0.0, min(interval_s, until - now)))


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
            if held_key := key.held(now):
                jog(-1.0 if held_key in BACKWARD else 1.0, now)
                moving = True
                continue
            if moving:
                robot.halt()
                moving = False
                renewal.overdue(time.monotonic())  # counts from here: the wait for the halt is not a stall
            elif not late_s:
                continue
            # A key that was pressed during the stall or the halt must not move the arm now.
            if not keyboard.drain().isdisjoint(QUIT):
                break
    if moving:
        robot.halt()


# -- joystick -------------------------------------------------------------------------------------------------------


@commands.command("joystick")
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
    with interruptible("interrupted: the joystick is released", *SUSPENDING), connect("joystick") as robot:
        if words == ["release"]:
            robot.joystick()
        else:
            _force_for(robot, pressed, byte, seconds)
        _await_rest(robot)
    report("the joystick is released")


def _await_rest(robot: Robot) -> None:
    """Wait until the arm that the joystick moved is at rest: the next command may need that."""
    until = time.monotonic() + LONGEST_STOP_S
    while (status := robot.status()).control_mode is ControlMode.JOYSTICK and status.state is State.MOVING:
        if time.monotonic() > until:
            return
        time.sleep(0.05)


def _position(words: Sequence[str]) -> tuple[list[str], int | None]:
    """Return the inputs that are pressed, or the whole input byte."""
    if words[0] == "byte":
        if len(words) != 2 or not _BYTE.fullmatch(words[1]) or int(words[1]) > 255:
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
    lapsed = "it was released and stays released"
    for now in _renewals("joystick", JOYSTICK_INTERVAL_S, JOYSTICK_HOLD_S, seconds, lapsed):
        _force(robot, pressed, byte, now)


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
            held_key = key.held(now)
            inputs = [*([paddle] if now < paddle_until else [ARROWS[held_key]] if held_key else []), *sorted(switched)]
            _force(robot, inputs, None, now)
            if now - shown_at > SHOW_INTERVAL_S:
                shown_at = now
                _show(robot.status(), inputs)
    emit("")


def _show(status: Status, inputs: Sequence[str]) -> None:
    joystick = status.raw["joystick"]
    modes = status.raw["control_mode"] if joystick is None else f"{status.raw['control_mode']}, {joystick['mode']}"
    line = f"{status.raw['state']}, {modes}: {' '.join(inputs) or 'neutral'}"
    sys.stdout.write(f"\r{line[:79]:79}")
    sys.stdout.flush()
