"""The rod's equilibrium by collocation: the oracle of shooting."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation

from kinematics.pose import Pose
from rtcp.ipc.errors import RtcpError
from rtcp.processes.rod import Equilibrium, Rod
from rtcp.processes.rod.statics import Array, _rates


def solve_boundary_values(rod: Rod, end: Pose, start: Equilibrium, tolerance: float = 1e-8) -> Array:
    """Return the parameters, (6,), of the equilibrium with an end pose, by collocation from one beside it.

    The thirteen states of the rod as a boundary value problem: q(0), p(0), p(L), and the vector part of
    conj(q_end) q(L). Slower than `shoot`; the two check each other.

    Raises:
        Refused: the method does not converge.
    """
    nodes = start.s / rod.length
    shape, w = rod.length * start.set_shape, (start.weight * rod.length**3 / rod.bending_stiffness).tolist()
    x, y, z, scalar = Rotation.from_matrix(np.reshape(end.rotation, (3, 3))).as_quat().tolist()
    conjugate = np.array([[-x, scalar, z, -y], [-y, -z, scalar, x], [-z, y, -x, scalar]])
    goal = np.array(end.position) / rod.length

    def rates(s: Array, states: Array) -> Array:
        local = np.stack([np.interp(s, nodes, column) for column in shape.T], axis=1).tolist()
        rows = [_rates(rod, state, u0, w) for state, u0 in zip(states.T.tolist(), local, strict=True)]
        return np.asarray(np.array(rows, dtype=np.float64).T)

    def residuals(first: Array, last: Array) -> Array:
        at_start = first[:7] - [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        return np.asarray(np.concatenate([at_start, last[4:7] - goal, conjugate @ last[:4]]))

    scale = rod.length / rod.bending_stiffness
    guess = np.hstack([start.q, start.p / rod.length, start.m * scale, start.f * scale * rod.length]).T
    result = solve_bvp(rates, residuals, nodes, guess, tol=tolerance, max_nodes=4000)
    if not result.success:
        raise RtcpError(
            "refused",
            f"collocation found no equilibrium with this end pose ({result.message}): start from one nearer to it",
            "rod_no_equilibrium",
        )
    return np.asarray(result.y[7:, 0])
