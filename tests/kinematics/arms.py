"""Arms from their data sheets, random arms, forward kinematics as 4x4 matrices, and how much the tests try.

Nothing here uses the code under test except the model and the pose. `RTCP_THOROUGH=1` runs the full counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf, pi, radians

import numpy as np
from numpy.typing import ArrayLike

from kinematics.model import ArmModel, DhRow, JointLimit
from kinematics.pose import Pose
from tests.samples import THOROUGH

Change = Callable[[ArmModel], ArmModel]

TOOL = Pose.from_xyzrpy(0.03, -0.02, 0.11, 0.4, -1.2, 2.1)


def count(quick: int, slow: int) -> int:
    """How many cases to try."""
    return slow if THOROUGH else quick


def assistive() -> ArmModel:
    rows = (
        DhRow(0.0, 0.0, 0.170),
        DhRow(-pi / 2, 0.0, 0.0, -pi / 2),
        DhRow(pi, 0.440, 0.0, -pi / 2),
        DhRow(-pi / 2, 0.0, 0.450 + 0.100),
        DhRow(-pi / 2, 0.0, 0.0),
        DhRow(pi / 2, 0.0, 0.140),
    )
    limits = tuple(JointLimit(-limit, limit, 0.5) for limit in (3.1, 2.0, 2.4, 3.1, 2.0, 3.1))
    return ArmModel("assistive", rows, limits)


def irb120() -> ArmModel:
    rows = (
        DhRow(0.0, 0.0, 0.290),
        DhRow(-pi / 2, 0.0, 0.0, -pi / 2),
        DhRow(0.0, 0.270, 0.0),
        DhRow(-pi / 2, 0.070, 0.302),
        DhRow(pi / 2, 0.0, 0.0),
        DhRow(-pi / 2, 0.0, 0.072, pi),
    )
    ranges = ((-165, 165, 250), (-110, 110, 250), (-110, 70, 250), (-160, 160, 320), (-120, 120, 320), (-400, 400, 420))
    limits = tuple(JointLimit(radians(lower), radians(upper), radians(speed)) for lower, upper, speed in ranges)
    return ArmModel("irb120", rows, limits)


def ur5() -> ArmModel:
    """Three parallel axes and no spherical wrist."""
    rows = (
        DhRow(0.0, 0.0, 0.089159),
        DhRow(pi / 2, 0.0, 0.0),
        DhRow(0.0, -0.425, 0.0),
        DhRow(0.0, -0.39225, 0.10915),
        DhRow(pi / 2, 0.0, 0.09465),
        DhRow(-pi / 2, 0.0, 0.0823),
    )
    return ArmModel("ur5", rows, tuple(JointLimit(-pi, pi, inf) for _ in range(6)))


def with_row(model: ArmModel, number: int, **changes: float) -> ArmModel:
    """The arm with changes to one row, counted from 0."""
    rows = (*model.rows[:number], replace(model.rows[number], **changes), *model.rows[number + 1 :])
    return replace(model, rows=rows)


def with_tool(model: ArmModel) -> ArmModel:
    return replace(model, tool=TOOL)


def with_general_rows(model: ArmModel) -> ArmModel:
    """No alpha is a quarter turn, no length and no offset is zero, and the tool is rotated."""
    numbers = np.random.default_rng(4).uniform(0.1, 1.4, (6, 4)).tolist()
    return replace(with_tool(model), rows=tuple(DhRow(*row) for row in numbers))


def chain(model: ArmModel, q: np.ndarray) -> np.ndarray:
    """Tool poses (N, 4, 4) of configurations (N, 6): the product of Craig's matrices."""
    q = np.asarray(q, float)
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for row, angles in zip(model.rows, q.T, strict=True):
        theta = angles + row.offset
        s, c, sa, ca = np.sin(theta), np.cos(theta), np.sin(row.alpha), np.cos(row.alpha)
        step = np.zeros((len(q), 4, 4))
        step[:, 0, 0], step[:, 0, 1], step[:, 0, 3] = c, -s, row.a
        step[:, 1, 0], step[:, 1, 1], step[:, 1, 2], step[:, 1, 3] = s * ca, c * ca, -sa, -row.d * sa
        step[:, 2, 0], step[:, 2, 1], step[:, 2, 2], step[:, 2, 3] = s * sa, c * sa, ca, row.d * ca
        step[:, 3, 3] = 1.0
        pose = pose @ step
    return pose @ matrix(model.tool)


def wrist_centres(model: ArmModel, arm: np.ndarray) -> np.ndarray:
    """Wrist centres (N, 3), m, of the angles (N, 3) of joints 1 to 3."""
    without_hand = replace(model, tool=Pose.from_xyzrpy(0.0, 0.0, -model.rows[5].d, 0.0, 0.0, 0.0))
    return chain(without_hand, np.hstack([arm, np.zeros_like(arm)]))[:, :3, 3]


def stretched(model: ArmModel) -> float:
    """Angle of joint 3, rad, with the elbow stretched; the forearm of the arm has right angles."""
    return -model.rows[2].offset - float(np.arctan2(-np.sin(model.rows[3].alpha) * model.rows[3].d, model.rows[3].a))


