"""The picture that `rtcp arm plot` makes: the arm and its frames in space, and its outline from two sides.

Bodies are one collection of facets, so that they hide each other facet by facet; frames are drawn over them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from kinematics.forward import forward, frames
from kinematics.model import ArmModel
from kinematics.pose import IDENTITY, Pose

Array = npt.NDArray[np.float64]

LINK, JOINT, TOOL = "#9aa5b8", "#2b4c7e", "#e07a1f"
AXES = ("#d1322d", "#2f9e44", "#1c6dd0")
"""x, y, z of every frame."""

_LIGHT = np.array((0.3, -0.5, 0.8)) / np.linalg.norm((0.3, -0.5, 0.8))
_SIDES, _SAME = 28, 1e-6


def draw(model: ArmModel, q: Sequence[float], out: Path, paths: Sequence[Sequence[Sequence[float]]] = ()) -> None:
    """Draw the arm at `q` (six rad) into a file, and the path of the tool along paths of the joints.

    The file's ending chooses the format.

    Raises:
        OSError: it cannot be written.
        ValueError: `q` is not six finite numbers.
    """
    poses = (IDENTITY, *frames(model, q))
    size = sum(abs(row.a) + abs(row.d) for row in model.rows) + float(np.linalg.norm(model.tool.position)) or 1.0
    corners = np.array(_corners(model, poses))
    centre, half = _room(corners, size)
    figure = Figure(figsize=(11.0, 7.2))
    space = figure.add_axes((0.0, 0.0, 0.68, 0.90), projection="3d")
    _in_space(space, corners, poses, size, centre, half)
    tools = [np.array([forward(model, joints).position for joints in path]) for path in paths]
    for tool in tools:
        space.plot(*tool.T, color=TOOL, lw=1.5, zorder=4)
    for bottom, plane, title in ((0.53, (0, 2), "from the side"), (0.07, (0, 1), "from above")):
        axes = figure.add_axes((0.74, bottom, 0.24, 0.36), title=title)
        _outline(axes, corners, poses, plane, centre, half)
        for tool in tools:
            axes.plot(*tool[:, plane].T, color=TOOL, lw=1.2)
    joints = ", ".join(f"{value:.4g}" for value in q)
    figure.text(0.02, 0.965, f"{model.name} at q = ({joints}) rad", fontsize=13, weight="bold")
    figure.text(0.02, 0.935, _tool(poses[-1]), fontsize=10)
    for number, (name, colour) in enumerate(zip("xyz", AXES, strict=True)):
        figure.text(0.02 + 0.014 * number, 0.905, name, color=colour, fontsize=11, weight="bold")
    figure.text(0.068, 0.905, "axes of the frames; joint i turns about the z axis of frame i", fontsize=10)
    figure.savefig(out, dpi=120)


def _tool(pose: Pose) -> str:
    position, angles = (", ".join(f"{value + 0.0:.3f}" for value in three) for three in (pose.position, pose.rpy))
    return f"tool at ({position}) m, (rx, ry, rz) = ({angles}) rad"


def _corners(model: ArmModel, poses: Sequence[Pose]) -> list[Array]:
    """Return the corners of the line from base to tool: along a on each frame's x, along d on the next frame's z."""
    corners = [np.zeros(3)]
    for row, before, pose in zip(model.rows, poses, poses[1:], strict=False):
        corners += [_origin(before) + row.a * _axes(before)[0], _origin(pose)]
    corners.append(_origin(poses[-1]))
    return [point for i, point in enumerate(corners) if i == 0 or float(np.linalg.norm(point - corners[i - 1])) > _SAME]


def _in_space(axes: Any, line: Array, poses: Sequence[Pose], size: float, centre: Array, half: float) -> None:
    axes.computed_zorder = False
    for axis, middle in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{axis}lim")(middle - half, middle + half, auto=False)
        getattr(axes, f"set_{axis}label")(f"{axis}, m", labelpad=8)
    axes.set_box_aspect((1, 1, 1), zoom=0.98)
    axes.view_init(elev=22, azim=-58)
    facets: list[Array] = []
    colours: list[Any] = []
    for start, end in pairwise(line):
        _add(facets, colours, _tube(start, end, 0.020 * size), LINK)
    for corner in line[1:-1]:
        _add(facets, colours, _ball(corner, 0.020 * size), LINK)
    for pose in poses[1:6]:
        along = 0.045 * size * _axes(pose)[2]
        _add(facets, colours, _tube(_origin(pose) - along, _origin(pose) + along, 0.032 * size, closed=True), JOINT)
    flange, tool = poses[6:]
    back = _origin(flange) - 0.025 * size * _axes(flange)[2]
    _add(facets, colours, _tube(back, _origin(flange), 0.034 * size, closed=True), JOINT)
    _add(facets, colours, _ball(_origin(tool), 0.020 * size), TOOL)
    _add(facets, colours, _tube(np.array((0, 0, -0.012 * size)), np.zeros(3), 0.09 * size, closed=True), LINK)
    axes.add_collection3d(Poly3DCollection(facets, facecolors=colours, edgecolors=colours, linewidths=0.2, zorder=2))
    axes.plot(line[:, 0], line[:, 1], 0 * line[:, 2], color="black", alpha=0.12, lw=6, solid_capstyle="round", zorder=1)
    _triads(axes, poses, size)


def _triads(axes: Any, poses: Sequence[Pose], size: float) -> None:
    """Draw every frame; frames that share an origin share a label."""
    places: list[tuple[Array, list[str]]] = []
    for name, pose in zip(["base", *"123456", "tool"], poses, strict=True):
        origin, directions = _origin(pose), _axes(pose)
        length = (0.16 if name in ("base", "tool") else 0.12) * size
        for direction, colour in zip(directions, AXES, strict=True):
            tip = origin + length * direction
            axes.plot(*zip(origin, tip, strict=True), color=colour, lw=2.2, solid_capstyle="round", zorder=3)
        for where, names in places:
            if np.linalg.norm(where - origin) < _SAME:
                names.append(name)
                break
        else:
            places.append((origin, [name]))
    aside = np.array((0.06, 0.0, 0.03)) * size
    for where, names in places:
        axes.text(*(where + aside), ", ".join(names), fontsize=9, zorder=4)


def _room(corners: Array, size: float) -> tuple[Array, float]:
    """Return the centre and half the side of the cube that holds the arm and the ground under it."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    low[2] = min(low[2], 0.0)
    centre, half = (low + high) / 2, max(float((high - low).max()) / 2, 0.3 * size) * 1.1
    if low[2] == 0.0:
        centre[2] = half - 0.02 * size
    return centre, half


