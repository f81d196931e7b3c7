"""Jogging: the tool goes where it is told to, for as long as it is told to.

What is asked for becomes a tool velocity under Cartesian acceleration and jerk (`JogRamp`); what the joint ranges, the
boxes and the singularities do not allow is taken from it (`JogBounds`); the inverse Jacobian makes it joint speeds
(`JogInverse`), and what the tool has lost of its line, some 1e-7 m a cycle, comes back with the next ones. All joints
are scaled together, so that the tool keeps its direction; where they cannot follow, it waits, and the ramp goes on from
what was reached. Nothing winds up.

Beside a singularity the joint that would have to move without bound is locked, and the tool goes where it still can. A
stretched elbow is bent by its joints (`_bend`).
"""

from __future__ import annotations

from collections.abc import Sequence

from kinematics.forward import frames
from kinematics.jacobian import jacobian_columns
from kinematics.model import ArmModel
from kinematics.pose import Pose, Rotation, applied, times
from rtcp.config.model import ArmConfig
from rtcp.motion.envelope import SetPointGuard
from rtcp.motion.jog_bounds import JogBounds, stopping
from rtcp.motion.jog_inverse import ELBOW, SHOULDER, WRIST, JogInverse
from rtcp.motion.jog_ramp import JogRamp
from rtcp.motion.limits import Limits
from rtcp.motion.state import MotionState, Phase, Reason, Target

FOR_EVER = 1 << 62
_FULL = 0.98
"""Part of the joints' speeds and accelerations that jogging uses: the guard never has to cut."""
_BRAKING = 0.7
"""Part of the Cartesian acceleration with which the tool slows before a box."""
_BACK_1_S = 100.0
"""How fast the tool returns to its line, 1/s."""
_OFF_LINE_M = 2e-4
"""Further away from it the line begins anew."""
_INWARD_M_S = 1e-3
"""An elbow that is stretched bends where the tool is wanted to come inwards faster than this."""
_STRAIGHT_RAD = 1e-9
_BENDING = 0.4
"""Part of the joints' speeds with which it bends."""
_LOST = 1e-3
_LAST_RAD = 1e-6
_AT_REST = 2e-3
"""m/s, rad/s: what is slower is not taken for a motion that is wanted."""


