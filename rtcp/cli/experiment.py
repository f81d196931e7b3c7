"""`rtcp experiment` and `rtcp report`: experiments of the thesis repeated, and one page of all their figures."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.api import RtcpError
from rtcp.cli.arguments import BusName, ConfigFile, number, option, positive
from rtcp.cli.output import SUSPENDING, CommandError, ExitCode, complain, interruptible, report, show, table
from rtcp.cli.platform import refuse_second_platform, running_platform
from rtcp.config.model import VIRTUAL
from rtcp.launch import offline

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.telemetry.experiments.experiment import Experiment, Result

ALL = "all"
NAMES = ("cycle", "delays", "step", "square", "picks", "joystick", "latency", "resources", "tracking", "temperature",
         "oversampling")  # fmt: skip
_APART = ("temperature", "oversampling")
"""What `all` leaves out: experiments without an arm."""
PLANES = ("xy", "yz", "xz")
MISSED = 1
_TRIALS = 3

commands = typer.Typer()


@commands.command("experiment")
def _experiment(
    name: Annotated[str, typer.Argument(metavar="NAME", help=f"{', '.join(NAMES)}, or all but the last two: {ALL}.")],
    plane: Annotated[
        str | None, typer.Argument(metavar="[xy|yz|xz]", help="Of the square; left out: xy and yz.")
    ] = None,
    config: ConfigFile = None,
    bus: BusName = None,
    out: Annotated[
        Path | None, option("--out", "DIR", "New folder for the results. Default: NAME and the time.")
    ] = None,
    csv: Annotated[
        list[str] | None,
        option("--csv", "TARGET_US=FILE", "Of cycle: an oscilloscope's file in place of a platform; may be repeated."),
    ] = None,
    channel: Annotated[
        int | None, typer.Option("--channel", min=1, help="Of --csv: column of levels. Default: 1.", show_default=False)
    ] = None,
    speed: Annotated[
        list[float] | None, typer.Option("--speed", help="Of the square: speed of the tool, m/s; may be repeated.")
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials", min=1, help=f"Of joystick: trials of each task and way. Default: {_TRIALS}.", show_default=False
        ),
    ] = None,
    accelerometer: Annotated[
        str,
        option("--accelerometer", "SLAVE.CHANNEL", "Of latency: input channel with the flange's acceleration, m/s2."),
    ] = "",
    records: Annotated[
        Path | None, option("--records", "DIR", "Of joystick: records of `rtcp user-trial` in place of a platform.")
    ] = None,
) -> None:
    """Repeat an experiment of the thesis: a table, pictures, recordings, and for all a page.

    Each starts a platform of its own and stops it. Exit code 1: a figure misses its aim.
    """
    if name not in (*NAMES, ALL):
        raise CommandError(f"there is no experiment {name}: allowed are {', '.join(NAMES)}, {ALL}")
    if plane is not None and (name != "square" or plane not in PLANES):
        raise CommandError(f"{plane}: only a square has a plane, one of {', '.join(PLANES)}")
    for written, given, used_by in (
        ("--csv", csv, "cycle"), ("--channel", channel, "cycle"), ("--speed", speed, "square"),
        ("--trials", trials, "joystick"), ("--records", records, "joystick"),
        ("--accelerometer", accelerometer, "latency"),
    ):  # fmt: skip
        if given and name != used_by:
            raise CommandError(f"{written} is not an option of {name}: leave it out, or use rtcp experiment {used_by}")
    if channel and not csv:
        raise CommandError("--channel is the column of the files of --csv: give --csv too, or leave out --channel")
    if trials and records:
        raise CommandError("--trials is not allowed beside --records, which starts no trials: leave one of them out")
    for value in speed or ():
        positive("--speed", value, "m/s")
    options = _Options(
        plane, _captures(csv or ()), channel or 1, tuple(speed or ()), trials or _TRIALS, records, accelerometer
    )
    if options.needs_platform:
        refuse_second_platform()
    arm = offline.configuration(config)  # its mistakes are named before anything begins
    if options.needs_platform and bus is None and arm.bus.interface != VIRTUAL:
        nic = arm.bus.interface
        raise CommandError(f"the bus of {arm.name} is {nic}: a real arm would move. Give --bus {nic} where it may")
    folder = Path(f"{name}-{time.strftime('%Y-%m-%dT%H-%M-%S')}") if out is None else out
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise CommandError(f"the folder {folder} cannot be made: {error.strerror}") from error
    results, failed = [], []
    with interruptible("interrupted: the platform has been stopped", *SUSPENDING):
        for entry in [each for each in NAMES if each not in _APART] if name == ALL else (name,):
            try:
                results.append(_carry_out(entry, options, config, bus, folder / entry if name == ALL else folder))
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


@dataclass(frozen=True)
class _Options:
    """Options of single experiments."""

    plane: str | None
    captures: Mapping[float, Path]
    channel: int
    speeds: tuple[float, ...]
    trials: int
    records: Path | None
    accelerometer: str

    @property
    def needs_platform(self) -> bool:
        """Whether the experiment starts a platform: it does not evaluate files."""
        return not self.captures and self.records is None

    def experiment(self, name: str) -> Experiment:
        """Return the experiment that these options make of a name."""
        from rtcp.telemetry.experiments import EXPERIMENTS, JoystickExperiment, LatencyExperiment, SquareExperiment
        from rtcp.telemetry.experiments.motions import SOURCE_PLANES
        from rtcp.telemetry.experiments.timing import OscilloscopeExperiment
        from rtcp.telemetry.experiments.user_trials import UserTrialsExperiment
        from rtcp.telemetry.square import SPEED_M_S

        if self.captures:
            return OscilloscopeExperiment(self.captures, self.channel)
        if self.records is not None:
            return UserTrialsExperiment(self.records)
        if name == "latency":
            return LatencyExperiment(accelerometer=self.accelerometer)
        if name == "square":
            return SquareExperiment((self.plane,) if self.plane else SOURCE_PLANES, self.speeds or (SPEED_M_S,))
        return JoystickExperiment(self.trials) if name == "joystick" else EXPERIMENTS[name]()

    def words(self, name: str) -> list[str]:
        """Return them as they are written after the name of the experiment."""
        words = [self.plane] if self.plane else []
        for target, file in self.captures.items():
            words += ["--csv", f"{target:g}={file}"]
        words += ["--channel", str(self.channel)] if self.captures else []
        for speed in self.speeds:
            words += ["--speed", f"{speed:g}"]
        words += ["--accelerometer", self.accelerometer] if self.accelerometer and name == "latency" else []
        words += ["--trials", str(self.trials)] if name == "joystick" and self.records is None else []
        return [*words, *(["--records", str(self.records)] if self.records is not None else [])]


def _captures(values: Sequence[str]) -> dict[float, Path]:
    """Return target, us -> file from the values of --csv; raises CommandError."""
    captures: dict[float, Path] = {}
    for value in values:
        target, equals, file = value.partition("=")
        if not (equals and file):
            raise CommandError(f"--csv {value} is not allowed: TARGET_US=FILE, as 500=scope.csv")
        target_us = number(target, "--csv, TARGET_US", "us")
        positive("--csv, TARGET_US", target_us, "us")
        if target_us in captures:
            raise CommandError(
                f"--csv has two files for {target_us:g} us: {captures[target_us]} and {file}. Give one for each target"
            )
        captures[target_us] = Path(file)
    return captures


def _carry_out(name: str, options: _Options, config: Path | None, bus: str | None, folder: Path) -> Result:
    from rtcp.telemetry.experiments.experiment import RESULT, ExperimentFailed, Setup, carry_out, read_result

    folder.mkdir(exist_ok=True)
    where = [*(["--config", str(config)] if config else []), *(["--bus", bus] if bus else [])]
    command = shlex.join(["rtcp", "experiment", name, *options.words(name), *where])
    experiment = options.experiment(name)
    report(f"{name}: {experiment.title}")
    try:
        return carry_out(experiment, Setup(folder, running_platform, report, config, bus), command)
    except (ExperimentFailed, RtcpError) as error:
        if (folder / RESULT).exists():
            show(result_table(read_result(folder)))  # what was measured before it failed
        if isinstance(error, RtcpError):
            raise
        raise RtcpError("fault", f"{name}: {error}") from error
    except OSError as error:
        raise CommandError(f"{folder}: the results cannot be written: {error}", ExitCode.FAULT) from error


def result_table(result: Result) -> Table:
    """Return the table of a result."""
    from rtcp.telemetry.experiments.experiment import shown

    rows = table(("figure", "thesis", "here", "aim", ""), fill="figure", title=result.title)
    for row in result.rows:
        verdict = "MISSED" if row.met is False else row.verdict
        rows.add_row(row.figure, shown(row.source), f"{shown(row.here)} {row.unit}", row.aim, verdict)
    return rows


@commands.command("report")
def _report(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR..", help="Of `rtcp experiment`: one, or two or three to compare.")
    ],
    out: Annotated[Path | None, option("--out", "FILE", "The page. Default: report.html in the first folder.")] = None,
) -> None:
    """Make the page of a folder of experiments anew, or of two or three side by side."""
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
