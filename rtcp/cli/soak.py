"""`rtcp soak`: the platform on its virtual segment, broken again and again at random, for as long as one likes."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.errors import CommandError, ExitCode, interruption_code, orderly_signals
from rtcp.cli.launch import launch, refuse_a_second_platform
from rtcp.cli.options import ConfigFile
from rtcp.cli.output import emit, report, show
from rtcp.config.virtual import VIRTUAL

if TYPE_CHECKING:
    from rtcp.telemetry.trials.soak import Summary

LONGEST_MIN = 10_080.0


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("soak")(_soak)


def _soak(
    minutes: Annotated[float, typer.Option("--minutes", metavar="N", help="How long.")] = 60.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="What all that is chosen follows from.")] = 1,
    config: ConfigFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the account as JSON.")] = False,
) -> None:
    """Let the arm work on its virtual segment while faults come at random; say what became of them, and what was lost.

    Ends with 5 where something must not have been: a target beyond its limits, an arm that could not be brought back, a
    torn record, a process that grew.
    """
    if not (math.isfinite(minutes) and 0 < minutes <= LONGEST_MIN):
        raise CommandError(f"--minutes {minutes:g} is not allowed: above 0, at most {LONGEST_MIN:g}")
    if seed < 0:
        raise CommandError(f"--seed {seed} is not allowed: 0 or more")
    refuse_a_second_platform()
    from rtcp.ipc.runtime_directory import runtime_directory
    from rtcp.ipc.session import read_processes, read_session
    from rtcp.launch.launcher import StartOptions
    from rtcp.telemetry.trials.bench import Bench
    from rtcp.telemetry.trials.soak import Soak

    say = (lambda line: None) if as_json else report
    interrupted: KeyboardInterrupt | None = None
    with orderly_signals():
        running = launch(StartOptions(config=config, bus=VIRTUAL, mode="joint"), say)
        try:
            directory = runtime_directory()
            found = read_processes(directory)
            pids = {"loop": found.loop, "gateway": found.gateway, "segment": found.segment}
            with Bench(directory, read_session(directory).config) as bench:
                soak = Soak(bench, pids, seed, say)
                try:
                    soak.run(minutes)
                except KeyboardInterrupt as interruption:
                    interrupted = interruption
        finally:
            left = running.stop()
    soak.summary.failures.extend(left)
    summary = soak.summary
    if as_json:
        emit(json.dumps(_as_json(summary), indent=2))
    else:
        from rtcp.cli.soak_view import tables

        for table in tables(summary):
            show(table)
        until_then = "" if interrupted is None else " until then"
        report("\n".join(summary.failures) or f"nothing was lost{until_then}")
    if interrupted is not None:
        raise CommandError("interrupted; the trial under way was cut off", interruption_code(interrupted))
    if summary.failures:
        raise typer.Exit(ExitCode.FAULT)


def _as_json(summary: Summary) -> dict[str, Any]:
    return dataclasses.asdict(summary)
