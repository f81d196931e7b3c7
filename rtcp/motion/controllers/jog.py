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
from kinematics.pose import Pose, Rotation, applied, times
from rtcp.ipc.commands import Command, Jog
from rtcp.ipc.events import OutOfReach
from rtcp.ipc.refusals import JogSpeedOutOfRange, NoGeometry, Refusal
from rtcp.ipc.states import JogFrame
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.controllers.jog_bounds import JogBounds
from rtcp.motion.controllers.jog_elbow import bend
from rtcp.motion.controllers.jog_inverse import ELBOW, JogInverse
from rtcp.motion.controllers.jog_ramp import JogRamp
from rtcp.motion.controllers.jog_speeds import FULL, JogSpeeds
from rtcp.motion.controllers.velocity import VelocityController
from rtcp.motion.state import ArmState, Phase, Setpoint

FOR_EVER = 1 << 62
_BRAKING = 0.7
"""Part of the Cartesian acceleration with which the tool slows before a box."""
_BACK_1_S = 100.0
"""How fast the tool returns to its line, 1/s."""
_OFF_LINE_M = 2e-4
"""Further away from it the line begins anew."""
_AT_REST = 2e-3
"""m/s, rad/s: what is slower is not taken for a motion that is wanted."""


class JogController(Controller):
    """Accepts `Jog`, and is commanded by the joystick (`start`, `command`).

    Without geometry it jogs joints only; without a spherical wrist the tool stands.
    """

    name = "jog"
    commands = (Jog,)
    tolerates_saturation = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        cartesian, model, limits = setup.config.cartesian, setup.config.arm, setup.limits
        self._velocity = VelocityController(setup)
        self._by_joints = False
        self.has_geometry = model is not None
        if model is None:
            return
        singularity = cartesian.singularity
        self._model = model
        self._trajectory_guard = setup.trajectory_guard
        self._inverse = JogInverse(model)
        nearest = (singularity.shoulder, singularity.elbow, singularity.wrist)
        braking = _BRAKING * cartesian.acceleration
        self._bounds = JogBounds(limits, setup.trajectory_guard, self._inverse, braking, nearest, setup.period_s)
        self._ramp = JogRamp(cartesian)
        self._speed, self._angular_speed = cartesian.speed, cartesian.angular_speed
        self._asked = [0.0] * 6
        self._wanted = [0.0] * 6
        self._scaled = JogSpeeds(limits)
        self._in_tool = False
        self._until_ns = FOR_EVER
        self._line: Pose | None = None
        self._fresh = True
        self._last = [0.0] * 6
        self._posed = False
        self._wrist = singularity.wrist

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Move the tool, or the joints, at the velocities until they expire."""
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
        """Begin to jog the tool, with velocity 0."""
        self.begin()
        self._by_joints = False
        self._asked[:] = self._zero
        self._until_ns = FOR_EVER
        self._fresh = True

    def command(self, twist: Sequence[float], *, in_tool_frame: bool, until_ns: int = FOR_EVER) -> None:
        """Move the tool at vx, vy, vz (m/s), wx, wy, wz (rad/s) along the axes of its own frame or of the base.

        The twist counts until the instant `until_ns`. It is scaled down to the largest speeds of the configuration;
        numbers that are not finite stop. Ignored while the controller stops: `start` begins anew.
        """
        if self.phase is not Phase.MOVE:
            return
        self._until_ns = until_ns
        self._in_tool = in_tool_frame
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
        """Come to rest; the tool keeps its direction."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            if self._by_joints:
                self._velocity.stop(state)
            else:
                self._asked[:] = self._zero

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        if self._by_joints:
            setpoint = self._velocity.update(state)
            self.phase, self.ended = self._velocity.phase, self._velocity.ended
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
            bend(inverse, poses, position, wanted, speeds, self.limits, self._wrist)
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
        target, speeds = self.setpoint, self._scaled.speeds
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
        joints, bounds, rows = self._scaled, self._bounds, self._inverse.rows
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
        speeds, fastest = self._scaled.speeds, self.limits.velocity
        for at, (row0, row1, row2, row3, row4, row5) in enumerate(self._inverse.rows):
            v = speeds[at] + _BACK_1_S * (row0 * dx + row1 * dy + row2 * dz + row3 * tx + row4 * ty + row5 * tz)
            most = fastest[at]
            speeds[at] = most if v > most else -most if v < -most else v

    def _advance(self, dt: float, tool: Pose) -> None:
        """Let the line go on with what the tool does in this cycle."""
        twist = self._scaled.twist
        if self._inverse.lost or self._bounds.axis >= 0 or not any(twist):
            self._line = None
            return
        (x, y, z), rotation = tool if self._line is None else self._line
        a, b, c, d, e, f = twist
        if d or e or f:
            rotation = times(_turn(d * dt, e * dt, f * dt), rotation)
        self._line = Pose((x + a * dt, y + b * dt, z + c * dt), rotation)

    def _stand(self, state: ArmState) -> Setpoint:
        """Each joint brakes as fast as it may: there is no inverse."""
        speeds = self._scaled.speeds
        speeds[:] = self._zero
        self._scaled.clip(state.commanded_velocity, FULL * self.period_s)
        self._line = None
        self._fresh = True
        self._posed = False
        self.ended = OutOfReach(0.0)
        if not any(speeds) and (self.phase is Phase.STOP or not any(self._asked)):
            self.phase = Phase.HOLD
        return self._answer(state.commanded, self.period_s)


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
