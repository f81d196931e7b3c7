"""Straight lines of the tool from rest to rest, with slerp; the plan was checked whole by `rtcp.motion.planning`."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, RuckigError

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose, Vector
from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.guards.distance import Singularities
from rtcp.motion.planning.rows import Refused, Wrong, damaged_line, read_row
from rtcp.motion.planning.slerp import quaternion, rotation, turn_between, turned_by
from rtcp.motion.state import ArmState, Phase, Reason, Setpoint

if TYPE_CHECKING:
    from rtcp.config.model import SingularityLimits
    from rtcp.motion.limits import Limits

AT_START_M, AT_START_RAD = 1e-3, 2e-3
"""So near to where the tool is commanded the first piece begins; what is left fades out."""
_STILL_RAD_S = 1e-6
_EXACT = 1e-9
_LOOK_S = 0.004
_BETWEEN_SAMPLES = 0.95
"""Of the distance that is kept from a singularity: a plan was looked at every 2 mm, and may be nearer in between."""
_FADED = 0.25
"""What was left at the start fades out over so much of the first piece."""


class LineController:
    """The mode `cartesian`: one inverse solution a cycle, on one branch.

    Args:
        model: the arm.
        limits: of the joints; read in every cycle.
        period_s: the cycle, s.
        singularity: how near to one the arm may come; None: the plan was looked at, that is enough.
    """

    def __init__(
        self, model: ArmModel, limits: Limits, period_s: float, singularity: SingularityLimits | None = None
    ) -> None:
        n = len(limits.velocity)
        self._singularities = Singularities(model)
        self._nearest = None if singularity is None else (singularity.shoulder, singularity.elbow, singularity.wrist)
        self._every = max(round(_LOOK_S / period_s), 1)
        self._wait = 0
        self._model = model
        self._inverse = InverseKinematics(model)
        self._limits = limits
        self._brake = JointMoveController(period_s, limits.velocity, limits.acceleration, limits.jerk)
        self._brakes = False
        self._otg = Ruckig(1, period_s)
        self._way, self._halt = InputParameter(1), InputParameter(1)
        self._halt.control_interface = ControlInterface.Velocity
        self._halt.target_velocity = [0.0]
        self._active = self._way
        self._output = OutputParameter(1)
        self._target = Setpoint(n)
        self._zero = [0.0] * n
        self._joints = range(n)
        self._velocity = [0.0] * n
        self._near = [0.0] * n
        self._rest = [0.0] * n
        self._rest_counts = False
        self._rows: memoryview[float] | None = None
        self._piece = [0.0] * 20
        self._ended = False
        self._row = self._count = 0
        self._done_s = 0.0
        self._from: Vector = (0.0, 0.0, 0.0)
        self._way_m: Vector = (0.0, 0.0, 0.0)
        self._axis: Vector = (0.0, 0.0, 1.0)
        self._angle = 0.0
        self._rotation = rotation((1.0, 0.0, 0.0, 0.0))
        self.tolerates_saturation = False
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: ArmState, rows: memoryview[float], count: int) -> Refused | None:
        """Begin a plan of `count` straight pieces (`rtcp.motion.planning.rows`) from `state`; return why not, or None.

        The arm has to be at rest, and the tool where the first piece begins: all that it does was checked beforehand.
        Where it is refused, what was under way goes on.
        """
        first = read_row(rows, 0)
        if (wrong := damaged_line(first, 0)) is not None:
            return wrong
        for i, v in enumerate(state.commanded_velocity):
            if not -_STILL_RAD_S <= v <= _STILL_RAD_S:
                return Refused(Wrong.MOVING, i, v, 0.0)
        tool = forward(self._model, state.commanded)
        far = hypot(*(a - b for a, b in zip(tool.position, first[0:3], strict=True)))
        if not far <= AT_START_M:
            return Refused(Wrong.START, -1, far, AT_START_M)
        _, turn = turn_between(quaternion(tool.rotation), first[3:7])
        if not turn <= AT_START_RAD:
            return Refused(Wrong.START, -1, turn, AT_START_RAD)
        self._rows, self._row, self._count = rows, 0, count
        self._brakes = False
        self.elapsed_s = self._done_s = 0.0
        self.duration_s = first[18]
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self._begin(state, first)
        return None

    def _begin(self, state: ArmState, row: list[float]) -> None:
        """Make a row the current piece."""
        self._piece, self._ended = row, False
        x, y, z = row[0:3]
        self._from = x, y, z
        self._way_m = row[7] - x, row[8] - y, row[9] - z
        self._axis, self._angle = turn_between(row[3:7], row[10:14])
        self._rotation = rotation(row[3:7])
        self._near = list(state.commanded)
        self._rest_counts = False
        found = self._inverse.solve_near(Pose(self._from, self._rotation), self._near).q
        if found is not None:
            # What the arm stands beside the line fades out along it: no jump, and no second line.
            for i in self._joints:
                self._rest[i] = rest = state.commanded[i] - found[i]
                self._rest_counts = self._rest_counts or not -_EXACT < rest < _EXACT
            self._near = list(found)
        way = self._way
        way.current_position, way.current_velocity, way.current_acceleration = [0.0], [0.0], [0.0]
        way.target_position = [1.0]
        way.max_velocity, way.max_acceleration, way.max_jerk = [row[14]], [row[15]], [row[16]]
        self._otg.reset()
        self._active = way

    def _stop_joints(self, state: ArmState) -> None:
        brake, limits = self._brake, self._limits
        brake.set_limits(limits.velocity, limits.acceleration, limits.jerk)
        brake.hold()
        brake.stop(state)

    def stop(self, state: ArmState) -> None:
        """Brake along the line, as fast as the piece's acceleration and jerk allow."""
        if self.phase is not Phase.MOVE:
            return
        self.phase = Phase.STOP
        way, halt = self._way, self._halt
        halt.current_position, halt.current_velocity = way.current_position, way.current_velocity
        halt.current_acceleration = way.current_acceleration
        halt.max_velocity, halt.max_acceleration, halt.max_jerk = way.max_velocity, way.max_acceleration, way.max_jerk
        self._active = halt

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle."""
        if not self.phase:
            target = self._target
            target.position, target.velocity = state.commanded, self._zero
            return target
        if self._brakes:
            target = self._brake.update(state, dt)
            if not self._brake.phase:
                self._brakes, self.phase = False, Phase.HOLD
            return target
        if self._ended and not self._begin_next(state):
            return self._give_up(state, dt, Reason.PLAN, self.axis, self.value, self.limit)
        return self._along(state, dt)

    def _begin_next(self, state: ArmState) -> bool:
        """Begin the next piece where the last has ended; False where it is damaged or begins elsewhere."""
        assert self._rows is not None
        self._row += 1
        row, last = read_row(self._rows, self._row), self._piece
        wrong = damaged_line(row, self._row)
        if wrong is None and not hypot(row[0] - last[7], row[1] - last[8], row[2] - last[9]) <= AT_START_M:
            wrong = Refused(Wrong.DAMAGED, self._row, row[0], 0.0)
        if wrong is None and not turn_between(last[10:14], row[3:7])[1] <= AT_START_RAD:
            wrong = Refused(Wrong.DAMAGED, self._row, row[3], 3.0)
        if wrong is not None:
            self.axis, self.value, self.limit = wrong.at, wrong.value, wrong.limit
            return False
        self._done_s = self.elapsed_s
        self._begin(state, row)
        return True

    def _along(self, state: ArmState, dt: float) -> Setpoint:
        output = self._output
        try:
            result = self._otg.update(self._active, output)
        except (RuckigError, ValueError):
            result = Result.Error
        if result < 0:
            return self._give_up(state, dt, Reason.GENERATOR, -1, 0.0, 0.0)
        fraction: float = output.new_position[0]
        x, y, z = self._from
        along, across, up = self._way_m
        turned = turned_by(self._rotation, self._axis, fraction * self._angle) if self._angle else self._rotation
        near = self._inverse.solve_near(
            Pose((x + fraction * along, y + fraction * across, z + fraction * up), turned), self._near
        )
        q = near.q
        if q is None:
            if near.limited >= 0:
                return self._give_up(state, dt, Reason.JOINT_LIMIT, near.limited, 0.0, 0.0)
            return self._give_up(state, dt, Reason.NO_SOLUTION, -1, near.out_of_reach, 0.0)
        target = self._target
        position = list(q)
        if self._rest_counts:
            left = _left(fraction / _FADED)
            for i in self._joints:
                position[i] += self._rest[i] * left
        velocity, before, limits, over = self._velocity, state.commanded, self._limits.velocity, 1.0 / dt
        for i in self._joints:
            velocity[i] = v = (position[i] - before[i]) * over
            if not -limits[i] * 1.000001 <= v <= limits[i] * 1.000001:
                return self._give_up(state, dt, Reason.JUMP, i, v, limits[i])
        if self._nearest is not None and self._due():
            for which, distance in enumerate(self._singularities.distances(frames(self._model, position))):
                if distance < _BETWEEN_SAMPLES * self._nearest[which]:
                    return self._give_up(state, dt, Reason.SINGULARITY, which, distance, self._nearest[which])
        self._near = position if not self._rest_counts else list(q)
        target.position, target.velocity = position, velocity
        self.elapsed_s = self._done_s + output.time
        if result == Result.Finished:
            self._ended = self.phase is Phase.MOVE and self._row < self._count - 1
            if not self._ended:
                self.phase = Phase.HOLD
        else:
            output.pass_to_input(self._active)
        return target

    def _due(self) -> bool:
        """Whether some ms have passed since the singularities were looked at: the tool has moved 1 mm at most."""
        self._wait -= 1
        if self._wait > 0:
            return False
        self._wait = self._every
        return True

    def _give_up(self, state: ArmState, dt: float, reason: Reason, axis: int, value: float, limit: float) -> Setpoint:
        self.phase, self.reason, self.axis, self.value, self.limit = Phase.STOP, reason, axis, value, limit
        self._stop_joints(state)
        self._brakes = True
        return self.update(state, dt)


def _left(x: float) -> float:
    """1 to 0 with speed and acceleration 0 at both ends."""
    return 1.0 - x * x * x * (10.0 + x * (6.0 * x - 15.0)) if x < 1.0 else 0.0
