"""Jogging: the tool moves at the commanded velocity until the command expires.

The commanded twist passes through `TwistRamp` (Cartesian acceleration and jerk); `JogBounds` removes what joint ranges,
boxes and singularities do not allow; the inverse Jacobian (`JogInverse`) converts it to joint speeds; `ScaledTwist`
scales all joints together, so that the tool keeps its direction. If joints cannot follow, the ramp continues from the
velocity reached: no windup. The tool's drift off its line, some 1e-7 m a cycle, is corrected in the next cycles.

Near a singularity the joint whose speed would be unbounded is locked, and the tool keeps its other directions. Joint
motion bends a stretched elbow (`jog_inverse.bend`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final

from kinematics.forward import frames
from kinematics.jacobian import jacobian_columns
from kinematics.pose import Pose, Rotation, applied, times
from rtcp.config.model import CartesianConfig
from rtcp.ipc.commands import Command, Jog
from rtcp.ipc.events import NoSolution
from rtcp.ipc.refusals import JogSpeedOutOfRange, NoGeometry, Refusal
from rtcp.ipc.schema import HELD_SPEED_AT
from rtcp.ipc.states import JogFrame
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.controllers.jog_bounds import JogBounds, stopping
from rtcp.motion.controllers.jog_inverse import ELBOW, JogInverse, bend
from rtcp.motion.controllers.velocity import VelocityController
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase, Setpoint

FOREVER_NS = 1 << 62
_FULL: Final = 0.98
"""Share of the joint speeds and accelerations that jogging uses, so that the guard never cuts."""
_LAST_RAD: Final = 1e-6
_BRAKING: Final = 0.7
"""Share of the Cartesian accelerations with which the tool slows before a box or a cone."""
_BACK_1_S: Final = 100.0
"""Gain of the tool's return to its line, 1/s."""
_OFF_LINE_M: Final = 2e-4
"""Drift beyond which the line starts again at the tool, m."""
_AT_REST: Final = 2e-3
"""Speed below which the tool counts as at rest, m/s, rad/s."""


