"""What `rtcp arm fk` and `rtcp arm ik` draw: tables of frames, solutions and distances to the singularities."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from kinematics.forward import frames
from kinematics.jacobian import SingularityDistances, manipulability, singularity_distances
from kinematics.model import ArmModel
from kinematics.solution import Singularity, Solution

ON_IT = 1e-9
"""m or rad; nearer than this a configuration is on the singularity."""


def forward_picture(model: ArmModel, q: Sequence[float]) -> list[RenderableType]:
    """Return the frames at joint positions `q`, rad, as a table, and what is to be known about `q`."""
    table = _table(f"{model.name}: frames in the base frame, m and rad", ("frame", "x", "y", "z", "rx", "ry", "rz"))
    for name, pose in zip([*map(str, range(1, 7)), "tool"], frames(model, q), strict=True):
        numbers = (f"{value:.6f}" for value in (*pose.position, *pose.rpy))
        table.add_row(name, *map(_zero, numbers), style="bold" if name == "tool" else "")
    distances = singularity_distances(model, q)
    facts = [
        f"from the singularities: {_in_words(distances)}",
        f"manipulability {_small(manipulability(model, q))} m^3",
    ]
    limits = zip(model.joint_names, q, model.limits, strict=True)
    facts += [
        f"{name} at {value:g} rad is outside its limits, {limit.lower:g} to {limit.upper:g}"
        for name, value, limit in limits
        if not limit.lower <= value <= limit.upper
    ]
    return [table, *(Text(f" {fact}") for fact in facts)]


def inverse_picture(model: ArmModel, solutions: Sequence[Solution]) -> list[RenderableType]:
    """Return the solutions as a table of joint positions and one of limits and distances to the singularities."""
    counted = "1 solution" if len(solutions) == 1 else f"{len(solutions)} solutions"
    joints = _table(f"{model.name}: {counted}, rad", ("#", "branch", *(f"q{i}" for i in range(1, 7)), "limits"), 0)
    far = _table(
        "limits and distances to the singularities",
        ("#", "outside", "shoulder m", "elbow rad", "wrist rad", "smallest", "singular"),
    )
    for number, one in enumerate(solutions, 1):
        joints.add_row(
            str(number),
            "-" if one.branch is None else str(one.branch),
            *(Text(_zero(f"{q:.4f}"), "red" if i in one.outside else "") for i, q in enumerate(one.q)),
            "inside" if one.within_limits else "outside",
            style="" if one.within_limits else "dim",
        )
        distances = singularity_distances(model, one.q)
        far.add_row(
            str(number),
            ", ".join(f"q{joint + 1}" for joint in one.outside) or "-",
            *("-" if value is None else _small(value) for value in distances),
            ", ".join(flag.name.lower() for flag in Singularity if flag in one.singularity and flag.name) or "-",
        )
    parts: list[RenderableType] = [joints, Text(""), far]
    if not any(one.within_limits for one in solutions):
        parts.append(Text(" no solution is inside the joints' limits"))
    return parts


def _table(title: str, headings: Sequence[str], padding: int = 1) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", show_edge=False, padding=(0, padding))
    for heading in headings:
        table.add_column(heading, justify="left" if heading in _TEXTS else "right", no_wrap=heading not in _LISTS)
    return table


_LISTS = ("outside", "singular")
_TEXTS = ("frame", "branch", "limits", *_LISTS)


def _in_words(distances: SingularityDistances) -> str:
    """Return the distances as a sentence's end; an arm without a spherical wrist has the last one alone."""
    named = zip(("shoulder", "elbow", "wrist"), distances, ("m", "rad", "rad"), strict=False)
    known = [f"{name} {_small(value)} {unit}" for name, value, unit in named if value is not None]
    return ", ".join([*known, f"smallest singular value {_small(distances.smallest)}"])


def _small(value: float) -> str:
    return "0" if value < ON_IT else f"{value:.3g}"


def _zero(number: str) -> str:
    """Take the sign from a zero, which only round-off gave it."""
    return number.removeprefix("-") if not number.strip("-0.") else number
