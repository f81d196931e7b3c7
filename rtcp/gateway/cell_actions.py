"""Motions in step: planned here for all arms of the cell, run here for this one."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Final

from annotated_types import Ge, Gt

from rtcp.config.cell import Member
from rtcp.config.model import Point
from rtcp.config.numbers import Name
from rtcp.gateway.command_channel import Caller, Json
from rtcp.gateway.method import Numbers, index_of, method
from rtcp.gateway.motion_actions import MotionActions
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.session import Session
from rtcp.ipc.states import State
from rtcp.motion.guards.neighbours import body_of
from rtcp.motion.limits import Limits
from rtcp.motion.planning.in_step import Curve, Way, check_apart, plan_brakes, plan_moves
from rtcp.motion.planning.plan import PlanRefused
from rtcp.motion.planning.trajectories import plan_trajectory

_SAME_S: Final = 1e-6


@dataclass(frozen=True)
class StepTarget:
    """Target of an arm in a motion in step: joint positions, rad, or points of a trajectory that begins at time 0."""

    arm: Name
    q: tuple[float, ...] = ()
    points: tuple[Point, ...] = ()


class CellActions:
    """Plans and runs motions in step; every method raises RtcpError.

    Args:
        session: the running platform.
        motion: moves this arm.
        limits: of this arm, in force.
    """

    def __init__(self, session: Session, motion: MotionActions, limits: Limits) -> None:
        self._session = session
        self._motion = motion
        self._limits = limits

    def _members(self) -> dict[str, Member]:
        cell = self._session.cell
        if cell is None:
            raise RtcpError("refused", "this arm is in no cell: start it by `rtcp cell start`")
        return {arm.name: arm for arm in cell.arms}

    @method(at_once=True)
    async def plan_in_step(
        self, caller: Caller, targets: tuple[StepTarget, ...], speed: Annotated[float, Gt(0)] | None = None
    ) -> Json:
        """Plan a motion of several arms of the cell that begin and end together; nothing moves.

        Each target names an `arm` and has joint positions `q`, rad, or `points` of a trajectory; `speed`: of the
        fastest joint, rad/s. Returns `points` of each arm, `duration_s`, and the table of the group's brakes:
        parameters of `run_in_step` of each arm.
        """
        members = self._members()
        names = [target.arm for target in targets]
        for name in names:
            index_of("arm", name, list(members))
        if not targets or len(set(names)) != len(names):
            raise RtcpError("invalid", f"targets: found {names}, allowed are one or more arms, each once")
        if len({bool(target.points) for target in targets}) > 1:
            raise RtcpError("invalid", "targets: found positions and trajectories, allowed is one kind for all arms")
        return await asyncio.to_thread(self._plan, targets, speed, members)

    def _plan(self, targets: Sequence[StepTarget], speed: float | None, members: dict[str, Member]) -> Json:
        cell = self._session.cell
        assert cell is not None
        begin = {target.arm: self._commanded(members[target.arm]) for target in targets}
        limits = {target.arm: self._limits_of(members[target.arm]) for target in targets}
        try:
            if targets[0].points:
                points = {target.arm: target.points for target in targets}
            else:
                ways = {target.arm: Way(limits[target.arm], begin[target.arm], target.q) for target in targets}
                points = plan_moves(ways, speed)
            paths = {}
            for name, waypoints in points.items():
                names = [f"{name} {joint.name}" for joint in members[name].config.joints]
                plan = plan_trajectory(waypoints, limits[name], begin[name], names=names)
                if plan.rows[0][0] != 0.0:
                    raise PlanRefused(f"{name}: its first point is at {plan.rows[0][0]:g} s, in step 0 is allowed")
                paths[name] = Curve(plan.rows, len(names))
            durations = {name: path.duration_s for name, path in paths.items()}
            if max(durations.values()) - min(durations.values()) > _SAME_S:
                listed = ", ".join(f"{name} {duration:g} s" for name, duration in durations.items())
                raise PlanRefused(f"the trajectories last {listed}: in step all end together, give them one duration")
            brakes = plan_brakes(paths, limits)
            bodies = {name: body for name, arm in members.items() if (body := body_of(arm)) is not None}
            rests = {name: q for name in members if name not in paths and (q := self._standing(members[name]))}
            check_apart(paths, bodies, rests, cell.clearance, cell.longest_silence_s + cell.slowest_s)
        except PlanRefused as refused:
            raise RtcpError("refused", str(refused), type(refused).__name__) from None
        return {
            "arms": [{"arm": name, "points": [asdict(point) for point in entry]} for name, entry in points.items()],
            "duration_s": max(path.duration_s for path in paths.values()),
            "brakes": list(brakes.times),
            "brake_step_s": brakes.step_s,
        }

    def _limits_of(self, member: Member) -> Limits:
        return self._limits if member.name == self._session.name else Limits(member.config)

    def _standing(self, member: Member) -> list[float]:
        """Return the position of an arm that does not take part, rad; empty if it does not run."""
        try:
            return self._commanded(member)
        except RtcpError:
            return []

    @staticmethod
    def _commanded(member: Member) -> list[float]:
        """Return the commanded position of an arm, rad."""
        try:
            with contextlib.closing(Observer(blackboard_file(member.directory))) as observer:
                record = observer.latest()
                if record is None:
                    raise BlackboardError("its loop has published no record yet")
                which = "commanded" if int(record["state"][0]) in (State.HOLDING, State.MOVING) else "actual"
                return [float(q) for q in record[f"{which}_position"][0]]
        except BlackboardError as error:
            raise RtcpError("refused", f"{member.name} does not run: {error}", "partner_missing") from None

    @method()
    async def run_in_step(
        self,
        caller: Caller,
        points: tuple[Point, ...],
        motion: Annotated[int, Ge(1)],
        start_ns: int,
        brakes: Numbers,
        brake_step_s: Annotated[float, Gt(0)],
        partners: tuple[str, ...] = (),
    ) -> Json:
        """Run what `plan_in_step` returned for this arm, from `start_ns` on (CLOCK_MONOTONIC, ns).

        It begins if all partners named have accepted the same number `motion` by then; it ends for all when it ends for
        one. Returns as `move_joints`.
        """
        mask = self.mask_of(partners)
        await asyncio.to_thread(self._check_brakes, points, brakes, brake_step_s)
        return await self._motion.run_in_step(caller, points, motion, mask, start_ns, brakes, brake_step_s)

    def _check_brakes(self, points: Sequence[Point], brakes: Sequence[float], step_s: float) -> None:
        """Check that this arm can brake within the times of the table; raises RtcpError."""
        begin, name = self._motion.plan_start(), self._session.name
        try:
            plan = plan_trajectory(points, self._limits, begin)
            needed = plan_brakes({name: Curve(plan.rows, len(begin))}, {name: self._limits})
        except PlanRefused as refused:
            raise RtcpError("refused", str(refused), type(refused).__name__) from None
        same = len(needed.times) == len(brakes) and abs(needed.step_s - step_s) < _SAME_S
        if not same or any(time_s < least - _SAME_S for time_s, least in zip(brakes, needed.times, strict=True)):
            raise RtcpError("invalid", "brakes: this arm cannot brake as the table says: take that of `plan_in_step`")

    def mask_of(self, partners: Sequence[str]) -> int:
        """Return the bits of partners by their names; raises RtcpError."""
        names = self._session.partners
        for name in partners:
            if name not in names:
                allowed = f"one of {', '.join(names)}" if names else "none: this arm has no partners"
                raise RtcpError("invalid", f'partners: found the text "{name}", allowed is {allowed}')
        return sum(1 << names.index(name) for name in set(partners))
