"""Arms from their documents, not from the files in config/, and forward kinematics in matrices to compare with."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, pi, radians

import numpy as np
import pytest

from kinematics.model import ArmModel, DhRow, JointLimit
from kinematics.pose import Pose

# Properties are tested on machines that are busy with something else

Chain = Callable[[ArmModel, np.ndarray], np.ndarray]


def build_assistive() -> ArmModel:
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


def build_irb120() -> ArmModel:
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


def build_ur5() -> ArmModel:
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


@pytest.fixture(scope="session")
def assistive() -> ArmModel:
    return build_assistive()


@pytest.fixture(scope="session")
def irb120() -> ArmModel:
    return build_irb120()


@pytest.fixture(scope="session")
def ur5() -> ArmModel:
    return build_ur5()


@pytest.fixture(scope="session", params=[build_assistive, build_irb120], ids=["assistive", "irb120"])
def either(request) -> ArmModel:
    """Both arms, one after the other."""
    return request.param()


@pytest.fixture(scope="session")
def chain() -> Chain:
    return tool_matrices


def tool_matrices(model: ArmModel, q: np.ndarray) -> np.ndarray:
    """Tool poses (N, 4, 4) of configurations (N, 6): the product of Craig's matrices, written here once more."""
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
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = np.reshape(model.tool.rotation, (3, 3)), model.tool.position
    return pose @ tool


@pytest.fixture(scope="session")
def random_configurations() -> Callable[..., np.ndarray]:
    return draw_configurations


def draw_configurations(model: ArmModel, count: int, seed: int = 1) -> np.ndarray:
    """(count, 6) configurations, even inside the joint limits."""
    lower = [limit.lower for limit in model.limits]
    upper = [limit.upper for limit in model.limits]
    return np.random.default_rng(seed).uniform(lower, upper, (count, 6))


@pytest.fixture(scope="session")
def pose_errors() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return errors_between


def errors_between(wanted: np.ndarray, actual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (m) and angles (rad, exact for small ones) between poses (N, 4, 4)."""
    difference = np.swapaxes(wanted[:, :3, :3], 1, 2) @ actual[:, :3, :3] - np.eye(3)
    position = np.linalg.norm(wanted[:, :3, 3] - actual[:, :3, 3], axis=1)
    return position, np.linalg.norm(difference, axis=(1, 2)) / np.sqrt(2.0)


@pytest.fixture(scope="session")
def as_pose() -> Callable[[np.ndarray], Pose]:
    return pose_of


def pose_of(matrix: np.ndarray) -> Pose:
    """The pose that a 4x4 matrix is."""
    return Pose(tuple(matrix[:3, 3].tolist()), tuple(matrix[:3, :3].ravel().tolist()))


class Draw:
    """Random numbers of a table."""

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
REGIONS = {
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


def right_angled(draw: Draw) -> tuple[float, float]:
    return pi / 2 * draw.sign(), pi / 2 * draw.sign()


def oblique(draw: Draw) -> tuple[float, float]:
    return draw.oblique(), draw.oblique()


def foldable(draw: Draw) -> tuple[float, float]:
    """Oblique, and axis 6 comes to lie in axis 4, as in a wrist with hollow shafts."""
    alpha = draw.oblique()
    return alpha, alpha * draw.sign()


WRISTS = {"right-angled": right_angled, "oblique": oblique, "foldable": foldable}


def draw_arm(seed: int, region: str, wrist: str) -> ArmModel:
    """An arm of a region and a wrist, with random lengths, offsets, base and tool."""
    draw = Draw(seed)
    alpha1, a1, alpha2 = REGIONS[region](draw)
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


@pytest.fixture(scope="session", params=REGIONS)
def region(request) -> str:
    """The name of a geometry of the first three joints."""
    return request.param


@pytest.fixture(scope="session")
def build_arm() -> Callable[[int, str, str], ArmModel]:
    return draw_arm
