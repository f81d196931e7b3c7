"""Keeps the measured joints clear of boxes, of the arm itself and of partners in CST.

In CST a torque or a hand moves the joints, and the setpoints only follow. The stop of the measured joints must
therefore end before a boundary, with a margin: a torque motion that would come nearer ends in a controlled stop, and an
arm that a hand pushes nearer in spite of the position loop is stopped by its drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from kinematics.forward import frames
from rtcp.config.model import ArmConfig
from rtcp.ipc.events import PartnerNear
from rtcp.motion.guards.braking import touched, travel
from rtcp.motion.guards.neighbours import Neighbours
from rtcp.motion.guards.zones import POINTER_M, Zones
from rtcp.motion.limits import Cone, Corners, Limits

TORQUE_MARGIN_M: Final = 0.02
"""Distance beyond `cartesian.clearance`, and of the tool from its box, before which a torque motion stops, m."""
TORQUE_REACTION_S: Final = 0.05
"""Time in which the arm continues at its speed before the controlled stop brakes it, s: the torque fades out."""
PUSHED_CLEARANCE: Final = 0.5
"""Part of `cartesian.clearance` that stays when the drives stop a pushed arm. The other part is for the errors of
the position loop, which must not stop the arm."""
PUSH_REACTION_S: Final = 0.005
"""Time before a quick stop brakes the arm, s."""
_STILL_RAD_S: Final = 0.003
"""Measured speed that counts as standstill, rad/s."""


class _Boxes:
    """The boxes and cones to keep: those of the tool are smaller than the ones in force."""

    def __init__(self) -> None:
        self.box: Corners | None = None
        self.keep_out: tuple[Corners, ...] = ()
        self.cones: tuple[Cone, ...] = ()

    def take(self, limits: Limits, margin: float) -> None:
        """Replace the boxes and cones by those in force; `margin`: distance of the tool from its box, m."""
        self.keep_out = limits.keep_out
        turn = margin / POINTER_M
        self.cones = tuple([cone._replace(angle=max(cone.angle - turn, 0.5 * cone.angle)) for cone in limits.cones])
        self.box = None
        if limits.box is not None:
            a, b, c, d, e, f = limits.box
            self.box = a + margin, b + margin, c + margin, d - margin, e - margin, f - margin


class ComplianceGuard:
    """Looks ahead from the measured joints.

    Args:
        config: the arm; without geometry nothing is guarded.
        limits: the limits in force.
        clearance: distance of bodies from boxes and from each other, m.
        margin: distance of the tool from its box, m.
        reaction_s: time before the arm brakes, s.
    """

    def __init__(self, config: ArmConfig, limits: Limits, clearance: float, margin: float, reaction_s: float) -> None:
        self._limits = limits
        self._models = config.models
        self._margin = margin
        self._boxes = _Boxes()
        self._boxes.take(limits, margin)
        self._zones = [Zones(model, self._boxes, clearance) for model in self._models]
        self._reaction_s = reaction_s
        n = len(config.joints)
        self._here, self._next = [0.0] * n, [0.0] * n
        self._room = 0.0
        """Lower bound on `Zones.room` at `_here`, m."""
        self._box, self._keep_out, self._cones = limits.box, limits.keep_out, limits.cones
        self._number = 0

    @property
    def is_inside(self) -> bool:
        """Whether the arm was nearer than the clearance when `ahead` last returned a box or pair."""
        return self._room < 0.0

    def use_tool(self, number: int) -> None:
        """Switch to another tool."""
        self._number, self._room = number, 0.0

    def ahead(self, q: Sequence[float], velocity: Sequence[float]) -> tuple[int, float] | None:
        """Return the box or pair (`zones`) that the joints at `q`, rad, would touch before they stand, or None."""
        if not self._models or _stands(velocity):
            return None
        limits, dt = self._limits, self._reaction_s
        zones, model = self._zones[self._number], self._models[self._number]
        if limits.box is not self._box or limits.keep_out is not self._keep_out or limits.cones is not self._cones:
            self._box, self._keep_out, self._cones, self._room = limits.box, limits.keep_out, limits.cones, 0.0
            self._boxes.take(limits, self._margin)
        whole = travel(velocity, limits.acceleration, zones.reach, dt)[1]
        here, there, moved = self._here, self._next, 0.0
        for i, reach in enumerate(zones.reach):
            turned = q[i] - here[i]
            moved += reach * (turned if turned >= 0.0 else -turned)
            there[i] = q[i] + velocity[i] * dt
        if self._room - moved > whole:
            return None
        poses = frames(model, q)
        here[:] = q
        self._room = zones.room(poses)
        if self._room > whole:
            return None
        return touched(zones, poses, frames(model, there), there, velocity, limits.acceleration, dt)

    def partner_ahead(
        self, neighbours: Neighbours | None, q: Sequence[float], velocity: Sequence[float], part: float = 1.0
    ) -> PartnerNear | None:
        """Return the partner that the joints would come nearer to than a part of the clearance before they stand."""
        if neighbours is None or _stands(velocity):
            return None
        there = self._next
        for i, speed in enumerate(velocity):
            there[i] = q[i] + speed * self._reaction_s
        return neighbours.near(there, velocity, part)


def _stands(velocity: Sequence[float]) -> bool:
    # No generator in the cycle.
    fastest = 0.0
    for speed in velocity:
        fastest = max(fastest, speed, -speed)
    return fastest <= _STILL_RAD_S
