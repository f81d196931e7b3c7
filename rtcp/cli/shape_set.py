"""`rtcp shape-set`: two arms bend a Nitinol rod, a heater sets its shape."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated

import typer

from rtcp.api import RtcpError
from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, emit, interruptible, report

commands = typer.Typer()


@commands.command("shape-set")
def _shape_set(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Shape, rod, chucks, profile: docs/shape_setting.md.")],
    out: Annotated[
        Path | None, option("--out", "DIR", "New folder for the report. Default: shape-set and the time.")
    ] = None,
    cell: Annotated[str, option("--cell", "NAME", "The cell, where several run.")] = "",
    yes: Annotated[bool, option("--yes", "Ask nobody: the rod is gripped and released by itself.")] = False,
) -> None:
    """Set the shape of a Nitinol rod: grip, measure, bend, heat, hold, cool, release; a report with pictures.

    Ctrl-C turns the heat off first, then stops the arms; so do SIGTERM and a terminal that is closed.
    """
    # Here: scipy and matplotlib load slowly, and no other command has use for them.
    from rtcp.api.cell import Cell
    from rtcp.processes.shape_setting.job import read_job
    from rtcp.processes.shape_setting.report import write_report
    from rtcp.processes.shape_setting.run import ShapeSettingRun

    job, profile = read_job(file)
    folder = Path(f"shape-set-{time.strftime('%Y-%m-%dT%H-%M-%S')}") if out is None else out

    def confirm(what: str) -> None:
        if yes:
            report(f"{what}: taken as done (--yes)")
        else:
            typer.prompt(f"{what}; then press Enter", default="", show_default=False, prompt_suffix="")

    with Cell(f"rtcp shape-set (pid {os.getpid()})", cell) as arms:
        run = ShapeSettingRun(arms, job, profile, report, confirm)
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise CommandError(f"--out {folder}: {error.strerror}: name a new folder") from None
        problem = "interrupted"
        try:
            with interruptible("interrupted: all arms come to a controlled stop"):
                run.run()
            problem = ""
        except RtcpError as error:
            problem = error.message
            raise
        finally:
            if problem:
                report(
                    "relay and gate of the heater are off, as measured, and no current flows"
                    if run.heat_is_off
                    else "THE HEATER DOES NOT CONFIRM THAT ITS GATE AND RELAY ARE OFF: turn the key to Off"
                )
            page = write_report(folder, job, profile, run.outcome, problem)
            emit(f"report: {page}")
    largest, mean = run.outcome.error
    emit(f"released rod against the wanted one: {1e3 * mean:.2f} mm rms, {1e3 * largest:.2f} mm at most")
