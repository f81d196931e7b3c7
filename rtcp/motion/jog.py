"""Jogging: the tool goes where it is told to, for as long as it is told to.

What is asked for becomes a tool velocity under Cartesian acceleration and jerk (`JogRamp`); what the joint ranges, the
boxes and the singularities do not allow is taken from it (`JogBounds`); the inverse Jacobian makes it joint speeds
(`JogInverse`), and what the tool has lost of its line, some 1e-7 m a cycle, comes back with the next ones. All joints
are scaled together, so that the tool keeps its direction; where they cannot follow, it waits, and the ramp goes on from
what was reached. Nothing winds up.

Beside a singularity the joint that would have to move without bound is locked, and the tool goes where it still can. A
stretched elbow bends towards the inverse solution a little further on (`_bend`).
"""

from __future__ import annotations

from collections.abc import Sequence

from kinematics.forward import frames
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import jacobian_columns
from kinematics.model import ArmModel
from kinematics.pose import Pose, Rotation, applied, times
from rtcp.config.model import ArmConfig
from rtcp.motion.envelope import SetPointGuard
from rtcp.motion.jog_bounds import JogBounds
from rtcp.motion.jog_inverse import ELBOW, JogInverse
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
_RETRACTION_M = 2e-4
_BEND_RAD = 0.2
"""So far, at most, the joints are from the solution that a stretched elbow bends towards."""
_TURNS_RAD_S = 1e-3


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
        self._inverse_kinematics = InverseKinematics(model)
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
        if inverse.locked[ELBOW] and self._bend(poses, position, wanted):
            self._follow(state, dt)
            self._line = None
            ramp.held(_reached(poses, speeds))
        else:
            self._fit(poses)
            self._back(poses[6])
            factor = self._follow(state, dt)
            if factor is None:
                self._line = None
                ramp.held(_reached(poses, speeds))
            else:
                self._advance(factor, dt, poses[6])
                ramp.held(twist)
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

    def _fit(self, poses: Sequence[Pose]) -> None:
        """Bring the twist, and the joint speeds with it, within all bounds."""
        twist, bounds = self._twist, self._bounds
        self._scale(self._make_speeds())
        a, b, c, d, e, f = twist
        moves = a * a + b * b + c * c > 1e-12
        turns = d * d + e * e + f * f > _TURNS_RAD_S * _TURNS_RAD_S
        if bounds.passed(poses, twist, self._speeds):
            if not bounds.slide(poses, twist, moves, turns):
                twist[:] = self._zero
            self._scale(self._make_speeds())
        self._scale(bounds.halt(twist))
        if bounds.near:
            self._scale(bounds.stoppable(poses, self._speeds))

    def _back(self, tool: Pose) -> None:
        """Add to the joint speeds what brings the tool back to its line."""
        line = self._line
        if line is None:
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
        speeds = self._speeds
        for at, (row0, row1, row2, row3, row4, row5) in enumerate(self._inverse.rows):
            speeds[at] += _BACK_1_S * (row0 * dx + row1 * dy + row2 * dz + row3 * tx + row4 * ty + row5 * tz)

    def _follow(self, state: MotionState, dt: float) -> float | None:
        """Bring the joint speeds within what the accelerations allow.

        Returns:
            The factor for all of them, with which the tool keeps its direction; None where there was none: each joint
            then goes towards its speed as fast as it may.
        """
        speeds, last, acceleration = self._speeds, state.velocity, self._limits.acceleration
        step = _FULL * dt
        for i in range(6):
            change, most = speeds[i] - last[i], step * acceleration[i]
            if change > most or change < -most:
                break
        else:
            return 1.0
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
                low, high = 1.0, 0.0
                break
            low, high = max(low, least), min(high, greatest)
        if low > high:
            self._clip(last, step)
            return None
        # Above 1 it brakes as fast as the joints can.
        factor = low if low > 1.0 else high if high < 1.0 else 1.0
        for i in range(6):
            speeds[i] *= factor
        return factor

    def _clip(self, last: Sequence[float], step: float) -> None:
        speeds, acceleration = self._speeds, self._limits.acceleration
        for i in range(6):
            most = step * acceleration[i]
            v, w = speeds[i], last[i]
            speeds[i] = w + most if v > w + most else w - most if v < w - most else v

    def _advance(self, factor: float, dt: float, tool: Pose) -> None:
        """Let the line go on with what the tool does in this cycle."""
        twist = self._twist
        if factor != 1.0:
            for i in range(6):
                twist[i] *= factor
        if self._inverse.lost or not any(twist):
            self._line = None
            return
        (x, y, z), rotation = tool if self._line is None else self._line
        a, b, c, d, e, f = twist
        if d or e or f:
            rotation = times(_turn(d * dt, e * dt, f * dt), rotation)
        self._line = Pose((x + a * dt, y + b * dt, z + c * dt), rotation)

    def _bend(self, poses: Sequence[Pose], position: Sequence[float], wanted: Sequence[float]) -> bool:
        """Write joint speeds that bend a stretched (or open a folded) elbow, where the tool is to go that way."""
        inverse = self._inverse
        row = inverse.lost[1 if inverse.locked[0] else 0]
        outward = sum(one * other for one, other in zip(row, wanted, strict=True))
        x, y, z, _, _, _ = row
        (px, py, pz), (wx, wy, wz) = poses[1].position, poses[4].position
        if x * (wx - px) + y * (wy - py) + z * (wz - pz) < 0.0:
            outward = -outward
        inward = -outward if inverse.stretched else outward
        if inward < 1e-3:
            return False
        ahead = _RETRACTION_M / inward
        a, b, c, d, e, f = (component * ahead for component in wanted)
        (x, y, z), rotation = poses[6]
        pose = Pose((x + a, y + b, z + c), times(_turn(d, e, f), rotation))
        found = self._inverse_kinematics.solve_near(pose, position).q
        if found is None:
            return False
        speeds, fastest, distance = self._speeds, self._limits.velocity, inverse.distance
        rate = 1.0 / ahead
        for i in range(6):
            speeds[i] = step = found[i] - position[i]
            size = step if step > 0.0 else -step
            if size > _BEND_RAD:
                return False
            if size * rate > 0.5 * fastest[i]:
                rate = 0.5 * fastest[i] / size
        # Beside a wrist that is singular too, joint 5 may only lead away; the shoulder is not moved sideways by it.
        if not inverse.locked[2] and distance[2] < self._wrist and speeds[4] * inverse.wrist_sign < 0.0:
            return False
        for i in range(6):
            speeds[i] *= rate
        return True

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
