"""`rtcp soak`: random faults for a long time, on a platform and its virtual segment or on a cluster of simulations."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.cli.arguments import AsJson, ConfigFile, option, positive
from rtcp.cli.output import (
    CommandError,
    ExitCode,
    complain,
    emit,
    emit_json,
    interruption_code,
    report,
    show,
    signals_raise,
    table,
    transfer,
)
from rtcp.cli.platform import launch, refuse_second_platform
from rtcp.config.model import VIRTUAL
from rtcp.ipc.states import State

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.config.cell import CellConfig
    from rtcp.config.model import ArmConfig
    from rtcp.config.segment import SegmentConfig
    from rtcp.telemetry.soak import Summary
    from rtcp.testing.sessions.cluster import SessionSummary
    from rtcp.testing.sessions.coverage import Coverage
    from rtcp.testing.sessions.run import Segment
    from rtcp.testing.sessions.session import Result

LONGEST_MIN = 10_080.0
LONGEST_SESSION_S = 3600.0
MOST_SESSIONS = 1_000_000_000
SHOWN_WORKERS = 10
COVERED_SESSIONS = 2000
"""Sessions from which on an empty row of the coverage table is an error."""
SHOWN_ROWS = 20
LARGEST_SEED = 2**63 - 1 - MOST_SESSIONS

commands = typer.Typer()


@commands.command("soak")
def _soak(
    minutes: Annotated[float | None, option("--minutes", "N", "Duration on a platform. Default: 60.")] = None,
    seed: Annotated[int, option("--seed", "N", "Seed of all random choices; of sessions that of the first.")] = 1,
    simulated: Annotated[
        bool, option("--simulated", "Run sessions in simulated time, on all CPUs or a cluster.")
    ] = False,
    sessions: Annotated[int | None, option("--sessions", "N", "Number of simulated sessions. Default: 1000.")] = None,
    seconds: Annotated[float | None, option("--seconds", "S", "Simulated time of a session, s. Default: 2.")] = None,
    scheduler: Annotated[
        str | None,
        option("--scheduler", "ADDRESS", "Dask scheduler, as tcp://HOST:8786. Default: this machine's CPUs."),
    ] = None,
    out: Annotated[
        Path | None,
        option("--out", "DIR", "Folder of the results, new or of the same sessions. Default: soak-SEED-SESSIONS."),
    ] = None,
    keep: Annotated[
        Path | None, option("--keep", "FILE", "Run one session here and write its black box (.mcap).")
    ] = None,
    coverage_from: Annotated[
        int | None,
        option(
            "--coverage-from", "N", "Sessions from which on an empty row of the coverage table fails. Default: 2000."
        ),
    ] = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Run the arm with random faults, on its virtual segment or in simulated sessions; show the result.

    Exit code 5 for any violation: a target outside its limits, an arm that does not recover, a torn record, a process
    that grows.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise CommandError(f"--seed {seed} is not allowed: 0 to {LARGEST_SEED}")
    only_simulated = {"--sessions": sessions, "--seconds": seconds, "--scheduler": scheduler, "--out": out,
                      "--keep": keep, "--coverage-from": coverage_from}  # fmt: skip
    if simulated:
        if minutes is not None:
            raise CommandError("--minutes has no meaning with --simulated: give --sessions and --seconds")
        covered = COVERED_SESSIONS if coverage_from is None else coverage_from
        _run_sessions(config, seed, sessions, seconds, scheduler, out, keep, covered, as_json)
        return
    for name, value in only_simulated.items():
        if value is not None:
            raise CommandError(f"{name} needs --simulated")
    _run_platform(60.0 if minutes is None else minutes, seed, config, as_json)


def _run_platform(minutes: float, seed: int, config: Path | None, as_json: bool) -> None:
    positive("--minutes", minutes, "min", LONGEST_MIN)
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
            processes = read_processes(directory)
            pids = {"loop": processes.loop, "gateway": processes.gateway, "segment": processes.segment}
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
    for kind, results in sorted(summary.counts.items()):
        rows.add_row(kind, *(str(getattr(results, count)) for count in counts))
    rows.add_section()
    found_all = summary.counts.values()
    rows.add_row("all", *(str(sum(getattr(results, count) for results in found_all)) for count in counts))
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


# -- sessions in simulated time -------------------------------------------------------------------------------------


def _run_sessions(
    config: Path | None,
    seed: int,
    sessions: int | None,
    seconds: float | None,
    scheduler: str | None,
    out: Path | None,
    keep: Path | None,
    covered: int,
    as_json: bool,
) -> None:
    count = sessions if sessions is not None else 1 if keep is not None else 1000
    if not 1 <= count <= MOST_SESSIONS:
        raise CommandError(f"--sessions {count} is not allowed: 1 to {MOST_SESSIONS}")
    if covered < 1:
        raise CommandError(f"--coverage-from {covered} is not allowed: at least 1")
    positive("--seconds", seconds, "s", LONGEST_SESSION_S)
    arm, segment = _simulated(config)
    duration = 2.0 if seconds is None else seconds
    if keep is not None:
        if count != 1 or scheduler is not None or out is not None:
            raise CommandError("--keep runs one session in this process: leave out --scheduler, --out, and --sessions")
        _replay(arm, segment, seed, duration, keep, as_json)
        return
    try:
        from rtcp.testing.sessions.cluster import Parts, SessionPlan, SessionRun, SoakError, cluster
    except ImportError as error:
        raise CommandError(f"--simulated needs a package ({error}): pip install 'rtcp[cluster]'") from error
    plan = SessionPlan(arm, segment, seed, count, duration)
    folder = Path(f"soak-{seed}-{count}") if out is None else out
    ended: CommandError | None = None
    try:
        with signals_raise(), cluster(scheduler) as client, transfer("sessions", count, quiet=as_json) as shown:
            parts = Parts(folder, plan)
            run = SessionRun(client, plan, parts, lambda summary: shown(summary.sessions))
            try:
                run.run()
            except KeyboardInterrupt as interruption:
                code = interruption_code(interruption)
                ended = CommandError(f"interrupted after {run.summary.sessions} sessions", code)
            except SoakError as error:
                ended = CommandError(f"{error}; {run.summary.sessions} sessions are known", ExitCode.FAULT)
    except SoakError as error:
        raise CommandError(str(error)) from error
    rows = _coverage_rows(arm, segment)
    try:
        table_file = parts.write_coverage(run.summary.coverage, rows)
    except SoakError as error:
        raise CommandError(str(error), ExitCode.FAULT) from error
    _show_sessions(run.summary, rows, folder, config, as_json)
    if ended is not None:
        raise ended
    _keep_failures(arm, segment, run.summary, folder)
    if run.summary.failed:
        raise typer.Exit(ExitCode.FAULT)
    if not run.summary.largest_speed:
        message = "no session moved the arm: `rtcp soak --simulated --keep FILE` and `rtcp faults show FILE` show why"
        raise CommandError(message, ExitCode.FAULT)
    empty = run.summary.coverage.empty(rows)
    if empty and run.summary.sessions >= covered:
        shown_rows = "; ".join(empty[:SHOWN_ROWS]) + ("; ..." if len(empty) > SHOWN_ROWS else "")
        message = (
            f"{len(empty)} rows of the coverage table are empty after {run.summary.sessions} sessions ({table_file}): "
        )
        raise CommandError(message + shown_rows, ExitCode.FAULT)


def _simulated(config: Path | None) -> tuple[ArmConfig | CellConfig, Segment]:
    """Load the arm, or the cell, and its segments; raises CommandError where their frames cannot be read."""
    from rtcp.config.cell_file import is_cell_file, load_cell
    from rtcp.config.find import find_config
    from rtcp.config.loader import load

    path = find_config(config)
    if not is_cell_file(path):
        arm = load(path)
        return arm, _segment_of(arm)
    cell = load_cell(path)
    return cell, {member.name: _segment_of(member.config) for member in cell.arms}


def _segment_of(arm: ArmConfig) -> SegmentConfig:
    from rtcp.config.segment import load_segment
    from rtcp.fieldbus.errors import BusError
    from rtcp.testing import Simulation
    from rtcp.testing.sessions.checker import reading_of

    try:
        reading_of(arm)
    except ValueError as error:
        raise CommandError(f"--simulated is for arms of CiA 402 drives: {error}") from error
    segment = load_segment(arm.source.parent / arm.bus.segment)
    try:
        Simulation(arm, segment=segment).close()
    except BusError as error:
        raise CommandError(str(error)) from error
    return segment


def _coverage_rows(arm: ArmConfig | CellConfig, segment: Segment) -> Coverage:
    """Return the rows that the sessions have to fill: none in a cell, whose sessions are about its arms together."""
    from rtcp.config.model import ArmConfig
    from rtcp.config.segment import SegmentConfig
    from rtcp.testing import Simulation
    from rtcp.testing.sessions.coverage import Coverage, rows_of

    if not (isinstance(arm, ArmConfig) and isinstance(segment, SegmentConfig)):
        return Coverage()
    with contextlib.closing(Simulation(arm, segment=segment)) as simulation:
        return rows_of(simulation)


def _replay(
    arm: ArmConfig | CellConfig, segment: Segment, seed: int, seconds: float, file: Path, as_json: bool
) -> None:
    from rtcp.ipc.recording import RecordingError
    from rtcp.testing.sessions.black_box import replay

    try:
        result, done = replay(seed, arm, seconds, file, segment)
    except RecordingError as error:
        raise CommandError(f"--keep {error}") from error
    if as_json:
        emit_json({**dataclasses.asdict(result), "file": str(file), "done": done})
    else:
        report("\n".join(done))
        report(f"seed {seed}: {_outcome(result)}\nblack box: {file} (`rtcp faults show {shlex.quote(str(file))}`)")
    if result.outcome != "passed":
        raise typer.Exit(ExitCode.FAULT)


def _keep_failures(arm: ArmConfig | CellConfig, segment: Segment, summary: SessionSummary, folder: Path) -> None:
    """Run the first failed sessions again in this process and write their black boxes."""
    from rtcp.ipc.recording import RecordingError
    from rtcp.testing.sessions.black_box import replay

    for result in summary.failures:
        if result.outcome == "worker_died":
            continue  # it would end this process, or hang
        try:
            again, _ = replay(result.seed, arm, summary.seconds, _black_box(folder, result), segment)
        except RecordingError as error:
            complain(str(error))
            continue
        if (again.outcome, again.violation) != (result.outcome, result.violation):
            complain(f"seed {result.seed}: repeated on this machine: {_outcome(again)}")


def _black_box(folder: Path, result: Result) -> Path:
    return folder / f"seed-{result.seed}.mcap"


def _outcome(result: Result) -> str:
    return f"{result.outcome.replace('_', ' ')} {result.violation}".rstrip()


def _show_coverage(coverage: Coverage, rows: Coverage) -> None:
    """Show how often each command was sent in each state, and each event and refusal; the modes are summed."""
    from rtcp.testing.sessions.coverage import by_state

    counts = by_state(coverage)
    states = [state for state in State if any(state in row for row in counts.values())]
    shown = table(("command", *(state.words for state in states)), ("command",), title="commands sent, by state")
    for command, row in counts.items():
        shown.add_row(command, *(str(row.get(state, 0)) for state in states))
    show(shown)
    for title, found, wanted in (
        ("events", coverage.events, rows.events), ("refusals", coverage.refusals, rows.refusals)
    ):  # fmt: skip
        names = sorted({*found, *wanted})
        report(f"\n{title}: " + ", ".join(f"{name.replace('_', ' ')} {found[name]}" for name in names))


def _show_sessions(
    summary: SessionSummary, rows_wanted: Coverage, folder: Path, config: Path | None, as_json: bool
) -> None:
    option = "" if config is None else f" --config {shlex.quote(str(config))}"
    repeat = f"rtcp soak --simulated{option} --seconds {summary.seconds:g}"
    failures = [
        {
            **{name: value for name, value in dataclasses.asdict(result).items() if name != "coverage"},
            "black_box": "" if result.outcome == "worker_died" else str(_black_box(folder, result)),
            "replay": f"{repeat} --seed {result.seed} --keep seed-{result.seed}.mcap",
        }
        for result in summary.failures
    ]
    if as_json:
        shown = dataclasses.asdict(summary)
        counts = {**summary.coverage.as_dict(), "empty": summary.coverage.empty(rows_wanted)}
        emit_json(
            {
                **shown, "sessions": summary.sessions, "results": str(folder), "coverage": counts, "failures": failures
            }
        )  # fmt: skip
        return
    _show_coverage(summary.coverage, rows_wanted)
    rows = table(("outcome", "sessions"), ("outcome",))
    for outcome, count in sorted(summary.outcomes.items()):
        rows.add_row(outcome.replace("_", " "), str(count))
    show(rows)
    report(
        f"\nsessions: {summary.sessions}, from seed {summary.seed} on, of {summary.seconds:g} s and a little more\n"
        f"simulated: {summary.simulated_s:.0f} s, {summary.cycles} cycles in {summary.wall_s:.0f} s; CPU time of a "
        f"session: {summary.cpu_s / max(summary.sessions, 1):.2f} s\n"
        f"largest step: {summary.largest_step:.3f} of the speed limit's; acceleration: "
        f"{summary.largest_acceleration:.3f} of its limit; speed: {summary.largest_speed:.3f} rad/s\n"
        f"configuration {summary.digest}; results: {folder}"
    )
    for worker, memory in sorted(summary.workers.items())[:SHOWN_WORKERS]:
        report(
            f"worker {worker}: {memory.sessions} sessions, {memory.first / 2**20:.1f} -> {memory.last / 2**20:.1f} MiB"
        )
    for result, failure in zip(summary.failures, failures, strict=False):
        report(f"seed {result.seed}: {_outcome(result)}")
        if failure["black_box"]:
            report(f"  black box: rtcp faults show {shlex.quote(str(failure['black_box']))}")
        report(f"  replay: {failure['replay']}")
