"""The square: its place, its evaluation, and its picture."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinematics import forward
from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, Box
from rtcp.ipc.observer import record_type
from rtcp.ipc.schema import arm_schema
from rtcp.telemetry.reading import Recorded
from rtcp.telemetry.square import PLANES, SIDE_M, NoSquare, Square, distance_from, draw, judge, place

CONFIG = load(default_config())


def recorded(square: Square, config: ArmConfig, off_m: float) -> Recorded:
    """A recording in which the commanded tool goes along the square and the actual one beside it, in z."""
    from kinematics import InverseKinematics, Pose

    assert config.arm is not None
    inverse = InverseKinematics(config.arm)
    rotation = forward(config.arm, square.start).rotation
    corners = np.array(square.corners)
    points = np.concatenate([a + (b - a) * np.linspace(0, 1, 50)[:, None] for a, b in itertools.pairwise(corners)])
    records = np.zeros(len(points), dtype=record_type(arm_schema(6)))
    near = square.start
    for number, (x, y, z) in enumerate(points):
        solution = inverse.solve_near(Pose((x, y, z), rotation), near)
        beside = inverse.solve_near(Pose((x, y, z + off_m), rotation), near)
        assert solution.q is not None
        assert beside.q is not None
        near = solution.q
        records[number]["sent_position"], records[number]["actual_position"] = solution.q, beside.q
    seconds = 0.001 * np.arange(len(records), dtype=np.float64)
    return Recorded(Path("square.mcap"), {}, config, records, seconds, 0.001, 0, (), (), False)


@pytest.mark.parametrize("plane", PLANES)
def test_a_square_lies_in_its_plane_with_its_sides(plane: str) -> None:
    square = place(CONFIG, plane)
    corners = np.array(square.corners)
    assert np.allclose(np.linalg.norm(np.diff(corners, axis=0), axis=1), SIDE_M)
    across, up = PLANES[plane]
    left = ({0, 1, 2} - {across, up}).pop()
    assert np.ptp(corners[:, left]) == pytest.approx(0.0, abs=1e-12)
    assert CONFIG.arm is not None
    assert forward(CONFIG.arm, square.start).position == pytest.approx(square.corners[0], abs=1e-12)


def test_an_arm_without_room_is_told_where_its_bounds_stand() -> None:
    small = Box((-0.1, -0.1, 1.0), (0.1, 0.1, 1.4))
    config = replace(CONFIG, cartesian=replace(CONFIG.cartesian, box=small))
    with pytest.raises(NoSquare, match=r"joints\[\]\.position.*cartesian"):
        place(config, "xy")


def test_an_arm_without_geometry_is_told_so() -> None:
    with pytest.raises(NoSquare, match="key kinematics"):
        place(replace(CONFIG, arm=None), "xy")


def test_the_distance_is_that_from_the_nearest_side() -> None:
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 0)]
    points = np.array([(0.5, 0.0, 0.0), (0.5, 0.1, 0.0), (0.5, 0.5, 0.0), (1.3, 1.4, 0.0), (0.2, 0.5, 0.3)])
    assert distance_from(corners, points) == pytest.approx([0.0, 0.1, 0.5, 0.5, np.hypot(0.2, 0.3)])


def test_what_is_beside_the_square_is_measured_and_drawn(tmp_path: Path) -> None:
    square = place(CONFIG, "xy")
    assert CONFIG.arm is not None
    driven = judge(CONFIG.arm, square, recorded(square, CONFIG, 0.002))
    commanded, actual = driven.worst
    assert commanded < 1e-6
    assert actual == pytest.approx(0.002, abs=1e-5)
    draw(driven, tmp_path / "square.png")
    assert (tmp_path / "square.png").stat().st_size > 20_000


def test_a_recording_without_motion_is_none() -> None:
    square = place(CONFIG, "xy")
    assert CONFIG.arm is not None
    still = replace(recorded(square, CONFIG, 0.0), records=np.zeros(10, dtype=record_type(arm_schema(6))))
    with pytest.raises(NoSquare, match="nothing moved"):
        judge(CONFIG.arm, square, still)
