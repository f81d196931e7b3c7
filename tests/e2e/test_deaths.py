"""Processes that die or hang: who stops the arm, what the black box keeps, how it goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from typing import Any

import pytest

from rtcp.ipc.runtime_directory import segment_control
from rtcp.ipc.session import read_session
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, SEVEN_SLAVES, SLAVES, Platform, gone, kill, lives
from tests.e2e.wire import inputs, outputs

pytestmark = [pytest.mark.platform, pytest.mark.long]

ZERO = [0.0] * 6

INIT, SAFE_OP_ERROR, SYNC_MANAGER_WATCHDOG = 0x01, 0x14, 0x1B
QUICK_STOP = 0x0002
"""Controlword."""
STATE_BITS, OPERATION_ENABLED, QUICK_STOP_ACTIVE, SWITCH_ON_DISABLED = 0x6F, 0x27, 0x07, 0x40
"""Masked statuswords."""
STILL_RAD_S = 0.002
MOVE = ("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")


@pytest.fixture
def platform(platform: Platform) -> Platform:
    """A platform with recordings of its own."""
    platform.environment["RTCP_STATE_DIR"] = str(platform.directory / "state")
    return platform


def recorded(platform: Platform) -> list[dict[str, Any]]:
    recordings: list[dict[str, Any]] = json.loads(platform.rtcp("faults", "--json").stdout)["faults"]
    return recordings


def until_recorded(platform: Platform, what: str) -> dict[str, Any]:
    end = time.monotonic() + 20
    while True:
        for fault in recorded(platform):
            if what in fault["what"]:
                return fault
        assert time.monotonic() < end, f"{what} was not recorded: {recorded(platform)}\n{platform.logs()}"


def drives(platform: Platform) -> list[dict[str, Any]]:
    with SegmentClient(segment_control(platform.directory)) as segment:
        return [slave for slave in segment.truth()["slaves"] if "velocity_rad_s" in slave]


def started(platform: Platform) -> subprocess.Popen[str]:
    platform.be_patient(2000)
    foreground = platform.background("start")
    end = time.monotonic() + 30
    while platform.rtcp("status", check=None).returncode != 0:
        assert time.monotonic() < end, platform.logs()
    return foreground


def test_the_foreground_start_keeps_a_gateway_and_nothing_moves_by_that(platform: Platform) -> None:
    foreground = started(platform)
    platform.call("enable")
    moving = platform.background(*MOVE)
    platform.until_moving()
    before = platform.pids()
    kill(before["gateway"])
    assert moving.wait() in (4, 5)
    status = json.loads(platform.rtcp("status", "--json").stdout)
    while status["state"] != "holding":
        status = platform.status()
    after = platform.pids()
    assert after["loop"] == before["loop"]
    assert after["gateway"] != before["gateway"]
    assert {drive["torque_on"] for drive in drives(platform)} == {True}
    where = [drive["position_rad"] for drive in drives(platform)]
    time.sleep(0.3)
    assert [drive["position_rad"] for drive in drives(platform)] == pytest.approx(where, abs=1e-3)
    # The loop is killed: the drives' watchdog stops them, the rest ends, and what happened is kept.
    kill(before["loop"])
    said = foreground.communicate()[0]
    assert foreground.returncode == 5
    assert f"the gateway (process {before['gateway']}) has ended by SIGKILL: it is restarted" in said
    assert f"the gateway (process {after['gateway']}) answers again" in said
    assert not any(lives(pid) for pid in after.values())
    (fault,) = recorded(platform)
    assert f"the loop (process {before['loop']}) ended unexpectedly" in fault["what"]
    assert fault["before"] == "holding"


def test_a_loop_that_hangs_is_stopped_by_the_watchdog_and_moves_again_after_reset_and_enable_alone(
    platform: Platform,
) -> None:
    platform.be_patient(2000)
    platform.rtcp("start", "--detach")
    platform.call("enable")
    moving = platform.background(*MOVE)
    platform.until_moving()
    loop = platform.pids()["loop"]
    assert max(abs(drive["velocity_rad_s"]) for drive in drives(platform)) > 0.1
    os.kill(loop, signal.SIGSTOP)
    stopped_ns = time.monotonic_ns()
    end = time.monotonic() + 20
    while any(abs(drive["velocity_rad_s"]) > STILL_RAD_S for drive in drives(platform)):
        assert time.monotonic() < end
    last_ns = max(drive["moved_ns"] for drive in drives(platform))
    assert (last_ns - stopped_ns) * 1e-9 < 0.6
    while platform.al_states()[1:] != [SAFE_OP_ERROR] * (SLAVES - 1):
        assert time.monotonic() < end
    assert json.loads(platform.wire("codes"))[1:] == [SYNC_MANAGER_WATCHDOG] * (SLAVES - 1)
    said = f"the loop (process {loop}) has published nothing for"
    status = platform.until(lambda status: said in status["message"], "the silence")
    assert status["state"] == "fault"
    fault = until_recorded(platform, said)
    assert fault["before"] == "moving"
    where = [drive["position_rad"] for drive in drives(platform)]
    os.kill(loop, signal.SIGCONT)
    assert moving.wait() != 0
    platform.until(lambda status: status["state"] == "fault" and said not in status["message"], "the loop's own fault")
    time.sleep(0.3)
    assert [drive["position_rad"] for drive in drives(platform)] == pytest.approx(where, abs=2e-3)
    assert max(drive["moved_ns"] for drive in drives(platform)) == last_ns
    assert platform.rtcp("enable", check=3).stderr
    platform.call("reset")
    assert platform.status()["state"] == "ready"
    platform.call("enable")
    platform.call("move_joints", q=ZERO)


def test_a_command_gives_a_detached_loop_its_gateway_back_which_records_what_happened_meanwhile(
    platform: Platform,
) -> None:
    platform.be_patient(200)
    platform.rtcp("start", "--detach")
    platform.call("enable")
    session = read_session(platform.directory)
    state = platform.directory / "state"
    assert (session.state, session.segment_control) == (state, segment_control(platform.directory))
    before = platform.pids()
    kill(before["gateway"])
    os.kill(before["segment"], signal.SIGSTOP)
    time.sleep(0.5)
    os.kill(before["segment"], signal.SIGCONT)
    # The state directory of that shell does not matter: the recording is stored beside the others.
    platform.environment["RTCP_STATE_DIR"] = str(platform.directory / "of another shell")
    done = platform.rtcp("status", "--json")
    platform.environment["RTCP_STATE_DIR"] = str(state)
    after = platform.pids()
    assert f"a new one was started (process {after['gateway']})" in done.stderr
    assert after["loop"] == before["loop"]
    assert json.loads(done.stdout)["state"] == "fault"
    assert platform.rtcp("status").stderr == ""
    # A stop does not lose what has not been written yet.
    platform.rtcp("stop")
    assert [fault["before"] for fault in recorded(platform)] == ["holding"]
    number = str(recorded(platform)[0]["number"])
    shown = platform.rtcp("faults", "show", number)
    assert "lost" in shown.stdout or "left OP" in shown.stdout
    assert "picture: " in shown.stdout


def test_a_stop_that_had_to_kill_the_loop_says_so_and_fails(platform: Platform) -> None:
    platform.be_patient(2000)
    platform.rtcp("start", "--detach")
    platform.call("enable")
    loop = platform.pids()["loop"]
    os.kill(loop, signal.SIGSTOP)
    done = platform.rtcp("stop", check=5)
    said = f"the loop (process {loop}) did not end in time and was killed: its drives were left to their watchdog"
    assert said in done.stderr
    assert "stopped\n" not in done.stdout
    assert not lives(loop)


@SEVEN_SLAVES
def test_a_stop_names_the_slaves_that_did_not_come_to_init_and_fails(platform: Platform) -> None:
    platform.be_patient(2000)
    platform.rtcp("start", "--detach")
    with SegmentClient(segment_control(platform.directory)) as segment:
        segment.fault({"fault": "al_hang", "slave": 3})
        segment.fault({"fault": "cable", "after": 5})
    done = platform.rtcp("stop", check=5)
    assert "stopped, but: the slaves on ecat" in done.stderr
    assert "slave 3 (drive2) did not reach INIT: it is in " in done.stderr
    assert "slave 6 (drive5)" in done.stderr
    assert "slave 4" not in done.stderr


def test_a_stop_without_a_segment_says_that_no_frame_comes_back(platform: Platform) -> None:
    foreground = started(platform)
    kill(platform.pids()["segment"])
    foreground.send_signal(signal.SIGINT)
    said = foreground.communicate()
    assert foreground.returncode == 5, said
    assert "no frame comes back" in "".join(said)
    assert list(platform.directory.glob("*.sock")) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_the_foreground_start_stops_in_order_on_a_signal(platform: Platform, number: signal.Signals) -> None:
    foreground = started(platform)
    platform.call("enable")
    pids = platform.pids()
    foreground.send_signal(number)
    foreground.communicate()
    assert foreground.returncode == 0
    assert not any(lives(pid) for pid in pids.values())


def test_a_loop_that_is_terminated_alone_is_a_fault_of_the_foreground_start(platform: Platform) -> None:
    foreground = started(platform)
    pids = platform.pids()
    os.kill(pids["loop"], signal.SIGTERM)
    foreground.communicate()
    assert foreground.returncode == 5
    assert not any(lives(pid) for pid in pids.values())


@CUBEMARS
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
