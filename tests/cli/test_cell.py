"""Platforms by name, and `rtcp cell` where it cannot do what was asked."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli.cell import _to_start
from rtcp.cli.output import CommandError
from rtcp.config.cell_file import load_cell
from rtcp.config.find import default_config
from rtcp.config.zero import state_directory
from rtcp.ipc.runtime_directory import control_socket, runtime_directory
from rtcp.ipc.session import Processes, identify

CELL = str(default_config().with_name("cell.yaml"))
Rtcp = Callable[..., Any]


@pytest.fixture(autouse=True)
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("RTCP_NAME", "")
    return tmp_path


def test_a_name_is_a_directory_of_its_own(rtcp: Rtcp, nowhere: Path) -> None:
    before = state_directory()
    ended = rtcp("--name", "left", "status")
    assert ended.code == 4
    assert runtime_directory() == nowhere / "left"
    assert state_directory() == before / "left"
    assert runtime_directory("") == nowhere


@pytest.mark.parametrize("name", ["../left", "a b", "1", "-x"])
def test_a_name_that_is_none_is_refused(rtcp: Rtcp, name: str) -> None:
    ended = rtcp(f"--name={name}", "status")
    assert ended.code == 2
    assert "--name: found the text" in ended.err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("start", "--cell", CELL), "--cell needs --name NAME"),
        (("start", "--name", "left", "--cell", CELL, "--config", CELL), "leave --config out"),
        (("start", "--name", "middle", "--cell", CELL), "allowed is one of left, right"),
        (("cell", "start", "--config", "none.yaml"), "none.yaml"),
        (("cell", "move", "left"), "allowed is ARM=Q1,..,QN"),
        (("cell", "move", "left=0,x"), "allowed is ARM=Q1,..,QN"),
        (("cell", "run", "left"), "allowed is ARM=FILE"),
        (("cell", "run", "left=none.yaml"), "none.yaml"),
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(rtcp: Rtcp, arguments: tuple[str, ...], sentence: str) -> None:
    ended = rtcp(*arguments)
    assert ended.code == 2
    assert sentence in ended.err


def test_an_arm_whose_loop_was_killed_is_started_again_although_its_gateway_still_listens(nowhere: Path) -> None:
    cell = load_cell(Path(CELL))
    loop = subprocess.Popen(["sleep", "60"])
    for name, pid in (("left", identify(loop.pid)), ("right", identify(os.getpid()))):
        directory = nowhere / name
        directory.mkdir()
        control_socket(directory).touch()
        Processes(loop=pid).write(directory)
    with pytest.raises(CommandError, match="runs already"):
        _to_start(cell)
    loop.kill()
    loop.wait()
    assert _to_start(cell) == ["left"]


@pytest.mark.parametrize("verb", ["status", "enable", "halt", "stop", "reset", "disable"])
def test_without_a_cell_every_command_says_so(rtcp: Rtcp, verb: str) -> None:
    ended = rtcp("cell", verb)
    assert ended.code == 4
    assert "rtcp cell start" in ended.err
