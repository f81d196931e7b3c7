"""The supervisor restarts a gateway that has ended; here each ends at once, as it finds no session."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.runtime_directory import LockHeld, exclusive, stop_marker
from rtcp.ipc.session import Pid, Processes, identify, is_running, read_processes
from rtcp.launch import supervisor
from rtcp.launch.platform import Platform
from rtcp.launch.supervisor import GatewaySupervisor
from tests.waiting import until


class Supervised:
    """A platform with this process as its loop, and the reports of its supervisor."""

    def __init__(self, directory: Path) -> None:
        self.reports: list[str] = []
        self.platform = Platform(directory, load(default_config()), Processes(loop=identify(os.getpid())))
        self.platform.processes.gateway = Pid(1 << 22, 1)
        self.platform.processes.write(directory)
        self.supervisor = GatewaySupervisor(self.platform, self.reports.append)

    def poll_until(self, met: Callable[[], bool]) -> None:
        def polled() -> bool:
            self.supervisor.poll()
            return met()

        until(polled, "what the supervisor should do")

    @property
    def starts(self) -> int:
        return sum("it is restarted" in sentence for sentence in self.reports)


@pytest.fixture
def supervised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervised]:
    monkeypatch.setattr(supervisor, "STARTS", 2)
    supervised_platform = Supervised(tmp_path)
    yield supervised_platform
    supervised_platform.supervisor.close()
    for child in supervised_platform.platform._children:
        child.kill()
        child.wait()


def test_a_gateway_that_ends_again_and_again_is_restarted_up_to_the_limit_and_its_log_keeps_every_end(
    supervised: Supervised, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    supervised.poll_until(lambda: "tried again" in (supervised.reports or [""])[-1])
    for _ in range(3):
        supervised.supervisor.poll()
    assert supervised.starts == 2
    assert len(supervised.reports) == 3
    assert supervised.reports[0] == f"the gateway (process {1 << 22}) has ended: it is restarted"
    assert "has ended with code 1, 2 times within 60 s: it is tried again later" in supervised.reports[2]
    assert supervised.reports[2].endswith(f"; {tmp_path / 'gateway.log'} has the reason")
    assert (tmp_path / "gateway.log").read_text().count("No such file") == 2
    # The minute has passed.
    monkeypatch.setattr(supervisor, "WINDOW_S", 0.0)
    supervised.poll_until(lambda: supervised.starts == 3)


def test_the_new_gateway_is_written_to_the_file_of_processes(supervised: Supervised, tmp_path: Path) -> None:
    supervised.supervisor.poll()
    written = read_processes(tmp_path)
    assert written.loop == os.getpid()
    assert written.gateway == supervised.platform.processes.gateway
    assert is_running(written.gateway)


def test_no_gateway_is_started_while_another_process_holds_the_lock(supervised: Supervised, tmp_path: Path) -> None:
    with exclusive(tmp_path):
        supervised.supervisor.poll()
        with pytest.raises(LockHeld), exclusive(tmp_path):
            pass
    assert supervised.reports == []
    supervised.supervisor.poll()
    assert supervised.starts == 1


def test_no_gateway_is_started_while_the_platform_is_being_stopped(supervised: Supervised, tmp_path: Path) -> None:
    stop_marker(tmp_path).touch()
    supervised.supervisor.poll()
    assert supervised.reports == []


def test_a_gateway_that_a_command_has_started_meanwhile_is_supervised(supervised: Supervised, tmp_path: Path) -> None:
    Processes(loop=supervised.platform.processes.loop, gateway=identify(os.getpid())).write(tmp_path)
    supervised.supervisor.poll()
    assert supervised.reports == []
    assert supervised.platform.processes.gateway == os.getpid()


def open_files() -> set[str]:
    return set(os.listdir("/proc/self/fd"))


@pytest.mark.parametrize("file", ["gateway.log", "processes.new"])
def test_a_gateway_that_cannot_be_started_is_reported_once_and_counts_as_a_start(
    supervised: Supervised, tmp_path: Path, file: str
) -> None:
    # A directory in the place of the file makes every write fail, as a full disk does.
    (tmp_path / file).mkdir()
    before = open_files()
    for _ in range(5):
        supervised.supervisor.poll()
    assert [sentence.partition(":")[0] for sentence in supervised.reports] == [
        "the gateway cannot be restarted",
        f"the gateway (process {1 << 22}) has ended, 2 times within 60 s",
    ]
    assert "Is a directory" in supervised.reports[0]
    assert open_files() == before
    assert supervised.platform.processes.gateway == 1 << 22
    assert [child.poll() for child in supervised.platform._children] == [-signal.SIGKILL] * len(
        supervised.platform._children
    )
    # It is tried again when the minute has passed.
    (tmp_path / file).rmdir()
    supervised.supervisor._starts.clear()
    supervised.supervisor.poll()
    assert supervised.starts == 1


def test_a_launcher_without_free_file_descriptors_goes_on(supervised: Supervised) -> None:
    allowed = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, allowed[1]))
    try:
        supervised.supervisor.poll()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, allowed)
    assert "Too many open files" in supervised.reports[0]


def test_a_signal_without_a_name_is_reported_by_its_number(supervised: Supervised) -> None:
    child = subprocess.Popen(["sleep", "60"])
    supervised.platform._children.append(child)
    supervised.platform.processes.gateway = identify(child.pid)
    child.send_signal(40)
    supervised.poll_until(lambda: supervised.reports != [])
    assert f"the gateway (process {child.pid}) has ended by signal 40: it is restarted" in supervised.reports[0]