class JogController(Controller):
    """Accepts `Jog`, and is commanded by the joystick (`start`, `command`).

    Without geometry it jogs joints only; without a spherical wrist the tool cannot be jogged.
    """

    name = "jog"
    commands = (Jog,)
    tolerates_saturation = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        cartesian, limits = setup.config.cartesian, setup.limits
        self._velocity = VelocityController(setup)
        self._by_joints = False
        self._models = setup.config.models
        self.has_geometry = bool(self._models)
        if not self.has_geometry:
            return
        singularity = cartesian.singularity
        self._trajectory_guard = setup.trajectory_guard
        nearest = (singularity.shoulder, singularity.elbow, singularity.wrist)
        braking, turning = _BRAKING * cartesian.acceleration, _BRAKING * cartesian.angular_acceleration
        zones_of = setup.trajectory_guard.zones_of
        self._inverses = [JogInverse(model) for model in self._models]
        self._bounds_of = [
            JogBounds(limits, zones_of(number), inverse, braking, turning, nearest, setup.period_s)
            for number, inverse in enumerate(self._inverses)
        ]
        self.use_tool(setup.tool.number)
        self._ramp = TwistRamp(cartesian)
        self._speed, self._angular_speed = cartesian.speed, cartesian.angular_speed
        self._commanded = [0.0] * 6
        self._wanted = [0.0] * 6
        self._scaled = ScaledTwist(limits)
        self._in_tool = False
        self._until_ns = FOREVER_NS
        self._line: Pose | None = None
        self._fresh = True
        self._last = [0.0] * 6
        self._posed = False
        self._wrist = singularity.wrist

    def use_tool(self, number: int) -> None:
        """Switch to another tool; at rest."""
        if self.has_geometry:
            self._model, self._inverse = self._models[number], self._inverses[number]
            self._bounds = self._bounds_of[number]

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Move the tool or the joints at the velocities until they expire."""
        assert isinstance(command, Jog)
        continues = continues and self.phase is Phase.MOVE and self._by_joints is (command.frame is JogFrame.JOINTS)
        if command.frame is JogFrame.JOINTS:
            refusal = self._velocity.ramp_to(command.velocity, command.hold_s, state, continues)
            if refusal is None and not continues:
                self.begin()
                self._by_joints = True
            return refusal
        if not self.has_geometry:
            return NoGeometry()
        bounds = (self._speed,) * 3 + (self._angular_speed,) * 3
        refusal = self.not_within(command.velocity, bounds, command.hold_s, JogSpeedOutOfRange)
        if refusal is not None:
            return refusal
        if not continues:
            self.start()
        until_ns = state.now_ns + round(command.hold_s * 1e9)
        self.command(command.velocity, in_tool_frame=command.frame is JogFrame.TOOL, until_ns=until_ns)
        return None

    def start(self) -> None:
        """Start jogging the tool, at velocity 0."""
        self.begin()
        self._by_joints = False
        self._commanded[:] = self._zero
        self._until_ns = FOREVER_NS
        self._fresh = True

    def command(self, twist: Sequence[float], *, in_tool_frame: bool, until_ns: int = FOREVER_NS) -> None:
        """Move the tool at vx, vy, vz (m/s), wx, wy, wz (rad/s) along the axes of its own frame or of the base.

        The twist is valid until `until_ns`. It is scaled down to the configured speed limits; numbers that are not
        finite stop the tool. Ignored during a stop: call `start` again.
        """
        if self.phase is not Phase.MOVE:
            return
        self._until_ns = until_ns
        self._in_tool = in_tool_frame
        a, b, c, d, e, f = twist
        linear, angular = a * a + b * b + c * c, d * d + e * e + f * f
        commanded = self._commanded
        if not linear + angular < 1e30:
            commanded[:] = self._zero
            return
        part, rotation_part = 1.0, 1.0
        if linear > self._speed * self._speed:
            part = self._speed / linear**0.5
        if angular > self._angular_speed * self._angular_speed:
            rotation_part = self._angular_speed / angular**0.5
        # One factor for both keeps the commanded direction.
        part = part if part < rotation_part else rotation_part
        for i in range(6):
            commanded[i] = part * twist[i]

    def stop(self, state: ArmState) -> None:
        """Come to rest; the tool keeps its direction."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            if self._by_joints:
                self._velocity.stop(state)
            else:
                self._commanded[:] = self._zero

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        if self._by_joints:
            setpoint = self._velocity.update(state)
            self.phase, self.ended, self.held = self._velocity.phase, self._velocity.ended, self._velocity.held
            return setpoint
        position, dt = state.commanded, self.period_s
        if state.now_ns > self._until_ns and self.phase is Phase.MOVE:
            self.stop(state)
        inverse, bounds, ramp, joints = self._inverse, self._bounds, self._ramp, self._scaled
        jumped = self._fresh or position != self._last
        poses = self._trajectory_guard.poses
        if jumped or not self._posed:
            poses = frames(self._model, position)
        if not (inverse.usable and inverse.at(poses)):
            return self._stand(state)
        if jumped:
            # At the start, or after a guard changed the setpoint: continue from the commanded position.
            ramp.begin(_reached(poses, state.commanded_velocity))
            self._line = None
            self._fresh = False
        wanted = self._turned(poses[6])
        ramp.step(wanted, dt)
        bounds.update(poses, position, jumped)
        twist, speeds = joints.twist, joints.speeds
        twist[:] = ramp.velocity
        self._fit(poses, wanted)
        if inverse.locked[ELBOW]:
            bend(inverse, poses, position, wanted, speeds, self.limits, self._wrist)
        self._back(poses[6])
        if joints.limit(state, dt):
            self._advance(dt, poses[6])
            ramp.cut_to(twist)
        else:
            self._line = None
            ramp.cut_to(_reached(poses, speeds))
        moving = any(speeds)
        self._posed = moving and bounds.watched
        self.held = bounds.held | (joints.slowest + 1) << HELD_SPEED_AT
        if not moving and not any(wanted) and not any(ramp.velocity):
            self.phase = Phase.HOLD
        return self._answer(position, dt)

    def _answer(self, position: Sequence[float], dt: float) -> Setpoint:
        target, speeds = self.setpoint, self._scaled.speeds
        target.position = self._last = [q + v * dt for q, v in zip(position, speeds, strict=True)]
        target.velocity = speeds
        return target

    def _turned(self, tool: Pose) -> list[float]:
        """Return the commanded twist along the base's axes, scaled by the speed override."""
        commanded, wanted, fraction = self._commanded, self._wanted, self.speed_override.fraction
        if fraction != 1.0:
            for i in range(6):
                wanted[i] = fraction * commanded[i]
            commanded = wanted
        if not self._in_tool:
            return commanded
        a, b, c, d, e, f = commanded
        wanted[0], wanted[1], wanted[2] = applied(tool.rotation, (a, b, c))
        wanted[3], wanted[4], wanted[5] = applied(tool.rotation, (d, e, f))
        return wanted

    def _fit(self, poses: Sequence[Pose], wanted: Sequence[float]) -> None:
        """Reduce the twist and its joint speeds to all bounds."""
        joints, bounds, rows = self._scaled, self._bounds, self._inverse.rows
        twist = joints.twist
        joints.make(rows)
        if bounds.passed(poses, twist, joints.speeds):
            a, b, c, d, e, f = twist
            moves = any(wanted[:3]) or a * a + b * b + c * c > _AT_REST * _AT_REST
            rotates = any(wanted[3:]) or d * d + e * e + f * f > _AT_REST * _AT_REST
            if not bounds.slide(poses, twist, moves, rotates):
                twist[:] = self._zero
            joints.make(rows)
        joints.scale(bounds.halt(twist))
        if bounds.near:
            joints.scale(bounds.stoppable(poses, joints.speeds))

    def _back(self, tool: Pose) -> None:
        """Correct the joint speeds towards the tool's line."""
        line = self._line
        if line is None or self._bounds.axis >= 0:
            return
        (x, y, z), (a, b, c, d, e, f, g, h, i) = line
        (u, v, w), (j, k, m, n, o, p, q, r, s) = tool
        # Half the sum of the cross products of the axes: the rotation error.
        dx, dy, dz = x - u, y - v, z - w
        tx = 0.5 * (n * g - q * d + o * h - r * e + p * i - s * f)
        ty = 0.5 * (q * a - j * g + r * b - k * h + s * c - m * i)
        tz = 0.5 * (j * d - n * a + k * e - o * b + m * f - p * c)
        if dx * dx + dy * dy + dz * dz + tx * tx + ty * ty + tz * tz > _OFF_LINE_M * _OFF_LINE_M:
            self._line = None
            return
        speeds, fastest = self._scaled.speeds, self.limits.velocity
        for at, (row0, row1, row2, row3, row4, row5) in enumerate(self._inverse.rows):
            v = speeds[at] + _BACK_1_S * (row0 * dx + row1 * dy + row2 * dz + row3 * tx + row4 * ty + row5 * tz)
            most = fastest[at]
            speeds[at] = most if v > most else -most if v < -most else v

    def _advance(self, dt: float, tool: Pose) -> None:
        """Advance the line by the tool's motion in this cycle."""
        twist = self._scaled.twist
        if self._inverse.lost or self._bounds.axis >= 0 or not any(twist):
            self._line = None
            return
        (x, y, z), rotation = tool if self._line is None else self._line
        a, b, c, d, e, f = twist
        if d or e or f:
            rotation = times(_small_rotation(d * dt, e * dt, f * dt), rotation)
        self._line = Pose((x + a * dt, y + b * dt, z + c * dt), rotation)

    def _stand(self, state: ArmState) -> Setpoint:
        """Brake each joint on its own: there is no inverse."""
        speeds = self._scaled.speeds
        speeds[:] = self._zero
        self._scaled.clip(state.commanded_velocity, _FULL * self.period_s)
        self._line = None
        self._fresh = True
        self._posed = False
        self.ended = NoSolution()
        if not any(speeds) and (self.phase is Phase.STOP or not any(self._commanded)):
            self.phase = Phase.HOLD
        return self._answer(state.commanded, self.period_s)


