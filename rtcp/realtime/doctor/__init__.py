"""What of a host stands in the way of real time: `examine(case)` gives a `Finding` for each question asked of it."""

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.examine import examine
from rtcp.realtime.doctor.finding import Finding, Severity
from rtcp.realtime.doctor.host import Host

__all__ = ["Case", "Finding", "Host", "Severity", "examine"]
