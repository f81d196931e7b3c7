"""Joint torques in CST: gravity compensation plus the commanded torque, bounded by speed and range."""

from __future__ import annotations

from math import sqrt
from typing import Final

from rtcp.ipc.commands import ApplyTorque, Command
from rtcp.ipc.events import CommandExpired
from rtcp.ipc.refusals import FractionOutOfRange, Refusal, TorqueOutOfRange, WeightUnknown
from rtcp.ipc.states import ControlMode
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.state import ArmState, Phase, Setpoint
from rtcp.motion.tool_in_use import Gravity

_RATE_S: Final = 0.1
"""Shortest time for a torque from 0 to the joint's limit, and for a stiffness or damping from 0 to 1, s."""
_FADE: Final = 0.3
"""Last part of the allowed speed, as a share, over which the torque fades out."""
_FREE = 1.0 - _FADE
_STILL_RAD_S: Final = 0.01
"""Speed up to which a joint rests, rad/s."""
_AHEAD_RAD_S: Final = 0.1
"""Speed above that of the setpoint at which the torque has faded out, rad/s; twice as much is damped."""
_CATCH_UP: Final = 20.0
"""Gain with which the setpoint approaches the arm's position at the end, 1/s."""
_MARGIN_RAD: Final = 0.02
"""Distance from the range end at which a joint comes to rest; beyond it a spring of `cst_stiffness` pushes it back."""


