"""`rtcp start` and `rtcp stop`, where no bus is needed; the whole way up and down is tested with the platform."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli import platform as start
from rtcp.cli.output import report
from rtcp.ipc.session import Pid, Processes, identify


@pytest.fixture
def loop(directory: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process named as the loop in the runtime directory."""
    program = "import time; time.sleep(600)  # stands for rtcp.control.process"
    process = subprocess.Popen([sys.executable, "-c", program])
    Processes(loop=identify(process.pid)).write(directory)
    yield process
    process.kill()
    process.wait()


def test_every_mistake_of_a_configuration_has_a_line_of_its_own(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "arm.yaml"
    file.write_text("name: arm\nslaves: []\njoints: []\n")
    ended = rtcp("start", "--config", str(file))
    assert ended.code == 2
    assert len(ended.err.splitlines()) >= 2
    assert all(line.startswith("rtcp: ") for line in ended.err.splitlines())


@pytest.mark.parametrize("command", ["start", "doctor"])
def test_an_implausible_value_is_refused_with_its_file_key_and_likely_mistake(
    rtcp: Callable[..., Any], arm: Path, command: str
) -> None:
    arm.write_text(arm.read_text().replace("velocity: 0.5", "velocity: 30", 1))
    ended = rtcp(command, "--config", str(arm), "--bus", "nosuch0")
    assert f"{arm}:" in ended.out + ended.err
    assert "if it is right, write {value: 30, unusual: true}" in ended.out + ended.err
    sentence = "joints[0].velocity: found 30 rad/s, plausible is at most 12.57 rad/s: if this is in degrees, write 0.5"
    assert sentence in ended.out + ended.err


@pytest.mark.parametrize("command", [("start",), ("scan",), ("sdo", "read", "io", "0x1000")])
def test_a_mistake_in_the_segments_file_is_named_with_file_line_and_key_and_exit_code_2(
    rtcp: Callable[..., Any], arm: Path, command: tuple[str, ...]
) -> None:
    file = arm.parent / "segment.yaml"
    file.write_text("slaves:\n- model: diewu-io\n- model: toaster\n  options: {colour: 3}\n")
    ended = rtcp(*command, "--config", str(arm))
    assert (ended.code, ended.out) == (2, "")
    assert f'{file}:3: slaves[1].model: found the text "toaster", allowed is one of cubemars-orh40' in ended.trouble


@pytest.mark.parametrize("command", [("start",), ("scan",)])
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nosuch0", "there is no network interface nosuch0 (`interface`); there are"),
        ("lo", "interface lo (`interface`) is the loopback"),
    ],
)
def test_an_interface_that_cannot_be_used_is_a_sentence_and_exit_code_2(
    rtcp: Callable[..., Any], name: str, sentence: str, command: tuple[str, ...]
) -> None:
    ended = rtcp(*command, "--bus", name)
    assert (ended.code, ended.out) == (2, "")
    assert sentence in ended.trouble


def test_a_runtime_directory_that_cannot_be_made_is_named(
    rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path / "file" / "run"))
    for arguments in (("start",), ("start", "--detach")):
        ended = rtcp(*arguments)
        assert ended.code == 2
        assert str(tmp_path / "file" / "run") in ended.trouble


