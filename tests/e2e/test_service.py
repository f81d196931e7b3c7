"""A platform in the foreground reports its state to the service manager, here a datagram socket."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.e2e.conftest import Platform, kill, lives
from tests.waiting import until

pytestmark = pytest.mark.platform


class Manager:
    """The socket of systemd that receives the messages."""

    def __init__(self, address: str, watchdog_s: float) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.environment = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        self.heard: list[str] = []

    def listen(self) -> list[str]:
        """Return the lines that have come since the last call."""
        came: list[str] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                came += self._socket.recv(4096, socket.MSG_DONTWAIT).decode().splitlines()
        self.heard += came
        return came

    def until(self, line: str) -> None:
        """Wait for a line; what came before and after it is kept in `heard`."""
        until(lambda: line in self.listen(), f"{line} among {self.heard}")

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(platform: Platform) -> Iterator[Manager]:
    """A manager with an abstract address that expects a ping every 0.9 s."""
    made = Manager(f"@rtcp-test-{os.getpid()}-{platform.directory.name}", 0.9)
    platform.environment |= made.environment
    yield made
    made.close()


def test_it_is_ready_after_op_and_pings_only_while_the_cycle_goes_on(platform: Platform, manager: Manager) -> None:
    platform.be_patient(2000)
    started = platform.background("start")
    manager.until("READY=1")
    assert platform.status()["state"] == "ready"
    assert set(platform.al_states()) == {8}
    manager.until("WATCHDOG=1")
    assert "STATUS=ready" in manager.heard
    pids = platform.pids()
    os.kill(pids["loop"], signal.SIGSTOP)
    silence = re.compile(rf"the loop \(process {pids['loop']}\) has published nothing for ([0-9.]+) s")

    def is_silent_for(seconds: float) -> bool:
        found = silence.search(platform.status()["message"])
        return found is not None and float(found[1]) >= seconds

    until(lambda: is_silent_for(1.0), "the silence")
    manager.listen()  # one more may have been in transit
    until(lambda: is_silent_for(3.0), "a silence as long as several intervals of the pings")
    assert "WATCHDOG=1" not in manager.listen()
    os.kill(pids["loop"], signal.SIGCONT)
    manager.until("WATCHDOG=1")
    started.send_signal(signal.SIGTERM)
    manager.until("STOPPING=1")
    started.communicate()
    manager.listen()
    assert started.returncode == 0
    assert manager.heard[-1] == "STATUS=stopping"
    assert not any(lives(pid) for pid in pids.values())
    assert not (platform.directory / "processes.json").exists()


def test_the_foreground_start_replaces_a_killed_gateway_and_ends_with_a_fault_when_the_loop_is_killed(
    platform: Platform, manager: Manager
) -> None:
    platform.be_patient(2000)
    reading, journal = os.pipe()
    status = os.fstat(journal)
    environment = {**platform.environment, "JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
    started = subprocess.Popen(
        [sys.executable, "-m", "rtcp.cli", "start"], env=environment, stdout=subprocess.PIPE, stderr=journal, text=True
    )
    os.close(journal)
    manager.until("READY=1")
    platform.call("enable")
    moving = platform.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")
    platform.until_moving()
    before = platform.pids()
    kill(before["gateway"])
    assert moving.wait() in (4, 5)
    assert json.loads(platform.rtcp("status", "--json").stdout)["pids"]["loop"] == before["loop"]
    status_at_rest = platform.until(lambda status: status["state"] == "holding", "rest")
    after = platform.pids()
    assert (after["loop"], after["gateway"] != before["gateway"]) == (before["loop"], True)
    platform.pass_cycles(100)
    assert platform.status()["joints"]["sent_position"] == status_at_rest["joints"]["sent_position"]
    # The loop is killed: the drives' watchdog stops them, the rest ends, and what happened is kept.
    kill(before["loop"])
    manager.until("STOPPING=1")
    said, _ = started.communicate()
    assert started.returncode == 5
    manager.listen()
    assert manager.heard[-1] == "STATUS=the loop has ended"
    with open(reading) as written:
        lines = written.read().splitlines()
    assert any(re.fullmatch(r"<3>the loop \(process \d+\) has ended", line) for line in lines), lines
    assert f"the gateway (process {before['gateway']}) has ended by SIGKILL: it is restarted" in said
    assert f"the gateway (process {after['gateway']}) answers again" in said
    assert not [line for line in lines if re.match(r"\d{4}-\d\d-\d\d", line)]
    assert list(platform.directory.glob("*.log")) == []
    assert not any(lives(pid) for pid in after.values())
    (fault,) = json.loads(platform.rtcp("faults", "--json").stdout)["faults"]
    assert (f"the loop (process {before['loop']}) ended unexpectedly" in fault["what"], fault["before"]) == (
        True,
        "holding",
    )
