"""The joints along a motion before it begins: for the display, and for checks against the boxes."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.motion.joint_motion import JointMotion
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import cubic, quintic, rotation, turn_between, turned_by, value
from rtcp.motion.planning.plan import ACCELERATIONS, CUBIC, KIND, LINE, POSITIONS, VELOCITIES, Plan
from rtcp.motion.state import ArmState

SAMPLES: Final = 60
"""Least number of configurations in the preview of a motion."""

JointPath = list[tuple[float, ...]]
"""Joint positions along the motion, rad, including start and end."""


def joint_move(
    limits: Limits, q_now: Sequence[float], q: Sequence[float], speed: float, synchronized: bool
) -> tuple[JointPath, float] | None:
    """Return the path of a joint move from rest and its duration, s; None: no plan is found."""
    motion, state = JointMotion(1e-3, limits.velocity, limits.acceleration, limits.jerk), ArmState(len(q_now))
    state.commanded = list(q_now)
    if not motion.move_to(state, q, speed, synchronized=synchronized):
        return None
    duration_s = motion.planned_duration_s
    return [motion.planned_position(duration_s * k / SAMPLES) for k in range(SAMPLES + 1)], duration_s


def planned(plan: Plan, q_now: Sequence[float], model: ArmModel | None) -> JointPath:
    """Return the path of a plan, in even steps of a trajectory's time or of a line's length."""
    if not plan.rows:
        return [tuple(q_now), plan.end]
    if plan.rows[0][KIND] == LINE:
        assert model is not None
        return _lines(plan, q_now, model)
    return _trajectory(plan, q_now)


def _lines(plan: Plan, q_now: Sequence[float], model: ArmModel) -> JointPath:
    inverse, q = InverseKinematics(model), tuple(q_now)
    path = [q]
    samples = max(2, SAMPLES // len(plan.rows))
    for row in plan.rows:
        start, (axis, angle) = rotation(row[3:7]), turn_between(row[3:7], row[10:14])
        for k in range(1, samples + 1):
            s = k / samples
            position = tuple(a + s * (b - a) for a, b in zip(row[0:3], row[7:10], strict=True))
            pose = Pose((position[0], position[1], position[2]), turned_by(start, axis, s * angle))
            q = inverse.solve_near(pose, q).q or q
            path.append(q)
    return path


def _trajectory(plan: Plan, q_now: Sequence[float]) -> JointPath:
    joints, times = len(q_now), [row[0] for row in plan.rows]
    path = [tuple(q_now)]
    pieces = list(pairwise(plan.rows))
    for k in range(1, SAMPLES + 1):
        t = plan.duration_s * k / SAMPLES
        if t <= times[0] or not pieces:
            continue  # before the first waypoint: the approach is planned in the loop
        before, after = pieces[min(bisect_left(times, t), len(pieces)) - 1]
        length = after[0] - before[0]
        row = []
        for i in range(joints):
            q0, v0, a0 = before[POSITIONS + i], before[VELOCITIES + i], before[ACCELERATIONS + i]
            q1, v1, a1 = after[POSITIONS + i], after[VELOCITIES + i], after[ACCELERATIONS + i]
            piece = cubic(q0, v0, q1, v1, length) if after[KIND] == CUBIC else quintic(q0, v0, a0, q1, v1, a1, length)
            row.append(value(piece, (t - before[0]) / length))
        path.append(tuple(row))
    path.append(plan.end)
    return path
