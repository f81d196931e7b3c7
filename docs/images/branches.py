"""Draws `branches.png`, the figure of docs/kinematics_derivation.md: `python docs/images/branches.py`.

The four ways in which joints 1 to 3 bring the wrist centre to one point, as the solver gives them, and the triangle
that they are computed from. The arm is the IRB 120 with its shoulder moved out from axis 1: without that offset front
and back have one outline, that of the arm turned by half a turn about axis 1 and bent to the other side.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from kinematics.forward import frames
from kinematics.inverse import InverseKinematics
from kinematics.pose import Pose
from rtcp.config import find_arm, load_kinematics

COLOURS = {"front/up": "#2b4c7e", "front/down": "#2f9e44", "back/up": "#e07a1f", "back/down": "#b5179e"}


def main() -> None:
    """Draw the figure beside this file."""
    arm = load_kinematics(find_arm("abb_irb120"))
    model = replace(arm, rows=(arm.rows[0], replace(arm.rows[1], a=0.08), *arm.rows[2:]))
    found = InverseKinematics(model).solve(Pose.from_xyzrpy(0.33, 0.0, 0.46, 0.0, np.pi / 2, 0.0))
    figure = Figure(figsize=(10.0, 4.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    for solution in found.solutions:
        if solution.branch is None or solution.branch.wrist == "flip":
            continue
        name = f"{solution.branch.shoulder}/{solution.branch.elbow}"
        origins = np.array([pose.position for pose in frames(model, solution.q)])[:, [0, 2]]
        corners = np.array([(0.0, 0.0), origins[0], origins[1], origins[2], origins[4]])
        left.plot(*corners.T, "-o", color=COLOURS[name], lw=3, ms=6, label=name, alpha=0.85)
        if name == "front/up":
            _triangle(right, origins[1], origins[2], origins[4])
    left.plot(*origins[4], "o", color="black", ms=9)
    left.annotate("wrist centre", origins[4], (-30, 10), textcoords="offset points")
    left.set(xlabel="x, m", ylabel="z, m", title="one wrist centre, four ways to it", aspect="equal")
    left.legend(loc="lower right", fontsize=9)
    left.grid(alpha=0.3)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=130)


def _triangle(axes: Any, shoulder: Any, elbow: Any, wrist: Any) -> None:
    """The triangle of one of them, in the plane across axis 2, with the names that the page uses."""
    axes.plot(*zip(shoulder, elbow, wrist, strict=True), color=COLOURS["front/up"], lw=4, solid_joinstyle="round")
    axes.plot(*zip(shoulder, wrist, strict=True), color="black", lw=1.2, ls="--")
    end = elbow + 0.55 * (elbow - shoulder)
    axes.plot(*zip(elbow, end, strict=True), color="black", lw=1, ls=":")
    for point, name, shift in (
        (shoulder, "axis 2", (-46, -4)),
        (elbow, "axis 3", (-44, 4)),
        (wrist, "wrist centre", (-34, 10)),
    ):
        axes.plot(*point, "o", color="black", ms=6)
        axes.annotate(name, point, shift, textcoords="offset points")
    for start, to, name, shift in (
        (shoulder, elbow, "$a_2$", (-28, 0)),
        (elbow, wrist, "$l$", (6, 6)),
        (shoulder, wrist, "$f$", (2, -14)),
    ):
        axes.annotate(name, (start + to) / 2, shift, textcoords="offset points", fontsize=13)
    for corner, one, other, name in ((elbow, wrist, end, r"$\beta$"), (shoulder, wrist, elbow, r"$\gamma$")):
        first, last = sorted(np.degrees(np.arctan2(*(point - corner)[::-1])) for point in (one, other))
        axes.add_patch(Arc(corner, 0.12, 0.12, theta1=first, theta2=last))
        middle = np.radians((first + last) / 2)
        axes.text(
            *(corner + 0.085 * np.array((np.cos(middle), np.sin(middle)))), name, ha="center", va="center", fontsize=13
        )
    axes.set(title="the triangle of front/up", aspect="equal")
    axes.margins(0.2)
    axes.axis("off")


if __name__ == "__main__":
    main()
