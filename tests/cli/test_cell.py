"""Platforms by name, and `rtcp cell` where it cannot do what was asked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.find import default_config
from rtcp.config.zero import state_directory
from rtcp.ipc.runtime_directory import runtime_directory

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


@pytest.mark.parametrize("verb", ["status", "enable", "halt", "stop", "reset", "disable"])
def test_without_a_cell_every_command_says_so(rtcp: Rtcp, verb: str) -> None:
    ended = rtcp("cell", verb)
    assert ended.code == 4
    assert "rtcp cell start" in ended.err
