"""A platform's gateway is started anew when it has ended; here each one ends at once, since it finds no session."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.runtime_directory import LockHeld, exclusive, stop_marker
from rtcp.ipc.session import Pid, Processes, identify, is_running, read_processes
from rtcp.launch import supervisor
from rtcp.launch.platform import Platform
from rtcp.launch.supervisor import GatewaySupervisor


class Kept:
    """A platform of which this process plays the loop, and what its supervisor reports."""

    def __init__(self, directory: Path) -> None:
        self.told: list[str] = []
        self.running = Platform(directory, load(default_config()), Processes(loop=identify(os.getpid())))
        self.running.processes.gateway = Pid(1 << 22, 1)
        self.running.processes.write(directory)
        self.supervisor = GatewaySupervisor(self.running, self.told.append)

    def look_until(self, met: Callable[[], bool]) -> None:
        end = time.monotonic() + 60
        while not met():
            assert time.monotonic() < end, self.told
            self.supervisor.look()
            time.sleep(0.01)

    @property
    def starts(self) -> int:
        return sum("it is restarted" in sentence for sentence in self.told)


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Kept]:
    monkeypatch.setattr(supervisor, "STARTS", 2)
    made = Kept(tmp_path)
    yield made
    made.supervisor.close()
    for child in made.running._children:
        child.kill()
        child.wait()


def test_a_gateway_that_cannot_live_is_started_only_so_often_and_its_log_keeps_every_end(
    kept: Kept, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept.look_until(lambda: "tried again" in (kept.told or [""])[-1])
    for _ in range(3):
        kept.supervisor.look()
    assert kept.starts == 2
    assert len(kept.told) == 3
    assert kept.told[0] == f"the gateway (process {1 << 22}) has ended: it is restarted"
    assert "has ended with code 1, 2 times within 60 s: it is tried again later" in kept.told[2]
    assert kept.told[2].endswith(f"; {tmp_path / 'gateway.log'} has the reason")
    assert (tmp_path / "gateway.log").read_text().count("No such file") == 2
    # The minute has passed.
    monkeypatch.setattr(supervisor, "WINDOW_S", 0.0)
    kept.look_until(lambda: kept.starts == 3)


def test_it_is_written_down_whose_gateway_the_new_one_is(kept: Kept, tmp_path: Path) -> None:
    kept.supervisor.look()
    written = read_processes(tmp_path)
    assert written.loop == os.getpid()
    assert written.gateway == kept.running.processes.gateway
    assert is_running(written.gateway)


def test_whoever_holds_the_lock_is_left_to_it(kept: Kept, tmp_path: Path) -> None:
    with exclusive(tmp_path):
        kept.supervisor.look()
        with pytest.raises(LockHeld), exclusive(tmp_path):
            pass
    assert kept.told == []
    kept.supervisor.look()
    assert kept.starts == 1


def test_none_is_started_while_the_platform_is_being_stopped(kept: Kept, tmp_path: Path) -> None:
    stop_marker(tmp_path).touch()
    kept.supervisor.look()
    assert kept.told == []


def test_a_gateway_that_a_command_has_started_meanwhile_is_taken_over(kept: Kept, tmp_path: Path) -> None:
    Processes(loop=kept.running.processes.loop, gateway=identify(os.getpid())).write(tmp_path)
    kept.supervisor.look()
    assert kept.told == []
    assert kept.running.processes.gateway == os.getpid()


def open_files() -> set[str]:
    return set(os.listdir("/proc/self/fd"))


@pytest.mark.parametrize("what", ["gateway.log", "processes.new"])
def test_a_gateway_that_cannot_be_started_is_said_once_and_counts_as_a_start(
    kept: Kept, tmp_path: Path, what: str
) -> None:
    # A directory in the place of the file, or of the one beside it, as a disk that refuses to write.
    (tmp_path / what).mkdir()
    before = open_files()
    for _ in range(5):
        kept.supervisor.look()
    assert [sentence.partition(":")[0] for sentence in kept.told] == [
        "the gateway cannot be restarted",
        f"the gateway (process {1 << 22}) has ended, 2 times within 60 s",
    ]
    assert "Is a directory" in kept.told[0]
    assert open_files() == before
    assert kept.running.processes.gateway == 1 << 22
    assert [child.poll() for child in kept.running._children] == [-signal.SIGKILL] * len(kept.running._children)
    # It is tried again when the minute has passed.
    (tmp_path / what).rmdir()
    kept.supervisor._starts.clear()
    kept.supervisor.look()
    assert kept.starts == 1


def test_no_file_left_to_open_does_not_end_the_launcher(kept: Kept) -> None:
    allowed = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, allowed[1]))
    try:
        kept.supervisor.look()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, allowed)
    assert "Too many open files" in kept.told[0]


def test_a_signal_without_a_name_is_told_by_its_number(kept: Kept) -> None:
    child = subprocess.Popen(["sleep", "60"])
    kept.running._children.append(child)
    kept.running.processes.gateway = identify(child.pid)
    child.send_signal(40)
    kept.look_until(lambda: kept.told != [])
    assert f"the gateway (process {child.pid}) has ended by signal 40: it is restarted" in kept.told[0]
