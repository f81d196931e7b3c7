"""The master follows the reference clock of the segment: when to wake up.

The reference slave's clock runs free. Each frame returns its system time at the instant the frame passed it; together
with the master's time just before sending this gives the difference of the two clocks, apart from the kernel's delay.
A second-order filter tracks that difference (phase and rate), and the next wake-up is computed straight from the
reference time: wake-up jitter never enters the clocks, and there is no gain to tune against it. Residuals are bounded:
one late frame moves the estimate by little. A frame that is later than any clock drifts (its sender or its receiver
was kept off the CPU) is ignored, until late frames outnumber timely ones so far that the clock itself has moved. A
reference whose time stands although frames return is not tracked until it moves again. The time of a clock of 32 bits
is extended first (`SystemTime`).

Three phases: *measure* (the clocks are compared for `MEASURE_CYCLES`, nothing is moved), *align* (one jump of the
grid to the configured phase between two SYNC0, before any drive is in OP), *track*.
"""

from __future__ import annotations

from typing import Final

from mypy_extensions import mypyc_attr

from rtcp.fieldbus.system_time import SystemTime

MEASURE_CYCLES: Final = 100
LOCK_CYCLES: Final = 200
LOCK_WITHIN_NS: Final = 10_000.0
UNLOCK_BEYOND_NS: Final = 50_000.0
_RESIDUAL_BOUND_NS: Final = 20_000.0
_PHASE_GAIN: Final = 0.02
# Critically damped for that phase gain.
_RATE_GAIN = _PHASE_GAIN * _PHASE_GAIN / 4
_SHOWN_GAIN: Final = 1 / 32
_LATE_BEYOND_NS: Final = 50_000.0
UNHEARD_CYCLES: Final = 200
"""Frames in a row with the same reference time that the holdover bridges at the last rate; then the lock is lost."""
_LATE_MORE: Final = 150
"""Excess of late frames over timely ones that shows a moved clock. A host that takes the CPU away in bursts
of tens of frames, fewer than half of all, does not reach it; it reaches 40."""
_LATE_MOST: Final = 200
"""Limit of that count: where most frames are late every late one is used, not one ignored for each timely one."""
_RATE_BOUND: Final = 500e-6
"""Largest difference of two oscillators' rates; keeps a jump of the reference from winding up the rate."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Discipline:
    """Computes wake-up instants (CLOCK_MONOTONIC, ns) that keep the send instant at a phase of the DC cycle.

    Args:
        period_ns: the cycle.
        phase_ns: wanted reference time of the frame, modulo the cycle: SYNC0 shift + send phase * period.
        system_time: time of the segment, which this keeps up to date; None: it begins with the first frame.
    """

    __slots__ = (
        "_base", "_difference", "_good_cycles", "_late", "_measured", "_period", "_phase", "_rate", "_reference",
        "_seen", "_standing", "aligned", "filtered_ns", "locked", "raw_ns", "system_time",
    )  # fmt: skip

    def __init__(self, period_ns: int, phase_ns: int, system_time: SystemTime | None = None) -> None:
        self.system_time = SystemTime() if system_time is None else system_time
        self._period = period_ns
        self._phase = phase_ns % period_ns
        # Reference less master: an integer part, too large for a float's 53 bits, and a small float part.
        self._base = 0
        self._difference = 0.0
        self._rate = 0.0
        self._reference = -1
        self._measured = [0] * MEASURE_CYCLES
        self._seen = 0
        self._good_cycles = 0
        self._late = 0
        self._standing = 0
        self.aligned = False
        self.locked = False
        self.raw_ns = 0
        """Reference time of the last frame minus the nearest wanted instant, ns: includes the wake-up's jitter."""
        self.filtered_ns = 0.0
        """The same without the wake-up's latency, low-pass filtered over 32 cycles, without single frames that were
        more than 50 us late: how well the clock is followed."""

    def observe(self, sent_ns: int, reference_ns: int) -> None:
        """Update from one frame: the master's time just before sending and the reference time when it passed, ns.

        The reference time has all bits or the low 32.
        """
        if reference_ns == self._reference:
            # The reference slave did not answer: the field returned as it was sent.
            self.holdover()
            self._standing += 1
            if self._standing == UNHEARD_CYCLES:
                self.locked = False
                self._good_cycles = 0
            return
        self._standing = 0
        self._reference = reference_ns
        system_time = self.system_time
        if system_time.offset_ns is None:
            system_time.offset_ns = reference_ns - sent_ns
        reference_ns = system_time.extended(reference_ns, sent_ns)
        period = self._period
        offset = (reference_ns - self._phase) % period
        self.raw_ns = offset - period if 2 * offset > period else offset
        if not self.aligned:
            self._measure(reference_ns - sent_ns)
            return
        self._difference += self._rate
        residual = reference_ns - sent_ns - self._base - self._difference
        if abs(residual) > period:
            # The reference was set: only its phase within the period matters, whole periods are taken over at once.
            shift = round(residual / period) * period
            self._base += shift
            residual -= shift
        if abs(residual) <= _LATE_BEYOND_NS:
            system_time.offset_ns = self._base + int(self._difference)
            if self._late:
                self._late -= 1
        else:
            if self._late < _LATE_MOST:
                self._late += 1
            if self._late <= _LATE_MORE:
                return
        bounded = min(max(residual, -_RESIDUAL_BOUND_NS), _RESIDUAL_BOUND_NS)
        self._difference += _PHASE_GAIN * bounded
        limit = _RATE_BOUND * period
        self._rate = min(max(self._rate + _RATE_GAIN * bounded, -limit), limit)
        self.filtered_ns += _SHOWN_GAIN * (min(max(residual, -period / 2), period / 2) - self.filtered_ns)
        self._judge()

    def holdover(self) -> None:
        """Continue for a cycle at the last rate: no frame returned."""
        if self.aligned:
            self._difference += self._rate

    def _measure(self, difference: int) -> None:
        self._measured[self._seen] = difference
        self._seen += 1
        if self._seen == MEASURE_CYCLES:
            # The median: a preempted cycle of the first hundred does not shift the phase.
            self._base = sorted(self._measured)[MEASURE_CYCLES // 2]
            self.aligned = True

    def _judge(self) -> None:
        error = abs(self.filtered_ns)
        if error < LOCK_WITHIN_NS:
            self._good_cycles += 1
            if self._good_cycles >= LOCK_CYCLES:
                self.locked = True
        else:
            self._good_cycles = 0
            if error > UNLOCK_BEYOND_NS:
                self.locked = False

    def next_wakeup(self, planned_ns: int) -> int:
        """Return the wake-up that follows the one planned at `planned_ns`.

        While measuring, the plain grid; then the first wanted instant of the reference clock that lies at least half
        a period after `planned_ns`, in the master's time.
        """
        period = self._period
        if not self.aligned:
            return planned_ns + period
        difference = self._base + round(self._difference + self._rate)
        # Round to the nearest wanted instant: on the grid this is exactly the next one.
        tick = planned_ns + difference + period - self._phase + period // 2
        return tick - tick % period + self._phase - difference
