"""A second thermometer: the temperatures that the measured electrical power allows in the middle of the rod.

A length in the middle of the rod stores the power that it does not lose to the air. It exchanges no heat with its
neighbours, which are as hot, so the balance needs no chucks. Power, heat capacity and losses are known within a
tolerance: the balance is kept twice, with the least and with the greatest power that the tolerance allows for the
stated heat capacity and losses. The resistance is not used: a wrong coefficient deceives the first thermometer only.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log, pi
from typing import Annotated, Final

from annotated_types import Ge, Gt, Le

KELVIN: Final = 273.15
_STEFAN_BOLTZMANN: Final = 5.670374e-8
_CONVECTION_POWER: Final = 1.2
"""Natural convection around a thin horizontal cylinder carries heat as this power of the temperature rise, by the
correlation of Churchill and Chu (1975), Int. J. Heat Mass Transfer 18, between 50 and 500 K."""
_CONVECTION_RISE: Final = 500.0
"""Rise over the air, K, for which `ThermalProperties.convection` is stated."""

COLD_K: Final = 3.0
"""Rise over the initial temperature, K, at which a rod counts as cold: the target of the next heating is 3 K higher."""
MELTING_C: Final = 1310.0
"""Melting point of equiatomic NiTi, C: no rod is hotter, whatever has failed."""


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

    @property
    def heat_transfer(self) -> float:
        """Mean coefficient of convection and radiation for a rod that is 500 K hotter than an air of 20 C, W/(m2 K)."""
        return self.convection + self.radiated(1.0, 20.0 + _CONVECTION_RISE, 20.0) / (
            pi * self.diameter * _CONVECTION_RISE
        )

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


def natural_convection(diameter: float) -> float:
    """Return `ThermalProperties.convection` of a horizontal rod in air of 20 C, W/(m2 K).

    Churchill and Chu (1975), Int. J. Heat Mass Transfer 18, with the properties of air at 543 K: conductivity
    0.0423 W/(m K), viscosity 43.5e-6 m2/s, Prandtl number 0.71.
    """
    film_k, conductivity, viscosity, prandtl = 543.0, 0.0423, 43.5e-6, 0.71
    rayleigh = 9.81 * _CONVECTION_RISE / film_k * diameter**3 * prandtl / viscosity**2
    factor = float((1.0 + (0.559 / prandtl) ** (9 / 16)) ** (-8 / 27))
    nusselt = (0.6 + 0.387 * float(rayleigh ** (1 / 6)) * factor) ** 2
    return nusselt * conductivity / diameter


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

    def forget_rod(self) -> None:
        """Know no rod, until the next `set_rod`."""
        self.is_known = False

    def update(self, power: float, passed_s: float) -> None:
        """Let a time pass with a measured power, W."""
        if self.is_known and abs(power) < inf:
            # A current or voltage that is no number trips by itself; here it would remain.
            self.least_k += self._change(self.least_k, power * (1.0 - self._tolerance), passed_s)
            self.most_k += self._change(self.most_k, power * (1.0 + self._tolerance), passed_s)

    @property
    def longest_cooling_s(self) -> float:
        """Longest time for which this rod may be hot without power, s: from its melting point on."""
        return self._time_between(MELTING_C - self._initial_c, COLD_K)

    def time_to_cold(self) -> float:
        """Return the time without power until the greatest temperature is at most `COLD_K` over the initial one, s."""
        return self._time_between(self.most_k, COLD_K)

    def _time_between(self, from_k: float, rise_k: float) -> float:
        """Return the time in which the middle cools from one rise to another one, s; 0 where it is as cold already.

        With the losses c x^1.2 + r x of a rise x, where r is the radiation of a rod as cold as the air,
        x^-0.2 obeys a linear equation. The real radiation is greater, and the chucks cool too: it is the longest time.
        """
        if not self.is_known or from_k <= rise_k:
            return 0.0
        share = 1.0 - self._tolerance
        bend: float = _CONVECTION_POWER - 1.0
        convected: float = share * self._convected / self._target_k**_CONVECTION_POWER
        radiated = share * 4.0 * self._air**3 * self._radiated / self._target_fourths
        began, ends = float(from_k**-bend), float(rise_k**-bend)
        if not radiated:
            return (ends - began) * self._capacity / (bend * convected)
        ratio = convected / radiated
        return log((ends + ratio) / (began + ratio)) * self._capacity / (bend * radiated)

    def _change(self, rise_k: float, power: float, passed_s: float) -> float:
        """Return the change of a rise with a power of the whole rod, W, in a time, s."""
        over_k = rise_k + self._over_air_k
        lost = 0.0
        if over_k > 0.0:
            fourths = (self._air + over_k) ** 4 - self._air**4
            lost = self._convected * (over_k / self._target_k) ** _CONVECTION_POWER
            lost += self._radiated * fourths / self._target_fourths
        return (power - lost) / self._capacity * passed_s
