"""The recording of the arm's file: the gateway's process starts it once, whatever becomes of the gateway."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from rtcp.config import default_config, load
from rtcp.config.model import RecordingConfig
from rtcp.ipc.client import ControlClient
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from rtcp.ipc.session import Session
from tests.gateway.fake_loop import FakeLoop
from tests.waiting import until

CONFIG = load(default_config())
Begin = Callable[[RecordingConfig], None]


@pytest.fixture
def directory() -> Iterator[Path]:
    """A runtime directory of the test's own: a file in it says that the recording has been started."""
    with tempfile.TemporaryDirectory(prefix="rtcp-gateway-", dir="/tmp") as made:
        yield Path(made)


@pytest.fixture(autouse=True)
def loop(directory: Path) -> Iterator[FakeLoop]:
    made = FakeLoop(blackboard_file(directory))
    yield made
    made.end()
    blackboard_file(directory).unlink(missing_ok=True)


@pytest.fixture
def begin(directory: Path) -> Iterator[Begin]:
    """Start a gateway in front of the loop; the gateway before it is killed."""
    gateways: list[subprocess.Popen[bytes]] = []

    def end() -> None:
        while gateways:
            gateways[-1].kill()
            gateways.pop().wait()

    def made(recording: RecordingConfig) -> None:
        end()
        config = dataclasses.replace(CONFIG, recording=recording)
        Session(config, "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
        (directory / "started.json").write_text("{}")
        reading, writing = os.pipe()
        command = ["-m", "rtcp.gateway.server", "--directory", str(directory), "--ready-fd", str(writing)]
        environment = {**os.environ, "RTCP_STATE_DIR": str(directory / "state")}
        gateways.append(subprocess.Popen([sys.executable, *command], pass_fds=(writing,), env=environment))
        os.close(writing)
        with open(reading) as pipe:
            assert pipe.readline()

    yield made
    end()


def call(directory: Path, method: str) -> Any:
    with ControlClient("a test", control_socket(directory)) as client:
        return client.call(method)


def test_the_recording_of_the_arms_file_runs_once_whatever_becomes_of_the_gateway(
    directory: Path, begin: Begin, tmp_path: Path
) -> None:
    recording = RecordingConfig(out=str(tmp_path), formats=("mcap", "csv"), max_file_seconds=3600.0, keep=2)

    def recordings() -> list[dict[str, Any]]:
        return list(call(directory, "record_status")["recordings"])

    begin(recording)
    until(lambda: any(one["running"] for one in recordings()), "a recording")
    (before,) = recordings()
    assert before["files"] == sorted(map(str, tmp_path.iterdir()), reverse=True)
    begin(recording)
    (ended,) = call(directory, "record_stop")["recordings"]
    assert (ended["pid"], ended["missing"], ended["problem"]) == (before["pid"], 0, "")
    begin(recording)
    call(directory, "events")  # by then the gateway has begun what it begins at its start
    assert [one["running"] for one in recordings()] == [False]


def test_a_recording_of_the_arms_file_that_cannot_start_is_a_message_of_the_status(
    directory: Path, begin: Begin
) -> None:
    begin(RecordingConfig(out="/proc/nowhere"))
    wanted = "the recording of the arm's file (recording) does not run: "
    until(lambda: any(text.startswith(wanted) for text in call(directory, "status")["messages"]), "the message")
    until(lambda: not _recorders(directory), "the end of the recorder")


def _recorders(directory: Path) -> list[psutil.Process]:
    commands = ((process, process.info["cmdline"] or ()) for process in psutil.process_iter(["cmdline"]))
    return [process for process, command in commands if {"rtcp.telemetry.recorder", str(directory)} <= {*command}]
