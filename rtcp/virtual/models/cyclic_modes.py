"""The cyclic synchronous modes, and the stop, which can interrupt any mode (CiA 402-2, ETG.6010).

After `enter`, `update` is called once a step: `count` sub-steps of `h` seconds each. `bits` are the mode's bits of the
statusword.
"""

from __future__ import annotations

from typing import ClassVar, Final

from rtcp.virtual.models.cia402 import Status
from rtcp.virtual.models.mechanics import Axis
from rtcp.virtual.models.units import AxisObjects
from rtcp.virtual.objects import Number

# Plain ints: enum arithmetic is too slow for every step.
REACHED: Final = int(Status.TARGET_REACHED)
LIMIT: Final = int(Status.INTERNAL_LIMIT)
SPECIFIC: Final = int(Status.MODE_SPECIFIC)
ERROR: Final = int(Status.MODE_ERROR)
_CATCHING_UP: Final = 1.02
_CREEP: Final = 0.005
"""Excess over the speed limit that the position loop may use to catch up: a factor, and rad/s."""
_STANDSTILL: Final = 0.005
"""Speed below which a stopped joint counts as at rest, rad/s."""
_STOP_PATIENCE: Final = 0.5
"""Time after the end of the ramp at which a stop ends even if an external force still moves the joint, s."""


class Motion:
    """Base of the modes: moves the axis while the power stage is on."""

    closed: ClassVar[bool] = True
    """True: the position loop is closed and the following error is supervised."""

    def __init__(self, axis: Axis) -> None:
        self.bits = 0
        self._axis = axis

    def enter(self) -> None:
        """Start without any earlier target."""
        self.bits = 0

    def resume(self) -> None:
        """Continue after a halt."""
        self.enter()

    def watch(self, controlword: int) -> None:
        """See the last controlword of a halt, after `resume`."""

    def update(self, controlword: int, h: float, count: int) -> None:
        """Advance by `count` times `h` seconds."""
        raise NotImplementedError


class Profile:
    """The objects of a profile in SI units; 0x60C5 and 0x607F bound the master's values."""

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
        return float(min(self._velocity.value, self._top.value) * self._units.velocity)

    @property
    def top(self) -> float:
        """Upper bound on the velocity of any profile, rad/s."""
        return float(self._top.value * self._units.velocity)

    @property
    def acceleration(self) -> float:
        """Profile acceleration, rad/s^2, never zero."""
        return float(max(1, min(self._acceleration.value, self._most.value)) * self._units.acceleration)

    @property
    def deceleration(self) -> float:
        """Profile deceleration, rad/s^2, never zero."""
        return float(max(1, min(self._deceleration.value, self._most.value)) * self._units.acceleration)

    @property
    def range(self) -> tuple[float, float]:
        """The software position limits, rad."""
        unit = self._units.position
        return self._low.value * unit, self._high.value * unit


class Hold(Motion):
    """No mode chosen yet (0x6061 = 0): holds the joint in place."""

    def enter(self) -> None:
        """Hold the present position."""
        self._axis.synchronise()
        self._axis.reference_velocity = 0.0

    def update(self, controlword: int, h: float, count: int) -> None:
        """Hold."""
        for _ in range(count):
            self._axis.follow(h)


