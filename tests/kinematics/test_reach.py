"""How far a pose is out of reach, of arms of any geometry."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose


def wrist_centres(model: ArmModel, chain, regional: np.ndarray) -> np.ndarray:
    """Of configurations (N, 3) of joints 1 to 3, m."""
    without_hand = replace(model, tool=Pose.from_xyzrpy(0.0, 0.0, -model.rows[5].d, 0.0, 0.0, 0.0))
    return chain(without_hand, np.hstack([regional, np.zeros_like(regional)]))[:, :3, 3]


def hand_at(model: ArmModel, point: np.ndarray) -> Pose:
    """A tool pose with the wrist centre at a point."""
    turn = Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.3, -0.8, 1.9)
    hand = Pose((0.0, 0.0, model.rows[5].d), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)) @ model.tool
    offset = (turn @ hand).position
    return Pose(tuple(np.add(point, offset).tolist()), (turn @ hand).rotation)


def test_far_out_of_reach_the_amount_is_the_distance_to_the_nearest_wrist_centre(build_arm, region, chain):
    for seed in range(4):
        model = build_arm(seed, region, "right-angled")
        centres = wrist_centres(model, chain, np.random.default_rng(1).uniform(-pi, pi, (200_000, 3)))
        middle, direction = centres.mean(axis=0), np.random.default_rng(seed).normal(size=3)
        point = middle + direction / np.linalg.norm(direction) * 2.5
        near = InverseKinematics(model).solve_near(hand_at(model, point), [0.0] * 6)
        nearest = np.linalg.norm(centres - point, axis=1).min()
        assert near.q is None
        assert nearest - 0.02 < near.out_of_reach <= nearest


def test_just_out_of_reach_the_amount_grows_from_nothing_with_the_distance(build_arm, region, chain):
    for seed in range(4):
        model = build_arm(seed, region, "right-angled")
        solver = InverseKinematics(model)
        inside = wrist_centres(model, chain, np.random.default_rng(seed).uniform(-pi, pi, (1, 3)))[0]
        direction = np.array([1.0, 0.4, -0.7])
        reached, beyond = 0.0, 5.0
        while beyond - reached > 1e-12:
            middle = 0.5 * (reached + beyond)
            if solver.solve(hand_at(model, inside + middle * direction)).solutions:
                reached = middle
            else:
                beyond = middle
        amounts = [
            solver.solve_near(hand_at(model, inside + (beyond + step) * direction), [0.0] * 6).out_of_reach
            for step in (1e-6, 2e-6, 4e-6)
        ]
        assert 0.0 < amounts[0] <= 1.3e-6
        assert np.divide(amounts, amounts[0]) == pytest.approx([1.0, 2.0, 4.0], rel=1e-2)


def test_beyond_a_stretched_arm_with_lateral_offset_the_amount_is_exact(assistive, chain):
    offset = 0.12
    rows = list(assistive.rows)
    rows[2] = replace(rows[2], d=offset)
    model = replace(assistive, rows=tuple(rows))
    for lean in (0.3, 0.9, -1.4):
        edge = wrist_centres(model, chain, np.array([[0.0, lean, 0.0]]))[0]
        along = edge - [0.0, edge[1], model.rows[0].d]
        # at right angles to what joints 1 and 2 move the wrist centre along
        normal = np.add(along, [0.0, edge[1] * along[0] / edge[0], 0.0])
        normal /= np.linalg.norm(normal)
        near = InverseKinematics(model).solve_near(hand_at(model, edge + 1e-6 * normal), [0.0] * 6)
        assert near.out_of_reach == pytest.approx(1e-6, rel=1e-3)


def test_inside_the_tube_of_a_lateral_offset_the_amount_is_the_distance_to_its_wall(assistive):
    rows = list(assistive.rows)
    rows[2] = replace(rows[2], d=0.12)
    model = replace(assistive, rows=tuple(rows))
    near = InverseKinematics(model).solve_near(hand_at(model, np.array([0.0, 0.12 - 1e-6, 0.9])), [0.0] * 6)
    assert near.out_of_reach == pytest.approx(1e-6, rel=1e-6)


def test_an_orientation_that_an_oblique_wrist_does_not_reach_is_told_so_with_the_angle(irb120, random_configurations):
    # Axis 6 is 0.05 to 0.65 rad from axis 4; the wrist of the arm as it is finds all positions of the forearm
    rows = (*irb120.rows[:4], replace(irb120.rows[4], alpha=0.30), replace(irb120.rows[5], alpha=-0.35))
    solver = InverseKinematics(replace(irb120, rows=rows))
    told = 0
    for q in random_configurations(irb120, 30):
        pose = forward(irb120, q.tolist())
        forearms = {frames(irb120, one.q)[3].rotation[2::3] for one in InverseKinematics(irb120).solve(pose).solutions}
        angles = np.arccos([np.dot(axis, pose.rotation[2::3]) for axis in forearms])
        missing = np.maximum(angles - 0.65, 0.05 - angles).min()
        near = solver.solve_near(pose, [0.0] * 6)
        if missing > 0.0:
            assert near.q is None
            assert near.reason.startswith(f"out of reach by {missing:.6g} rad")
            assert near.out_of_reach == 0.0
            told += 1
        else:
            assert solver.solve(pose).solutions
    assert 5 < told < 30
