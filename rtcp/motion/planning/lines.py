"""Plans of straight lines: every point in reach on one branch, away from singularities, inside limits and zones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, hypot, inf, isfinite, sqrt
from typing import TYPE_CHECKING, Final

from ruckig import InputParameter, Ruckig, RuckigError, Trajectory

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import singularity_distances
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.config.model import MOST_POINTS, CartesianConfig, Stop
from rtcp.motion.planning.interpolation import Quaternion, quaternion, rotation, turn_between, turned_by
from rtcp.motion.planning.plan import KIND, LINE, LONGEST_S, AlreadyThere, Plan, PlanRefused, ZoneAt

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

PoseAt = Callable[[float], Pose]
"""Maps the fraction of a line or an arc, 0 to 1, to its pose."""
SAMPLE_M, SAMPLE_RAD = 0.002, 0.01
"""Largest tool motion between two checked samples of a line."""
_JUMP_RAD: Final = 0.3
"""A larger joint motion between two samples is a change of branch or a singularity."""
_UNUSED = (0.0,) * (KIND - 19)
NO_WAY_M, NO_WAY_RAD = 1e-6, 1e-6
OF_LIMIT: Final = 0.95
"""Share of the joint limits that a line uses, so that they also hold between the samples."""
_SAME_RAD: Final = 1e-3
_TRIES, _A_LITTLE_LESS = 3, 1.0 - 1e-4


@dataclass(frozen=True)
class _Piece:
    """A straight piece, the joints along it, and the number of its stop."""

    number: int
    start: Pose
    end: Pose
    turns: tuple[Quaternion, Quaternion]
    length: float
    angle: float
    joints: list[tuple[float, ...]]
    speed: float


def plan_lines(
    model: ArmModel,
    limits: Limits,
    cartesian: CartesianConfig,
    q_now: Sequence[float],
    stops: Sequence[Stop],
    *,
    speed: float | None = None,
    zone_at: ZoneAt | None = None,
) -> Plan:
    """Return the plan of straight lines for `LineController`, from the arm's position, at rest at each stop.

    Args:
        model: the arm.
        limits: of the joints; a line that would exceed them is slowed down.
        cartesian: speeds, accelerations and jerks of the tool, and its least distances to singularities.
        q_now: commanded position, at rest, rad, shape (6,).
        stops: at least one; a stop at the tool's present pose is skipped.
        speed: for stops without their own, m/s; None: that of `cartesian`.
        zone_at: called for every sample.

    Raises:
        PlanRefused: with the stop, the distance along its line, the value and its limit.
    """
    if not stops:
        raise PlanRefused("the path has no poses, at least one is needed")
    if len(stops) > MOST_POINTS:
        raise PlanRefused(f"the path has {len(stops)} poses, at most {MOST_POINTS} are allowed")
    inverse = InverseKinematics(model)
    rows: list[tuple[float, ...]] = []
    here, q = forward(model, q_now), tuple(q_now)
    length = 0.0
    slowed = 1.0
    for number, stop in enumerate(stops, 1):
        where = f"the line to pose {number}" if len(stops) > 1 else "the line"
        goal = goal_of(model, stop, where)
        fast = speed_of(stop, speed, cartesian, where)
        orientations = quaternion(here.rotation), quaternion(goal.rotation)
        distance = hypot(*(b - a for a, b in zip(here.position, goal.position, strict=True)))
        _, angle = turn_between(*orientations)
        if distance > NO_WAY_M or angle > NO_WAY_RAD:
            joints = follow(inverse, limits, cartesian, straight(here, goal), (distance, angle), q, where, zone_at)
            piece = _Piece(number, here, goal, orientations, distance, angle, joints, fast)
            row, part = _timed(piece, limits, cartesian, where)
            rows.append(row)
            length, slowed = length + distance, min(slowed, part)
            q, here = joints[-1], goal
        check_branch(stop, q, where, model)
    if not rows:
        raise AlreadyThere("the tool is already where the path leads, there is nothing to move")
    duration = 0.0
    for at in range(len(rows) - 1, -1, -1):
        duration += rows[at][18]
        if not duration <= LONGEST_S:
            raise PlanRefused(f"the path would take {duration:g} s, at most {LONGEST_S:g} s are allowed: move faster")
        rows[at] = (*rows[at][:18], duration, *rows[at][19:])
    return Plan(tuple(rows), duration, length, slowed, q)


def goal_of(model: ArmModel, stop: Stop, where: str) -> Pose:
    """Return the pose of a stop, or raise PlanRefused."""
    target = stop.pose if stop.q is None else stop.q
    if target is None or (stop.pose is not None and stop.q is not None):
        raise PlanRefused(f"{where}: either a pose or joint positions are needed")
    if len(target) != 6:
        raise PlanRefused(f"{where}: found {len(target)} numbers, 6 are needed")
    for number in target:
        if not isfinite(number):
            raise PlanRefused(f"{where}: found {number} in its end, numbers are needed")
    return Pose.from_xyzrpy(*target) if stop.q is None else forward(model, target)


def speed_of(stop: Stop, of_path: float | None, cartesian: CartesianConfig, where: str) -> float:
    """Return the tool's speed towards a stop, m/s, or raise PlanRefused."""
    speed = stop.speed if stop.speed is not None else of_path if of_path is not None else cartesian.speed
    if not isfinite(speed) or not 0.0 < speed <= cartesian.speed:
        raise PlanRefused(
            f"{where}: found a speed of {speed:g} m/s, allowed is more than 0 and at most {cartesian.speed:g} m/s "
            f"(cartesian.speed)"
        )
    return speed


