"""What happens when a process is stopped, ended or killed."""

from __future__ import annotations

import contextlib
import os
import re
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import rtcp
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import Faulted, RtcpError
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, segment_control
from rtcp.ipc.states import State
from rtcp.telemetry.reading import target_steps
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, SLAVES, Platform, gone, kill, lives
from tests.e2e.wire import outputs
from tests.waiting import until

pytestmark = pytest.mark.platform

ZERO = [0.0] * 6

LOST = {"process_data_lost", "slave_lost"}
OP, SAFE_OP_ERROR, INIT = 0x08, 0x14, 0x01


def observe(platform: Platform) -> Observer:
    return Observer(blackboard_file(platform.directory))


@contextlib.contextmanager
def stands_still(pid: int) -> Iterator[None]:
    """Stop a process in this block."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def state(observer: Observer) -> State:
    """Return the state of the machine in the last record."""
    latest = observer.latest()
    assert latest is not None
    return State(int(latest[0]["state"]))


def test_a_stop_leaves_slaves_in_init_and_nothing_behind(running: Platform) -> None:
    running.call("enable")
    pids = running.pids()
    blackboard = blackboard_file(running.directory)
    os.kill(pids["loop"], signal.SIGTERM)
    gone(pids["loop"])
    assert running.al_states() == [INIT] * SLAVES
    running.rtcp("stop")
    assert not any(lives(pid) for pid in pids.values())
    assert not blackboard.exists()
    assert not (running.directory / "control.sock").exists()
    assert "no platform is running" in running.rtcp("stop", check=4).stderr
    assert "no platform is running" in running.rtcp("status", check=4).stderr


@CUBEMARS  # Other drives saturate while they catch up, and the supervision of torque ends the motion.
def test_a_segment_that_stands_still_for_a_moment_does_not_take_the_cycle_off_its_grid(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "0.4", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until_moving()
    observer = observe(running)
    first = observer.head
    with stands_still(running.pids()["segment"]):
        until(lambda: observer.head >= first + 15, "some cycles without a frame", 0.001)
    # Shorter than allowed: the motion continues, and no target jumped.
    assert moving.wait() == 0
    records, lost = observer.since(first)
    assert lost == 0
    without = records[records["wkc"] < 0]
    assert len(without) >= 10
    # Every wake-up was planned a whole number of periods after the previous one.
    planned = (records["time_ns"] - records["wakeup_ns"]).astype(np.int64)
    periods = np.diff(planned) / observer.period_ns
    assert np.abs(periods - np.round(periods)).max() < 0.02
    # A lost frame costs its cycle only: frameless cycles follow each other at the cycle's pace.
    waits = np.diff(without["time_ns"].astype(np.int64)) / observer.period_ns
    assert np.median(waits) < 1.5
    steps = np.abs(np.diff(records["sent_position"], axis=0))
    assert steps.max() <= 0.5 * observer.period_ns * 1e-9 * 1.001
    observer.close()
    assert running.status()["state"] == "holding"


def test_a_segment_that_stands_still_for_longer_than_allowed_is_a_fault_and_can_be_reset(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until_moving()
    observer = observe(running)
    first, since = observer.head, running.last_event()
    with stands_still(running.pids()["segment"]):
        running.until(lambda status: status["state"] == "fault", "the fault")
    moving.communicate()
    assert moving.returncode == 5
    assert LOST & set(running.events(since))
    records, _ = observer.since(first)
    # No target of an enabled drive moved while no slave answered, and none jumped afterwards.
    _, steps = target_steps(records)
    assert steps.max() <= 0.5 * observer.period_ns * 1e-9 * 1.001
    observer.close()
    status = running.status()
    assert status["state"] == "fault"
    assert f"; the fault: {status['message']}" in running.rtcp("enable", check=3).stderr
    running.until(lambda status: all(slave["state"] == "OP" for slave in status["slaves"]), "OP")
    running.call("reset")
    assert running.al_states() == [OP] * SLAVES
    assert running.status()["state"] == "ready"
    running.call("enable")


@CUBEMARS
def test_one_slave_that_is_lost_stops_the_joints_of_the_others(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.5", "0.5", "0", "0", "0", "0", "--speed", "0.4")
    running.until_moving()
    since = running.last_event()
    # The IO box falls to INIT and stays there: the drives' frames go on, and their watchdogs are content.
    with SegmentClient(segment_control(running.directory)) as segment:
        segment.fault({"fault": "al_refuse", "slave": 1, "state": "PRE-OP"})
        running.wire("init", "0")
        assert moving.wait() == 5
        # Not the first status: the frame of its cycle may have been delayed by a shared host.
        status = running.until(lambda status: 0 < status["wkc"]["actual"] < 3 * SLAVES, "an answer without the IO box")
        assert status["state"] == "fault"

        def drives() -> list[dict[str, Any]]:
            return [slave for slave in segment.truth()["slaves"] if "position_rad" in slave]

        running.pass_cycles(125)
        before = drives()
        running.pass_cycles(125)
        after = drives()
        for drive_before, same_drive in zip(before, after, strict=True):
            assert drive_before["position_rad"] == pytest.approx(same_drive["position_rad"], abs=1e-3)
        assert before[0]["position_rad"] < 1.5
        # Without the box the button counts as pressed after a second.
        running.until(lambda _: "estop_unobservable" in running.events(since), "the button that counts as pressed")
        path = running.directory / "frames"
        with running.capture(path):
            running.pass_cycles(60)
        sent = [targets for _, targets in outputs(path)]
        assert len(sent) > 50
        assert {drive.controlword for targets in sent for drive in targets} == {0x0000}
        assert {(drive.velocity, drive.torque) for targets in sent for drive in targets} == {(0, 0)}
        while "working counter" not in (said := running.rtcp("disable", check=5).stderr):
            assert "no frame returns" in said  # the newest cycle is one of those
        assert running.rtcp("reset", check=5).stderr


def test_a_killed_loop_leaves_the_drives_to_their_watchdog_and_its_stream_moves_nothing_of_the_next_one(
    running: Platform,
) -> None:
    running.call("enable")
    pids = running.pids()
    with rtcp.connect("a program", control_socket(running.directory)) as robot:
        stream = robot.open_stream()
        stream.send(ZERO)
        kill(pids["loop"])
        said = f"the loop (process {pids['loop']}) has ended: start the platform, then open another stream"
        with pytest.raises(Faulted, match=re.escape(said)):
            stream.send([0.5] * 6)
    until(lambda: running.al_states()[1:] == [SAFE_OP_ERROR] * (SLAVES - 1), "the watchdog of every drive")
    status = running.status()
    assert status["state"] == "fault"
    assert "ended unexpectedly" in status["message"]
    assert running.rtcp("enable", check=5).stderr
    said = f"the loop (process {pids['loop']}) had ended before, and not in order: its drives were left to their"
    assert said in running.rtcp("stop", check=5).stderr
    assert not any(lives(pid) for pid in pids.values())
    running.rtcp("start", "--detach")
    assert running.status()["state"] == "ready"
    running.call("enable")
    with rtcp.connect("a program", control_socket(running.directory)) as robot, robot.open_stream() as other:
        for _ in range(20):
            with pytest.raises(Faulted, match="has ended"):
                stream.send([0.5] * 6)
            other.send(ZERO)
        stream.close()
        running.pass_cycles(25)
        assert (stream.sent, other.sent) == (1, 20)
        assert robot.status().commanded_positions == pytest.approx(ZERO, abs=1e-6)


def test_a_gateway_that_hangs_stops_the_motion_is_named_and_can_be_killed_and_replaced(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until_moving()
    observer, since = observe(running), running.last_event()
    before = running.pids()
    with stands_still(before["gateway"]):
        until(lambda: state(observer) is State.HOLDING, "rest")
        observer.close()
        with (
            ControlClient(path=control_socket(running.directory)) as client,
            pytest.raises(RtcpError, match=rf"its gateway \(process {before['gateway']}\) hangs"),
        ):
            client.call("status", timeout_s=0.5)
        kill(before["gateway"])
    assert moving.wait() in (4, 5)
    running.rtcp("start", "--detach")
    status = running.status()
    assert status["pids"]["loop"] == before["loop"]
    assert status["state"] == "holding"
    assert "lease_expired" in running.events(since)


def test_a_killed_segment_is_a_fault_that_a_new_start_mends(running: Platform) -> None:
    running.call("enable")
    pids = running.pids()
    kill(pids["segment"])
    running.until(lambda status: status["state"] == "fault", "the fault")
    assert LOST & set(running.events())
    assert "no frame comes back" in running.rtcp("stop", check=5).stderr
    assert not any(lives(pid) for pid in pids.values())
    running.rtcp("start", "--detach")
    assert running.status()["state"] == "ready"
