"""A joint: motor, gear, brake, load and gravity on the output side, and its control loops. SI units."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sin, sqrt
from types import MappingProxyType
from typing import ClassVar, Final

GRAVITY: Final = 9.80665
GEAR_RATIO = 100
ENCODER_INCREMENTS = 1 << 14
"""Increments per revolution of each encoder; the motor's encoder gives the fine position."""
INCREMENTS_PER_RAD = GEAR_RATIO * ENCODER_INCREMENTS / (2 * pi)
"""Increments of the motor's encoder per rad of the output."""


@dataclass(frozen=True)
class ActuatorSize:
    """An actuator, output side: torques (Nm) and speed from the maker's table, other values assumed."""

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
    """Inertia of rotor and wave generator at the output, kg m^2 (assumed)."""
    load_inertia: float
    """Usual load inertia of a joint of this size, kg m^2 (assumed)."""
    coulomb: float
    """Coulomb friction of the gear, Nm (assumed)."""
    viscous: float
    """Viscous friction of the gear, Nm s/rad (assumed)."""

    @property
    def speed_limit(self) -> float:
        """Speed limit of the output from the gear's input speed, rad/s."""
        return self.input_speed / 60 * 2 * pi / GEAR_RATIO


SIZES = MappingProxyType({
    "orh40": ActuatorSize("ORH40", 5.4, 19.0, 35.0, 7.7, 8000, 8.0, 23.0, 0.15, 0.15, 0.35, 0.3),
    "orh50": ActuatorSize("ORH50", 16.0, 37.0, 71.0, 27.0, 7000, 12.5, 37.0, 0.30, 0.25, 0.8, 0.6),
    "orh60": ActuatorSize("ORH60", 28.0, 57.0, 95.0, 34.0, 6000, 9.0, 28.0, 0.60, 0.50, 1.4, 1.2),
    "orh70": ActuatorSize("ORH70", 40.0, 82.0, 147.0, 49.0, 6000, 10.0, 30.0, 1.00, 1.00, 2.0, 2.0),
})  # fmt: skip


class Mechanics:
    """Mechanics of a joint: `position` (rad, of the output encoder) and `velocity` (rad/s), moved by `advance`.

    `load_mass_moment` (kg m) is the load's mass times the distance of its centre from the axis. `external_torque` (Nm)
    is the sum of outside torques: a hand, a collision, a payload. `braked` adds the holding torque to the friction.
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
        """Advance by `h` seconds (at most about 1 ms) with the motor's `torque` (Nm) at the output.

        Gravity adds `gravity_torque * sin(position + gravity_phase)`: with phase 0 the load is upright (unstable) at 0,
        with phase pi it hangs.
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
            # Implicit viscous friction: stable for any step.
            after = (velocity + h * opposed / self.inertia) / (1.0 + h * self.viscous / self.inertia)
            if after * velocity < 0.0 and -friction <= net <= friction:
                # Friction stops a motion but never reverses it.
                after = 0.0
        self.velocity = after
        self.position += 0.5 * (velocity + after) * h


def ramp(velocity: float, target: float, acceleration: float, deceleration: float, h: float) -> float:
    """Return the velocity after `h` seconds of a ramp to `target`, at `deceleration` when slowing."""
    slowing = abs(target) < abs(velocity) or target * velocity < 0.0
    change = (deceleration if slowing else acceleration) * h
    if velocity < target:
        return min(target, velocity + change)
    return max(target, velocity - change)


_POSITION_GAIN: Final = 50.0
_VELOCITY_BANDWIDTH: Final = 300.0
_VELOCITY_INTEGRAL: Final = 40.0
_TRACKER: Final = 150.0
"""Bandwidth of the tracker that smooths cyclic set-points, rad/s: one count per cycle is 0.2 rad/s at 500 us."""


