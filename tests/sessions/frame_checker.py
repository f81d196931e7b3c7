"""A checker of what goes over the bus: bytes decoded by its own table, limits as they are at that time.

It knows the facts' process data (15 bytes a drive, 10000 counts to the rad, rad/s and Nm) and nothing of the loop.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

from rtcp.launch.simulation import Frame
from rtcp.motion.limits import Corners, Values
from tests.arm_geometry import L2, L3, L4, L5, box_gaps, depth, own_gap, points

WIRE = struct.Struct("<Hiiib")
"""Controlword or statusword, position, velocity, torque, mode: the same both ways."""
COUNTS = 10_000.0
CSP, CSV, CST = 8, 9, 10
CHANGING = -1
ENABLE_OPERATION = 0x0F
OPERATION_ENABLED, STATE_MASK = 0x27, 0x6F
WINDOWS = (1, 4, 16, 64)
"""Cycles over which the acceleration is looked at: a window of n sees what rounding hides from a shorter one."""
ROUNDING = 2
"""Counts that three rounded positions are wrong by at most: 1/2 + 2 * 1/2 + 1/2."""
MARGIN = 0.02 * COUNTS
"""So far outside its range a joint may be enabled, to be brought back."""
LATCHED = 5
"""Counts between the first target after enabling and the joint, which may sag a little when the brake opens."""
ZONE_TOLERANCE_M = 0.5e-3
"""Of positions rounded to 0.1 mrad."""
REACH = (L2 + L3 + L4 + L5, L2 + L3 + L4 + L5, L3 + L4 + L5, L5, L5, 0.0)
"""m a rad: how far a point of the arm moves at most when the joint turns."""
_KEPT = 2 * WINDOWS[-1] + 1


@dataclass
class Bounds:
    """The limits in force, in rad, rad/s, rad/s^2, Nm and m; one number a joint."""

    low: list[float]
    high: list[float]
    velocity: list[float]
    acceleration: list[float]
    torque: list[float]
    box: Corners | None = None
    keep_out: list[Corners] = field(default_factory=list)

    def put(self, new: Values) -> None:
        """Change all of them in place."""
        self.low[:], self.high[:] = new.low, new.high
        self.velocity[:], self.acceleration[:], self.torque[:] = new.velocity, new.acceleration, new.torque
        self.box, self.keep_out[:] = new.box, new.keep_out


class _Joint:
    """What was commanded of one joint since it was enabled."""

    def __init__(self) -> None:
        self.positions: list[int] = []
        self.velocities: list[float] = []
        self.resting = 0
        self.mode = 0
        self.last = 0
        """Target position of the last frame, in whatever mode."""
        self.heard: int | None = None
        """The one that the drive heard last."""


class FrameChecker:
    """Checks every frame; `violations` are sentences, `largest_step` and `largest_acceleration` relative to the bound.

    Args:
        bounds: the limits; changed in place, then reported by `changed`.
        period_s: the cycle.
        drives: index of each joint's slave.
        expected_wkc: working counter of an exchange in which every slave took part.
    """

    def __init__(self, bounds: Bounds, period_s: float, drives: Sequence[int], expected_wkc: int) -> None:
        self.bounds = bounds
        self.violations: list[str] = []
        self.largest_step = 0.0
        self.largest_acceleration = 0.0
        self.frames = 0
        self.obeyed = 0
        """Frames in which at least one drive was enabled and commanded to be."""
        self.zero = [0] * len(drives)
        """What each drive shows at the arm's zero, counts."""
        self._dt = period_s
        self._drives = list(drives)
        self._expected = expected_wkc
        self._joints = [_Joint() for _ in drives]
        self._answered = True
        self._look_again = 0
        self._excused = True
        """Whether the arm was enabled inside a zone and has not come out of it yet."""

    def changed(self) -> None:
        """Take note that `bounds` have changed: windows do not reach back beyond this."""
        for joint in self._joints:
            del joint.positions[:-1]
            del joint.velocities[:-1]
            joint.resting = 0
        self._look_again = 0

    def check(self, frame: Frame) -> None:
        """Check a frame; the statuswords that came back with it say which drives obey it."""
        self.frames += 1
        answered, self._answered = self._answered, frame.wkc == self._expected
        obeying = 0
        for axis, slot in enumerate(self._drives):
            control, position, velocity, torque, mode = WIRE.unpack(frame.sent[slot])
            status, actual, _, _, shown = WIRE.unpack(frame.received[slot])
            joint = self._joints[axis]
            position, actual = position - self.zero[axis], actual - self.zero[axis]
            if control != ENABLE_OPERATION or status & STATE_MASK != OPERATION_ENABLED or mode not in (CSP, CSV, CST):
                if joint.mode:
                    self._joints[axis] = _Joint()
                continue
            obeying += 1
            if mode != shown:
                # Commanded to change its mode and has not yet.
                if joint.mode:
                    self._check_going_on(axis, joint, position, mode, frame.now_ns)
                    joint.mode = CHANGING
            elif mode != joint.mode:
                self._check_entry(axis, joint, position, actual, mode, frame.now_ns)
                joint = self._joints[axis] = _Joint()
                joint.mode = mode
            elif mode == CST:
                self._check_torque(axis, torque, frame.now_ns)
            else:
                self._check_position(axis, joint, position, answered, frame.now_ns)
                if frame.heard:
                    self._check_heard(axis, joint, position, frame.now_ns)
                if mode == CSV:
                    self._check_velocity(axis, joint, velocity, answered, frame.now_ns)
            if mode != CST and joint.mode == mode and not joint.positions:
                joint.positions.append(position)
            joint.last = position
        if obeying:
            self.obeyed += 1
        if obeying == len(REACH):
            if all(joint.positions for joint in self._joints):
                self._check_zones(frame.now_ns)
        else:
            self._look_again = 0
            self._excused = True

    def _violation(self, now_ns: int, axis: int, sentence: str) -> None:
        if len(self.violations) < 20:
            self.violations.append(f"{now_ns * 1e-9:.4f} s, joint {axis + 1}: {sentence}")

    def _check_entry(self, axis: int, joint: _Joint, position: int, actual: int, mode: int, now: int) -> None:
        """The first target after enabling is where the joint is; the first in another mode goes on from the last."""
        bounds = self.bounds
        low, high = bounds.low[axis] * COUNTS - 1, bounds.high[axis] * COUNTS + 1
        self._check_going_on(axis, joint, position, mode, now)
        if not joint.mode and mode == CSP and abs(position - actual) > LATCHED:
            self._violation(now, axis, f"first target {position}, the joint stands at {actual}")
        if mode == CSP and not low - MARGIN <= position <= high + MARGIN:
            self._violation(now, axis, f"first target {position} outside {low:.0f}..{high:.0f}")

    def _check_going_on(self, axis: int, joint: _Joint, position: int, mode: int, now: int) -> None:
        step = self.bounds.velocity[axis] * self._dt * COUNTS + 1
        if joint.mode and mode == CSP and abs(position - joint.last) > step:
            self._violation(now, axis, f"target {position} after the change of mode, {joint.last} before it")

    def _check_position(self, axis: int, joint: _Joint, position: int, answered: bool, now: int) -> None:
        bounds, past = self.bounds, joint.positions
        low, high = bounds.low[axis] * COUNTS - 1, bounds.high[axis] * COUNTS + 1
        last = past[-1]
        if not min(low, last) <= position <= max(high, last):
            self._violation(now, axis, f"target {position} outside {low:.0f}..{high:.0f}, the last was {last}")
        step = abs(position - last)
        allowed = bounds.velocity[axis] * self._dt * COUNTS + 1
        self.largest_step = max(self.largest_step, step / allowed)
        if step > allowed:
            self._violation(now, axis, f"step of {step} counts, allowed are {allowed:.1f}")
        if not step:
            # Nobody heard the last targets: time stands still for the set-points, and no sample is added.
            if not answered:
                return
            joint.resting += 1
            if joint.resting > _KEPT:
                return
        else:
            joint.resting = 0
        past.append(position)
        if len(past) > _KEPT:
            del past[0]
        bound = bounds.acceleration[axis] * self._dt * self._dt * COUNTS
        newest = len(past) - 1
        for n in WINDOWS:
            if newest < 2 * n:
                break
            second = abs(past[newest] - 2 * past[newest - n] + past[newest - 2 * n])
            allowed = bound * n * n + ROUNDING
            if second > allowed * self.largest_acceleration:
                self.largest_acceleration = second / allowed
                if second > allowed + 1e-6:
                    self._violation(now, axis, f"{second} counts from straight over {n} cycles, allowed {allowed:.1f}")

    def _check_heard(self, axis: int, joint: _Joint, position: int, now: int) -> None:
        """A drive that missed frames must not be far behind when it hears again."""
        allowed = self.bounds.velocity[axis] * self._dt * COUNTS + 1
        if joint.heard is not None and abs(position - joint.heard) > allowed:
            self._violation(now, axis, f"the drive hears {position}, and heard {joint.heard} before that")
        joint.heard = position

    def _check_velocity(self, axis: int, joint: _Joint, velocity: int, answered: bool, now: int) -> None:
        """In CSV the velocity itself is on the wire, with what pulls the joint back to its position."""
        bounds, past = self.bounds, joint.velocities
        bound = bounds.velocity[axis] * COUNTS + 1
        if abs(velocity) > bound:
            self._violation(now, axis, f"target velocity {velocity}, allowed {bound:.0f}")
        if not answered:
            return
        past.append(velocity)
        if len(past) > _KEPT:
            del past[0]
        newest = len(past) - 1
        for n in WINDOWS:
            if newest < n:
                break
            change = abs(past[newest] - past[newest - n])
            allowed = bounds.acceleration[axis] * n * self._dt * COUNTS + ROUNDING
            self.largest_acceleration = max(self.largest_acceleration, change / allowed)
            if change > allowed:
                self._violation(
                    now, axis, f"target velocity changes by {change:.0f} in {n} cycles, allowed {allowed:.0f}"
                )

    def _check_torque(self, axis: int, torque: int, now: int) -> None:
        bound = self.bounds.torque[axis] * COUNTS + 1
        if abs(torque) > bound:
            self._violation(now, axis, f"target torque {torque}, allowed {bound:.0f}")

    def _check_zones(self, now: int) -> None:
        self._look_again -= 1
        if self._look_again > 0:
            return
        bounds = self.bounds
        q = [joint.positions[-1] / COUNTS for joint in self._joints]
        inner = [max(-gap for gap in box_gaps(q, box)) for box in bounds.keep_out]
        inner.append(-own_gap(q))
        if bounds.box is not None:
            inner.append(-depth(points(q)[0], bounds.box))
        deepest = max(inner)
        if deepest > ZONE_TOLERANCE_M and self._excused:
            # The arm was enabled in there: it is not to be checked until it is out.
            self._look_again = 1
            return
        self._excused = False
        if deepest > ZONE_TOLERANCE_M:
            which = inner.index(deepest)
            names = [
                *(f"in keep-out box {n}" for n in range(len(bounds.keep_out))),
                "in another body",
                "outside the box",
            ]
            self._violation(now, -1, f"a body is {deepest * 1e3:.1f} mm {names[which]}")
            self._look_again = 50
            return
        # Nothing is nearer than -deepest: until it can have moved so far nothing is to be looked at.
        fastest = sum(v * reach for v, reach in zip(bounds.velocity, REACH, strict=True)) * self._dt
        self._look_again = int(-deepest / fastest)
