"""The solution that continues a motion: the one whose joints move least, inside their limits, and why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, remainder, sin, tau

from kinematics.forward import forward
from kinematics.pose import Pose, Rotation, Vector
from kinematics.reasons import why_none
from kinematics.slide import pose_error, slide
from kinematics.solution import SINGULARITIES, Near, Singularity, Solution
from kinematics.spherical import SphericalArm
from kinematics.turns import nearest_turn

# A joint does not jump that moves by less than this, rad, and so many times what the tool does, in m and rad
_NO_JUMP = 1e-4
_AS_THE_TOOL = 4.0
_BESIDE = 1e-4  # |sin theta5| below which what joints 1 to 3 have lost to round-off could make joint 4 jump


def solve_near(arm: SphericalArm, pose: Pose, q_near: Sequence[float]) -> Near:
    """The solution inside the limits whose joint that moves most from `q_near` moves least; finite numbers are needed.

    First the branch of joints 1 to 3 that is nearest, and its nearer wrist. That is the answer unless another branch's
    joints 1 to 3 alone are nearer than all six of it, a joint is not inside its limits, or a singularity is near: then
    all are compared.
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
        return _none(arm, pose)
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
            (l1, u1), (l2, u2), (l3, u3), (l4, u4), (l5, u5), (l6, u6) = arm.turns.limits
            q = q1, q2, q3, q4, q5, q6 = n1 + d1, n2 + d2, n3 + d3, n4 + d4, n5 + d5, n6 + d6
            if (
                l1 <= q1 <= u1 and l2 <= q2 <= u2 and l3 <= q3 <= u3
                and l4 <= q4 <= u4 and l5 <= q5 <= u5 and l6 <= q6 <= u6
                and arm.wrist.error(wrist[0], wrist[1], wrist[2], inner) <= arm.confirmed
            ):  # fmt: skip
                return Near(q, "", SINGULARITIES[wrist[4]], 0.0, -1)
    return _least_of_all(arm, pose, point, rotation, q_near)


def _least_of_all(arm: SphericalArm, pose: Pose, point: Vector, rotation: Rotation, q_near: Sequence[float]) -> Near:
    """The same by comparing all solutions, in all turns that the limits allow."""
    held = [min(max(near, lower), upper) for near, (lower, upper) in zip(q_near, arm.turns.limits, strict=True)]
    solutions = arm.solve(point, rotation, held)
    if not solutions:
        return _none(arm, pose)
    candidates = solutions + _other_holds(arm, point, rotation, solutions, q_near)
    least, best = inf, None
    for solution in candidates:
        if solution.within_limits:
            q = arm.turns.nearest_six(solution.q, q_near)
            move = _largest(q, q_near)
            if move < least:
                least, best = move, Near(q, "", solution.singularity, 0.0, -1)
    if any(_is_beside_singularity(arm, solution) for solution in solutions):
        best = _slid(arm, pose, q_near, least, solutions) or best
    return best or _beyond_limit(arm, solutions, q_near)


def _is_beside_singularity(arm: SphericalArm, solution: Solution) -> bool:
    return bool(solution.singularity) or abs(sin(solution.q[4] + arm.offsets[4])) < _BESIDE


def _slid(
    arm: SphericalArm, pose: Pose, q_near: Sequence[float], least: float, solutions: list[Solution]
) -> Near | None:
    """What least squares find inside the limits by less than the move `least`, if that is more than the tool's own."""
    if least <= _NO_JUMP + _AS_THE_TOOL * max(map(abs, pose_error(pose, forward(arm.model, q_near)))):
        return None
    q = slide(arm.model, pose, q_near)
    if q is None or not _largest(q, q_near) < least or not arm.turns.allow(q):
        return None
    beside = min(solutions, key=lambda solution: _largest_turn(solution.q, q))
    return Near(q, "", beside.singularity, 0.0, -1)


def _largest(q: Sequence[float], q_near: Sequence[float]) -> float:
    return max(abs(angle - near) for angle, near in zip(q, q_near, strict=True))


def _largest_turn(q: Sequence[float], q_near: Sequence[float]) -> float:
    """The same with turns of 2 pi left out."""
    return max(abs(remainder(angle - near, tau)) for angle, near in zip(q, q_near, strict=True))


def _other_holds(
    arm: SphericalArm, point: Vector, rotation: Rotation, solutions: list[Solution], q_near: Sequence[float]
) -> list[Solution]:
    """Where joint 4 is free and joint 6 would pass a limit: those with joint 6 on it and joint 4 making it good."""
    lower, upper = arm.turns.limits[5]
    found = []
    for solution in solutions:
        if Singularity.WRIST in solution.singularity:
            wanted = nearest_turn(solution.q[5], q_near[5])
            rest = wanted - min(max(wanted, lower), upper)
            if rest != 0.0:
                for held4 in (solution.q[3] + rest, solution.q[3] - rest):
                    found += arm.solve(point, rotation, (*solution.q[:3], held4, 0.0, 0.0))
    return found


def _beyond_limit(arm: SphericalArm, solutions: list[Solution], q_near: Sequence[float]) -> Near:
    """Names the joint that keeps the arm from the nearest solution."""
    solution = min(solutions, key=lambda solution: _largest_turn(solution.q, q_near))
    joint = solution.outside[0]
    lower, upper = arm.turns.limits[joint]
    angle = nearest_turn(solution.q[joint], q_near[joint])
    limit = upper if angle > upper else lower
    name = arm.model.joint_names[joint]
    reason = f"joint limit: {name} would have to be at {angle:.6g} rad, beyond its limit of {limit:.6g} rad"
    return Near(None, reason, solution.singularity, 0.0, joint)


def _none(arm: SphericalArm, pose: Pose) -> Near:
    reason, out_of_reach = why_none(arm, pose)
    return Near(None, reason, Singularity.NONE, out_of_reach, -1)