class TorqueController(Controller):
    """Accepts `ApplyTorque`.

    In phase MOVE `Setpoint.direct` is true: the torque is the whole torque of each joint. The setpoint follows the arm
    under the joints' speed and acceleration limits; a torque that would move the arm faster fades out, so the arm keeps
    to them too. During a stop and at rest, the position loop of CST holds the setpoint.

    Gravity is computed from the masses of the geometry; without masses the torque at the start is kept.
    """

    name = "torque"
    commands = (ApplyTorque,)
    control_modes = frozenset({ControlMode.TORQUE})
    tolerates_saturation = True
    follows_joints = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        joints, n = setup.config.joints, len(self._zero)
        self._gravity = Gravity(setup.config, setup.tool)
        self._stiffness = [joint.cst_stiffness for joint in joints]
        self._damping = [joint.cst_damping for joint in joints]
        self._direct = Setpoint(n)
        self._direct.direct = True
        self._position = [0.0] * n
        self._wanted = [0.0] * n
        self._applied = [0.0] * n
        self._bias = [0.0] * n
        self._about = [0.0] * n
        self._extra_low, self._extra_high = [0.0] * n, [0.0] * n
        """Margin given up for a joint that begins nearer to its range end, so that it is not pushed away, rad."""
        self._stiff = self._damped = 0.0
        """Stiffness and damping that act, as fractions; they approach the commanded ones."""
        self._wanted_stiff = self._wanted_damped = 0.0
        self._until_ns = 0

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Apply the torques, Nm, from the next cycle; a stiffness that rises from 0 acts about the current position."""
        assert isinstance(command, ApplyTorque)
        if (
            refusal := self.not_within(command.torque, self.limits.torque, command.hold_s, TorqueOutOfRange)
        ) is not None:
            return refusal
        for fraction in (command.stiffness, command.damping):
            if not 0.0 <= fraction <= 1.0:
                return FractionOutOfRange(fraction)
        if not continues or self.phase is not Phase.MOVE:
            if (refusal := not_at_rest(state)) is not None:
                return refusal
            self._start(state)
        self._wanted[:] = command.torque
        if command.stiffness > 0.0 and self._stiff == 0.0:
            self._about[:] = self._position
        self._wanted_stiff, self._wanted_damped = command.stiffness, command.damping
        self._until_ns = state.now_ns + round(command.hold_s * 1e9)
        return None

    def _start(self, state: ArmState) -> None:
        """Begin with the torques that hold the arm now, at rest, so that it does not sag."""
        carried = self._gravity.torques(state.actual)
        for i in self._joints:
            self._bias[i] = state.proven_torque(i) - carried[i]
            self._applied[i] = 0.0
            q, limits = state.actual[i], self.limits
            self._extra_low[i] = max(0.0, limits.low[i] + _MARGIN_RAD - q)
            self._extra_high[i] = max(0.0, q - limits.high[i] + _MARGIN_RAD)
        self._stiff = self._damped = 0.0
        # A stiffness commanded before the first `advance` acts about this position.
        self._position[:] = state.commanded
        self.begin()

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle: position of the arm, and the torque."""
        if state.now_ns > self._until_ns:
            return self.give_up(state, CommandExpired())
        target, dt = self._direct, self.period_s
        limits = self.limits
        low, high, fastest, slowing, most = limits.low, limits.high, limits.velocity, limits.acceleration, limits.torque
        part = dt / _RATE_S
        self._stiff += min(max(self._wanted_stiff - self._stiff, -part), part)
        self._damped += min(max(self._wanted_damped - self._damped, -part), part)
        carried = self._gravity.torques(state.actual)
        position, applied = self._position, self._applied
        torque, follows, speeds = target.torque, target.position, target.velocity
        for i in self._joints:
            q, v = state.actual[i], state.actual_velocity[i]
            step = most[i] * dt / _RATE_S
            change = self._wanted[i] - applied[i]
            applied[i] += step if change > step else -step if change < -step else change
            pushed = applied[i] + self._stiff * self._stiffness[i] * (self._about[i] - q)
            above = high[i] - _MARGIN_RAD + self._extra_high[i] - q
            below = q - low[i] - _MARGIN_RAD + self._extra_low[i]
            top, slow = fastest[i], slowing[i]
            up, down = _bound(above, top, slow), _bound(below, top, slow)
            # At the range end no torque towards it remains, whether the joint moves or not.
            share = (up - v if pushed > 0.0 else down + v) / (_FADE * top)
            # Nor while the arm is ahead of its setpoint, which keeps to the acceleration limit.
            ahead = v - state.commanded_velocity[i]
            slack = 1.0 - (ahead if pushed > 0.0 else -ahead) / _AHEAD_RAD_S
            share = slack if slack < share else share
            pushed *= 0.0 if share < 0.0 else share if share < 1.0 else 1.0
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
            weight = target.weight[i] = carried[i] + self._bias[i]
            whole = weight + pushed - self._damping[i] * drag + self._stiffness[i] * wall
            torque[i] = most[i] if whole > most[i] else -most[i] if whole < -most[i] else whole
            position[i] = q
            speeds[i] = speed = chase(q - state.commanded[i], v, state.commanded_velocity[i], top, slow, dt)
            follows[i] = state.commanded[i] + speed * dt
        return target


def not_at_rest(state: ArmState) -> WeightUnknown | None:
    """Return the refusal of a motion that begins with the torque of joints at rest while one of them turns, or None."""
    for i, speed in enumerate(state.actual_velocity):
        if not abs(speed) <= _STILL_RAD_S:
            return WeightUnknown(i, speed)
    return None


def _bound(stopping_distance: float, fastest: float, slowing: float) -> float:
    """Return the speed that stops within `stopping_distance` rad."""
    bound = sqrt(2.0 * slowing * stopping_distance) if stopping_distance > 0.0 else 0.0
    return bound if bound < fastest else fastest


def chase(lag: float, speed: float, now: float, fastest: float, acceleration: float, dt: float) -> float:
    """Return the setpoint's next speed, to meet the arm, which is `lag` rad away and moves at `speed`."""
    far = lag if lag >= 0.0 else -lag
    closing = sqrt(acceleration * far)
    closing = closing if closing < _CATCH_UP * far else _CATCH_UP * far
    wanted = speed + (closing if lag >= 0.0 else -closing)
    wanted = fastest if wanted > fastest else -fastest if wanted < -fastest else wanted
    most = acceleration * dt
    return now + most if wanted > now + most else now - most if wanted < now - most else wanted
