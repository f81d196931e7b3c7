"""Whether joints that are told to quick-stop stand; where nobody hears them, whether they must by now."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.ipc.stops import quick_stop_s

_STAND_S = 2.0
"""A drive that still turns so long after its quick stop does not stop by itself: its brake has to."""
_UNHEARD_S = 0.5
"""So much longer than the quick stop of a usual arm that a late begin of it does not matter."""
FIRST_CYCLES = 10
"""What a drive shows is older than what it was told: so many cycles pass before standstill counts."""


class Standstill:
    """Looked at once a cycle from `begin` on.

    Args:
        config: how long a quick stop takes, and the cycle.
        arm: the joints.
    """

    def __init__(self, config: ArmConfig, arm: Arm) -> None:
        ramp_s, period_s = quick_stop_s(config), config.cycle.period_us * 1e-6
        self._arm = arm
        self._stand_cycles = round(max(_STAND_S, ramp_s) / period_s)
        self._unheard_cycles = round(max(_UNHEARD_S, ramp_s) / period_s)
        self._cycles = self._unheard = 0

    def begin(self) -> None:
        """Begin with the quick stop."""
        self._cycles = self._unheard = 0

    @property
    def unheard(self) -> bool:
        """Whether the drives have not answered for as long as any quick stop takes: their states are not known."""
        return self._unheard > self._unheard_cycles

    def reached(self, good: bool) -> bool:
        """Do the cycle's part; return whether the joints stand, or nothing is gained by waiting for it.

        Args:
            good: the drives have answered.
        """
        self._cycles += 1
        if not good:
            self._unheard += 1
        stands = good and self._cycles > FIRST_CYCLES and self._arm.first_moving() < 0
        return stands or self.unheard or self._cycles > self._stand_cycles
