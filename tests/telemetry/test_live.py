"""The live view as a process beside a blackboard that the test writes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import psutil
import pytest

from rtcp.cli.__main__ import main
from tests.telemetry.test_recorder import Loop, loop
from tests.viewer import Viewer

__all__ = ["loop"]


def memory_of(pid: int) -> int:
    """Return the private memory of a process, without the shared ring of records."""
    memory = psutil.Process(pid).memory_info()
    return memory.rss - memory.shared


def connections_of(pid: int) -> int:
    return sum(connection.status == psutil.CONN_ESTABLISHED for connection in psutil.Process(pid).net_connections())


def test_a_client_that_never_reads_is_dropped_and_takes_nothing_from_others(loop: Loop) -> None:
    environment = {**os.environ, "RTCP_RUNTIME_DIR": str(loop.directory)}
    command = [sys.executable, "-m", "rtcp.cli", "live", "--port", "0"]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = process.stdout.readline().partition(": ")[0]
        with Viewer(url) as hanging, Viewer(url, ["/cycle"]) as viewer:
            # A subscription has begun when a description comes.
            assert hanging.first("/robot_description")
            viewer.subscribe("/robot_description")
            assert viewer.first("/robot_description")
            before, published = memory_of(process.pid), 0
            while connections_of(process.pid) == 2:
                loop.publish(100)
                for number in range(published + 1, published + 101):
                    assert viewer.first("/cycle").number == number
                published += 100
            grown = memory_of(process.pid) - before
        process.terminate()
    # 7 000 cycles of every signal are some 12 MB; on a slow host no more pass before the client is dropped.
    assert published > 7_000
    assert grown < 10e6
    assert process.returncode == 0


def test_what_cannot_be_served_ends_in_one_message(
    loop: Loop, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(code: int, *arguments: str) -> str:
        assert main(("live", *arguments)) == code
        return capsys.readouterr().err

    assert "start one with `rtcp start`" in said(4)
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(loop.directory))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
        told = said(3, "--port", port)
    assert told.startswith(f"rtcp: 127.0.0.1 port {port} cannot be listened at: Address already in use")
    assert "nowhere.invalid port 8765 cannot be" in said(3, "--host", "nowhere.invalid")
    assert "--port" in said(2, "--port", "70000")
