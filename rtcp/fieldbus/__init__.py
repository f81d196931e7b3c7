"""A segment as the master sees it: the `Bus` protocol and the SOEM bus behind it."""

from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import Bus, ProcessData, SlaveInfo, SlaveState
from rtcp.fieldbus.errors import BusError, SdoAborted

__all__ = ["AlState", "Bus", "BusError", "ProcessData", "SdoAborted", "SlaveInfo", "SlaveState"]