def _reached(poses: Sequence[Pose], speeds: Sequence[float]) -> list[float]:
    """Return the tool twist at joint speeds."""
    twist = [0.0] * 6
    if any(speeds):
        for v, column in zip(speeds, jacobian_columns(poses), strict=True):
            for i in range(6):
                twist[i] += v * column[i]
    return twist


def _small_rotation(x: float, y: float, z: float) -> Rotation:
    """Rotation by a small vector (rad): Rodrigues' formula to second order, orthonormal to 1e-12 over a cycle."""
    angle2 = x * x + y * y + z * z
    half = 0.5 - angle2 / 24.0
    sine = 1.0 - angle2 / 6.0
    return (
        1.0 - half * (y * y + z * z), half * x * y - sine * z, half * x * z + sine * y,
        half * x * y + sine * z, 1.0 - half * (x * x + z * z), half * y * z - sine * x,
        half * x * z - sine * y, half * y * z + sine * x, 1.0 - half * (x * x + y * y),
    )  # fmt: skip


class TwistRamp:
    """`velocity`: vx, vy, vz (m/s), wx, wy, wz (rad/s) along the base's axes; `step` moves it towards a goal.

    All six change in proportion, so that the tool keeps its direction from rest and to rest.

    Args:
        config: accelerations and jerks.
    """

    def __init__(self, config: CartesianConfig) -> None:
        self._linear, self._angular = 1.0 / config.acceleration, 1.0 / config.angular_acceleration
        self._rise = max(config.acceleration / config.jerk, config.angular_acceleration / config.angular_jerk)
        self._weight = (self._linear / self._angular) ** 2
        self.velocity = [0.0] * 6
        self.acceleration = [0.0] * 6

    def begin(self, velocity: Sequence[float]) -> None:
        """Begin with a velocity, without acceleration."""
        self.velocity[:] = velocity
        for i in range(6):
            self.acceleration[i] = 0.0

    def step(self, wanted: Sequence[float], dt: float) -> None:
        """Advance one cycle towards `wanted`."""
        v, acc = self.velocity, self.acceleration
        if v == wanted:
            for i in range(6):
                acc[i] = 0.0
            return
        a, b, c = wanted[0] - v[0], wanted[1] - v[1], wanted[2] - v[2]
        d, e, f = wanted[3] - v[3], wanted[4] - v[4], wanted[5] - v[5]
        time = max(sqrt(a * a + b * b + c * c) * self._linear, sqrt(d * d + e * e + f * f) * self._angular)
        rise = dt / self._rise
        if time <= 2.0 * dt * rise:
            v[:] = wanted
            for i in range(6):
                acc[i] = 0.0
            return
        # At constant jerk the acceleration falls with the root of the remaining difference.
        full = sqrt(1.6 * time / self._rise)
        full = (1.0 if full > 1.0 else full) / time
        if full * dt > 0.5:
            full = 0.5 / dt
        a, b, c = a * full - acc[0], b * full - acc[1], c * full - acc[2]
        d, e, f = d * full - acc[3], e * full - acc[4], f * full - acc[5]
        change = max(sqrt(a * a + b * b + c * c) * self._linear, sqrt(d * d + e * e + f * f) * self._angular)
        part = rise / change if change > rise else 1.0
        for i, more in enumerate((a, b, c, d, e, f)):
            acc[i] += part * more
            v[i] += acc[i] * dt

    def cut_to(self, velocity: Sequence[float]) -> None:
        """Set the velocity to its bounded value; drop the acceleration against the bound."""
        v, acc, weight = self.velocity, self.acceleration, self._weight
        a, b, c = velocity[0] - v[0], velocity[1] - v[1], velocity[2] - v[2]
        d, e, f = velocity[3] - v[3], velocity[4] - v[4], velocity[5] - v[5]
        v[:] = velocity
        size = a * a + b * b + c * c + (d * d + e * e + f * f) / weight
        if size < 1e-24:
            return
        along = a * acc[0] + b * acc[1] + c * acc[2] + (d * acc[3] + e * acc[4] + f * acc[5]) / weight
        if along < 0.0:
            part = along / size
            for i, more in enumerate((a, b, c, d, e, f)):
                acc[i] -= part * more


