"""A platform in the foreground reports its state to the service manager, here a datagram socket."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform


class Manager:
    """The socket of systemd that receives the messages."""

    def __init__(self, address: str, watchdog_s: float) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.environment = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        self.heard: list[str] = []

    def listen(self, for_s: float) -> list[str]:
        """The lines that come within `for_s`."""
        came: list[str] = []
        end = time.monotonic() + for_s
        while (left := end - time.monotonic()) > 0:
            self._socket.settimeout(left)
            try:
                came += self._socket.recv(4096).decode().splitlines()
            except TimeoutError:
                break
        self.heard += came
        return came

    def until(self, line: str, patience_s: float = 60.0) -> None:
        """Wait for a line; what came before and after it is kept in `heard`."""
        end = time.monotonic() + patience_s
        while line not in self.listen(0.1):
            assert time.monotonic() < end, f"{line} did not come: {self.heard}"

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
    manager.until("WATCHDOG=1", 5.0)
    assert "STATUS=ready" in manager.heard
    loop = platform.pids()["loop"]
    os.kill(loop, signal.SIGSTOP)
    manager.listen(1.0)  # one more may be in transit
    assert "WATCHDOG=1" not in manager.listen(1.5)
    os.kill(loop, signal.SIGCONT)
    manager.until("WATCHDOG=1", 5.0)
    started.send_signal(signal.SIGTERM)
    manager.until("STOPPING=1", 10.0)
    assert started.wait(40) == 0
    assert manager.heard[-1] == "STATUS=stopping"
    assert not (platform.directory / "processes.json").exists()


def test_a_loop_that_was_killed_ends_the_service_with_a_fault_and_the_journal_has_the_logs(
    platform: Platform, manager: Manager
) -> None:
    platform.be_patient(2000)
    reading, journal = os.pipe()
    status = os.fstat(journal)
    environment = {**platform.environment, "JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
    started = subprocess.Popen([sys.executable, "-m", "rtcp.cli", "start"], env=environment, stderr=journal)
    os.close(journal)
    manager.until("READY=1")
    os.kill(platform.pids()["loop"], signal.SIGKILL)
    manager.until("STOPPING=1", 10.0)
    assert started.wait(40) == 5
    assert manager.heard[-1] == "STATUS=the loop has ended"
    with open(reading) as written:
        lines = written.read().splitlines()
    assert any(re.fullmatch(r"<3>the loop \(process \d+\) has ended", line) for line in lines), lines
    assert not [line for line in lines if re.match(r"\d{4}-\d\d-\d\d", line)]
    assert list(platform.directory.glob("*.log")) == []
