"""Capsules of an arm: what lies inside, which may collide, and how far they are apart."""

from __future__ import annotations

import math
import random
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.capsules import Placed, between_axes, capsules, distance, from_box, self_pairs
from kinematics.forward import frames
from kinematics.model import ArmModel, Capsule
from kinematics.pose import IDENTITY, Pose, Vector
from kinematics.urdf import to_urdf
from tests.kinematics.arms import Change, irb120, random_configurations, with_general_rows, with_tool
from tests.kinematics.test_urdf import read, transform
from tests.samples import examples

BOX = (-0.3, -0.2, 0.1, 0.4, 0.5, 0.6)
NUMBER = st.one_of(st.sampled_from([-1.0, 0.0, 0.5, 1.0]), st.floats(-1.0, 1.0))
Segment = tuple[Vector, Vector]
POINT = st.tuples(NUMBER, NUMBER, NUMBER)
POSES = (IDENTITY,) * 7


def placed(*bodies: Capsule) -> Placed:
    arm = Placed(bodies)
    arm.place(POSES)
    return arm


def sampled(start: Vector, end: Vector, count: int = 401) -> np.ndarray:
    return np.linspace(0.0, 1.0, count)[:, None] * np.subtract(end, start) + start


def surface(body: ET.Element) -> np.ndarray:
    """Points on the edges of a cylinder or around a ball, in the frame of its link."""
    angles = np.linspace(0.0, 2.0 * math.pi, 60)
    sphere, cylinder = body.find("geometry/sphere"), body.find("geometry/cylinder")
    if sphere is not None:
        heights = np.linspace(-math.pi / 2, math.pi / 2, 30)[:, None]
        unit = np.stack(
            np.broadcast_arrays(np.cos(heights) * np.cos(angles), np.cos(heights) * np.sin(angles), np.sin(heights))
        )
        local = float(sphere.get("radius")) * unit.reshape(3, -1).T
    else:
        radius, length = float(cylinder.get("radius")), float(cylinder.get("length"))
        ring = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full_like(angles, 0.5 * length)], axis=1)
        local = np.concatenate([ring, ring * (1.0, 1.0, -1.0)])
    pose = transform(body.find("origin"))
    return local @ pose[:3, :3].T + pose[:3, 3]


BODIES = (
    Capsule(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.2), 0.1),
    Capsule(3, (0.01, 0.0, 0.0), (0.07, 0.1, 0.05), 0.06),
    Capsule(6, (0.0, 0.02, 0.1), (0.0, 0.02, 0.1), 0.03),
)


@pytest.mark.parametrize("change", [replace, with_tool, with_general_rows, lambda arm: replace(arm, bodies=BODIES)])
def test_all_bodies_of_the_urdf_lie_inside_the_capsules(change: Change, either: ArmModel) -> None:
    model = change(either)
    bodies = capsules(model)
    links = ET.fromstring(to_urdf(model)).findall("link")
    for q in random_configurations(model, 20).tolist():
        poses = (IDENTITY, *frames(model, q))
        around = Placed(bodies)
        around.place(poses[1:])
        ends = np.reshape(around.axes, (-1, 6))
        for link, pose in zip(links, poses, strict=True):
            for body in link.findall("collision"):
                points = surface(body) @ np.reshape(pose.rotation, (3, 3)).T + pose.position
                depth = np.full(len(points), -np.inf)
                for (start, along), radius in zip(ends.reshape(-1, 2, 3), around.radii, strict=True):
                    part = np.clip((points - start) @ along / max(along @ along, 1e-30), 0.0, 1.0)
                    depth = np.maximum(depth, radius - np.linalg.norm(points - start - part[:, None] * along, axis=1))
                assert depth.min() > -1e-4  # the file has four digits


def test_an_irb_120_has_a_capsule_for_each_rod() -> None:
    assert [body.link for body in capsules(irb120())] == [0, 2, 3, 3, 5]


