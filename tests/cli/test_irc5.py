"""`rtcp irc5` in the foreground, and the operator's commands to it."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.cli.irc5 import _VERBS
from rtcp.virtual.irc5.controller import _VERBS as REQUESTS

Rtcp = Callable[..., Any]
Started = tuple["subprocess.Popen[str]", list[str]]


@pytest.fixture
def pc() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(10.0)
        yield listening


@pytest.fixture
def begin(rtcp_process: Callable[..., Any], tmp_path: Path, pc: socket.socket) -> Callable[[], Started]:
    """Start `rtcp irc5`; return its process and its first lines."""
    config = tmp_path / "irc5.yaml"
    config.write_text(f"units:\n  - {{name: ROB_1, port: {pc.getsockname()[1]}}}\n")

    def start() -> Started:
        process = rtcp_process("irc5", "--config", str(config))
        lines: list[str] = []
        while not lines or lines[-1] != "Ctrl-C ends it\n":
            lines.append(process.stdout.readline())
            assert lines[-1], process.stderr.read()
        return process, lines

    return start


def test_it_says_what_it_does_speaks_to_its_pc_and_ends_by_ctrl_c(
    begin: Callable[[], Started], pc: socket.socket, directory: Path
) -> None:
    process, lines = begin()
    assert lines[0] == f"virtual IRC5 (process {process.pid})\n"
    assert lines[1] == "mode auto, motors on, enabling device released, open stops: none\n"
    assert lines[2].startswith(
        f"ROB_1 speaks to 127.0.0.1:{pc.getsockname()[1]}: RAPID runs, EGM is running, joints 0.00"
    )
    assert f"control socket {directory / 'irc5.sock'}" in lines[3]
    assert pc.recv(2048)
    process.send_signal(signal.SIGINT)
    assert (process.communicate(), process.returncode) == (("ended\n", ""), 0)
    assert not (directory / "irc5.sock").exists()


def test_an_operator_stops_resets_and_starts(
    rtcp: Rtcp, begin: Callable[[], Started], wait_until: Callable[..., None]
) -> None:
    begin()
    stopped = rtcp("irc5", "stop", "emergency").out
    assert stopped.startswith("stop emergency: done\nmode auto, motors off, ")
    assert "open stops: emergency, a stop waits for Motors On\n" in stopped
    refused = rtcp("irc5", "motors-on")
    assert (refused.code, refused.out) == (3, "")
    assert refused.trouble == "rtcp: the emergency stop is open: close its circuit, then press Motors On"
    assert "motors off" in rtcp("irc5", "release", "emergency").out
    assert "motors on" in rtcp("irc5", "motors-on").out
    assert "RAPID is stopped" in rtcp("irc5", "stop-rapid", "ROB_1").out
    rtcp("irc5", "start-rapid")
    assert "RAPID runs" in rtcp("irc5", "status").out
    assert "mode hand" in rtcp("irc5", "mode", "hand").out
    wait_until(lambda: "motors off" in rtcp("irc5", "status").out)
    assert "motors on, enabling device middle" in rtcp("irc5", "enabling", "middle").out


def test_faults_begin_and_are_cleared(rtcp: Rtcp, begin: Callable[[], Started]) -> None:
    begin()
    lost = rtcp("irc5", "fault", "lost", "--value", "0.5", "--unit", "ROB_1", "--direction", "from_pc")
    assert lost.out.startswith("fault lost ROB_1 0.5 from_pc: done\n")
    collision = rtcp("irc5", "fault", "collision")
    assert "EGM is error" in collision.out
    assert "    last event: a collision was detected (a fault on command)\n" in collision.out
    assert rtcp("irc5", "clear").code == 0
    assert json.loads(rtcp("irc5", "status", "--json").out)["units"]["ROB_1"]["collision"] is True


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("fault", "tired"), 'fault: found the text "tired", allowed is one of seqno_restart, rapid_stop'),
        (("fault", "lost", "--value", "2"), "value: found 2, allowed is a number from 0 to 1"),
        (("clear", "ROB_2"), 'unit: found the text "ROB_2", allowed is one of ROB_1'),
        (("mode", "manual"), 'mode: found the text "manual", allowed is one of hand, auto'),
    ],
)
def test_what_the_controller_refuses_is_its_sentence_and_exit_code_3(
    rtcp: Rtcp, begin: Callable[[], Started], command: tuple[str, ...], sentence: str
) -> None:
    begin()
    ended = rtcp("irc5", *command)
    assert (ended.code, ended.out) == (3, "")
    assert sentence in ended.trouble


def test_a_second_controller_has_a_socket_of_its_own_and_has_to_be_chosen(
    rtcp: Rtcp, begin: Callable[[], Started], directory: Path
) -> None:
    begin()
    second, _ = begin()
    own = directory / f"irc5-{second.pid}.sock"
    unclear = rtcp("irc5", "status")
    assert unclear.code == 2
    assert f"--irc5 {directory / 'irc5.sock'} or {own}" in unclear.trouble
    rtcp("irc5", "motors-off", "--irc5", str(own))
    assert "motors on" in rtcp("irc5", "status", "--irc5", str(directory / "irc5.sock")).out


def test_without_a_controller_that_runs_the_exit_code_is_4(rtcp: Rtcp, directory: Path) -> None:
    ended = rtcp("irc5", "motors-on")
    assert ended.code == 4
    assert ended.trouble == f"rtcp: no virtual IRC5 is running: nothing listens at {directory / 'irc5.sock'}"
    ended = rtcp("irc5", "status", "--irc5", str(directory / "x.sock"))
    assert ended.code == 4
    assert f"no virtual IRC5 answers at {directory / 'x.sock'}" in ended.trouble


def test_a_mistake_is_a_sentence_and_exit_code_2(rtcp: Rtcp, tmp_path: Path) -> None:
    (tmp_path / "wrong.yaml").write_text("units: []\n")
    for command, sentence in (
        (("--config", str(tmp_path / "wrong.yaml")), "units: "),
        (("--config", str(tmp_path / "none.yaml")), "none.yaml"),
        (("--config", "x.yaml", "status"), "--config is an option of an IRC5 that starts, not of status"),
        (("stop",), "emergency|automatic|general|superior"),
        (("fault", "lost", "--value", "much"), "unable to parse string as a number"),
    ):
        ended = rtcp("irc5", *command)
        assert (ended.code, ended.out) == (2, ""), command
        assert sentence in ended.trouble
        assert "Traceback" not in ended.err


def test_every_request_of_the_controller_has_a_command_but_the_experiments_own() -> None:
    requests = {name.replace("-", "_"): set(verb.keys) for name, verb in _VERBS.items()}
    assert requests | {"status": set(), "accelerometer": {"unit"}} == {
        verb: set(keys) for verb, (keys, _) in REQUESTS.items()
    }
