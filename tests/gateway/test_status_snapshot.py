"""The picture of the platform: its headline, and what it says of a bus that does not answer; the loop is played."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rtcp.gateway.picture import Picture

from rtcp.config import default_config, load
from rtcp.fieldbus.emergency import Emergency
from rtcp.gateway import picture
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code
from rtcp.ipc.layout import FLAG_DC_LOCKED, PER_JOINT, SCALARS
from rtcp.ipc.machine import State
from rtcp.ipc.observer import Observer
from rtcp.ipc.session import Processes, Session

JOINTS = 6
AT = {name: i for i, (name, _) in enumerate(SCALARS[1:])}


class Bench:
    """A blackboard that a test writes, and the picture of it."""

    def __init__(self, board: Blackboard, path: Path) -> None:
        self.board = board
        self.observer = Observer(path)
        self.picture = Picture(self.observer, Session(load(default_config()), "virtual", "ecat0", 0, 0), {})

    def publish(self, state: State, moves: int = 0, wkc: int = 21) -> None:
        record: list[float] = [0] * (len(SCALARS) - 1 + len(PER_JOINT) * JOINTS)
        told = {"state": state, "moves": moves, "wkc": wkc, "wkc_expected": 21, "flags": FLAG_DC_LOCKED}
        for name, value in {**told, "time_ns": time.monotonic_ns()}.items():
            record[AT[name]] = value
        self.board.publish(record)

    @property
    def status(self) -> dict[str, Any]:
        self.picture.follow()
        return self.picture.status(Processes())

    @property
    def headline(self) -> str:
        return str(self.status["message"])


@pytest.fixture
def bench(board: Blackboard, path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(picture, "_STALE_S", 1e9)  # a busy host must not make the loop a silent one
    made = Bench(board, path)
    yield made
    made.observer.close()


def test_an_emergency_stop_out_of_a_fault_is_the_headline_and_not_the_fault(bench: Bench) -> None:
    bench.publish(State.FAULT)
    bench.board.event(Code.DRIVE_FAULT, 2, 0x0218)
    assert "joint3" in bench.headline
    bench.publish(State.EMERGENCY_STOP)
    bench.board.event(Code.PRESSED)
    assert bench.headline.startswith("the emergency stop was pressed")


def test_an_emergency_that_says_no_error_is_a_message_and_never_the_headline(bench: Bench) -> None:
    bench.publish(State.READY)
    bench.board.text("something to know")
    none, over = (Emergency(2, "drive1", code, 0, bytes(5)).sentence() for code in (0x0000, 0x8611))
    bench.board.text(none)
    assert bench.headline == "something to know"
    assert bench.status["messages"] == ["something to know", none]
    bench.board.text(over)
    assert bench.headline == over


def test_while_the_arm_moves_the_headline_says_so_and_not_how_the_last_motion_ended(bench: Bench) -> None:
    bench.publish(State.MOVING, moves=1)
    bench.board.event(Code.ARRIVED)
    bench.publish(State.HOLDING, moves=1)
    arrived = bench.headline
    assert "arrived" in arrived
    time.sleep(0.002)
    bench.publish(State.MOVING, moves=2)
    assert bench.headline == "moving"
    time.sleep(0.002)
    bench.board.text("said meanwhile")
    bench.publish(State.MOVING, moves=2)
    assert bench.headline == "said meanwhile"
    time.sleep(0.002)
    # The next motion begins without a cycle of rest between.
    bench.publish(State.MOVING, moves=3)
    assert bench.headline == "moving"
    bench.publish(State.STOPPING, moves=3)
    assert bench.headline == "stopping"
    bench.board.event(Code.ARRIVED)
    bench.publish(State.HOLDING, moves=3)
    assert bench.headline == arrived


def test_a_loop_that_is_silent_is_said_with_what_to_do_and_nothing_of_it_is_taken_for_the_present(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.publish(State.HOLDING)
    assert (bench.status["wkc"]["actual"], bench.status["dc"]["locked"]) == (21, True)
    monkeypatch.setattr(picture, "_STALE_S", -1.0)
    status = bench.status
    assert "has published nothing for " in status["message"]
    assert " s; the drives' watchdog stops them" in status["message"]
    assert "`rtcp stop`, then `rtcp start`, if it stays so" in status["message"]
    assert (status["wkc"]["actual"], status["dc"]["locked"]) == (-1, False)
