"""The distributed clock unit of a slave controller: registers 0x0900 to 0x09FF (ETG.1000.4, 6.6)."""

from __future__ import annotations

from rtcp.virtual.clock import Clock, SyncGenerator
from rtcp.virtual.registers import Register

CYCLIC = 0x01
SYNC0 = 0x02
SYNC1 = 0x04
TIME_64 = (1 << 64) - 1
NEGATIVE = 0x8000_0000


class DistributedClockUnit:
    """Clock, SYNC generator and their registers in `memory`.

    `turnaround` is the time in ns from a frame's arrival at port 0 to its return at port 1; None for the last slave.
    """

    def __init__(self, memory: bytearray, clock: Clock, turnaround: int | None) -> None:
        self._memory = memory
        self.clock = clock
        self.sync0 = SyncGenerator(clock)
        self.turnaround = turnaround

    @property
    def cyclic(self) -> bool:
        """Whether SYNC pulses are asked for at all (0x0981 bit 0)."""
        return bool(self._memory[Register.DC_ACTIVATION] & CYCLIC)

    @property
    def activation(self) -> int:
        """The activation register 0x0981."""
        return self._memory[Register.DC_ACTIVATION]

    @property
    def sync0_cycle(self) -> int:
        """SYNC0 cycle time in ns (0x09A0)."""
        return self._get(Register.DC_SYNC0_CYCLE, 4)

    def latch(self, t: int) -> None:
        """A write to 0x0900 passed at `t`: latch the receive times of the ports and of the processing unit."""
        local = self.clock.local(t)
        self._put(Register.DC_RECEIVE_TIME, local, 4)
        returned = 0 if self.turnaround is None else local + self.turnaround
        self._put(Register.DC_RECEIVE_TIME + 4, returned, 4)
        self._put(Register.DC_RECEIVE_TIME_UNIT, local, 8)

    def before_read(self, t: int) -> None:
        """Bring the registers that follow the time up to date for a frame that arrives at `t`."""
        clock, sync0 = self.clock, self.sync0
        self._put(Register.DC_SYSTEM_TIME, clock.system(t), 8)
        difference = clock.difference
        self._put(Register.DC_DIFFERENCE, abs(difference) | (NEGATIVE if difference < 0 else 0), 4)
        if sync0.running:
            self._put(Register.DC_START_TIME, sync0.next, 8)
            pending = 0x01 if sync0.due is not None and not sync0.pulses else 0x00
            self._memory[Register.DC_ACTIVATION_STATUS] = pending

    def wrote(self, first: int, end: int, t: int) -> None:
        """The master wrote registers from `first` up to `end` with a frame that arrived at `t`."""

        def touched(register: int, size: int) -> bool:
            return first < register + size and end > register

        clock = self.clock
        if touched(Register.DC_RECEIVE_TIME, 4):
            self.latch(t)
        if touched(Register.DC_SYSTEM_TIME, 4):
            clock.follow(t, self._get(Register.DC_SYSTEM_TIME, 4))
        if touched(Register.DC_OFFSET, 8):
            clock.offset = self._get(Register.DC_OFFSET, 8)
            if clock.offset >> 63:
                clock.offset -= 1 << 64
            self.sync0.schedule(t)
        if touched(Register.DC_DELAY, 4):
            clock.delay = self._get(Register.DC_DELAY, 4)
        if touched(Register.DC_SPEED_START, 2):
            clock.reset_control()
        if touched(Register.DC_ACTIVATION, 1):
            self._activate(t)

    def _activate(self, t: int) -> None:
        wanted = self.activation & (CYCLIC | SYNC0) == CYCLIC | SYNC0
        if wanted and not self.sync0.running:
            self.sync0.activate(self._get(Register.DC_START_TIME, 8), self.sync0_cycle, t)
        elif not wanted:
            self.sync0.deactivate()
            self._memory[Register.DC_ACTIVATION_STATUS] = 0

    def _get(self, register: int, size: int) -> int:
        return int.from_bytes(self._memory[register : register + size], "little")

    def _put(self, register: int, value: int, size: int) -> None:
        self._memory[register : register + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")
