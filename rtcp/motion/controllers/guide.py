"""Hand guiding in CST: the arm carries its weight and follows the hand, inside its limits and below a bounded speed.

A spring ties each joint to an anchor, which the joint drags along once the spring pulls with more than `hold`: the arm
stays where it is let go, even with a slightly wrong weight. Anchors keep to the speed bounds of joints and tool and
stay inside ranges, outside boxes and clear of the arm itself: at these bounds the hand feels the spring.

Apart from carrying the weight the controller adds no energy: an anchor moves only towards its joint, so a spring
returns no more than it stored, and damping only brakes. Friction is not compensated: a wrong figure would push the arm.
The setpoint follows the anchors under all limits and through the guards: a stop can begin from it at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final

from kinematics.forward import frames
from kinematics.jacobian import jacobian_columns
from kinematics.pose import Pose
from rtcp.ipc.commands import Command, Guide
from rtcp.ipc.events import GuidedTooFast
from rtcp.ipc.refusals import DurationOutOfRange, MassesUnknown, NoEnablingSwitch, Refusal, WeightDiffers
from rtcp.ipc.states import ControlMode
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.controllers.jog_bounds import JogBounds, lever, stopping
from rtcp.motion.controllers.jog_inverse import JogInverse
from rtcp.motion.controllers.torque import chase, not_at_rest
from rtcp.motion.state import ArmState, Setpoint
from rtcp.motion.tool_in_use import Gravity

LONGEST_S: Final = 3600.0
_VIRTUAL: Final = ("virtual", "inprocess")
"""Simulated buses: no person stands beside the arm."""
_STIFF: Final = 2.0
"""Stiffness between joint and anchor, as a multiple of `cst_stiffness`."""
_DAMPED: Final = 3.0
"""Damping of a joint that is faster than its anchor, as a multiple of `cst_damping`."""
_SHARE: Final = 0.8
"""Share of the speed bounds for the anchors: until the spring is bent a hand that pushes hard is faster."""
_TOO_FAST: Final = 1.5
_FAST_CYCLES: Final = 5
"""The guiding ends when the tool exceeds `_TOO_FAST` times its speed bound for more than this many cycles in a row."""
_MARGIN_RAD: Final = 0.05
"""Distance of the anchors from the ends of the range, rad: room to bend the spring."""
_BRAKES: Final = 0.5
"""Share of the joint and tool acceleration with which anchors brake before a range end or a box."""
_FORGET_1_RAD: Final = 10.0
"""Decay per rad of motion of the initial torque beyond the weight, mostly friction, 1/rad."""
_PASSES: Final = 6
_TOLERANCE: Final = 1e-6


class GuideController(Controller):
    """Accepts `Guide`, from rest.

    In phase MOVE `Setpoint.direct` is true: the torque is the whole torque of each joint.
    """

    name = "guide"
    commands = (Guide,)
    control_modes = frozenset({ControlMode.TORQUE})
    tolerates_saturation = True
    needs_geometry = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        config, n = setup.config, len(self._zero)
        guiding, joints = config.guiding, config.joints
        self._models = config.models
        self._gravity = Gravity(config, setup.tool)
        self._needs_switch = (
            guiding.enabling_switch and config.inputs.enabling_switch is None and config.bus.interface not in _VIRTUAL
        )
        self._most = guiding.speed
        self._speed = _SHARE * guiding.speed
        self._joint_speed = [_SHARE * min(guiding.joint_speed, joint.velocity) for joint in joints]
        self._error = [guiding.weight_error * joint.torque for joint in joints]
        self._stiffness = [_STIFF * joint.cst_stiffness for joint in joints]
        self._slack = [guiding.hold * joint.torque / (_STIFF * joint.cst_stiffness) for joint in joints]
        self._damping = [_DAMPED * joint.cst_damping for joint in joints]
        self._drag = [guiding.damping * joint.cst_damping for joint in joints]
        cartesian = config.cartesian
        self._bounds_of = [
            JogBounds(
                self.limits,
                setup.trajectory_guard.zones_of(number),
                JogInverse(model),
                _BRAKES * cartesian.acceleration,
                _BRAKES * cartesian.angular_acceleration,
                (0.0,) * 3,
                setup.period_s,
            )
            for number, model in enumerate(self._models)
        ]
        self.use_tool(setup.tool.number)
        self._direct = Setpoint(n)
        self._direct.direct = True
        self._anchor, self._anchor_speed = [0.0] * n, [0.0] * n
        self._wanted, self._row = [0.0] * n, [0.0] * n
        self._bias = [0.0] * n
        self._extra_low, self._extra_high = [0.0] * n, [0.0] * n
        """Margin given up for a joint that begins nearer to its range end, so that it is not pushed away, rad."""
        self._until_ns = 0
        self._fresh = True
        self._fast = 0
        """Consecutive cycles in which the tool was too fast."""

    def use_tool(self, number: int) -> None:
        """Switch to another tool; at rest."""
        self._model, self._bounds = self._models[number], self._bounds_of[number]

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Start guiding, from rest, until the commanded duration is over or a stop."""
        assert isinstance(command, Guide)
        if self._needs_switch:
            return NoEnablingSwitch()
        if not 0.0 <= command.duration_s <= LONGEST_S:
            return DurationOutOfRange(command.duration_s, LONGEST_S)
        if not self._gravity.is_known:
            return MassesUnknown()
        if (refusal := not_at_rest(state)) is not None:
            return refusal
        carried, limits = self._gravity.torques(state.actual), self.limits
        for i in self._joints:
            held = state.proven_torque(i)
            if not abs(held - carried[i]) <= self._error[i]:
                return WeightDiffers(i, held, carried[i], self._error[i])
        for i in self._joints:
            q = state.actual[i]
            self._bias[i] = state.proven_torque(i) - carried[i]
            self._anchor[i], self._anchor_speed[i] = q, 0.0
            self._extra_low[i] = max(0.0, limits.low[i] + _MARGIN_RAD - q)
            self._extra_high[i] = max(0.0, q - limits.high[i] + _MARGIN_RAD)
        self._until_ns = state.now_ns + round((command.duration_s or LONGEST_S) * 1e9)
        self._fresh = True
        self._fast = 0
        self.begin()
        self.duration_s = command.duration_s
        return None

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle: position of the anchors, and the torque."""
        if state.now_ns >= self._until_ns:
            self.brake(state)
            return self.update(state)
        self.elapsed_s += self.period_s
        poses = frames(self._model, self._anchor)
        x, y, z = _tool_velocity(poses, state.actual_velocity)
        speed = sqrt(x * x + y * y + z * z)
        self._fast = self._fast + 1 if speed > _TOO_FAST * self._most else 0
        if self._fast > _FAST_CYCLES:
            return self.give_up(state, GuidedTooFast(speed, self._most))
        target, dt, limits = self._direct, self.period_s, self.limits
        anchor, wanted, last, bias = self._anchor, self._wanted, self._anchor_speed, self._bias
        position, speeds, torque = target.position, target.velocity, target.torque
        carried = self._gravity.torques(state.actual)
        self._drag_anchors(state, poses)
        for i in self._joints:
            q, v, moved = state.actual[i], state.actual_velocity[i], wanted[i]
            anchor[i] += moved * dt
            last[i] = moved
            step = v * dt * _FORGET_1_RAD
            bias[i] -= bias[i] * (step if step > 0.0 else -step)
            # Damp the joint's speed relative to its anchor; never push in the direction of motion.
            along = moved if 0.0 <= moved <= v or v <= moved <= 0.0 else v if moved * v > 0.0 else 0.0
            pulled = self._stiffness[i] * (anchor[i] - q) - self._damping[i] * (v - along) - self._drag[i] * v
            weight = target.weight[i] = carried[i] + bias[i]
            whole, most = weight + pulled, limits.torque[i]
            torque[i] = most if whole > most else -most if whole < -most else whole
            here, fastest = state.commanded[i], limits.velocity[i]
            speeds[i] = speed = chase(
                anchor[i] - here, moved, state.commanded_velocity[i], fastest, limits.acceleration[i], dt
            )
            position[i] = here + speed * dt
        self.held = self._bounds.held
        return target

    def _drag_anchors(self, state: ArmState, poses: Sequence[Pose]) -> None:
        """Write the speeds of the anchors to `_wanted`: towards their joints, within the bounds."""
        anchor, wanted, last, limits, dt = self._anchor, self._wanted, self._anchor_speed, self.limits, self.period_s
        bounds, fraction = self._bounds, self.speed_override.fraction
        bounds.update(poses, anchor, self._fresh)
        self._fresh = False
        moves = False
        for i in self._joints:
            lag, slack = state.actual[i] - anchor[i], self._slack[i]
            lag = lag - slack if lag > slack else lag + slack if lag < -slack else 0.0
            if lag == 0.0:
                wanted[i] = 0.0
                continue
            moves = True
            size = (lag if lag > 0.0 else -lag) / dt
            rate = limits.acceleration[i]
            # Speed rises with the setpoint's acceleration and falls at once.
            most = rate * dt + max(0.0, last[i] if lag > 0.0 else -last[i])
            fastest = fraction * self._joint_speed[i]
            most = fastest if most > fastest else most
            if lag > 0.0:
                room = limits.high[i] - _MARGIN_RAD + self._extra_high[i] - anchor[i]
            else:
                room = anchor[i] - limits.low[i] - _MARGIN_RAD + self._extra_low[i]
            edge = stopping(room, _BRAKES * rate, dt)
            if edge < most:
                most = edge
                if size > most:
                    bounds.axis = i
            size = most if size > most else size
            wanted[i] = size if lag > 0.0 else -size
        if not moves:
            return
        self._keep_clear(poses)
        x, y, z = _tool_velocity(poses, wanted)
        speed, fastest = sqrt(x * x + y * y + z * z), fraction * self._speed
        if speed > fastest:
            for i in self._joints:
                wanted[i] *= fastest / speed
        share = bounds.stoppable(poses, wanted)
        if share < 1.0:
            for i in self._joints:
                wanted[i] *= share

    def _keep_clear(self, poses: Sequence[Pose]) -> None:
        """Remove from the anchor speeds the part towards a box or the arm itself; the rest slides along.

        The removed part bends the springs in proportion to each joint's lever: they push along the boundary's normal.
        """
        bounds, wanted, row = self._bounds, self._wanted, self._row
        for clearance in bounds.near:
            allowed = bounds.allowed(clearance)
            for i in self._joints:
                inside = clearance.other <= i < clearance.link
                row[i] = -lever(poses[i], clearance) if inside else 0.0
            for _ in range(_PASSES):
                approach = whole = 0.0
                for i in self._joints:
                    approach += row[i] * wanted[i]
                    if row[i] * wanted[i] > 0.0:
                        whole += row[i] * row[i] / self._stiffness[i]
                excess = approach - allowed
                if excess <= _TOLERANCE or whole <= 0.0:
                    break
                bounds.box = clearance.zone
                for i in self._joints:
                    towards = row[i] * wanted[i]
                    if towards > 0.0:
                        part = excess * row[i] / (self._stiffness[i] * whole)
                        # Never reversed: an anchor moves only towards its joint.
                        reduced = wanted[i] - part
                        wanted[i] = reduced if reduced * wanted[i] > 0.0 else 0.0
        # With several boundaries, each correction may undo another: scale the whole motion.
        for clearance in bounds.near:
            allowed = bounds.allowed(clearance)
            approach = 0.0
            for i in range(clearance.other, clearance.link):
                approach -= lever(poses[i], clearance) * wanted[i]
            if approach > allowed + _TOLERANCE:
                for i in self._joints:
                    wanted[i] *= allowed / approach


def _tool_velocity(poses: Sequence[Pose], speeds: Sequence[float]) -> tuple[float, float, float]:
    """Return the tool velocity, m/s, at the joint speeds `speeds`, rad/s."""
    x = y = z = 0.0
    for v, (a, b, c, _, _, _) in zip(speeds, jacobian_columns(poses), strict=True):
        x += v * a
        y += v * b
        z += v * c
    return x, y, z
