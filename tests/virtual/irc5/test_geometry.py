"""The controller's forward kinematics against the data sheet, and against that of the master's side."""

from __future__ import annotations

from math import radians

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinematics.forward import forward
from rtcp.config.find import find_arm
from rtcp.config.loader import load_mechanics
from rtcp.virtual.irc5.geometry import Geometry

ARM = load_mechanics(find_arm("abb_irb120"))
GEOMETRY = Geometry([(row.alpha, row.a, row.d, row.offset) for row in ARM.rows])


def test_the_flange_of_an_irb_120_at_zero_is_where_its_data_sheet_says() -> None:
    pose = GEOMETRY.flange((0.0,) * 6)
    assert pose.position == pytest.approx((374.0, 0.0, 630.0))
    assert pose.orientation == pytest.approx((0.5**0.5, 0.0, 0.5**0.5, 0.0))


@given(st.lists(st.floats(-400.0, 400.0), min_size=6, max_size=6))
def test_pose_and_rotation_are_those_of_the_kinematics_package(joints: list[float]) -> None:
    pose = GEOMETRY.flange(joints)
    expected = forward(ARM, [radians(joint) for joint in joints])
    assert [value / 1000.0 for value in pose.position] == pytest.approx(expected.position, abs=1e-9)
    w, x, y, z = pose.orientation
    assert w * w + x * x + y * y + z * z == pytest.approx(1.0)
    assert (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ) == pytest.approx(expected.rotation, abs=1e-9)  # fmt: skip
