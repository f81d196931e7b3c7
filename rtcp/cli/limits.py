"""`rtcp limits show` and `set`: what no motion goes beyond, changed as one transaction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, refuse_options
from rtcp.cli.connection import ask
from rtcp.cli.errors import CommandError
from rtcp.cli.output import emit_json, report, show
from rtcp.config.plain_number import plain_number

AsJson = Annotated[bool, typer.Option("--json", help="One JSON object, SI units.")]
COLUMNS = (
    ("min", "rad"), ("max", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s^2"), ("jerk", "rad/s^3"),
    ("torque", "Nm"),
)  # fmt: skip
UNITS = {"speed": "m/s", "acceleration": "m/s^2", "jerk": "m/s^3", "angular_speed": "rad/s",
         "angular_acceleration": "rad/s^2", "angular_jerk": "rad/s^3"}  # fmt: skip


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    limits = typer.Typer(help="Show and narrow the limits while the platform runs.", no_args_is_help=True)
    limits.command("show")(_show)
    limits.command("set", context_settings=NUMBERS_AS_WRITTEN)(_set)
    app.add_typer(limits, name="limits")


def _show(as_json: AsJson = False) -> None:
    """Show the limits of the joints and the tool, and the boxes; what was changed is marked."""
    found = ask("limits show", "limits")
    if as_json:
        emit_json(found)
        return
    show(*_picture(found))


def _set(
    pairs: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY VALUE..",
            help="joint2.max, joints.velocity, box.min.x, user.max.z, ...: rad, m, s, Nm; all are taken, or none.",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Change limits, within what is configured; refused as a whole if the arm would be outside."""
    refuse_options(pairs, ("--json", "--help", "-h"))
    changes = _changes(pairs)
    found = ask("limits set", "limits", {"set": changes})
    if as_json:
        emit_json(found)
        return
    report(f"{len(changes)} {'limit is' if len(changes) == 1 else 'limits are'} changed until `rtcp stop`")


def _changes(pairs: Sequence[str]) -> dict[str, float]:
    if len(pairs) % 2:
        raise CommandError(f"{pairs[-1]!r} has no value: give KEY VALUE, as joint2.max 1.2")
    changes: dict[str, float] = {}
    wrong = []
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        try:
            number = plain_number(value)
        except ValueError:
            wrong.append(f"{key}: {value!r} is not a number")
            continue
        if not math.isfinite(number):
            wrong.append(f"{key}: {value} is not finite; a limit is a finite number")
        elif key in changes:
            wrong.append(f"{key} is given twice")
        changes[key] = number
    if wrong:
        raise CommandError("\n".join(wrong))
    return changes


def _picture(found: Mapping[str, Any]) -> list[Any]:
    from rich import box
    from rich.table import Table

    now, configured = found["limits"], found["configured"]
    joints = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1))
    joints.add_column("joint")
    for name, unit in COLUMNS:
        joints.add_column(f"{name}\n{unit}", justify="right")
    for at, joint in enumerate(found["joint_names"]):
        joints.add_row(joint, *(_changed(now[name][at], configured[name][at]) for name, _ in COLUMNS))
    boxes = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1))
    for heading in ("box", "x m", "y m", "z m"):
        boxes.add_column(heading, justify="left" if heading == "box" else "right")
    _row(boxes, "tool inside", now["box"], configured["box"])
    for name, corners in now["keep_out"].items():
        _row(boxes, f"keep out: {name}", corners, configured["keep_out"].get(name))
    tool = Table.grid(padding=(0, 2))
    for name, unit in UNITS.items():
        tool.add_row(f"tool: {name.replace('_', ' ')}", f"{found['cartesian'][name]:g} {unit}")
    for name, value in found["cartesian"]["singularity"].items():
        tool.add_row(f"singularity: {name}", f"{value:g} {'m' if name == 'shoulder' else 'rad'}")
    return [joints, "", boxes, "", tool]


def _row(table: Any, name: str, corners: Mapping[str, Any] | None, configured: Mapping[str, Any] | None) -> None:
    if corners is None:
        return
    before = configured or corners
    table.add_row(
        name,
        *(
            f"{_changed(low, was)} to {_changed(high, had)}"
            for low, high, was, had in zip(corners["min"], corners["max"], before["min"], before["max"], strict=True)
        ),
    )


def _changed(value: float, configured: float) -> str:
    return f"{value:g}" if value == configured else f"{value:g} *"
