"""Exactly at a box's face the guards still answer, and no thin plate is crossed."""

from __future__ import annotations

import pytest

from kinematics.forward import frames
from rtcp.motion.guards.trajectory_guard import GuardResult

from .judge import ARM, MODEL, Judge, with_boxes

WIDE = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
Q = (0.3, -0.5, 1.2, 0.2, 0.7, -0.4)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("kept_in", [False, True])
def test_with_a_point_exactly_on_a_face_any_single_joint_may_be_asked_for(axis: int, kept_in: bool) -> None:
    x, y, z = frames(MODEL, Q)[6].position
    box = (*WIDE[:3], x, *WIDE[4:]) if kept_in else (x, y - 0.1, z - 0.1, x + 0.2, y + 0.1, z + 0.1)
    judge = Judge(with_boxes(box) if kept_in else with_boxes(WIDE, box), Q, 0.001)
    for sign in (1.0, -1.0):
        for _ in range(60):
            way = [sign * 0.5 * judge.dt if i == axis else 0.0 for i in range(6)]
            verdict = judge.ask(
                [q + w for q, w in zip(judge.state.commanded, way, strict=True)], tolerates_saturation=True
            )
            if axis == 5:
                assert verdict <= GuardResult.CLAMPED
        judge.ask([float("nan")] * 6, tolerates_saturation=False)
        judge.stop()


@pytest.mark.parametrize("dt", [0.0005, 0.01, 0.1])
@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-5])
@pytest.mark.parametrize("part", [0.01, 0.3, 0.99])
def test_a_plate_that_the_first_cycle_would_cross_is_not_crossed(dt: float, gap: float, part: float) -> None:
    q = (0.0, 0.6, 1.2, 0.0, 0.0, 0.0)
    x, y, z = frames(MODEL, q)[6].position
    # Joint 1 moves the tool along y; so far it comes in a cycle from rest.
    way = abs(x) * ARM.joints[0].acceleration * dt * dt
    low = y + gap
    judge = Judge(with_boxes(WIDE, (x - 0.3, low, z - 0.3, x + 0.3, low + part * way, z + 0.3)), q, dt)
    speed = ARM.joints[0].velocity if x > 0 else -ARM.joints[0].velocity
    for _ in range(50):
        judge.ask([judge.state.commanded[0] + speed * dt, *q[1:]], tolerates_saturation=True)
        assert frames(MODEL, judge.state.commanded)[6].position[1] <= low + 1e-9
