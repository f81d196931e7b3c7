"""A joint: motor, gear, brake, load and gravity on the output side, and the loops that control it. SI units."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sin, sqrt
from types import MappingProxyType
from typing import ClassVar

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


def ramp(velocity: float, target: float, acceleration: float, deceleration: float, h: float) -> float:
    """Return the velocity after `h` seconds on the way to `target`, by `deceleration` when slowing."""
    slowing = abs(target) < abs(velocity) or target * velocity < 0.0
    change = (deceleration if slowing else acceleration) * h
    if velocity < target:
        return min(target, velocity + change)
    return max(target, velocity - change)


_POSITION_GAIN = 50.0
_VELOCITY_BANDWIDTH = 300.0
_VELOCITY_INTEGRAL = 40.0
_TRACKER = 150.0
"""Bandwidth (rad/s) of the tracker that smooths cyclic set-points: one count a cycle is 0.2 rad/s at 500 us."""


class Axis:
    """One controlled joint. Every method lets `h` seconds pass, at most `LONGEST_STEP` of them.

    `demand` is the position that the drive is on its way through (0x6062); `reference` and `reference_velocity` are
    what the position loop follows: the same, but smooth. The gains are set from the inertia that was there at
    commissioning.
    """

    LONGEST_STEP: ClassVar = 500e-6

    __slots__ = (
        "_integral", "_integral_gain", "_velocity_gain", "demand", "mechanics", "offset", "reference",
        "reference_velocity", "saturated", "torque", "torque_limit",
    )  # fmt: skip

    def __init__(self, mechanics: Mechanics) -> None:
        self.mechanics = mechanics
        self.offset = 0.0
        """Position as the user counts it, minus the encoder's; homing sets it."""
        self.torque = 0.0
        self.torque_limit = 0.0
        self.saturated = False
        """Whether the torque limit was met in the last step."""
        self._velocity_gain = _VELOCITY_BANDWIDTH * mechanics.inertia
        self._integral_gain = self._velocity_gain * _VELOCITY_INTEGRAL
        self._integral = 0.0
        self.synchronise()

    @property
    def position(self) -> float:
        """Position as the user counts it, rad."""
        return self.mechanics.position + self.offset

    def synchronise(self) -> None:
        """Set the demand to the joint's own position and velocity: no jump when something else takes over."""
        self.demand = self.reference = self.mechanics.position + self.offset
        self.reference_velocity = self.mechanics.velocity

    def shift(self, offset: float) -> None:
        """Move the user's zero: every position reads `offset` rad more from now on."""
        self.offset += offset
        self.demand += offset
        self.reference += offset

    def release(self) -> None:
        """Open the brake, power stage on: the loops start empty."""
        self.mechanics.braked = False
        self._integral = 0.0
        self.synchronise()

    def rest(self, h: float) -> None:
        """Power stage off, brake closed: friction alone stops the joint."""
        self.torque = 0.0
        self.saturated = False
        self.mechanics.braked = True
        self.mechanics.advance(0.0, h)
        self.synchronise()

    def glide(self, goal: float, slope: float, fastest: float, h: float, count: int) -> float:
        """Move `demand` on by `slope` (rad/s) until it is at `goal`, follow it; `count` times. Return the slope left.

        It is followed, at most `fastest` (rad/s), through a tracker that has no lag at constant speed, of second order
        and critically damped. What `run` and `Mechanics.advance` do is written out: a drive in CSP does nothing else.
        """
        mechanics = self.mechanics
        demand, reference, along = self.demand, self.reference, self.reference_velocity
        position, speed, offset = mechanics.position, mechanics.velocity, self.offset
        gain, integral_gain, integral = self._velocity_gain, self._integral_gain, self._integral
        limit, torque, saturated = self.torque_limit, self.torque, self.saturated
        inertia, viscous, external = mechanics.inertia, mechanics.viscous, mechanics.external_torque
        gravity, phase = mechanics.gravity_torque, mechanics.gravity_phase
        friction = mechanics.coulomb
        if mechanics.braked:
            friction += mechanics.holding_torque
        moving = slope != 0.0
        move = slope * h
        for _ in range(count):
            if moving:
                if (goal - demand - move) * move <= 1e-12:
                    demand = goal
                    slope = move = 0.0
                else:
                    demand += move
            error = demand - reference
            along += _TRACKER * _TRACKER * error * h
            reference += (along + 2.0 * _TRACKER * error) * h
            wanted = along + _POSITION_GAIN * (reference - along * h - position - offset)
            error = (fastest if wanted > fastest else -fastest if wanted < -fastest else wanted) - speed
            torque = gain * error + integral
            saturated = not -limit <= torque <= limit
            if saturated:
                torque = limit if torque > limit else -limit
            else:
                integral += integral_gain * error * h
            net = torque + external
            if gravity:
                net += gravity * sin(position + phase)
            if speed == 0.0:
                if -friction <= net <= friction:
                    continue
                after = h * (net - (friction if net > 0.0 else -friction)) / inertia
            else:
                opposed = net - friction if speed > 0.0 else net + friction
                after = (speed + h * opposed / inertia) / (1.0 + h * viscous / inertia)
                if after * speed < 0.0 and -friction <= net <= friction:
                    after = 0.0
            position += 0.5 * (speed + after) * h
            speed = after
        self.demand, self.reference, self.reference_velocity = demand, reference, along
        self._integral, self.torque, self.saturated = integral, torque, saturated
        mechanics.position, mechanics.velocity = position, speed
        return slope

    def follow(self, h: float) -> None:
        """Close the position loop on `reference` and `reference_velocity`."""
        velocity = self.reference_velocity
        # The reference is where the joint shall be after this step: compare what was before it.
        error = self.reference - velocity * h - self.mechanics.position - self.offset
        self.run(velocity + _POSITION_GAIN * error, h)

    def ramp(self, velocity: float, acceleration: float, h: float) -> None:
        """Move the demand at a speed that approaches `velocity` by `acceleration` (rad/s^2), and follow it."""
        self.reference_velocity = ramp(self.reference_velocity, velocity, acceleration, acceleration, h)
        self.demand = self.reference = self.reference + self.reference_velocity * h
        self.follow(h)

    def run(self, velocity: float, h: float) -> None:
        """Close the velocity loop on `velocity` rad/s."""
        error = velocity - self.mechanics.velocity
        torque = self._velocity_gain * error + self._integral
        limit = self.torque_limit
        if torque > limit:
            self.saturated = True
            torque = limit
        elif torque < -limit:
            self.saturated = True
            torque = -limit
        else:
            self.saturated = False
            self._integral += self._integral_gain * error * h
        self.torque = torque
        self.mechanics.advance(torque, h)

    def push(self, torque: float, slowest: float, fastest: float, h: float) -> None:
        """Apply `torque` Nm as far as the torque limit and the range of velocities slowest..fastest allow."""
        velocity = self.mechanics.velocity
        highest = min(self.torque_limit, self._velocity_gain * (fastest - velocity))
        lowest = max(-self.torque_limit, self._velocity_gain * (slowest - velocity))
        allowed = max(-self.torque_limit, min(self.torque_limit, max(lowest, min(highest, torque))))
        self.saturated = allowed != torque
        # A velocity or position mode that takes over starts from this torque.
        self._integral = self.torque = allowed
        self.mechanics.advance(allowed, h)

    def velocity_range(self, low: float, high: float, deceleration: float) -> tuple[float, float]:
        """Return the slowest and the fastest velocity from which `deceleration` (rad/s^2) still stops in low..high."""
        position = self.mechanics.position + self.offset
        below, above = position - low, high - position
        return (
            -sqrt(2.0 * deceleration * below) if below > 0.0 else 0.0,
            sqrt(2.0 * deceleration * above) if above > 0.0 else 0.0,
        )
