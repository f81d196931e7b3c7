"""`rtcp limits show` and `set`: limits of joints, tool and boxes, changed as one transaction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, AsJson, number, refuse_options
from rtcp.cli.connection import connect
from rtcp.cli.errors import CommandError
from rtcp.cli.output import emit_json, report, show, table

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
    """Show the limits of joints, tool and boxes; a star marks a changed value."""
    with connect("limits show") as robot:
        found = robot.limits()
    if as_json:
        emit_json(found)
    else:
        show(*_tables(found))


def _set(
    pairs: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY VALUE..",
            help="joint2.max, joints.velocity, box.min.x, user.max.z, ...: rad, m, s, Nm; all apply, or none.",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Change limits within the configured ones; refused as a whole where the arm would be outside."""
    refuse_options(pairs, ("--json",))
    changes = _changes(pairs)
    with connect("limits set") as robot:
        found = robot.set_limits(changes)
    if as_json:
        emit_json(found)
    else:
        report(f"{len(changes)} {'limit is' if len(changes) == 1 else 'limits are'} changed until `rtcp stop`")


def _changes(pairs: Sequence[str]) -> dict[str, float]:
    if len(pairs) % 2:
        raise CommandError(f"{pairs[-1]!r} has no value: give KEY VALUE, as joint2.max 1.2")
    changes: dict[str, float] = {}
    wrong = []
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        if key in changes:
            wrong.append(f"{key} is given twice")
        try:
            changes[key] = number(value, key)
        except CommandError as error:
            wrong.append(error.message)
    if wrong:
        raise CommandError("\n".join(wrong))
    return changes


def _tables(found: Mapping[str, Any]) -> list[Any]:
    from rich.table import Table

    now, configured = found["limits"], found["configured"]
    joints = table(("joint", *(f"{name}\n{unit}" for name, unit in COLUMNS)), ("joint",))
    for at, joint in enumerate(found["joint_names"]):
        joints.add_row(joint, *(_marked(now[name][at], configured[name][at]) for name, _ in COLUMNS))
    boxes = table(("box", "x m", "y m", "z m"), ("box",))
    rows = [("tool inside", now["box"], configured["box"])]
    rows += [(f"keep out: {name}", box, configured["keep_out"].get(name)) for name, box in now["keep_out"].items()]
    for name, box, before in rows:
        if box is not None:
            before = before or box  # noqa: PLW2901
            spans = zip(box["min"], box["max"], before["min"], before["max"], strict=True)
            boxes.add_row(name, *(f"{_marked(low, was)} to {_marked(high, had)}" for low, high, was, had in spans))
    tool = Table.grid(padding=(0, 2))
    for name, unit in UNITS.items():
        tool.add_row(f"tool: {name.replace('_', ' ')}", f"{found['cartesian'][name]:g} {unit}")
    for name, value in found["cartesian"]["singularity"].items():
        tool.add_row(f"singularity: {name}", f"{value:g} {'m' if name == 'shoulder' else 'rad'}")
    return [joints, "", boxes, "", tool]


def _marked(value: float, configured: float) -> str:
    return f"{value:g}" if value == configured else f"{value:g} *"
