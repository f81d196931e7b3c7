"""What happens when a process is stopped, ended or killed."""

from __future__ import annotations

import os
import signal
import subprocess
import time

import numpy as np
import pytest

from rtcp.runtime.layout import FLAG_ALL_OP, FLAG_DC_LOCKED, RecordLayout
from rtcp.runtime.observer import Observer, record_type
from rtcp.runtime.paths import blackboard_file
from tests.e2e.conftest import Platform, gone, kill, lives

OP, SAFE_OP_ERROR, INIT = 0x08, 0x14, 0x01


def observe(platform: Platform) -> Observer:
    return Observer(blackboard_file(platform.directory))


def test_a_stop_leaves_slaves_in_init_and_nothing_behind(running: Platform) -> None:
    running.rtcp("enable")
    pids = running.pids()
    blackboard = blackboard_file(running.directory)
    os.kill(pids["loop"], signal.SIGTERM)
    gone(pids["loop"])
    assert running.al_states() == [INIT] * 7
    running.rtcp("stop")
    assert not any(lives(pid) for pid in pids.values())
    assert not blackboard.exists()
    assert not (running.directory / "control.sock").exists()
    assert "no platform is running" in running.rtcp("stop", check=4).stderr
    assert "no platform is running" in running.rtcp("status", check=4).stderr


def test_the_cycle_locks_onto_drifting_clocks_within_two_seconds_of_cycles(running: Platform) -> None:
    observer = observe(running)
    records, _ = observer.since(0)
    observer.close()
    locked = (records["flags"] & FLAG_DC_LOCKED) != 0
    assert int(records["cycle"][0]) < 100
    assert locked.any()
    assert int(records["cycle"][np.argmax(locked)]) * 500e-6 < 2.0
    # The slaves were asked to go to OP only then.
    assert not ((records["flags"] & FLAG_ALL_OP) != 0)[: np.argmax(locked)].any()


def test_a_second_run_starts_right_after_the_first(running: Platform) -> None:
    running.rtcp("enable")
    running.rtcp("stop")
    running.rtcp("start", "--detach")
    running.rtcp("enable")
    assert running.status()["state"] == "holding"


def test_the_foreground_start_stops_in_an_orderly_way_on_a_signal(platform: Platform) -> None:
    foreground = platform.background("start")
    end = time.monotonic() + 30
    while platform.rtcp("status", check=None).returncode != 0:
        assert time.monotonic() < end, platform.logs()
    platform.rtcp("enable")
    pids = platform.pids()
    foreground.send_signal(signal.SIGTERM)
    foreground.communicate()
    assert foreground.returncode in (0, 143)
    assert not any(lives(pid) for pid in pids.values())


