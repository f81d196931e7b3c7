"""Cells of virtual arms: real platforms side by side, commanded together, in step, and with one of them in trouble."""

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
from rtcp.api.cell import Cell, CellStream
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
    instants,
    put_in_order,
    restore,
)
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform


@pytest.fixture(scope="module")
def irbs() -> Iterator[RunningCell]:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    made = RunningCell(CONFIG / "cell.yaml")
    yield made
    made.end()


@pytest.fixture
def cell(irbs: RunningCell) -> Iterator[Cell]:
    """Both arms enabled and at their home."""
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


def test_one_command_for_all_arms(irbs: RunningCell, cell: Cell) -> None:
    cell.disable()
    run = irbs.platform.rtcp
    states = json.loads(run("cell", "status", "--json").stdout)
    assert {name: arm["state"] for name, arm in states.items()} == {"left": "ready", "right": "ready"}
    run("cell", "enable")
    moved = run("cell", "move", "left=0.2,0.1,0,0,0.5,0", "right=-0.2,0.1,0,0,0.5,0", "--speed", "0.5")
    assert "left: arrived" in moved.stdout
    assert "right: arrived" in moved.stdout
    assert "holding" in run("cell", "status").stdout
    assert "holding" in run("--name", "left", "status").stdout.lower()
    run("cell", "halt")
    run("cell", "disable")
    assert {status.state for status in cell.status().values()} == {State.READY}


def test_trajectories_from_files_in_step(irbs: RunningCell, cell: Cell, tmp_path: Path) -> None:
    for name, by in (("left", 0.2), ("right", -0.2)):
        rows = [f"  - {{t: {t}, q: [{by * s}, 0.1, 0, 0, 0.5, {s}]}}" for t, s in ((0, 0.0), (1, 0.4), (2, 0.5))]
        (tmp_path / f"{name}.yaml").write_text("\n".join(["trajectory:", *rows, ""]))
    files = [f"{name}={tmp_path}/{name}.yaml" for name in ("left", "right")]
    refused = irbs.platform.rtcp("cell", "run", *files, check=3)
    assert "left joint_2 must be where it is" in refused.stderr
    done = irbs.platform.rtcp("cell", "run", *files, "--approach")
    assert "right: arrived" in done.stdout


