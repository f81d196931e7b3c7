"""`rtcp jog` and `rtcp joystick`: motion while a key is held, or for a time."""

from __future__ import annotations

import os
import pty
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rtcp.cli.jog import RELEASED_AFTER_S, REPEATS_WITHIN_S, HeldKey, RenewalCheck
from tests.waiting import until

ARROW_UP, ARROW_LEFT = b"\x1b[A", b"\x1b[D"


class Terminal:
    """A command at a terminal, and its keyboard."""

    def __init__(self, start: Callable[..., Any], *arguments: str) -> None:
        self.master, end = pty.openpty()
        self.process = start(*arguments, stdin=end, env={**os.environ, "TERM": "xterm"})
        os.close(end)
        self.first_line = self.process.stdout.readline()

    def press(self, key: bytes) -> None:
        os.write(self.master, key)

    def hold(self, key: bytes, seconds: float, delay_s: float = 0.3, every_s: float = 0.04) -> None:
        """Press a key as a keyboard does: once, then after a delay again and again."""
        until = time.monotonic() + seconds
        self.press(key)
        time.sleep(delay_s)
        while time.monotonic() < until:
            self.press(key)
            time.sleep(every_s)

    def quit(self) -> int:
        self.press(b"q")
        return int(self.process.wait())


@pytest.fixture
def terminal(rtcp_process: Callable[..., Any]) -> Iterator[Callable[..., Terminal]]:
    terminals: list[Terminal] = []

    def start(*arguments: str) -> Terminal:
        terminals.append(Terminal(rtcp_process, *arguments))
        return terminals[-1]

    yield start
    for terminal in terminals:
        os.close(terminal.master)


# -- held keys ------------------------------------------------------------------------------------------------------

SOON, LATE = 0.9 * RELEASED_AFTER_S, 1.1 * RELEASED_AFTER_S


@pytest.mark.parametrize(
    ("presses", "at", "held"),
    [
        ([("x", 0.0)], 0.01, ""),
        ([("x", 0.0), ("x", 0.6), ("x", 0.64)], 0.64 + SOON, "x"),
        ([("x", 0.0), ("x", 0.6), ("x", 0.64)], 0.64 + LATE, ""),
        ([("x", 0.0), ("x", 0.6), ("x", 0.6 + LATE)], 0.61 + LATE, ""),
        ([("x", 0.0), ("x", 1.1 * REPEATS_WITHIN_S)], 1.1 * REPEATS_WITHIN_S, ""),
        ([("x", 0.0), ("x", 0.6), ("y", 0.65)], 0.66, ""),
    ],
    ids=["a tap", "repeated", "released", "a tap after the release", "two taps", "another key"],
)
def test_a_key_is_held_from_its_first_repetition_until_shortly_after_its_last(
    presses: list[tuple[str, float]], at: float, held: str
) -> None:
    key = HeldKey()
    for name, now in presses:
        key.press(name, now)
    assert key.held(at) == held


# -- a process that was suspended ----------------------------------------------------------------------------------


def test_a_renewal_is_overdue_once_when_it_comes_later_than_a_command_is_valid() -> None:
    renewal = RenewalCheck(0.25)
    assert [renewal.overdue(at) for at in (7.0, 7.25, 7.75, 8.0)] == [0.0, 0.0, 0.5, 0.0]


def suspend(process: Any, seconds: float, meanwhile: Callable[[], None] = lambda: None) -> None:
    """Stop a process with SIGSTOP, and continue it."""
    process.send_signal(signal.SIGSTOP)
    os.waitpid(process.pid, os.WUNTRACED)
    meanwhile()
    time.sleep(seconds)
    process.send_signal(signal.SIGCONT)


