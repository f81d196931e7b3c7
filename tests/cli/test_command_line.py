"""The command line as a whole."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from rtcp import __version__

COMMANDS = ("start", "stop", "status", "enable", "disable", "reset", "halt", "mode", "move", "run", "jog", "joystick",
            "output", "io", "gripper", "zero", "home", "limits", "scan", "sdo", "segment", "irc5", "demo", "soak",
            "doctor", "service", "faults", "arm")  # fmt: skip
SUBCOMMANDS = ("limits set", "sdo write", "segment fault", "irc5 fault", "irc5 mode", "service install", "faults show",
               "arm fk", "arm ik", "arm plot", "arm urdf", "arm export-c", "arm export-moveit")  # fmt: skip


@pytest.mark.parametrize("option", ["-h", "--help"])
def test_both_help_options_list_the_commands(rtcp: Callable[..., Any], option: str) -> None:
    ended = rtcp(option)
    assert ended.code == 0
    assert all(command in ended.out for command in COMMANDS)
    assert "4 not running" in " ".join(ended.out.split())


def test_without_a_command_there_is_help(rtcp: Callable[..., Any]) -> None:
    ended = rtcp()
    assert ended.code == 0
    assert "status" in ended.out


@pytest.mark.parametrize("command", [*COMMANDS, *SUBCOMMANDS])
def test_every_command_has_help(rtcp: Callable[..., Any], command: str) -> None:
    ended = rtcp(*command.split(), "-h")
    assert (ended.code, ended.err) == (0, "")
    assert f"rtcp {command}" in ended.out


def test_the_version_is_the_packages(rtcp: Callable[..., Any]) -> None:
    assert rtcp("--version").out == f"rtcp {__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("statu",), ("status", "--jsn"), ("status", "extra"), ("mode",), ("move",), ("output", "x", "on"),
        ("start", "--mode", "pp"), ("start", "--cycle-us", "-5"), ("start", "--cycle-us", "nan"), ("sdo", "erase"),
        ("sdo", "write", "1", "0x6060", "1"), ("segment",), ("demo", "--seconds", "0"), ("demo", "--seconds", "nan"),
    ],
)  # fmt: skip
def test_a_mistake_on_the_command_line_is_a_sentence_and_exit_code_2(
    rtcp: Callable[..., Any], arguments: tuple[str, ...]
) -> None:
    ended = rtcp(*arguments)
    assert ended.code == 2
    assert ended.out == ""
    assert ended.trouble
    assert "Traceback" not in ended.err


def test_an_error_that_nobody_foresaw_is_one_line(rtcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(**options: Any) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr("rtcp.cli.__main__.app", broken)
    ended = rtcp("status")
    assert ended.code == 1
    assert ended.err == "rtcp: internal error: RuntimeError: a bug (RTCP_TRACEBACK=1 shows where)\n"


def test_status_loads_nothing_that_starts_slowly() -> None:
    heavy = ("numpy", "pydantic", "pysoem", "ruckig", "yaml", "pyroute2", "asyncio")
    program = f"import sys, rtcp.cli.__main__; print(*[name for name in {heavy!r} if name in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", program], text=True).split() == []


def test_a_command_without_standard_output_says_nothing_and_succeeds() -> None:
    command = [sys.executable, "-m", "rtcp.cli", "arm", "fk", *"000000"]
    ended = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *command], stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")


@pytest.mark.parametrize("written", ["0_1", "\u0661", "1__0"])
def test_what_only_python_takes_for_a_number_is_none(rtcp: Callable[..., Any], written: str) -> None:
    for command in (("move", written, *"00000"), ("jog", "x", written), ("limits", "set", "joint1.max", written)):
        ended = rtcp(*command)
        assert ended.code == 2
        assert "is not a number" in ended.trouble


@pytest.mark.parametrize(
    ("arguments", "now"),
    [
        (("stick", "forward"), "stick is now `rtcp joystick`"),
        (("segment", "mend", "1"), "mend is now `rtcp segment clear`"),
        (("move", *"000000", "--each"), "--each is now --unsynchronized"),
    ],
)
def test_an_old_name_is_refused_with_the_new_one(
    rtcp: Callable[..., Any], arguments: tuple[str, ...], now: str
) -> None:
    ended = rtcp(*arguments)
    assert (ended.code, ended.out) == (2, "")
    assert now in ended.trouble