def test_both_begin_and_end_within_a_cycle(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    cell.move_joints(near(cell), 0.6)
    (left_began, left_ended), (right_began, right_ended) = instants(records.read()).values()
    assert abs(left_began - right_began) <= 4_200_000
    assert abs(left_ended - right_ended) <= 2 * 4_200_000


@pytest.mark.parametrize("command", [("--name", "left", "halt"), ("cell", "halt")], ids=" ".join)
def test_a_halt_stops_both_on_one_time_scale(irbs: RunningCell, cell: Cell, command: tuple[str, ...]) -> None:
    records = Records(irbs)
    thread, errors = moving(cell, near(cell), 0.25)
    records.await_speed(0.1)
    irbs.platform.rtcp(*command)
    thread.join()
    assert [error.reason for error in errors] == ["stopped"]
    paths = records.paths()
    assert paths["left"] == pytest.approx(paths["right"], abs=2e-5)
    assert {status.state for status in cell.status().values()} == {State.HOLDING}


def test_a_target_outside_moves_no_arm(cell: Cell) -> None:
    with pytest.raises(RtcpError, match="right: joint 1: found 9 rad") as refused:
        cell.move_joints({"left": list(ABB_HOME), "right": [9.0, *ABB_HOME[1:]]})
    assert refused.value.kind == "refused"


def test_a_way_that_brings_them_together_is_refused(cell: Cell) -> None:
    with pytest.raises(RtcpError, match="bodies of left and right") as refused:
        cell.move_joints({name: [0.0, 1.2, -0.3, 0.0, 0.5, 0.0] for name in cell.arms})
    assert refused.value.kind == "refused"


def test_the_guard_stops_an_arm_that_comes_near_by_itself(cell: Cell) -> None:
    reach = [0.0, 1.1, -0.2, 0.0, 0.5, 0.0]
    cell.arms["left"].move_joints(reach)
    with pytest.raises(RtcpError) as stopped:
        cell.arms["right"].move_joints(reach)
    assert stopped.value.reason == "partner_near"
    cell.arms["right"].reset()
    cell.arms["right"].move_joints(ABB_HOME)  # away from it: allowed
    cell.arms["left"].move_joints(ABB_HOME)


def test_a_partner_that_holds_nothing_keeps_both_at_rest(irbs: RunningCell, cell: Cell) -> None:
    cell.arms["right"].disable()
    records = Records(irbs)
    with pytest.raises(RtcpError) as refused:
        cell.move_joints(near(cell))
    assert refused.value.message.startswith("right: ")
    time.sleep(0.05)  # several cycles: a motion would have begun
    assert [np.abs(rows["commanded_velocity"]).max() for rows in records.read().values()] == [0.0, 0.0]


def test_a_fault_of_one_stops_the_other_along_its_path(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    thread, errors = moving(cell, near(cell), 0.5)
    records.await_speed(0.2)
    with RequestClient(irc5_control(irbs.of("right")), server="virtual IRC5") as operator:
        operator.ask({"do": "stop", "circuit": "emergency"})
    thread.join()
    assert errors[0].message.startswith("right: ")
    states = {name: status.state for name, status in cell.status().items()}
    assert states == {"left": State.HOLDING, "right": State.FAULT}
    with RequestClient(irc5_control(irbs.of("right")), server="virtual IRC5") as operator:
        put_in_order(operator)
    restore(cell)


def test_a_loop_that_hangs_stops_the_other(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    thread, errors = moving(cell, near(cell), 0.5)
    records.await_speed(0.2)
    loop = read_processes(irbs.of("right")).loop
    os.kill(loop, signal.SIGSTOP)
    try:
        with Robot(path=control_socket(irbs.of("left"))) as left:
            until = time.monotonic() + 5.0
            while left.state is not State.HOLDING and time.monotonic() < until:
                time.sleep(0.02)
            assert "partner_silent" in [event.name for event in left.events()]
    finally:
        os.kill(loop, signal.SIGCONT)
    thread.join()
    # The loop reports a fault when it runs again, or that it is behind.
    assert len(errors) == 1
    restore(cell)


def test_a_sine_of_twelve_joints_by_a_stream(irbs: RunningCell, cell: Cell) -> None:
    records = Records(irbs)
    began = time.monotonic()
    with cell.open_stream() as stream:
        while (t := time.monotonic() - began) < 3.0:
            angle = 0.1 * sin(3.0 * t) * min(t, 1.0)
            stream.send({name: [q + angle for q in ABB_HOME] for name in cell.arms})
            time.sleep(1.0 / 30.0)
        assert stream.is_open
    recorded = records.read()
    ways = {name: rows["commanded_position"][:, 0] for name, rows in recorded.items()}
    times = {name: rows["time_ns"] for name, rows in recorded.items()}
    other = np.interp(times["left"], times["right"], ways["right"])
    assert np.ptp(ways["left"]) > 0.15
    assert np.abs(ways["left"] - other).max() < 0.01


def test_a_stream_in_step_ends_for_all(irbs: RunningCell, cell: Cell) -> None:
    def send_on(stream: CellStream, began: float) -> None:
        while (t := time.monotonic() - began) < 5.0:
            stream.send({name: [0.1 * sin(t), *ABB_HOME[1:]] for name in cell.arms})
            time.sleep(0.01)

    with cell.open_stream() as stream:
        halt = threading.Timer(0.5, lambda: irbs.platform.rtcp("--name", "right", "halt"))
        halt.start()
        with pytest.raises(RtcpError) as ended:
            send_on(stream, time.monotonic())
        halt.join()
    assert ended.value.kind == "fault"
    assert {status.state for status in cell.status().values()} <= {State.HOLDING, State.STOPPING}


# -- EtherCAT ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", ["two EtherCAT arms", "an IRB 120 beside the EtherCAT arm"])
def test_other_cells(file: str) -> None:
    running = RunningCell(PAIR if file.startswith("two") else MIXED)
    try:
        running.platform.rtcp("cell", "enable")
        with running.connect() as cell:
            names = tuple(cell.arms)
            records = Records(running, names)
            goals = {name: [q + 0.1 for q in status.positions] for name, status in cell.status().items()}
            arrived = cell.move_joints(goals, 0.3)
            assert set(arrived) == set(names)
            slowest_ns = max(observer.period_ns for observer in records._observers.values())
            (began, _), (other_began, _) = instants(records.read()).values()
            # On a shared host a loop may get no CPU for some cycles.
            assert abs(began - other_began) <= slowest_ns + 2_000_000
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
