"""Setting a rod's shape: heat relaxes its set shape u0 towards the shape u in which it is held.

    du0/dt = k(T) (u - u0),   k(T) = 1/tau exp(-E/R (1/T - 1/T_ref))

With u held, the part of u that is set at a place is 1 - exp(-integral of k dt). The cold ends at the chucks stay as
they were. While a part is set the rest of a rod with fixed ends may shift a little: that is left out here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from rtcp.ipc.errors import RtcpError
from rtcp.processes.rod.statics import Equilibrium, integrate

Array = npt.NDArray[np.float64]
_GAS_CONSTANT: Final = 8.314462618
_ZERO_C: Final = 273.15


@dataclass(frozen=True)
class Kinetics:
    """Kinetics of shape setting in Nitinol.

    The time constant makes 0.5 min at 500 C set 95 % (industry practice: 0.5 min and more at 500 to 550 C). The
    activation energy is chosen, not measured: at 400 C it makes the same take 18 min.
    """

    time_constant_s: float = 10.0
    """tau at the reference temperature, s."""
    reference_c: float = 500.0
    """Reference temperature, degrees C."""
    activation_energy: float = 155e3
    """E, J/mol."""

    def rate(self, temperature: npt.ArrayLike) -> Array:
        """Return k, 1/s, at temperatures, degrees C, of any shape."""
        inverse = 1.0 / (np.asarray(temperature, dtype=np.float64) + _ZERO_C) - 1.0 / (self.reference_c + _ZERO_C)
        return np.asarray(np.exp(-self.activation_energy / _GAS_CONSTANT * inverse) / self.time_constant_s)


@dataclass(frozen=True)
class Release:
    """A rod after its release.

    shape: the unloaded rod. error: distance of each node from the wanted shape after the best rigid alignment,
    (n + 1,), m. straight_start, straight_end: lengths at the two ends with a set fraction below one half, m.
    """

    shape: Equilibrium
    error: Array
    straight_start: float
    straight_end: float


def set_fraction(times: npt.ArrayLike, temperatures: npt.ArrayLike, kinetics: Kinetics | None = None) -> Array:
    """Return the share of the held shape that is set at each node, (n + 1,), 0 to 1.

    Args:
        times: s, rising, (k,).
        temperatures: degrees C, (n + 1, k).
        kinetics: of the alloy; None: the defaults.

    Raises:
        Invalid: times that do not rise, or another count.
    """
    t, grid = np.asarray(times, dtype=np.float64), np.asarray(temperatures, dtype=np.float64)
    if t.ndim != 1 or grid.ndim != 2 or grid.shape[1] != len(t) or not (np.diff(t) > 0.0).all():
        raise RtcpError(
            "invalid", f"found times {t.shape} and temperatures {grid.shape}, allowed are rising (k,) and (n + 1, k)"
        )
    rates = (Kinetics() if kinetics is None else kinetics).rate(grid)
    return np.asarray(1.0 - np.exp(-(0.5 * (rates[:, 1:] + rates[:, :-1]) * np.diff(t)).sum(axis=1)))


def relax(held: Equilibrium, fraction: npt.ArrayLike) -> Array:
    """Return the set shape u0, (n + 1, 3), 1/m, after a fraction, (n + 1,), of the held shape was set.

    Raises:
        Invalid: another count, or a fraction outside 0 to 1.
    """
    parts = np.asarray(fraction, dtype=np.float64)
    if parts.shape != held.s.shape or not ((parts >= 0.0) & (parts <= 1.0)).all():
        raise RtcpError("invalid", f"fraction: found {parts.shape}, allowed is {held.s.shape} with numbers of 0 to 1")
    return np.asarray(held.set_shape + parts[:, None] * (held.u - held.set_shape))


def release(held: Equilibrium, fraction: npt.ArrayLike, wanted: Array | None = None) -> Release:
    """Return the unloaded rod after a fraction of its shape was set, (n + 1,).

    `wanted`: points of the wanted shape at the same nodes, (n + 1, 3), m; None: the held shape.

    Raises:
        Invalid: as `relax`.
    """
    parts = np.asarray(fraction, dtype=np.float64)
    shape = integrate(held.rod, np.zeros(6), relax(held, parts), steps=len(held.s) - 1)
    unset = np.append(parts < 0.5, False)
    first = int(np.argmin(unset))
    last = len(parts) if first == len(parts) else int(np.argmin(np.append(unset[-2::-1], False)))
    step = held.rod.length / (len(parts) - 1)
    error = aligned_error(shape.p, held.p if wanted is None else wanted)
    return Release(shape, error, min(first * step, held.rod.length), min(last * step, held.rod.length))


def aligned_error(points: Array, wanted: Array) -> Array:
    """Return the distances, (n,), m, of points, (n, 3), from wanted ones after the best rigid alignment."""
    return np.asarray(np.linalg.norm(aligned(points, wanted) - wanted, axis=1))


def aligned(points: Array, wanted: Array) -> Array:
    """Return points, (n, 3), moved as a rigid body onto wanted ones.

    Source: Kabsch, Acta Crystallographica A32, 922 (1976).
    """
    a, b = points - points.mean(axis=0), wanted - wanted.mean(axis=0)
    left, _, right = np.linalg.svd(a.T @ b)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return np.asarray(a @ rotation + wanted.mean(axis=0))
