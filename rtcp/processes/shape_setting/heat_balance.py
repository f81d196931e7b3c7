"""A second thermometer: the temperatures that the measured electrical power allows in the middle of the rod.

A length in the middle of the rod stores the power that it does not lose to the air. It exchanges no heat with its
neighbours, which are as hot, so the balance needs no chucks. Power, heat capacity and losses are known within a
tolerance: the balance is kept twice, with the least and with the greatest power that the tolerance allows for the
stated heat capacity and losses. The resistance is not used: a wrong coefficient deceives the first thermometer only.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi
from typing import Annotated, Final

from annotated_types import Ge, Gt, Le

KELVIN: Final = 273.15
_STEFAN_BOLTZMANN: Final = 5.670374e-8
_CONVECTION_POWER: Final = 1.2
"""Natural convection around a thin horizontal cylinder carries heat as this power of the temperature rise, by the
correlation of Churchill and Chu (1975), Int. J. Heat Mass Transfer 18, between 50 and 500 K."""
_CONVECTION_RISE: Final = 500.0
"""Rise over the air, K, for which `ThermalProperties.convection` is stated."""


@dataclass(frozen=True)
class ThermalProperties:
    """Heat that a rod stores and loses, and how well this is known."""

    diameter: Annotated[float, Ge(1e-4), Le(0.01)]
    """Diameter of the rod, m."""
    heat_capacity: Annotated[float, Ge(1e6), Le(1e7)]
    """Heat capacity by volume, J/(m3 K): density times specific heat."""
    convection: Annotated[float, Ge(1), Le(1000)]
    """Coefficient of convection to the air for a rod that is 500 K hotter than the air, W/(m2 K)."""
    emissivity: Annotated[float, Gt(0), Le(1)]
    """Emissivity of the surface: 0.3 (bright) to 0.8 (oxidised)."""
    tolerance: Annotated[float, Ge(0), Le(0.3)]
    """Greatest relative error of the power, measured against what the rod stores and loses."""

    def stored(self, length: float) -> float:
        """Return the heat capacity of a length, J/K."""
        return self.heat_capacity * 0.25 * pi * self.diameter**2 * length

    def convected(self, length: float, celsius: float, air_c: float) -> float:
        """Return the power that a length of this temperature loses by convection, W."""
        rise = max(celsius - air_c, 0.0)
        coefficient: float = self.convection * (rise / _CONVECTION_RISE) ** (_CONVECTION_POWER - 1.0)
        return coefficient * pi * self.diameter * length * rise

    def radiated(self, length: float, celsius: float, air_c: float) -> float:
        """Return the power that a length of this temperature loses by radiation, W."""
        fourths = (celsius + KELVIN) ** 4 - (air_c + KELVIN) ** 4
        return self.emissivity * _STEFAN_BOLTZMANN * pi * self.diameter * length * fourths


class HeatBalance:
    """Least and greatest temperature in the middle of the rod that the measured power allows."""

    def __init__(self) -> None:
        self.is_known = False
        """Whether there is a rod: a profile was set."""
        self.least_k = self.most_k = 0.0
        """Least and greatest rise in the middle since the measurement of the initial resistance, K."""
        self._initial_c = self._target_k = self._air = self._target_fourths = 1.0
        self._over_air_k = 0.0
        self._capacity = self._convected = self._radiated = 1.0
        self._tolerance = 0.0

    def set_rod(
        self, initial_c: float, air_c: float, target_c: float, capacity: float, convected: float, radiated: float,
        tolerance: float,
    ) -> None:  # fmt: skip
        """Set the properties of the rod; the temperatures go on.

        Args:
            initial_c: temperature at which the initial resistance is measured, C.
            air_c: temperature of the air, C.
            target_c: temperature for which the losses are stated, C.
            capacity: heat capacity of the rod between the chucks, J/K.
            convected: loss by convection of a rod that has the target temperature from end to end, W.
            radiated: its loss by radiation, W.
            tolerance: see `ThermalProperties.tolerance`.
        """
        self.is_known = True
        self._initial_c, self._over_air_k = initial_c, initial_c - air_c
        self._target_k = target_c - air_c
        self._air = air_c + KELVIN
        self._target_fourths = (target_c + KELVIN) ** 4 - self._air**4
        self._capacity, self._convected, self._radiated = capacity, convected, radiated
        self._tolerance = tolerance

    @property
    def least_c(self) -> float:
        """Least temperature in the middle, C."""
        return self._initial_c + self.least_k

    @property
    def most_c(self) -> float:
        """Greatest temperature in the middle, C."""
        return self._initial_c + self.most_k

    def begin(self) -> None:
        """Begin with a rod that is as cold as for the measurement of its initial resistance."""
        self.least_k = self.most_k = 0.0

    def update(self, power: float, passed_s: float) -> None:
        """Let a time pass with a measured power, W."""
        if self.is_known and abs(power) < inf:
            # A current or voltage that is no number trips by itself; here it would remain.
            self.least_k += self._change(self.least_k, power * (1.0 - self._tolerance), passed_s)
            self.most_k += self._change(self.most_k, power * (1.0 + self._tolerance), passed_s)

    def _change(self, rise_k: float, power: float, passed_s: float) -> float:
        """Return the change of a rise with a power of the whole rod, W, in a time, s."""
        over_k = rise_k + self._over_air_k
        lost = 0.0
        if over_k > 0.0:
            fourths = (self._air + over_k) ** 4 - self._air**4
            lost = self._convected * (over_k / self._target_k) ** _CONVECTION_POWER
            lost += self._radiated * fourths / self._target_fourths
        return (power - lost) / self._capacity * passed_s
