"""`rtcp experiment` and `rtcp report`: experiments of the thesis repeated, and one page of all their figures."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.api import RtcpError
from rtcp.cli.arguments import BusName, ConfigFile, option
from rtcp.cli.output import SUSPENDING, CommandError, ExitCode, complain, interruptible, report, show, table
from rtcp.cli.platform import refuse_second_platform, running_platform
from rtcp.config.model import VIRTUAL
from rtcp.launch import offline

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.telemetry.experiments.experiment import Result

ALL = "all"
NAMES = ("cycle", "delays", "step", "square", "picks", "latency", "resources", "tracking")
PLANES = ("xy", "yz", "xz")
MISSED = 1

commands = typer.Typer()


@commands.command("experiment")
def _experiment(
    name: Annotated[str, typer.Argument(metavar="NAME", help=f"{', '.join(NAMES)}, or all of them: {ALL}.")],
    plane: Annotated[
        str | None, typer.Argument(metavar="[xy|yz|xz]", help="Of the square; left out: xy and yz.")
    ] = None,
    config: ConfigFile = None,
    bus: BusName = None,
    out: Annotated[
        Path | None, option("--out", "DIR", "New folder for the results. Default: NAME and the time.")
    ] = None,
) -> None:
    """Repeat an experiment of the thesis: a table, pictures, recordings, and for all a page.

    Each starts a platform of its own and stops it. Exit code 1: a figure misses its aim.
    """
    if name not in (*NAMES, ALL):
        raise CommandError(f"there is no experiment {name}: allowed are {', '.join(NAMES)}, {ALL}")
    if plane is not None and (name != "square" or plane not in PLANES):
        raise CommandError(f"{plane}: only a square has a plane, one of {', '.join(PLANES)}")
    refuse_second_platform()
    arm = offline.configuration(config)  # its mistakes are named before anything begins
    if bus is None and arm.bus.interface != VIRTUAL:
        nic = arm.bus.interface
        raise CommandError(f"the bus of {arm.name} is {nic}: a real arm would move. Give --bus {nic} where it may")
    folder = Path(f"{name}-{time.strftime('%Y-%m-%dT%H-%M-%S')}") if out is None else out
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise CommandError(f"the folder {folder} cannot be made: {error.strerror}") from error
    results, failed = [], []
    with interruptible("interrupted: the platform has been stopped", *SUSPENDING):
        for entry in NAMES if name == ALL else (name,):
            try:
                results.append(_carry_out(entry, plane, config, bus, folder / entry if name == ALL else folder))
                show(result_table(results[-1]))
            except RtcpError as error:
                if name != ALL:
                    raise
                failed.append(str(error))
                complain(failed[-1])
    if name == ALL:
        report(f"report: {_write_report([folder], folder / 'report.html')}")
    else:
        report(f"results: {folder}")
    if failed:
        raise typer.Exit(ExitCode.FAULT)
    if not all(result.met for result in results):
        raise typer.Exit(MISSED)


def _carry_out(name: str, plane: str | None, config: Path | None, bus: str | None, folder: Path) -> Result:
    from rtcp.telemetry.experiments import EXPERIMENTS
    from rtcp.telemetry.experiments.experiment import ExperimentFailed, Setup, carry_out
    from rtcp.telemetry.experiments.motions import SquareExperiment

    folder.mkdir(exist_ok=True)
    options = [*(["--config", str(config)] if config else []), *(["--bus", bus] if bus else [])]
    command = shlex.join(["rtcp", "experiment", name, *([plane] if plane else []), *options])
    experiment = SquareExperiment((plane,)) if plane else EXPERIMENTS[name]()
    report(f"{name}: {EXPERIMENTS[name].title}")
    try:
        return carry_out(experiment, Setup(folder, running_platform, report, config, bus), command)
    except ExperimentFailed as error:
        raise RtcpError("fault", f"{name}: {error}") from error
    except OSError as error:
        raise CommandError(f"{folder}: the results cannot be written: {error}", ExitCode.FAULT) from error


def result_table(result: Result) -> Table:
    """Return the table of a result."""
    from rtcp.telemetry.experiments.experiment import shown

    rows = table(("figure", "source", "here", "aim", ""), fill="figure", title=result.title)
    for row in result.rows:
        verdict = "MISSED" if row.met is False else row.verdict
        rows.add_row(row.figure, shown(row.source), f"{shown(row.here)} {row.unit}", row.aim, verdict)
    return rows


@commands.command("report")
def _report(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR..", help="Of `rtcp experiment`: one, or two to compare.")
    ],
    out: Annotated[Path | None, option("--out", "FILE", "The page. Default: report.html in the first folder.")] = None,
) -> None:
    """Make the page of a folder of experiments anew, or of two side by side."""
    report(f"report: {_write_report(folders, folders[0] / 'report.html' if out is None else out)}")


def _write_report(folders: Sequence[Path], out: Path) -> Path:
    from rtcp.telemetry.experiments.experiment import ExperimentFailed
    from rtcp.telemetry.report import page

    try:
        text = page(folders)
        out.write_text(text)
    except ExperimentFailed as error:
        raise CommandError(str(error)) from error
    except OSError as error:
        raise CommandError(f"{out}: the report cannot be written: {error.strerror}", ExitCode.FAULT) from error
    return out