def test_named_bodies_take_the_place_of_derived_ones(either: ArmModel) -> None:
    assert capsules(replace(either, bodies=BODIES)) == BODIES
    robot = ET.fromstring(to_urdf(replace(either, bodies=BODIES)))
    drawn = {
        link.get("name"): [shape.tag for shape in link.findall("collision/geometry/*")] for link in robot.iter("link")
    }
    assert {name: shapes for name, shapes in drawn.items() if shapes} == {
        "base_link": ["cylinder", "sphere", "sphere"],
        "link3": ["cylinder", "sphere", "sphere"],
        "link6": ["sphere"],
    }
    tip = robot.find("link[@name='link6']/collision")
    assert read(tip.find("origin"), "xyz") == [0.0, 0.02, 0.1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"link": 7}, "link is 7; 0 .the base. to 6 are allowed"),
        ({"start": (0.0, 1.0)}, "start has 2 numbers; 3 are required"),
        ({"end": (0.0, math.nan, 1.0)}, "end y is nan; a finite number is required"),
        ({"radius": 0.0}, "radius is 0.0; a positive number is required"),
    ],
)
def test_an_impossible_body_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(BODIES[0], **change)


# -- pairs ------------------------------------------------------------------------------------------------------------


def test_neighbours_and_bodies_that_meet_at_a_joint_do_not_collide(assistive: ArmModel, irb120: ArmModel) -> None:
    named = [
        [(capsules(arm)[i].link, capsules(arm)[j].link) for i, j in self_pairs(arm)] for arm in (assistive, irb120)
    ]
    # Link 1 and link 4 have no length: base and upper arm meet at the shoulder, forearm and hand at the wrist; the
    # elbow of an IRB 120 lies 70 mm beside its forearm, so that its hand can reach it.
    assert named[0] == [(0, 3), (0, 5), (2, 5)]
    assert named[1] == [(0, 3), (0, 3), (0, 5), (2, 5), (3, 5)]


def test_pairs_that_are_left_out_of_the_delivered_arms_overlap_in_every_configuration(either: ArmModel) -> None:
    bodies, around = capsules(either), Placed(capsules(either))
    left_out = [
        (i, j)
        for i, j in product(range(len(bodies)), repeat=2)
        if i < j and (i, j) not in self_pairs(either) and bodies[j].link - bodies[i].link > 1
    ]
    assert left_out
    for q in random_configurations(either, 500).tolist():
        around.place(frames(either, q))
        assert all(distance(around, around, (pair,))[0] < 0.0 for pair in left_out)


def test_named_bodies_that_overlap_at_home_are_checked(irb120: ArmModel) -> None:
    thick = tuple(replace(body, radius=0.2) for body in capsules(irb120))
    assert self_pairs(replace(irb120, bodies=thick))


# -- distances --------------------------------------------------------------------------------------------------------


@given(a=POINT, b=POINT, c=POINT, d=POINT)
@settings(max_examples=examples(300))
def test_no_points_of_two_segments_are_nearer_than_their_distance(a: Vector, b: Vector, c: Vector, d: Vector) -> None:
    axes = [*a, *np.subtract(b, a), *c, *np.subtract(d, c)]
    square, s, t = between_axes(axes, 0, axes, 6)
    apart = np.linalg.norm(sampled(a, b)[:, None] - sampled(c, d)[None], axis=2).min()
    assert 0.0 <= s <= 1.0
    assert 0.0 <= t <= 1.0
    assert math.sqrt(square) == pytest.approx(
        math.dist(np.add(a, s * np.subtract(b, a)), np.add(c, t * np.subtract(d, c)))
    )
    assert apart - 0.005 <= math.sqrt(square) <= apart + 1e-9


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (((0, 0, 0), (0, 0, 0)), ((0, 3, 4), (0, 3, 4)), 5.0),  # two points
        (((0, 0, 0), (0, 0, 0)), ((-1, 1, 0), (1, 1, 0)), 1.0),  # a point beside a segment
        (((-1, 1, 0), (1, 1, 0)), ((0, 0, 0), (0, 0, 0)), 1.0),
        (((0, 0, 0), (1, 0, 0)), ((0.5, 1, 0), (2, 1, 0)), 1.0),  # parallel, side by side
        (((0, 0, 0), (1, 0, 0)), ((2, 1, 0), (3, 1, 0)), math.sqrt(2.0)),  # parallel, one after the other
        (((0, 0, 0), (1, 0, 0)), ((3, 1, 0), (2, 1, 0)), math.sqrt(2.0)),  # parallel, against each other
        (((0, 0, 0), (1, 0, 0)), ((3, 0, 0), (2, 0, 0)), 1.0),  # on one line
        (((0, 0, 0), (1, 0, 0)), ((0.5, 0, 0), (2, 0, 0)), 0.0),  # on one line, overlapping
        (((-1, 0, 0), (1, 0, 0)), ((0, -1, 0.5), (0, 1, 0.5)), 0.5),  # crossing
        (((0, 0, 0), (1, 0, 0)), ((2, 2, 0), (2, 1, 0)), math.sqrt(2.0)),  # both at an end
    ],
)
def test_the_distance_of_special_segments(one: Segment, other: Segment, expected: float) -> None:
    first, second = (Capsule(0, start, end, 0.125) for start, end in (one, other))
    assert distance(placed(first), placed(second))[0] == pytest.approx(expected - 0.25, abs=1e-12)


