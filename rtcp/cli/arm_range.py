"""The picture that `rtcp arm range` makes: where the wrist's centre can be, from the side and from above.

As in data sheets, only the ends of joints 1 to 3 limit the range; bodies, keep-out boxes and the ground do not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Wedge

from kinematics.forward import frames
from kinematics.model import ArmModel

_WRIST = 3
"""Index of the frame in the wrist's centre, frame 4."""
_STEPS = 90
_ARMS = ("#2b4c7e", "#e07a1f")


def wrist_range(model: ArmModel) -> npt.NDArray[np.float64]:
    """Return the wrist's centre for positions of joints 2 and 3 over their ranges, shape (n, n, 2): x and z, m.

    Joint 1 stands at 0, so x is the distance from its axis, negative behind it.
    """
    ends = [(limit.lower, limit.upper) for limit in model.limits[1:3]]
    second, third = (np.linspace(low, high, _STEPS) for low, high in ends)
    points = [[frames(model, (0.0, a, b, 0.0, 0.0, 0.0))[_WRIST].position for b in third] for a in second]
    return np.array(points)[:, :, (0, 2)]


def draw_range(model: ArmModel, out: Path, facing_m: float = 0.0) -> None:
    """Draw the range into a file, whose ending chooses the format.

    Args:
        model: the arm, with its limits.
        out: the file.
        facing_m: distance of a second arm of the same kind that faces it, m; 0: none.

    Raises:
        OSError: it cannot be written.
    """
    grid = wrist_range(model)
    reach, behind = float(grid[:, :, 0].max()), float(-grid[:, :, 0].min())
    figure = Figure(figsize=(7.0, 8.0))
    side, above = figure.subplots(2, 1)
    first = model.limits[0]
    for number in range(2 if facing_m > 0.0 else 1):
        colour, base, sign = _ARMS[number], number * facing_m, 1.0 - 2.0 * number
        placed = np.stack((base + sign * grid[:, :, 0], grid[:, :, 1]), axis=-1)
        quads = np.stack((placed[:-1, :-1], placed[1:, :-1], placed[1:, 1:], placed[:-1, 1:]), axis=2).reshape(-1, 4, 2)
        side.add_collection(
            PolyCollection(list(quads), facecolors=colour, linewidths=0.0, antialiaseds=False, alpha=0.35)
        )
        side.plot([base], [0.0], "^", color=colour, ms=10)
        turned = 180.0 * number
        begin, end = (turned + float(np.degrees(angle)) for angle in (first.lower, first.upper))
        above.add_patch(Wedge((base, 0.0), reach, begin, end, facecolor=colour, alpha=0.35))
        if end - begin < 360.0:
            # Joint 1 does not turn there; the arm reaches over its own base.
            above.add_patch(Wedge((base, 0.0), behind, end, begin + 360.0, facecolor=colour, alpha=0.35))
        above.plot([base], [0.0], "o", color=colour, ms=8)
    _finish(side, "from the side: joints 2 and 3, joint 1 at 0", "z, m")
    _finish(above, "from above: joint 1", "y, m")
    what = f"{model.name}: range of the wrist's centre, {reach:.3f} m from axis 1"
    figure.suptitle(what + (f"; two arms {facing_m:g} m apart" if facing_m > 0.0 else ""), fontsize=11)
    figure.tight_layout()
    figure.savefig(out, dpi=110)


def _finish(axes: Any, title: str, upward: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("x, m")
    axes.set_ylabel(upward)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.08)
    axes.grid(alpha=0.3)
