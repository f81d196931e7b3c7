"""The arm that the virtual drives turn: weights and pushes as torques of the joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from kinematics.forward import forward, frames
from kinematics.pose import applied
from rtcp.config import default_config, load, load_segment, segment_path
from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.virtual.arm import PERIOD, make_arm
from rtcp.virtual.faults.fault import FaultRefused, Frames
from rtcp.virtual.faults.slaves import Push
from rtcp.virtual.models import CubemarsDrive, create
from rtcp.virtual.segment import make_segment

ARM = load(default_config())
MODEL = ARM.arm
Q = (0.3, -0.5, 1.4, 0.4, 0.9, -0.7)
STEP = 1e-5


def slopes(function: Callable[[Sequence[float]], float]) -> list[float]:
    """The derivatives of a function of the joints at Q."""
    derivatives = []
    for joint in range(6):
        ahead, behind = ([q + sign * STEP * (i == joint) for i, q in enumerate(Q)] for sign in (1.0, -1.0))
        derivatives.append((function(ahead) - function(behind)) / (2.0 * STEP))
    return derivatives


def energy(q: Sequence[float]) -> float:
    """Potential energy of the links, J."""
    links = zip(frames(MODEL, q), MODEL.links, strict=False)
    heights = ((link.mass, position[2] + applied(rotation, link.centre)[2]) for (position, rotation), link in links)
    return sum(9.80665 * mass * height for mass, height in heights)


def test_the_joints_feel_the_weight_of_all_links_and_a_push_by_its_work_beside_what_others_set() -> None:
    segment = make_segment(load_segment(segment_path(ARM)), 0)
    drives = [slave.device for slave in segment.slaves if isinstance(slave.device, CubemarsDrive)]
    for drive, q in zip(drives, Q, strict=True):
        drive.mechanics.position = q
    drives[1].mechanics.external_torque += 5.0
    segment.tick(PERIOD)
    weight = [-slope for slope in slopes(energy)]
    weight[1] += 5.0
    assert [drive.mechanics.external_torque for drive in drives] == pytest.approx(weight, abs=1e-6)
    end = Push(x=3.0, y=-7.0, z=2.0).start(segment, Frames(lambda frame: None), 0)
    end_of_second = Push(x=1.0).start(segment, Frames(lambda frame: None), 0)
    segment.tick(2 * PERIOD)
    work = slopes(lambda q: sum(a * b for a, b in zip((4.0, -7.0, 2.0), forward(MODEL, q).position, strict=True)))
    expected = [a + b for a, b in zip(weight, work, strict=True)]
    assert [drive.mechanics.external_torque for drive in drives] == pytest.approx(expected, abs=1e-6)
    end(0)
    end_of_second(0)
    segment.tick(3 * PERIOD)
    assert [drive.mechanics.external_torque for drive in drives] == pytest.approx(weight, abs=1e-6)


def test_a_segment_that_names_no_arm_has_nothing_to_push() -> None:
    slaves = tuple(SegmentSlave(model="cubemars-orh40") for _ in range(6))
    segment = make_segment(SegmentConfig(slaves, Path()), 0)
    with pytest.raises(FaultRefused, match="no arm to push"):
        Push(x=1.0).start(segment, Frames(lambda frame: None), 0)


def test_an_arm_without_geometry_and_a_segment_with_too_few_drives_have_none(tmp_path: Path) -> None:
    drives = [create("cubemars-orh40") for _ in range(6)]
    file = tmp_path / "arm.yaml"
    file.write_text("name: bare\n")
    assert make_arm(SegmentConfig((), Path(), file), drives) is None
    assert make_arm(SegmentConfig((), Path(), default_config()), drives[:5]) is None
