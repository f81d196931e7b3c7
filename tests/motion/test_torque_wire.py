"""The mode `torque` on the wire: the real loop and device models (see tests/runtime/test_behaviour.py)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from rtcp.ipc.codes import Refusal
from rtcp.ipc.machine import Code, Command, State
from tests.runtime.bench import CONFIG, CST, PERIOD_S, Bench

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer

TORQUE_MODE = 5.0


@pytest.fixture
def bench() -> Iterator[Bench]:
    path = Path(f"/dev/shm/rtcp-torque-{os.getpid()}")
    board = Blackboard(path, len(CONFIG.joints), round(PERIOD_S * 1e9))
    observer = Observer(path)
    path.unlink()
    made = Bench(board, observer)
    yield made
    observer.release(made.lease)
    observer.close()
    board.close()


def in_torque_mode(bench: Bench) -> Bench:
    bench.hold()
    bench.do(Command.MOTION, [TORQUE_MODE])
    bench.wait(lambda: not bench.behaviour.switching)
    assert all(said.mode_display == CST for said in bench.log[-1].drives)
    return bench


def torques(first: float, second: float, hold_s: float = 1.0) -> list[float]:
    return [first, second, *[0.0] * 9, hold_s]


def push(bench: Bench, first: float, second: float, seconds: float) -> None:
    for _ in range(round(seconds / 0.1)):
        bench.do(Command.TORQUE, torques(first, second))
        bench.run(0.1)


def test_the_torque_on_the_wire_is_bounded_and_so_is_the_speed_that_it_makes(bench: Bench) -> None:
    in_torque_mode(bench)
    begun = len(bench.log)
    push(bench, 49.0, -49.0, 1.0)
    push(bench, -49.0, 49.0, 1.0)
    push(bench, 4.0, 2.0, 0.3)
    # Torques count in real time, in which the bench is faster.
    bench.until(State.HOLDING, 60.0)
    bench.run(1.0)
    for axis, (drive, joint) in enumerate(zip(bench.arm.drives, CONFIG.joints, strict=True)):
        said = [cycle.drives[axis] for cycle in bench.log[begun:]]
        efforts = [drive_said.effort for drive_said in said]
        one_nm = drive_scale(bench, axis)
        assert max(map(abs, efforts)) <= joint.torque * one_nm + 1
        # It did push, and turned round.
        assert max(efforts) > 2.0 * one_nm
        assert min(efforts) < -2.0 * one_nm
        fastest = max(abs(drive_said.velocity) for drive_said in said) / 10000
        assert 0.5 * joint.velocity < fastest <= 1.05 * joint.velocity
        assert abs(drive.velocity) < 0.01
    assert Code.ENDED + 9 in bench.codes
    assert not {Code.OVER_SPEED, Code.OVER_TORQUE, Code.FOLLOWING_ERROR} & set(bench.codes)


def drive_scale(bench: Bench, axis: int) -> float:
    """What the wire says for 1 Nm: as the driver encodes it."""
    drive = bench.arm.drives[axis]
    kept, drive.target_torque = drive.target_torque, 1.0
    unit = abs(bench_effort(drive.encode()))
    drive.target_torque = kept
    return unit


def bench_effort(output: bytes) -> int:
    return int.from_bytes(output[10:14], "little", signed=True)


def test_a_torque_beyond_the_joints_limit_is_refused_and_one_in_another_mode_too(bench: Bench) -> None:
    bench.hold()
    assert bench.order(Command.TORQUE, torques(1.0, 0.0)).refusal == Refusal.OTHER_MOTION
    bench.do(Command.MOTION, [TORQUE_MODE])
    bench.wait(lambda: not bench.behaviour.switching)
    assert bench.order(Command.TORQUE, torques(49.5, 0.0)).refusal == Refusal.TORQUE_LIMIT
    assert bench.order(Command.TORQUE, torques(1.0, 0.0, 2.0)).refusal == Refusal.HOLD_TIME
    assert bench.state is State.HOLDING
