"""Ratio of resistances and temperature, of the mean and in the middle of the rod, with their uncertainty.

R_F / R_I = (rho20 + alpha (T_F - 20)) / (rho20 + alpha (T_I - 20)), equation 4.3 of the thesis, holds for the mean
temperature. Cold chucks keep the ends cold: the middle is hotter, by the solution of a fin heated along its length.
Plain numbers: the loop uses `RatioScale`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import cosh, hypot, sqrt, tanh
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

_RELATIVE = Annotated[float, Ge(0), Lt(1)]
_LONGEST_FIN = 350.0
"""Half a length by the cold end's length from which on cosh would overflow; the ends do not reach the middle then."""


class Place(Enum):
    """Which temperature of the rod is meant."""

    MEAN = "mean"
    MIDDLE = "middle"


@dataclass(frozen=True)
class Temperature:
    """A temperature of the rod and its standard uncertainty."""

    celsius: float
    uncertainty_k: float
    place: Place

    def __str__(self) -> str:
        return f"{self.celsius:.1f} C in the {self.place.value} (u = {self.uncertainty_k:.1f} K)"


@dataclass(frozen=True)
class Alloy:
    """Resistivity of the austenite, as a line over the temperature (equation 4.2)."""

    resistivity_20: Annotated[float, Ge(1e-7), Le(1e-5)]
    """Resistivity at 20 C, ohm m."""
    alpha: Annotated[float, Ge(1e-11), Le(1e-8)]
    """Slope of the resistivity, ohm m/K; not by the resistivity itself."""
    alpha_uncertainty: _RELATIVE
    """Relative standard uncertainty of `alpha` by `resistivity_20`."""

    def resistivity(self, celsius: float) -> float:
        """Return the resistivity, ohm m."""
        return self.resistivity_20 + self.alpha * (celsius - 20.0)


@dataclass(frozen=True)
class ColdEnds:
    """Effect of the chucks on the temperature along the rod."""

    length: Annotated[float, Ge(0.02), Le(2)]
    """Length of the rod between the chucks, m."""
    end_length: Annotated[float, Gt(0), Le(0.1)]
    """Length over which the rise of temperature at an end falls by e, m: sqrt(k d / 4 h), some 5 to 20 mm."""
    end_uncertainty: _RELATIVE
    """Relative standard uncertainty of `end_length`."""

    def mean_by_middle(self) -> float:
        """Return the rise of the mean by that of the middle, over the temperature of the chucks."""
        return _mean_by_middle(0.5 * self.length / self.end_length)

    def uncertainty(self) -> float:
        """Return the standard uncertainty of `mean_by_middle`."""
        if not self.end_uncertainty:
            return 0.0
        half = 0.5 * self.length / self.end_length
        longer, shorter = half / (1.0 + self.end_uncertainty), half / (1.0 - self.end_uncertainty)
        return 0.5 * abs(_mean_by_middle(shorter) - _mean_by_middle(longer))


def _mean_by_middle(half: float) -> float:
    """Return it for half the rod's length by the end's length: T(x) = 1 - cosh(x) / cosh(half)."""
    if half > _LONGEST_FIN:
        return 1.0 - 1.0 / half
    return (1.0 - tanh(half) / half) / (1.0 - 1.0 / cosh(half))


def cold_end_length(diameter: float, conductivity: float, heat_transfer: float) -> float:
    """Return the length of a cold end, m.

    Args:
        diameter: of the rod, m.
        conductivity: W/m K; 18 for austenite.
        heat_transfer: change of the heat flux to the air with the rod's temperature, W/m2 K, where the rod is hot: some
            1.5 times flux by rise.
    """
    return sqrt(conductivity * diameter / (4.0 * heat_transfer))


@dataclass(frozen=True)
class RatioScale:
    """Temperatures of the rod as lines over the ratio of its resistance to the initial one."""

    initial_c: float
    """Temperature of the whole rod at ratio 1, C."""
    kelvin_per_ratio: float
    """Resistivity at `initial_c` by alpha, K."""
    chuck_c: float
    """Temperature of the chucks, C."""
    mean_by_middle: float
    """See `ColdEnds.mean_by_middle`."""

    def mean(self, ratio: float) -> float:
        """Return the mean temperature, C."""
        return self.initial_c + (ratio - 1.0) * self.kelvin_per_ratio

    def middle(self, ratio: float) -> float:
        """Return the temperature in the middle, C."""
        return self.chuck_c + (self.mean(ratio) - self.chuck_c) / self.mean_by_middle

    def ratio_for_middle(self, celsius: float) -> float:
        """Return the ratio at which the middle has a temperature, C."""
        return 1.0 + (self.mean_of_middle(celsius) - self.initial_c) / self.kelvin_per_ratio

    def mean_of_middle(self, celsius: float) -> float:
        """Return the mean temperature of a rod whose middle has a temperature, C."""
        return self.chuck_c + self.mean_by_middle * (celsius - self.chuck_c)


def ratio_scale(alloy: Alloy, ends: ColdEnds, initial_c: float, chuck_c: float) -> RatioScale:
    """Return the lines of a rod whose initial resistance is taken at `initial_c`, C."""
    return RatioScale(initial_c, alloy.resistivity(initial_c) / alloy.alpha, chuck_c, ends.mean_by_middle())


def mean_temperature(
    alloy: Alloy, scale: RatioScale, ratio: float, ratio_uncertainty: float, initial_uncertainty_k: float
) -> Temperature:
    """Return the mean temperature at a ratio, with the standard uncertainties of ratio and initial temperature, K."""
    mean = scale.mean(ratio)
    # dT/d(rho20/alpha) = ratio - 1, and dT/dT_I = ratio, where the slope itself is known.
    slope = (ratio - 1.0) * (alloy.resistivity_20 / alloy.alpha) * alloy.alpha_uncertainty
    own = hypot(scale.kelvin_per_ratio * ratio_uncertainty, slope, ratio * initial_uncertainty_k)
    return Temperature(mean, own, Place.MEAN)


def middle_temperature(ends: ColdEnds, scale: RatioScale, mean: Temperature) -> Temperature:
    """Return the temperature in the middle for that of the mean."""
    factor = scale.mean_by_middle
    rise = (mean.celsius - scale.chuck_c) / factor
    own = hypot(mean.uncertainty_k / factor, rise * ends.uncertainty() / factor)
    return Temperature(scale.chuck_c + rise, own, Place.MIDDLE)
