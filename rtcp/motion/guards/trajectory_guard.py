"""The guards of the setpoints: between every controller and the drive writer.

For each joint the mean speed of the next cycle is within its limit, differs from the last by no more than
acceleration x cycle, and leaves room to stop inside the range (`braking.fastest_stoppable`). These conditions stay
satisfiable: the next step of a stop always fulfils them. Boxes, cones and the arm's own bodies are guarded in the same
way: a setpoint passes only if the stop from it touches nothing, so that the stop from the last setpoint is always
possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from math import inf, isfinite
from typing import Final

from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.config.model import ArmConfig
from rtcp.ipc.events import BoxReached, CollisionAhead, JointLimitReached, MotionEnded, NotLeavingBox
from rtcp.ipc.refusals import LimitsExcludeArm, Refusal
from rtcp.motion.guards.braking import fastest_stoppable, touched, travel
from rtcp.motion.guards.neighbours import Neighbours
from rtcp.motion.guards.zones import ITSELF, Zones, reported
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import ArmState, Setpoint

# Tolerances for round-off of the generators: position beyond the range, factors on a joint's speed and on its change in
# a cycle, and slack of the change that a lowered limit requires.
_ROUNDING_RAD: Final = 1e-7
_SPEED: Final = 1.0 + 5e-7
_CHANGE: Final = 1.0 + 5e-5
_ROUNDING_RAD_S: Final = 1e-10


class GuardResult(IntEnum):
    """Effect of the guard on a target."""

    PASS = 0
    CLAMPED = 1
    STOPPING = 2
    """The guard brakes and ignores targets until the arm stands."""
    STOPPED = 3
    """The guard's stop came to rest in this cycle."""


