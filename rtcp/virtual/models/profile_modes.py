"""Modes with the drive's own profile: profile position, profile velocity, homing (CiA 402-2)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import floor, pi, sqrt

from rtcp.virtual.models.cyclic_modes import ERROR, LIMIT, REACHED, SPECIFIC, Motion, Profile
from rtcp.virtual.models.drive_objects import HOMING_METHODS
from rtcp.virtual.models.mechanics import Axis, ramp
from rtcp.virtual.models.units import AxisObjects


def approach(
    position: float, velocity: float, target: float, top: float, acceleration: float, deceleration: float, h: float
) -> tuple[float, float]:
    """Return position and velocity after `h` seconds of an approach to rest at `target`, at most at `top`.

    SI units; `top`, `acceleration`, `deceleration` are positive. It ends exactly at the target, without overshoot
    unless the initial velocity forces one.
    """
    distance = target - position
    direction = 1.0 if distance >= 0.0 else -1.0
    distance *= direction
    along = velocity * direction
    # Fastest speed from which whole steps of deceleration * h stop at the target.
    allowed = deceleration * (sqrt(0.25 * h * h + 2.0 * distance / deceleration) - 0.5 * h)
    wanted = min(top, allowed, distance / h)
    if along > wanted:
        along = max(wanted, along - deceleration * h)
    elif along < 0.0:
        along = min(wanted, along + deceleration * h)
    else:
        along = min(wanted, along + acceleration * h)
    # The last step is shorter than a deceleration step: it ends at rest on the target.
    if distance <= along * h * (1.0 + 1e-9) and along <= deceleration * h * (1.0 + 1e-9):
        return target, 0.0
    return position + direction * along * h, direction * along


_START = 0x10
"""Controlword bit 4: new set-point, homing operation start."""
_CHANGE_IMMEDIATELY = 0x20
_RELATIVE = 0x40


@dataclass(frozen=True)
class SetPoint:
    """A target of profile position with the profile at the time of its acceptance (SI units)."""

    position: float
    velocity: float
    acceleration: float
    deceleration: float
    limited: bool


class ProfilePosition(Motion):
    """Profile position (1): set-points by the handshake of controlword bit 4 and statusword bit 12; one is buffered."""

    def __init__(self, axis: Axis, objects: AxisObjects) -> None:
        super().__init__(axis)
        self._units = objects.units
        self._profile = Profile(objects)
        self._target = objects.number(0x607A)
        self._window = objects.number(0x6067)
        self._window_time = objects.number(0x6068)
        self._active: SetPoint | None = None
        self._queued: SetPoint | None = None
        self._last = 0.0
        self._start: int | None = None
        self._inside = 0.0

    def enter(self) -> None:
        """Discard all set-points; bit 4 must rise again."""
        self._active = self._queued = None
        self._last = self._axis.demand
        self._start = None
        self._inside = 0.0
        self.bits = 0

    def resume(self) -> None:
        """Continue to the active set-point."""
        self._inside = 0.0

    def watch(self, controlword: int) -> None:
        """Remember bit 4, whose next rise offers a set-point."""
        self._start = controlword & _START

    def update(self, controlword: int, h: float, count: int) -> None:
        """Accept an offered set-point; move towards the active one."""
        self._handshake(controlword)
        axis = self._axis
        for _ in range(count):
            point = self._active
            if point is None:
                axis.ramp(0.0, self._profile.deceleration, h)
                continue
            axis.reference, axis.reference_velocity = approach(
                axis.reference, axis.reference_velocity, point.position, point.velocity, point.acceleration,
                point.deceleration, h,
            )  # fmt: skip
            if axis.reference == point.position and self._queued is not None:
                self._active, self._queued = self._queued, None
            axis.demand = axis.reference
            axis.follow(h)
        self._report(h * count)

    def _handshake(self, controlword: int) -> None:
        start = controlword & _START
        if self._start is None:
            self._start = start
        if start and not self._start:
            busy = self._active is not None and self._axis.reference != self._active.position
            if controlword & _CHANGE_IMMEDIATELY or not busy:
                self._active, self._queued = self._set_point(controlword), None
            elif self._queued is None:
                self._queued = self._set_point(controlword)
            self.bits |= SPECIFIC
        elif not start and self._queued is None:
            self.bits &= ~SPECIFIC
        self._start = start

    def _set_point(self, controlword: int) -> SetPoint:
        profile = self._profile
        wanted = self._target.value * self._units.position
        if controlword & _RELATIVE:
            wanted += self._last
        low, high = profile.range
        self._last = max(low, min(high, wanted))
        return SetPoint(
            self._last, profile.velocity, profile.acceleration, profile.deceleration, limited=self._last != wanted
        )

    def _report(self, dt: float) -> None:
        point = self._active
        bits = self.bits & SPECIFIC
        if point is not None:
            arrived = self._queued is None and self._axis.reference == point.position
            if arrived and abs(point.position - self._axis.position) <= self._window.value * self._units.position:
                self._inside += dt
            else:
                self._inside = 0.0
            if self._inside * 1000.0 >= self._window_time.value and arrived:
                bits |= REACHED
            if point.limited:
                bits |= LIMIT
        self.bits = bits


class ProfileVelocity(Motion):
    """Profile velocity (3): follows 0x60FF with ramps of 0x6083 and 0x6084; stops at the software position limits."""

    closed = False

    def __init__(self, axis: Axis, objects: AxisObjects) -> None:
        super().__init__(axis)
        self._units = objects.units
        self._profile = Profile(objects)
        self._target = objects.number(0x60FF)
        self._window = objects.number(0x606D)
        self._window_time = objects.number(0x606E)
        self._threshold = objects.number(0x606F)
        self._threshold_time = objects.number(0x6070)
        self._inside = self._still = 0.0

    def enter(self) -> None:
        """Start at the joint's actual velocity."""
        self._inside = self._still = 0.0
        self.bits = 0

    def update(self, controlword: int, h: float, count: int) -> None:
        """Ramp to the target velocity and hold it."""
        axis, profile = self._axis, self._profile
        wanted = self._target.value * self._units.velocity
        low, high = profile.range
        acceleration, deceleration = profile.acceleration, profile.deceleration
        target = max(-profile.top, min(profile.top, wanted))
        velocity, limited = axis.reference_velocity, target != wanted
        for _ in range(count):
            slowest, fastest = axis.velocity_range(low, high, deceleration)
            free = ramp(velocity, target, acceleration, deceleration, h)
            velocity = max(slowest, min(fastest, free))
            limited = limited or velocity != free
            axis.run(velocity, h)
        axis.synchronise()
        axis.reference_velocity = velocity
        actual, dt = axis.mechanics.velocity, h * count
        self._inside = self._inside + dt if abs(wanted - actual) <= self._window.value * self._units.velocity else 0.0
        self._still = self._still + dt if abs(actual) <= self._threshold.value * self._units.velocity else 0.0
        bits = LIMIT if limited else 0
        if self._inside and self._inside * 1000.0 >= self._window_time.value:
            bits |= REACHED
        if self._still and self._still * 1000.0 >= self._threshold_time.value:
            bits |= SPECIFIC
        self.bits = bits


