"""Processes that die or hang: who stops the arm, what the black box keeps, how it goes on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from typing import Any

import pytest

from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, segment_control
from rtcp.ipc.session import read_session
from rtcp.ipc.states import State
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, SEVEN_SLAVES, SLAVES, Platform, gone, kill, lives
from tests.e2e.wire import inputs, outputs
from tests.waiting import until

pytestmark = pytest.mark.platform

ZERO = [0.0] * 6

INIT, SAFE_OP_ERROR, SYNC_MANAGER_WATCHDOG = 0x01, 0x14, 0x1B
QUICK_STOP = 0x0002
"""Controlword."""
STATE_BITS, OPERATION_ENABLED, QUICK_STOP_ACTIVE, SWITCH_ON_DISABLED = 0x6F, 0x27, 0x07, 0x40
"""Masked statuswords."""
STILL_RAD_S = 0.002
MOVE = ("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")


def faults(platform: Platform) -> list[dict[str, Any]]:
    """Return the recorded faults, oldest first."""
    recordings: list[dict[str, Any]] = json.loads(platform.rtcp("faults", "--json").stdout)["faults"]
    return sorted(recordings, key=lambda fault: int(fault["number"]))


def drives(platform: Platform) -> list[dict[str, Any]]:
    with SegmentClient(segment_control(platform.directory)) as segment:
        return [slave for slave in segment.truth()["slaves"] if "velocity_rad_s" in slave]


def test_a_loop_that_hangs_is_stopped_by_the_watchdog_and_moves_again_after_reset_and_enable_alone(
    running: Platform,
) -> None:
    running.call("enable")
    moving = running.background(*MOVE)
    running.until_moving()
    loop = running.pids()["loop"]
    assert max(abs(drive["velocity_rad_s"]) for drive in drives(running)) > 0.1
    os.kill(loop, signal.SIGSTOP)
    try:
        until(lambda: all(abs(drive["velocity_rad_s"]) < STILL_RAD_S for drive in drives(running)), "rest")
        until(lambda: running.al_states()[1:] == [SAFE_OP_ERROR] * (SLAVES - 1), "the watchdog of every drive")
        assert json.loads(running.wire("codes"))[1:] == [SYNC_MANAGER_WATCHDOG] * (SLAVES - 1)
        said = f"the loop (process {loop}) has published nothing for"
        assert running.until(lambda status: said in status["message"], "the silence")["state"] == "fault"
        fault = until(lambda: [fault for fault in faults(running) if said in fault["what"]], "its recording")[0]
        assert fault["before"] == "moving"
        where = [drive["position_rad"] for drive in drives(running)]
        last_ns = max(drive["moved_ns"] for drive in drives(running))
    finally:
        os.kill(loop, signal.SIGCONT)
    assert moving.wait() != 0
    running.until(lambda status: status["state"] == "fault" and said not in status["message"], "the loop's own fault")
    running.pass_cycles(100)
    assert [drive["position_rad"] for drive in drives(running)] == pytest.approx(where, abs=2e-3)
    assert max(drive["moved_ns"] for drive in drives(running)) == last_ns
    assert running.rtcp("enable", check=3).stderr
    running.call("reset")
    assert running.status()["state"] == "ready"
    running.call("enable")
    running.call("move_joints", q=ZERO)


def test_a_command_gives_a_detached_loop_its_gateway_back_which_records_what_happened_meanwhile(
    running: Platform,
) -> None:
    running.call("enable")
    session = read_session(running.directory)
    state = running.directory / "state"
    assert (session.state, session.segment_control) == (state, segment_control(running.directory))
    recorded_before = [fault["number"] for fault in faults(running)]
    before = running.pids()
    kill(before["gateway"])
    with contextlib.closing(Observer(blackboard_file(running.directory))) as observer:
        os.kill(before["segment"], signal.SIGSTOP)
        try:
            until(lambda: State(int(observer.latest()[0]["state"])) is State.FAULT, "the fault")
        finally:
            os.kill(before["segment"], signal.SIGCONT)
    # The state directory of that shell does not matter: the recording is stored beside the others.
    running.environment["RTCP_STATE_DIR"] = str(running.directory / "of another shell")
    try:
        done = running.rtcp("status", "--json")
    finally:
        running.environment["RTCP_STATE_DIR"] = str(state)
    after = running.pids()
    assert f"a new one was started (process {after['gateway']})" in done.stderr
    assert after["loop"] == before["loop"]
    assert json.loads(done.stdout)["state"] == "fault"
    assert running.rtcp("status").stderr == ""
    new = until(lambda: [fault for fault in faults(running) if fault["number"] not in recorded_before], "the recording")
    assert [fault["before"] for fault in new] == ["holding"]
    shown = running.rtcp("faults", "show", str(new[0]["number"])).stdout
    assert "lost" in shown or "left OP" in shown
    assert "picture: " in shown


@pytest.mark.long("test_a_killed_loop_leaves_the_drives_to_their_watchdog_and_its_stream_moves_nothing_of_the_next_one")
def test_a_stop_that_had_to_kill_the_loop_says_so_and_fails(running: Platform) -> None:
    running.call("enable")
    loop = running.pids()["loop"]
    os.kill(loop, signal.SIGSTOP)
    done = running.rtcp("stop", check=5)
    said = f"the loop (process {loop}) did not end in time and was killed: its drives were left to their watchdog"
    assert said in done.stderr
    assert "stopped\n" not in done.stdout
    assert not lives(loop)


@SEVEN_SLAVES
@pytest.mark.long("test_a_stop_leaves_slaves_in_init_and_nothing_behind")
def test_a_stop_names_the_slaves_that_did_not_come_to_init_and_fails(running: Platform) -> None:
    with SegmentClient(segment_control(running.directory)) as segment:
        segment.fault({"fault": "al_hang", "slave": 3})
        segment.fault({"fault": "cable", "after": 5})
    done = running.rtcp("stop", check=5)
    assert "stopped, but: the slaves on ecat" in done.stderr
    assert "slave 3 (drive2) did not reach INIT: it is in " in done.stderr
    assert "slave 6 (drive5)" in done.stderr
    assert "slave 4" not in done.stderr


@CUBEMARS
@pytest.mark.long("test_after_a_defect_joints_ramp_down_and_none_loses_its_torque_while_it_moves")
def test_a_defect_in_the_cycle_ramps_the_joints_down_and_leaves_slaves_in_init(platform: Platform) -> None:
    # A defect cannot be ordered from outside: the interpreter's own start-up hook puts one into the real loop.
    hook = platform.directory / "hook"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(
        "import sys\n"
        "if 'rtcp.control.process' in sys.orig_argv:\n"
        "    from rtcp.control.cycle import Cycle\n"
        "    cycle = Cycle.cycle\n"
        "    def defective(self, *given):\n"
        "        if self.arm.drives[0].velocity > 0.3:\n"
        "            raise ZeroDivisionError('a defect for the test')\n"
        "        return cycle(self, *given)\n"
        "    Cycle.cycle = defective\n"
    )
    platform.environment["PYTHONPATH"] = str(hook)
    platform.be_patient(2000)
    platform.rtcp("start", "--detach")
    # A drive that does not ramp down on `disable operation` has nothing but the quick stop.
    platform.rtcp("sdo", "write", "2", "0x605C:0", "0", "--type", "int16")
    platform.call("enable")
    loop = platform.pids()["loop"]
    path = platform.directory / "frames"
    with platform.capture(path):
        assert platform.rtcp("move", "1.5", "0", "0", "0", "0", "0", check=5).stderr
        gone(loop)
    assert "a defect for the test" in platform.logs()
    quick_stops = [when for when, drives in outputs(path) if {drive.controlword for drive in drives} == {QUICK_STOP}]
    assert quick_stops[-1] - quick_stops[0] > 75e6
    shown = list(inputs(path))
    turning = [drive.statusword & STATE_BITS for _, drives in shown for drive in drives if abs(drive.velocity) > 100]
    assert set(turning) == {OPERATION_ENABLED, QUICK_STOP_ACTIVE}
    assert {drive.statusword & 0x4F for drive in shown[-1][1]} == {SWITCH_ON_DISABLED}
    assert platform.al_states() == [INIT] * SLAVES
    assert "ended unexpectedly" in platform.status()["message"]


def test_an_interrupted_start_leaves_nothing_and_a_start_in_the_foreground_ends_in_order_with_its_terminal(
    platform: Platform,
) -> None:
    platform.be_patient(2000)
    starting = platform.background("start")
    until(lambda: platform.pids()["segment"], "the segment")
    pids = platform.pids()
    # A segment that answers nothing: the start cannot be complete before the signal.
    os.kill(pids["segment"], signal.SIGSTOP)
    starting.send_signal(signal.SIGINT)
    _, said = starting.communicate()
    assert (starting.returncode, "Traceback" in said) == (130, False), said
    assert "nothing is left running" in said
    assert not any(map(lives, (*pids.values(), *platform.pids().values())))
    started = platform.background("start")
    assert started.stdout is not None
    until(lambda: "ready" in started.stdout.readline(), "ready")
    platform.call("enable")
    pids = platform.pids()
    started.send_signal(signal.SIGHUP)
    _, said = started.communicate()
    assert (started.returncode, said) == (0, "")
    assert not any(map(lives, pids.values()))
