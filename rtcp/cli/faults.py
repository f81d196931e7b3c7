"""`rtcp faults`: the recordings of the black box. No platform is needed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import AsJson, check_picture, option
from rtcp.cli.output import CommandError, ExitCode, emit_json, facts, report, show, table

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from rtcp.ipc.recording import Listed

SERVICE_FAULTS = Path("/var/lib/rtcp/faults")
"""Recordings of the service and of root; StateDirectory= of the unit."""
JOINT_COLUMNS = {"position rad": "actual_position", "target rad": "sent_position", "velocity rad/s": "actual_velocity",
                 "torque Nm": "actual_torque"}  # fmt: skip

commands = typer.Typer(name="faults", help="List the recorded faults, show one.", invoke_without_command=True)


@commands.callback()
def _list(context: typer.Context, as_json: AsJson = False) -> None:
    """List the recorded faults, the newest last."""
    if context.invoked_subcommand is not None:
        return
    from rtcp.ipc.recording import faults_directory, listed

    with _readable():
        faults = listed(faults_directory())
    if as_json:
        emit_json({"faults": [_row(fault) for fault in faults]})
    elif faults:
        show(*_list_table(faults))
    else:
        report(f"no fault has been recorded in {faults_directory()}{_service_hint()}")


@commands.command("show")
def _show(
    which: Annotated[
        str, typer.Argument(metavar="N|FILE", help="Number of a fault, as `rtcp faults` lists it, or its file.")
    ],
    plot: Annotated[
        Path | None,
        option("--plot", "FILE", "Picture: .png, .svg or .pdf. Default: a .png beside the recording."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show one fault: what happened when, where the joints were, and a picture of it."""
    if plot is not None:
        check_picture("--plot", plot)
    path = _recording(int(which)) if which.isdecimal() else Path(which)
    if not path.exists():
        raise CommandError(f"{which}: no such file: give a number of `rtcp faults`, or a recording (.mcap)")
    from rtcp.ipc.recording import read
    from rtcp.telemetry.fault_report import draw, summary

    with _readable():
        recording = read(path)
    fault = {**summary(recording), "file": str(path)}
    if not as_json or plot is not None:
        out = _picture_file(path) if plot is None else plot
        fault["picture"] = str(out)
        try:
            draw(recording, out)
        except OSError as error:
            option, code = ("", ExitCode.FAULT) if plot is None else ("--plot ", ExitCode.USAGE)
            raise CommandError(f"{option}{out} cannot be written: {error.strerror or error}", code) from error
    if as_json:
        emit_json(fault)
        return
    show(*_fault_tables(fault))
    report(f"\nrecording: {fault['file']}\npicture: {fault['picture']}")


@contextmanager
def _readable() -> Iterator[None]:
    from rtcp.ipc.recording import RecordingError

    try:
        yield
    except RecordingError as error:
        raise CommandError(str(error), ExitCode.FAULT) from error


def _recording(number: int) -> Path:
    """Return the recording of this number; raises CommandError with the numbers that exist."""
    from rtcp.ipc.recording import faults_directory, files

    with _readable():
        recorded = dict(files(faults_directory()))
    if number in recorded:
        return recorded[number]
    which = f"recorded: {_spans(sorted(recorded))}" if recorded else f"none has been recorded{_service_hint()}"
    raise CommandError(f"there is no fault {number} in {faults_directory()}: {which}")


def _service_hint() -> str:
    """Return a hint at the recordings of the service, for a user whose own list is empty."""
    from rtcp.ipc.recording import faults_directory

    if faults_directory() == SERVICE_FAULTS or not os.path.isdir(SERVICE_FAULTS):
        return ""
    return f"; the service records in {SERVICE_FAULTS} (`sudo rtcp faults`)"


