"""Which event takes which rung of the ladder of stops; what each rung does is in `rtcp.ipc.stop_reactions`.

The first rung, to hold the last targets, is every lost cycle's up to `bus.lost_cycles` and nobody's choice. As `model`,
this module imports nothing heavy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

HardStop = Literal["quick_stop", "torque_off"]
"""Where set-points cannot be carried out any more, or are not to be trusted: the drives stop by themselves."""
AnyStop = Literal["controlled_stop", "quick_stop", "torque_off"]


@dataclass(frozen=True)
class StopsConfig:
    """One key an event, its value the rung that the event takes."""

    lost_frames: HardStop = "quick_stop"
    """`bus.lost_cycles` cycles without a right working counter in a row, or so many more than with one."""
    slave_lost: HardStop = "quick_stop"
    """A slave has left OP, or is gone."""
    drive_fault: HardStop = "quick_stop"
    """A drive is in fault, or has left Operation Enabled by itself."""
    clock_lost: AnyStop = "quick_stop"
    """The cycle does not follow the reference clock any more."""
    emergency_stop: HardStop = "quick_stop"
    """Its input is active: IEC 60204-1 knows stop category 1, a quick stop and then no torque, and category 0."""
    supervision: HardStop = "quick_stop"
    """What is measured was beyond a limit of `watch` for too long."""
    lease_ended: AnyStop = "controlled_stop"
    """The commander of what moves fell silent, or gave up its lease."""
    enabling_switch: AnyStop = "controlled_stop"
    """It was let go while something moves."""
