"""`rtcp shape-set`: two arms bend a Nitinol rod, a heater sets its shape."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Annotated

import typer

from rtcp.api import RtcpError
from rtcp.cli.arguments import option
from rtcp.cli.output import SUSPENDING, CommandError, ExitCode, complain, emit, interruptible, report

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

    Ctrl-C turns the heat off first, then stops the arms; so do Ctrl-Z, SIGTERM and a terminal that is
    closed.
    """
    # Here: scipy and matplotlib load slowly, and no other command has use for them.
    from rtcp.api.cell import Cell
    from rtcp.processes.shape_setting.job import read_job
    from rtcp.processes.shape_setting.report import write_report
    from rtcp.processes.shape_setting.run import ShapeSettingRun, undisturbed

    job, profile = read_job(file)
    folder = Path(f"shape-set-{time.strftime('%Y-%m-%dT%H-%M-%S')}") if out is None else out

    if not folder.name:
        raise CommandError(f'--out: found "{folder}", allowed is the name of a new folder')

    def confirm(question: str) -> None:
        if yes:
            report(f"{question}: taken as done (--yes)")
            return
        report(f"{question}; then press Enter")
        try:
            input()
        except (EOFError, RuntimeError, UnicodeDecodeError):
            # A standard input that is closed, or that is no text.
            raise RtcpError("invalid", "standard input has ended at a question: answer it, or pass --yes") from None

    with Cell(f"rtcp shape-set (pid {os.getpid()})", cell) as arms:
        run = ShapeSettingRun(arms, job, profile, report, confirm)
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise CommandError(f"--out {folder}: {error.strerror}: name a new folder") from None
        problem = "interrupted"
        try:
            with interruptible("interrupted: all arms come to a controlled stop", *SUSPENDING):
                run.run()
            problem = ""
        except CommandError:
            raise
        except Exception as error:
            problem = str(error) or type(error).__name__
            raise
        finally:
            with undisturbed():
                if problem:
                    complain(_heat(run.heat_is_off, run.middle_c))
                unwritten = ""
                try:
                    page = write_report(folder, job, profile, run.outcome, problem)
                except Exception as error:
                    unwritten = f"no report: {folder}: {getattr(error, 'strerror', '') or error}"
                if problem and unwritten:
                    complain(unwritten)
                elif not unwritten:
                    with contextlib.suppress(OSError):
                        report(f"report: {page}")
    largest, mean = run.outcome.error
    emit(f"released rod against the wanted one: {1e3 * mean:.2f} mm rms, {1e3 * largest:.2f} mm at most")
    if unwritten:
        raise CommandError(unwritten, ExitCode.INTERNAL)


def _heat(is_off: bool, middle_c: float | None) -> str:
    """Return the known temperature and state of the heat after a run that ended early."""
    rod = "" if middle_c is None else f"; the rod may have {middle_c:.0f} C in the middle: do not touch it"
    if is_off:
        return f"relay and gate of the heater are off, as measured, and no current flows{rod}"
    return f"THE HEATER DOES NOT CONFIRM THAT ITS GATE AND RELAY ARE OFF: turn the key to Off{rod}"