@pytest.mark.parametrize(
    ("command", "verb", "last", "words"),
    [
        (("jog", "joint1", "0.1"), "jog", "halt", "the arm had stopped and stays stopped"),
        (("joystick", "forward"), "joystick", "joystick", "it was released and stays released"),
    ],
)
def test_a_command_that_was_suspended_ends_and_does_not_move_the_arm_again(
    platform: Any,
    rtcp_process: Callable[..., Any],
    wait_until: Callable[..., None],
    command: tuple[str, ...],
    verb: str,
    last: str,
    words: str,
) -> None:

    def begun() -> Any:
        platform.requests.clear()
        process = rtcp_process(*command, "--seconds", "50")
        wait_until(lambda: len(platform.asked(verb)) > 2 or process.poll() is not None)
        # It has ended where the host stood still for longer than a renewal may take.
        return process if process.poll() is None else None

    command_process = until(begun, "a command that renews")
    counts: list[int] = []
    suspend(command_process, 0.6, lambda: counts.append(settled(lambda: len(platform.asked(verb)))))
    _, trouble = command_process.communicate()
    assert command_process.returncode == 5
    assert f"the {command[0]} was not renewed for " in trouble
    assert words in trouble
    assert len(platform.asked(verb)) == counts[0]
    assert platform.methods[-1] == last


def settled(count: Callable[[], int]) -> int:
    """Return a count once the other thread has received what had been sent."""
    time.sleep(0.5)
    return count()


def test_a_jog_carries_the_instant_at_which_it_was_requested(platform: Any, rtcp: Callable[..., Any]) -> None:
    before = time.monotonic()
    rtcp("jog", "x", "0.1", "--seconds", "0.1")
    instants = [jog["sent_s"] for jog in platform.asked("jog")]
    assert before < instants[0] < instants[-1] < time.monotonic()


def hold_until(keyboard: Terminal, key: bytes, met: Callable[[], bool]) -> None:
    """Hold a key until `met`, which takes longer on a busy host."""
    for _ in range(100):
        keyboard.hold(key, 0.2)
        if met():
            return
    raise AssertionError("the condition was not met")


def test_keys_typed_while_the_process_was_suspended_move_nothing(
    platform: Any, terminal: Callable[..., Terminal], wait_until: Callable[..., None]
) -> None:
    keyboard = terminal("jog", "joint1", "0.1")
    hold_until(keyboard, b" ", lambda: len(platform.asked("jog")) > 2)
    counts: list[int] = []
    instants: list[float] = []

    def meanwhile() -> None:
        counts.append(settled(lambda: len(platform.asked("jog"))))
        instants.append(time.monotonic())
        keyboard.press(b" " * 300)

    suspend(keyboard.process, 0.6, meanwhile)
    wait_until(lambda: bool(platform.asked("halt")))
    time.sleep(0.4)
    # One jog may have been under way: the platform refuses it by its instant.
    assert len(platform.asked("jog")) <= counts[0] + 1
    assert all(jog["sent_s"] < instants[0] for jog in platform.asked("jog"))
    assert "the keyboard was not read for" in keyboard.process.stdout.readline()
    hold_until(keyboard, b" ", lambda: len(platform.asked("jog")) > counts[0])
    assert keyboard.quit() == 0


def test_arrows_typed_while_the_process_was_suspended_are_ignored(
    platform: Any, terminal: Callable[..., Terminal], wait_until: Callable[..., None]
) -> None:
    keyboard = terminal("joystick")
    wait_until(lambda: bool(platform.asked("joystick")))
    counts: list[int] = []

    def meanwhile() -> None:
        counts.append(settled(lambda: len(platform.asked("joystick"))))
        keyboard.press(ARROW_UP * 150 + b"+" + ARROW_UP * 3)

    suspend(keyboard.process, 0.8, meanwhile)
    wait_until(lambda: len(platform.asked("joystick")) > counts[0] + 4)
    assert all(inputs["pressed"] == [] for inputs in platform.asked("joystick"))
    assert keyboard.quit() == 0


def unstalled(platform: Any, rtcp: Callable[..., Any], *arguments: str) -> Any:
    """Run a command again where the host stood still for longer than a renewal may take."""
    while (ended := rtcp(*arguments)).code:
        assert "was not renewed for" in ended.trouble
        platform.requests.clear()
    return ended


