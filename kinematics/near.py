"""The solution that continues a motion: the one whose joints move least, inside their limits, and why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, remainder, tau
from operator import sub

from kinematics.pose import Pose, Rotation, Vector
from kinematics.reasons import why_none
from kinematics.solution import SINGULARITIES, Near, Singularity, Solution
from kinematics.spherical import SphericalArm
from kinematics.turns import nearest_turn


def solve_near(arm: SphericalArm, pose: Pose, q_near: Sequence[float]) -> Near:
    """The solution inside the limits whose joint that moves most from `q_near` moves least; finite numbers are needed.

    First the branch of joints 1 to 3 that is nearest, and its nearer wrist. That is the answer unless another branch's
    joints 1 to 3 alone are nearer than all six of it, or a joint is not inside its limits: then all are compared.
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
        if max(least, closest) <= second and closest < inf:
            (l1, u1), (l2, u2), (l3, u3), (l4, u4), (l5, u5), (l6, u6) = arm.turns.limits
            q = q1, q2, q3, q4, q5, q6 = n1 + d1, n2 + d2, n3 + d3, n4 + d4, n5 + d5, n6 + d6
            if (
                l1 <= q1 <= u1 and l2 <= q2 <= u2 and l3 <= q3 <= u3
                and l4 <= q4 <= u4 and l5 <= q5 <= u5 and l6 <= q6 <= u6
                and arm.wrist.error(wrist[0], wrist[1], wrist[2], inner) <= arm.confirmed
            ):  # fmt: skip
                return Near(q, "", SINGULARITIES[arm_singular | wrist[4]], 0.0, -1)
    return _least_of_all(arm, pose, point, rotation, q_near)


def _least_of_all(arm: SphericalArm, pose: Pose, point: Vector, rotation: Rotation, q_near: Sequence[float]) -> Near:
    """The same by comparing all solutions, in all turns that the limits allow."""
    held = [min(max(near, lower), upper) for near, (lower, upper) in zip(q_near, arm.turns.limits, strict=True)]
    solutions = arm.solve(point, rotation, held)
    if not solutions:
        return _none(arm, pose)
    solutions += _other_holds(arm, point, rotation, held, solutions)
    best, least, singularity = None, inf, Singularity.NONE
    for solution in solutions:
        if solution.within_limits:
            q = arm.turns.nearest_six(solution.q, q_near)
            move = max(map(abs, map(sub, q, q_near)))
            if move < least:
                best, least, singularity = q, move, solution.singularity
    if best is not None:
        return Near(best, "", singularity, 0.0, -1)
    return _beyond_limit(arm, solutions, q_near)


def _other_holds(
    arm: SphericalArm, point: Vector, rotation: Rotation, held: Sequence[float], solutions: list[Solution]
) -> list[Solution]:
    """Where joint 4 is free and joint 6 beyond its limits: those with joint 6 on a limit, joint 4 making it good."""
    holds = [
        (*held[:3], solution.q[3] + sign * remainder(solution.q[5] - edge, tau), *held[4:])
        for solution in solutions
        if 5 in solution.outside and Singularity.WRIST in solution.singularity
        for edge in arm.turns.limits[5]
        for sign in (1.0, -1.0)
    ]
    return [solution for hold in holds for solution in arm.solve(point, rotation, hold)]


def _beyond_limit(arm: SphericalArm, solutions: list[Solution], q_near: Sequence[float]) -> Near:
    """Names the joint that keeps the arm from the nearest solution."""

    def move(solution: Solution) -> float:
        return max(abs(remainder(angle - near, tau)) for angle, near in zip(solution.q, q_near, strict=True))

    solution = min(solutions, key=move)
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
