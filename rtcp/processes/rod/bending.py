"""Plan of a bend: two arms of a cell hold a straight rod and bring it to a wanted shape, as one motion in step.

The middle of the rod stays where it is held, both arms move about it. The plan is checked whole: joints, stability and
strain, the bodies of rod, chucks and arms, keep-out boxes. Weight is left out: it bends a rod of 1 mm by 0.3 m by 0.4
mm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise, product
from math import ceil, inf
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from kinematics import IDENTITY, Capsule, InverseKinematics, JointLimit, Placed, Pose, capsules, distance, forward
from kinematics.capsules import from_box
from kinematics.forward import frames
from rtcp.config.cell import CellConfig, Member
from rtcp.config.model import Point
from rtcp.ipc.errors import Refused, RtcpError
from rtcp.motion.guards.neighbours import Body
from rtcp.motion.limits import Limits
from rtcp.motion.planning.in_step import ACCELERATION_SHARE, SPEED_SHARE, Curve, check_apart, plan_brakes
from rtcp.motion.planning.plan import PlanRefused, PlanTooFast
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.processes.rod.continuation import bend, check
from rtcp.processes.rod.statics import Equilibrium, Rod, shoot

Array = npt.NDArray[np.float64]
HALF_TURN: Final = Pose((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0))
"""From the end of the rod, whose e1 points into the second chuck, to the mouth of that chuck."""
_LARGEST_JOINT_STEP: Final = 0.3
"""Largest step of a joint between two steps of the rod, rad; a larger one changes the branch."""
_POINT_S: Final = 0.1
_SMALLEST_PART: Final = 1e-4
_STRETCH: Final = 1.25
_ATTEMPTS: Final = 8
_WRIST: Final = 4
"""The first link that is always near the chuck: its distance to it is not checked."""
_OWN_ARC: Final = 20.0
"""Distance along the rod, in diameters, below which two places belong to one bend: a circle of 8 % strain has 39."""
_SAME_RAD: Final = 1e-4
_NEAR_STRAIGHT_RAD: Final = 0.1
"""Angle between the ends below which the rod is too near to the singular straight one to be solved by its end pose."""


@dataclass(frozen=True)
class Chuck:
    """A chuck on a flange: a cylinder from the flange to its mouth."""

    pose: Pose
    """The mouth from the flange; its x axis points out of the chuck, along the rod."""
    radius: float
    """Radius, m."""


@dataclass(frozen=True)
class BendingPlan:
    """A motion that bends a rod, and the rod along it.

    arms: points of each arm; both begin at rest with the straight rod. steps: the rod, in the frame of its start.
    times: of the steps, s. starts: poses of the rod's start in the world. curves: the rod in the world,
    (steps, nodes, 3), m. clearance: least distance of the rod to any other body, m.
    """

    arms: Mapping[str, tuple[Point, ...]]
    steps: tuple[Equilibrium, ...]
    times: tuple[float, ...]
    starts: tuple[Pose, ...]
    curves: Array
    clearance: float

    @property
    def trajectory(self) -> dict[str, list[dict[str, Any]]]:
        """The points as `Cell.run_trajectory` takes them."""
        return {name: [asdict(point) for point in points] for name, points in self.arms.items()}

    @property
    def begin(self) -> dict[str, tuple[float, ...]]:
        """Joint positions at which the arms hold the straight rod, rad."""
        return {name: points[0].q for name, points in self.arms.items()}

    @property
    def duration_s(self) -> float:
        """Duration, s."""
        return self.times[-1]


def plan_bending(
    cell: CellConfig,
    chucks: Mapping[str, Chuck],
    rod: Rod,
    end: Pose,
    held: Pose,
    near: Mapping[str, Sequence[float]],
) -> BendingPlan:
    """Return the plan from the straight rod to an end pose (frame of the rod's start); arguments as `plan_motion`.

    Raises:
        Refused: as `bend` and `plan_motion`.
    """
    return plan_motion(cell, chucks, bend(rod, end), held, near)


def plan_motion(
    cell: CellConfig,
    chucks: Mapping[str, Chuck],
    steps: Sequence[Equilibrium],
    held: Pose,
    near: Mapping[str, Sequence[float]],
) -> BendingPlan:
    """Return the plan of a continuous path of the rod (`rtcp.processes.rod.continuation`).

    Args:
        cell: with the two arms.
        chucks: by the names of their arms; the first one holds the start of the rod.
        steps: of the rod, from the straight one on.
        held: pose of the rod's middle in the world, x along the straight rod.
        near: joint positions, rad, that choose between the configurations of an arm.

    Raises:
        Invalid: not two arms of the cell, or not a number in `near` for each joint.
        Refused: `arm_out_of_reach`, `rod_collision`, `arms_too_near`, `rod_strain`, `rod_unstable`, with subject,
            place, value and limit; nothing is begun.
    """
    names = [arm.name for arm in cell.arms]
    if len(chucks) != 2 or not set(chucks) <= set(names) or set(near) != set(chucks):
        raise RtcpError(
            "invalid",
            f"chucks: found {', '.join(chucks) or 'none'}, near: found {', '.join(near) or 'none'}, allowed are two "
            f"arms of {', '.join(names)}, the same in both",
        )
    for name, q in near.items():
        if len(q) != (count := len(cell.member(name).config.joints)):
            raise RtcpError("invalid", f"near of {name}: found {len(q)} numbers, allowed are {count}, one a joint")
    for step in steps[1:]:
        check(step)
    holders = {name: _Holder(cell.member(name), chuck, cell.clearance) for name, chuck in chucks.items()}
    starts = tuple(held @ step.pose(len(step.s) // 2).inverse() for step in steps)
    tools = (starts, [start @ step.end @ HALF_TURN for start, step in zip(starts, steps, strict=True)])
    ways = [list(holder.paths(poses, near[name])) for (name, holder), poses in zip(holders.items(), tools, strict=True)]
    curves = np.array(
        [
            step.p @ np.reshape(start.rotation, (3, 3)).T + np.array(start.position)
            for start, step in zip(starts, steps, strict=True)
        ]
    )
    _check_curves(cell, curves, steps[0].rod.diameter)
    refused: RtcpError | None = None
    for pair in product(*ways):
        paths = dict(zip(holders, pair, strict=True))
        try:
            clearance = _check_rod(holders, paths, curves, steps[0].rod.diameter, cell.clearance)
            arms, times = _timed(cell, holders, paths)
            _check_between(holders, arms, steps, times)
        except Refused as error:
            refused = refused or error
            continue
        return BendingPlan(arms, tuple(steps), times, starts, curves, clearance)
    assert refused is not None
    raise refused


def plan_approach(
    cell: CellConfig,
    chucks: Mapping[str, Chuck],
    now: Mapping[str, Sequence[float]],
    begin: Mapping[str, Sequence[float]],
    speed: float,
) -> dict[str, list[dict[str, Any]]] | None:
    """Return the straight motion of all joints to where a plan begins, as `Cell.run_trajectory` takes it.

    It is checked as the bend is, with the chucks among the bodies, which the loops do not know.

    Args:
        cell: with the two arms.
        chucks: by the names of their arms.
        now: where the arms are commanded, rad.
        begin: where they are to be, rad.
        speed: of the fastest joint, rad/s.

    Returns:
        The points by arm; None: they are there.

    Raises:
        Refused: `arms_too_near`, with the obstacle; nothing is begun.
    """
    if all(abs(a - b) < _SAME_RAD for name, q in begin.items() for a, b in zip(now[name], q, strict=True)):
        return None
    holders = {name: _Holder(cell.member(name), chuck, cell.clearance) for name, chuck in chucks.items()}
    arms, _ = _timed(cell, holders, {name: (tuple(now[name]), tuple(begin[name])) for name in holders}, speed)
    return {name: [asdict(point) for point in points] for name, points in arms.items()}


class _Holder:
    """An arm with its chuck: the chuck's mouth is its tool, and the chuck the last of its bodies."""

    def __init__(self, member: Member, chuck: Chuck, clearance: float) -> None:
        model = member.config.arm
        if model is None:
            raise RtcpError("invalid", f"{member.name}: its geometry is not known: give its file `kinematics`")
        self.name, self.chuck, self.limits = member.name, chuck, Limits(member.config)
        x, y, z = chuck.pose.position
        a, _, _, d, _, _, g, _, _ = chuck.pose.rotation
        end = (x - chuck.radius * a, y - chuck.radius * d, z - chuck.radius * g)
        model = replace(
            model,
            tool=chuck.pose,
            limits=tuple(JointLimit(*both) for both in zip(self.limits.low, self.limits.high, strict=True)),
            bodies=(*capsules(replace(model, tool=IDENTITY)), Capsule(6, (0.0, 0.0, 0.0), end, chuck.radius)),
        )
        base = Pose.from_xyzrpy(*member.base.position, *member.base.rpy)
        self.body = Body(model, base, self.limits.acceleration)
        self._solver = InverseKinematics(model)
        self._clearance = clearance
        self._boxes = [(box.name, (*box.min, *box.max)) for box in member.config.cartesian.keep_out]
        self._local = Placed(capsules(model))
        self._chuck = len(self._local.radii) - 1
        self._local.place(frames(model, [0.0] * len(self.limits.low)))
        self._pairs = [
            (which, self._chuck)
            for which, part in enumerate(self._local.bodies)
            if part.link < _WRIST and distance(self._local, self._local, ((which, self._chuck),))[0] > 0.0
        ]

    def zone_at(self, q: Sequence[float]) -> str | None:
        """Return the obstacle too near to the chuck, in words: a keep-out box or its own arm; None: nothing."""
        self._local.place(frames(self.body.model, q))
        for name, box in self._boxes:
            if from_box(self._local, self._chuck, box)[0] < self._clearance:
                return f"the keep-out box {name} (with the chuck of {self.name})"
        apart, link, _ = distance(self._local, self._local, self._pairs)
        if apart < self._clearance:
            return f"a collision with itself (chuck of {self.name} and link {self._local.bodies[link].link})"
        return None

    def paths(self, poses: Sequence[Pose], near: Sequence[float]) -> Iterator[list[tuple[float, ...]]]:
        """Yield the continuous joint paths that lead the chuck through poses in the world, the nearest first.

        Raises:
            Refused: there is none; with the reason for the end of the longest one.
        """
        back = self.body.base.inverse()
        local = [back @ pose for pose in poses]
        first = self._solver.solve(local[0], near)
        starts = [solution.q for solution in first.solutions if solution.within_limits]
        starts.sort(key=lambda q: max(abs(a - b) for a, b in zip(q, near, strict=True)))
        farthest, reason, count = 0, first.reason or "every configuration there is beyond a joint limit", 0
        for start in starts:
            path = [start]
            for number, pose in enumerate(local[1:], 1):
                following = self._solver.solve_near(pose, path[-1])
                problem = following.reason
                if following.q is not None:
                    step = max(abs(a - b) for a, b in zip(following.q, path[-1], strict=True))
                    if step <= _LARGEST_JOINT_STEP:
                        path.append(following.q)
                        continue
                    problem = f"a joint would jump by {step:.3g} rad, {_LARGEST_JOINT_STEP:g} rad is allowed"
                if number > farthest:
                    farthest, reason = number, problem
                break
            else:
                count += 1
                yield [tuple(q) for q in path]
        if not count:
            raise RtcpError(
                "refused",
                f"{self.name}: at step {farthest} of {len(poses) - 1} of the bend: {reason}: hold the rod elsewhere",
                "arm_out_of_reach",
                {"arm": self.name, "step": farthest},
            )


def _check_curves(cell: CellConfig, curves: Array, diameter: float) -> None:
    """Check that the rod keeps clear of itself and of every arm's keep-out boxes; raises Refused."""
    count = curves.shape[1] - 1
    segment = float(np.linalg.norm(np.diff(curves[0], axis=0), axis=1)[0])
    gap = max(ceil(_OWN_ARC * diameter / segment), 2)
    own = [(i, j) for i in range(count) for j in range(i + gap, count)]
    for number, curve in enumerate(curves):
        rod = _placed(curve, 0.5 * diameter)
        apart, place, second = distance(rod, rod, own)
        if apart <= 0.0:
            raise RtcpError(
                "refused",
                f"at step {number} of {len(curves) - 1} the rod would touch itself, {place * segment:.3f} and "
                f"{second * segment:.3f} m from its start: bend it less",
                "rod_collision",
                {"step": number, "distance": apart, "s": place * segment},
            )
        for member in cell.arms:
            boxes = member.config.cartesian.keep_out
            if not boxes:
                continue
            back = Pose.from_xyzrpy(*member.base.position, *member.base.rpy).inverse()
            local = _placed(curve @ np.reshape(back.rotation, (3, 3)).T + np.array(back.position), 0.5 * diameter)
            for box in boxes:
                near = [from_box(local, which, (*box.min, *box.max))[0] for which in range(count)]
                if min(near) < cell.clearance:
                    at = int(np.argmin(near)) * segment
                    raise RtcpError(
                        "refused",
                        f"at step {number} of {len(curves) - 1} the rod, {at:.3f} m from its start, would be "
                        f"{min(near):.3f} m from the keep-out box {box.name} of {member.name}, allowed is at least "
                        f"{cell.clearance:g} m: hold the rod elsewhere",
                        "rod_collision",
                        {"arm": member.name, "step": number, "distance": min(near), "s": at},
                    )


def _placed(curve: Array, radius: float) -> Placed:
    rod = Placed([Capsule(0, a, b, radius) for a, b in pairwise(map(tuple, curve.tolist()))])
    rod.place(())
    return rod


def _check_rod(
    holders: Mapping[str, _Holder],
    paths: Mapping[str, Sequence[Sequence[float]]],
    curves: Array,
    diameter: float,
    clearance: float,
) -> float:
    """Return the least distance of the rod to arms and chucks, less half of the motion between two steps.

    The rod may be nearer to its own chuck than the clearance: its end is inside.
    """
    least, count = np.inf, curves.shape[1] - 1
    segment = float(np.linalg.norm(np.diff(curves[0], axis=0), axis=1)[0])
    moved = np.abs(np.diff(curves, axis=0, prepend=curves[:1])).max(axis=(1, 2))
    before = {name: np.zeros(0) for name in holders}
    for number, curve in enumerate(curves):
        rod = _placed(curve, 0.5 * diameter)
        for index, (name, holder) in enumerate(holders.items()):
            holder.body.place(paths[name][number])
            placed = holder.body.placed
            axes = np.array(placed.axes)
            ends = np.concatenate([axes.reshape(-1, 6)[:, :3], axes.reshape(-1, 6)[:, :3] + axes.reshape(-1, 6)[:, 3:]])
            travel = float(np.linalg.norm(ends - before[name], axis=1).max()) if number else 0.0
            before[name] = ends
            own = len(placed.radii) - 1
            inside = min(ceil(2.0 * holder.chuck.radius / segment), count)
            beyond = range(inside, count) if index == 0 else range(count - inside)
            between = 0.5 * (float(moved[number]) + travel)
            for pairs, allowed in (
                (product(range(count), range(own)), clearance),
                (product(beyond, (own,)), 0.0),
            ):
                apart, place, body = distance(rod, placed, tuple(pairs))
                if apart - between <= allowed:
                    part = f"link {placed.bodies[body].link}" if body != own else "chuck"
                    raise RtcpError(
                        "refused",
                        f"at step {number} of {len(curves) - 1} the rod, {place * segment:.3f} m from its start, would "
                        f"be {apart:.3f} m from {name} ({part}), allowed is more than {allowed + between:.3f} m: hold "
                        "the rod elsewhere",
                        "rod_collision",
                        {"arm": name, "step": number, "distance": apart, "s": place * segment},
                    )
                if body != own:
                    least = min(least, apart - between)
    return float(least)


def _timed(
    cell: CellConfig,
    holders: Mapping[str, _Holder],
    paths: Mapping[str, Sequence[Sequence[float]]],
    most: float = inf,
) -> tuple[dict[str, tuple[Point, ...]], tuple[float, ...]]:
    """Return the points of both arms and the times of the steps: one spline through the steps, one time law for both.

    The time law is 10 x^3 - 15 x^4 + 6 x^5; its duration is the least that keeps speeds, `most` (rad/s) of any joint
    among them, accelerations and jerks.
    """
    joints = np.hstack([np.asarray(path) for path in paths.values()])
    along = np.append(0.0, np.cumsum(np.abs(np.diff(joints, axis=0)).max(axis=1) + _SMALLEST_PART))
    along /= along[-1]
    spline = CubicSpline(along, joints)
    x = np.linspace(0.0, 1.0, 1001)
    law = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    position, speed, acceleration = _by_time(spline, x)
    jerk = np.gradient(acceleration, x, axis=0)
    limits = [holder.limits for holder in holders.values()]
    fastest = np.minimum(SPEED_SHARE * np.concatenate([limit.velocity for limit in limits]), most)
    strongest = ACCELERATION_SHARE * np.concatenate([limit.acceleration for limit in limits])
    jerkiest = np.concatenate([limit.jerk for limit in limits])
    duration = max(
        float((np.abs(speed) / fastest).max()),
        float((np.abs(acceleration) / strongest).max()) ** 0.5,
        float((np.abs(jerk) / jerkiest).max()) ** (1.0 / 3.0),
    )
    for attempt in range(_ATTEMPTS):
        count = max(ceil(duration / _POINT_S), 2)
        parts = np.linspace(0.0, 1.0, count + 1)
        position, speed, acceleration = _by_time(spline, parts)
        arms, first = {}, 0
        for name in holders:
            columns = slice(first, first + 6)
            arms[name] = tuple(
                Point(float(t), tuple(q[columns]), tuple(v[columns]), tuple(a[columns]))
                for t, q, v, a in zip(
                    duration * parts,
                    position.tolist(),
                    (speed / duration).tolist(),
                    (acceleration / duration**2).tolist(),
                    strict=True,
                )
            )
            first += 6
        try:
            _check_motion(cell, holders, arms)
        except PlanRefused as refused:
            too_fast = isinstance(refused, PlanTooFast)
            # Arms that approach may be too near for the stops of their speed; those of a bend have other ways.
            if attempt == _ATTEMPTS - 1 or not (too_fast or most < inf):
                reason = type(refused).__name__ if too_fast else "arms_too_near"
                raise RtcpError("refused", str(refused), reason) from None
            duration *= _STRETCH
            continue
        break
    return arms, tuple(float(t) for t in duration * np.interp(along, law, x))


def _by_time(spline: CubicSpline, x: Array) -> tuple[Array, Array, Array]:
    """Position, first and second derivative of the motion by the part x of its duration."""
    law = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    first, second = 30.0 * (x * (1.0 - x)) ** 2, 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)
    slope, bow = spline(law, 1), spline(law, 2)
    return spline(law), slope * first[:, None], bow * first[:, None] ** 2 + slope * second[:, None]


