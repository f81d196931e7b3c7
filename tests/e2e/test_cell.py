"""Cells of virtual arms: real platforms side by side, commanded together, in step, and with one of them in trouble.

tests/cell/test_in_step.py has the same arms in simulated time: who brakes when, and what is refused.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from math import sin
from pathlib import Path

import numpy as np
import pytest

from rtcp.api import Robot, RtcpError, State
from rtcp.api.cell import Cell
from rtcp.ipc.runtime_directory import control_socket, irc5_control
from rtcp.ipc.session import read_processes
from rtcp.virtual.request_socket import RequestClient
from tests.cell.running import (
    ABB_HOME,
    CONFIG,
    MIXED,
    PAIR,
    Records,
    RunningCell,
    leftovers_of,
    put_in_order,
    restore,
    shipped_cell,
    starts,
)
from tests.e2e.conftest import Platform, lives
from tests.leftovers import Leftovers
from tests.waiting import until

pytestmark = pytest.mark.platform
CYCLE_NS = 4_200_000
"""A cycle of the IRB 120, and a little more."""


@pytest.fixture(scope="module")
def irbs(leftovers: Leftovers) -> Iterator[RunningCell]:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    with leftovers_of(leftovers, "left", "right") as platform:
        yield RunningCell(shipped_cell(), platform)


@pytest.fixture
def cell(irbs: RunningCell) -> Iterator[Cell]:
    """Both arms enabled and at their home."""
    irbs.start_ended("left", "right")
    with irbs.connect() as connected:
        for name in connected.arms:
            with RequestClient(irc5_control(irbs.of(name)), server="virtual IRC5") as operator:
                put_in_order(operator)
        restore(connected)
        yield connected


def near(cell: Cell) -> dict[str, list[float]]:
    """Return targets a second away."""
    return {"left": [0.4, 0.2, 0.1, 0.0, 0.5, 0.3], "right": [-0.3, 0.1, -0.1, 0.1, 0.6, 0.0]}


def moving(cell: Cell, targets: dict[str, list[float]], speed: float) -> tuple[threading.Thread, list[RtcpError]]:
    """Begin a motion in step; return its thread when both arms move, and the list for its error."""
    errors: list[RtcpError] = []

    def run() -> None:
        try:
            cell.move_joints(targets, speed)
        except RtcpError as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


# -- two IRB 120 over EGM ---------------------------------------------------------------------------------------------


def test_one_command_for_all_arms(irbs: RunningCell, cell: Cell, tmp_path: Path) -> None:
    cell.disable()
    run = irbs.platform.rtcp
    states = json.loads(run("cell", "status", "--json").stdout)
    assert {name: arm["state"] for name, arm in states.items()} == {"left": "ready", "right": "ready"}
    run("cell", "enable")
    moved = run("cell", "move", "left=0.2,0.1,0,0,0.5,0", "right=-0.2,0.1,0,0,0.5,0", "--speed", "0.5")
    assert "left: arrived" in moved.stdout
    assert "right: arrived" in moved.stdout
    for name, by in (("left", 0.2), ("right", -0.2)):
        rows = [f"  - {{t: {t}, q: [{by * s}, 0.1, 0, 0, 0.5, {s}]}}" for t, s in ((0, 0.0), (1, 0.4))]
        (tmp_path / f"{name}.yaml").write_text("\n".join(["trajectory:", *rows, ""]))
    files = [f"{name}={tmp_path}/{name}.yaml" for name in ("left", "right")]
    refused = run("cell", "run", *files, check=3)
    assert "left joint_1 must be where it is" in refused.stderr
    assert "right: arrived" in run("cell", "run", *files, "--approach").stdout
    run("cell", "disable")
    assert {status.state for status in cell.status().values()} == {State.READY}


def test_both_are_on_one_path_at_one_time_and_a_halt_of_one_stops_both_there(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    cell.move_joints(near(cell), 0.6)
    left, right = starts(records.read()).values()
    assert abs(left - right) <= CYCLE_NS
    paths = records.paths()
    assert paths["left"] == pytest.approx(paths["right"], abs=CYCLE_NS * 1e-9)
    cell.move_joints(dict.fromkeys(cell.arms, ABB_HOME), 0.6)
    records = Records(irbs)
    thread, errors = moving(cell, near(cell), 0.25)
    records.await_speed(0.1)
    with Robot(path=control_socket(irbs.of("left"))) as robot:
        robot.halt()
    thread.join()
    assert [error.reason for error in errors] == ["stopped"]
    paths = records.paths()
    assert paths["left"] == pytest.approx(paths["right"], abs=2e-5)
    assert {status.state for status in cell.status().values()} == {State.HOLDING}


def test_a_motion_that_one_arm_cannot_carry_out_moves_no_arm(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    with pytest.raises(RtcpError, match="right: joint 1: found 9 rad") as refused:
        cell.move_joints({"left": list(ABB_HOME), "right": [9.0, *ABB_HOME[1:]]})
    assert refused.value.kind == "refused"
    with pytest.raises(RtcpError, match="bodies of left and right") as refused:
        cell.move_joints({name: [0.0, 1.4, -1.4, 0.0, 0.0, 0.0] for name in cell.arms})
    assert refused.value.kind == "refused"
    cell.arms["right"].disable()
    with pytest.raises(RtcpError) as refused:
        cell.move_joints(near(cell), 0.3)
    assert refused.value.message.startswith("right: ")
    assert [np.abs(rows["commanded_velocity"]).max() for rows in records.read().values()] == [0.0, 0.0]


def test_an_arm_whose_loop_was_killed_is_brought_back_by_the_start_of_the_cell(irbs: RunningCell, cell: Cell) -> None:
    loops = {name: read_processes(irbs.of(name)).loop for name in cell.arms}
    os.kill(loops["right"], signal.SIGKILL)
    until(lambda: not lives(loops["right"]), "the end of the loop")
    irbs.platform.rtcp("cell", "start", "--detach", "--config", str(irbs.file))
    assert read_processes(irbs.of("left")).loop == loops["left"]
    assert read_processes(irbs.of("right")).loop != loops["right"]
    with Robot(path=control_socket(irbs.of("right"))) as right:
        until(lambda: right.state is State.READY, "the right arm is ready")


def test_a_loop_that_hangs_stops_the_other(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    thread, errors = moving(cell, near(cell), 0.5)
    records.await_speed(0.2)
    loop = read_processes(irbs.of("right")).loop
    os.kill(loop, signal.SIGSTOP)
    try:
        with Robot(path=control_socket(irbs.of("left"))) as left:
            until(lambda: left.state is State.HOLDING, "the left arm at rest")
            assert "partner_silent" in [event.name for event in left.events()]
    finally:
        os.kill(loop, signal.SIGCONT)
    thread.join()
    # The loop reports a fault when it runs again, or that it is behind.
    assert len(errors) == 1
    restore(cell)


def test_a_stream_of_twelve_joints_moves_all_and_ends_for_all(irbs: RunningCell, cell: Cell) -> None:
    records, began = Records(irbs), time.monotonic()
    with cell.open_stream() as stream, Robot(path=control_socket(irbs.of("right"))) as right:

        def send() -> None:
            angle = 0.2 * sin(min(time.monotonic() - began, 1.0)) ** 2
            stream.send({name: [q + angle for q in ABB_HOME] for name in cell.arms})
            time.sleep(1.0 / 30.0)

        def is_far() -> bool:
            send()
            newest = records.newest().values()
            return all(record["commanded_position"][0][0] > 0.1 for record in newest)

        def goes_on() -> bool:
            send()
            return False

        until(is_far, "a motion of both arms")
        right.halt()
        with pytest.raises(RtcpError) as ended:
            until(goes_on, "the end of the stream")
    assert ended.value.kind == "fault"
    assert {status.state for status in cell.status().values()} <= {State.HOLDING, State.STOPPING}


# -- EtherCAT ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "file",
    [
        "two EtherCAT arms",
        pytest.param("an IRB 120 beside the EtherCAT arm", marks=pytest.mark.long("test_other_cells")),
    ],
)
def test_other_cells(file: str) -> None:
    running = RunningCell(PAIR if file.startswith("two") else MIXED)
    try:
        with running.connect() as cell:
            cell.enable()
            names = tuple(cell.arms)
            records = Records(running, names)
            goals = {name: [q + 0.1 for q in status.positions] for name, status in cell.status().items()}
            arrived = cell.move_joints(goals, 0.3)
            assert set(arrived) == set(names)
            assert all(np.abs(rows["commanded_velocity"]).max() > 0.1 for rows in records.read().values())
    finally:
        running.end()


def test_a_cell_whose_arm_cannot_start_leaves_nothing_running(tmp_path: Path) -> None:
    platform = Platform()
    file = tmp_path / "cell.yaml"
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: x\n")
    arms = [f"  - {{name: a, config: {CONFIG / 'abb_irb120.yaml'}}}", "  - {name: b, config: broken.yaml}"]
    file.write_text("\n".join(["name: odd", "arms:", *arms, ""]))
    refused = platform.rtcp("cell", "start", "--detach", "--config", str(file), check=2)
    assert "arm b" in refused.stderr
    assert platform.rtcp("cell", "status", check=4).stderr
    platform.end()
