"""A running cell for tests: its commands, its operators, and the records of all its arms."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

import rtcp
from rtcp.api import State
from rtcp.api.cell import Cell
from rtcp.config.find import default_config
from rtcp.ipc.errors import Refused
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.virtual.request_socket import RequestClient
from tests.e2e.conftest import Platform

CONFIG = default_config().parent
ABB_HOME = (0.0, 0.0, 0.0, 0.0, 0.5, 0.0)
PAIR = """
name: pair
arms:
  - {name: left, config: assistive_arm.yaml, base: {position: [0, 1.5, 0]}}
  - {name: right, config: assistive_arm.yaml, base: {position: [0, -1.5, 0]}}
silence_s: 0.2
"""
MIXED = PAIR.replace("{name: left, config: assistive_arm.yaml", "{name: left, config: abb_irb120.yaml")


class RunningCell:
    """A cell of a file, its directories, and the commands of a user."""

    def __init__(self, file: Path | str) -> None:
        self.platform = platform = Platform()
        self.directory = platform.directory
        if isinstance(file, str):
            platform.be_patient(500)
            path = platform.directory / "config" / "cell.yaml"
            path.write_text(file)
        else:
            path = file
        platform.rtcp("cell", "start", "--detach", "--config", str(path))

    def of(self, name: str) -> Path:
        """Return the runtime directory of an arm."""
        return self.directory / name

    def connect(self) -> Cell:
        """Connect to all arms."""
        return rtcp.connect_cell("the tests", directory=self.directory)

    def end(self) -> None:
        """Stop it."""
        self.platform.rtcp("cell", "stop", check=None)
        self.platform.end()


def put_in_order(operator: RequestClient) -> None:
    """Perform the operator's steps at the controller after a stop."""
    requests = [{"do": "release", "circuit": "emergency"}, {"do": "clear"}, {"do": "motors_on"}, {"do": "start_rapid"}]
    for request in requests:
        operator.ask(request)


def restore(cell: Cell) -> None:
    """Reset and enable what needs it, and go home."""
    until = time.monotonic() + 30.0
    while any(status.state in (State.STOPPING, State.DISABLING, State.STARTING) for status in cell.status().values()):
        assert time.monotonic() < until
        time.sleep(0.05)
    cell.reset()
    for name, status in cell.status().items():
        while status.state is State.READY:
            assert time.monotonic() < until
            try:
                cell.arms[name].enable()
                break
            except Refused as error:
                # The joints still run out after a fault.
                if error.reason != "not_at_standstill":
                    raise
                time.sleep(0.05)
    cell.move_joints(dict.fromkeys(cell.arms, ABB_HOME))


class Records:
    """The cycle records of all arms from now on.

    Args:
        running: the cell.
        names: of the arms.
    """

    def __init__(self, running: RunningCell, names: tuple[str, ...] = ("left", "right")) -> None:
        self._observers = {name: Observer(blackboard_file(running.of(name))) for name in names}
        self._from = {name: observer.head for name, observer in self._observers.items()}

    def read(self) -> dict[str, Any]:
        """Return the records of each arm since the beginning."""
        return {name: observer.since(self._from[name])[0] for name, observer in self._observers.items()}

    def await_speed(self, least: float) -> None:
        """Wait until every arm is faster than `least`, rad/s."""
        until = time.monotonic() + 30.0
        while time.monotonic() < until:
            newest = [observer.latest() for observer in self._observers.values()]
            if all(record is not None and np.abs(record["commanded_velocity"]).max() > least for record in newest):
                return
            time.sleep(0.002)
        raise AssertionError("the arms do not move")

    def newest(self) -> dict[str, Any]:
        """Return the newest record of each arm, shape (1,)."""
        return {name: observer.latest() for name, observer in self._observers.items()}

    def paths(self) -> dict[str, float]:
        """Return the time of each arm on its path, s."""
        return {name: float(record["step_path_s"][0]) for name, record in self.newest().items()}


def instants(records: dict[str, Any]) -> dict[str, tuple[int, int]]:
    """Return when each arm began to move and came to rest, CLOCK_MONOTONIC."""
    spans = {}
    for name, rows in records.items():
        moves = np.flatnonzero(np.abs(rows["commanded_velocity"]).max(axis=1) > 0.0)
        spans[name] = int(rows["time_ns"][moves[0]]), int(rows["time_ns"][moves[-1]])
    return spans
