"""`rtcp doctor`: what of this host stands in the way of real time, and what mends it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.options import ConfigFile
from rtcp.cli.output import emit_json
from rtcp.config.virtual import VIRTUAL
from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
from rtcp.realtime.doctor import Case, Finding, Severity, examine
from rtcp.realtime.host import Host
from rtcp.realtime.scheduling import choose_cpu

CODES = {
    Severity.OK: ExitCode.DONE,
    Severity.NOTE: ExitCode.DONE,
    Severity.WARNING: ExitCode.REFUSED,
    Severity.BAD: ExitCode.FAULT,
}
"""The exit code of the worst finding: what is merely in the way is told from what keeps the loop from its cycle."""

Bus = Annotated[
    str | None,
    typer.Option("--bus", metavar="virtual|NAME", help="virtual, or a network interface; else the configuration's."),
]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("doctor")(_doctor)


def _doctor(
    bus: Bus = None,
    config: ConfigFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, the worst finding first.")] = False,
) -> None:
    """Show what of this host stands in the way of real time, why, and what mends it; changes nothing.

    Exit codes: 0 nothing stands in the way, 3 cycles will be late at times, 5 the loop cannot keep its cycle.
    """
    case = _case(bus, config)
    findings = sorted(examine(case), key=lambda finding: -finding.severity)  # stable: the order of the checks stays
    worst = max(finding.severity for finding in findings)
    if as_json:
        emit_json(_as_json(case, worst, findings))
    else:
        from rtcp.cli.doctor_view import show_findings

        show_findings(case, findings)
    raise typer.Exit(CODES[worst])


def _checked(name: str) -> str:
    """Return what may be an interface's name: the kernel's rule, `dev_valid_name` of net/core/dev.c."""
    if not re.fullmatch(r"[^\s/:]{1,15}", name) or name in (".", ".."):
        raise CommandError(f"{name!r} is no name of a network interface: 1 to 15 letters without / : and white space")
    return name


def _case(bus: str | None, config: Path | None) -> Case:
    from rtcp.config import find_config, load  # here: the validator starts slowly, and `rtcp status` must not wait

    arm = load(find_config(config))
    name = arm.bus.interface if bus is None else bus
    return Case(
        host=Host(),
        cpu=choose_cpu(arm.cycle.cpu),
        priority=arm.cycle.priority,
        interface=None if name == VIRTUAL else _checked(name),
        wait_us=arm.bus.receive_fraction * arm.cycle.period_us,
        blackboard=blackboard_file(runtime_directory()),
    )


def _as_json(case: Case, worst: Severity, findings: list[Finding]) -> dict[str, Any]:
    return {
        "severity": worst.name.lower(),
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