def straight(start: Pose, end: Pose) -> PoseAt:
    """Return the poses of a straight line as a function of its fraction."""
    from_q, to_q = quaternion(start.rotation), quaternion(end.rotation)
    axis, angle = turn_between(from_q, to_q)
    direction = [b - a for a, b in zip(start.position, end.position, strict=True)]
    turned = rotation(from_q)

    def pose_at(x: float) -> Pose:
        px, py, pz = (a + x * w for a, w in zip(start.position, direction, strict=True))
        return Pose((px, py, pz), turned_by(turned, axis, x * angle))

    return pose_at


def follow(
    inverse: InverseKinematics,
    limits: Limits,
    cartesian: CartesianConfig,
    pose_at: PoseAt,
    extent: tuple[float, float],
    q: tuple[float, ...],
    where: str,
    zone_at: ZoneAt | None,
    least: int = 0,
) -> list[tuple[float, ...]]:
    """Return the joints along a line or an arc, at even fractions of it, each checked.

    Args:
        inverse: of the arm.
        limits: of the joints.
        cartesian: least distances to singularities.
        pose_at: maps the fraction, 0 to 1, to the pose.
        extent: distance, m, and angle, rad, of the tool's motion.
        q: joints at the start, rad.
        where: name of the line in error messages.
        zone_at: called for every sample.
        least: lower bound on the number of samples.

    Raises:
        PlanRefused: with the place on the line, the value and its limit.
    """
    length, angle = extent
    count = max(8, least, ceil(length / SAMPLE_M), ceil(angle / SAMPLE_RAD))
    path: list[tuple[float, ...]] = []
    names = inverse.model.joint_names
    for k in range(count + 1):
        x = k / count
        place = f"{where} at {x * length:.3f} m of {length:.3f} m" if length > 1e-4 else (
            f"{where} at {x * angle:.3f} rad of {angle:.3f} rad"
        )  # fmt: skip
        near = inverse.solve_near(pose_at(x), q)
        if near.q is None:
            raise PlanRefused(f"{place}: {near.reason}")
        check_singular(inverse.model, near.q, cartesian, place)
        for i, (before, after) in enumerate(zip(q, near.q, strict=True)):
            if abs(after - before) > _JUMP_RAD:
                raise PlanRefused(f"{place}: {names[i]} would have to jump from {before:.3f} to {after:.3f} rad")
            if not limits.low[i] <= after <= limits.high[i]:
                raise PlanRefused(
                    f"{place}: {names[i]} would be at {after:.4f} rad, allowed is "
                    f"{limits.low[i]:g} to {limits.high[i]:g} rad"
                )
        if zone_at is not None and (box := zone_at(near.q)) is not None:
            raise PlanRefused(f"{place}: the arm would be in {box}")
        q = near.q
        path.append(q)
    return path


