"""`rtcp segment`: run software slaves for any EtherCAT master, and make faults on those that run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import refuse_old_name
from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.options import Poll
from rtcp.cli.output import emit, emit_json, report
from rtcp.ipc.runtime_directory import is_listening, runtime_directory, segment_control

if TYPE_CHECKING:
    from rtcp.virtual.faults.client import SegmentClient

ControlPath = Annotated[
    Path | None,
    typer.Option(
        "--segment", metavar="PATH", help="Control socket of the segment; else the one in the runtime directory."
    ),
]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    segment = typer.Typer(invoke_without_command=True)
    segment.callback()(_segment)
    segment.command("fault")(_fault)
    segment.command("clear")(_clear)
    refuse_old_name(segment, "mend", "rtcp segment clear")
    segment.command("faults")(_faults)
    segment.command("kinds")(_kinds)
    app.add_typer(segment, name="segment")


def _segment(
    context: typer.Context,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="The slaves in the order of the cable.")
    ] = None,
    interface: Annotated[
        str | None,
        typer.Option(
            "--interface", metavar="NAME", help="Leave the master's end here under this name; else in a namespace."
        ),
    ] = None,
    poll: Poll = False,
    cpu: Annotated[int | None, typer.Option("--cpu", metavar="N", help="CPU of the segment.")] = None,
    script: Annotated[
        Path | None, typer.Option("--faults", metavar="SCRIPT", help="Faults with their times, s from the start.")
    ] = None,
) -> None:
    """Run a segment of software slaves for any EtherCAT master, until stopped; or make faults on one that runs."""
    given = {"--config": config, "--interface": interface, "--poll": poll or None, "--cpu": cpu, "--faults": script}
    if context.invoked_subcommand is not None:
        if wrong := [option for option, value in given.items() if value is not None]:
            raise CommandError(f"{wrong[0]} is an option of a segment that starts, not of {context.invoked_subcommand}")
        return
    if config is None:
        raise CommandError("--config FILE is missing: the slaves in the order of the cable (or: fault, clear, faults)")
    from rtcp.cli.segment_run import run_segment

    run_segment(config, interface, poll, cpu, script)


def _fault(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Kind of the fault: `rtcp segment kinds` lists them.")],
    pairs: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE..", help="As after=3, code=0x1A.")] = None,
    lasts: Annotated[
        float | None, typer.Option("--lasts", metavar="S", help="How long, s; else until it is cleared.")
    ] = None,
    segment: ControlPath = None,
) -> None:
    """Make a fault on the segment that runs."""
    from rtcp.cli.segment_view import named
    from rtcp.config.faults import ONCE, parse, sentence_of

    mapping = _mapping(name, pairs or [], lasts)
    planned, findings = parse(mapping)
    if planned is None:
        raise CommandError("\n".join(map(sentence_of, findings)))
    if planned.at:
        raise CommandError("at: a fault that is asked for begins at once; only a script has times")
    with _client(segment) as client:
        number = client.fault(planned.as_mapping())
        active = any(each["id"] == number for each in client.faults())
    said = f"fault {number}: {named(planned.as_mapping())}"
    if isinstance(planned.fault, ONCE) or not active:
        report(f"{said}: it has happened")
        return
    until = "until it is cleared" if planned.lasts is None else f"for {planned.lasts:g} s"
    if getattr(planned.fault, "burst", None) is not None:
        until = "until its burst has passed"
    where = "" if segment is None else f" --segment {segment}"
    report(f"{said}, {until}; to clear it: rtcp segment clear {number}{where}")


def _clear(
    number: Annotated[int | None, typer.Argument(metavar="ID", help="The fault's number; else all faults.")] = None,
    segment: ControlPath = None,
) -> None:
    """Clear a fault, or all of them."""
    with _client(segment) as client:
        cleared = client.clear(number)
    report(f"cleared: {', '.join(f'fault {each}' for each in cleared)}" if cleared else "no fault is active")


def _faults(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON array.")] = False, segment: ControlPath = None
) -> None:
    """Show the faults that are active, since when, and what they have done to frames."""
    with _client(segment) as client:
        active = client.faults()
    if as_json:
        emit_json(active)
        return
    from rtcp.cli.segment_view import line_of

    emit("\n".join(map(line_of, active)) or "no fault is active")


def _kinds() -> None:
    """List the kinds of faults, their keys and what is allowed for them."""
    from rtcp.cli.segment_view import kinds

    for kind in kinds():
        emit(f"{kind.name}: {kind.says}")
        for key, allowed in kind.keys.items():
            emit(f"    {key:9} {allowed}")
    emit("Each but those that happen once takes --lasts S. In a script: a list `faults:` with fault, at, lasts, keys.")


def _mapping(name: str, pairs: Sequence[str], lasts: float | None) -> dict[str, Any]:
    """Return the mapping that a command line names."""
    mapping: dict[str, Any] = {"fault": name}
    for pair in pairs:
        key, separator, value = pair.partition("=")
        if not separator or not key or not value:
            raise CommandError(f"{pair!r} is no KEY=VALUE, as after=3 or code=0x1A")
        if key in mapping:
            raise CommandError(f"{key} stands twice")
        mapping[key] = _value(value)
    if lasts is not None:
        if "lasts" in mapping:
            raise CommandError("lasts stands twice")
        mapping["lasts"] = lasts
    return mapping


def _value(written: str) -> int | float | str:
    """Return a number, decimal or as 0x1A, or the text itself."""
    if "_" in written or not written.isascii():
        return written
    for read in (int, lambda text: int(text, 16) if text[:2].lower() == "0x" else float(text)):
        try:
            return read(written)
        except ValueError:
            continue
    return written


@contextmanager
def _client(path: Path | None) -> Iterator[SegmentClient]:
    """Speak to the segment at `path`, or to the one that runs.

    Raises:
        CommandError: there is none, or several, or it refuses.
    """
    from rtcp.virtual.faults.client import SegmentAway, SegmentClient, SegmentRefused

    try:
        with SegmentClient(path or _running()) as client:
            yield client
    except SegmentAway as error:
        raise CommandError(str(error), ExitCode.NOT_RUNNING) from error
    except SegmentRefused as error:
        raise CommandError(str(error), ExitCode.REFUSED) from error


def _running() -> Path:
    directory = runtime_directory()
    usual = segment_control(directory)
    found = [path for path in (usual, *sorted(directory.glob("segment-*.sock"))) if is_listening(path)]
    if not found:
        raise CommandError(f"no virtual segment is running: nothing listens at {usual}", ExitCode.NOT_RUNNING)
    if len(found) > 1:
        raise CommandError(f"several segments are running: choose by --segment {' or '.join(map(str, found))}")
    return found[0]