class TrajectoryGuard:
    """Guards the setpoints of one arm.

    After a cut, `held` is the bit mask of the clamped joints.

    Args:
        config: the arm; without geometry neither boxes nor the arm itself are guarded.
        limits: the limits in force, read every cycle.
        dt: cycle time, s.
    """

    def __init__(self, config: ArmConfig, limits: Limits, dt: float) -> None:
        n = len(config.joints)
        self._limits = limits
        self._dt = dt
        self._models = config.models
        self._clearance = config.cartesian.clearance
        self._zones = [Zones(model, limits, self._clearance) for model in self._models]
        self._model: ArmModel | None = None
        self.zones: Zones | None = None
        self._joints = range(n)
        self._mean = [0.0] * n
        """Mean speed of each joint in the last cycle, rad/s: reference for its acceleration."""
        self._next = [0.0] * n
        """Allowed mean speed of each joint in the next cycle, rad/s."""
        self._position = [0.0] * n
        self._state = ArmState(n)
        self._poses: Sequence[Pose] | None = None
        self._room = self._room_then = 0.0
        """Lower bound on `Zones.room` of the commanded position, m; 0: unknown."""
        self._poses_then: Sequence[Pose] | None = None
        self._box, self._keep_out, self._cones = limits.box, limits.keep_out, limits.cones
        self._rests = False
        """Whether the last setpoint was at rest at the commanded position, not cut by a guard."""
        self.neighbours: Neighbours | None = None
        """Guards the distance to the partners in a cell; None: no partners."""
        self.stopping = False
        self.held = 0
        self.ended: MotionEnded | None = None
        """Reason for the last stop of the guard."""

        self.use_tool(0)

    def use_tool(self, number: int) -> None:
        """Switch to another tool; at rest."""
        if self._models:
            self._model, self.zones = self._models[number], self._zones[number]
            self._poses, self._room = None, 0.0

    def zones_of(self, number: int) -> Zones | None:
        """Return the zones for a tool."""
        return self._zones[number] if self._models else None

    def zone_with(self, number: int, q: Sequence[float]) -> int | None:
        """Return the box or pair that the arm would violate at `q` (rad) with a tool, or None."""
        if not self._models:
            return None
        distance, zone = self._zones[number].distance(frames(self._models[number], q))
        return zone if distance < 0.0 else None

    @property
    def poses(self) -> Sequence[Pose]:
        """`frames` of the commanded position; empty without geometry."""
        if self._poses is None:
            self._poses = () if self._model is None else frames(self._model, self._state.commanded)
        return self._poses

    def latch(self, state: ArmState) -> None:
        """Start at rest at `state`."""
        for i in self._joints:
            self._mean[i] = state.commanded_velocity[i] = state.commanded_acceleration[i] = 0.0
        self.stopping = self._rests = False
        self.held = 0
        self._state = state
        self._poses, self._room = None, 0.0

    def zone_at(self, q: Sequence[float]) -> int | None:
        """Return the box or pair (`zones`) that the arm would violate at `q` (rad), or None."""
        distance, zone = self.nearest_box(q)
        return zone if distance < 0.0 else None

    def nearest_box(self, q: Sequence[float]) -> tuple[float, int]:
        """Return the arm's signed distance at `q` (rad) from the nearest box or itself, m, and the box or pair."""
        if self.zones is None or self._model is None:
            return inf, 0
        return self.zones.distance(frames(self._model, q))

    def _reached(self, zone: int, ahead: float) -> MotionEnded:
        """Return the reason of a stop: the box or pair that the arm would reach, `ahead` m away, or has reached."""
        assert self.zones is not None
        here, nearest = self.zones.distance(self.poses)
        if here < 0.0 and nearest == zone:
            return NotLeavingBox(zone, reported(zone, -here))
        return self.reached(zone, ahead)

    def stop_for(self, ended: MotionEnded) -> None:
        """Brake from the next cycle on, for a reason that the setpoints do not show."""
        if not self.stopping:
            self.stopping, self.ended = True, ended

    def reached(self, zone: int, ahead: float) -> MotionEnded:
        """Return the reason of a stop before a box or pair, `ahead` m away."""
        assert self.zones is not None
        if zone < ITSELF:
            return BoxReached(zone, max(reported(zone, ahead), 0.0))
        return CollisionAhead(*self.zones.links(zone), max(ahead, 0.0))

    def refusal_of(self, state: ArmState, new: Values, *, widen: bool = False) -> Refusal | None:
        """Return a refusal of `new` limits if the arm, or its stop under them, is outside them or too near a partner.

        The refusal is None if the arm can still stop in time. Every change of the limits under way asks this method;
        one that may `widen` is compared with the absolute limits in place of the configured ones.
        """
        refused = self._limits.check(new, state.commanded, self._mean, widen=widen)
        if refused is not None or self._model is None:
            return refused
        limits, mean = self._limits, self._mean
        same_boxes = (new.box, new.keep_out, new.cones) == (limits.box, limits.keep_out, limits.cones)
        slower = any(rate < now for rate, now in zip(new.acceleration, limits.acceleration, strict=True))
        longer_stop = slower and any(mean)
        if longer_stop and self.neighbours is not None:
            refused = self.neighbours.refusal_of(state.commanded, mean, new.acceleration)
            if refused is not None:
                return refused
        # Accepted even if the arm already violates a box: the new limits make that no worse.
        if same_boxes and not longer_stop:
            return None
        zones, poses = Zones(self._model, new, self._clearance), frames(self._model, state.commanded)
        distance, zone = zones.box_distance(poses)
        if distance >= 0.0:
            stop = touched(zones, poses, poses, state.commanded, mean, new.acceleration, self._dt)
            if stop is None:
                return None
            zone, _ = stop
        return LimitsExcludeArm(zone)

    def apply(self, state: ArmState, target: Setpoint, tolerates_saturation: bool) -> GuardResult:
        """Write the allowed part of `target` to `state`: position, velocity, acceleration.

        A velocity that does not match the positions is replaced by their mean speed.

        Args:
            state: with the commanded values of the last cycle.
            target: setpoint of the controller; NaN is cut too.
            tolerates_saturation: whether the controller continues after a cut; otherwise a cut starts a stop.
        """
        self._state = state
        if self.stopping:
            self._rests = False
            return self._brake(state)
        wanted = target.position
        if wanted is not state.commanded:
            self._rests = False
        elif self._rests and not any(target.velocity):
            return GuardResult.PASS  # at rest a controller returns the state itself
        self.held = held = self._bound(state, wanted)
        position, mean, last, dt = self._position, self._next, self._mean, self._dt
        if held:
            if not tolerates_saturation:
                return self._stop(state, self._excess(state, wanted))
            for i in self._joints:
                position[i] = state.commanded[i] + mean[i] * dt if held >> i & 1 else wanted[i]
            wanted = position
        contact = self._touches(state, wanted)
        if contact is not None:
            return self._stop(state, self._reached(*contact))
        if self.neighbours is not None and (near := self.neighbours.ahead(wanted, mean)) is not None:
            return self._stop(state, near)
        self._poses, self._room = self._poses_then, self._room_then
        here, speeds, rates, most = state.commanded, target.velocity, self._limits.acceleration, self._limits.velocity
        velocity, acceleration = state.commanded_velocity, state.commanded_acceleration
        for i in self._joints:
            w, speed, rate = mean[i], speeds[i], rates[i]
            u, fastest = rate * dt * _CHANGE, most[i] * _SPEED
            if held >> i & 1 or not (-u <= speed - w <= u and -fastest <= speed <= fastest):
                speed = w
            change = (speed - velocity[i]) / dt
            acceleration[i] = rate if change > rate else -rate if change < -rate else change
            velocity[i] = speed
        here[:], last[:] = wanted, mean
        if held:
            return GuardResult.CLAMPED
        self._rests = wanted is here and not (any(last) or any(velocity) or any(acceleration))
        return GuardResult.PASS

    def _bound(self, state: ArmState, wanted: Sequence[float]) -> int:
        """Write the allowed mean speeds to `_next`; return the mask of the joints whose target was cut."""
        limits, dt, last, allowed, here = self._limits, self._dt, self._mean, self._next, state.commanded
        lows, highs, most, rates = limits.low, limits.high, limits.velocity, limits.acceleration
        held = 0
        for i in self._joints:
            q, v, rate = here[i], last[i], rates[i]
            u = rate * dt
            w = (wanted[i] - q) / dt
            if w > 0.0:
                speed, slower, room = w, v - w, highs[i] - q + _ROUNDING_RAD
            else:
                speed, slower, room = -w, w - v, q - lows[i] + _ROUNDING_RAD
            # A speed above a lowered limit has to decrease at the joint's acceleration, and cannot decrease faster.
            if (-u * _CHANGE <= slower <= u * _CHANGE) and (
                (
                    speed <= most[i] * _SPEED
                    and (speed * (dt + 0.5 * speed / rate) <= room or speed <= fastest_stoppable(room, u, dt))
                )
                or slower >= u - _ROUNDING_RAD_S
            ):
                allowed[i] = w
                continue
            held |= 1 << i
            allowed[i] = self._cut(w, q, v, i)
        return held

    def _cut(self, w: float, q: float, v: float, i: int) -> float:
        """Return the nearest allowed mean speed; NaN brakes."""
        limits, dt = self._limits, self._dt
        fastest, u = limits.velocity[i], limits.acceleration[i] * dt
        high = min(fastest, fastest_stoppable(limits.high[i] - q, u, dt))
        low = -min(fastest, fastest_stoppable(q - limits.low[i], u, dt))
        high = min(max(high, v - u), v + u)
        low = max(min(low, v + u), v - u)
        return min(max(w if isfinite(w) else 0.0, low), high)

    def _touches(self, state: ArmState, position: Sequence[float]) -> tuple[int, float] | None:
        """Return the box or pair that `position` at the speeds `_next`, or the stop from there, would touch."""
        zones, model, mean, limits = self.zones, self._model, self._next, self._limits
        self._poses_then, self._room_then = None, self._room
        if zones is None or model is None:
            return None
        if not any(mean):
            self._poses_then = self._poses
            return None
        if limits.box is not self._box or limits.keep_out is not self._keep_out or limits.cones is not self._cones:
            self._box, self._keep_out, self._cones, self._room = limits.box, limits.keep_out, limits.cones, 0.0
        step, whole = travel(mean, limits.acceleration, zones.reach, self._dt)
        if self._room <= whole:
            self._room = zones.room(self.poses)
        self._room_then = self._room - step
        if self._room > whole:
            return None
        self._poses_then = frames(model, position)
        return touched(zones, self.poses, self._poses_then, position, mean, limits.acceleration, self._dt)

    def _excess(self, state: ArmState, wanted: Sequence[float]) -> JointLimitReached:
        """Return the first joint that was cut, with its commanded and its allowed value."""
        axis = (self.held & -self.held).bit_length() - 1
        target, limits = wanted[axis], self._limits
        if target > limits.high[axis]:
            return JointLimitReached(axis, target, limits.high[axis])
        if target < limits.low[axis]:
            return JointLimitReached(axis, target, limits.low[axis])
        return JointLimitReached(axis, (target - state.commanded[axis]) / self._dt, self._next[axis])

    def _stop(self, state: ArmState, ended: MotionEnded) -> GuardResult:
        self.stopping, self.ended = True, ended
        return self._brake(state)

    def _brake(self, state: ArmState) -> GuardResult:
        limits, dt, mean = self._limits, self._dt, self._mean
        self._poses, self._room = None, 0.0
        moving = False
        for i in self._joints:
            v, u = mean[i], limits.acceleration[i] * dt
            w = v - u if v > u else v + u if v < -u else 0.0
            state.commanded_acceleration[i] = (w - v) / dt
            state.commanded[i] += w * dt
            state.commanded_velocity[i] = mean[i] = w
            moving = moving or w != 0.0
        if moving:
            return GuardResult.STOPPING
        self.stopping = False
        for i in self._joints:
            state.commanded_acceleration[i] = 0.0
        return GuardResult.STOPPED