class CyclicPosition(Motion):
    """CSP (8): interpolates from set-point to set-point, at most at `speed` and `top`.

    0x60B1 is added to the input of the velocity loop, 0x60B2 to its output.

    `period` and `exponent` (0x60C2) give the duration of a set-point; 0: one step.
    """

    def __init__(self, axis: Axis, objects: AxisObjects, speed: Number, top: Number, period: Number,
                 exponent: Number) -> None:  # fmt: skip
        super().__init__(axis)
        self._units = objects.units
        self._target = objects.number(0x607A)
        self._offset = objects.number(0x60B0)
        self._velocity_offset = objects.number(0x60B1)
        self._torque_offset = objects.number(0x60B2)
        self._speed = speed
        self._top = top
        self._low = objects.number(0x607D, 1)
        self._high = objects.number(0x607D, 2)
        self._wrap_low = objects.number(0x607B, 1)
        self._wrap_high = objects.number(0x607B, 2)
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
        """Start from the joint's position; after a halt, continue to the set-point."""
        super().enter()
        self._set_point = None

    def update(self, controlword: int, h: float, count: int) -> None:
        """Move the demand linearly to the set-point; the joint follows."""
        axis = self._axis
        target: int = self._target.value
        offset: int = self._offset.value
        limit: int = self._speed.value
        counts = target + offset
        if counts != self._set_point or limit != self._limit:
            self._take(counts, limit, h * count)
        added: int = self._velocity_offset.value
        fed: int = self._torque_offset.value
        axis.velocity_offset = added * self._units.velocity
        axis.torque_offset = fed * self._units.torque
        self._slope = axis.glide(self._goal, self._slope, self._fastest, h, count)
        bits = SPECIFIC
        if self._clamped or (self._held_back and axis.demand != self._goal):
            bits |= LIMIT
        self.bits = bits

    def _take(self, counts: int, limit: int, step: float) -> None:
        # Called every cycle of a motion: comparisons are faster than min and max.
        self._set_point, self._limit = counts, limit
        if self._wrap_low.value < self._wrap_high.value:
            # A target of an axis that wraps is reached by the shorter way (CiA 402-2, object 0x607B).
            turn = self._wrap_high.value - self._wrap_low.value + 1
            here = round(self._axis.demand / self._units.position)
            counts = here + (counts - here + turn // 2) % turn - turn // 2
        high: int = self._high.value
        low: int = self._low.value
        allowed = high if counts > high else counts
        if allowed < low:  # noqa: PLR1730
            allowed = low
        self._clamped = allowed != counts
        self._goal = allowed * self._units.position
        value: int = self._period.value
        exponent: int = self._exponent.value
        if value != self._period_told or exponent != self._exponent_told:
            self._period_told, self._exponent_told = value, exponent
            self._period_s = value * 10.0**exponent
        highest: int = self._top.value
        size = -limit if limit < 0 else limit
        top = (highest if highest < size else size) * self._units.velocity
        slope = (self._goal - self._axis.demand) / (self._period_s or step)
        self._slope = top if slope > top else -top if slope < -top else slope
        self._held_back = self._slope != slope
        self._fastest = top * _CATCHING_UP + _CREEP


class _WithoutPosition(Motion):
    """Common part of CSV and CST: target, offset, and software position limits that stop the joint."""

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
    """CSV (9): the velocity loop follows 0x60FF + 0x60B1 within 0x607F, and stops at the software position limits.

    0x60B2 is added to its output.
    """

    def __init__(self, axis: Axis, objects: AxisObjects) -> None:
        super().__init__(axis, objects, 0x60FF, 0x60B1)
        self._torque_offset = objects.number(0x60B2)

    def update(self, controlword: int, h: float, count: int) -> None:
        """Run at the commanded velocity."""
        axis = self._axis
        allowed = wanted = (self._target.value + self._offset.value) * self._units.velocity
        top = self._profile.top
        low, high, deceleration = self._limits()
        axis.torque_offset = self._torque_offset.value * self._units.torque
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
        """Apply the commanded torque."""
        axis = self._axis
        wanted = (self._target.value + self._offset.value) * self._units.torque
        low, high, deceleration = self._limits()
        for _ in range(count):
            slowest, fastest = axis.velocity_range(low, high, deceleration)
            axis.push(wanted, slowest, fastest, h)
        axis.synchronise()
        self.bits = SPECIFIC | LIMIT if axis.saturated else SPECIFIC


class Stop(Motion):
    """A ramp to rest, then hold: for halt, quick stop, disabling and fault reaction in all modes.

    Set `deceleration` (rad/s^2) before `enter`; `done` is True at rest.
    """

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self.done = False
        self.deceleration = 1.0
        self._waited = 0.0

    def enter(self) -> None:
        """Start the ramp at the joint's position and velocity."""
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
