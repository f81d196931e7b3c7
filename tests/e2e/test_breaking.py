"""What happens when a process is stopped, ended or killed."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import numpy as np
import pytest

from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import Observer, record_type
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, segment_control
from rtcp.ipc.schema import FLAG_ALL_OP, FLAG_DC_LOCKED, arm_schema
from rtcp.telemetry.reading import target_steps
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, FULL_CIA402, SLAVES, Platform, gone, kill, lives
from tests.e2e.wire import outputs

pytestmark = pytest.mark.platform

PERIOD_US = 1000
"""A cycle that a loaded host keeps."""

ZERO = [0.0] * 6

LOST = {"process_data_lost", "slave_lost"}
OP, SAFE_OP_ERROR, INIT = 0x08, 0x14, 0x01


def observe(platform: Platform) -> Observer:
    return Observer(blackboard_file(platform.directory))


def stand_still(pid: int, seconds: float) -> None:
    os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(seconds)
    finally:
        os.kill(pid, signal.SIGCONT)


def test_the_cycle_locks_onto_drifting_clocks_within_two_seconds_of_cycles(shared: Platform) -> None:
    observer = observe(shared)
    records, _ = observer.since(0)
    observer.close()
    locked = (records["flags"] & FLAG_DC_LOCKED) != 0
    assert int(records["cycle"][0]) < 100
    assert locked.any()
    assert int(records["cycle"][np.argmax(locked)]) * PERIOD_US * 1e-6 < 2.0
    # OP was requested only then.
    assert not ((records["flags"] & FLAG_ALL_OP) != 0)[: np.argmax(locked)].any()


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
def test_a_segment_that_stands_still_for_50_ms_does_not_take_the_cycle_off_its_grid(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.0", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until_moving()
    observer = observe(running)
    first = observer.head
    stand_still(running.pids()["segment"], 0.05)
    time.sleep(0.1)
    records, lost = observer.since(first)
    assert lost == 0
    without = records[records["wkc"] < 0]
    assert len(without) >= 20
    # Every wake-up was planned a whole number of periods after the previous one.
    planned = (records["time_ns"] - records["wakeup_ns"]).astype(np.int64)
    periods = np.diff(planned) / observer.period_ns
    assert np.abs(periods - np.round(periods)).max() < 0.02
    # A lost frame costs its cycle only: frameless cycles follow each other at the cycle's pace.
    waits = np.diff(without["time_ns"].astype(np.int64)) / observer.period_ns
    assert np.median(waits) < 1.5
    # Shorter than allowed: the motion continues, and no target jumped.
    assert moving.wait() == 0
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
    stand_still(running.pids()["segment"], 2.5)
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
    running.call("move_joints", q=ZERO)


@CUBEMARS
@pytest.mark.parametrize("mode", ["csp", *(pytest.param(mode, marks=pytest.mark.long) for mode in ("csv", "cst"))])
def test_one_slave_that_is_lost_stops_the_joints_of_the_others(running: Platform, mode: str) -> None:
    running.call("mode", name=mode)
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

        time.sleep(0.5)
        before = drives()
        time.sleep(0.5)
        after = drives()
        for drive_before, same_drive in zip(before, after, strict=True):
            assert drive_before["position_rad"] == pytest.approx(same_drive["position_rad"], abs=1e-3)
        assert before[0]["position_rad"] < 1.5
        # Without the box the button counts as pressed after a second.
        end = time.monotonic() + 20
        while "estop_unobservable" not in running.events(since):
            assert time.monotonic() < end
            time.sleep(0.05)
        path = running.directory / f"frames-{mode}"
        with running.capture(path):
            time.sleep(0.2)
        sent = [targets for _, targets in outputs(path)]
        assert len(sent) > 100
        assert {drive.controlword for targets in sent for drive in targets} == {0x0000}
        assert {(drive.velocity, drive.torque) for targets in sent for drive in targets} == {(0, 0)}
        while "working counter" not in (said := running.rtcp("disable", check=5).stderr):
            assert "no frame returns" in said  # the newest cycle is one of those
        assert running.rtcp("reset", check=5).stderr


@FULL_CIA402
def test_an_object_is_not_written_while_drives_have_torque(running: Platform) -> None:
    running.call("enable")
    done = running.rtcp("sdo", "write", "2", "0x6065:0", "9999", "--type", "uint32", check=3)
    assert "ready" in done.stderr
    running.call("disable")
    before = running.rtcp("sdo", "read", "2", "0x6065:0", "--type", "uint32").stdout.split()[0]
    # A little longer, so that the next tests have a window of this size.
    written = str(int(before) + 1)
    running.rtcp("sdo", "write", "2", "0x6065:0", written, "--type", "uint32")
    assert running.rtcp("sdo", "read", "2", "0x6065:0", "--type", "uint32").stdout.split()[0] == written


def test_a_gateway_that_stands_still_ends_the_motion_by_its_lease(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "3.0", "0", "0", "0", "0", "0", "--speed", "0.2")
    running.until_moving()
    observer, since = observe(running), running.last_event()
    gateway = running.pids()["gateway"]
    os.kill(gateway, signal.SIGSTOP)
    try:
        end = time.monotonic() + 20
        while True:
            latest = observer.latest()
            assert latest is not None
            if int(latest[0]["state"]) == 4:
                break
            assert time.monotonic() < end
            time.sleep(0.01)
    finally:
        os.kill(gateway, signal.SIGCONT)
    observer.close()
    assert moving.wait() == 5
    assert "lease_expired" in running.events(since)


def test_a_mover_that_is_suspended_loses_its_lease_and_the_arm_stops(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.05")
    running.until_moving(0.02)
    since = running.last_event()
    os.kill(moving.pid, signal.SIGSTOP)
    try:
        # Before it would have arrived, 30 s later.
        running.until(lambda status: status["state"] == "holding", "rest")
        assert running.status()["lease"]["holder"] in ("", None)
        assert "lease_expired" in running.events(since)
        running.call("move_joints", q=[0.0] * 6)
    finally:
        os.kill(moving.pid, signal.SIGCONT)
    moving.communicate()
    assert moving.returncode == 5


def test_disabling_ends_another_clients_move_at_once(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "3.0", "0", "0", "0", "0", "0", "--speed", "0.2")
    running.until_moving()
    running.call("disable")
    moving.communicate()
    assert moving.returncode == 3
    assert running.status()["state"] == "ready"


def test_a_killed_loop_leaves_the_drives_to_their_watchdog(running: Platform) -> None:
    running.call("enable")
    pids = running.pids()
    kill(pids["loop"])
    end = time.monotonic() + 20
    while running.al_states()[1:] != [SAFE_OP_ERROR] * (SLAVES - 1):
        assert time.monotonic() < end, running.al_states()
    status = running.status()
    assert status["state"] == "fault"
    assert "ended unexpectedly" in status["message"]
    assert running.rtcp("enable", check=5).stderr
    said = f"the loop (process {pids['loop']}) had ended before, and not in order: its drives were left to their"
    assert said in running.rtcp("stop", check=5).stderr
    assert not any(lives(pid) for pid in pids.values())
    running.rtcp("start", "--detach")
    assert running.status()["state"] == "ready"


def test_a_gateway_that_hangs_stops_the_motion_is_named_and_can_be_killed_and_replaced(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until_moving()
    observer = observe(running)
    before = running.pids()
    os.kill(before["gateway"], signal.SIGSTOP)
    try:
        end = time.monotonic() + 20
        while True:
            latest = observer.latest()
            assert latest is not None
            if int(latest[0]["state"]) == 4 and abs(float(latest[0]["actual_velocity"][0])) < 1e-3:
                break
            assert time.monotonic() < end
            time.sleep(0.01)
        observer.close()
        with (
            ControlClient(path=control_socket(running.directory)) as client,
            pytest.raises(RtcpError, match=rf"its gateway \(process {before['gateway']}\) hangs"),
        ):
            client.call("status", timeout_s=0.5)
    finally:
        kill(before["gateway"])
    assert moving.wait() in (4, 5)
    running.rtcp("start", "--detach")
    status = running.status()
    assert status["pids"]["loop"] == before["loop"]
    assert status["state"] == "holding"
    running.call("move_joints", q=ZERO)


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


@pytest.mark.parametrize("name", ["gateway", "segment"])
def test_a_terminated_process_is_no_traceback(running: Platform, name: str) -> None:
    pids = running.pids()
    kill(pids[name], signal.SIGTERM)
    assert "Traceback" not in running.logs()
    running.rtcp("stop", check=None)
    assert not any(lives(pid) for pid in pids.values())


def test_the_record_layout_is_the_same_for_writer_and_reader() -> None:
    for joints in (1, 6, 7):
        assert record_type(arm_schema(joints)).itemsize == arm_schema(joints).size
