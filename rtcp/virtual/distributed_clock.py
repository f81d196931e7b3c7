"""Distributed clocks: local time, SYNC0 and their registers 0x0900 to 0x09FF (ETG.1000.4, 6.8)."""

from __future__ import annotations

from rtcp.virtual.protocol import Register

PROPORTIONAL = 40.0
"""Proportional gain of the phase, 1/s; with INTEGRAL a critically damped loop that settles within half a second."""
INTEGRAL = 400.0
LONGEST_STEP = 0.02
"""Upper bound on the time between two references in the loop, s: rarer references are followed more slowly."""
SLEW_LIMIT = 1e-3
"""Upper bound on a phase correction, as a share of the elapsed time: time never runs backwards."""
RATE_LIMIT = 500e-6
INTEGRATED_ERROR_LIMIT = 20_000.0
"""Phase error above which the rate is not adjusted, ns: it is an offset not set yet, not drift."""
HALF_RANGE = 1 << 31
RANGE_32 = 1 << 32


class Clock:
    """A free-running local clock with drift, steered by drift compensation at each reference.

    All instants `t` are at the slave's place on the wire, in ns of the host's monotonic clock. `offset` (0x0920)
    and `delay` (0x0928) are the registers' values in ns; system time is local time plus offset.
    """

    __slots__ = (
        "_fraction", "_last", "_local", "_natural", "_rate", "_t", "bits", "delay", "difference", "offset",
    )  # fmt: skip

    def __init__(self, drift_ppm: float, start: int, t: int, bits: int = 64) -> None:
        """The clock shows `start` ns at instant `t` and runs fast by `drift_ppm` ppm; its registers have `bits` bits.

        Times in here do not wrap; the registers show their low 32 or 64 bits (`shown`). 0: it only measures delays.
        """
        self.bits = bits
        self._natural = drift_ppm * 1e-6
        self._rate = self._natural
        self._t = t
        self._local = start
        self._fraction = 0.0
        self._last = t
        self.offset = 0
        self.delay = 0
        self.difference = 0
        """Last difference of the system time from the reference, ns (0x092C)."""

    def local(self, t: int) -> int:
        """Local time at `t`, in ns."""
        passed = t - self._t
        return self._local + passed + int(passed * self._rate + self._fraction)

    def system(self, t: int) -> int:
        """System time at `t`, in ns."""
        return self.local(t) + self.offset

    def shown(self, time: int) -> int:
        """Return a time as the registers show it."""
        return time & ((1 << self.bits) - 1)

    def next_match(self, shown: int, t: int) -> int:
        """Return the system time, not before that at `t`, that the registers show as `shown`.

        With 64 bits a time in the past stays there: it comes again only after centuries.
        """
        now = self.system(t)
        ahead = self.shown(shown - now)
        return now + (ahead - (1 << 64) if ahead >> 63 else ahead)

    def instant(self, system: int) -> int:
        """Return the instant at which the system time is `system`, at the present rate."""
        passed = system - self.offset - self._local
        return self._t + passed - int((passed * self._rate + self._fraction) / (1.0 + self._rate))

    def jump(self, ns: int) -> None:
        """Advance the clock by `ns`."""
        self._local += ns

    def change_drift(self, ppm: float, t: int) -> None:
        """Increase the drift by `ppm` at instant `t`."""
        passed = t - self._t
        moved = passed * self._rate + self._fraction
        self._t, self._local, self._fraction = t, self._local + passed + int(moved), moved - int(moved)
        self._natural += ppm * 1e-6
        self._rate += ppm * 1e-6

    def reset_control(self) -> None:
        """Reset drift compensation (by a write to 0x0930)."""
        self._rate = self._natural
        self.difference = 0

    def follow(self, t: int, reference: int) -> None:
        """Steer towards `reference`, the low 32 bits of the reference's system time at instant `t`."""
        passed = t - self._t
        moved = passed * self._rate + self._fraction
        whole = int(moved)
        local = self._local + passed + whole
        error = (local + self.offset - self.delay - reference + HALF_RANGE) % RANGE_32 - HALF_RANGE
        self.difference = error
        seconds = (t - self._last) * 1e-9
        self._last = t
        if seconds < 0.0:
            return
        seconds = min(seconds, LONGEST_STEP)
        limit = seconds * 1e9 * SLEW_LIMIT
        step = error * PROPORTIONAL * seconds
        if step > limit:
            step = limit
        elif step < -limit:
            step = -limit
        if -INTEGRATED_ERROR_LIMIT < error < INTEGRATED_ERROR_LIMIT:
            rate = self._rate - error * INTEGRAL * seconds * 1e-9
            if -RATE_LIMIT < rate - self._natural < RATE_LIMIT:
                self._rate = rate
        fraction = moved - whole - step
        whole = int(fraction)
        self._t = t
        self._local = local + whole
        self._fraction = fraction - whole