def _check_motion(cell: CellConfig, holders: Mapping[str, _Holder], arms: Mapping[str, tuple[Point, ...]]) -> None:
    """Check all that the gateway will check, with the chucks as bodies; raises PlanRefused."""
    curves = {}
    for name, points in arms.items():
        names = [f"{name} {joint.name}" for joint in cell.member(name).config.joints]
        holder = holders[name]
        plan = plan_trajectory(points, holder.limits, points[0].q, names=names, zone_at=holder.zone_at)
        curves[name] = Curve(plan.rows, len(points[0].q))
    plan_brakes(curves, {name: holder.limits for name, holder in holders.items()})
    bodies = {name: holder.body for name, holder in holders.items()}
    check_apart(curves, bodies, {}, cell.clearance, cell.longest_silence_s + cell.slowest_s)


def _check_between(
    holders: Mapping[str, _Holder],
    arms: Mapping[str, tuple[Point, ...]],
    steps: Sequence[Equilibrium],
    times: Sequence[float],
) -> None:
    """Check the rod at the points of the motion: the arms are there where no step is; raises Refused."""
    first, second = holders
    rod = steps[0].rod
    for point, opposite in zip(arms[first], arms[second], strict=True):
        nearest = steps[int(np.abs(np.array(times) - point.t).argmin())]
        if float(nearest.rotations[-1][0, 0]) > np.cos(_NEAR_STRAIGHT_RAD):
            continue
        start = holders[first].body.base @ forward(holders[first].body.model, point.q)
        end = holders[second].body.base @ forward(holders[second].body.model, opposite.q) @ HALF_TURN
        check(shoot(rod, start.inverse() @ end, nearest))
