"""Statics of an elastic rod that is clamped at its start: equilibrium, Jacobian of its end, stability.

Arc length s from 0 to L, body frame with e1 along the rod, moment m and force f in that frame, set shape u0 (twist rate
and two curvatures that the unloaded rod has), weight w per length, fixed in space:

    u  = u0 + K(m)                   K: linear for twist, the moment law of `Rod` for bending
    m' = -u x m - e1 x f             f' = -u x f - R^T w
    q' = 1/2 q * (0, u)              p' = R(q) e1

The parameters of an equilibrium are a = (m, f) at s = 0, in units of EI/L and EI/L^2. With k = dK/dm the derivatives by
them, M of (m, f) and J of the pose in its own frame (rotation, position in units of L), are

    M' = [[hat(m) k - hat(u), -hat(e1)], [hat(f) k, -hat(u)]] M + [[0, 0], [-hat(R^T w), 0]] J
    J' = [[k, 0], [0, 0]] M + [[-hat(u), 0], [-hat(e1), -hat(u)]] J          M(0) = 1, J(0) = 0

An equilibrium is stable if det J(s) has no zero in (0, L]. The straight rod is singular: det J = 0 throughout.

Source: Bretl and McCarthy, Quasi-static manipulation of a Kirchhoff elastic rod, IJRR 33(1), 2014; there k is constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import asin, hypot, pi, sqrt
from typing import Final, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from kinematics.pose import Pose
from kinematics.pose import Rotation as Rows
from rtcp.ipc.errors import RtcpError

Array = npt.NDArray[np.float64]
STEPS: Final = 60
"""Steps of the Runge-Kutta method along the rod."""
GRAVITY: Final = 9.80665
"""m/s^2."""
_FIRST_NODE: Final = 0.05
"""Share of the length in which det J is lost in rounding; no conjugate point lies there."""
_SINGULAR: Final = 1e-18
_ITERATIONS: Final = 30
_CLOSE: Final = 1e-10
_LARGEST_CHANGE: Final = 20.0
_E1_HAT: Final = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Rod:
    """A round rod of Nitinol; the defaults are those of austenite at body temperature.

    Bending follows a stress of three straight pieces (elastic, plateau, martensite), equal in tension and compression,
    for rising load. Twist is linear. Source of the defaults: Confluent Medical, nitinol-design-concepts, 115; density
    and strains: sma-inc.com, table of NiTi properties.
    """

    length: float
    """Free length between the chucks, m."""
    diameter: float
    """Diameter, m."""
    youngs_modulus: float = 62.9e9
    """Young's modulus of austenite, Pa."""
    poissons_ratio: float = 0.33
    """Poisson's ratio."""
    density: float = 6450.0
    """Density, kg/m^3."""
    plateau_stress: float = 460e6
    """Stress at which the loading plateau begins, Pa."""
    plateau_end_stress: float = 500e6
    """Stress at which the loading plateau ends, Pa."""
    plateau_strain: float = 0.046
    """Strain from the beginning to the end of the plateau."""
    martensite_modulus: float = 27.8e9
    """Young's modulus beyond the plateau, Pa."""
    usable_strain: float = 0.06
    """Largest strain of a plan: 100 cycles."""
    hard_strain: float = 0.08
    """Largest strain at all: once."""

    @property
    def bending_stiffness(self) -> float:
        """EI of the elastic rod, N m^2."""
        return self.youngs_modulus * pi * self.diameter**4 / 64.0

    @property
    def torsional_compliance(self) -> float:
        """EI/GJ = 1 + nu of a round section."""
        return 1.0 + self.poissons_ratio

    @property
    def linear_strain(self) -> float:
        """Strain at which the plateau begins."""
        return self.plateau_stress / self.youngs_modulus

    @property
    def weight(self) -> float:
        """Weight per length, N/m."""
        return self.density * GRAVITY * pi * self.diameter**2 / 4.0

    def moment(self, curvature: float) -> float:
        """Return the bending moment, N m, of a curvature, 1/m, not negative; strictly monotone."""
        return self._moment(curvature)[0]

    def curvature(self, moment: float) -> tuple[float, float]:
        """Return the curvature, 1/m, of a bending moment, N m, not negative; and its derivative, 1/(N m^2)."""
        stiffness = self.bending_stiffness
        low, high = moment / stiffness, moment / self._plateau_modulus * self.youngs_modulus / stiffness
        if low * self.diameter <= 2.0 * self.linear_strain:
            return low, 1.0 / stiffness
        kappa = low
        for _ in range(100):  # Newton's method inside a bracket
            value, slope = self._moment(kappa)
            if value < moment:
                low = kappa
            else:
                high = kappa
            following = kappa - (value - moment) / slope
            if not low <= following <= high:
                following = 0.5 * (low + high)
            if abs(following - kappa) <= 1e-14 * kappa:
                break
            kappa = following
        return kappa, 1.0 / self._moment(kappa)[1]

    @property
    def _plateau_modulus(self) -> float:
        return (self.plateau_end_stress - self.plateau_stress) / self.plateau_strain

    def _moment(self, kappa: float) -> tuple[float, float]:
        """Moment and its derivative: the section integral of y stress(kappa y), piece by piece."""
        inertia = pi * self.diameter**4 / 64.0
        elastic, elastic_slope = self._clipped(kappa, self.linear_strain)
        soft, soft_slope = self._clipped(kappa, self.linear_strain + self.plateau_strain)
        plateau = self._plateau_modulus
        first, third = self.youngs_modulus - plateau, self.martensite_modulus - plateau
        value = first * elastic + plateau * inertia * kappa + third * (inertia * kappa - soft)
        return value, first * elastic_slope + plateau * inertia + third * (inertia - soft_slope)

    def _clipped(self, kappa: float, strain: float) -> tuple[float, float]:
        """Integral of y min(kappa y, strain) over the round section, m^3, and its derivative by kappa, m^4."""
        radius = 0.5 * self.diameter
        if kappa * radius <= strain:
            return 0.25 * pi * radius**4 * kappa, 0.25 * pi * radius**4
        x = strain / (kappa * radius)
        root = sqrt(1.0 - x * x)
        slope = 0.5 * radius**4 * (asin(x) - x * (1.0 - 2.0 * x * x) * root)
        return slope * kappa + 4.0 / 3.0 * strain * radius**3 * root**3, slope


