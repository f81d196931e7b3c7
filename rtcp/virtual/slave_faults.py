"""What is wrong with a slave's firmware and clock."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class SlaveFaults:
    """It stays with the slave when its supply goes and comes back; firmware and mailbox look here while they work."""

    refusals: list[tuple[int, int]] = field(default_factory=list)
    """AL states that the slave refuses to go up to, and the AL status code it gives."""
    hangs: int = 0
    """Not 0: requests for AL states are neither done nor refused."""
    sdo_delays: list[int] = field(default_factory=list)
    """ns by which answers to SDO come late; the longest counts."""
    sdo_aborts: list[tuple[int, int]] = field(default_factory=list)
    """Objects (index, 0: each) whose services are aborted, and the abort code."""
    sync0_losses: int = 0
    """Not 0: no SYNC0 comes."""
    drift_ppm: float = 0.0
    """What the clock runs fast beyond its own drift."""

    def refusal(self, state: int) -> int:
        """The AL status code with which the slave refuses to go up to `state`; 0: it does not."""
        return next((code for refused, code in self.refusals if refused == state), 0)

    def sdo_abort(self, index: int) -> int:
        """The abort code of services of object `index`; 0: they are served."""
        return next((code for refused, code in self.sdo_aborts if refused in (0, index)), 0)

    def sdo_delay(self) -> int:
        """ns by which the answer to an SDO comes late."""
        return max(self.sdo_delays, default=0)
