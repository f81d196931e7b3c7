"""The mechanics of a joint, all on the output side: rotor, strain-wave gear, friction, holding brake, load, gravity."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sin
from types import MappingProxyType

GRAVITY = 9.80665
GEAR_RATIO = 100
ENCODER_INCREMENTS = 1 << 14
"""Increments of a turn of either encoder; the motor's, behind the gear, gives the fine position."""
INCREMENTS_PER_RAD = GEAR_RATIO * ENCODER_INCREMENTS / (2 * pi)
"""Increments of the motor's encoder for one rad of the output."""


@dataclass(frozen=True)
class ActuatorSize:
    """An actuator: torques (Nm) and speed from the maker's table, output side; what the table leaves out is assumed."""

    name: str
    rated_torque: float
    start_stop_torque: float
    peak_torque: float
    average_torque: float
    """Largest average load torque."""
    input_speed: float
    """Largest speed of the gear's input, rpm."""
    rated_current: float
    peak_current: float
    rotor_inertia: float
    """Rotor and wave generator as the output sees them, kg m^2 (assumed)."""
    load_inertia: float
    """What a joint of this size usually carries, kg m^2 (assumed)."""
    coulomb: float
    """Coulomb friction of the gear, Nm (assumed)."""
    viscous: float
    """Viscous friction of the gear, Nm s/rad (assumed)."""

    @property
    def speed_limit(self) -> float:
        """Largest speed of the output, rad/s, that the gear's input allows."""
        return self.input_speed / 60 * 2 * pi / GEAR_RATIO


SIZES = MappingProxyType({
    "orh40": ActuatorSize("ORH40", 5.4, 19.0, 35.0, 7.7, 8000, 8.0, 23.0, 0.15, 0.15, 0.35, 0.3),
    "orh50": ActuatorSize("ORH50", 16.0, 37.0, 71.0, 27.0, 7000, 12.5, 37.0, 0.30, 0.25, 0.8, 0.6),
    "orh60": ActuatorSize("ORH60", 28.0, 57.0, 95.0, 34.0, 6000, 9.0, 28.0, 0.60, 0.50, 1.4, 1.2),
    "orh70": ActuatorSize("ORH70", 40.0, 82.0, 147.0, 49.0, 6000, 10.0, 30.0, 1.00, 1.00, 2.0, 2.0),
})  # fmt: skip


class Mechanics:
    """A joint that turns: `position` (rad, of the output encoder), `velocity` (rad/s), moved by `advance`.

    `load_mass_moment` (kg m) is the load's mass times the distance of its centre from the axis. `external_torque` (Nm)
    is what the world adds: a hand, a collision, a payload. `braked` adds the holding torque to the friction.
    """

    __slots__ = (
        "braked", "coulomb", "external_torque", "gravity_phase", "gravity_torque", "holding_torque", "inertia",
        "position", "velocity", "viscous",
    )  # fmt: skip

    def __init__(
        self,
        inertia: float,
        coulomb: float,
        viscous: float,
        *,
        holding_torque: float,
        load_mass_moment: float = 0.0,
        gravity_phase: float = 0.0,
        position: float = 0.0,
    ) -> None:
        self.inertia = inertia
        self.coulomb = coulomb
        self.viscous = viscous
        self.holding_torque = holding_torque
        self.gravity_torque = load_mass_moment * GRAVITY
        self.gravity_phase = gravity_phase
        self.external_torque = 0.0
        self.braked = True
        self.position = position
        self.velocity = 0.0

    def advance(self, torque: float, h: float) -> None:
        """Let `h` seconds (at most about 1 ms) pass under `torque` (Nm) of the motor, as the output feels it.

        Gravity adds `gravity_torque * sin(position + gravity_phase)`: with phase 0 the load stands upright at 0 and
        wants to fall, with phase pi it hangs.
        """
        velocity = self.velocity
        net = torque + self.external_torque
        if self.gravity_torque:
            net += self.gravity_torque * sin(self.position + self.gravity_phase)
        friction = self.coulomb
        if self.braked:
            friction += self.holding_torque
        if velocity == 0.0:
            if -friction <= net <= friction:
                return
            net -= friction if net > 0.0 else -friction
            after = h * net / self.inertia
        else:
            opposed = net - friction if velocity > 0.0 else net + friction
            # Viscous friction is taken implicitly: stable for any step.
            after = (velocity + h * opposed / self.inertia) / (1.0 + h * self.viscous / self.inertia)
            if after * velocity < 0.0 and -friction <= net <= friction:
                # Friction stops a motion; it never turns it round.
                after = 0.0
        self.velocity = after
        self.position += 0.5 * (velocity + after) * h