def test_frames_lost_for_less_than_allowed_only_delay_the_motion(running: Platform) -> None:
    running.rtcp("enable")
    moving = running.background("move", "0.4", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until(lambda found: abs(found["joints"]["velocity"][0]) > 0.2, "motion")
    observer = observe(running)
    first = observer.head
    segment = running.pids()["segment"]
    os.kill(segment, signal.SIGSTOP)
    time.sleep(0.01)
    os.kill(segment, signal.SIGCONT)
    assert moving.wait() == 0
    records, _ = observer.since(first)
    observer.close()
    assert (records["wkc"] < 0).sum() >= 10
    assert np.abs(np.diff(records["target"], axis=0)).max() <= 0.5 * 500e-6 * 1.001
    assert running.status()["state"] == "holding"


def test_a_segment_that_stands_still_for_50_ms_does_not_take_the_cycle_off_its_grid(platform: Platform) -> None:
    running = platform
    running.be_patient(40)
    running.rtcp("start", "--detach")
    running.rtcp("enable")
    observer = observe(running)
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until(lambda found: abs(found["joints"]["velocity"][0]) > 0.2, "motion")
    segment = running.pids()["segment"]
    first = observer.head
    os.kill(segment, signal.SIGSTOP)
    time.sleep(0.05)
    os.kill(segment, signal.SIGCONT)
    time.sleep(0.1)
    records, lost = observer.since(first)
    assert lost == 0
    assert moving.wait() == 5
    without = records[records["wkc"] < 0]
    assert len(without) >= 50
    # The grid: every wake-up was planned a whole number of periods after the one before.
    planned = (records["time_ns"] - records["wakeup_ns"]).astype(np.int64)
    periods = np.diff(planned) / observer.period_ns
    assert np.abs(periods - np.round(periods)).max() < 0.02
    # A lost frame costs its cycle only: frameless cycles follow each other at the cycle's pace.
    waits = np.diff(without["time_ns"].astype(np.int64)) / observer.period_ns
    assert np.median(waits) < 1.5
    # No target moved on while nobody listened, none jumped afterwards.
    steps = np.abs(np.diff(records["target"], axis=0))
    assert steps.max() <= 0.5 * observer.period_ns * 1e-9 * 1.001
    observer.close()
    status = running.status()
    assert status["state"] == "fault"
    assert "process data lost" in status["message"] or "left OP" in status["message"]
    running.rtcp("reset")
    assert running.al_states() == [OP] * 7
    assert running.status()["state"] == "ready"
    running.rtcp("enable")
    running.rtcp("move", *["0"] * 6)


def test_a_killed_loop_leaves_the_drives_to_their_watchdog(running: Platform) -> None:
    running.rtcp("enable")
    pids = running.pids()
    kill(pids["loop"])
    end = time.monotonic() + 20
    while running.al_states()[1:] != [SAFE_OP_ERROR] * 6:
        assert time.monotonic() < end, running.al_states()
    status = running.status()
    assert status["state"] == "fault"
    assert "ended unexpectedly" in status["message"]
    assert running.rtcp("enable", check=5).stderr
    running.rtcp("stop")
    assert not any(lives(pid) for pid in pids.values())
    running.rtcp("start", "--detach")
    assert running.status()["state"] == "ready"


def test_a_killed_gateway_stops_the_motion_and_can_be_replaced(running: Platform) -> None:
    running.rtcp("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.3")
    running.until(lambda found: abs(found["joints"]["velocity"][0]) > 0.2, "motion")
    observer = observe(running)
    before = running.pids()
    kill(before["gateway"])
    assert moving.wait() in (4, 5)
    end = time.monotonic() + 20
    while True:
        latest = observer.latest()
        assert latest is not None
        if int(latest[0]["state"]) == 4 and abs(float(latest[0]["velocity"][0])) < 1e-3:
            break
        assert time.monotonic() < end
    observer.close()
    assert "start" in running.rtcp("status", check=4).stderr
    running.rtcp("start", "--detach")
    status = running.status()
    assert status["pids"]["loop"] == before["loop"]
    assert status["state"] == "holding"
    running.rtcp("move", *["0"] * 6)


def test_a_killed_segment_is_a_fault_that_a_new_start_mends(running: Platform) -> None:
    running.rtcp("enable")
    pids = running.pids()
    kill(pids["segment"])
    status = running.until(lambda found: found["state"] == "fault", "the fault")
    assert "process data lost" in status["message"]
    running.rtcp("stop")
    assert not any(lives(pid) for pid in pids.values())
    running.rtcp("start", "--detach")
    assert running.status()["state"] == "ready"


def test_a_defect_in_the_cycle_leaves_slaves_in_init(platform: Platform) -> None:
    # A defect cannot be ordered from outside: the interpreter's own start-up hook puts one into the real loop.
    hook = platform.directory / "hook"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(
        "import sys\n"
        "if 'rtcp.runtime.loop_process' in sys.orig_argv:\n"
        "    from rtcp.runtime.record import Recorder\n"
        "    publish = Recorder.publish\n"
        "    def defective(self, *given):\n"
        "        publish(self, *given)\n"
        "        if self._behaviour.moves:\n"
        "            raise ZeroDivisionError('a defect for the test')\n"
        "    Recorder.publish = defective\n"
    )
    platform.environment["PYTHONPATH"] = str(hook)
    platform.be_patient(200)
    platform.rtcp("start", "--detach")
    platform.rtcp("enable")
    loop = platform.pids()["loop"]
    assert platform.rtcp("move", "0.5", "0", "0", "0", "0", "0", check=5).stderr
    gone(loop)
    assert "a defect for the test" in platform.logs()
    assert platform.al_states() == [INIT] * 7
    assert "ended unexpectedly" in platform.status()["message"]


@pytest.mark.parametrize("name", ["gateway", "segment"])
def test_a_terminated_process_is_no_traceback(running: Platform, name: str) -> None:
    pids = running.pids()
    kill(pids[name], signal.SIGTERM)
    assert "Traceback" not in running.logs()
    running.rtcp("stop", check=None)
    assert not any(lives(pid) for pid in pids.values())


def test_the_record_layout_is_the_same_for_writer_and_reader() -> None:
    for joints in (1, 6, 7):
        assert record_type(RecordLayout(joints)).itemsize == RecordLayout(joints).size


def test_a_lost_terminal_does_not_leave_a_loop_behind(platform: Platform) -> None:
    foreground = subprocess.Popen(
        ["sh", "-c", "exec python3 -c 'import signal,os,sys; os.execvp(sys.argv[1], sys.argv[1:])' \"$@\"", "sh",
         *[os.fspath(part) for part in (os.sys.executable, "-m", "rtcp.cli", "start")]],  # type: ignore[attr-defined]
        env=platform.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    end = time.monotonic() + 30
    while platform.rtcp("status", check=None).returncode != 0:
        assert time.monotonic() < end, platform.logs()
    pids = platform.pids()
    foreground.send_signal(signal.SIGHUP)
    foreground.wait()
    assert not any(lives(pid) for pid in pids.values())
