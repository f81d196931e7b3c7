"""A segment as the master sees it: the `Bus` protocol and the SOEM bus behind it."""

from rtcp.fieldbus.alstatus import AlState
from rtcp.fieldbus.bus import Bus, BusError, ProcessData, SdoAborted, SlaveInfo, SlaveState

__all__ = ["AlState", "Bus", "BusError", "ProcessData", "SdoAborted", "SlaveInfo", "SlaveState"]