class Axis:
    """A controlled joint. Every method advances by `h` seconds, at most `LONGEST_STEP`.

    `demand` is the position demand value (0x6062); `reference` and `reference_velocity` are its smooth version for the
    position loop. The gains are set from the inertia at commissioning.
    """

    LONGEST_STEP: ClassVar = 500e-6

    __slots__ = (
        "_integral", "_integral_gain", "_velocity_gain", "demand", "mechanics", "offset", "reference",
        "reference_velocity", "saturated", "torque", "torque_limit", "torque_offset", "velocity_offset",
        "velocity_share",
    )  # fmt: skip

    def __init__(self, mechanics: Mechanics) -> None:
        self.mechanics = mechanics
        self.offset = 0.0
        """User position minus encoder position, rad; set by homing."""
        self.torque = 0.0
        self.torque_limit = 0.0
        self.velocity_share = 1.0
        """Fraction of the demand's velocity that the position loop itself adds; 0: it relies on `velocity_offset`."""
        self.saturated = False
        """True: the last step reached the torque limit."""
        self._velocity_gain = _VELOCITY_BANDWIDTH * mechanics.inertia
        self._integral_gain = self._velocity_gain * _VELOCITY_INTEGRAL
        self._integral = 0.0
        self.synchronise()

    @property
    def position(self) -> float:
        """User position, rad."""
        return self.mechanics.position + self.offset

    def synchronise(self) -> None:
        """Set the demand to the joint's actual position and velocity, for a change of mode without a jump.

        The offsets become 0: a mode that has some sets them before each step.
        """
        self.torque_offset = self.velocity_offset = 0.0
        self.demand = self.reference = self.mechanics.position + self.offset
        self.reference_velocity = self.mechanics.velocity

    def shift(self, offset: float) -> None:
        """Move the user's zero: all positions increase by `offset` rad."""
        self.offset += offset
        self.demand += offset
        self.reference += offset

    def release(self) -> None:
        """Power stage on, brake open; reset the loops."""
        self.mechanics.braked = False
        self._integral = 0.0
        self.synchronise()

    def rest(self, h: float) -> None:
        """Power stage off, brake closed: only friction stops the joint."""
        self.torque = 0.0
        self.saturated = False
        self.mechanics.braked = True
        self.mechanics.advance(0.0, h)
        self.synchronise()

    def glide(self, goal: float, slope: float, fastest: float, h: float, count: int) -> float:
        """Move `demand` at `slope` (rad/s) to `goal` and follow it, `count` times; return the remaining slope.

        A second-order, critically damped tracker without lag at constant speed follows, at most at `fastest` (rad/s).
        `run` and `Mechanics.advance` are inlined: this is all that a drive in CSP does.
        """
        mechanics = self.mechanics
        demand, reference, along = self.demand, self.reference, self.reference_velocity
        position, speed, offset = mechanics.position, mechanics.velocity, self.offset
        gain, integral_gain, integral = self._velocity_gain, self._integral_gain, self._integral
        limit, torque, saturated = self.torque_limit, self.torque, self.saturated
        inertia, viscous, external = mechanics.inertia, mechanics.viscous, mechanics.external_torque
        gravity, phase = mechanics.gravity_torque, mechanics.gravity_phase
        share, added, fed = self.velocity_share, self.velocity_offset, self.torque_offset
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
            wanted = share * along + added + _POSITION_GAIN * (reference - along * h - position - offset)
            error = (fastest if wanted > fastest else -fastest if wanted < -fastest else wanted) - speed
            torque = gain * error + integral + fed
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
        # The reference is for the end of this step: compare with the value before it.
        error = self.reference - velocity * h - self.mechanics.position - self.offset
        self.run(velocity + _POSITION_GAIN * error, h)

    def ramp(self, velocity: float, acceleration: float, h: float) -> None:
        """Ramp the demand's speed to `velocity` at `acceleration` (rad/s^2), and follow it."""
        self.reference_velocity = ramp(self.reference_velocity, velocity, acceleration, acceleration, h)
        self.demand = self.reference = self.reference + self.reference_velocity * h
        self.follow(h)

    def run(self, velocity: float, h: float) -> None:
        """Close the velocity loop on `velocity` rad/s."""
        error = velocity - self.mechanics.velocity
        torque = self._velocity_gain * error + self._integral + self.torque_offset
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
        """Apply `torque` Nm within the torque limit and the velocity range slowest..fastest."""
        velocity = self.mechanics.velocity
        highest = min(self.torque_limit, self._velocity_gain * (fastest - velocity))
        lowest = max(-self.torque_limit, self._velocity_gain * (slowest - velocity))
        allowed = max(-self.torque_limit, min(self.torque_limit, max(lowest, min(highest, torque))))
        self.saturated = allowed != torque
        # A following velocity or position mode starts from this torque.
        self._integral = self.torque = allowed
        self.mechanics.advance(allowed, h)

    def velocity_range(self, low: float, high: float, deceleration: float) -> tuple[float, float]:
        """Return the range of velocities from which `deceleration` (rad/s^2) stops within low..high."""
        position = self.mechanics.position + self.offset
        below, above = position - low, high - position
        return (
            -sqrt(2.0 * deceleration * below) if below > 0.0 else 0.0,
            sqrt(2.0 * deceleration * above) if above > 0.0 else 0.0,
        )