# -- jog ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "frame", "speeds"),
    [
        (("z", "-0.05"), "base", [0, 0, -0.05, 0, 0, 0]),
        (("rx", "0.1", "--frame", "tool"), "tool", [0, 0, 0, 0.1, 0, 0]),
        (("JOINT6", "-.2"), "joints", [0, 0, 0, 0, 0, -0.2]),
    ],
)
def test_a_jog_for_a_time_is_renewed_and_ends_in_a_halt(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...], frame: str, speeds: list[float]
) -> None:
    ended = unstalled(platform, rtcp, "jog", *arguments, "--seconds", "0.4")
    assert ended.code == 0
    assert ended.out.startswith("stopped at 0.1000 -0.2000")
    requests = platform.asked("jog")
    assert 2 <= len(requests) <= 9
    assert all(jog == {"velocity": speeds, "frame": frame, "hold_s": 0.25, "sent_s": jog["sent_s"]} for jog in requests)
    assert platform.methods[-2] == "halt"


def test_a_jog_reports_what_limits_it_once(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status = {**platform.status, "limited_by": {"elbow": "the elbow is 0.08 rad from its singularity"}}
    ended = unstalled(platform, rtcp, "jog", "z", "0.1", "--seconds", "0.9")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.splitlines()[:-1] == ["the elbow is 0.08 rad from its singularity"]


WRONG = {
    "an unknown axis": (("w", "0.1", "--seconds", "1"), "'w' is not an axis: x, y, z, rx, ry, rz, or joint1"),
    "a joint beyond the last": (("joint7", "0.1", "--seconds", "1"), "joint7 does not exist: joint1 to joint6"),
    "a joint before the first": (("joint0", "0.1", "--seconds", "1"), "'joint0' is not an axis"),
    "not a number": (("x", "fast", "--seconds", "1"), "'fast' is not a number (m/s)"),
    "no speed": (("x", "0", "--seconds", "1"), "SPEED 0 is not allowed"),
    "an infinite speed": (("rz", "inf", "--seconds", "1"), "SPEED: inf is not finite; a finite number of rad/s"),
    "an unknown frame": (("x", "1", "--seconds", "1", "--frame", "world"), "--frame world is not known"),
    "not a time": (("x", "1", "--seconds", "nan"), "--seconds nan is not allowed"),
    "a time too long": (("x", "1", "--seconds", "61"), "at most 60"),
    "a misspelt option": (("x", "1", "--second", "1"), "--second"),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_argument_of_a_jog_is_refused_by_name(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...], sentence: str
) -> None:
    ended = rtcp("jog", *arguments)
    assert (ended.code, platform.asked("jog")) == (2, [])
    assert sentence in ended.trouble


@pytest.mark.parametrize(
    ("command", "words"), [(("jog", "x", "0.1"), "give --seconds N"), (("joystick",), "give a position")]
)
def test_without_a_terminal_a_duration_or_position_is_required(
    platform: Any, rtcp_process: Callable[..., Any], command: tuple[str, ...], words: str
) -> None:
    ended = rtcp_process(*command)
    _, trouble = ended.communicate()
    assert (ended.returncode, platform.requests) == (2, [])
    assert words in trouble


def test_a_suspended_joystick_is_released_and_ends(
    platform: Any, rtcp_process: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    joystick = rtcp_process("joystick", "forward", "--seconds", "50")
    wait_until(lambda: bool(platform.asked("joystick")))
    joystick.send_signal(signal.SIGTSTP)
    _, trouble = joystick.communicate()
    assert (joystick.returncode, trouble) == (148, "rtcp: interrupted: the joystick is released\n")


def test_an_interrupted_jog_closes_its_connection_and_reports_the_stop(
    platform: Any, rtcp_process: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    jogging = rtcp_process("jog", "x", "0.1", "--seconds", "50")
    wait_until(lambda: bool(platform.asked("jog")))
    jogging.send_signal(signal.SIGINT)
    _, trouble = jogging.communicate()
    assert jogging.returncode == 130
    assert trouble == "rtcp: interrupted: the connection is closed, the arm comes to a controlled stop\n"


def test_the_arm_moves_while_a_key_is_held_and_stops_when_it_is_released(
    platform: Any, terminal: Callable[..., Terminal], wait_until: Callable[..., None]
) -> None:
    keyboard = terminal("jog", "y", "0.1")
    hold_until(keyboard, b" ", lambda: len(platform.asked("jog")) >= 5)
    wait_until(lambda: platform.methods[-1] == "halt")
    forward, halts = len(platform.asked("jog")), len(platform.asked("halt"))
    hold_until(keyboard, ARROW_LEFT, lambda: len(platform.asked("jog")) > forward)
    wait_until(lambda: len(platform.asked("halt")) > halts)
    assert keyboard.quit() == 0
    directions = [jog["velocity"][1] for jog in platform.asked("jog")]
    assert set(directions[:forward]) == {0.1}
    assert set(directions[forward:]) == {-0.1}


def test_a_tap_moves_nothing(platform: Any, terminal: Callable[..., Terminal]) -> None:
    keyboard = terminal("jog", "y", "0.1")
    keyboard.press(b" ")
    time.sleep(0.4)
    assert keyboard.quit() == 0
    assert platform.asked("jog") == []


def test_quitting_with_a_held_key_stops_the_arm(platform: Any, terminal: Callable[..., Terminal]) -> None:
    keyboard = terminal("jog", "joint1", "0.1")
    hold_until(keyboard, b" ", lambda: bool(platform.asked("jog")))
    assert keyboard.quit() == 0
    assert platform.methods[-2:] == ["halt", "status"]


# -- joystick -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "pressed", "byte"),
    [
        (("forward",), ["forward"], None),
        (("backward", "left"), ["backward", "left"], None),
        (("up",), ["mode_up"], None),
        (("chair",), ["chair"], None),
        (("estop",), ["emergency_stop"], None),
        (("byte", "61"), [], 61),
    ],
)
def test_a_position_is_held_for_a_time_by_renewal(
    platform: Any, rtcp: Callable[..., Any], words: tuple[str, ...], pressed: list[str], byte: int | None
) -> None:
    ended = unstalled(platform, rtcp, "joystick", *words, "--seconds", "0.4")
    assert (ended.code, ended.out) == (0, "the joystick is released\n")
    requests = platform.asked("joystick")
    assert len(requests) >= 2
    assert all(item == {"pressed": pressed, "byte": byte, "hold_s": 0.4, "sent_s": item["sent_s"]} for item in requests)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("sideways",), "'sideways' is not a joystick position"),
        (("byte",), "byte is not allowed"),
        (("byte", "256"), "byte 256 is not allowed: one number from 0 to 255"),
        (("byte", "9" * 5000), "one number from 0 to 255"),
        (("byte", "61", "62"), "one number from 0 to 255"),
        (("forward", "release"), "'release' is not a joystick position"),
        (("forward", "--seconds", "0"), "--seconds 0 is not allowed"),
    ],
)
def test_an_unknown_position_is_refused(
    platform: Any, rtcp: Callable[..., Any], words: tuple[str, ...], sentence: str
) -> None:
    ended = rtcp("joystick", *words)
    assert (ended.code, platform.requests) == (2, [])
    assert sentence in ended.trouble


