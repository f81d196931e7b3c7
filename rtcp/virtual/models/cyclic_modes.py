"""The cyclic synchronous modes and the stop that may take over from any mode (CiA 402-2, ETG.6010).

A mode is entered, then updated once a step: `count` sub-steps of `h` seconds each. `bits` are the bits of the
statusword that the mode owns.
"""

from __future__ import annotations

from typing import ClassVar

from rtcp.virtual.device import Number
from rtcp.virtual.models.cia402 import Status
from rtcp.virtual.models.mechanics import Axis
from rtcp.virtual.models.units import AxisObjects

# Plain ints: flag arithmetic is too slow for every step.
REACHED = int(Status.TARGET_REACHED)
LIMIT = int(Status.INTERNAL_LIMIT)
SPECIFIC = int(Status.MODE_SPECIFIC)
ERROR = int(Status.MODE_ERROR)
_CATCHING_UP = 1.02
_CREEP = 0.005
"""What the position loop may add to the speed limit to make good what it lags behind: a factor, and rad/s."""
_STANDSTILL = 0.005
"""Speed, rad/s, below which a stopped joint counts as standing."""
_STOP_PATIENCE = 0.5
"""A joint that still moves so long (s) after its ramp has ended is moved by something else: the stop is over."""


class Motion:
    """What moves the axis while the power stage is on. Base of the modes."""

    closed: ClassVar[bool] = True
    """Whether the position loop is closed: only then is the following error watched."""

    def __init__(self, axis: Axis) -> None:
        self.bits = 0
        self._axis = axis

    def enter(self) -> None:
        """Begin anew: nothing is left of an earlier target."""
        self.bits = 0

    def resume(self) -> None:
        """Go on after a halt."""
        self.enter()

    def update(self, controlword: int, h: float, count: int) -> None:
        """Let `count` times `h` seconds pass."""
        raise NotImplementedError


class Profile:
    """The objects that shape a profile, in SI units; 0x60C5 and 0x607F bound what the master asks for."""

    def __init__(self, objects: AxisObjects) -> None:
        self._units = objects.units
        self._velocity = objects.number(0x6081)
        self._acceleration = objects.number(0x6083)
        self._deceleration = objects.number(0x6084)
        self._most = objects.number(0x60C5)
        self._top = objects.number(0x607F)
        self._low = objects.number(0x607D, 1)
        self._high = objects.number(0x607D, 2)

    @property
    def velocity(self) -> float:
        """Profile velocity, rad/s."""
        return min(self._velocity.value, self._top.value) * self._units.velocity

    @property
    def top(self) -> float:
        """Largest velocity of any profile, rad/s."""
        return self._top.value * self._units.velocity

    @property
    def acceleration(self) -> float:
        """Profile acceleration, rad/s^2, never zero."""
        return max(1, min(self._acceleration.value, self._most.value)) * self._units.acceleration

    @property
    def deceleration(self) -> float:
        """Profile deceleration, rad/s^2, never zero."""
        return max(1, min(self._deceleration.value, self._most.value)) * self._units.acceleration

    @property
    def range(self) -> tuple[float, float]:
        """The software position limits, rad."""
        unit = self._units.position
        return self._low.value * unit, self._high.value * unit


class Hold(Motion):
    """No mode chosen yet (0x6061 = 0): the joint is held where it is."""

    def enter(self) -> None:
        """Hold here."""
        self._axis.synchronise()
        self._axis.reference_velocity = 0.0

    def update(self, controlword: int, h: float, count: int) -> None:
        """Stay."""
        for _ in range(count):
            self._axis.follow(h)


