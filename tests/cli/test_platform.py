"""`start`, `stop` and `demo` with the true platform on the virtual bus."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.platform

PERIOD = ("--cycle-us", "4000")
"""A cycle that a loaded machine keeps: what is tested here is how the commands start and end it."""

FIELDS = {
    "state": str, "drive_mode": str, "bus": str, "cycle_ns": int, "cycles": int, "missed": int, "wkc": dict,
    "slaves": list, "joints": dict, "tool": dict, "axes": dict, "devices": dict, "processes": dict, "wakeup_us": dict,
    "exchange_us": dict, "compute_us": dict, "dc": dict, "realtime": dict, "pids": dict, "speed_override": float,
    "tool_name": str, "payload": dict,
}  # fmt: skip


@pytest.fixture(autouse=True)
def nothing_is_left(
    tmp_path: Path,
    processes_of: Callable[[Path], list[int]],
    rtcp: Callable[..., Any],
    wait_until: Callable[[Callable[[], bool]], None],
) -> Iterator[None]:
    yield
    rtcp("stop")
    wait_until(lambda: processes_of(tmp_path) == [])


def test_a_detached_start_returns_when_the_platform_answers_and_stop_ends_it_and_not_the_next_one(
    rtcp: Callable[..., Any],
    arm: Path,
    processes_of: Callable[[Path], list[int]],
    wait_until: Callable[[Callable[[], bool]], None],
) -> None:
    started = rtcp("start", "--detach", "--config", str(arm), "--mode", "csv", *PERIOD)
    assert (started.code, started.err) == (0, "")
    status = json.loads(rtcp("status", "--json").out)
    assert {name: type(status[name]) for name in FIELDS} == FIELDS
    assert (status["state"], status["drive_mode"], status["cycle_ns"]) == ("ready", "csv", 4_000_000)
    assert rtcp("start", "--config", str(arm)).code == 3
    assert rtcp("segment", "faults").out == "no fault is active\n"
    assert rtcp("stop").code == 0
    assert rtcp("start", "--detach", "--config", str(arm), *PERIOD).code == 0
    wait_until(lambda: len(processes_of(arm)) <= 1)  # the former launcher has gone
    assert json.loads(rtcp("status", "--json").out)["state"] == "ready"
    assert rtcp("stop").code == 0
    assert rtcp("stop").code == 4


def test_stop_ends_a_start_in_the_foreground_with_exit_code_0(
    rtcp: Callable[..., Any], rtcp_process: Callable[..., Any], arm: Path
) -> None:
    running = rtcp_process("start", "--config", str(arm), *PERIOD)
    assert any(line.startswith("ready") for line in running.stdout)
    assert rtcp("stop").code == 0
    assert [*running.stdout] == ["stopped\n"]
    trouble = running.stderr.read()
    assert (running.wait(), trouble) == (0, "")


def test_a_signal_during_the_start_leaves_nothing(rtcp_process: Callable[..., Any], arm: Path) -> None:
    starting = rtcp_process("start", "--config", str(arm), *PERIOD)
    assert starting.stdout.readline().startswith("segment")
    starting.terminate()
    _, trouble = starting.communicate()
    assert starting.returncode == 128 + signal.SIGTERM
    assert "nothing is left running" in trouble


def test_ctrl_c_ends_a_demo_and_its_platform(rtcp_process: Callable[..., Any], arm: Path) -> None:
    showing = rtcp_process("demo", "--config", str(arm), "--seconds", "60")
    assert any(line.startswith("clocks locked") for line in showing.stdout)
    showing.send_signal(signal.SIGINT)
    assert [*showing.stdout][-1] == "stopped\n"
    trouble = showing.stderr.read()
    assert (showing.wait(), trouble) == (130, "rtcp: interrupted: the platform has been stopped\n")