def random_configurations(model: ArmModel, number: int, seed: int = 1) -> np.ndarray:
    """(number, 6) configurations, uniform inside the joint limits."""
    lower = [limit.lower for limit in model.limits]
    upper = [limit.upper for limit in model.limits]
    return np.random.default_rng(seed).uniform(lower, upper, (number, 6))


def pose_errors(wanted: np.ndarray, actual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (m) and angles (rad, exact for small ones) between poses (N, 4, 4)."""
    difference = np.swapaxes(wanted[:, :3, :3], 1, 2) @ actual[:, :3, :3] - np.eye(3)
    position = np.linalg.norm(wanted[:, :3, 3] - actual[:, :3, 3], axis=1)
    return position, np.linalg.norm(difference, axis=(1, 2)) / np.sqrt(2.0)


def worst_error(model: ArmModel, wanted: np.ndarray, q: ArrayLike) -> float:
    """Largest error, m or rad, between configurations (N, 6) and their poses (N, 4, 4) or one pose (4, 4)."""
    reached = chain(model, np.array(q))
    return float(np.max(pose_errors(np.broadcast_to(wanted, reached.shape), reached)))


def as_pose(matrix: np.ndarray) -> Pose:
    return Pose(tuple(matrix[:3, 3].tolist()), tuple(matrix[:3, :3].ravel().tolist()))


def matrix(pose: Pose) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = np.reshape(pose.rotation, (3, 3)), pose.position
    return result


def wrapped_difference(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """The largest difference of a joint, rad, regardless of multiples of 2 pi."""
    return np.abs(np.remainder(np.subtract(a, b) + pi, 2 * pi) - pi).max(axis=-1)


class Draw:
    """Random numbers of a Denavit-Hartenberg table."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def sign(self) -> float:
        return float(self.random.choice([-1.0, 1.0]))

    def length(self, lowest: float, highest: float) -> float:
        return float(self.random.uniform(lowest, highest)) * self.sign()

    def oblique(self) -> float:
        return float(self.random.uniform(0.4, pi - 0.4)) * self.sign()

    def angle(self) -> float:
        return float(self.random.uniform(-pi, pi))


# alpha1, a1, alpha2 of the arm
GEOMETRIES: dict[str, Callable[[Draw], tuple[float, float, float]]] = {
    "parallel axes 2 and 3, offsets": lambda draw: (
        pi / 2 * draw.sign(),
        draw.length(0.0, 0.2),
        draw.random.choice([0.0, pi]),
    ),
    "parallel axes 2 and 3, oblique axis 2": lambda draw: (draw.oblique(), draw.length(0.0, 0.2), 0.0),
    "no parallel axes": lambda draw: (draw.oblique(), draw.length(0.05, 0.3), draw.oblique()),
    "no parallel axes, axes 1 and 2 meet": lambda draw: (draw.oblique(), 0.0, draw.oblique()),
    "parallel axes 1 and 2": lambda draw: (draw.random.choice([0.0, pi]), draw.length(0.1, 0.3), draw.oblique()),
    "all right angles": lambda draw: (pi / 2 * draw.sign(), draw.length(0.05, 0.3), pi / 2 * draw.sign()),
}


def foldable(draw: Draw) -> tuple[float, float]:
    """Oblique, but axis 6 can align with axis 4, as in a wrist with hollow shafts."""
    alpha = draw.oblique()
    return alpha, alpha * draw.sign()


# alpha4, alpha5
WRISTS: dict[str, Callable[[Draw], tuple[float, float]]] = {
    "right-angled": lambda draw: (pi / 2 * draw.sign(), pi / 2 * draw.sign()),
    "oblique": lambda draw: (draw.oblique(), draw.oblique()),
    "foldable": foldable,
}


def build_arm(seed: int, geometry: str, wrist: str) -> ArmModel:
    """An arm with random lengths, offsets, base and tool."""
    draw = Draw(seed)
    alpha1, a1, alpha2 = GEOMETRIES[geometry](draw)
    alpha4, alpha5 = WRISTS[wrist](draw)
    rows = (
        DhRow(draw.angle(), draw.length(0.0, 0.2), draw.length(0.0, 0.3), draw.angle()),
        DhRow(alpha1, a1, draw.length(0.0, 0.2), draw.angle()),
        DhRow(float(alpha2), draw.length(0.2, 0.5), draw.length(0.0, 0.2), draw.angle()),
        DhRow(draw.oblique(), draw.length(0.0, 0.2), draw.length(0.2, 0.5), draw.angle()),
        DhRow(alpha4, 0.0, 0.0, draw.angle()),
        DhRow(alpha5, 0.0, draw.length(0.0, 0.2), draw.angle()),
    )
    tool = Pose.from_xyzrpy(*(draw.length(0.0, 0.2) for _ in range(3)), *(draw.angle() for _ in range(3)))
    return ArmModel(f"arm {seed}", rows, (JointLimit(-pi, pi),) * 6, tool=tool)
