"""Straight tool lines from rest to rest, with slerp, of a plan that `rtcp.motion.planning` has checked."""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, hypot, sqrt
from typing import Final, NamedTuple

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, RuckigError, Trajectory

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import singularity_distances
from kinematics.model import JOINTS, ArmModel
from kinematics.pose import Pose, Vector
from rtcp.ipc.commands import Command, RunLines
from rtcp.ipc.events import (
    ControllerFailed,
    JointLimitReached,
    MotionEnded,
    NoSolution,
    OutOfReach,
    PlanDamaged,
    SetpointJump,
    SingularityReached,
)
from rtcp.ipc.refusals import DamagedRow, PathNeedsRest, PathStartsElsewhere, Refusal
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import find_trajectory
from rtcp.motion.planning.interpolation import quaternion, rotation, turn_between, turned_by
from rtcp.motion.planning.plan import MOST_LINES, damaged_line, read_row
from rtcp.motion.speed_override import TimeScale
from rtcp.motion.state import ArmState, Phase, Setpoint

AT_START_M, AT_START_RAD = 1e-3, 2e-3
"""Upper bounds on the distance of the first piece from the commanded tool pose, m, rad; the difference fades out."""
_STILL_RAD_S: Final = 1e-6
_EXACT: Final = 1e-9
_LOOK_S: Final = 0.004
_BETWEEN_SAMPLES: Final = 0.95
"""Share of the required distance to a singularity: plans are checked every 2 mm only."""
_FADED: Final = 0.25
"""Fraction of the first piece over which the difference at its start fades out."""