@dataclass(frozen=True)
class Equilibrium:
    """A rod in equilibrium at n + 1 nodes, in the frame of its start; arrays are not to be changed.

    rod: dimensions and alloy. a: parameters, (6,), units of EI/L and EI/L^2. s: arc length, (n + 1,), m. p: position,
    (n + 1, 3), m. q: orientation w, x, y, z, (n + 1, 4). m, f: moment, N m, and force, N, in the body frame,
    (n + 1, 3). u: twist rate and curvatures, (n + 1, 3), 1/m. jacobian: of the pose by a, (n + 1, 6, 6), rad and L.
    set_shape: u0 at the nodes, (n + 1, 3), 1/m. weight: in the frame of the start, (3,), N/m.
    """

    rod: Rod
    a: Array
    s: Array
    p: Array
    q: Array
    m: Array
    f: Array
    u: Array
    jacobian: Array
    set_shape: Array
    weight: Array

    @cached_property
    def rotations(self) -> Array:
        """Orientation of the nodes, (n + 1, 3, 3)."""
        return cast(Array, Rotation.from_quat(np.roll(self.q, -1, axis=1)).as_matrix())

    @cached_property
    def strain(self) -> Array:
        """Strain at the surface against the set shape, d/2 |u - u0| of both curvatures, (n + 1,)."""
        return np.asarray(0.5 * self.rod.diameter * np.linalg.norm((self.u - self.set_shape)[:, 1:], axis=1))

    @property
    def largest_strain(self) -> float:
        """Largest strain at any node."""
        return float(self.strain.max())

    @property
    def is_linear(self) -> bool:
        """Whether the whole rod is below the plateau: beyond, the moment law is a model of one loading."""
        return self.largest_strain <= self.rod.linear_strain

    @cached_property
    def conjugate_point(self) -> float | None:
        """Arc length of the first zero of det J, m; L where J is singular there; None: there is none."""
        determinants = np.linalg.det(self.jacobian)
        first = int(np.ceil(_FIRST_NODE * (len(self.s) - 1)))
        signs = np.sign(determinants[first:])
        changes = np.flatnonzero(signs[1:] != signs[:-1])
        if changes.size:
            at = first + int(changes[0])
            before, after = determinants[at : at + 2]
            return float(self.s[at] + (self.s[at + 1] - self.s[at]) * before / (before - after))
        return None if abs(determinants[-1]) > _SINGULAR else self.rod.length

    @property
    def is_stable(self) -> bool:
        """Whether it has no conjugate point."""
        return self.conjugate_point is None

    def pose(self, node: int) -> Pose:
        """Return the pose of a node in the frame of the start."""
        x, y, z = self.p[node].tolist()
        return Pose((x, y, z), cast(Rows, tuple(self.rotations[node].ravel().tolist())))

    @property
    def end(self) -> Pose:
        """Pose of the end in the frame of the start."""
        return self.pose(-1)


