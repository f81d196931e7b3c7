"""`scan`, `sdo` and `segment` without a platform: real segments in namespaces of their own."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.launch import offline
from tests.waiting import HANG_S, until


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the limits only end a test that hangs."""
    for limit in ("SEGMENT_TIMEOUT_S", "QUESTION_TIMEOUT_S", "END_TIMEOUT_S"):
        monkeypatch.setattr(offline, limit, HANG_S)


def test_a_scan_of_the_virtual_bus_starts_a_segment_and_ends_it(
    rtcp: Callable[..., Any], arm: Path, processes_of: Callable[[Path], list[int]]
) -> None:
    ended = rtcp("scan", "--config", str(arm), "--json")
    assert (ended.code, ended.err) == (0, "")
    slaves = json.loads(ended.out)
    assert [slave["position"] for slave in slaves] == [1, 2, 3, 4, 5, 6, 7]
    assert [slave["delay_ns"] for slave in slaves] == pytest.approx([0, 820, 1660, 2500, 3320, 4160, 5020], abs=20)
    assert [entry["index"] for entry in slaves[1]["outputs"][0]["entries"]] == [0x6040, 0x607A, 0x60FF, 0x6071, 0x6060]
    assert processes_of(arm.parent) == []


def test_a_scan_for_people_lists_the_models(rtcp: Callable[..., Any], arm: Path) -> None:
    ended = rtcp("scan", "--bus", "virtual", "--config", str(arm))
    assert ended.code == 0
    assert "virtual: 7 slaves" in ended.out
    assert "Cubemars ORH40" in ended.out


def test_an_object_is_read_by_the_slaves_configured_name(rtcp: Callable[..., Any], arm: Path) -> None:
    ended = rtcp("sdo", "read", "drive1", "0x1000", "--type", "uint32", "--config", str(arm))
    assert (ended.code, ended.err) == (0, "")
    assert int(ended.out) & 0xFFFF == 402  # device profile, CiA 301, 7.5.2.1


def test_an_object_is_written(rtcp: Callable[..., Any], arm: Path) -> None:
    ended = rtcp("sdo", "write", "2", "0x6060", "8", "--type", "int8", "--config", str(arm))
    assert (ended.code, ended.err) == (0, "")
    assert "08 written" in ended.out


def test_an_object_that_does_not_exist_is_refused_in_words(rtcp: Callable[..., Any], arm: Path) -> None:
    ended = rtcp("sdo", "read", "2", "0x5FFF", "--config", str(arm))
    assert ended.code == 3
    assert "0x5FFF" in ended.trouble


def test_a_position_beyond_the_last_slave_is_refused_with_their_number(rtcp: Callable[..., Any], arm: Path) -> None:
    ended = rtcp("sdo", "read", "8", "0x1000", "--config", str(arm))
    assert ended.code == 2
    assert "has 7" in ended.trouble


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_scan_leaves_no_process(
    rtcp_process: Callable[..., Any],
    wait_until: Callable[..., None],
    processes_of: Callable[[Path], list[int]],
    arm: Path,
    number: signal.Signals,
    code: int,
) -> None:
    def begun() -> Any:
        scanning = rtcp_process("scan", "--config", str(arm))
        wait_until(lambda: bool(processes_of(arm.parent / "segment.yaml")) or scanning.poll() is not None)
        return scanning if scanning.poll() is None else None

    scanning = until(begun, "a scan that can be interrupted")
    scanning.send_signal(number)
    _, trouble = scanning.communicate()
    assert (scanning.returncode, trouble) == (code, "rtcp: interrupted: nothing is left running\n")
    assert processes_of(arm.parent) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_segment_says_where_the_masters_end_is_and_ends_on_a_signal(
    rtcp_process: Callable[..., Any], arm: Path, number: signal.Signals
) -> None:
    running = rtcp_process("segment", "--config", str(arm.parent / "segment.yaml"))
    lines = [running.stdout.readline() for _ in range(5)]
    assert f"segment of 7 slaves (process {running.pid})" in lines[0]
    assert f"nsenter -t {running.pid}" in lines[2]
    running.send_signal(number)
    out, trouble = running.communicate()
    assert (running.returncode, out, trouble) == (0, "ended\n", "")


def test_a_segment_of_an_unknown_model_is_a_sentence(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text("slaves:\n  - model: toaster\n")
    ended = rtcp("segment", "--config", str(file))
    assert ended.code == 2
    assert "toaster" in ended.trouble
