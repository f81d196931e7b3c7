"""`rtcp record` on a whole platform: files against the cycles, and what recorder and gateway survive."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.ipc.session import read_processes
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
