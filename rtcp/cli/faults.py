"""`rtcp faults`: what the black box has recorded. No platform is needed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import emit_json, report, show

if TYPE_CHECKING:
    from rtcp.gateway.blackbox_file import Listed

SERVICE_FAULTS = Path("/var/lib/rtcp/faults")
"""Of the service and of root; `systemd/` has it as StateDirectory=."""

PICTURES = (".png", ".svg", ".pdf")

AsJson = Annotated[bool, typer.Option("--json", help="One JSON object, SI units.")]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    faults = typer.Typer(help="List what the black box has recorded, show one fault.", invoke_without_command=True)
    faults.callback()(_list)
    faults.command("show")(_show)
    app.add_typer(faults, name="faults")


def _list(context: typer.Context, as_json: AsJson = False) -> None:
    """List the recorded faults, the newest last."""
    if context.invoked_subcommand is not None:
        return
    found = _listed()
    if as_json:
        from rtcp.cli.faults_summary import as_row

        emit_json({"faults": [as_row(one) for one in found]})
    elif found:
        from rtcp.cli.faults_view import table

        show(table(found))
    else:
        from rtcp.gateway.blackbox_file import faults_directory

        report(f"no fault has been recorded ({faults_directory()}){_elsewhere()}")


def _show(
    number: Annotated[int, typer.Argument(metavar="N", help="Number of a fault, as `rtcp faults` lists it.")],
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="The picture: .png, .svg or .pdf; else beside the recording."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show one fault: what happened when, where the joints were, and a picture of it."""
    if plot is not None and plot.suffix.lower() not in PICTURES:
        raise CommandError(f"--plot {plot}: the ending {plot.suffix!r} is none of {', '.join(PICTURES)}")
    path = _path(number)
    from rtcp.gateway.blackbox_file import RecordingError, read

    try:
        recording = read(path)
    except RecordingError as error:
        raise CommandError(str(error), ExitCode.FAULT) from error
    from rtcp.cli.faults_summary import summary

    told = {**summary(recording), "file": str(path)}
    if not as_json or plot is not None:
        from rtcp.cli.faults_plot import draw

        told["picture"] = str(out := _place(plot, path))
        try:
            draw(recording, out)
        except OSError as error:
            option, code = ("", ExitCode.FAULT) if plot is None else ("--plot ", ExitCode.USAGE)
            why = f"{option}{out}: the picture cannot be written there: {error.strerror or error}"
            raise CommandError(why, code) from error
    if as_json:
        emit_json(told)
        return
    from rtcp.cli.faults_view import picture

    show(picture(told))
    report(f"\nrecording: {told['file']}\npicture: {told['picture']}")


def _listed() -> list[Listed]:
    from rtcp.gateway.blackbox_file import RecordingError, faults_directory, listed

    try:
        return listed(faults_directory())
    except RecordingError as error:
        raise CommandError(str(error), ExitCode.FAULT) from error


def _path(number: int) -> Path:
    """Return the recording of this number.

    Raises:
        CommandError: there is none; it says which there are.
    """
    from rtcp.gateway.blackbox_file import RecordingError, faults_directory, files

    directory = faults_directory()
    try:
        there = dict(files(directory))
    except RecordingError as error:
        raise CommandError(str(error), ExitCode.FAULT) from error
    if number in there:
        return there[number]
    which = f"recorded: {_spans(sorted(there))}" if there else f"none has been recorded{_elsewhere()}"
    raise CommandError(f"there is no fault {number} in {directory}: {which}")


def _elsewhere() -> str:
    """Return where the service records, of which another user has an empty list of their own."""
    from rtcp.gateway.blackbox_file import faults_directory

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


def _place(plot: Path | None, recording: Path) -> Path:
    """Return where the picture goes: where it was asked for, beside the recording, or here where that may not be."""
    if plot is not None:
        return plot
    beside = recording.with_suffix(".png")
    return beside if os.access(beside.parent, os.W_OK) else Path(beside.name)
