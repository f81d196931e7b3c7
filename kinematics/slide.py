"""The solution that a small step leads to, by least squares: for where singularities meet.

A closed form finds the joints one after the other. What it has to choose at one singularity (a free joint), or cannot
know there (the bend of a stretched arm is known to 1e-8), the joints after it have to make good, and beside a second
singularity they do so by a jump. Least squares give all joints at once the smallest step that makes the pose good.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul

from kinematics.forward import frames
from kinematics.jacobian import jacobian_columns
from kinematics.linear import gram, solve_positive
from kinematics.model import ArmModel
from kinematics.pose import Pose
from kinematics.solution import Six, six

_STEPS = 7  # at most; mostly two or three do, and on the edge of the workspace each halves what is left
_DAMPING, _RELAXATION, _LEAST_DAMPING = 1e-3, 1e-3, 1e-13
_ENOUGH = 1e-28  # m^2 and rad^2: what is left comes back multiplied, from beside a singularity
_REACHED = (5e-10) ** 2
_HOPEFUL = 1e-4  # of the square at the start, which three steps have to get below


def pose_error(wanted: Pose, actual: Pose) -> list[float]:
    """What moves one pose to another that is near: three lengths (m) and three angles (rad) in the base frame."""
    (x, y, z), (a, b, c, d, e, f, g, h, i) = wanted
    (px, py, pz), (j, k, m, n, o, p, q, r, s) = actual
    return [
        x - px,
        y - py,
        z - pz,
        0.5 * (n * g - q * d + o * h - r * e + p * i - s * f),
        0.5 * (q * a - j * g + r * b - k * h + s * c - m * i),
        0.5 * (j * d - n * a + k * e - o * b + m * f - p * c),
    ]


def slide(model: ArmModel, pose: Pose, q_near: Sequence[float]) -> Six | None:
    """The configuration at `pose` that the smallest joint steps from `q_near` (rad) lead to, or None.

    Damped least squares (Marquardt 1963) with a damping that falls with every step, 0.1 ms each. Gives up when the
    first three do not bring the tool much nearer: the pose is then none that a small step reaches.
    """
    q = list(q_near)
    damping = _DAMPING
    poses = frames(model, q)
    error = pose_error(pose, poses[6])
    cost = start = sum(map(mul, error, error))
    for step in range(_STEPS):
        if cost < _ENOUGH or (step == 3 and cost > _HOPEFUL * start):
            break
        columns = jacobian_columns(poses)
        matrix = gram(list(zip(*columns, strict=True)))
        for index, row in enumerate(matrix):
            row[index] += damping
        weights = solve_positive(matrix, error)
        if weights is None:
            break
        q = [angle + sum(map(mul, column, weights)) for angle, column in zip(q, columns, strict=True)]
        poses = frames(model, q)
        error = pose_error(pose, poses[6])
        cost = sum(map(mul, error, error))
        damping = max(_LEAST_DAMPING, _RELAXATION * damping)
    return six(q) if cost < _REACHED else None
