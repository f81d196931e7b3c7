"""How `rtcp doctor` shows its findings: all in a table, and below it what to do, in lines that can be copied."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from rtcp.cli.output import emit, show
from rtcp.config.virtual import VIRTUAL
from rtcp.realtime.doctor import Case, Finding, Severity

_STYLES = {Severity.OK: "green", Severity.NOTE: "", Severity.WARNING: "yellow", Severity.BAD: "bold red"}
_SENTENCES = {
    Severity.OK: "nothing stands in the way",
    Severity.NOTE: "nothing that was found stands in the way",
    Severity.WARNING: "cycles will be late at times",
    Severity.BAD: "the loop cannot keep its cycle here",
}


def show_findings(case: Case, findings: Sequence[Finding]) -> None:
    """Print the findings as they are ordered, the ways to mend them, and a line that sums them up."""
    show(_table(findings))
    to_mend = [finding for finding in findings if finding.remedy]
    if to_mend:
        emit("\nWhat mends it, as root:")
    for finding in to_mend:
        head = _severity(finding.severity)
        head.append(f"  {finding.key}: {finding.why}", "not bold default")
        emit("")
        show(head)
        for line in finding.remedy:
            emit(f"    {line}")  # never broken: a command is copied whole, however long
    emit("")
    show(_sum(case, findings))


def _table(findings: Sequence[Finding]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    table.add_column("", no_wrap=True)
    table.add_column("check", no_wrap=True)
    table.add_column("found", ratio=1)
    for finding in findings:
        table.add_row(_severity(finding.severity), finding.key, Text(finding.found))
    return table


def _sum(case: Case, findings: Sequence[Finding]) -> Text:
    worst = max(finding.severity for finding in findings)
    counts = {severity: sum(finding.severity is severity for finding in findings) for severity in Severity}
    told = ", ".join(
        f"{counts[severity]} {severity.name.lower()}" for severity in reversed(Severity) if counts[severity]
    )
    where = f"Cycle on CPU {case.cpu}, bus {case.interface or VIRTUAL}"
    return Text(f"{where}: {_SENTENCES[worst]} ({told}).", _STYLES[worst])


def _severity(severity: Severity) -> Text:
    return Text(severity.name.lower(), _STYLES[severity])