class LineController(Controller):
    """Accepts `RunLines`: one inverse solution a cycle, on one branch."""

    name = "line"
    pausable = True
    commands = (RunLines,)
    needs_geometry = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        singularity, n = setup.config.cartesian.singularity, len(self._zero)
        self._models = setup.config.models
        self._inverses = [InverseKinematics(model) for model in self._models]
        self.use_tool(setup.tool.number)
        self._singularities = Singularities(self._model)
        self._nearest = (singularity.shoulder, singularity.elbow, singularity.wrist)
        self._singularity_cycles = max(round(_LOOK_S / setup.period_s), 1)
        self._wait = 0
        self._otg = Ruckig(1, setup.period_s)
        self._inp, self._halt = InputParameter(1), InputParameter(1)
        self._halt.control_interface = ControlInterface.Velocity
        self._halt.target_velocity = [0.0]
        self._active = self._inp
        self._time_scale = TimeScale()
        self._plan = Trajectory(1)
        """Trajectory of the rest of the piece, since the piece became slower than planned."""
        self._is_scaled = False
        self._fraction = self._plan_s = 0.0
        """Fraction of the piece that is done, and its time in the plan, s."""
        self._output = OutputParameter(1)
        self._velocity = [0.0] * n
        self._near = [0.0] * n
        self._offset = [0.0] * n
        self._has_offset = False
        self._rows: memoryview[float] | None = None
        self._piece = [0.0] * 20
        self._piece_ended = False
        self._row = self._count = 0
        self._done_s = 0.0
        self._from: Vector = (0.0, 0.0, 0.0)
        self._span: Vector = (0.0, 0.0, 0.0)
        self._axis: Vector = (0.0, 0.0, 1.0)
        self._angle = 0.0
        self._rotation = rotation((1.0, 0.0, 0.0, 0.0))

    def use_tool(self, number: int) -> None:
        """Switch to another tool; at rest."""
        self._model, self._inverse = self._models[number], self._inverses[number]

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Run a plan of straight pieces (`rtcp.motion.planning.plan`) from rest at the start of the first."""
        assert isinstance(command, RunLines)
        rows, count = self.rows_of(command.slot, command.rows, MOST_LINES), command.rows
        if isinstance(rows, Refusal):
            return rows
        first = read_row(rows, 0)
        if (damaged := damaged_line(first)) is not None:
            return DamagedRow(0, damaged)
        for i, v in enumerate(state.commanded_velocity):
            if not -_STILL_RAD_S <= v <= _STILL_RAD_S:
                return PathNeedsRest(i, v)
        tool = forward(self._model, state.commanded)
        far = hypot(*(a - b for a, b in zip(tool.position, first[0:3], strict=True)))
        if not far <= AT_START_M:
            return PathStartsElsewhere(far)
        _, angle = turn_between(quaternion(tool.rotation), first[3:7])
        if not angle <= AT_START_RAD:
            return PathStartsElsewhere(angle)
        self.begin()
        self._rows, self._row, self._count = rows, 0, count
        self._done_s = 0.0
        self.duration_s = first[18]
        self._begin_piece(state, first)
        return None

    def _begin_piece(self, state: ArmState, row: list[float]) -> None:
        """Set a row as the current piece."""
        self._piece, self._piece_ended = row, False
        x, y, z = row[0:3]
        self._from = x, y, z
        self._span = row[7] - x, row[8] - y, row[9] - z
        self._axis, self._angle = turn_between(row[3:7], row[10:14])
        self._rotation = rotation(row[3:7])
        self._near = list(state.commanded)
        self._has_offset = False
        q = self._inverse.solve_near(Pose(self._from, self._rotation), self._near).q
        if q is not None:
            # The arm's offset from the line fades out along it, without a jump.
            for i in self._joints:
                self._offset[i] = offset = state.commanded[i] - q[i]
                self._has_offset = self._has_offset or not -_EXACT < offset < _EXACT
            self._near = list(q)
        inp = self._inp
        inp.current_position, inp.current_velocity, inp.current_acceleration = [0.0], [0.0], [0.0]
        inp.target_position = [1.0]
        inp.max_velocity, inp.max_acceleration, inp.max_jerk = [row[14]], [row[15]], [row[16]]
        self._otg.reset()
        self._active = inp
        self._is_scaled = False

    def stop(self, state: ArmState) -> None:
        """Brake along the line, as fast as the piece's acceleration and jerk allow."""
        if self.phase is not Phase.MOVE:
            return
        self.phase = Phase.STOP
        inp, halt = self._inp, self._halt
        halt.current_position, halt.current_velocity = inp.current_position, inp.current_velocity
        halt.current_acceleration = inp.current_acceleration
        halt.max_velocity, halt.max_acceleration, halt.max_jerk = inp.max_velocity, inp.max_acceleration, inp.max_jerk
        self._active = halt

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        if self._piece_ended and (damaged := self._begin_next(state)) is not None:
            return self.give_up(state, damaged)
        ended = self._go_along(state)
        return self.setpoint if ended is None else self.give_up(state, ended)

    def _begin_next(self, state: ArmState) -> PlanDamaged | None:
        """Begin the next piece; return an error if it is damaged or does not start at the end of the last one."""
        assert self._rows is not None
        self._row += 1
        row, last = read_row(self._rows, self._row), self._piece
        damaged = damaged_line(row)
        if damaged is None and not hypot(row[0] - last[7], row[1] - last[8], row[2] - last[9]) <= AT_START_M:
            damaged = row[0]
        if damaged is None and not turn_between(last[10:14], row[3:7])[1] <= AT_START_RAD:
            damaged = row[3]
        if damaged is not None:
            return PlanDamaged(self._row, damaged)
        self._done_s = self.elapsed_s
        self._begin_piece(state, row)
        return None

    def _go_along(self, state: ArmState) -> MotionEnded | None:
        """Write the setpoints of the next cycle, or return why the line cannot continue."""
        result = self._step()
        if result < 0:
            return ControllerFailed()
        fraction: float = self._fraction
        x, y, z = self._from
        along, across, up = self._span
        turned = turned_by(self._rotation, self._axis, fraction * self._angle) if self._angle else self._rotation
        near = self._inverse.solve_near(
            Pose((x + fraction * along, y + fraction * across, z + fraction * up), turned), self._near
        )
        q = near.q
        if q is None:
            if near.limited >= 0:
                low, high, q_now = self.limits.low, self.limits.high, state.commanded[near.limited]
                nearer = min((low[near.limited], high[near.limited]), key=lambda edge: abs(edge - q_now))
                return JointLimitReached(near.limited, q_now, nearer)
            return OutOfReach(near.out_of_reach) if near.out_of_reach > 0.0 else NoSolution()
        position = list(q)
        if self._has_offset:
            share = _fade(fraction / _FADED)
            for i in self._joints:
                position[i] += self._offset[i] * share
        velocity, before, limits, over = self._velocity, state.commanded, self.limits.velocity, 1.0 / self.period_s
        for i in self._joints:
            velocity[i] = v = (position[i] - before[i]) * over
            if not -limits[i] * 1.000001 <= v <= limits[i] * 1.000001:
                return SetpointJump(i, v / over, limits[i] / over)
        if self._due():
            for singularity, distance in enumerate(self._singularities.distances(frames(self._model, position))):
                if distance < _BETWEEN_SAMPLES * self._nearest[singularity]:
                    return SingularityReached(singularity, distance, self._nearest[singularity])
        self._near = position if not self._has_offset else list(q)
        self.setpoint.position, self.setpoint.velocity = position, velocity
        self.elapsed_s = self._done_s + self._plan_s
        if result == Result.Finished:
            self._piece_ended = self.phase is Phase.MOVE and self._row < self._count - 1
            if not self._piece_ended:
                self.phase = Phase.HOLD
        return None

    def _step(self) -> Result:
        """Advance along the piece by one cycle, at the speed override."""
        if self.phase is Phase.MOVE and (self._is_scaled or self.speed_override.fraction != 1.0):
            # ruckig may find no plan because of rounding: try again in the next cycle.
            if not self._is_scaled and find_trajectory(self._otg, self._inp, [self._piece[16]], self._plan):
                self._is_scaled, self._done_s, self._plan_s = True, self.elapsed_s, 0.0
                self._time_scale.begin(1.0 if any(self._inp.current_velocity) else self.speed_override.fraction)
            if self._is_scaled:
                return self._follow_plan()
        output = self._output
        try:
            result = self._otg.update(self._active, output)
        except (RuckigError, ValueError):
            return Result.Error
        self._fraction, self._plan_s = output.new_position[0], output.time
        if result == Result.Working:
            output.pass_to_input(self._active)
        return result

    def _follow_plan(self) -> Result:
        inp, plan, scale, dt = self._inp, self._plan, self._time_scale, self.period_s
        before, goal = scale.speed, self.speed_override.fraction
        speed = 1.0
        if not goal == before == 1.0:
            # The end point of the cycle hardly depends on the change of u.
            _, along, _ = plan.at_time(self._plan_s + (before + 0.5 * scale.rate * dt) * dt)
            speed = scale.step(goal, along, inp.current_velocity, inp.max_acceleration, inp.max_jerk, dt)
        self._plan_s = min(self._plan_s + 0.5 * (before + speed) * dt, plan.duration)
        position, (along_it,), (bend,) = plan.at_time(self._plan_s)
        self._fraction = position[0]
        # Initial state of a stop.
        inp.current_position, inp.current_velocity = position, [speed * along_it]
        inp.current_acceleration = [speed * speed * bend + scale.rate * along_it]
        return Result.Finished if self._plan_s >= plan.duration else Result.Working

    def _due(self) -> bool:
        """Whether the singularities are due for a check; between two checks the tool moves at most 1 mm."""
        self._wait -= 1
        if self._wait > 0:
            return False
        self._wait = self._singularity_cycles
        return True


