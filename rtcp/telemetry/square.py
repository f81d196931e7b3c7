"""The square of the thesis, 200 x 200 mm in the X-Y or Y-Z plane: its place, its deviation when driven, its picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kinematics.forward import forward, forward_batch, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.config.model import ArmConfig, Stop
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Limits
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.plan import PlanRefused
from rtcp.telemetry.reading import Recorded

Array = npt.NDArray[np.float64]

PLANES = {"xy": (0, 1), "yz": (1, 2), "xz": (0, 2)}
SIDE_M = 0.2
SPEED_M_S = 0.05
_ROOM_M = 0.03
"""Least distance of the square from every box, m."""
_SHOULDERS = (-0.3, 0.0, -0.6, 0.3, -0.9)
_ELBOWS = (1.9, 1.6, 1.3, 1.0, -1.6)
_WRISTS = (1.6, 1.2, -1.6, -1.2, 0.8)
_COMMANDED, _ACTUAL, _WANTED = "#1c6dd0", "#e07a1f", "#9aa5b8"


class NoSquare(Exception):
    """The arm has no room for the square, or did not drive it; the message is a sentence."""


@dataclass(frozen=True)
class Square:
    """Place of a square: joints at its first corner (rad), its corners in order, closed (m), and the orientation."""

    plane: str
    start: tuple[float, ...]
    corners: tuple[tuple[float, float, float], ...]
    rpy: tuple[float, float, float]

    @property
    def poses(self) -> list[list[float]]:
        """Poses at the ends of the four lines from the first corner: x, y, z, rx, ry, rz."""
        return [[*corner, *self.rpy] for corner in self.corners[1:]]


def place(config: ArmConfig, plane: str, speed: float = SPEED_M_S) -> Square:
    """Return a square that the arm can drive at `speed`, m/s, far from singularities, ends of ranges and boxes.

    Candidates are around configurations with a bent elbow and wrist; each is planned as the platform will plan it.

    Raises:
        NoSquare: no candidate is suitable.
    """
    model = config.arm
    if model is None:
        raise NoSquare("the arm's geometry is not known (key kinematics): no square can be driven")
    limits = Limits(config)
    zones = Zones(model, limits, config.cartesian.clearance)

    def zone_at(q: Sequence[float]) -> str | None:
        return "a box or itself" if zones.distance(frames(model, q))[0] < _ROOM_M else None

    for elbow, wrist, shoulder in product(_ELBOWS, _WRISTS, _SHOULDERS):
        square = _around(model, (0.0, shoulder, elbow, 0.0, wrist, 0.0), plane)
        if square is None or zone_at(square.start):
            continue
        stops = [Stop(pose=tuple(pose)) for pose in square.poses]
        try:
            plan = plan_lines(model, limits, config.cartesian, square.start, stops, speed=speed, zone_at=zone_at)
        except PlanRefused:
            continue
        if plan.slowed == 1.0:
            return square
    raise NoSquare(
        f"no place was found for a square of {SIDE_M:g} m in the plane {plane} at {speed:g} m/s: the ranges "
        "(joints[].position) and the boxes (cartesian) leave no room"
    )


def _around(model: ArmModel, q: Sequence[float], plane: str) -> Square | None:
    middle = forward(model, q)
    across, up = PLANES[plane]
    corners = []
    for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)):
        corner = list(middle.position)
        corner[across] += 0.5 * u * SIDE_M
        corner[up] += 0.5 * v * SIDE_M
        corners.append((corner[0], corner[1], corner[2]))
    solution = InverseKinematics(model).solve_near(Pose(corners[0], middle.rotation), q)
    if solution.q is None:
        return None
    # The pose of the rounded joints, so that the first line begins exactly there.
    start = tuple(round(angle, 6) for angle in solution.q)
    first = forward(model, start)
    offset = [a - b for a, b in zip(first.position, corners[0], strict=True)]
    moved = [tuple(a + b for a, b in zip(corner, offset, strict=True)) for corner in corners]
    return Square(plane, start, tuple((x, y, z) for x, y, z in moved), first.rpy)


@dataclass(frozen=True)
class Driven:
    """A driven square; arrays over the cycles: s, m, rad, rad/s, Nm.

    `commanded` and `actual` (cycles, 3): the tool. `off_commanded`, `off_actual` (cycles,): distance from the square.
    """

    square: Square
    seconds: Array
    commanded: Array
    actual: Array
    off_commanded: Array
    off_actual: Array
    joints: Array
    speeds: Array
    torques: Array
    missing: int

    @property
    def worst(self) -> tuple[float, float]:
        """Largest distance from the square: of the commanded and of the actual tool, m."""
        return float(self.off_commanded.max()), float(self.off_actual.max())


def judge(model: ArmModel, square: Square, recorded: Recorded) -> Driven:
    """Return the evaluation of a recording of the square's lines, without the records before and after the motion.

    Raises:
        NoSquare: nothing moved in the recording.
    """
    target = recorded.column("sent_position")
    moving = np.flatnonzero(np.abs(np.diff(target, axis=0)).max(axis=1) > 0) if len(target) > 1 else np.empty(0, int)
    if not len(moving):
        raise NoSquare("nothing moved while the square was recorded")
    span = slice(int(moving[0]), int(moving[-1]) + 2)
    position = recorded.column("actual_position")[span]
    commanded = forward_batch(model, target[span])[0]
    actual = forward_batch(model, position)[0]
    seconds = recorded.seconds[span]
    return Driven(
        square,
        seconds - seconds[0],
        commanded,
        actual,
        distance_from(square.corners, commanded),
        distance_from(square.corners, actual),
        position,
        recorded.column("actual_velocity")[span],
        recorded.column("actual_torque")[span],
        recorded.missing,
    )


def distance_from(corners: Sequence[Sequence[float]], points: Array) -> Array:
    """Return the distance (m) of each point, shape (n, 3), from the nearest side of a polygon."""
    nearest = np.full(len(points), np.inf)
    for start, end in pairwise(np.asarray(corners, dtype=np.float64)):
        along = end - start
        share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - (start + share[:, None] * along), axis=1))
    return nearest


def draw(driven: Driven, out: Path) -> None:
    """Draw path, deviation, joint angles, speeds and torques into a file; its ending chooses the format.

    Raises:
        OSError: it cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 8.0), layout="constrained")
    grid = figure.add_gridspec(3, 3)
    _in_space(figure.add_subplot(grid[:2, 0], projection="3d"), driven)
    _deviation(figure.add_subplot(grid[2, 0]), driven)
    names = [f"joint {number + 1}" for number in range(driven.joints.shape[1])]
    for row, (values, unit) in enumerate(
        ((driven.joints, "angle, rad"), (driven.speeds, "speed, rad/s"), (driven.torques, "torque, Nm"))
    ):
        axes = figure.add_subplot(grid[row, 1:])
        for name, column in zip(names, values.T, strict=True):
            axes.plot(driven.seconds, column, lw=1.0, label=name)
        axes.set(ylabel=unit, xlim=(0.0, float(driven.seconds[-1])))
        axes.grid(alpha=0.3)
        if row == 0:
            axes.legend(ncols=6, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.18), frameon=False)
    axes.set(xlabel="time, s")
    commanded, actual = (1e3 * worst for worst in driven.worst)
    figure.suptitle(
        f"{1e3 * SIDE_M:g} x {1e3 * SIDE_M:g} mm in the plane {driven.square.plane}: largest deviation "
        f"{commanded:.3f} mm commanded, {actual:.2f} mm actual"
    )
    figure.savefig(out, dpi=110)


