"""Paths of the rod through stable equilibria."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from kinematics.pose import IDENTITY, Pose, rotation_from_rpy
from rtcp.ipc.errors import Refused
from rtcp.processes.rod import (
    Equilibrium,
    Form,
    Rod,
    bend,
    continuation,
    follow_parameters,
    follow_pose,
    integrate,
    pre_bend,
    sample_equilibrium,
)
from rtcp.processes.rod.statics import pose_error

ROD = Rod(0.3, 1e-3)
END = Pose((0.22, 0.05, 0.08), rotation_from_rpy(0.5, -0.3, 0.4))


def assert_continuous_and_stable(steps: tuple[Equilibrium, ...]) -> None:
    assert all(step.is_stable and step.largest_strain <= step.rod.usable_strain for step in steps[1:])
    moves = [np.abs(after.p - before.p).max() for before, after in pairwise(steps)]
    assert max(moves) <= 0.025 * steps[0].rod.length


def test_a_straight_rod_is_brought_to_its_end_pose_through_stable_equilibria() -> None:
    steps = bend(ROD, END)
    assert steps[0].end.position == pytest.approx((0.3, 0.0, 0.0))
    assert np.abs(pose_error(steps[-1], END)).max() < 1e-9
    assert_continuous_and_stable(steps)


@pytest.mark.parametrize("side", [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.6, -0.8)])
def test_a_straight_rod_bends_to_the_chosen_side(side: tuple[float, float]) -> None:
    steps = pre_bend(ROD, side)
    assert_continuous_and_stable(steps)
    lateral = steps[-1].p[-1, 1:]
    assert lateral / np.linalg.norm(lateral) == pytest.approx(side, abs=1e-9)


def test_a_thick_rod_is_bent_onto_its_plateau_to_an_arc_of_the_same_shape() -> None:
    thick = Rod(0.3, 3e-3)
    arc = pre_bend(thick, (1.0, 0.0), 2.0)[-1]
    assert not arc.is_linear
    assert arc.end.position == pytest.approx((0.15 * np.sin(2.0), 0.15 * (1.0 - np.cos(2.0)), 0.0), abs=1e-7)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("form", list(Form))
def test_random_shapes_are_reached_by_their_parameters(form: Form, seed: int) -> None:
    wanted = sample_equilibrium(ROD, form, np.random.default_rng(seed))
    steps = follow_parameters(pre_bend(ROD, (1.0, 0.0))[-1], wanted.a)
    assert steps[-1].p == pytest.approx(wanted.p)
    assert_continuous_and_stable(steps)


def test_a_way_back_leads_to_where_it_came_from() -> None:
    steps = bend(ROD, END)
    bent = next(step for step in steps if step.rotations[-1][0, 0] < np.cos(0.39))
    back = follow_pose(steps[-1], bent.end)
    assert back[-1].p == pytest.approx(bent.p, abs=1e-6)


@pytest.mark.parametrize(
    ("rod", "end", "reason", "field"),
    [
        (ROD, Pose((0.301, 0.0, 0.0), IDENTITY.rotation), "rod_out_of_reach", "distance"),
        (ROD, Pose((0.3 - 1e-8, 0.0, 0.0), IDENTITY.rotation), "rod_straight", "distance"),
        (Rod(0.3, 3.2e-3), Pose((0.1, 0.1, 0.0), rotation_from_rpy(0.0, 0.0, -1.0)), "rod_strain", "strain"),
        (ROD, Pose((0.25, 0.08, 0.0), IDENTITY.rotation), "rod_unstable", "conjugate_point"),
    ],
)
def test_an_end_pose_that_cannot_be_is_refused_with_its_numbers(rod: Rod, end: Pose, reason: str, field: str) -> None:
    with pytest.raises(Refused) as refused:
        bend(rod, end)
    assert refused.value.reason == reason
    assert field in refused.value.fields


def test_an_unstable_goal_is_refused() -> None:
    unstable = integrate(ROD, [0.0, 0.0, 0.2, -50.0, 0.0, 0.0])
    with pytest.raises(Refused, match="snap") as refused:
        follow_parameters(pre_bend(ROD, (1.0, 0.0))[-1], unstable.a)
    assert refused.value.reason == "rod_unstable"


def test_a_rod_too_thick_for_any_shape_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(continuation, "_ATTEMPTS", 10)
    with pytest.raises(Refused):
        sample_equilibrium(Rod(0.05, 20e-3), Form.S, np.random.default_rng(0))
