"""Joint torques in CST: gravity is carried, what is asked for comes on top, and speed and range bound what it does."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING

from kinematics.gravity import gravity_torques
from kinematics.model import ArmModel
from rtcp.config.model import Joint
from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.state import ArmState, Phase, Reason, Setpoint

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

_RATE_S = 0.1
"""A torque goes from 0 to the joint's largest in no less."""
_FADE = 0.3
"""Torque fades out over the last part of the speed that a joint may have in its direction."""
_FREE = 1.0 - _FADE
_STILL_RAD_S = 0.01
_AHEAD_RAD_S = 0.1
"""Torque fades out by where the arm is so much faster than its set-point; twice as much is damped."""
_CATCH_UP = 20.0
"""1/s: how fast the set-point goes to where the arm is, on the last bit of the way."""
_MARGIN_RAD = 0.02
"""So far inside its range a joint is brought to rest; beyond, a spring of its `cst_stiffness` pushes it back."""


class TorqueController:
    """The mode `torque`.

    While `direct` is true the set-point follows the arm under the joints' speed and acceleration; what would carry the
    arm away from it faster than that fades out, so that the arm keeps to them too. `Setpoint.torque` is the whole
    torque of each joint (`CstWriter.pass_on`). While it stops, and at rest, it is an ordinary mode whose set-point the
    law holds.

    Args:
        joints: for the stiffness and damping that the impedance is a part of.
        limits: of the joints; read in every cycle.
        period_s: the cycle, s.
        model: for the gravity torques; None, or one without masses: what holds the arm at the start is kept.
    """

    def __init__(self, joints: Sequence[Joint], limits: Limits, period_s: float, model: ArmModel | None = None) -> None:
        n = len(joints)
        self._limits = limits
        self._model = model if model is not None and model.links and n == 6 else None
        self._stiffness = [joint.cst_stiffness for joint in joints]
        self._damping = [joint.cst_damping for joint in joints]
        self._brake = JointMoveController(period_s, limits.velocity, limits.acceleration, limits.jerk)
        self._target = Setpoint(n)
        self._zero = [0.0] * n
        self._joints = range(n)
        self._position = [0.0] * n
        self._follows, self._speed = [0.0] * n, [0.0] * n
        """The set-point, rad and rad/s."""
        self._torque = [0.0] * n
        self._wanted = [0.0] * n
        self._given = [0.0] * n
        self._bias = [0.0] * n
        self._about = [0.0] * n
        self._extra_low, self._extra_high = [0.0] * n, [0.0] * n
        """What begins nearer to its edge than the margin is not pushed away from it, rad."""
        self._stiff = self._damped = 0.0
        self._until_ns = 0
        self.direct = False
        self.tolerates_saturation = True
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: ArmState) -> None:
        """Begin with the torques that hold the arm now, so that it does not sag."""
        carried = self._carried(state.actual)
        # In motion a torque holds nothing: what held the arm before is kept.
        rests = not any(abs(v) > _STILL_RAD_S for v in state.actual_velocity)
        for i in self._joints:
            if rests:
                self._bias[i] = state.actual_torque[i] - carried[i]
            self._given[i] = self._wanted[i] = 0.0
            q, limits = state.actual[i], self._limits
            self._extra_low[i] = max(0.0, limits.low[i] + _MARGIN_RAD - q)
            self._extra_high[i] = max(0.0, q - limits.high[i] + _MARGIN_RAD)
        self._stiff = self._damped = 0.0
        self._about[:] = state.commanded
        # A stiffness may be asked for before the first `update`: it is about here, not about an earlier motion's end.
        self._position[:] = state.commanded
        self._until_ns = state.now_ns
        self.direct = True
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0

    def command(
        self, torques: Sequence[float], hold_s: float, now_ns: int, stiffness: float = 0.0, damping: float = 0.0
    ) -> None:
        """Ask for joint torques beyond gravity, Nm, of shape (n,), finite; they count for `hold_s` from `now_ns` on.

        Args:
            torques: bounded by each joint's limit.
            hold_s: s.
            now_ns: as `ArmState.now_ns`.
            stiffness: 0 to 1, of the joints' `cst_stiffness`, about where the arm is when it rises from 0.
            damping: 0 to 1, of the joints' `cst_damping`.
        """
        if self.phase is not Phase.MOVE:
            return
        for i in self._joints:
            bound, wanted = self._limits.torque[i], torques[i]
            self._wanted[i] = bound if wanted > bound else -bound if wanted < -bound else wanted
        if stiffness > 0.0 and self._stiff == 0.0:
            self._about[:] = self._position
        self._stiff, self._damped = min(max(stiffness, 0.0), 1.0), min(max(damping, 0.0), 1.0)
        self._until_ns = now_ns + round(hold_s * 1e9)

    def stop(self, state: ArmState) -> None:
        """Bring the arm to rest under its limits, held by the law of CST from now on."""
        if self.phase is Phase.MOVE:
            brake, limits = self._brake, self._limits
            brake.set_limits(limits.velocity, limits.acceleration, limits.jerk)
            brake.hold()
            brake.stop(state)
            self.phase, self.direct = Phase.STOP, False

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle: where the arm is, and the torque."""
        target = self._target
        if self.phase is Phase.STOP:
            target = self._brake.update(state, dt)
            self.phase = self._brake.phase
            return target
        if not self.phase:
            target.position, target.velocity = state.commanded, self._zero
            return target
        if state.now_ns > self._until_ns:
            self.reason = Reason.COMMAND_ENDED
            self.stop(state)
            return self.update(state, dt)
        limits = self._limits
        low, high, fastest, slowing, most = limits.low, limits.high, limits.velocity, limits.acceleration, limits.torque
        carried = self._carried(state.actual)
        position, torque, given = self._position, self._torque, self._given
        follows, speeds = self._follows, self._speed
        for i in self._joints:
            q, v = state.actual[i], state.actual_velocity[i]
            step = most[i] * dt / _RATE_S
            change = self._wanted[i] - given[i]
            given[i] += step if change > step else -step if change < -step else change
            pushed = given[i] + self._stiff * self._stiffness[i] * (self._about[i] - q)
            above = high[i] - _MARGIN_RAD + self._extra_high[i] - q
            below = q - low[i] - _MARGIN_RAD + self._extra_low[i]
            top, slow = fastest[i], slowing[i]
            up, down = _bound(above, top, slow), _bound(below, top, slow)
            # Towards the edge nothing is left of a torque, whether the joint moves or stands.
            left = (up - v if pushed > 0.0 else down + v) / (_FADE * top)
            # Nor where the arm runs away from its set-point, which keeps to the acceleration.
            ahead = v - state.commanded_velocity[i]
            slack = 1.0 - (ahead if pushed > 0.0 else -ahead) / _AHEAD_RAD_S
            left = slack if slack < left else left
            pushed *= 0.0 if left < 0.0 else left if left < 1.0 else 1.0
            drag = self._damped * v
            if v > up * _FREE:
                drag += v - up * _FREE
            elif v < -down * _FREE:
                drag += v + down * _FREE
            if ahead > 2.0 * _AHEAD_RAD_S:
                drag += ahead - 2.0 * _AHEAD_RAD_S
            elif ahead < -2.0 * _AHEAD_RAD_S:
                drag += ahead + 2.0 * _AHEAD_RAD_S
            wall = above if above < 0.0 else -below if below < 0.0 else 0.0
            whole = carried[i] + self._bias[i] + pushed - self._damping[i] * drag + self._stiffness[i] * wall
            torque[i] = most[i] if whole > most[i] else -most[i] if whole < -most[i] else whole
            position[i] = q
            speeds[i] = speed = _chase(q - state.commanded[i], v, state.commanded_velocity[i], top, slow, dt)
            follows[i] = state.commanded[i] + speed * dt
        target.position, target.velocity, target.torque = follows, speeds, torque
        return target

    def _carried(self, position: Sequence[float]) -> Sequence[float]:
        return self._zero if self._model is None else gravity_torques(self._model, position)


def _bound(stopping_distance: float, fastest: float, slowing: float) -> float:
    """The speed that stops within `stopping_distance` rad."""
    bound = sqrt(2.0 * slowing * stopping_distance) if stopping_distance > 0.0 else 0.0
    return bound if bound < fastest else fastest


def _chase(lag: float, speed: float, now: float, fastest: float, acceleration: float, dt: float) -> float:
    """The set-point's next speed: it catches up with the arm, `lag` rad away at `speed`, and has its speed there."""
    far = lag if lag >= 0.0 else -lag
    closing = sqrt(acceleration * far)
    closing = closing if closing < _CATCH_UP * far else _CATCH_UP * far
    wanted = speed + (closing if lag >= 0.0 else -closing)
    wanted = fastest if wanted > fastest else -fastest if wanted < -fastest else wanted
    most = acceleration * dt
    return now + most if wanted > now + most else now - most if wanted < now - most else wanted
