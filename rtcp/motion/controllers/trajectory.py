"""Timed joint waypoints joined by cubics or quintics, of a plan that `rtcp.motion.planning` has checked.

An `Approach` leads to a first waypoint with a time above 0; a `TimeScale` stops the arm along the path and applies the
speed override.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final, NamedTuple

from ruckig import InputParameter, Ruckig, Trajectory

from rtcp.ipc.commands import Command, ExtendTrajectory, RunTrajectory
from rtcp.ipc.events import MotionEnded, OutOfPoints, PlanDamaged
from rtcp.ipc.layout import PLAN_ROWS
from rtcp.ipc.refusals import (
    ApproachImpossible,
    DamagedRow,
    NoRoomForPoints,
    NotOpen,
    PlanStartsElsewhere,
    PlanStartsMoving,
    Refusal,
)
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import allowed_acceleration, find_trajectory, leaves_range
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import Coefficients, cubic, quintic
from rtcp.motion.planning.plan import (
    ACCELERATIONS,
    CUBIC,
    KIND,
    LONGEST_S,
    POSITIONS,
    QUINTIC,
    VELOCITIES,
    first_not_finite,
    read_row,
)
from rtcp.motion.speed_override import STOP, TimeScale
from rtcp.motion.state import ArmState, Phase, Setpoint

AT_START_RAD: Final = 1e-3
"""Upper bound on the distance of a waypoint at time 0 from the setpoint, rad; the difference fades out."""
AT_START_RAD_S: Final = 1e-2
"""Upper bound on the difference of their velocities, rad/s."""
_FADE_S: Final = 0.5
_EXACT: Final = 1e-12
_AT_ONCE_S: Final = 1e-9
_SLACK: Final = 1e-6
_INSIDE = 1.0 - 1e-9


class NoApproach(NamedTuple):
    """Why no approach exists: joint that would leave its range, and its extreme, rad; -1: any other reason."""

    axis: int
    extreme: float


class Approach:
    """A trajectory to a waypoint that arrives at the waypoint's time, or later if the limits require it.

    Args:
        limits: of the joints; read in each `plan`.
    """

    def __init__(self, limits: Limits) -> None:
        n = len(limits.velocity)
        self._limits = limits
        self._otg = Ruckig(n, 0.001)
        self._inp = InputParameter(n)
        # Double buffer: a new plan replaces the current one only if planning succeeds.
        self._trajectory, self._spare = Trajectory(n), Trajectory(n)
        self.duration_s = 0.0

    def at(self, time_s: float) -> tuple[list[float], list[float], list[float]]:
        """Return position, velocity and acceleration of each joint."""
        state: tuple[list[float], list[float], list[float]] = self._trajectory.at_time(time_s)
        return state

    def plan(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        waypoint: Sequence[float],
    ) -> NoApproach | None:
        """Plan from a state (rad, rad/s, rad/s^2) to a waypoint; return why it fails, or None."""
        inp, limits, n = self._inp, self._limits, len(position)
        bounds = limits.acceleration
        inp.current_position, inp.current_velocity = list(position), list(velocity)
        inp.current_acceleration = [
            allowed_acceleration(acceleration[i], velocity[i], limits.velocity[i], bounds[i], limits.jerk[i])
            for i in range(n)
        ]
        inp.target_position, inp.target_velocity = (
            list(waypoint[POSITIONS : POSITIONS + n]),
            list(waypoint[VELOCITIES : VELOCITIES + n]),
        )
        # The acceleration at the start of a cubic is free.
        wanted = waypoint[ACCELERATIONS : ACCELERATIONS + n] if waypoint[KIND] == QUINTIC else [0.0] * n
        inp.target_acceleration = [min(max(a, -b * _INSIDE), b * _INSIDE) for a, b in zip(wanted, bounds, strict=True)]
        inp.max_velocity = [max(b, abs(v)) for b, v in zip(limits.velocity, velocity, strict=True)]
        inp.max_acceleration = list(bounds)
        inp.minimum_duration = waypoint[0]
        if not find_trajectory(self._otg, inp, limits.jerk, self._spare) or self._spare.duration > LONGEST_S:
            return NoApproach(-1, 0.0)
        if (departure := leaves_range(self._spare, position, limits)) is not None:
            return NoApproach(*departure)
        self._trajectory, self._spare = self._spare, self._trajectory
        self.duration_s = self._trajectory.duration
        return None


class TrajectoryController(Controller):
    """Accepts `RunTrajectory`, and `ExtendTrajectory` during an open one."""

    name = "trajectory"
    pausable = True
    commands: ClassVar[tuple[type[Command], ...]] = (RunTrajectory, ExtendTrajectory)

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        n = len(self._zero)
        self._time_scale = TimeScale()
        self._approach = Approach(setup.limits)
        self._approach_s = 0.0
        self._position = [0.0] * n
        self._velocity = [0.0] * n
        self._pieces: list[Coefficients] = [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)] * n
        self._fade: list[Coefficients] = list(self._pieces)
        self._fade_s = 0.0
        self._waypoint = [0.0] * 20
        self._rows: memoryview[float] | None = None
        self._row = self._count = 0
        self._from_s = self._to_s = 0.0
        self._delay_s = 0.0
        self._open = False
        """Whether more rows may follow."""

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Run a plan of waypoints (`rtcp.motion.planning.plan`) from `state`.

        If the first waypoint's time is 0, the arm must be there. Otherwise an approach leads there under the joint
        limits; it ends at the waypoint's time, or later if the limits require it, which delays all that follows. After
        a refusal the current motion continues.
        """
        if isinstance(command, ExtendTrajectory):
            return self._extend(command, continues)
        assert isinstance(command, RunTrajectory)
        return self.take(command.slot, command.rows, command.open, state)

    def take(self, slot: int, count: int, is_open: bool, state: ArmState) -> Refusal | None:
        """Begin with the rows in a slot of the plan area, or return a refusal and change nothing."""
        rows = self.rows_of(slot, count, PLAN_ROWS)
        if isinstance(rows, Refusal):
            return rows
        first, last = read_row(rows, 0), read_row(rows, count - 1)
        for index, row in ((0, first), (count - 1, last)):
            if (damaged := self._damage(row)) is not None:
                return DamagedRow(index, damaged)
        refusal = self._is_elsewhere(state, first) if first[0] == 0.0 else self._approach_to(first, state)
        if refusal is not None:
            return refusal
        self.begin()
        self._time_scale.begin(1.0 if any(state.commanded_velocity) else self.speed_override.fraction)
        self._fade_s = self._approach_s = 0.0
        if first[0] == 0.0:
            self._fade_out(state, first, last[0])
        else:
            self._approach_s = self._approach.duration_s
        self._rows, self._row, self._count, self._open = rows, 0, count, is_open
        self._waypoint = first
        self._delay_s = max(self._approach_s - first[0], 0.0)
        self._from_s = self._to_s = first[0] + self._delay_s
        self.duration_s = last[0] + self._delay_s
        return None

    def _extend(self, command: ExtendTrajectory, continues: bool) -> Refusal | None:
        rows, count = self._rows, command.rows
        if not (continues and self._open and self.phase is Phase.MOVE) or rows is None:
            return NotOpen()
        # The row that the current piece starts from is still in use.
        if not (self._count <= count <= self._row + PLAN_ROWS):
            return NoRoomForPoints(count - self._row, PLAN_ROWS)
        last = read_row(rows, (count - 1) % PLAN_ROWS)
        if (damaged := self._damage(last)) is not None:
            return DamagedRow(count - 1, damaged)
        self._count, self._open = count, not command.ends
        self.duration_s = last[0] + self._delay_s
        return None

    def _approach_to(self, first: list[float], state: ArmState) -> Refusal | None:
        refused = self._approach.plan(state.commanded, state.commanded_velocity, state.commanded_acceleration, first)
        return None if refused is None else ApproachImpossible()

    def _damage(self, row: list[float]) -> float | None:
        """Return the invalid number of a damaged row, or None."""
        column = first_not_finite(row)
        if column >= 0:
            return row[min(column, KIND)]
        if not 0.0 <= row[0] <= LONGEST_S:
            return row[0]
        if row[KIND] not in (CUBIC, QUINTIC):
            return row[KIND]
        limits = self.limits
        for i in self._joints:
            q, v = row[POSITIONS + i], row[VELOCITIES + i]
            if not limits.low[i] - _SLACK <= q <= limits.high[i] + _SLACK:
                return q
            if not -limits.velocity[i] - _SLACK <= v <= limits.velocity[i] + _SLACK:
                return v
        return None

    def _is_elsewhere(self, state: ArmState, first: list[float]) -> Refusal | None:
        for i in self._joints:
            if not abs(state.commanded[i] - first[POSITIONS + i]) <= AT_START_RAD:
                return PlanStartsElsewhere(i, first[POSITIONS + i], state.commanded[i])
            if not abs(state.commanded_velocity[i] - first[VELOCITIES + i]) <= AT_START_RAD_S:
                return PlanStartsMoving(i, first[VELOCITIES + i], state.commanded_velocity[i])
        return None

    def _fade_out(self, state: ArmState, first: list[float], last_s: float) -> None:
        for i in self._joints:
            ahead, faster = (
                state.commanded[i] - first[POSITIONS + i],
                state.commanded_velocity[i] - first[VELOCITIES + i],
            )
            if abs(ahead) > _EXACT or abs(faster) > _EXACT:
                self._fade_s = min(_FADE_S, last_s)
            self._fade[i] = quintic(ahead, faster, 0.0, 0.0, 0.0, 0.0, min(_FADE_S, last_s))

    def stop(self, state: ArmState) -> None:
        """Brake along the path as fast as the joint limits allow."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        target, dt = self.setpoint, self.period_s
        scale, moves = self._time_scale, self.phase is Phase.MOVE
        goal = self.speed_override.fraction if moves else STOP
        before = scale.speed
        if goal == before == 1.0:
            if (damaged := self._go_to(self.elapsed_s + dt)) is not None:
                return self.give_up(state, damaged)
            self.elapsed_s = min(self.elapsed_s + dt, self.duration_s)
            speed = 1.0
        else:
            limits = self.limits
            # The end point of the cycle hardly depends on the change of u.
            if (damaged := self._go_to(self.elapsed_s + (before + 0.5 * scale.rate * dt) * dt)) is not None:
                return self.give_up(state, damaged)
            speed = scale.step(goal, self._velocity, state.commanded_velocity, limits.acceleration, limits.jerk, dt)
            self.elapsed_s = min(self.elapsed_s + 0.5 * (before + speed) * dt, self.duration_s)
            if (damaged := self._go_to(self.elapsed_s)) is not None:
                return self.give_up(state, damaged)
            velocity = self._velocity
            for i in self._joints:
                velocity[i] *= speed
        if speed == 0.0 and not moves:
            self.phase = Phase.HOLD
        elif self.elapsed_s >= self.duration_s - _AT_ONCE_S and (ended := self._arrive()) is not None:
            return self.give_up(state, ended)
        target.position, target.velocity = self._position, self._velocity
        return target

    def _arrive(self) -> MotionEnded | None:
        """Come to rest at the end; return an error if rows are missing or the plan does not end at rest."""
        self.phase = Phase.HOLD
        for i in self._joints:
            speed = self._velocity[i]
            if not -_SLACK < speed < _SLACK:
                return OutOfPoints() if self._open else PlanDamaged(self._count - 1, speed)
            self._velocity[i] = 0.0
        if self._open:
            self.ended = OutOfPoints()
        return None

    def _go_to(self, at_s: float) -> PlanDamaged | None:
        """Write position and velocity at path time `at_s`, or return where the plan is damaged."""
        position, velocity = self._position, self._velocity
        if at_s < self._approach_s:
            position[:], velocity[:], _ = self._approach.at(at_s)
            return None
        while at_s > self._to_s and self._row < self._count - 1:
            if (damaged := self._next()) is not None:
                return damaged
        length = self._to_s - self._from_s
        if length > 0.0:
            x = (at_s - self._from_s) / length
            x = 1.0 if x > 1.0 else x
            over = 1.0 / length
            for i, (c0, c1, c2, c3, c4, c5) in enumerate(self._pieces):
                position[i] = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
                velocity[i] = (c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) * over
        else:
            waypoint = self._waypoint
            n = len(position)
            position[:], velocity[:] = waypoint[POSITIONS : POSITIONS + n], waypoint[VELOCITIES : VELOCITIES + n]
        if at_s < self._fade_s:
            x, over = at_s / self._fade_s, 1.0 / self._fade_s
            for i, (c0, c1, c2, c3, c4, c5) in enumerate(self._fade):
                position[i] += c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
                velocity[i] += (c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) * over
        return None

    def _next(self) -> PlanDamaged | None:
        """Set the piece to the next waypoint as the current one, or return that it is damaged."""
        rows = self._rows
        assert rows is not None
        index = self._row + 1
        before, waypoint = self._waypoint, read_row(rows, index % PLAN_ROWS)
        damaged = self._damage(waypoint)
        length = waypoint[0] - before[0]
        if damaged is None and not 0.0 < length <= LONGEST_S:
            damaged = waypoint[0]
        if damaged is not None:
            return PlanDamaged(index, damaged)
        pieces = self._pieces
        if waypoint[KIND] == CUBIC:
            for i in self._joints:
                pieces[i] = cubic(
                    before[POSITIONS + i],
                    before[VELOCITIES + i],
                    waypoint[POSITIONS + i],
                    waypoint[VELOCITIES + i],
                    length,
                )
        else:
            for i in self._joints:
                pieces[i] = quintic(
                    before[POSITIONS + i],
                    before[VELOCITIES + i],
                    before[ACCELERATIONS + i],
                    waypoint[POSITIONS + i],
                    waypoint[VELOCITIES + i],
                    waypoint[ACCELERATIONS + i],
                    length,
                )
        self._row, self._waypoint = index, waypoint
        self._from_s, self._to_s = before[0] + self._delay_s, waypoint[0] + self._delay_s
        return None
