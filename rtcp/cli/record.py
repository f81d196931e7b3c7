"""`rtcp record`: recordings of the running platform, by processes of their own."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rtcp.api import RecorderStatus
from rtcp.cli.arguments import AsJson, option
from rtcp.cli.output import ExitCode, emit_json, report, show, table
from rtcp.cli.platform import connect

commands = typer.Typer(name="record", help="Record every cycle to the disk.", no_args_is_help=True)


@commands.command("start")
def _start(
    out: Annotated[
        Path | None, option("--out", "DIR|FILE", "Where to. Default: recordings/ beside the faults of the platform.")
    ] = None,
    format: Annotated[
        str, option("--format", "mcap,csv", "Formats, separated by commas. Default: FILE's ending, or mcap.")
    ] = "",
    signals: Annotated[
        str, option("--signals", "NAMES", "Fields of a record or patterns (*_position), separated by commas.")
    ] = "",
    every: Annotated[int, typer.Option("--every", min=1, max=1_000_000, help="Record every Nth cycle.")] = 1,
    seconds: Annotated[float | None, typer.Option("--seconds", help="Duration, s.")] = None,
    max_file_mb: Annotated[int | None, option("--max-file-mb", "MB", "Size at which the next file begins.")] = None,
    max_file_seconds: Annotated[
        float | None, option("--max-file-seconds", "S", "Age at which the next file begins.")
    ] = None,
    keep: Annotated[int | None, option("--keep", "N", "Newest files that are kept. Default: all.")] = None,
    reserve_mb: Annotated[
        int, option("--reserve-mb", "MB", "Free space of the disk below which the recording ends.")
    ] = 256,
) -> None:
    """Start a recording; it goes on when this command has ended."""
    with connect("record") as robot:
        recording = robot.record_start(
            out, _listed(format), _listed(signals), every, seconds, max_file_mb, max_file_seconds, keep, reserve_mb
        )
    for file in recording.files:
        report(f"recording to {file}")


@commands.command("stop")
def _stop(as_json: AsJson = False) -> None:
    """End all recordings; their files are complete when this returns."""
    with connect("record") as robot:
        ended = robot.record_stop()
    if as_json:
        emit_json({"recordings": [dataclasses.asdict(recording) for recording in ended]})
    elif ended:
        _table(ended)
    else:
        report("nothing is being recorded")
    if any(recording.problem for recording in ended):
        raise typer.Exit(ExitCode.FAULT)


@commands.command("status")
def _status(as_json: AsJson = False) -> None:
    """Show the recordings that run, and those that have ended since the platform was started."""
    with connect("record") as robot:
        recordings = robot.record_status()
    if as_json:
        emit_json({"recordings": [dataclasses.asdict(recording) for recording in recordings]})
    elif recordings:
        _table(recordings)
    else:
        report("nothing has been recorded since the platform was started")


def _listed(text: str) -> list[str]:
    return [item.strip() for item in text.split(",") if item.strip()]


def _table(recordings: Sequence[RecorderStatus]) -> None:
    rows = table(("", "s", "cycles", "missing", "MB"), ("",))
    for entry in recordings:
        state = "recording" if entry.running else "ended early" if entry.problem else "ended"
        rows.add_row(state, f"{entry.seconds:.1f}", str(entry.records), str(entry.missing), f"{entry.bytes / 1e6:.1f}")
    show(rows)
    # Below the table, because a path is longer than what a column has.
    for entry in recordings:
        for line in (*entry.files, *([entry.problem] if entry.problem else [])):
            report(line)
