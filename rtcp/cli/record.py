"""`rtcp record`: recordings of the running platform, by processes of their own."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rtcp.api import Recording
from rtcp.cli.arguments import AsJson, option
from rtcp.cli.output import CommandError, ExitCode, emit_json, report, show, table
from rtcp.cli.platform import connect

FORMATS = ("mcap", "csv")

commands = typer.Typer(name="record", help="Record every cycle to the disk.", no_args_is_help=True)


@commands.command("start")
def _start(
    out: Annotated[
        Path | None, option("--out", "DIR|FILE", "Where to. Default: recordings/ beside the faults of the platform.")
    ] = None,
    format: Annotated[
        str | None, option("--format", "mcap,csv", "Formats, separated by commas. Default: FILE's ending, or mcap.")
    ] = None,
    signals: Annotated[
        str, option("--signals", "NAMES", "Fields of a record or patterns (*_position), separated by commas.")
    ] = "",
    every: Annotated[int, typer.Option("--every", min=1, max=1_000_000, help="Record every Nth cycle.")] = 1,
    seconds: Annotated[float | None, typer.Option("--seconds", help="Duration, s.")] = None,
) -> None:
    """Start a recording; it goes on when this command has ended."""
    ending = "" if out is None else out.suffix.removeprefix(".")
    formats = _listed(format) if format else [ending if ending in FORMATS else FORMATS[0]]
    for one in formats:
        if one not in FORMATS:
            raise CommandError(f"--format: found {one}, allowed are {', '.join(FORMATS)}")
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise CommandError(f"--seconds: found {seconds:g}, allowed is a number greater than 0")
    with connect("record") as robot:
        made = robot.record_start(out, formats, _listed(signals), every, seconds)
    for file in made.files:
        report(f"recording to {file}")


@commands.command("stop")
def _stop(as_json: AsJson = False) -> None:
    """End all recordings; their files are complete when this returns."""
    with connect("record") as robot:
        ended = robot.record_stop()
    if as_json:
        emit_json({"recordings": [dataclasses.asdict(one) for one in ended]})
    elif ended:
        _table(ended)
    else:
        report("nothing is being recorded")
    if any(one.problem for one in ended):
        raise typer.Exit(ExitCode.FAULT)


@commands.command("status")
def _status(as_json: AsJson = False) -> None:
    """Show the recordings that run, and those that have ended since the platform was started."""
    with connect("record") as robot:
        found = robot.record_status()
    if as_json:
        emit_json({"recordings": [dataclasses.asdict(one) for one in found]})
    elif found:
        _table(found)
    else:
        report("nothing has been recorded since the platform was started")


def _listed(text: str) -> list[str]:
    return [one.strip() for one in text.split(",") if one.strip()]


def _table(recordings: Sequence[Recording]) -> None:
    rows = table(("", "s", "cycles", "missing", "MB"), ("",))
    for one in recordings:
        state = "recording" if one.running else "ended early" if one.problem else "ended"
        rows.add_row(state, f"{one.seconds:.1f}", str(one.records), str(one.missing), f"{one.bytes / 1e6:.1f}")
    show(rows)
    # Below the table, because a path is longer than what a column has.
    for one in recordings:
        for line in (*one.files, *([one.problem] if one.problem else [])):
            report(line)