def _in_space(axes: Any, driven: Driven) -> None:
    corners = np.array(driven.square.corners)
    axes.plot(*corners.T, color=_WANTED, lw=5, label="square")
    axes.plot(*driven.commanded.T, color=_COMMANDED, lw=1.2, label="commanded")
    axes.plot(*driven.actual.T, color=_ACTUAL, lw=1.2, label="actual")
    middle, half = corners.mean(axis=0), 0.7 * SIDE_M
    for axis, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(middle[axis] - half, middle[axis] + half)
        getattr(axes, f"set_{name}label")(f"{name}, m", labelpad=12)
        axes.tick_params(axis=name, labelsize=8)
        getattr(axes, f"{name}axis").set_major_locator(_few_ticks())
    axes.set_box_aspect((1, 1, 1), zoom=0.8)
    axes.legend(fontsize=8, loc="upper left")


def _few_ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(4)


def _deviation(axes: Any, driven: Driven) -> None:
    axes.plot(driven.seconds, 1e3 * driven.off_commanded, color=_COMMANDED, lw=1.0, label="commanded")
    axes.plot(driven.seconds, 1e3 * driven.off_actual, color=_ACTUAL, lw=1.0, label="actual")
    axes.set(xlabel="time, s", ylabel="deviation, mm", xlim=(0.0, float(driven.seconds[-1])))
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
