"""`rtcp ros` as a process, without a platform."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rtcp.cli.__main__ import main
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder
from rtcp.fieldbus.simple_message.messages import ByteOrder, JointPosition, ReplyCode


def test_it_serves_without_a_platform_refuses_motion_and_ends_with_a_signal(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rtcp.cli", "ros", "--simple-message", "--motion-port", "0", "--state-port", "0"]
    with subprocess.Popen(
        command, env={"RTCP_RUNTIME_DIR": str(tmp_path)}, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as served:
        assert served.stdout is not None
        first = served.stdout.readline()
        ports = re.findall(r"127\.0\.0\.1:(\d+)", first)
        assert len(ports) == 2, first
        with socket.create_connection(("127.0.0.1", int(ports[0]))) as client:
            point = Frame.request(JointPosition(0, (0.1,)), ByteOrder.BIG)
            client.sendall(point.pack(ByteOrder.BIG))
            (reply,) = FrameDecoder().feed(client.recv(16, socket.MSG_WAITALL))
            assert reply == point.reply(ReplyCode.FAILURE)
            served.send_signal(signal.SIGTERM)
            output = served.communicate()[0]
    assert served.returncode == 0
    assert "the platform is not there" in output
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--rate", "0"], "--rate"),
        (["--downsample", "1"], "--downsample 1"),
        (["--simple-message", "--byte-order", "middle"], "--byte-order middle"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ros", *arguments]) == 2
    assert reason in capsys.readouterr().err


def test_a_port_that_is_taken_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    program = [sys.executable, "-m", "rtcp.cli", "ros", "--simple-message", "--state-port", "0", "--motion-port"]
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
        done = subprocess.run([*program, port], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert port in done.stderr
    assert "Traceback" not in done.stderr