class JogMode:
    """The mode `jog`, for a stick and for commands.

    Args:
        config: Cartesian and jog limits; it must have a geometry.
        model: the geometry; without a spherical wrist the arm stands.
        limits: of the joints; read every cycle.
        guards: knows the boxes and the frames of what is commanded.
        period_s: the cycle, s.
    """

    def __init__(
        self, config: ArmConfig, model: ArmModel, limits: Limits, guards: SetPointGuard, period_s: float
    ) -> None:
        cartesian = config.cartesian
        singularity = cartesian.singularity
        self._model = model
        self._limits = limits
        self._guards = guards
        self._inverse = JogInverse(model)
        nearest = (singularity.shoulder, singularity.elbow, singularity.wrist)
        braking = _BRAKING * cartesian.acceleration
        self._bounds = JogBounds(limits, guards, self._inverse, braking, nearest, period_s)
        self._ramp = JogRamp(cartesian)
        self._speed, self._angular_speed = cartesian.speed, cartesian.angular_speed
        self._zero = [0.0] * 6
        self._target = Target(6)
        self._asked = [0.0] * 6
        self._wanted = [0.0] * 6
        self._twist = [0.0] * 6
        self._speeds = [0.0] * 6
        self._in_tool = False
        self._until_ns = FOR_EVER
        self._line: Pose | None = None
        self._fresh = True
        self._last = [0.0] * 6
        self._posed = False
        self._wrist = singularity.wrist
        self.clamps = True
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: MotionState) -> None:
        """Begin at `state`; nothing is asked for yet."""
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self._asked[:] = self._zero
        self._until_ns = FOR_EVER
        self._fresh = True

    def command(self, twist: Sequence[float], frame: str, until_ns: int = FOR_EVER) -> None:
        """Ask for a tool velocity: vx, vy, vz (m/s), wx, wy, wz (rad/s) along the axes of `frame` (base or tool).

        It counts until the instant `until_ns`. It is brought down to the greatest speeds of the configuration; numbers
        that are none stop. While the mode stops nothing is taken: a stop that has ended is begun anew with `start`.
        """
        if self.phase is not Phase.MOVE:
            return
        self._until_ns = until_ns
        self._in_tool = frame == "tool"
        a, b, c, d, e, f = twist
        linear, angular = a * a + b * b + c * c, d * d + e * e + f * f
        asked = self._asked
        if not linear + angular < 1e30:
            asked[:] = self._zero
            return
        part, turn = 1.0, 1.0
        if linear > self._speed * self._speed:
            part = self._speed / linear**0.5
        if angular > self._angular_speed * self._angular_speed:
            turn = self._angular_speed / angular**0.5
        # One factor for both, so that the direction is the one that was asked for.
        part = part if part < turn else turn
        for i in range(6):
            asked[i] = part * twist[i]

    def stop(self, state: MotionState) -> None:
        """Come to rest."""
        if self.phase is Phase.MOVE:
            self._asked[:] = self._zero
            self.phase = Phase.STOP

    def update(self, state: MotionState, dt: float) -> Target:
        """Return the set-points of the next cycle."""
        target = self._target
        position = state.position
        if not self.phase:
            target.position, target.velocity = position, self._zero
            return target
        if state.now_ns > self._until_ns and self.phase is Phase.MOVE:
            self.stop(state)
        inverse, bounds, ramp = self._inverse, self._bounds, self._ramp
        jumped = self._fresh or position != self._last
        poses = self._guards.poses
        if jumped or not self._posed:
            poses = frames(self._model, position)
        if not (inverse.usable and inverse.at(poses)):
            return self._brake(state, dt)
        if jumped:
            # The beginning, or the guards have changed what was commanded: go on from where the arm is.
            ramp.begin(_reached(poses, state.velocity))
            self._line = None
            self._fresh = False
        wanted = self._turned(poses[6])
        ramp.step(wanted, dt)
        bounds.look(poses, position, jumped)
        twist, speeds = self._twist, self._speeds
        twist[:] = ramp.velocity
        self._fit(poses, wanted)
        if inverse.locked[ELBOW]:
            self._bend(poses, position, wanted)
        self._back(poses[6])
        if self._follow(state, dt):
            self._advance(dt, poses[6])
            ramp.held(twist)
        else:
            self._line = None
            ramp.held(_reached(poses, speeds))
        moving = any(speeds)
        self._posed = moving and bounds.watched
        if not moving and not any(wanted) and not any(ramp.velocity):
            self.phase = Phase.HOLD
        return self._answer(position, dt)

    def _answer(self, position: Sequence[float], dt: float) -> Target:
        target, speeds = self._target, self._speeds
        target.position = self._last = [q + v * dt for q, v in zip(position, speeds, strict=True)]
        target.velocity = speeds
        return target

    def _turned(self, tool: Pose) -> list[float]:
        """Return what is wanted along the base's axes."""
        asked = self._asked
        if not self._in_tool:
            return asked
        a, b, c, d, e, f = asked
        wanted = self._wanted
        wanted[0], wanted[1], wanted[2] = applied(tool.rotation, (a, b, c))
        wanted[3], wanted[4], wanted[5] = applied(tool.rotation, (d, e, f))
        return wanted

    def _make_speeds(self) -> float:
        """Write the joint speeds for the twist; return the part of them that the joints can do."""
        a, b, c, d, e, f = self._twist
        speeds, fastest = self._speeds, self._limits.velocity
        part = 1.0
        for i, (g, h, k, m, n, o) in enumerate(self._inverse.rows):
            speeds[i] = v = a * g + b * h + c * k + d * m + e * n + f * o
            most = _FULL * fastest[i]
            if v * part > most or v * part < -most:
                part = most / (v if v > 0.0 else -v)
        return part

    def _scale(self, part: float) -> None:
        if part < 1.0:
            twist, speeds = self._twist, self._speeds
            for i in range(6):
                twist[i] *= part
                speeds[i] *= part

    def _fit(self, poses: Sequence[Pose], wanted: Sequence[float]) -> None:
        """Bring the twist, and the joint speeds with it, within all bounds."""
        twist, bounds = self._twist, self._bounds
        self._scale(self._make_speeds())
        if bounds.passed(poses, twist, self._speeds):
            a, b, c, d, e, f = twist
            moves = any(wanted[:3]) or a * a + b * b + c * c > _AT_REST * _AT_REST
            turns = any(wanted[3:]) or d * d + e * e + f * f > _AT_REST * _AT_REST
            if not bounds.slide(poses, twist, moves, turns):
                twist[:] = self._zero
            self._scale(self._make_speeds())
        self._scale(bounds.halt(twist))
        if bounds.near:
            self._scale(bounds.stoppable(poses, self._speeds))

    def _back(self, tool: Pose) -> None:
        """Add to the joint speeds what brings the tool back to its line."""
        line = self._line
        if line is None or self._bounds.axis >= 0:
            return
        (x, y, z), (a, b, c, d, e, f, g, h, i) = line
        (u, v, w), (j, k, m, n, o, p, q, r, s) = tool
        # Half the sum of the cross products of the axes: the rotation that is missing.
        dx, dy, dz = x - u, y - v, z - w
        tx = 0.5 * (n * g - q * d + o * h - r * e + p * i - s * f)
        ty = 0.5 * (q * a - j * g + r * b - k * h + s * c - m * i)
        tz = 0.5 * (j * d - n * a + k * e - o * b + m * f - p * c)
        if dx * dx + dy * dy + dz * dz + tx * tx + ty * ty + tz * tz > _OFF_LINE_M * _OFF_LINE_M:
            self._line = None
            return
        speeds, fastest = self._speeds, self._limits.velocity
        for at, (row0, row1, row2, row3, row4, row5) in enumerate(self._inverse.rows):
            v = speeds[at] + _BACK_1_S * (row0 * dx + row1 * dy + row2 * dz + row3 * tx + row4 * ty + row5 * tz)
            most = fastest[at]
            speeds[at] = most if v > most else -most if v < -most else v

    def _follow(self, state: MotionState, dt: float) -> bool:
        """Bring the joint speeds, and the twist with them, within what the accelerations allow.

        Returns:
            Whether all joints are scaled by one factor, so that the tool keeps its direction. Where there is none, each
                goes towards its speed as fast as it may; so it does, too, where its limits leave no more.
        """
        speeds, last, limits = self._speeds, state.velocity, self._limits
        acceleration = limits.acceleration
        step = _FULL * dt
        together = True
        for i in range(6):
            change, most = speeds[i] - last[i], step * acceleration[i]
            if change > most or change < -most:
                together = self._scaled_together(last, step)
                break
        q, low, high, fastest = state.position, limits.low, limits.high, limits.velocity
        for i in range(6):
            v, rate, most = speeds[i], acceleration[i], fastest[i]
            if v > most or v < -most:
                least = abs(last[i]) - step * rate
                most = max(most, least)
                speeds[i] = v = most if v > most else -most if v < -most else v
                together = False
            room = high[i] - q[i] if v > 0.0 else q[i] - low[i]
            if v * v > 1.8 * rate * room:
                most = stopping(room - _LAST_RAD, rate, dt)
                least = abs(last[i]) - step * rate if v * last[i] > 0.0 else 0.0
                most = max(most, least)
                if v > most or v < -most:
                    speeds[i] = most if v > 0.0 else -most
                    together = False
        return together

    def _scaled_together(self, last: Sequence[float], step: float) -> bool:
        speeds, acceleration = self._speeds, self._limits.acceleration
        low, high = 0.0, 1e9
        for i in range(6):
            v, w, most = speeds[i], last[i], step * acceleration[i]
            if v > 1e-12:
                least, greatest = (w - most) / v, (w + most) / v
            elif v < -1e-12:
                least, greatest = (w + most) / v, (w - most) / v
            elif -most <= w <= most:
                continue
            else:
                high = -1.0
                break
            low, high = max(low, least), min(high, greatest)
        if low > high:
            self._clip(last, step)
            return False
        # Above 1 it brakes as fast as the joints can.
        factor = low if low > 1.0 else high if high < 1.0 else 1.0
        twist = self._twist
        for i in range(6):
            speeds[i] *= factor
            twist[i] *= factor
        return True

    def _clip(self, last: Sequence[float], step: float) -> None:
        speeds, acceleration = self._speeds, self._limits.acceleration
        for i in range(6):
            most = step * acceleration[i]
            v, w = speeds[i], last[i]
            speeds[i] = w + most if v > w + most else w - most if v < w - most else v

    def _advance(self, dt: float, tool: Pose) -> None:
        """Let the line go on with what the tool does in this cycle."""
        twist = self._twist
        if self._inverse.lost or self._bounds.axis >= 0 or not any(twist):
            self._line = None
            return
        (x, y, z), rotation = tool if self._line is None else self._line
        a, b, c, d, e, f = twist
        if d or e or f:
            rotation = times(_turn(d * dt, e * dt, f * dt), rotation)
        self._line = Pose((x + a * dt, y + b * dt, z + c * dt), rotation)

    def _bend(self, poses: Sequence[Pose], position: Sequence[float], wanted: Sequence[float]) -> None:
        """Bend a stretched (or open a folded) elbow, where the tool is to go that way.

        The joints then move as they can without moving the tool, to first order: joint 2 takes back what joint 3 does
        to the wrist centre, and the hand keeps its direction. To second order the tool goes the only way that it can.
        """
        inverse, speeds, limits = self._inverse, self._speeds, self._limits
        row = inverse.lost[1 if inverse.locked[SHOULDER] else 0]
        x, y, z = row[:3]
        (px, py, pz), (wx, wy, wz) = poses[1].position, poses[4].position
        outward = sum(one * other for one, other in zip(row, wanted, strict=True))
        if (x * (wx - px) + y * (wy - py) + z * (wz - pz) < 0.0) is inverse.stretched:
            outward = -outward
        if outward > -_INWARD_M_S:
            return
        way = inverse.bend
        if -_STRAIGHT_RAD < way < _STRAIGHT_RAD:
            way = 1.0 if limits.high[2] - position[2] >= position[2] - limits.low[2] else -1.0
        elif not inverse.stretched:
            way = -way
        third = 1.0 if way > 0.0 else -1.0
        _, (a, b, c), (d, e, f) = inverse.arm
        second = -third * (a * d + b * e + c * f) / (a * a + b * b + c * c)
        _, _, x2, _, _, y2, _, _, z2 = poses[1].rotation
        _, _, x3, _, _, y3, _, _, z3 = poses[2].rotation
        x, y, z = -second * x2 - third * x3, -second * y2 - third * y3, -second * z2 - third * z3
        ox, oy, oz = inverse.to_centre
        # The twist that turns the hand about the wrist centre.
        hand = (-y * oz + z * oy, -z * ox + x * oz, -x * oy + y * ox, x, y, z)
        wrist = [sum(one * other for one, other in zip(inverse.rows[i], hand, strict=True)) for i in (3, 4, 5)]
        if inverse.locked[WRIST]:
            lost = sum(one * other for one, other in zip(inverse.lost[-1], hand, strict=True))
            if abs(lost) > _LOST:
                return
        elif inverse.distance[WRIST] < self._wrist and wrist[1] * inverse.wrist_sign < 0.0:
            return
        rate = 1.0
        for i, v in enumerate((0.0, second, third, *wrist)):
            if abs(v) * rate > _BENDING * limits.velocity[i]:
                rate = _BENDING * limits.velocity[i] / abs(v)
        for i, v in enumerate((0.0, second, third, *wrist)):
            speeds[i] += rate * v

    def _brake(self, state: MotionState, dt: float) -> Target:
        """Each joint brakes as fast as it may: there is no inverse."""
        speeds = self._speeds
        speeds[:] = self._zero
        self._clip(state.velocity, _FULL * dt)
        self._line = None
        self._fresh = True
        self._posed = False
        self.reason = Reason.NO_SOLUTION
        if not any(speeds) and (self.phase is Phase.STOP or not any(self._asked)):
            self.phase = Phase.HOLD
        return self._answer(state.position, dt)


def _reached(poses: Sequence[Pose], speeds: Sequence[float]) -> list[float]:
    """Return the tool velocity of joint speeds."""
    twist = [0.0] * 6
    if any(speeds):
        for v, column in zip(speeds, jacobian_columns(poses), strict=True):
            for i in range(6):
                twist[i] += v * column[i]
    return twist


def _turn(x: float, y: float, z: float) -> Rotation:
    """Rotation by a small vector (rad): Rodrigues' formula to second order, orthonormal to 1e-12 for a cycle's turn."""
    angle2 = x * x + y * y + z * z
    half = 0.5 - angle2 / 24.0
    one = 1.0 - angle2 / 6.0
    return (
        1.0 - half * (y * y + z * z), half * x * y - one * z, half * x * z + one * y,
        half * x * y + one * z, 1.0 - half * (x * x + z * z), half * y * z - one * x,
        half * x * z - one * y, half * y * z + one * x, 1.0 - half * (x * x + y * y),
    )  # fmt: skip
