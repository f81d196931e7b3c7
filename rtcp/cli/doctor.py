"""`rtcp doctor`: what on this host prevents real time, and how to fix it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.cli.arguments import AsJson, ConfigFile, option
from rtcp.cli.drive_settings import exit_code, settings_of_drives, show_drives
from rtcp.cli.output import CommandError, ExitCode, emit, emit_json, show, table
from rtcp.config.model import VIRTUAL
from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
from rtcp.realtime.doctor import Case, Finding, Severity, examine
from rtcp.realtime.host import Host
from rtcp.realtime.scheduling import choose_cpu

RESULTS = {
    Severity.OK: (ExitCode.DONE, "green", "no obstacle to real time was found"),
    Severity.NOTE: (ExitCode.DONE, "", "no obstacle to real time was found"),
    Severity.WARNING: (ExitCode.REFUSED, "yellow", "cycles will be late at times"),
    Severity.BAD: (ExitCode.FAULT, "bold red", "the loop cannot keep its cycle here"),
}
"""Worst finding -> exit code, style and summary."""

Bus = Annotated[
    str | None,
    option("--bus", "virtual|NAME", "virtual, or a network interface. Default: the configured one."),
]

Drives = Annotated[bool, option("--drives", "Also read and check the settings of the drives.")]

commands = typer.Typer()


@commands.command("doctor")
def _doctor(bus: Bus = None, config: ConfigFile = None, drives: Drives = False, as_json: AsJson = False) -> None:
    """Show what on this host prevents real time, why, and how to fix it; changes nothing.

    With --drives the limits and the reactions to stops that the drives hold themselves follow, as they are after the
    start, compared with what the joints need. The slaves are then brought to PRE-OP if no platform runs.

    Exit codes: 0 no obstacle, 3 cycles will be late at times, or a drive differs, 5 the loop cannot keep its cycle, or
    a drive is refused at the start.
    """
    case = _case(bus, config)
    findings = sorted(examine(case), key=lambda finding: -finding.severity)  # stable: keeps the order of the checks
    found = settings_of_drives(bus, config) if drives else []
    if as_json:
        emit_json(_as_json(case, findings) | ({"drives": [drive.as_json() for drive in found]} if drives else {}))
    else:
        _show(case, findings)
        if drives:
            emit("")
            show_drives(found)
    raise typer.Exit(max(RESULTS[findings[0].severity][0], exit_code(found)))


def _case(bus: str | None, config: Path | None) -> Case:
    from rtcp.config import find_config, load  # the validator loads slowly

    arm = load(find_config(config))
    name = arm.bus.interface if bus is None else bus
    # dev_valid_name of the kernel's net/core/dev.c
    if name != VIRTUAL and (not re.fullmatch(r"[^\s/:]{1,15}", name) or name in (".", "..")):
        raise CommandError(
            f"{name!r} is not the name of a network interface: 1 to 15 characters other than /, : and blanks"
        )
    return Case(
        host=Host(),
        cpu=choose_cpu(arm.cycle.cpu),
        priority=arm.cycle.priority,
        interface=None if name == VIRTUAL else name,
        blackboard=blackboard_file(runtime_directory()),
        wait_us=arm.ethercat.receive_fraction * arm.cycle.period_us,
    )


def _as_json(case: Case, findings: Sequence[Finding]) -> dict[str, Any]:
    return {
        "severity": findings[0].severity.name.lower(),
        "cpu": case.cpu,
        "bus": case.interface or VIRTUAL,
        "findings": [
            {
                "key": finding.key,
                "severity": finding.severity.name.lower(),
                "found": finding.found,
                "why": finding.why,
                "remedy": list(finding.remedy),
            }
            for finding in findings
        ],
    }


def _show(case: Case, findings: Sequence[Finding]) -> None:
    """Print the findings as a table, then the commands that fix them, then a summary."""
    from rich.text import Text

    rows = table(("", "check", "found"), ("", "check"), expand=True, fill="found")
    for finding in findings:
        rows.add_row(_severity(finding), finding.key, Text(finding.found))
    show(rows)
    fixable = [finding for finding in findings if finding.remedy]
    if fixable:
        emit("\nTo fix, as root:")
    for finding in fixable:
        emit("")
        show(_severity(finding).append(f"  {finding.key}: {finding.why}", "not bold default"))
        for line in finding.remedy:
            emit(f"    {line}")  # on one line however long, so that it can be copied
    emit("")
    counts = {severity: sum(finding.severity is severity for finding in findings) for severity in reversed(Severity)}
    counted = ", ".join(f"{count} {severity.name.lower()}" for severity, count in counts.items() if count)
    _, style, summary = RESULTS[findings[0].severity]
    show(Text(f"Cycle on CPU {case.cpu}, bus {case.interface or VIRTUAL}: {summary} ({counted}).", style))


def _severity(finding: Finding) -> Any:
    from rich.text import Text

    return Text(finding.severity.name.lower(), RESULTS[finding.severity][1])
