"""The true motion of a segment's joints: reported on request, watched from the first request on."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from rtcp.config.segment import load_segment
from rtcp.virtual.faults.control import PATIENCE, GroundTruth, SegmentClient
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.models import CubemarsDrive
from rtcp.virtual.segment import Segment, make_segment
from rtcp.virtual.slave import Slave
from tests.virtual.faults.conftest import BeginSegment
from tests.virtual.line import MS

FALLING = "{load_mass_moment: 2.0, holding_torque: 0, initial_position: 0.5, viscous_friction: 6}"
"""A load that sinks to the bottom within two seconds and stays there."""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """An IO box, a drive that rests, and one without a brake whose load falls."""
    path = tmp_path / "segment.yaml"
    lines = ("model: diewu-io", "model: cubemars-orh70", f"model: cubemars-orh70, options: {FALLING}")
    path.write_text("slaves:\n" + "".join(f"  - {{{line}}}\n" for line in lines), encoding="utf-8")
    return path


def watched(config: Path) -> tuple[GroundTruth, Segment]:
    loaded = load_segment(config)
    segment = make_segment(loaded, 0)
    return GroundTruth(segment, [slave.model for slave in loaded.slaves]), segment


def drive_of(slave: Slave) -> CubemarsDrive:
    assert isinstance(slave.device, CubemarsDrive)
    return slave.device


def test_the_last_motion_and_the_largest_velocity_are_kept(config: Path) -> None:
    truth, segment = watched(config)
    slave = segment.slaves[1]
    drive = drive_of(slave)
    assert not truth.watching
    truth.answer(MS)
    assert truth.watching
    for now, velocity in ((2 * MS, 0.5), (3 * MS, -0.8), (4 * MS, 0.0021), (5 * MS, 0.0019), (6 * MS, 0.0)):
        drive.mechanics.velocity = velocity
        truth.update(slave, now)
    joint = truth.answer(7 * MS)["slaves"][1]
    assert (joint["moved_ns"], joint["peak_rad_s"], joint["velocity_rad_s"]) == (4 * MS, 0.8, 0.0)


def test_the_largest_velocity_counts_from_when_it_was_cleared(config: Path) -> None:
    truth, segment = watched(config)
    drive = drive_of(segment.slaves[1])
    drive.mechanics.velocity = 0.8
    truth.answer(MS)
    truth.clear_peaks(MS)
    drive.mechanics.velocity = 0.3
    assert truth.answer(2 * MS)["slaves"][1]["peak_rad_s"] == 0.3


def test_a_step_updates_the_stepped_joint_alone(config: Path) -> None:
    truth, segment = watched(config)
    io, stepped, other = segment.slaves
    truth.answer(MS)
    drive_of(stepped).mechanics.velocity = drive_of(other).mechanics.velocity = 0.5
    truth.update(io, 2 * MS)
    truth.update(stepped, 3 * MS)
    drive_of(stepped).mechanics.velocity = drive_of(other).mechanics.velocity = 0.0
    slaves = truth.answer(4 * MS)["slaves"]
    assert [(slave["moved_ns"], slave["peak_rad_s"]) for slave in slaves[1:]] == [(3 * MS, 0.5), (0, 0.0)]


def test_nothing_is_watched_any_more_when_nobody_has_asked_for_long_and_everything_from_the_next_request_on(
    config: Path,
) -> None:
    truth, segment = watched(config)
    slave = segment.slaves[1]
    truth.requested(0)
    assert not truth.watching, "requests, but none for the truth"
    truth.answer(MS)
    truth.update(slave, MS + PATIENCE)
    assert truth.watching
    truth.requested(2 * MS)
    truth.update(slave, 2 * MS + PATIENCE)
    assert truth.watching
    truth.update(slave, 2 * MS + PATIENCE + 1)
    assert not truth.watching
    truth.requested(3 * PATIENCE)
    assert truth.watching


def test_the_segment_says_which_slave_it_has_stepped(config: Path) -> None:
    _, segment = watched(config)
    segment.tick(2 * MS)
    stepped = []
    while segment.busy:
        stepped.append(segment.step_one())
    assert stepped == list(segment.slaves)
    assert segment.step_one() is None


def test_a_real_segment_reports_a_falling_load_without_any_master(
    begin_segment: BeginSegment, config: Path, tmp_path: Path
) -> None:
    path = tmp_path / "segment.sock"
    process = begin_segment("--control", str(path), config=config)
    assert process.stdout.readline()
    with SegmentClient(path) as client:
        answers = [client.truth()]
        while answers[-1]["slaves"][2]["velocity_rad_s"] or not answers[-1]["slaves"][2]["moved_ns"]:
            time.sleep(0.2)
            answers.append(client.truth())
    _, resting, fallen = answers[-1]["slaves"]
    assert (resting["moved_ns"], resting["peak_rad_s"]) == (0, 0.0)
    assert fallen["position_rad"] == pytest.approx(3.14, abs=0.1)
    assert fallen["peak_rad_s"] > 1.0
    instants = {each["time_ns"] for each in answers}
    speeds = {abs(each["slaves"][2]["velocity_rad_s"]) for each in answers}
    assert fallen["moved_ns"] not in instants or fallen["peak_rad_s"] not in speeds, "it is watched between requests"
    assert min(instants) < fallen["moved_ns"] < max(instants)


def test_an_output_is_stamped_when_frames_change_it_with_the_clock_of_its_slave(config: Path) -> None:
    truth, segment = watched(config)
    box = segment.slaves[0]
    assert truth.edges(1, 10, MS) == []
    watch = box.application.outputs_watch
    for at, outputs in enumerate((b"\x00\x00", b"\x00\x02", b"\xff\x02", b"\x00\x00", b"\x00\x00", b"\x00\x02")):
        watch(memoryview(outputs), (2 + at) * MS)
    assert truth.edges(1, 10, 10 * MS) == [box.clock.local(at * MS) for at in (3, 5, 7)]
    assert truth.edges(1, 10, 10 * MS) == []
    truth.update(box, 10 * MS + PATIENCE + 1)
    assert box.application.outputs_watch is None


@pytest.mark.parametrize(("slave", "output"), [(1, 0), (1, 17), (2, 1), (0, 1), (9, 1)])
def test_an_output_that_is_not_there_is_refused(config: Path, slave: int, output: int) -> None:
    truth, _ = watched(config)
    with pytest.raises(FaultRefused, match=f"slave {slave} has no output {output}"):
        truth.edges(slave, output, MS)
