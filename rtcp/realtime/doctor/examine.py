"""Every question put to a host, in the order in which the answers read best."""

from __future__ import annotations

from rtcp.realtime.doctor import cpus, interrupts, kernel, machine, memory, network, rights, traffic
from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Finding, Severity
from rtcp.realtime.doctor.host import NotKnown

CHECKS: tuple[Check, ...] = (
    *kernel.CHECKS,
    *cpus.CHECKS,
    *interrupts.CHECKS,
    *network.CHECKS,
    *traffic.CHECKS,
    *rights.CHECKS,
    *memory.CHECKS,
    *machine.CHECKS,
)


def examine(case: Case) -> list[Finding]:
    """Return what each check that makes sense on this host found; what a host does not tell is a note."""
    return [finding for check in CHECKS if (finding := _asked(check, case)) is not None]


def _asked(check: Check, case: Case) -> Finding | None:
    try:
        verdict = check.look(case)
    except NotKnown as reason:
        return Finding(check.key, Severity.NOTE, f"not known: {reason}", check.why, ())
    if verdict is None:
        return None
    return Finding(check.key, verdict.severity, verdict.found, check.why, verdict.mend)