@pytest.fixture
def launched(platform: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The processes of a platform that `rtcp start` has started."""
    platform.started_loop = True
    monkeypatch.setattr(start, "launch", lambda options: platform)
    platform.status |= {"state": "ready", "message": "all slaves are in OP"}
    return platform


def test_a_start_waits_until_the_machine_is_ready(
    rtcp: Callable[..., Any], launched: Any, wait_until: Callable[..., None]
) -> None:
    launched.status["state"] = "starting"

    def become_ready() -> None:
        wait_until(lambda: len(launched.asked("status")) > 2)
        launched.status["state"] = "ready"

    machine = threading.Thread(target=become_ready)
    machine.start()
    ended = rtcp("start", "--detach")
    machine.join()
    assert ended.code == 0
    assert ended.out.startswith("ready: `rtcp enable`")


@pytest.mark.parametrize("state", ["fault", "emergency_stop"])
def test_a_start_that_ends_in_a_fault_says_why_and_leaves_the_platform_running(
    rtcp: Callable[..., Any], launched: Any, state: str
) -> None:
    launched.status |= {"state": state, "message": "joint2: the drive is in fault"}
    ended = rtcp("start", "--detach")
    assert (ended.code, ended.out) == (5, "")
    assert ended.trouble == "rtcp: started, but: joint2: the drive is in fault"
    assert launched.asked("stop") == []


@pytest.mark.parametrize(
    ("arguments", "state", "started_loop", "asked"),
    [
        ((), "ready", True, []),
        ((), "fault", True, []),
        (("--enable",), "ready", True, ["enable"]),
        (("--enable",), "fault", True, ["reset", "enable"]),
        (("--enable",), "fault", False, []),
        (("--enable",), "emergency_stop", True, []),
        (("--enable",), "holding", True, []),
    ],
)
def test_a_start_powers_the_drives_only_where_it_is_told_to_and_never_after_an_emergency_stop(
    rtcp: Callable[..., Any],
    launched: Any,
    arguments: tuple[str, ...],
    state: str,
    started_loop: bool,
    asked: list[str],
) -> None:
    launched.status |= {"state": state, "message": "as it is"}
    launched.started_loop = started_loop
    rtcp("start", "--detach", *arguments)
    assert [name for name in ("reset", "enable") for _ in launched.asked(name)] == asked


def test_a_start_whose_enabling_is_refused_says_why_and_leaves_the_platform_running(
    rtcp: Callable[..., Any], launched: Any
) -> None:
    launched.refusals["enable"] = ("refused", "the enabling switch is not held")
    ended = rtcp("start", "--detach", "--enable")
    assert (ended.code, ended.out) == (5, "")
    assert ended.trouble == "rtcp: started, but: the enabling switch is not held"
    assert launched.asked("stop") == []


def test_a_start_does_not_wait_for_ever(
    rtcp: Callable[..., Any], launched: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start, "READY_TIMEOUT_S", 0.2)
    launched.status |= {"state": "starting", "message": "slave 3 is back"}
    ended = rtcp("start", "--detach")
    assert ended.code == 5
    assert ended.trouble == "rtcp: started, but: not ready within 0.2 s (`rtcp status`): slave 3 is back"


def test_a_loop_that_is_given_its_gateway_back_while_it_holds_is_no_failed_start(
    rtcp: Callable[..., Any], launched: Any
) -> None:
    launched.status |= {"state": "holding", "message": "the arm has stopped and holds"}
    ended = rtcp("start", "--detach")
    assert (ended.code, ended.out) == (0, "holding: the arm has stopped and holds\n")


def test_a_start_in_the_foreground_shows_what_came_of_it_and_runs_on(
    rtcp: Callable[..., Any], launched: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def serve(options: object, announce: Callable[[object], None]) -> int:
        announce(launched)
        report("it runs on")
        return 0

    monkeypatch.setattr(start, "serve", serve)
    launched.status |= {"state": "fault", "message": "joint2: the drive is in fault"}
    ended = rtcp("start")
    assert ended.code == 0
    assert ended.out.splitlines() == ["started, but: joint2: the drive is in fault", "it runs on", "stopped"]


def test_a_demo_is_refused_while_a_platform_runs(rtcp: Callable[..., Any], loop: subprocess.Popen[bytes]) -> None:
    ended = rtcp("demo")
    assert ended.code == 3
    assert f"loop process {loop.pid}" in ended.trouble
    assert loop.poll() is None


def test_stop_ends_a_loop_that_has_lost_its_gateway(
    rtcp: Callable[..., Any], loop: subprocess.Popen[bytes], directory: Path
) -> None:
    ended = rtcp("stop")
    # It has no bus, so it does not report its end.
    assert (ended.code, ended.out) == (5, "")
    assert f"stopped, but: the loop (process {loop.pid}) did not end in" in ended.trouble
    assert loop.wait(20) != 0
    assert rtcp("stop").code == 4


def test_a_later_bearer_of_the_loops_pid_is_neither_taken_for_it_nor_signalled(
    rtcp: Callable[..., Any], loop: subprocess.Popen[bytes], directory: Path
) -> None:
    # As if the loop had ended and its id were in use again: its present process started at another instant.
    Processes(loop=Pid(loop.pid, identify(loop.pid).identity - 1)).write(directory)
    assert rtcp("stop").code == 4
    assert "no platform is running" in rtcp("status").trouble
    assert loop.poll() is None


def test_a_loop_of_which_nobody_knows_how_it_was_started_is_given_no_gateway(
    rtcp: Callable[..., Any], loop: subprocess.Popen[bytes]
) -> None:
    ended = rtcp("status")
    assert (ended.code, ended.out) == (4, "")
    assert f"the loop (process {loop.pid}) runs without a gateway: `rtcp start` gives it one" in ended.trouble


def test_the_pids_stand_in_their_file_as_plain_numbers_by_name(
    loop: subprocess.Popen[bytes], directory: Path
) -> None:  # fmt: skip
    file = json.loads((directory / "processes.json").read_text())
    assert file == {"loop": loop.pid, "gateway": 0, "segment": 0, "identities": file["identities"]}