def _spans(numbers: list[int]) -> str:
    """Return rising numbers as `3, 5-9`."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][-1] + 1:
            spans[-1][1:] = [number]
        else:
            spans.append([number])
    return ", ".join("-".join(map(str, span)) for span in spans)


def _picture_file(recording: Path) -> Path:
    """Return a file beside the recording, or in the working directory where that cannot be written to."""
    beside = recording.with_suffix(".png")
    return beside if os.access(beside.parent, os.W_OK) else Path(beside.name)


def _row(fault: Listed) -> dict[str, Any]:
    if fault.about is None:
        return {"number": fault.number, "file": str(fault.path), "error": fault.trouble}
    return {
        "number": fault.number,
        "time": fault.about.when.isoformat(timespec="milliseconds"),
        "what": fault.about.what,
        "before": fault.about.before,
        "seconds": round(fault.seconds, 4),
        "notes": list(fault.about.notes),
        "file": str(fault.path),
    }


def _list_table(faults: Sequence[Listed]) -> list[RenderableType]:
    """Return the list; problems of recordings follow below it."""
    from rich.text import Text

    rows = table(("#", "time", "what", "before", "recorded"), ("time", "before"), expand=True, fill="what")
    notes: list[RenderableType] = []
    for fault in faults:
        if fault.about is None:
            rows.add_row(str(fault.number), "-", Text("unreadable", "red"), "-", "-")
            notes.append(Text(f"{fault.number}: {fault.trouble}", "red"))
            continue
        event = Text(fault.about.what.partition(";")[0])
        when = f"{fault.about.when:%Y-%m-%d %H:%M:%S}"
        rows.add_row(str(fault.number), when, event, fault.about.before, f"{fault.seconds:.1f} s")
        notes += [Text(f"{fault.number}: {note}") for note in fault.about.notes]
    return [rows, *([Text()] if notes else []), *notes]


def _fault_tables(fault: dict[str, Any]) -> list[RenderableType]:
    """Return the tables of a fault, from its summary."""
    from rich import box
    from rich.panel import Panel
    from rich.text import Text

    title = (f"FAULT {fault['number']}", "bold red") if fault["number"] else ("SESSION", "bold")
    head = Text.assemble(title, f"   {fault['time'].replace('T', ' ')}   ")
    head.append(f"{fault['arm']} on {fault['bus']}, every {fault['cycle_ns'] / 1000:g} us\n")
    head.append(fault["what"], "red")
    versions = ", ".join(f"{name} {version}" for name, version in fault["versions"].items())
    head.append(f"\nbefore: {fault['before']}; {versions}")
    timeline = table(("s", "what happened"), expand=True, fill="what happened")
    for entry in fault["timeline"]:
        timeline.add_row(f"{entry['t_s']:+.3f}", Text(entry["message"]))
    parts: list[RenderableType] = [Panel(head, box=box.ROUNDED, title="rtcp", title_align="left"), timeline]
    if "joints" in fault:
        joints = table(("at the fault", *JOINT_COLUMNS), ("at the fault",), expand=True)
        for at, name in enumerate(fault["joint_names"]):
            joints.add_row(name, *(f"{fault['joints'][column][at]:+.4f}" for column in JOINT_COLUMNS.values()))
        parts += [Text(), joints, Text(), _facts(fault)]
    return [*parts, *(Text(note, "yellow") for note in fault["notes"])]


def _facts(fault: dict[str, Any]) -> Table:
    rows = facts()
    rows.columns[0].style = "bold"
    rows.add_row("recorded", f"{fault['cycles']} cycles, {fault['begins_s']:+.1f} s to {fault['ends_s']:+.1f} s")
    if step := fault["largest_step"]:
        where = f"{step['joint']}, {step['rad_per_s']:.4g} rad/s, at {step['t_s']:+.3f} s"
        rows.add_row("largest step", f"{step['rad']:.3g} rad of a target in one cycle ({where})")
    rows.add_row("missed", f"{fault['missed']} cycles of the grid")
    wkc = fault["wkc"]
    counted = f"working counter {wkc['actual']} of {wkc['expected']} at the fault"
    rows.add_row("frames", f"{counted}; {wkc['wrong_cycles']} wrong, {wkc['without_answer']} without an answer")
    return rows