def integrate(
    rod: Rod,
    a: npt.ArrayLike,
    set_shape: Array | None = None,
    weight: Sequence[float] = (0.0, 0.0, 0.0),
    steps: int = STEPS,
) -> Equilibrium:
    """Return the equilibrium with parameters `a`, by the fourth-order Runge-Kutta method.

    Args:
        rod: the rod.
        a: moment and force at the start, (6,), units of EI/L and EI/L^2.
        set_shape: u0 at the nodes, (steps + 1, 3), 1/m; None: straight.
        weight: per length, in the frame of the start, N/m.
        steps: along the rod.
    """
    length, stiffness = rod.length, rod.bending_stiffness
    shape = np.zeros((steps + 1, 3)) if set_shape is None else set_shape
    shapes = (length * np.stack([shape[:-1], 0.5 * (shape[:-1] + shape[1:]), shape[1:]], axis=1)).tolist()
    w = [component * length**3 / stiffness for component in weight]
    h = 1.0 / steps
    y = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *np.asarray(a, dtype=np.float64).tolist()]
    nodes, stages, between = [y], [], []
    for first, middle, last in shapes:
        k1 = _rates(rod, y, first, w)
        y2 = [v + 0.5 * h * k for v, k in zip(y, k1, strict=True)]
        k2 = _rates(rod, y2, middle, w)
        y3 = [v + 0.5 * h * k for v, k in zip(y, k2, strict=True)]
        k3 = _rates(rod, y3, middle, w)
        y4 = [v + h * k for v, k in zip(y, k3, strict=True)]
        k4 = _rates(rod, y4, last, w)
        stages.append([y, y2, y3, y4])
        between.append([first, middle, middle, last])
        y = [v + h / 6.0 * (b + 2.0 * c + 2.0 * d + e) for v, b, c, d, e in zip(y, k1, k2, k3, k4, strict=True)]
        nodes.append(y)
    states = np.array(nodes)
    q = states[:, :4] / np.linalg.norm(states[:, :4], axis=1, keepdims=True)
    u = length * shape + _strains(rod, states[:, 7:10])[0]
    return Equilibrium(
        rod=rod, a=states[0, 7:].copy(), s=np.linspace(0.0, length, steps + 1), p=length * states[:, 4:7], q=q,
        m=states[:, 7:10] * stiffness / length, f=states[:, 10:] * stiffness / length**2, u=u / length,
        jacobian=_jacobians(rod, np.array(stages), np.array(between), np.array(w)), set_shape=shape,
        weight=np.array(weight, dtype=np.float64),
    )  # fmt: skip


def shoot(rod: Rod, end: Pose, start: Equilibrium) -> Equilibrium:
    """Return the equilibrium whose end has a pose (frame of the start), by Newton's method from one beside it.

    `start` gives parameters, set shape and weight. The caller checks whether the result is stable.

    Raises:
        Refused: the method does not converge.
    """
    current = start
    for _ in range(_ITERATIONS):
        error = pose_error(current, end)
        if np.abs(error).max() < _CLOSE:
            return current
        try:
            change = np.linalg.solve(current.jacobian[-1], error)
        except np.linalg.LinAlgError:
            break
        change *= min(1.0, _LARGEST_CHANGE / (np.abs(change).max() + 1e-300))
        current = integrate(rod, current.a + change, start.set_shape, start.weight.tolist(), len(start.s) - 1)
        if not np.isfinite(current.jacobian[-1]).all():
            break
    miss = float(np.abs(pose_error(current, end)).max())
    raise RtcpError(
        "refused",
        f"no equilibrium with this end pose was found: its error is {miss:.3g} (rad, lengths of the rod), allowed is "
        f"{_CLOSE:g}: start from an equilibrium nearer to it",
        "rod_no_equilibrium",
        {"error": miss},
    )


def pose_error(equilibrium: Equilibrium, end: Pose) -> Array:
    """Return the error of the end to a pose, in the frame of the end: rotation vector, rad, and position, L; (6,)."""
    own = equilibrium.rotations[-1]
    rotation = Rotation.from_matrix(own.T @ np.reshape(end.rotation, (3, 3))).as_rotvec()
    return np.concatenate([rotation, own.T @ (np.array(end.position) - equilibrium.p[-1]) / equilibrium.rod.length])


