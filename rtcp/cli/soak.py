"""`rtcp soak`: the platform on its virtual segment, with random faults, for a long time."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.cli.arguments import AsJson, ConfigFile, option, positive
from rtcp.cli.output import CommandError, ExitCode, emit, interruption_code, report, show, signals_raise, table
from rtcp.cli.platform import launch, refuse_second_platform
from rtcp.config.model import VIRTUAL

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.telemetry.soak import Summary

LONGEST_MIN = 10_080.0

commands = typer.Typer()


@commands.command("soak")
def _soak(
    minutes: Annotated[float, option("--minutes", "N", "Duration.")] = 60.0,
    seed: Annotated[int, option("--seed", "N", "Seed of all random choices.")] = 1,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Run the arm on its virtual segment with random faults; show the result of each kind of fault.

    Exit code 5 for any violation: a target outside its limits, an arm that does not recover, a torn record, a process
    that grows.
    """
    positive("--minutes", minutes, "min", LONGEST_MIN)
    if seed < 0:
        raise CommandError(f"--seed {seed} is not allowed: 0 or more")
    refuse_second_platform()
    from rtcp.ipc.runtime_directory import runtime_directory
    from rtcp.ipc.session import read_processes, read_session
    from rtcp.launch.launcher import StartOptions
    from rtcp.telemetry.harness import Harness
    from rtcp.telemetry.soak import Soak

    log = (lambda line: None) if as_json else report
    interrupted: KeyboardInterrupt | None = None
    with signals_raise():
        running = launch(StartOptions(config=config, bus=VIRTUAL, mode="joint"), log)
        try:
            directory = runtime_directory()
            found = read_processes(directory)
            pids = {"loop": found.loop, "gateway": found.gateway, "segment": found.segment}
            with Harness(directory, read_session(directory).config) as harness:
                soak = Soak(harness, pids, seed, log)
                try:
                    soak.run(minutes)
                except KeyboardInterrupt as interruption:
                    interrupted = interruption
        finally:
            problems = running.stop()
    summary = soak.summary
    summary.failures.extend(problems)
    if as_json:
        emit(json.dumps(dataclasses.asdict(summary), indent=2))
    else:
        show(_fault_table(summary))
        show(_process_table(summary))
        report("\n".join(summary.failures) or f"no failure{'' if interrupted is None else ' until the interruption'}")
    if interrupted is not None:
        raise CommandError("interrupted; the current trial was aborted", interruption_code(interrupted))
    if summary.failures:
        raise typer.Exit(ExitCode.FAULT)


def _fault_table(summary: Summary) -> Table:
    counts = ("injected", "noticed", "continued", "stopped", "recovered")
    rows = table(("fault", *counts), ("fault",), title=f"{summary.minutes:.1f} min, seed {summary.seed}")
    for kind, found in sorted(summary.counts.items()):
        rows.add_row(kind, *(str(getattr(found, count)) for count in counts))
    rows.add_section()
    found_all = summary.counts.values()
    rows.add_row("all", *(str(sum(getattr(found, count) for found in found_all)) for count in counts))
    return rows


def _process_table(summary: Summary) -> Table:
    rows = table(
        ("process", "RSS, MiB", "threads", "open files"),
        ("process",),
        title=f"{summary.records} cycles, {summary.torn} records torn or lost, "
        f"largest step of a target {summary.largest_step:.3f} of the limit",
    )
    for name, last in summary.last.items():
        first = summary.first.get(name, last)
        rows.add_row(
            name,
            f"{first.rss / 2**20:.1f} -> {last.rss / 2**20:.1f}",
            f"{first.threads} -> {last.threads}",
            f"{first.files} -> {last.files}",
        )
    return rows