def _fade(x: float) -> float:
    """Return 1 to 0 for `x` from 0 to 1, with slope and curvature 0 at both ends."""
    return 1.0 - x * x * x * (10.0 + x * (6.0 * x - 15.0)) if x < 1.0 else 0.0


_SOMEWHERE = [0.2] * JOINTS


class Distances(NamedTuple):
    """Shoulder: distance of the wrist centre from the plane of axes 1 and 2, m; elbow, wrist: rad; inf: none exists."""

    shoulder: float
    elbow: float
    wrist: float


class Singularities:
    """The singularities of an arm: `kinematics.singularity_distances`, fast enough for a cycle.

    With axis 2 parallel to axis 3 and a spherical wrist, each distance is one factor of the Jacobian's determinant.

    Args:
        model: the geometry; the constructor finds out which of the three it has.
    """

    def __init__(self, model: ArmModel) -> None:
        shoulder, _, wrist, _ = singularity_distances(model, _SOMEWHERE)
        self._has_arm, self._has_wrist = shoulder is not None, wrist is not None
        self._scale = 1.0 / (model.constants[4][0] * model.constants[5][0]) if self._has_wrist else 0.0

    def distances(self, poses: Sequence[Pose]) -> Distances:
        """Return the three distances for the `frames` of a configuration."""
        shoulder = elbow = wrist = float("inf")
        fourth, fifth = poses[3], poses[4]
        if self._has_wrist:
            _, _, ax, _, _, ay, _, _, az = fourth[1]
            _, _, bx, _, _, by, _, _, bz = fifth[1]
            _, _, cx, _, _, cy, _, _, cz = poses[5][1]
            sine = (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)) * self._scale
            sine = sine if sine >= 0.0 else -sine
            wrist = asin(sine if sine < 1.0 else 1.0)
        if self._has_arm:
            (px, py, pz), (_, _, ax, _, _, ay, _, _, az) = poses[0]
            (sx, sy, sz), (_, _, bx, _, _, by, _, _, bz) = poses[1]
            ex, ey, ez = poses[2][0]
            wx, wy, wz = fifth[0]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            off = (nx * (wx - px) + ny * (wy - py) + nz * (wz - pz)) / sqrt(nx * nx + ny * ny + nz * nz)
            shoulder = off if off >= 0.0 else -off
            ux, uy, uz, fx, fy, fz = ex - sx, ey - sy, ez - sz, wx - ex, wy - ey, wz - ez
            across = bx * (uy * fz - uz * fy) + by * (uz * fx - ux * fz) + bz * (ux * fy - uy * fx)
            # A displacement along axis 2 has no effect: only the perpendicular part counts.
            along = ux * fx + uy * fy + uz * fz - (ux * bx + uy * by + uz * bz) * (fx * bx + fy * by + fz * bz)
            elbow = atan2(across if across >= 0.0 else -across, along if along >= 0.0 else -along)
        return Distances(shoulder, elbow, wrist)
