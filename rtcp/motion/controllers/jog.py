"""Jogging: the tool goes where it is told to, for as long as it is told to.

What is asked for becomes a tool velocity under Cartesian acceleration and jerk (`JogRamp`); what the joint ranges, the
boxes and the singularities do not allow is taken from it (`JogBounds`); the inverse Jacobian makes it joint speeds
(`JogInverse`), and what the tool has lost of its line, some 1e-7 m a cycle, comes back with the next ones. All joints
are scaled together, so that the tool keeps its direction; where they cannot follow, it waits, and the ramp goes on from
what was reached. Nothing winds up.

Beside a singularity the joint that would have to move without bound is locked, and the tool goes where it still can. A
stretched elbow is bent by its joints (`jog_elbow`).
"""

from __future__ import annotations

from collections.abc import Sequence

from kinematics.forward import frames
from kinematics.jacobian import jacobian_columns
from kinematics.model import ArmModel
from kinematics.pose import Pose, Rotation, applied, times
from rtcp.config.model import ArmConfig
from rtcp.motion.controllers.jog_bounds import JogBounds
from rtcp.motion.controllers.jog_elbow import bend
from rtcp.motion.controllers.jog_inverse import ELBOW, JogInverse
from rtcp.motion.controllers.jog_ramp import JogRamp
from rtcp.motion.controllers.jog_speeds import FULL, JogSpeeds
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase, Reason, Setpoint

FOR_EVER = 1 << 62
_BRAKING = 0.7
"""Part of the Cartesian acceleration with which the tool slows before a box."""
_BACK_1_S = 100.0
"""How fast the tool returns to its line, 1/s."""
_OFF_LINE_M = 2e-4
"""Further away from it the line begins anew."""
_AT_REST = 2e-3
"""m/s, rad/s: what is slower is not taken for a motion that is wanted."""


class JogController:
    """The mode `jog`, for a stick and for commands.

    Args:
        config: Cartesian and jog limits; it must have a geometry.
        model: the geometry; without a spherical wrist the arm stands.
        limits: of the joints; read every cycle.
        trajectory_guard: knows the boxes and the frames of what is commanded.
        period_s: the cycle, s.
    """

    def __init__(
        self, config: ArmConfig, model: ArmModel, limits: Limits, trajectory_guard: TrajectoryGuard, period_s: float
    ) -> None:
        cartesian = config.cartesian
        singularity = cartesian.singularity
        self._model = model
        self._limits = limits
        self._trajectory_guard = trajectory_guard
        self._inverse = JogInverse(model)
        nearest = (singularity.shoulder, singularity.elbow, singularity.wrist)
        braking = _BRAKING * cartesian.acceleration
        self._bounds = JogBounds(limits, trajectory_guard, self._inverse, braking, nearest, period_s)
        self._ramp = JogRamp(cartesian)
        self._speed, self._angular_speed = cartesian.speed, cartesian.angular_speed
        self._zero = [0.0] * 6
        self._target = Setpoint(6)
        self._asked = [0.0] * 6
        self._wanted = [0.0] * 6
        self._joints = JogSpeeds(limits)
        self._in_tool = False
        self._until_ns = FOR_EVER
        self._line: Pose | None = None
        self._fresh = True
        self._last = [0.0] * 6
        self._posed = False
        self._wrist = singularity.wrist
        self.tolerates_saturation = True
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: ArmState) -> None:
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

    def stop(self, state: ArmState) -> None:
        """Come to rest."""
        if self.phase is Phase.MOVE:
            self._asked[:] = self._zero
            self.phase = Phase.STOP

    def hold(self) -> None:
        """End whatever is under way where the set-points are: something else has taken the arm."""
        self._asked[:] = self._zero
        self.phase = Phase.HOLD

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle."""
        target = self._target
        position = state.commanded
        if not self.phase:
            target.position, target.velocity = position, self._zero
            return target
        if state.now_ns > self._until_ns and self.phase is Phase.MOVE:
            self.stop(state)
        inverse, bounds, ramp, joints = self._inverse, self._bounds, self._ramp, self._joints
        jumped = self._fresh or position != self._last
        poses = self._trajectory_guard.poses
        if jumped or not self._posed:
            poses = frames(self._model, position)
        if not (inverse.usable and inverse.at(poses)):
            return self._brake(state, dt)
        if jumped:
            # The beginning, or the guards have changed what was commanded: go on from where the arm is.
            ramp.begin(_reached(poses, state.commanded_velocity))
            self._line = None
            self._fresh = False
        wanted = self._turned(poses[6])
        ramp.step(wanted, dt)
        bounds.look(poses, position, jumped)
        twist, speeds = joints.twist, joints.speeds
        twist[:] = ramp.velocity
        self._fit(poses, wanted)
        if inverse.locked[ELBOW]:
            bend(inverse, poses, position, wanted, speeds, self._limits, self._wrist)
        self._back(poses[6])
        if joints.follow(state, dt):
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

    def _answer(self, position: Sequence[float], dt: float) -> Setpoint:
        target, speeds = self._target, self._joints.speeds
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

    def _fit(self, poses: Sequence[Pose], wanted: Sequence[float]) -> None:
        """Bring the twist, and the joint speeds with it, within all bounds."""
        joints, bounds, rows = self._joints, self._bounds, self._inverse.rows
        twist = joints.twist
        joints.make(rows)
        if bounds.passed(poses, twist, joints.speeds):
            a, b, c, d, e, f = twist
            moves = any(wanted[:3]) or a * a + b * b + c * c > _AT_REST * _AT_REST
            turns = any(wanted[3:]) or d * d + e * e + f * f > _AT_REST * _AT_REST
            if not bounds.slide(poses, twist, moves, turns):
                twist[:] = self._zero
            joints.make(rows)
        joints.scale(bounds.halt(twist))
        if bounds.near:
            joints.scale(bounds.stoppable(poses, joints.speeds))

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
        speeds, fastest = self._joints.speeds, self._limits.velocity
        for at, (row0, row1, row2, row3, row4, row5) in enumerate(self._inverse.rows):
            v = speeds[at] + _BACK_1_S * (row0 * dx + row1 * dy + row2 * dz + row3 * tx + row4 * ty + row5 * tz)
            most = fastest[at]
            speeds[at] = most if v > most else -most if v < -most else v

    def _advance(self, dt: float, tool: Pose) -> None:
        """Let the line go on with what the tool does in this cycle."""
        twist = self._joints.twist
        if self._inverse.lost or self._bounds.axis >= 0 or not any(twist):
            self._line = None
            return
        (x, y, z), rotation = tool if self._line is None else self._line
        a, b, c, d, e, f = twist
        if d or e or f:
            rotation = times(_turn(d * dt, e * dt, f * dt), rotation)
        self._line = Pose((x + a * dt, y + b * dt, z + c * dt), rotation)

    def _brake(self, state: ArmState, dt: float) -> Setpoint:
        """Each joint brakes as fast as it may: there is no inverse."""
        speeds = self._joints.speeds
        speeds[:] = self._zero
        self._joints.clip(state.commanded_velocity, FULL * dt)
        self._line = None
        self._fresh = True
        self._posed = False
        self.reason = Reason.NO_SOLUTION
        if not any(speeds) and (self.phase is Phase.STOP or not any(self._asked)):
            self.phase = Phase.HOLD
        return self._answer(state.commanded, dt)


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
