"""The gateway's process and the black box: a gateway that ends loses no fault, and nothing waits for the disk."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.gateway import server
from rtcp.ipc.client import ControlClient
from rtcp.ipc.events import ErrorReported, ProcessDataLost
from rtcp.ipc.recording import About, listed
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from rtcp.ipc.session import Session
from tests.gateway.fake_loop import RunningLoop

LOST = ProcessDataLost(3, 5)


class Gateways:
    """A fake loop, and gateways in front of it, one after the other."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        Session(load(default_config()), "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
        (directory / "started.json").write_text("{}")
        self.loop = RunningLoop(blackboard_file(directory))
        self._started: list[subprocess.Popen[bytes]] = []

    def start(self) -> subprocess.Popen[bytes]:
        reading, writing = os.pipe()
        module = [sys.executable, "-m", "rtcp.gateway.server"]
        process = subprocess.Popen(
            [*module, "--directory", str(self.directory), "--ready-fd", str(writing)],
            pass_fds=(writing,),
            env={**os.environ, "RTCP_STATE_DIR": str(self.directory / "state")},
        )
        self._started.append(process)
        os.close(writing)
        with open(reading) as pipe:
            assert pipe.readline()
        return process

    @property
    def recorded(self) -> list[About]:
        return [
            recording.about for recording in listed(self.directory / "state" / "faults") if recording.about is not None
        ]

    def end(self) -> None:
        for process in self._started:
            process.kill()
            process.wait()
        self.loop.end()
        blackboard_file(self.directory).unlink(missing_ok=True)


@pytest.fixture
def gateways() -> Iterator[Gateways]:
    # Short: a control socket's path has 107 bytes at most.
    directory = Path(tempfile.mkdtemp(prefix="rtcp-box-", dir="/tmp"))
    made = Gateways(directory)
    yield made
    made.end()
    shutil.rmtree(directory)


def test_a_fault_followed_at_once_by_a_stop_is_written_before_the_blackboard_goes(gateways: Gateways) -> None:
    gateway = gateways.start()
    gateways.loop.board.event(LOST)
    with ControlClient("a test", control_socket(gateways.directory)) as client:
        client.call("stop", timeout_s=60.0)
        assert [about.what.partition(":")[0] for about in gateways.recorded] == ["process data lost"]
    assert not blackboard_file(gateways.directory).exists()
    assert gateway.wait() == 0


def test_a_fault_in_whose_second_the_gateway_is_killed_is_written_by_the_next_one(gateways: Gateways) -> None:
    gateway = gateways.start()
    gateways.loop.board.event(LOST)
    with ControlClient("a test", control_socket(gateways.directory)) as client:
        while not any("process data lost" in message for message in client.call("status")["messages"]):
            pass
    gateway.kill()
    gateway.wait()
    second = gateways.start()
    second.terminate()
    assert second.wait() == 0
    assert len(gateways.recorded) == 1


def test_the_status_is_answered_while_a_fault_is_written_and_names_its_number(gateways: Gateways) -> None:
    gateways.start()
    with ControlClient("a test", control_socket(gateways.directory)) as client:
        gateways.loop.board.event(LOST)
        answers = 0
        while not any("black box: this fault is number 1" in message for message in client.call("status")["messages"]):
            answers += 1
        assert answers > 3
        assert client.call("status")["message"].startswith("process data lost")


def test_a_defect_in_following_the_loop_is_logged_now_and_then_and_ends_nothing(
    gateways: Gateways, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server, "_FOLLOW_S", 0.0)
    made = server.Gateway(gateways.directory)
    turns = {"the status snapshot": 0, "the black box": 0}

    def broken(what: str) -> None:
        turns[what] += 1
        raise ValueError(what)

    monkeypatch.setattr(made._snapshot, "follow", lambda: broken("the status snapshot"))
    monkeypatch.setattr(made._box, "poll", lambda: broken("the black box"))

    async def followed() -> None:
        following = asyncio.create_task(made._follow())
        while min(turns.values()) < 50 and not following.done():
            await asyncio.sleep(0)
        following.cancel()

    asyncio.run(followed())
    monkeypatch.undo()
    made._box.finish()
    made._observer.close()
    assert min(turns.values()) >= 50
    logged = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert logged == [f"{what} cannot follow the loop; it is tried again" for what in turns]


def test_a_new_gateway_knows_what_was_said_before_it_and_logs_only_what_comes(
    gateways: Gateways, caplog: pytest.LogCaptureFixture
) -> None:
    gateways.loop.board.event(ErrorReported("said before"))
    gateways.loop.board.event(LOST)
    caplog.set_level("INFO", "rtcp.gateway")
    made = server.Gateway(gateways.directory)
    gateways.loop.board.event(ErrorReported("said now"))
    made._log_messages()
    made._box.finish()
    assert [record.getMessage() for record in caplog.records if record.name == "rtcp.gateway"] == ["said now"]
    messages = [message for _, message in made._snapshot.messages]
    assert "said before" in messages
    assert made._snapshot.fault.startswith("process data lost")
