"""What the joints of a segment truly do, whatever the master hears of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rtcp.virtual.models.cubemars import CubemarsDrive
from rtcp.virtual.segment import Segment
from rtcp.virtual.slave import Slave

STANDSTILL = 0.002
"""A joint slower than this, rad/s, stands."""
PATIENCE = 10_000_000_000
"""Without a request for so many ns the joints are not watched any more."""


class _Joint:
    """A drive that is watched: when it last moved, how fast it was at most."""

    __slots__ = ("drive", "moved", "peak")

    def __init__(self, drive: CubemarsDrive) -> None:
        self.drive = drive
        self.moved = 0
        self.peak = 0.0

    def look(self, now: int) -> None:
        """Remember what it does now."""
        speed = abs(self.drive.mechanics.velocity)
        if speed > STANDSTILL:
            self.moved = now
            self.peak = max(self.peak, speed)


class GroundTruth:
    """Watches the joints from the first question on, for as long as requests come: else a segment pays nothing.

    While `watching`, `look` is to be called after each step of a device.
    """

    def __init__(self, segment: Segment, models: Sequence[str]) -> None:
        self.watching = False
        self._asked: int | None = None
        """Instant of the last request; None: nobody has ever asked for the truth."""
        self._chain = segment.chain
        self._segment = segment
        self._models = tuple(models)
        self._joints = {
            slave: _Joint(slave.device) for slave in segment.slaves if isinstance(slave.device, CubemarsDrive)
        }

    def look(self, slave: Slave, now: int) -> None:
        """See whether the joint of `slave`, which was stepped, moves at instant `now`."""
        joint = self._joints.get(slave)
        if joint is not None:
            joint.look(now)
        if self._asked is not None and now - self._asked > PATIENCE:
            self.watching = False

    def requested(self, now: int) -> None:
        """Somebody asked for something: who has once asked for the truth may ask for it again."""
        if self._asked is not None:
            self._watch(now)

    def _watch(self, now: int) -> None:
        self.watching = True
        self._asked = now

    def clear_peaks(self, now: int) -> None:
        """Forget how fast the joints were."""
        self._watch(now)
        for joint in self._joints.values():
            joint.peak = 0.0

    def answer(self, now: int) -> dict[str, Any]:
        """Return what is true at instant `now`, slave by slave."""
        self._watch(now)
        for joint in self._joints.values():
            joint.look(now)
        slaves = zip(self._segment.slaves, self._models, strict=True)
        return {
            "time_ns": now,
            "slaves": [self._of(position, slave, model) for position, (slave, model) in enumerate(slaves, 1)],
        }

    def _of(self, position: int, slave: Slave, model: str) -> dict[str, Any]:
        found: dict[str, Any] = {
            "position": position,
            "model": model,
            "al": slave.application.state.name.replace("_", "-"),
            "reachable": position <= self._segment.chain.reach,
        }
        joint = self._joints.get(slave)
        if joint is not None:
            drive = joint.drive
            found |= {
                "position_rad": drive.mechanics.position,
                "velocity_rad_s": drive.mechanics.velocity,
                "state": drive.state.name.lower().replace("_", " "),
                "torque_on": drive.powered,
                "moved_ns": joint.moved,
                "peak_rad_s": joint.peak,
            }
        return found
