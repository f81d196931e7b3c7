"""The tables of `rtcp faults`: whole at 80 columns, readable without colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from rtcp.gateway.blackbox_file import Listed

JOINT_COLUMNS = (("position", "rad"), ("target", "rad"), ("velocity", "rad/s"), ("torque", "Nm"))


def table(found: Sequence[Listed]) -> RenderableType:
    """Return the list; what is lacking of a recording stands below it."""
    rows = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    rows.add_column("#", justify="right")
    rows.add_column("time", no_wrap=True)
    rows.add_column("what", ratio=1)
    rows.add_column("before", no_wrap=True)
    rows.add_column("recorded", justify="right", no_wrap=True)
    below: list[RenderableType] = []
    for one in found:
        if one.about is None:
            rows.add_row(str(one.number), "-", Text("unreadable", "red"), "-", "-")
            below.append(Text(f"{one.number}: {one.trouble}", "red"))
            continue
        about = one.about
        what = Text(about.what.partition(";")[0])
        rows.add_row(str(one.number), f"{about.when:%Y-%m-%d %H:%M:%S}", what, about.before, f"{one.seconds:.1f} s")
        below += [Text(f"{one.number}: {note}") for note in about.notes]
    return Group(rows, *([Text()] if below else []), *below)


def picture(told: dict[str, Any]) -> RenderableType:
    """Return everything about one fault, from its summary."""
    parts: list[RenderableType] = [_head(told), _timeline(told)]
    if "joints" in told:
        parts += [Text(), _joints(told), Text(), _facts(told)]
    return Group(*parts, *(Text(note, "yellow") for note in told["notes"]))


def _head(told: dict[str, Any]) -> Panel:
    line = Text.assemble((f"FAULT {told['number']}", "bold red"), f"   {told['time'].replace('T', ' ')}   ")
    line.append(f"{told['arm']} on {told['bus']}, every {told['cycle_ns'] / 1000:g} us\n")
    line.append(told["what"], "red")
    line.append(f"\nbefore: {told['before']}; " + ", ".join(f"{name} {one}" for name, one in told["versions"].items()))
    return Panel(line, box=box.ROUNDED, title="rtcp", title_align="left")


def _timeline(told: dict[str, Any]) -> Table:
    rows = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    rows.add_column("s", justify="right", no_wrap=True)
    rows.add_column("what happened", ratio=1)
    for moment in told["timeline"]:
        rows.add_row(f"{moment['t_s']:+.3f}", Text(moment["sentence"]))
    return rows


def _joints(told: dict[str, Any]) -> Table:
    rows = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    rows.add_column("at the fault")
    for name, unit in JOINT_COLUMNS:
        rows.add_column(f"{name} {unit}", justify="right")
    for at, name in enumerate(told["joint_names"]):
        rows.add_row(name, *(f"{told['joints'][column][at]:+.4f}" for column, _ in JOINT_COLUMNS))
    return rows


def _facts(told: dict[str, Any]) -> Table:
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold", no_wrap=True)
    facts.add_column()
    facts.add_row("recorded", f"{told['cycles']} cycles, {told['begins_s']:+.1f} s to {told['ends_s']:+.1f} s")
    if step := told["largest_step"]:
        where = f"{step['joint']}, {step['rad_per_s']:.4g} rad/s, at {step['t_s']:+.3f} s"
        facts.add_row("largest step", f"{step['rad']:.3g} rad of a target in one cycle ({where})")
    facts.add_row("missed", f"{told['missed']} cycles of the grid")
    wkc = told["wkc"]
    at_the_fault = f"working counter {wkc['actual']} of {wkc['expected']} at the fault"
    facts.add_row("frames", f"{at_the_fault}; {wkc['wrong_cycles']} wrong, {wkc['without_answer']} without an answer")
    return facts
