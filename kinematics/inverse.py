"""Inverse kinematics: all solutions of a pose, or the one that continues a motion, by the best method for the arm."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, remainder, sin, tau
from typing import Final, Literal

from kinematics.damped_least_squares import (
    NumericResult,
    damped_least_squares,
    pose_error,
    require_rotation,
    solve_numeric,
)
from kinematics.forward import forward
from kinematics.model import JOINTS, ArmModel
from kinematics.pose import Pose, Rotation, Vector, as_floats, require_finite
from kinematics.solution import SINGULARITIES, AngleWrap, Near, Singularity, Solution, Solutions, nearest_turn
from kinematics.spherical import ObliqueWrist, SphericalArm, has_spherical_wrist

# A solution is a jump if a joint moves by more than NO_JUMP, rad, plus JUMP_RATIO times the tool's motion, the largest
# component of its displacement (m) and rotation (rad).
_NO_JUMP: Final = 1e-4
_JUMP_RATIO: Final = 4.0
_BESIDE: Final = 1e-4  # |sin theta5| below which the round-off of joints 1 to 3 could make joint 4 jump

Method = Literal["spherical wrist, parallel axes 2 and 3", "spherical wrist, general", "numeric"]


class InverseKinematics:
    """Joint angles for tool poses of one arm; the constructor computes everything that is constant.

    `method`: closed form where axes 4 to 6 meet in one point (a triangle where axes 2 and 3 are parallel, otherwise
    Pieper's quartic), else numeric. The calls keep no state.
    """

    def __init__(self, model: ArmModel) -> None:
        self.model = model
        self.method: Method = "numeric"
        self._arm: SphericalArm | None = None
        if has_spherical_wrist(model):
            arm = SphericalArm(model)
            if arm.is_regular:
                self._arm = arm
                self.method = "spherical wrist, parallel axes 2 and 3" if arm.parallel else "spherical wrist, general"
        self._home = tuple(min(max(0.0, limit.lower), limit.upper) for limit in model.limits)

    def solve(self, pose: Pose, q_near: Sequence[float] | None = None) -> Solutions:
        """All configurations that bring the tool to `pose` (base frame), each confirmed by forward kinematics.

        Joint limits are reported, not enforced. On a singularity the free joint stays at `q_near` (six rad; default:
        zero, or the limit nearest to it). The numeric method gives one solution, computed from `q_near`, inside the
        limits if possible. Raises ValueError for a value that is not finite, naming it, and for an invalid rotation.
        """
        near = self._home if q_near is None else as_floats(q_near)
        _require_finite(self.model, pose, near)
        if self._arm is None:
            return self._solve_numeric(pose, near)
        point, rotation = self._arm.target(pose)
        solutions = self._arm.solve(point, rotation, near)
        if solutions:
            return Solutions(tuple(solutions), None)
        return Solutions((), _why_none(self._arm, pose)[0])

    def solve_near(self, pose: Pose, q_near: Sequence[float]) -> Near:
        """The solution inside the joint limits that is nearest to `q_near` (six rad), or why there is none.

        The nearest solution is the one whose largest joint motion is smallest, over all multiples of 2 pi: along a
        continuous motion this is the branch that continues. It may be far away when no near one exists; the caller
        bounds the step. A joint that is free on a singularity keeps its position. Raises ValueError as `solve`.
        """
        q_near = as_floats(q_near)
        _require_finite(self.model, pose, q_near)
        if self._arm is None:
            return self._near_numeric(pose, q_near)
        return _solve_near(self._arm, pose, q_near)

    def _solve_numeric(self, pose: Pose, q_near: Sequence[float]) -> Solutions:
        result = solve_numeric(self.model, pose, q_near)
        if not result.converged:
            result = solve_numeric(self.model, pose, q_near, respect_limits=False)
        if not result.converged:
            return Solutions((), _nearest(result))
        wrap = AngleWrap(self.model)
        (arm, arm_outside), (hand, outside) = wrap.into_limits(0, *result.q[:3]), wrap.into_limits(3, *result.q[3:])
        outside = arm_outside + outside
        return Solutions((Solution((*arm, *hand), None, not outside, outside, Singularity.NONE),), None)

    def _near_numeric(self, pose: Pose, q_near: Sequence[float]) -> Near:
        result = solve_numeric(self.model, pose, q_near)
        if result.converged:
            return Near(result.q, "", Singularity.NONE, 0.0, -1)
        return Near(None, _nearest(result), Singularity.NONE, result.position_error, -1)


def _nearest(result: NumericResult) -> str:
    return (
        f"no solution found inside the joint limits: the nearest configuration misses the pose by "
        f"{result.position_error:.6g} m and {result.rotation_error:.6g} rad"
    )


def _require_finite(model: ArmModel, pose: Pose, q_near: Sequence[float]) -> None:
    """Check one sum; only when that is not finite check each number."""
    if len(q_near) != JOINTS:
        raise ValueError(f"q_near has {len(q_near)} joint angles; {JOINTS} are required")
    (x, y, z), (a, b, c, d, e, f, g, h, i) = pose
    q1, q2, q3, q4, q5, q6 = q_near
    total = x + y + z + a + b + c + d + e + f + g + h + i + q1 + q2 + q3 + q4 + q5 + q6
    if total - total != 0.0:
        Pose(*pose).require_finite()
        require_finite(q_near, (f"{name} of q_near" for name in model.joint_names))


def _solve_near(arm: SphericalArm, pose: Pose, q_near: Sequence[float]) -> Near:
    """`InverseKinematics.solve_near` for finite numbers.

    Fast path: the nearest branch of joints 1 to 3, then its nearer wrist. All solutions are compared only when joints
    1 to 3 of another branch move less than all six joints of this one, a joint is outside its limits, or a singularity
    is near.
    """
    point, rotation = arm.target(pose)
    n1, n2, n3, n4, n5, n6 = q_near
    o1, o2, o3, o4, o5, o6 = arm.offsets
    h1, h2, h3 = n1 + o1, n2 + o2, n3 + o3
    least = second = inf
    for branch in arm.arm.solve(*point, h1, h2):
        m1 = remainder(branch[0] - h1, tau)
        if not -second < m1 < second:
            continue
        m2, m3 = remainder(branch[1] - h2, tau), remainder(branch[2] - h3, tau)
        move = max(m1, -m1, m2, -m2, m3, -m3)
        if move < least:
            least, second = move, least
            d1, d2, d3, nearest = m1, m2, m3, branch
        elif move < second:
            second = move
    if least == inf:
        return _no_near(arm, pose)
    theta1, theta2, theta3, _, arm_singular = nearest
    inner = arm.arm.confirm(theta1, theta2, theta3, point, rotation)
    if inner is not None:
        h4, h5, h6 = n4 + o4, n5 + o5, n6 + o6
        closest = inf
        for angles in arm.wrist.solve(inner, h4):
            m1, m2, m3 = remainder(angles[0] - h4, tau), remainder(angles[1] - h5, tau), remainder(angles[2] - h6, tau)
            move = max(m1, -m1, m2, -m2, m3, -m3)
            if move < closest:
                closest = move
                d4, d5, d6, wrist = m1, m2, m3, angles
        if (
            max(least, closest) <= second
            and closest < inf
            and not arm_singular
            and not -_BESIDE < sin(wrist[1]) < _BESIDE
        ):
            (l1, u1), (l2, u2), (l3, u3), (l4, u4), (l5, u5), (l6, u6) = arm.wrap.limits
            q = q1, q2, q3, q4, q5, q6 = n1 + d1, n2 + d2, n3 + d3, n4 + d4, n5 + d5, n6 + d6
            if (
                l1 <= q1 <= u1 and l2 <= q2 <= u2 and l3 <= q3 <= u3
                and l4 <= q4 <= u4 and l5 <= q5 <= u5 and l6 <= q6 <= u6
                and arm.wrist.error(wrist[0], wrist[1], wrist[2], inner) <= arm.confirmed
            ):  # fmt: skip
                return Near(q, "", SINGULARITIES[wrist[4]], 0.0, -1)
    return _compare_all(arm, pose, point, rotation, q_near)


def _compare_all(arm: SphericalArm, pose: Pose, point: Vector, rotation: Rotation, q_near: Sequence[float]) -> Near:
    """The nearest of all solutions, at all multiples of 2 pi that the limits allow."""
    clamped = [min(max(near, lower), upper) for near, (lower, upper) in zip(q_near, arm.wrap.limits, strict=True)]
    solutions = arm.solve(point, rotation, clamped)
    if not solutions:
        return _no_near(arm, pose)
    candidates = solutions + _with_joint_6_at_its_limit(arm, point, rotation, solutions, q_near)
    least, best = inf, None
    for solution in candidates:
        if solution.within_limits:
            q = arm.wrap.nearest(solution.q, q_near)
            move = _largest(q, q_near)
            if move < least:
                least, best = move, Near(q, "", solution.singularity, 0.0, -1)
    if any(_is_beside_singularity(arm, solution) for solution in solutions):
        best = _by_least_squares(arm, pose, q_near, least, solutions) or best
    return best or _beyond_limit(arm, solutions, q_near)


def _is_beside_singularity(arm: SphericalArm, solution: Solution) -> bool:
    return bool(solution.singularity) or abs(sin(solution.q[4] + arm.offsets[4])) < _BESIDE


def _by_least_squares(
    arm: SphericalArm, pose: Pose, q_near: Sequence[float], least: float, solutions: list[Solution]
) -> Near | None:
    """A solution by damped least squares, if the closed form's smallest move `least` is a jump and this is smaller."""
    if least <= _NO_JUMP + _JUMP_RATIO * max(map(abs, pose_error(pose, forward(arm.model, q_near)))):
        return None
    q = damped_least_squares(arm.model, pose, q_near)
    if q is None or not _largest(q, q_near) < least or not arm.wrap.allow(q):
        return None
    beside = min(solutions, key=lambda solution: _largest_turn(solution.q, q))
    return Near(q, "", beside.singularity, 0.0, -1)


def _largest(q: Sequence[float], q_near: Sequence[float]) -> float:
    return max(abs(angle - near) for angle, near in zip(q, q_near, strict=True))


def _largest_turn(q: Sequence[float], q_near: Sequence[float]) -> float:
    """As `_largest`, regardless of multiples of 2 pi."""
    return max(abs(remainder(angle - near, tau)) for angle, near in zip(q, q_near, strict=True))


def _with_joint_6_at_its_limit(
    arm: SphericalArm, point: Vector, rotation: Rotation, solutions: list[Solution], q_near: Sequence[float]
) -> list[Solution]:
    """Solutions on a wrist singularity with joint 6 at the limit that it would exceed, compensated by joint 4."""
    lower, upper = arm.wrap.limits[5]
    at_limit = []
    for solution in solutions:
        if Singularity.WRIST in solution.singularity:
            wanted = nearest_turn(solution.q[5], q_near[5])
            excess = wanted - min(max(wanted, lower), upper)
            if excess != 0.0:
                for held4 in (solution.q[3] + excess, solution.q[3] - excess):
                    at_limit += arm.solve(point, rotation, (*solution.q[:3], held4, 0.0, 0.0))
    return at_limit


def _beyond_limit(arm: SphericalArm, solutions: list[Solution], q_near: Sequence[float]) -> Near:
    """The answer that names the joint whose limit prevents the nearest solution."""
    solution = min(solutions, key=lambda solution: _largest_turn(solution.q, q_near))
    joint = solution.outside[0]
    lower, upper = arm.wrap.limits[joint]
    angle = nearest_turn(solution.q[joint], q_near[joint])
    limit = upper if angle > upper else lower
    name = arm.model.joint_names[joint]
    reason = f"joint limit: {name} would have to be at {angle:.6g} rad, beyond its limit of {limit:.6g} rad"
    return Near(None, reason, solution.singularity, 0.0, joint)


def _no_near(arm: SphericalArm, pose: Pose) -> Near:
    reason, out_of_reach = _why_none(arm, pose)
    return Near(None, reason, Singularity.NONE, out_of_reach, -1)


def _why_none(arm: SphericalArm, pose: Pose) -> tuple[str, float]:
    """Why a pose has no solution, as a sentence, and how far (m) the wrist centre is out of reach.

    0 m when only the orientation is out of reach. Raises ValueError for an invalid rotation.
    """
    require_rotation(pose)
    point, rotation = arm.target(pose)
    branches = arm.arm.solve(*point, 0.0, 0.0)
    if not branches:
        gap = arm.arm.shortfall(*point)
        x, y, z = arm.wrist_centre(pose)
        return f"out of reach by {gap:.6g} m: the wrist centre cannot reach ({x:.6g}, {y:.6g}, {z:.6g}) m", gap
    if isinstance(arm.wrist, ObliqueWrist):
        inner = (arm.arm.confirm(*branch[:3], point, rotation) for branch in branches)
        missing = min((arm.wrist.shortfall(rotation) for rotation in inner if rotation is not None), default=0.0)
        if missing > 0.0:
            return f"out of reach by {missing:.6g} rad: the wrist cannot tilt axis 6 that far", 0.0
    return "no solution was confirmed by forward kinematics", 0.0