def _outline(axes: Any, line: Array, poses: Sequence[Pose], plane: tuple[int, int], centre: Array, half: float) -> None:
    across, up = plane
    axes.plot(line[:, across], line[:, up], color=LINK, lw=6, solid_capstyle="round", solid_joinstyle="round")
    origins = np.array([_origin(pose) for pose in poses[1:7]])
    axes.plot(origins[:, across], origins[:, up], "o", color=JOINT, ms=8)
    axes.plot(*line[-1][[across, up]], "o", color=TOOL, ms=7)
    axes.plot(0, 0, marker="s", color="black", ms=10, zorder=0)
    axes.set(xlabel="xyz"[across] + ", m", ylabel="xyz"[up] + ", m", aspect="equal")
    axes.set_xlim(centre[across] - half, centre[across] + half)
    axes.set_ylim(centre[up] - half, centre[up] + half)
    axes.grid(alpha=0.3)


def _tube(start: Array, end: Array, radius: float, *, closed: bool = False) -> Iterator[Array]:
    """Yield the facets, (4, 3), of a cylinder from `start` to `end`, in rings short enough to be sorted by depth."""
    along = end - start
    length = float(np.linalg.norm(along))
    u, v = _across(along / length)
    angles = np.linspace(0.0, 2 * np.pi, _SIDES + 1)
    circle = radius * (np.outer(np.cos(angles), u) + np.outer(np.sin(angles), v))
    rings = max(1, round(length / (2 * radius)))
    for step in range(rings):
        below, above = start + along * step / rings + circle, start + along * (step + 1) / rings + circle
        yield from (np.array((below[i], below[i + 1], above[i + 1], above[i])) for i in range(_SIDES))
    if closed:
        # Four corners, as all facets have: shorter ones would be padded with undefined corners.
        for centre, rim in ((end, circle), (start, circle[::-1])):
            yield from (centre + np.array((0 * along, *rim[i : i + 3])) for i in range(0, _SIDES, 2))


def _ball(centre: Array, radius: float) -> Iterator[Array]:
    heights, angles = np.linspace(-np.pi / 2, np.pi / 2, 9), np.linspace(0.0, 2 * np.pi, 17)
    for low, high in pairwise(heights):
        for left, right in pairwise(angles):
            corners = ((left, low), (right, low), (right, high), (left, high))
            yield centre + radius * np.array(
                [(np.cos(t) * np.cos(h), np.sin(t) * np.cos(h), np.sin(h)) for t, h in corners]
            )


def _across(direction: Array) -> tuple[Array, Array]:
    """Return two directions perpendicular to `direction` and to each other, right-handed."""
    aside = np.array((1.0, 0.0, 0.0)) if abs(direction[0]) < 0.9 else np.array((0.0, 1.0, 0.0))
    normal: Array = np.cross(direction, aside)
    normal /= np.linalg.norm(normal)
    return normal, np.cross(direction, normal)


def _add(facets: list[Array], colours: list[Any], shape: Iterator[Array], colour: str) -> None:
    """Add facets, lighter where they face the light."""
    base = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    for facet in shape:
        normal = np.cross(facet[1] - facet[0], facet[2] - facet[0])
        length = float(np.linalg.norm(normal))
        lit = 0.5 + 0.5 * (float(normal @ _LIGHT) / length if length else 0.0)
        facets.append(facet)
        colours.append((*np.clip(base * (0.55 + 0.6 * lit), 0.0, 1.0), 1.0))


def _origin(pose: Pose) -> Array:
    return np.array(pose.position)


def _axes(pose: Pose) -> Array:
    """Return the frame's axes as rows."""
    return np.array([pose.rotation[column::3] for column in range(3)])
