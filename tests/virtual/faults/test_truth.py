"""What the joints of a segment truly do: told when asked, watched from the first question on."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from rtcp.config.segment import load_segment
from rtcp.virtual.faults.client import SegmentClient
from rtcp.virtual.faults.truth import Truth
from rtcp.virtual.models import CubemarsDrive
from rtcp.virtual.server import make_segment
from tests.virtual.faults.conftest import BeginSegment
from tests.virtual.line import MS

FALLING = "{load_mass_moment: 2.0, holding_torque: 0, initial_position: 0.5, viscous_friction: 6}"
"""It sinks to the bottom within two seconds and stays there."""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """An IO box, a drive that rests, and one without a brake whose load falls."""
    path = tmp_path / "segment.yaml"
    lines = ("model: diewu-io", "model: cubemars-orh70", f"model: cubemars-orh70, options: {FALLING}")
    path.write_text("slaves:\n" + "".join(f"  - {{{line}}}\n" for line in lines), encoding="utf-8")
    return path


def watched(config: Path) -> tuple[Truth, CubemarsDrive]:
    loaded = load_segment(config)
    segment = make_segment(loaded, 0)
    drive = segment.slaves[1].device
    assert isinstance(drive, CubemarsDrive)
    return Truth(segment, [slave.model for slave in loaded.slaves]), drive


def test_the_last_motion_and_the_largest_velocity_are_kept(config: Path) -> None:
    truth, drive = watched(config)
    assert not truth.watching
    truth.answer(MS)
    assert truth.watching
    for now, velocity in ((2 * MS, 0.5), (3 * MS, -0.8), (4 * MS, 0.0021), (5 * MS, 0.0019), (6 * MS, 0.0)):
        drive.mechanics.velocity = velocity
        truth.look(now)
    told = truth.answer(7 * MS)["slaves"][1]
    assert (told["moved_ns"], told["peak_rad_s"], told["velocity_rad_s"]) == (4 * MS, 0.8, 0.0)


def test_the_largest_velocity_counts_from_when_it_was_cleared(config: Path) -> None:
    truth, drive = watched(config)
    drive.mechanics.velocity = 0.8
    truth.answer(MS)
    truth.clear_peaks()
    drive.mechanics.velocity = 0.3
    assert truth.answer(2 * MS)["slaves"][1]["peak_rad_s"] == 0.3


def test_a_real_segment_tells_of_a_load_that_falls_without_any_master(
    begin_segment: BeginSegment, config: Path, tmp_path: Path
) -> None:
    path = tmp_path / "segment.sock"
    process = begin_segment("--control", str(path), config=config)
    assert process.stdout is not None
    assert process.stdout.readline()
    with SegmentClient(path) as client:
        told = [client.truth()]
        while told[-1]["slaves"][2]["velocity_rad_s"] or not told[-1]["slaves"][2]["moved_ns"]:
            time.sleep(0.2)
            told.append(client.truth())
    _, resting, fallen = told[-1]["slaves"]
    assert (resting["moved_ns"], resting["peak_rad_s"]) == (0, 0.0)
    assert fallen["position_rad"] == pytest.approx(3.14, abs=0.1)
    assert fallen["peak_rad_s"] > 1.0
    asked = {each["time_ns"] for each in told}
    speeds = {abs(each["slaves"][2]["velocity_rad_s"]) for each in told}
    assert fallen["moved_ns"] not in asked or fallen["peak_rad_s"] not in speeds, "it is watched between the questions"
    assert min(asked) < fallen["moved_ns"] < max(asked)