class SyncGenerator:
    """SYNC0: a pulse at the start time plus each multiple of the cycle, in system time (0x0981..0x09A3).

    The hardware compares for equality: if the system time has passed the next pulse, because the start time was in the
    past or the offset was rewritten while running, there are no further pulses. A clock of 32 bits shows each time
    again after 4.29 s: the pulses then begin that late.
    """

    __slots__ = ("_clock", "_suspended", "cycle", "due", "next", "pulses", "running")

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._suspended = False
        self.cycle = 0
        """Period, ns; 0: a single pulse."""
        self.next = 0
        """System time of the next pulse."""
        self.due: int | None = None
        """Instant of the next pulse; None: no pulse."""
        self.pulses = 0
        """Pulses since activation."""
        self.running = False
        """True: SYNC0 is activated."""

    @property
    def lost(self) -> bool:
        """Whether SYNC0 is activated but no pulse will follow."""
        return self.running and self.due is None

    def activate(self, start: int, cycle: int, t: int) -> None:
        """Start at system time `start` with period `cycle` ns."""
        self.running = True
        self.cycle = cycle
        self.next = start
        self.pulses = 0
        self.schedule(t)

    def deactivate(self) -> None:
        """Stop the pulses."""
        self.running = False
        self.due = None

    def schedule(self, t: int) -> None:
        """Compute the instant of the next pulse; it is lost if the system time has passed it."""
        if not self.running or self._suspended:
            return
        self.next = self._clock.next_match(self.next, t)
        due = self._clock.instant(self.next)
        self.due = due if due >= t else None

    def suspend(self) -> None:
        """Suppress all pulses until `resume`."""
        self._suspended = True
        self.due = None

    def resume(self, t: int) -> None:
        """Restart the pulses at `t` in their original grid."""
        self._suspended = False
        late = self._clock.system(t) - self.next
        if self.cycle and late >= 0:
            self.next += (late // self.cycle + 1) * self.cycle
        self.schedule(t)

    def fire(self) -> None:
        """Count the due pulse and compute the next one."""
        self.pulses += 1
        if not self.cycle:
            self.due = None
            return
        self.next += self.cycle
        self.due = self._clock.instant(self.next)

    def skip_to(self, t: int) -> None:
        """Skip the pulses before `t`; the grid stays."""
        if self.due is None or not self.cycle:
            return
        late = self._clock.system(t) - self.next
        if late > 0:
            count = late // self.cycle
            self.pulses += count
            self.next += count * self.cycle
            self.due = self._clock.instant(self.next)


CYCLIC = 0x01
SYNC0 = 0x02
SYNC1 = 0x04
NEGATIVE = 0x8000_0000


class DistributedClockUnit:
    """Clock, SYNC generator and their registers in `memory`."""

    def __init__(self, memory: bytearray, clock: Clock) -> None:
        self._memory = memory
        self.clock = clock
        self.sync0 = SyncGenerator(clock)
        self.returns: dict[int, int] = {}
        """Time from a frame's arrival at port 0 to its return at each other port that it used, ns."""

    @property
    def cyclic(self) -> bool:
        """Whether SYNC pulses are requested (0x0981 bit 0)."""
        return bool(self._memory[Register.DC_ACTIVATION] & CYCLIC)

    @property
    def sync0_active(self) -> bool:
        """Whether SYNC0 is activated (0x0981 bits 0 and 1)."""
        return self._memory[Register.DC_ACTIVATION] & (CYCLIC | SYNC0) == CYCLIC | SYNC0

    @property
    def sync0_cycle(self) -> int:
        """SYNC0 cycle time, ns (0x09A0)."""
        return self._get(Register.DC_SYNC0_CYCLE, 4)

    @property
    def sync1_pulses(self) -> int:
        """Number of SYNC0 pulses from one SYNC1 to the next (0x09A4); 1: each has one, or SYNC1 is off."""
        cycle = self.sync0_cycle
        active = self._memory[Register.DC_ACTIVATION] & SYNC1
        return 1 + self._get(Register.DC_SYNC1_CYCLE, 4) // cycle if active and cycle else 1

    def latch(self, t: int) -> None:
        """Latch the receive times of the ports and the processing unit, for a write to 0x0900 at `t`."""
        local = self.clock.local(t)
        self._put(Register.DC_RECEIVE_TIME, local, 4)
        for port in (1, 2, 3):
            returned = self.returns.get(port)
            self._put(Register.DC_RECEIVE_TIME + 4 * port, 0 if returned is None else local + returned, 4)
        self._put(Register.DC_RECEIVE_TIME_UNIT, self.clock.shown(local), 8)

    def before_read(self, t: int) -> None:
        """Update the time-dependent registers for a frame that arrives at `t`."""
        clock, sync0 = self.clock, self.sync0
        self._put(Register.DC_SYSTEM_TIME, clock.shown(clock.system(t)), 8)
        difference = clock.difference
        self._put(Register.DC_DIFFERENCE, abs(difference) | (NEGATIVE if difference < 0 else 0), 4)
        if sync0.running:
            self._put(Register.DC_START_TIME, clock.shown(sync0.next), 8)
            pending = 0x01 if sync0.due is not None and not sync0.pulses else 0x00
            self._memory[Register.DC_ACTIVATION_STATUS] = pending

    def wrote(self, first: int, end: int, t: int) -> None:
        """Handle the master's write to the registers `first` to `end` (excluded), at instant `t`."""

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
        wanted = self.sync0_active
        if wanted and not self.sync0.running:
            self.sync0.activate(self._get(Register.DC_START_TIME, 8), self.sync0_cycle, t)
        elif not wanted:
            self.sync0.deactivate()
            self._memory[Register.DC_ACTIVATION_STATUS] = 0

    def _get(self, register: int, size: int) -> int:
        return int.from_bytes(self._memory[register : register + size], "little")

    def _put(self, register: int, value: int, size: int) -> None:
        self._memory[register : register + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")
