"""`rtcp export`, `rtcp plot`, `rtcp replay`: use of a recording. The first two need no platform."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.api import RtcpError
from rtcp.cli.arguments import check_picture, finite, option, positive
from rtcp.cli.motion import arrival
from rtcp.cli.output import CommandError, ExitCode, complain, progress, report
from rtcp.cli.platform import stoppable

if TYPE_CHECKING:
    from rtcp.telemetry.reading import Reader

FORMATS = ("csv", "mcap", "npz")
_SLOWEST = 0.1
"""Least speed of a smoothed replay, as a share of the recorded speed."""
File = Annotated[Path, typer.Argument(metavar="FILE", help="A recording: .mcap or .csv; a fault of the black box.")]
Signals = Annotated[str, option("--signals", "NAMES", "Fields of a record or patterns (*_position), by commas.")]
Start = Annotated[float | None, typer.Option("--start", help="Begin, s from the first record.")]
End = Annotated[float | None, typer.Option("--end", help="End, s from the first record.")]

commands = typer.Typer()


@commands.command("export")
def _export(
    file: File,
    to: Annotated[str | None, option("--to", "csv|mcap|npz", "Format. Default: the ending of --out.")] = None,
    out: Annotated[Path | None, option("--out", "FILE", "Where to. Default: beside FILE, with another ending.")] = None,
    signals: Signals = "",
    start: Start = None,
    end: End = None,
    force: Annotated[bool, option("--force", "Replace a file that exists.")] = False,
) -> None:
    """Write a recording, or a part of it, in another format."""
    form = to or ("" if out is None else out.suffix[1:])
    if form not in FORMATS:
        raise CommandError(f"--to: found {form or 'nothing'}, allowed are {', '.join(FORMATS)}")
    target = file.with_suffix(f".{form}") if out is None else out
    if target.suffix != f".{form}":
        raise CommandError(f"--out {target}: its ending must be that of the format, .{form}")
    with _readable(start, end):
        from rtcp.telemetry.export import export
        from rtcp.telemetry.reading import Reader

        reader = Reader(file, _names(signals), start, end)
        count = export(reader, target, force)
        _complain_of(reader)
    report(f"{count} records in {target}")


@commands.command("plot")
def _plot(
    file: File,
    signals: Signals = "",
    out: Annotated[
        Path | None, option("--out", "FILE", "Picture: .png, .svg or .pdf. Default: a .png beside FILE.")
    ] = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Draw a recording: one plot a signal; the peak of a single cycle stays visible."""
    picture = file.with_suffix(".png") if out is None else out
    check_picture("--out", picture)
    with _readable(start, end):
        from rtcp.telemetry.fault_report import save
        from rtcp.telemetry.reading import Reader
        from rtcp.telemetry.recording_plot import figure

        reader = Reader(file, _names(signals), start, end)
        drawn = figure(reader)
        _complain_of(reader)
    try:
        save(drawn, picture)
    except OSError as error:
        raise CommandError(f"--out {picture} cannot be written: {error.strerror or error}") from error
    report(f"picture: {picture}")


@commands.command("replay")
def _replay(
    file: File,
    start: Start = None,
    end: End = None,
    speed: Annotated[float, option("--speed", "SCALE", "Scale of the recorded speed.")] = 1.0,
    smooth: Annotated[
        float | None,
        option("--smooth", "HZ", "Cutoff, 0.2 to 20: smooth a hand-guided motion; slower where limits need it."),
    ] = None,
    rest: Annotated[float | None, option("--rest", "S", "Shorten longer rests in it to S, s.")] = None,
) -> None:
    """Move the arm along a recorded joint motion, checked as a whole first. Ctrl-C stops it."""
    positive("--speed", speed, "its recorded speed", 10.0)
    positive("--rest", rest, "s")
    if smooth is not None and not 0.2 <= smooth <= 20.0:
        raise CommandError(f"--smooth {smooth:g} is not allowed: 0.2 to 20 Hz")
    with _readable(start, end):
        from rtcp.telemetry.reading import read
        from rtcp.telemetry.replay import deviation, trajectory

        # A CSV has no flags.
        signals = ["*_position"] if file.suffix.lower() == ".csv" else ["*_position", "flag*"]
        recorded = read(file, signals, start, end)
        points = trajectory(recorded, speed, smooth, rest)
        apart = None if smooth is None else deviation(recorded, smooth)
    if recorded.truncated or recorded.missing:
        complain(f"{file}: {recorded.missing} records are missing{', and its end' if recorded.truncated else ''}")
    with stoppable("replay") as robot, progress() as show_progress:
        joints, wanted = recorded.joints, robot.status().joint_names
        if (count := len(points[0]["q"])) != len(wanted) or joints not in ((), wanted):
            has = f"{count} joints {', '.join(joints)}".rstrip()
            raise CommandError(f"{file}: it has {has}; the arm has {len(wanted)}: {', '.join(wanted)}")
        if apart is not None:
            report(f"smoothed: at most {apart:.4f} rad from the recorded positions")
        while True:
            report(f"{len(points)} points, {points[-1]['t']:.1f} s, after a move to the first")
            try:
                arrived = robot.run_trajectory(points, True, show_progress)
                break
            except RtcpError as error:
                if error.reason != "PlanTooFast":
                    raise
                slower = 0.9 * speed
                if smooth is None or slower < _SLOWEST:
                    hint = f"nothing has moved; a motion recorded at its limits passes with --speed {slower:.2g}"
                    raise CommandError(f"{error.message}; {hint}", ExitCode.REFUSED) from error
                speed = slower
                report(f"too fast for a joint: at {speed:.0%} of its speed")
                points = trajectory(recorded, speed, smooth, rest)
    report(arrival(arrived))


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _complain_of(reader: Reader) -> None:
    if reader.truncated:
        complain(f"{reader.path}: its end is missing or damaged: what is whole before it has been read")


@contextmanager
def _readable(start: float | None, end: float | None) -> Iterator[None]:
    from rtcp.ipc.recording import RecordingError

    for name, value in (("--start", start), ("--end", end)):
        finite(name, 0.0 if value is None else value, "s")
    try:
        yield
    except RecordingError as error:
        hint = ": --force replaces it, --out names another" if error.kind == "exists" else ""
        raise CommandError(f"{error}{hint}") from error
