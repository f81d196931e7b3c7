"""Jogging: the tool goes where it is told to, for as long as it is told to.

What is asked for becomes a tool velocity under Cartesian acceleration and jerk limits (ruckig, six degrees of freedom);
the commanded pose is integrated from it, and one inverse solution a cycle follows it on its branch. The joints go towards
that solution with all their steps scaled together, so that the tool keeps its direction; where they cannot follow, the pose
waits for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from ruckig import ControlInterface, InputParameter, OutputParameter, Ruckig, RuckigError, Synchronization

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose, applied, times
from rtcp.config.model import ArmConfig
from rtcp.motion.envelope import SetPointGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import MotionState, Phase, Reason, Target

_LEAST_TWIST = 1e-9
FOR_EVER = 1 << 62


class JogMode:
    """The mode `jog`, for a stick and for commands.

    Args:
        config: Cartesian and jog limits; it must have a geometry.
        model: the geometry.
        limits: of the joints; read every cycle.
        guards: knows the boxes and the frames of what is commanded.
        period_s: the cycle, s.
    """

    def __init__(
        self, config: ArmConfig, model: ArmModel, limits: Limits, guards: SetPointGuard, period_s: float
    ) -> None:
        cartesian = config.cartesian
        self._model = model
        self._inverse = InverseKinematics(model)
        self._limits = limits
        self._guards = guards
        self._singularity = (cartesian.singularity.shoulder, cartesian.singularity.elbow, cartesian.singularity.wrist)
        self._acceleration = cartesian.acceleration
        self._otg = Ruckig(6, period_s)
        self._ramp, self._output = InputParameter(6), OutputParameter(6)
        ramp = self._ramp
        ramp.control_interface = ControlInterface.Velocity
        ramp.synchronization = Synchronization.No
        ramp.max_velocity = [cartesian.speed] * 3 + [cartesian.angular_speed] * 3
        ramp.max_acceleration = [cartesian.acceleration] * 3 + [cartesian.angular_acceleration] * 3
        ramp.max_jerk = [cartesian.jerk] * 3 + [cartesian.angular_jerk] * 3
        self._zero = [0.0] * 6
        self._target = Target(6)
        self._wanted = [0.0] * 6
        self._in_tool = False
        self._until_ns = FOR_EVER
        self._pose: Pose | None = None
        self._last: Sequence[float] = ()
        self.clamps = True
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: MotionState) -> None:
        """Begin at `state`, at rest."""
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self._wanted = list(self._zero)
        ramp = self._ramp
        ramp.current_position = ramp.current_velocity = ramp.current_acceleration = self._zero
        self._pose = None

    def command(self, twist: Sequence[float], frame: str, until_ns: int = FOR_EVER) -> None:
        """Ask for a tool velocity: vx, vy, vz (m/s), wx, wy, wz (rad/s) along the axes of `frame` (base or tool).

        It counts until the instant `until_ns`; a stop under way is not taken back.
        """
        self._until_ns = until_ns
        self._wanted[:] = twist
        self._in_tool = frame == "tool"

    def stop(self, state: MotionState) -> None:
        """Come to rest."""
        if self.phase is Phase.MOVE:
            self._wanted[:] = self._zero
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
        if self._pose is None or position != self._last:
            # The guards have changed what was commanded: go on from where the arm is.
            self._pose = forward(self._model, position)
        twist = self._ramped()
        if twist is None:
            self._rest()
            target.position, target.velocity = position, self._zero
            return target
        q, share = self._towards(self._moved(self._pose, twist, dt), state, dt)
        if share < 1.0:
            self._pose = None
        else:
            self._pose = self._next
        target.position = q
        target.velocity = [(new - old) / dt for new, old in zip(q, position, strict=True)]
        self._last = q
        if not any(self._wanted) and max(map(abs, twist)) < _LEAST_TWIST and self._slow(target.velocity):
            self._rest()
        return target

    def _slow(self, velocity: Sequence[float]) -> bool:
        return max(map(abs, velocity)) < 1e-6

    def _rest(self) -> None:
        self.phase = Phase.HOLD

    def _ramped(self) -> Sequence[float] | None:
        """Return the tool velocity of this cycle along the base's axes."""
        ramp = self._ramp
        wanted = self._wanted
        if self._in_tool and self._pose is not None:
            rotation = self._pose[1]
            ramp.target_velocity = [*applied(rotation, wanted[:3]), *applied(rotation, wanted[3:])]  # type: ignore[arg-type]
        else:
            ramp.target_velocity = wanted
        try:
            if self._otg.update(ramp, self._output) < 0:
                return None
        except (RuckigError, ValueError):
            return None
        self._output.pass_to_input(ramp)
        return self._output.new_velocity

    def _moved(self, pose: Pose, twist: Sequence[float], dt: float) -> Pose:
        (x, y, z), rotation = pose
        vx, vy, vz, wx, wy, wz = (component * dt for component in twist)
        if wx or wy or wz:
            rotation = times(_turn(wx, wy, wz), rotation)
        return Pose((x + vx, y + vy, z + vz), rotation)

    def _towards(self, pose: Pose, state: MotionState, dt: float) -> tuple[list[float], float]:
        """Return where the joints go in this cycle, and which part of the way to `pose` that is."""
        self._next = pose
        position = state.position
        found = self._inverse.solve_near(pose, position)
        if found.q is None:
            return self._brake(state, dt), 0.0
        share = 1.0
        limits = self._limits
        for i in range(6):
            step = found.q[i] - position[i]
            room = limits.velocity[i] * dt
            if step > room * share or step < -room * share:
                share = min(share, room / abs(step))
        q = [here + share * (there - here) for here, there in zip(position, found.q, strict=True)]
        return q, share

    def _brake(self, state: MotionState, dt: float) -> list[float]:
        q = []
        for here, v, a in zip(state.position, state.velocity, self._limits.acceleration, strict=True):
            u = a * dt
            q.append(here + (v - u if v > u else v + u if v < -u else 0.0) * dt)
        self._ramp.current_velocity = self._ramp.current_acceleration = self._zero
        return q


def _turn(x: float, y: float, z: float) -> tuple[float, ...]:
    """Rotation by a small vector (rad): Rodrigues' formula to second order, orthonormal to 1e-12 for a cycle's turn."""
    angle2 = x * x + y * y + z * z
    half = 0.5 - angle2 / 24.0
    one = 1.0 - angle2 / 6.0
    return (
        1.0 - half * (y * y + z * z), half * x * y - one * z, half * x * z + one * y,
        half * x * y + one * z, 1.0 - half * (x * x + z * z), half * y * z - one * x,
        half * x * z - one * y, half * y * z + one * x, 1.0 - half * (x * x + y * y),
    )  # fmt: skip