class Phase(Enum):
    """Phase of a homing procedure (statusword bits 10, 12 and 13 of CiA 402-2)."""

    IDLE = REACHED
    SEARCHING = 0
    STOPPING = SPECIFIC
    ATTAINED = SPECIFIC | REACHED
    FAILED = ERROR | REACHED


class Homing(Motion):
    """Homing (6) by methods 33, 34 (next index pulse), 35 and 37 (present position); home gets the value of 0x607C."""

    def __init__(self, axis: Axis, objects: AxisObjects, gear_ratio: float) -> None:
        """The index pulse occurs once per motor revolution: `gear_ratio` times per output revolution."""
        super().__init__(axis)
        self._units = objects.units
        self._pitch = 2 * pi / gear_ratio
        self._method = objects.number(0x6098)
        self._home_offset = objects.number(0x607C)
        self._speed = objects.number(0x6099, 2)
        self._acceleration = objects.number(0x609A)
        self._phase = Phase.IDLE
        self._start: int | None = None
        self._velocity = 0.0
        self._index = 0.0

    def enter(self) -> None:
        """Wait for the start (rising edge of controlword bit 4)."""
        self._phase = Phase.IDLE
        self._start = None
        self.bits = 0

    def resume(self) -> None:
        """Continue the search."""

    def update(self, controlword: int, h: float, count: int) -> None:
        """Start or interrupt by bit 4; search; stop."""
        start = controlword & _START
        if self._start is None:
            self._start = start
        if start and not self._start:
            self._begin()
        elif not start and self._phase in (Phase.SEARCHING, Phase.STOPPING):
            self._phase = Phase.IDLE
        self._start = start
        axis = self._axis
        acceleration = max(1, self._acceleration.value) * self._units.acceleration
        for _ in range(count):
            axis.ramp(self._velocity if self._phase is Phase.SEARCHING else 0.0, acceleration, h)
            if self._phase is Phase.SEARCHING:
                self._search()
        standing = axis.reference_velocity == 0.0 and abs(axis.mechanics.velocity) < 0.01
        if self._phase is Phase.STOPPING and standing:
            self._phase = Phase.ATTAINED
        self.bits = self._phase.value if standing else self._phase.value & ~REACHED

    def _begin(self) -> None:
        method, position = self._method.value, self._axis.mechanics.position
        if method in (35, 37):
            self._attain(position)
        elif method not in HOMING_METHODS or self._speed.value == 0:
            self._phase = Phase.FAILED
        else:
            revolution = floor(position / self._pitch)
            if method == 33:
                self._index = (revolution if revolution * self._pitch < position else revolution - 1) * self._pitch
            else:
                self._index = (revolution + 1) * self._pitch
            self._velocity = self._speed.value * self._units.velocity * (-1.0 if method == 33 else 1.0)
            self._phase = Phase.SEARCHING

    def _search(self) -> None:
        position = self._axis.mechanics.position
        if position >= self._index if self._velocity > 0.0 else position <= self._index:
            self._attain(self._index)

    def _attain(self, home: float) -> None:
        axis = self._axis
        axis.shift(self._home_offset.value * self._units.position - (home + axis.offset))
        self._phase = Phase.STOPPING
