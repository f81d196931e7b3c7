"""The process image of the in-process bus: exchanges, SYNC0, watchdogs, and frames that are lost."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

from rtcp.launch.inprocess_slave import InProcessSlave


class InProcessData:
    """The process image (ProcessData). `configure` makes it.

    `lose` frames to see what becomes of it; `heard` tells of the last `send` whether it reached the slaves.
    """

    def __init__(
        self, slaves: Sequence[InProcessSlave], period_ns: int, now_ns: int, offset_ns: int, random: Random
    ) -> None:
        self.expected_wkc = sum((1 if s.input_bytes else 0) + (2 if s.output_bytes else 0) for s in slaves)
        self.now_ns = now_ns
        self.missed = 0
        self.stale = 0
        self.heard = False
        self.wkc = -1
        """What the last `receive` returned."""
        self.outputs = [bytes(slave.output_bytes) for slave in slaves]
        """What the next `send` sends, slave by slave."""
        self._offset_ns = offset_ns
        self._random = random
        self._period_ns = period_ns
        self._period_s = period_ns * 1e-9
        self._slaves = tuple(slaves)
        self._lengths = [slave.output_bytes for slave in slaves]
        self.inputs = [slave.inputs for slave in slaves]
        """Those of the last answer."""
        self._answer = self.inputs
        self._answered = False
        self._lost_out = self._lost_back = 0
        self._fed_ns = self.now_ns
        self._came = True
        self._doubt = False
        self._free_since = self.now_ns
        self._free = [slave for slave in slaves if not slave.by_sync0]
        self._shifts = sorted({slave.shift_ns % period_ns for slave in slaves if slave.by_sync0})
        self._groups = [
            [slave for slave in slaves if slave.by_sync0 and slave.shift_ns % period_ns == shift]
            for shift in self._shifts
        ]
        self._due = [self._first(shift) for shift in self._shifts]
        self.dc_time = self._shown = self.now_ns + self._offset_ns
        self.count()

    def _first(self, shift: int) -> int:
        """The first SYNC0 from now on: whole cycles of the reference clock, and the shift."""
        shown = self.now_ns + self._offset_ns - shift
        return self.now_ns + -shown % self._period_ns

    def count(self) -> None:
        """Work out the working counter anew: a slave has changed its state."""
        self._wkc = sum(slave.counts for slave in self._slaves)

    def fed(self, slave: InProcessSlave) -> bool:
        """Whether a frame has come within the slave's watchdog time."""
        return self.now_ns - self._fed_ns <= slave.watchdog_ns

    def lose(self, cycles: int, heard: bool | None = None) -> None:
        """Lose the next `cycles` frames: on the way back (`heard`) or out; None: chance decides."""
        if self._random.random() < 0.5 if heard is None else heard:
            self._lost_back = max(self._lost_back, cycles)
        else:
            self._lost_out = max(self._lost_out, cycles)

    def send(self) -> None:
        """Send the outputs that were set."""
        if self._lost_out:
            self._lost_out -= 1
            self._answered = self.heard = False
            return
        self.heard = True
        self._answer = [slave.inputs for slave in self._slaves]
        self._shown = self.now_ns + self._offset_ns
        # Every slave keeps them; only one in OP takes them over.
        for slave, outputs in zip(self._slaves, self.outputs, strict=True):
            slave.outputs = outputs
        self._fed_ns = self.now_ns
        self._came = True
        self._answered = not self._lost_back
        if self._lost_back:
            self._lost_back -= 1
        if self._free:
            passed = self.now_ns - self._free_since
            self._free_since = self.now_ns
            for slave in self._free:
                slave.advance(passed * 1e-9)

    def receive(self) -> int:
        """Return the working counter of the answer, -1 where none came; then inputs and `dc_time` stay."""
        if not self._answered:
            self.missed += 1
            self.wkc = -1
            return -1
        self.inputs = self._answer
        self.dc_time = self._shown
        self.wkc = self._wkc
        return self.wkc

    def input(self, index: int) -> bytes:
        """Return the inputs of slave `index` of the last answer."""
        return self.inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of slave `index` for the next `send`; data of another length is not taken."""
        if len(data) == self._lengths[index]:
            self.outputs[index] = data

    def pass_time(self, now_ns: int) -> None:
        """Let every SYNC0 up to `now_ns` happen, in the order of time."""
        due = self._due
        while due and (first := min(due)) <= now_ns:
            which = due.index(first)
            due[which] += self._period_ns
            if not self._came or self._doubt:
                self._watch(first)
            for slave in self._groups[which]:
                slave.advance(self._period_s)
            if which == len(due) - 1:
                self._came = False
        if not due and not self._came:
            self._watch(now_ns)
        self.now_ns = max(now_ns, self.now_ns)

    def _watch(self, now_ns: int) -> None:
        since = now_ns - self._fed_ns
        left = [slave.watch(since, self._came) for slave in self._slaves]
        self._doubt = any(slave.in_doubt for slave in self._slaves)
        if any(left):
            self.count()
