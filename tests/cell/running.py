"""A running cell for tests: its commands, its operators, and the records of all its arms."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
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
from rtcp.ipc.session import read_processes
from rtcp.virtual.request_socket import RequestClient
from tests.e2e.conftest import Platform, lives
from tests.leftovers import Leftovers
from tests.waiting import until

CONFIG = default_config().parent
ABB_HOME = (0.0, 0.0, 0.0, 0.0, 0.5, 0.0)
PAIR = """
name: pair
arms:
  - {name: left, config: assistive_arm.yaml, base: {position: [0, 1.5, 0]}}
  - {name: right, config: assistive_arm.yaml, base: {position: [0, -1.5, 0]}}
silence_s: 0.5
"""
MIXED = PAIR.replace("{name: left, config: assistive_arm.yaml", "{name: left, config: abb_irb120.yaml")


def shipped_cell(apart_m: float = 1.6) -> str:
    """Return the shipped cell of two IRB 120; its loops may be as late as the format allows.

    An arm that may be silent for so long needs room to stop in: the arms stand farther from each other.
    """
    text = (CONFIG / "cell.yaml").read_text()
    for old, new in {
        "silence_s: 0.1": "silence_s: 0.5",
        "[0, 0.457, 0]": f"[0, {apart_m / 2:g}, 0]",
        "[0, -0.457, 0]": f"[0, {-apart_m / 2:g}, 0]",
    }.items():
        assert old in text
        text = text.replace(old, new)
    return text


@contextlib.contextmanager
def leftovers_of(leftovers: Leftovers, *names: str) -> Iterator[Platform]:
    """A platform whose parts, by their names, may outlive a test meanwhile."""
    platform = Platform()
    directories = {str(platform.directory), *(str(platform.directory / name) for name in names)}
    leftovers.shared |= directories
    try:
        yield platform
    finally:
        end(platform)
        leftovers.shared -= directories


def end(platform: Platform) -> None:
    """Stop a cell and the platforms of its arms, also where its start failed."""
    platform.rtcp("cell", "stop", check=None)
    platform.end()


class RunningCell:
    """A cell of a file, its directories, and the commands of a user."""

    def __init__(self, text: str, platform: Platform | None = None) -> None:
        self.platform = platform = platform or Platform()
        self.directory = platform.directory
        platform.be_patient(2000)
        self.file = platform.directory / "config" / "cell.yaml"
        self.file.write_text(text)
        platform.rtcp("cell", "start", "--detach", "--config", str(self.file))

    def start_ended(self, *names: str) -> None:
        """Start the arms again whose processes a test has ended."""
        for name in names:
            if all(lives(int(pid)) for pid in vars(read_processes(self.of(name))).values()):
                continue
            self.platform.rtcp("--name", name, "stop", check=None)
            self.platform.rtcp("--name", name, "start", "--detach", "--cell", str(self.file))

    def of(self, name: str) -> Path:
        """Return the runtime directory of an arm."""
        return self.directory / name

    def connect(self) -> Cell:
        """Connect to all arms."""
        return rtcp.connect_cell("the tests", directory=self.directory)

    def end(self) -> None:
        """Stop it."""
        end(self.platform)


def put_in_order(operator: RequestClient) -> None:
    """Perform the operator's steps at the controller after a stop."""
    requests = [{"do": "release", "circuit": "emergency"}, {"do": "clear"}, {"do": "motors_on"}, {"do": "start_rapid"}]
    for request in requests:
        operator.ask(request)


def restore(cell: Cell) -> None:
    """Reset and enable what needs it, and go home."""

    def rests() -> bool:
        states = (status.state for status in cell.status().values())
        return not {State.STOPPING, State.DISABLING, State.STARTING} & set(states)

    def is_enabled(name: str) -> bool:
        try:
            cell.arms[name].enable()
            return True
        except Refused as error:
            # The joints still run out after a fault.
            if error.reason != "not_at_standstill":
                raise
            return False

    until(rests, "rest")
    cell.reset()
    for name, status in cell.status().items():
        if status.state is State.READY:
            until(partial(is_enabled, name), f"{name} enabled")
    home = dict.fromkeys(cell.arms, ABB_HOME)
    try:
        cell.move_joints(home)
    except Refused:
        # Where a test left the arms close to each other, only slow arms stop in time.
        cell.move_joints(home, 0.1)


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

        def is_reached() -> bool:
            newest = [observer.latest() for observer in self._observers.values()]
            return all(record is not None and np.abs(record["commanded_velocity"]).max() > least for record in newest)

        until(is_reached, "motion of all arms", interval_s=0.002)

    def newest(self) -> dict[str, Any]:
        """Return the newest record of each arm, shape (1,)."""
        return {name: observer.latest() for name, observer in self._observers.items()}

    def paths(self) -> dict[str, float]:
        """Return the time of each arm on its path, s."""
        return {name: float(record["step_path_s"][0]) for name, record in self.newest().items()}


def starts(records: dict[str, Any]) -> dict[str, int]:
    """Return when each arm's path began, CLOCK_MONOTONIC: the median over the motion, whichever cycles came late."""
    begun = {}
    for name, rows in records.items():
        moves = rows[np.abs(rows["commanded_velocity"]).max(axis=1) > 0.0]
        begun[name] = int(np.median(moves["time_ns"] - moves["step_path_s"] * 1e9))
    return begun