def _rates(rod: Rod, y: Sequence[float], u0: Sequence[float], w: Sequence[float]) -> list[float]:
    """Derivatives by s of q, p, m, f, all in units of L and EI."""
    a, b, c, d, _, _, _, m1, m2, m3, f1, f2, f3 = y
    secant = _bending(rod, hypot(m2, m3))[0]
    u1, u2, u3 = u0[0] + rod.torsional_compliance * m1, u0[1] + secant * m2, u0[2] + secant * m3
    e1x, e1y, e1z = 1.0 - 2.0 * (c * c + d * d), 2.0 * (b * c + a * d), 2.0 * (b * d - a * c)
    g1 = e1x * w[0] + e1y * w[1] + e1z * w[2]
    g2 = 2.0 * (b * c - a * d) * w[0] + (1.0 - 2.0 * (b * b + d * d)) * w[1] + 2.0 * (c * d + a * b) * w[2]
    g3 = 2.0 * (b * d + a * c) * w[0] + 2.0 * (c * d - a * b) * w[1] + (1.0 - 2.0 * (b * b + c * c)) * w[2]
    return [
        -0.5 * (b * u1 + c * u2 + d * u3), 0.5 * (a * u1 + c * u3 - d * u2), 0.5 * (a * u2 + d * u1 - b * u3),
        0.5 * (a * u3 + b * u2 - c * u1),
        e1x, e1y, e1z,
        u3 * m2 - u2 * m3, u1 * m3 - u3 * m1 + f3, u2 * m1 - u1 * m2 - f2,
        u3 * f2 - u2 * f3 - g1, u1 * f3 - u3 * f1 - g2, u2 * f1 - u1 * f2 - g3,
    ]  # fmt: skip


def _bending(rod: Rod, moment: float) -> tuple[float, float]:
    """Secant and tangent compliance of bending, in units of EI, at a moment in units of EI/L."""
    if 0.5 * rod.diameter * moment <= rod.linear_strain * rod.length:
        return 1.0, 1.0
    stiffness, length = rod.bending_stiffness, rod.length
    kappa, slope = rod.curvature(moment * stiffness / length)
    return kappa * length / moment, slope * stiffness


def _strains(rod: Rod, m: Array) -> tuple[Array, Array]:
    """K(m), (..., 3), and its derivative k, (..., 3, 3), in units of L and EI."""
    size = np.hypot(m[..., 1], m[..., 2])
    pairs = np.array([_bending(rod, moment) for moment in size.ravel().tolist()]).reshape(*size.shape, 2)
    secant, tangent = pairs[..., 0], pairs[..., 1]
    k = np.zeros((*m.shape, 3))
    direction = m[..., 1:] / np.where(size > 0.0, size, 1.0)[..., None]
    k[..., 0, 0] = rod.torsional_compliance
    k[..., 1:, 1:] = secant[..., None, None] * np.eye(2)
    k[..., 1:, 1:] += (tangent - secant)[..., None, None] * direction[..., :, None] * direction[..., None, :]
    u = np.concatenate([rod.torsional_compliance * m[..., :1], secant[..., None] * m[..., 1:]], axis=-1)
    return u, k


def _jacobians(rod: Rod, stages: Array, shapes: Array, w: Array) -> Array:
    """J at the nodes, (n + 1, 6, 6), from the states (n, 4, 13) and u0 (n, 4, 3) at the stages of each step."""
    count, h = len(stages), 1.0 / len(stages)
    m, f = stages[..., 7:10], stages[..., 10:]
    strains, k = _strains(rod, m)
    u = shapes + strains
    rates = np.zeros((count, 4, 12, 12))
    rates[..., :3, :3] = hat(m) @ k - hat(u)
    rates[..., :3, 3:6] = -_E1_HAT
    rates[..., 3:6, :3] = hat(f) @ k
    rates[..., 3:6, 3:6] = -hat(u)
    rates[..., 6:9, :3] = k
    rates[..., 6:9, 6:9] = rates[..., 9:, 9:] = -hat(u)
    rates[..., 9:, 6:9] = -_E1_HAT
    if w.any():
        turns = Rotation.from_quat(np.roll(stages[..., :4].reshape(-1, 4), -1, axis=1)).inv()
        rates[..., 3:6, 6:9] = -hat(turns.apply(w).reshape(count, 4, 3))
    unit = np.eye(12)
    k1 = rates[:, 0]
    k2 = rates[:, 1] @ (unit + 0.5 * h * k1)
    k3 = rates[:, 2] @ (unit + 0.5 * h * k2)
    k4 = rates[:, 3] @ (unit + h * k3)
    maps = unit + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    derivatives = np.zeros((count + 1, 12, 6))
    derivatives[0, :6] = np.eye(6)
    for at, step in enumerate(maps):
        derivatives[at + 1] = step @ derivatives[at]
    return derivatives[:, 6:]


def hat(vectors: Array) -> Array:
    """Return the matrices of the cross products with vectors, (..., 3) to (..., 3, 3)."""
    matrices = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices[..., 0, 1], matrices[..., 0, 2], matrices[..., 1, 2] = -z, y, -x
    matrices[..., 1, 0], matrices[..., 2, 0], matrices[..., 2, 1] = z, -y, x
    return matrices
