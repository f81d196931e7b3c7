"""The distances that the cycle computes are those of the kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinematics import singularity_distances
from kinematics.forward import frames
from kinematics.model import ArmModel
from rtcp.motion.controllers.line import Singularities

from .guard_checker import MODEL

ANGLES = st.lists(st.floats(-pi, pi), min_size=6, max_size=6)


@given(q=ANGLES)
def test_each_distance_is_that_of_the_kinematics(q: Sequence[float]) -> None:
    distances = Singularities(MODEL).distances(frames(MODEL, q))
    assert tuple(distances) == pytest.approx(singularity_distances(MODEL, q)[:3], abs=1e-9)


@given(bend=st.floats(-0.1, 0.1))
def test_close_to_a_singularity_the_distance_is_the_angle_that_is_left(bend: float) -> None:
    distances = Singularities(MODEL).distances(frames(MODEL, [0.4, 0.9, bend, 0.3, bend, 0.1]))
    assert distances.elbow == pytest.approx(abs(bend), abs=1e-7)
    assert distances.wrist == pytest.approx(abs(bend), abs=1e-7)


def test_an_arm_without_a_spherical_wrist_has_none_of_them() -> None:
    rows = [*MODEL.rows[:5], replace(MODEL.rows[5], a=0.05)]
    model: ArmModel = replace(MODEL, rows=tuple(rows))
    assert singularity_distances(model, [0.2] * 6)[:3] == (None, None, None)
    assert tuple(Singularities(model).distances(frames(model, [0.2] * 6))) == (inf, inf, inf)