def test_nearly_parallel_segments_are_as_far_apart_as_parallel_ones() -> None:
    numbers = random.Random(3)
    for _ in range(2000):
        turn = 10.0 ** numbers.uniform(-16, -4)
        axes = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, numbers.uniform(-1.5, 1.5), 0.3, 0.0, 0.8, turn, -turn]
        gap = max(axes[6] - 1.0, -(axes[6] + 0.8), 0.0)
        assert math.sqrt(between_axes(axes, 0, axes, 6)[0]) == pytest.approx(
            math.hypot(gap, 0.3), abs=2.0 * turn + 1e-7
        )


def test_the_least_of_all_pairs_is_found_and_named(irb120: ArmModel) -> None:
    one, other = Placed(capsules(irb120)), Placed(capsules(irb120))
    base = Pose.from_xyzrpy(0.7, 0.1, 0.0, 0.0, 0.0, math.pi)
    for q in random_configurations(irb120, 200).tolist():
        one.place(frames(irb120, q))
        other.place(frames(irb120, q[::-1]), base)
        every = {(i, j): distance(one, other, ((i, j),))[0] for i in range(5) for j in range(5)}
        least, i, j = distance(one, other)
        assert least == min(every.values()) == every[i, j]
        assert distance(one, other, [pair for pair in every if pair != (i, j)])[0] >= least


def test_without_bodies_nothing_is_near() -> None:
    assert distance(placed(), placed(BODIES[0])) == (math.inf, -1, -1)


def test_bodies_stand_where_the_base_of_their_arm_stands(irb120: ArmModel) -> None:
    base, q = Pose.from_xyzrpy(0.5, -0.2, 0.3, 0.3, 0.4, 2.0), [0.1, 0.2, -0.3, 0.4, 0.5, -0.6]
    moved, around = Placed(capsules(irb120)), Placed(capsules(irb120))
    moved.place(frames(irb120, q), base)
    around.place([base @ pose for pose in frames(irb120, q)])
    assert moved.axes[6:] == pytest.approx(around.axes[6:], abs=1e-15)
    assert moved.axes[:3] == pytest.approx(base.position)


# -- boxes ------------------------------------------------------------------------------------------------------------


def box_distance(points: np.ndarray) -> np.ndarray:
    beyond = np.maximum(np.array(BOX[:3]) - points, points - np.array(BOX[3:]))
    return np.where((beyond > 0).any(axis=1), np.linalg.norm(np.maximum(beyond, 0), axis=1), beyond.max(axis=1))


@given(a=POINT, b=POINT)
@settings(max_examples=examples(500))
def test_no_point_of_a_capsules_axis_is_nearer_to_a_box_than_their_distance(a: Vector, b: Vector) -> None:
    body = placed(Capsule(0, a, b, 0.05))
    apart, part = from_box(body, 0, BOX)
    every = box_distance(sampled(a, b, 4001))
    assert 0.0 <= part <= 1.0
    assert every.min() - 0.001 <= apart + 0.05 <= every.min() + 1e-9
    for within in (0.0, 0.2):
        rough = from_box(body, 0, BOX, within)[0]
        assert rough == apart or within <= rough <= apart + 1e-12
    assert box_distance(np.add(a, part * np.subtract(b, a))[None])[0] == pytest.approx(apart + 0.05, abs=1e-9)
