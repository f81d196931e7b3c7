"""`rtcp record` on a whole platform: files against the cycles, and what recorder and gateway survive."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.ipc.errors import RtcpError
from rtcp.ipc.session import read_processes
from rtcp.telemetry.reading import read
from tests.telemetry.test_recorder import messages

from .conftest import CUBEMARS, Platform
from .wire import COUNTS_PER_RAD, inputs, outputs

pytestmark = pytest.mark.platform


def recordings(platform: Platform) -> list[dict[str, Any]]:
    recordings: list[dict[str, Any]] = json.loads(platform.rtcp("record", "status", "--json").stdout)["recordings"]
    return recordings


def test_a_move_is_recorded_cycle_by_cycle_while_the_gateway_is_killed(enabled: Platform) -> None:
    out = enabled.directory / "kept"
    enabled.rtcp("record", "start", "--format", "mcap,csv", "--out", str(out))
    enabled.rtcp("record", "start", "--out", str(out / "second.csv"))
    enabled.call("move_joints", q=[0.2, 0, 0, 0, 0, 0])
    os.kill(read_processes(enabled.directory).gateway, signal.SIGKILL)
    enabled.rtcp("start", "--detach")  # gives the loop a gateway
    enabled.call("move_joints", q=[0.0] * 6)
    stopped = json.loads(enabled.rtcp("record", "stop", "--json").stdout)["recordings"]
    assert [(file["missing"], file["problem"], file["running"]) for file in stopped] == [(0, "", False)] * 2
    (first,) = (recording for recording in stopped if len(recording["files"]) == 2)
    numbers = [record.number for record in messages(Path(first["files"][0]), "/cycle")]
    assert len(numbers) == first["records"]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert len(Path(first["files"][1]).read_text().splitlines()) == 1 + len(numbers)


@CUBEMARS
def test_the_columns_of_a_csv_are_those_of_the_frames_captured_at_the_segment(
    enabled: Platform, tmp_path: Path
) -> None:
    captured = tmp_path / "captured"
    enabled.call("move_joints", q=[0.0] * 6)
    with enabled.capture(captured):
        enabled.rtcp("record", "start", "--format", "mcap,csv", "--out", str(tmp_path))
        enabled.call("move_joints", q=[0.1, -0.1, 0.2, 0.1, 0.1, -0.2])
        enabled.rtcp("record", "stop")
    (out,), (beside,) = tmp_path.glob("*.csv"), tmp_path.glob("*.mcap")
    assert out.read_text().partition("\n")[0].split(",") == [
        "Time", *(f"J{axis}_{name}" for name in ("pos", "vel", "tor", "tpos") for axis in range(1, 7))
    ]  # fmt: skip
    counts = np.rint(np.loadtxt(out, delimiter=",", skiprows=1)[:, 1:] * COUNTS_PER_RAD).astype(int)
    shown = np.array([[getattr(drive, name) for name in ("position", "velocity", "torque") for drive in drives]
                      for _, drives in inputs(captured)])  # fmt: skip
    asked = np.array([[drive.position for drive in drives] for _, drives in outputs(captured, answered=True)])
    # The cycles of a stall repeat the values before it, and the segment does not answer a frame that waited for
    # long: the cycles between two stalls are compared separately. Without a stall all are compared at once.
    came = np.array([record.wkc == record.wkc_expected for record in messages(beside, "/cycle")])
    at = 0
    for run in np.ma.clump_masked(np.ma.masked_array(came, came)):  # type: ignore[no-untyped-call]
        rows = counts[run]
        n = len(rows)
        # A record has the answer to the frame of its cycle, and the targets that left with the next one.
        frame = (
            start
            for start in range(at, len(shown) - n + 1)
            if (shown[start : start + n] == rows[:, :18]).all()
            and (asked[start + 1 : start + n] == rows[:-1, 18:]).all()
        )
        start = next(frame, None)
        assert start is not None, f"cycles {run.start} to {run.stop - 1}"
        at = start + n
    assert np.ptp(counts[came], axis=0).min() > 0


def test_a_killed_recorder_is_reported_and_the_arm_moves_on(enabled: Platform) -> None:
    enabled.rtcp("record", "start", "--out", str(enabled.directory / "killed.mcap"))
    (running,) = (recording for recording in recordings(enabled) if recording["running"])
    os.kill(running["pid"], signal.SIGKILL)
    enabled.call("move_joints", q=[0.1, 0, 0, 0, 0, 0])
    (killed,) = (recording for recording in recordings(enabled) if recording["pid"] == running["pid"])
    assert "ended from outside" in killed["problem"]
    assert enabled.rtcp("record", "stop").stdout == "nothing is being recorded\n"


@pytest.mark.skipif(os.geteuid() != 0, reason="a mount needs root")
def test_a_full_disk_ends_the_recording_and_not_the_move(enabled: Platform, tmp_path: Path) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", tmp_path], check=True)
    try:
        moving = enabled.background("move", "1.2", "0", "0", "0", "0", "0", "--speed", "0.15")
        enabled.until_moving()
        enabled.call("record_start", out=str(tmp_path), formats=["mcap", "csv"], reserve_mb=0)

        def ended() -> dict[str, Any]:
            running = enabled.call("record_status")["recordings"]
            return next(recording for recording in running if str(tmp_path) in recording["files"][0])

        enabled.until(lambda _: not ended()["running"], "the end of the recording")
        assert ended()["problem"].endswith("cannot be written: No space left on device")
        assert enabled.status()["state"] == "moving"
        moving.communicate()
        assert moving.returncode == 0
        assert enabled.status()["joints"]["actual_position"][0] == pytest.approx(1.2, abs=1e-3)
        written = next(tmp_path.glob("*.mcap"))
        assert len(read(written, ["wkc"]).seconds) > 50
    finally:
        subprocess.run(["umount", "--lazy", tmp_path], check=True)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--format", "wav"], 2, "formats[0]: found"),
        (["--signals", "nothing"], 2, "nothing: there is no such signal"),
        (["--out", "/proc/nowhere"], 3, "/proc/nowhere cannot be written"),
        (["--seconds", "-1"], 2, "seconds: found -1"),
        (["--keep", "2"], 2, "keep: found 2 without max_file_mb or max_file_seconds"),
    ],
)
def test_what_cannot_be_recorded_ends_in_one_message(
    shared: Platform, arguments: list[str], code: int, said: str
) -> None:
    assert said in shared.rtcp("record", "start", *arguments, check=code).stderr


def test_a_refused_recording_has_its_reason_and_fields(shared: Platform) -> None:
    with pytest.raises(RtcpError) as refused:
        shared.call("record_start", signals=["nothing"])
    assert (refused.value.kind, refused.value.reason) == ("invalid", "unknown_signal")
    assert refused.value.fields["signal"] == "nothing"
    assert "actual_position" in refused.value.fields["allowed"]


def test_the_recording_of_the_arms_file_runs_once_whatever_becomes_of_the_gateway() -> None:
    platform = Platform()
    try:
        out = start_with(platform, "{out: OUT, formats: [mcap, csv], max_file_seconds: 3600, keep: 2}")
        platform.until(lambda _: any(recording["running"] for recording in recordings(platform)), "a recording")
        (before,) = recordings(platform)
        assert before["files"] == sorted(map(str, out.iterdir()), reverse=True)
        os.kill(read_processes(platform.directory).gateway, signal.SIGKILL)
        platform.rtcp("start", "--detach")
        (ended,) = json.loads(platform.rtcp("record", "stop", "--json").stdout)["recordings"]
        assert (ended["pid"], ended["missing"], ended["problem"]) == (before["pid"], 0, "")
        os.kill(read_processes(platform.directory).gateway, signal.SIGKILL)
        platform.rtcp("start", "--detach")
        platform.call("enable")  # by then the gateway has begun what it begins at its start
        assert [recording["running"] for recording in recordings(platform)] == [False]
    finally:
        platform.end()


def test_a_recording_that_cannot_start_with_the_platform_is_reported_and_the_end_completes_another() -> None:
    platform = Platform()
    try:
        start_with(platform, "{out: /proc/nowhere}")
        wanted = "the recording of the arm's file (recording) does not run: /proc/nowhere cannot be written"
        platform.until(lambda status: any(message.startswith(wanted) for message in status["messages"]), "the message")
        platform.call("enable")
        out = platform.directory / "whole.mcap"
        platform.rtcp("record", "start", "--out", str(out))
        platform.rtcp("stop")
        assert out.read_bytes()[-8:] == b"\x89MCAP0\r\n"
        assert not list(platform.directory.glob("recorder-*.json"))
    finally:
        platform.end()


def start_with(platform: Platform, recording: str) -> Path:
    """Start a platform whose arm's file has this `recording`; OUT stands for the directory that is returned."""
    platform.be_patient(2000)
    out = platform.directory / "out"
    with open(platform.environment["RTCP_CONFIG"], "a") as file:
        file.write(f"\nrecording: {recording.replace('OUT', str(out))}\n")
    platform.rtcp("start", "--detach")
    return out