def test_arrows_are_the_joystick_and_letters_its_switches(
    platform: Any, terminal: Callable[..., Terminal], wait_until: Callable[..., None]
) -> None:
    keyboard = terminal("joystick")

    def last() -> list[str]:
        requests = platform.asked("joystick")
        return requests[-1]["pressed"] if requests else ["none"]

    def was(pressed: list[str]) -> bool:
        return any(request["pressed"] == pressed for request in platform.asked("joystick"))

    wait_until(lambda: last() == [])
    hold_until(keyboard, ARROW_UP, lambda: was(["forward"]))
    wait_until(lambda: last() == [])
    keyboard.press(b"+")
    wait_until(lambda: was(["mode_up"]))
    wait_until(lambda: last() == [])
    keyboard.press(b"-")
    wait_until(lambda: was(["mode_down"]))
    keyboard.press(b"t")
    wait_until(lambda: last() == ["chair"])
    keyboard.press(b"e")
    wait_until(lambda: last() == ["chair", "emergency_stop"])
    keyboard.press(b"t")
    wait_until(lambda: last() == ["emergency_stop"])
    assert keyboard.quit() == 0


def test_a_killed_joystick_sends_nothing_more(
    platform: Any, rtcp_process: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    playing = rtcp_process("joystick", "forward", "--seconds", "50")
    wait_until(lambda: bool(platform.asked("joystick")))
    playing.kill()
    playing.wait()
    count = len(platform.asked("joystick"))
    time.sleep(0.3)
    assert len(platform.asked("joystick")) <= count + 1