def check_singular(model: ArmModel, q: Sequence[float], cartesian: CartesianConfig, place: str) -> None:
    """Raise PlanRefused if a configuration is too near to a singularity."""
    distances = singularity_distances(model, q)
    allowed = cartesian.singularity
    for name, unit, distance, least in (
        ("shoulder", "m", distances.shoulder, allowed.shoulder),
        ("elbow", "rad", distances.elbow, allowed.elbow),
        ("wrist", "rad", distances.wrist, allowed.wrist),
    ):
        if distance is not None and distance < least:
            raise PlanRefused(
                f"{place}: the {name} is {distance:.4f} {unit} from its singularity, allowed is at least {least:g} "
                f"{unit} (cartesian.singularity.{name})"
            )


def _timed(piece: _Piece, limits: Limits, cartesian: CartesianConfig, where: str) -> tuple[tuple[float, ...], float]:
    """Return the row of a piece, and the share of its speed that the joints allow."""
    length, angle = piece.length, piece.angle

    def of_both(linear: float, angular: float) -> float:
        return min(linear / length if length > NO_WAY_M else inf, angular / angle if angle > NO_WAY_RAD else inf)

    wanted = speed = of_both(piece.speed, cartesian.angular_speed)
    acceleration = of_both(cartesian.acceleration, cartesian.angular_acceleration)
    jerk = of_both(cartesian.jerk, cartesian.angular_jerk)
    joints = piece.joints
    count = len(joints) - 1
    bends = []
    for k in range(1, count):
        for i, (before, here, after) in enumerate(zip(joints[k - 1], joints[k], joints[k + 1], strict=True)):
            # dq/ds from the steeper side, d2q/ds2 from the second difference; s is the fraction.
            first = count * max(abs(here - before), abs(after - here))
            second = count * count * abs(after - 2.0 * here + before)
            bends.append((i, first, second))
            if first > 0.0:
                speed = min(speed, OF_LIMIT * limits.velocity[i] / first)
            if second > 0.0:
                speed = min(speed, sqrt(0.5 * OF_LIMIT * limits.acceleration[i] / second))
    for i, first, second in bends:
        if first > 0.0:
            remaining = OF_LIMIT * limits.acceleration[i] - second * speed * speed
            acceleration = min(acceleration, remaining / first)
    duration, acceleration = _duration(speed, acceleration, jerk, where)
    row = (
        *piece.start.position, *piece.turns[0], *piece.end.position, *piece.turns[1],
        speed, acceleration, jerk, length, duration, *_UNUSED, LINE,
    )  # fmt: skip
    return row, speed / wanted


def _duration(speed: float, acceleration: float, jerk: float, where: str) -> tuple[float, float]:
    """Return the duration of the fraction from 0 to 1, s, and the acceleration it needs."""
    inp, trajectory = InputParameter(1), Trajectory(1)
    inp.target_position = [1.0]
    inp.max_velocity, inp.max_jerk = [speed], [jerk]
    for _ in range(_TRIES):
        inp.max_acceleration = [acceleration]
        try:
            if Ruckig(1, 0.001).calculate(inp, trajectory) >= 0:
                return float(trajectory.duration), acceleration
        except (RuckigError, ValueError):
            pass
        # If the acceleration is only just reached, as on 10 mm with 0.5 m/s^2 and 5 m/s^3, ruckig finds no solution.
        acceleration *= _A_LITTLE_LESS
    raise PlanRefused(f"{where}: no motion along it was found")


def check_branch(stop: Stop, q: Sequence[float], where: str, model: ArmModel) -> None:
    """Raise PlanRefused if a line ends at other joint positions than those of its stop."""
    if stop.q is None:
        return
    for name, wanted, reached in zip(model.joint_names, stop.q, q, strict=True):
        if abs(wanted - reached) > _SAME_RAD:
            raise PlanRefused(
                f"{where}: it ends with {name} at {reached:.3f} rad, not at {wanted:.3f} rad: a straight line does not "
                f"change the branch; move there by the joints"
            )
