"""Whether process data keep to SYNC0: the sync error counter (ETG.1020, 21.2) and the objects that show it."""

from __future__ import annotations

from rtcp.virtual.device import Device
from rtcp.virtual.esc import Esc
from rtcp.virtual.objects import Value

MISSED = 3
HIT = 1
"""A window without outputs adds MISSED to the error counter, one with outputs takes HIT away."""
DEFAULT_LIMIT = 4
LIMIT = (0x10F1, 2)
SYNC_TYPE, CYCLE_TIME, MISSED_COUNTER, SYNC_ERROR = 1, 2, 11, 32
TYPE_SM_EVENT, TYPE_SYNC0 = 1, 2
OUTPUT_PARAMETERS, INPUT_PARAMETERS = 0x1C32, 0x1C33


class SyncMonitor:
    """Counts the SYNC0 windows that bring no outputs."""

    def __init__(self, esc: Esc, device: Device) -> None:
        self._dc = esc.dc
        self._objects = device.objects
        self._came = 0
        self._counter = 0
        self._limit = DEFAULT_LIMIT
        self._missed = 0
        self.active = False
        """Whether the device is to work by SYNC0."""

    @property
    def running(self) -> bool:
        """Whether SYNC0 pulses have come and go on coming."""
        return self._dc is not None and self._dc.sync0.pulses > 0 and self._dc.sync0.due is not None

    def configure(self) -> None:
        """Decide by the DC activation register whether SYNC0 is used; show it in 0x1C32 and 0x1C33."""
        self.active = self._dc is not None and self._dc.cyclic
        cycle = self._dc.sync0.cycle if self._dc is not None and self.active else 0
        for index in (OUTPUT_PARAMETERS, INPUT_PARAMETERS):
            self._show(index, SYNC_TYPE, TYPE_SYNC0 if self.active else TYPE_SM_EVENT)
            self._show(index, CYCLE_TIME, cycle)

    def start(self) -> None:
        """The slave enters OP: count from zero, with the limit that 0x10F1:02 holds now (0: never an error)."""
        limit: Value = self._objects[LIMIT].value if LIMIT in self._objects else DEFAULT_LIMIT
        self._limit = limit if isinstance(limit, int) else DEFAULT_LIMIT
        self._counter = 0
        self._came = 1
        self._show(OUTPUT_PARAMETERS, SYNC_ERROR, 0)

    def stop(self) -> None:
        """The slave left SAFE-OP."""
        self.active = False

    def outputs_came(self) -> None:
        """A complete buffer of outputs arrived."""
        self._came += 1

    def pulse(self, on_time: bool) -> bool:
        """SYNC0 has come; return whether the error counter is above its limit.

        A pulse noticed late (the process was stopped) uses up one of the buffers that came meanwhile and is no miss.
        """
        if not on_time:
            self._came = max(0, self._came - 1)
            return False
        if self._came:
            self._came = 0
            self._counter = max(0, self._counter - HIT)
            return False
        self._counter += MISSED
        self._missed = (self._missed + 1) & 0xFFFF
        self._show(OUTPUT_PARAMETERS, MISSED_COUNTER, self._missed)
        exceeded = 0 < self._limit < self._counter
        if exceeded:
            self._show(OUTPUT_PARAMETERS, SYNC_ERROR, 1)
        return exceeded

    def _show(self, index: int, subindex: int, value: int) -> None:
        if (index, subindex) in self._objects:
            self._objects[index, subindex].value = value
