"""What the service manager is told of a blackboard, over a real datagram socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.layout import PER_JOINT, SCALARS
from rtcp.ipc.machine import State
from rtcp.launch.notifier import Notifier

JOINTS = 6
STATE = [name for name, _ in SCALARS[1:]].index("state")
AT_ONCE = 1e-6
"""A watchdog's patience, s, under which a ping is due at every look."""


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """The manager's end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind(str(tmp_path / "notify"))
        made.setblocking(False)
        yield made


def heard(manager: socket.socket) -> list[str]:
    came = []
    while True:
        try:
            came.append(manager.recv(4096).decode())
        except BlockingIOError:
            return came


def publish(board: Blackboard, state: State) -> None:
    values: list[float] = [0] * (len(SCALARS) - 1 + len(PER_JOINT) * JOINTS)
    values[STATE] = state
    board.publish(values)


def test_it_pings_only_when_the_head_has_moved(board: Blackboard, path: Path, manager: socket.socket) -> None:
    notifier = Notifier(path, manager.getsockname(), AT_ONCE)
    notifier.look()
    assert heard(manager) == []
    publish(board, State.READY)
    notifier.look()
    notifier.look()
    assert heard(manager) == ["STATUS=ready", "WATCHDOG=1"]
    publish(board, State.READY)
    notifier.look()
    assert heard(manager) == ["WATCHDOG=1"]
    notifier.close()


def test_it_pings_no_oftener_than_three_times_a_watchdog(board: Blackboard, path: Path, manager: socket.socket) -> None:
    notifier = Notifier(path, manager.getsockname(), 3000.0)
    notifier.ready()
    publish(board, State.READY)
    notifier.look()
    assert heard(manager) == ["READY=1", "STATUS=ready"]
    notifier.close()


def test_a_state_is_told_once(board: Blackboard, path: Path, manager: socket.socket) -> None:
    notifier = Notifier(path, manager.getsockname())
    for state in (State.READY, State.READY, State.STOPPED_BY_LIMIT):
        publish(board, state)
        notifier.look()
    assert heard(manager) == ["STATUS=ready", "STATUS=stopped by limit"]
    notifier.close()


def test_an_abstract_address_is_understood(board: Blackboard, path: Path) -> None:
    name = f"rtcp-test-notifier-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name)
        manager.setblocking(False)
        notifier = Notifier(path, "@" + name)
        notifier.ready()
        assert heard(manager) == ["READY=1"]
        notifier.close()


def test_a_manager_that_is_gone_is_no_error(board: Blackboard, path: Path, tmp_path: Path) -> None:
    notifier = Notifier(path, str(tmp_path / "nobody"), AT_ONCE)
    publish(board, State.READY)
    notifier.ready()
    notifier.look()
    notifier.stopping("stopping")
    notifier.close()


def test_without_a_blackboard_there_is_no_sign_of_life(tmp_path: Path, manager: socket.socket) -> None:
    notifier = Notifier(tmp_path / "none", manager.getsockname(), AT_ONCE)
    notifier.look()
    notifier.stopping("the loop has ended")
    assert heard(manager) == ["STOPPING=1\nSTATUS=the loop has ended"]
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
def test_the_environment_says_whether_pings_are_expected_of_this_process(
    board: Blackboard,
    path: Path,
    manager: socket.socket,
    monkeypatch: pytest.MonkeyPatch,
    watchdog: dict[str, str],
    pings: int,
) -> None:
    for name in ("WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"NOTIFY_SOCKET": manager.getsockname(), **watchdog}.items():
        monkeypatch.setenv(name, value)
    publish(board, State.READY)
    notifier = Notifier.of_environment(path)
    notifier.look()
    assert heard(manager).count("WATCHDOG=1") == pings
    notifier.close()


def test_without_a_manager_nothing_is_done(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notifier = Notifier.of_environment(path)
    notifier.ready()
    notifier.look()
    notifier.stopping("stopping")
    notifier.close()