class ScaledTwist:
    """A twist (m/s, rad/s; six, along the base's axes) and its joint speeds (rad/s, six), scaled to the joint limits.

    Args:
        limits: of the joints; read every cycle.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self.twist = [0.0] * 6
        self.speeds = [0.0] * 6
        self.slowest = -1
        """Joint whose speed limit scaled the last twist down; -1: none."""

    def make(self, rows: Sequence[Sequence[float]]) -> None:
        """Compute the joint speeds of the twist; scale both to the joint speed limits.

        Args:
            rows: of the inverse Jacobian, shape (6, 6).
        """
        a, b, c, d, e, f = self.twist
        speeds, fastest = self.speeds, self._limits.velocity
        part = 1.0
        self.slowest = -1
        for i, (g, h, k, m, n, o) in enumerate(rows):
            speeds[i] = v = a * g + b * h + c * k + d * m + e * n + f * o
            most = _FULL * fastest[i]
            if v * part > most or v * part < -most:
                part = most / (v if v > 0.0 else -v)
                self.slowest = i
        self.scale(part)

    def scale(self, part: float) -> None:
        """Multiply twist and joint speeds by `part` if it is less than 1."""
        if part < 1.0:
            twist, speeds = self.twist, self.speeds
            for i in range(6):
                twist[i] *= part
                speeds[i] *= part

    def limit(self, state: ArmState, dt: float) -> bool:
        """Limit the joint speeds, and the twist with them, to the accelerations possible after `state`.

        Returns:
            True if one factor scales all joints, so that the tool keeps its direction. If no factor exists, each joint
                moves towards its speed at its own acceleration limit.
        """
        speeds, last, limits = self.speeds, state.commanded_velocity, self._limits
        acceleration = limits.acceleration
        step = _FULL * dt
        together = True
        for i in range(6):
            change, most = speeds[i] - last[i], step * acceleration[i]
            if change > most or change < -most:
                together = self._scaled_together(last, step)
                break
        q, low, high, fastest = state.commanded, limits.low, limits.high, limits.velocity
        for i in range(6):
            v, rate, most = speeds[i], acceleration[i], fastest[i]
            if v > most or v < -most:
                least = abs(last[i]) - step * rate
                most = max(most, least)
                speeds[i] = v = most if v > most else -most if v < -most else v
                together = False
            stopping_distance = high[i] - q[i] if v > 0.0 else q[i] - low[i]
            if v * v > 1.8 * rate * stopping_distance:
                most = stopping(stopping_distance - _LAST_RAD, rate, dt)
                least = abs(last[i]) - step * rate if v * last[i] > 0.0 else 0.0
                most = max(most, least)
                if v > most or v < -most:
                    speeds[i] = most if v > 0.0 else -most
                    together = False
        return together

    def _scaled_together(self, last: Sequence[float], step: float) -> bool:
        speeds, acceleration = self.speeds, self._limits.acceleration
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
            self.clip(last, step)
            return False
        # Above 1: brake at the joint limits.
        factor = low if low > 1.0 else high if high < 1.0 else 1.0
        twist = self.twist
        for i in range(6):
            speeds[i] *= factor
            twist[i] *= factor
        return True

    def clip(self, last: Sequence[float], step: float) -> None:
        """Limit each joint's speed to acceleration x `step` (s) around its `last` (rad/s), regardless of the twist."""
        speeds, acceleration = self.speeds, self._limits.acceleration
        for i in range(6):
            most = step * acceleration[i]
            v, w = speeds[i], last[i]
            speeds[i] = w + most if v > w + most else w - most if v < w - most else v
