"""Notifications of a platform to systemd (sd_notify(3)), over a real datagram socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.schema import arm_schema
from rtcp.ipc.states import State
from rtcp.launch.supervisor import Notifier
from tests.records import numbers

JOINTS = 6
AT_ONCE = 1e-6
"""A watchdog interval, s, for which a ping is due at every poll."""


class Cycle:
    """A blackboard, on which a test publishes as a loop."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.board = Blackboard(path, arm_schema(JOINTS), 500_000)

    def publish(self, state: State = State.READY) -> None:
        self.board.publish(numbers(self.board.schema, state=state))


@pytest.fixture
def cycle() -> Iterator[Cycle]:
    published = Cycle(Path(f"/dev/shm/rtcp-test-notifier-{os.getpid()}"))
    yield published
    published.board.close()
    published.path.unlink()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """The service manager's end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.setblocking(False)
        yield receiver


def received(manager: socket.socket) -> list[str]:
    came = []
    while True:
        try:
            came.append(manager.recv(4096).decode())
        except BlockingIOError:
            return came


def test_a_ping_is_sent_only_after_the_cycle_has_published_a_record(cycle: Cycle, manager: socket.socket) -> None:
    notifier = Notifier(cycle.path, manager.getsockname(), AT_ONCE)
    notifier.poll()
    assert received(manager) == []
    cycle.publish()
    notifier.poll()
    notifier.poll()
    assert received(manager) == ["STATUS=ready", "WATCHDOG=1"]
    cycle.publish(State.STOPPED_BY_LIMIT)
    notifier.poll()
    assert received(manager) == ["STATUS=stopped by limit", "WATCHDOG=1"]
    notifier.close()


def test_a_ping_is_sent_three_times_a_watchdog_interval_at_most(cycle: Cycle, manager: socket.socket) -> None:
    notifier = Notifier(cycle.path, manager.getsockname(), 3000.0)
    notifier.ready()
    cycle.publish()
    notifier.poll()
    assert received(manager) == ["READY=1", "STATUS=ready"]
    notifier.close()


def test_an_abstract_address_begins_with_an_at_sign(cycle: Cycle) -> None:
    name = f"rtcp-test-notifier-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name)
        manager.setblocking(False)
        notifier = Notifier(cycle.path, "@" + name)
        notifier.ready()
        assert received(manager) == ["READY=1"]
        notifier.close()


def test_without_a_blackboard_no_ping_is_sent(tmp_path: Path, manager: socket.socket) -> None:
    notifier = Notifier(tmp_path / "none", manager.getsockname(), AT_ONCE)
    notifier.poll()
    notifier.stopping("the loop has ended")
    assert received(manager) == ["STOPPING=1\nSTATUS=the loop has ended"]
    notifier.close()


@pytest.mark.parametrize("gone", [True, False])
def test_a_manager_that_is_gone_or_was_never_there_is_no_error(
    cycle: Cycle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: bool
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notifier = Notifier(cycle.path, str(tmp_path / "nobody"), AT_ONCE) if gone else Notifier.of_environment(cycle.path)
    cycle.publish()
    notifier.ready()
    notifier.poll()
    notifier.stopping("stopping")
    notifier.close()


@pytest.mark.parametrize(
    ("watchdog", "pings"),
    [
        ({}, 0),
        ({"WATCHDOG_USEC": "1"}, 1),
        ({"WATCHDOG_USEC": "1", "WATCHDOG_PID": str(os.getpid())}, 1),
        ({"WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}, 0),
        ({"WATCHDOG_USEC": "soon"}, 0),
    ],
)
def test_the_environment_selects_the_process_that_sends_pings(
    cycle: Cycle, manager: socket.socket, monkeypatch: pytest.MonkeyPatch, watchdog: dict[str, str], pings: int
) -> None:
    for name in ("WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"NOTIFY_SOCKET": manager.getsockname(), **watchdog}.items():
        monkeypatch.setenv(name, value)
    cycle.publish()
    notifier = Notifier.of_environment(cycle.path)
    notifier.poll()
    assert received(manager).count("WATCHDOG=1") == pings
    notifier.close()