class CyclicPosition(Motion):
    """CSP (8): interpolates from set-point to set-point, by `speed` and `top` fast at most.

    `period` and `exponent` (0x60C2) tell how long a set-point lasts; 0: as long as a step.
    """

    def __init__(self, axis: Axis, objects: AxisObjects, speed: Number, top: Number, period: Number,
                 exponent: Number) -> None:  # fmt: skip
        super().__init__(axis)
        self._units = objects.units
        self._target = objects.number(0x607A)
        self._offset = objects.number(0x60B0)
        self._speed = speed
        self._top = top
        self._low = objects.number(0x607D, 1)
        self._high = objects.number(0x607D, 2)
        self._period = period
        self._exponent = exponent
        self._period_told = self._exponent_told = 0
        self._period_s = 0.0
        self._set_point: int | None = None
        self._limit = 0
        self._goal = 0.0
        self._slope = 0.0
        self._fastest = _CREEP
        self._clamped = self._held_back = False

    def enter(self) -> None:
        """Start from where the joint is; after a halt, on to the set-point again."""
        super().enter()
        self._set_point = None

    def update(self, controlword: int, h: float, count: int) -> None:
        """Move the demand along the line to the set-point, and the joint after it."""
        axis = self._axis
        counts = self._target.value + self._offset.value
        limit = self._speed.value
        if counts != self._set_point or limit != self._limit:
            self._take(counts, limit, h * count)
        self._slope = axis.glide(self._goal, self._slope, self._fastest, h, count)
        bits = SPECIFIC
        if self._clamped or (self._held_back and axis.demand != self._goal):
            bits |= LIMIT
        self.bits = bits

    def _take(self, counts: int, limit: int, step: float) -> None:
        # Every cycle in a motion: comparisons are quicker than min and max.
        self._set_point, self._limit = counts, limit
        high, low = self._high.value, self._low.value
        allowed = high if counts > high else counts
        if allowed < low:  # noqa: PLR1730
            allowed = low
        self._clamped = allowed != counts
        self._goal = allowed * self._units.position
        value, exponent = self._period.value, self._exponent.value
        if value != self._period_told or exponent != self._exponent_told:
            self._period_told, self._exponent_told = value, exponent
            self._period_s = value * 10.0**exponent
        highest = self._top.value
        size = -limit if limit < 0 else limit
        top = (highest if highest < size else size) * self._units.velocity
        slope = (self._goal - self._axis.demand) / (self._period_s or step)
        self._slope = top if slope > top else -top if slope < -top else slope
        self._held_back = self._slope != slope
        self._fastest = top * _CATCHING_UP + _CREEP


class _WithoutPosition(Motion):
    """What CSV and CST share: a target, an offset added to it, and the software position limits that stop the joint."""

    closed = False

    def __init__(self, axis: Axis, objects: AxisObjects, target: int, offset: int) -> None:
        super().__init__(axis)
        self._units = objects.units
        self._target = objects.number(target)
        self._offset = objects.number(offset)
        self._profile = Profile(objects)
        self._deceleration = objects.number(0x6085)

    def _limits(self) -> tuple[float, float, float]:
        """Return the lowest and the highest position and the deceleration before them."""
        return *self._profile.range, self._deceleration.value * self._units.acceleration


class CyclicVelocity(_WithoutPosition):
    """CSV (9): the velocity loop follows 0x60FF + 0x60B1 within 0x607F, and stops at the software position limits."""

    def __init__(self, axis: Axis, objects: AxisObjects) -> None:
        super().__init__(axis, objects, 0x60FF, 0x60B1)

    def update(self, controlword: int, h: float, count: int) -> None:
        """Run at the velocity commanded."""
        axis = self._axis
        allowed = wanted = (self._target.value + self._offset.value) * self._units.velocity
        top = self._profile.top
        low, high, deceleration = self._limits()
        for _ in range(count):
            slowest, fastest = axis.velocity_range(low, high, deceleration)
            allowed = max(slowest, -top, min(fastest, top, wanted))
            axis.run(allowed, h)
        axis.synchronise()
        axis.reference_velocity = allowed
        self.bits = SPECIFIC if allowed == wanted else SPECIFIC | LIMIT


class CyclicTorque(_WithoutPosition):
    """CST (10): applies 0x6071 + 0x60B2 within 0x6072, and stops at the software position limits."""

    def __init__(self, axis: Axis, objects: AxisObjects) -> None:
        super().__init__(axis, objects, 0x6071, 0x60B2)

    def update(self, controlword: int, h: float, count: int) -> None:
        """Apply the torque commanded."""
        axis = self._axis
        wanted = (self._target.value + self._offset.value) * self._units.torque
        low, high, deceleration = self._limits()
        for _ in range(count):
            slowest, fastest = axis.velocity_range(low, high, deceleration)
            axis.push(wanted, slowest, fastest, h)
        axis.synchronise()
        self.bits = SPECIFIC | LIMIT if axis.saturated else SPECIFIC


class Stop(Motion):
    """A ramp to rest, then the joint is held: halt, quick stop, disabling and fault reaction, in every mode alike.

    `deceleration` (rad/s^2) is set before `enter`; `done` tells that the joint stands.
    """

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self.done = False
        self.deceleration = 1.0
        self._waited = 0.0

    def enter(self) -> None:
        """Begin to slow down from the joint's own position and velocity."""
        super().enter()
        self.done = False
        self._waited = 0.0
        self._axis.synchronise()

    def update(self, controlword: int, h: float, count: int) -> None:
        """Slow down, then hold."""
        axis = self._axis
        for _ in range(count):
            axis.ramp(0.0, self.deceleration, h)
        if not self.done and axis.reference_velocity == 0.0:
            self._waited += h * count
            self.done = abs(axis.mechanics.velocity) < _STANDSTILL or self._waited > _STOP_PATIENCE
        self.bits = REACHED if self.done else 0
