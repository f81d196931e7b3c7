"""A Nitinol rod between two cold chucks, heated by its own current: temperature, phase, resistance and set shape.

One-dimensional. SI units, temperatures in C. `rtcp.virtual.heater_circuit` provides the current.
"""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

KELVIN = 273.15
GRAVITY = 9.80665
STEFAN_BOLTZMANN = 5.670374e-8
GAS_CONSTANT = 8.314463
REFERENCE_TEMPERATURE = 20.0
"""Reference temperature of the resistivities, C."""
MELTING_TEMPERATURE = 1310.0
"""Temperature at which the rod melts through, C (usual value for NiTi; not in the thesis)."""

SETTING_STARTS, SETTING_FULL = 450.0, 500.0
"""Temperatures below which no shape is set and above which the rate law applies in full, C."""
STRUCTURE_LOST = 600.0
"""Temperature above which a cell loses its structure, C (Kellogg; industrialheating)."""
_SETTING_TIME, _SETTING_TEMPERATURE = 10.0, 525.0
"""Time constant (s) at a temperature (C): 95 % set after 30 s, the shortest published time."""
_SETTING_ENERGY = 150e3
"""Activation energy of shape setting, J/mol (assumed: the rate doubles every 25 K)."""

_UPDATE_INTERVAL = 0.005
"""Upper bound on the update interval of heat exchange, stress and set shape, s."""
_STABLE_SHARE = 0.25
"""Upper bound on that interval as a share of a cell's time constant (explicit scheme)."""
_GRADING = 10.0
"""Ratio of the cell lengths in the middle and at a chuck: the cold end of a thin rod is only 5 mm long."""
_FIBRES = (np.arange(8) + 0.5) / 8
_FIBRE_WEIGHTS = np.sqrt(1.0 - _FIBRES**2) / np.sqrt(1.0 - _FIBRES**2).sum()
"""Distances of fibres from the neutral plane, radii, and their shares of a circular section."""


@dataclass(frozen=True)
class Alloy:
    """Data of a NiTi alloy; the defaults are a superelastic wire.

    Sources: density, specific heat (837), latent heat (24 kJ/kg) and conductivity from the SMA Inc. table of 2003;
    models use 450 to 470 J/kg K and 12 kJ/kg (doi 10.1109/TRO.2017.2679199, table II). Resistivity of austenite and
    martensite in 1e-8 ohm m: 100, 80 (SMA Inc.), 82, 76 (others), 89, 102 (wire model): the sign of the jump is open.
    Its temperature coefficients are from one wire model. Transformation temperatures follow from the plateaus of a
    superelastic wire at 22 C, 460 and 225 MPa, by 6.5 MPa/K (Confluent Medical); the widths are assumed.
    """

    density: float = 6450.0
    """kg/m^3."""
    specific_heat: float = 500.0
    """J/(kg K)."""
    latent_heat: float = 24e3
    """Heat from martensite to austenite, J/kg."""
    conductivity_austenite: float = 18.0
    """W/(m K)."""
    conductivity_martensite: float = 8.6
    """W/(m K)."""
    resistivity_austenite: float = 89e-8
    """At 20 C, ohm m."""
    resistivity_martensite: float = 102e-8
    """At 20 C, ohm m; above or below that of austenite."""
    coefficient_austenite: float = 2e-4
    """d rho/dT over rho at 20 C, 1/K."""
    coefficient_martensite: float = 3e-4
    """d rho/dT over rho at 20 C, 1/K."""
    martensite_start: float = -49.0
    """Ms, C: martensite begins to form on cooling."""
    martensite_finish: float = -64.0
    """Mf, C."""
    austenite_start: float = -27.0
    """As, C: austenite begins to form on heating."""
    austenite_finish: float = -12.0
    """Af, C."""
    emissivity: float = 0.5
    """0.3 (bright) to 0.8 (oxidised)."""
    modulus: float = 62.9e9
    """Young's modulus of austenite, Pa (Confluent Medical)."""
    stress_rate: float = 6.5e6
    """Rise of the plateau stress with temperature, Pa/K (Confluent Medical)."""
    transformation_strain: float = 0.046
    """Length of the plateau (Confluent Medical)."""

    def __post_init__(self) -> None:
        if not (
            self.martensite_finish < self.martensite_start < self.austenite_finish
            and self.martensite_finish < self.austenite_start < self.austenite_finish
        ):
            raise ValueError(
                f"Mf {self.martensite_finish}, Ms {self.martensite_start}, As {self.austenite_start}, "
                f"Af {self.austenite_finish} C do not form a hysteresis loop; make Mf < Ms < Af and Mf < As < Af"
            )


_RESISTIVITIES = ((100e-8, 80e-8), (82e-8, 76e-8), (89e-8, 102e-8))


def draw(random: Random) -> HeatedRod:
    """Return a random rod within the published ranges of `Alloy`, 0.5 to 3.2 mm thick and 0.2 to 0.4 m long.

    Assumed: 3 % on a source's resistivities, 25 % on the temperature coefficients, Af from -15 to 45 C.
    """
    austenite, martensite = random.choice(_RESISTIVITIES)
    purity = random.uniform(0.97, 1.03)
    finish = random.uniform(-15.0, 45.0)
    start = finish - random.uniform(25.0, 40.0)
    alloy = Alloy(
        specific_heat=random.uniform(450.0, 837.0),
        latent_heat=random.uniform(12e3, 24e3),
        resistivity_austenite=austenite * purity,
        resistivity_martensite=martensite * purity,
        coefficient_austenite=2e-4 * random.uniform(0.75, 1.25),
        coefficient_martensite=3e-4 * random.uniform(0.75, 1.25),
        martensite_start=start,
        martensite_finish=start - random.uniform(10.0, 20.0),
        austenite_start=finish - random.uniform(10.0, 20.0),
        austenite_finish=finish,
        emissivity=random.uniform(0.3, 0.8),
    )
    return HeatedRod(alloy, diameter=random.uniform(0.5e-3, 3.2e-3), length=random.uniform(0.2, 0.4))


def convection(temperature: Floats, ambient: float, diameter: float) -> Floats:
    """Return the coefficient of natural convection around a horizontal cylinder, W/(m^2 K).

    Churchill and Chu, Int. J. Heat Mass Transfer 18, 1975. Air at film temperature: conductivity 0.0263 W/(m K),
    viscosity 15.9e-6 and diffusivity 22.5e-6 m^2/s at 300 K, with the powers 0.8, 1.7 and 1.7 of temperature.
    """
    film = (temperature + ambient) / 2 + KELVIN
    ratio = film / 300.0
    viscosity, diffusivity = 15.9e-6 * ratio**1.7, 22.5e-6 * ratio**1.7
    rayleigh = GRAVITY / film * np.abs(temperature - ambient) * diameter**3 / (viscosity * diffusivity)
    prandtl = 15.9 / 22.5
    nusselt = (0.6 + 0.387 * rayleigh ** (1 / 6) / (1 + (0.559 / prandtl) ** (9 / 16)) ** (8 / 27)) ** 2
    return np.asarray(nusselt * 0.0263 * ratio**0.8 / diameter)


def radiation(temperature: Floats, ambient: float, emissivity: float) -> Floats:
    """Return the radiated flux, W/m^2."""
    return np.asarray(emissivity * STEFAN_BOLTZMANN * ((temperature + KELVIN) ** 4 - (ambient + KELVIN) ** 4))


class HeatedRod:
    """A clamped rod (`diameter`, `length` in m) in air and chucks of `ambient` C, cooled from above Af, straight.

    Arrays have one row per cell, from the first chuck to the second. The state is enthalpy and share of martensite; the
    share stays between the two branches of the hysteresis loop (a play operator), so latent heat needs no iteration.
    """

    def __init__(self, alloy: Alloy, *, diameter: float, length: float, ambient: float = 20.0, cells: int = 48) -> None:
        if cells < 2 or cells % 2:
            raise ValueError(f"{cells} cells; the rod is symmetric: use an even number")
        self.alloy = alloy
        self.diameter = diameter
        self.length = length
        self.ambient = ambient
        half = _GRADING ** np.linspace(0.0, 1.0, cells // 2)
        self.cell_lengths: Floats = np.concatenate((half, half[::-1])) * (length / 2 / half.sum())
        """Length of each cell, m; shorter near the chucks."""
        self.positions: Floats = np.cumsum(self.cell_lengths) - self.cell_lengths / 2
        """Centre of each cell along the rod, m."""
        self.area = np.pi / 4 * diameter**2
        """Cross section, m^2."""
        self.mass = alloy.density * self.area * length
        """Mass, kg."""
        self.shape: Floats = np.zeros((cells, 3))
        """Imposed twist rate and two curvatures, 1/m; set by `bend`."""
        self.set_shape: Floats = np.zeros((cells, 3))
        """Twist rate and curvatures of the unloaded rod, 1/m."""
        self.set_fraction: Floats = np.zeros(cells)
        """Share of the last `bend` that has become the rod's own shape, 0 to 1."""
        self.temperature: Floats = np.full(cells, ambient)
        """C."""
        self.highest_temperature: Floats = np.full(cells, ambient)
        """Highest temperature that each cell has had, C."""
        cooling = (alloy.martensite_start - ambient) / (alloy.martensite_start - alloy.martensite_finish)
        self.martensite: Floats = np.full(cells, min(1.0, max(0.0, cooling)))
        """Share of martensite, 0 to 1."""
        self.resistance = 0.0
        """Resistance between the chucks, without contacts, ohm; infinite once the rod has melted."""
        self.joule_energy = self.air_energy = self.chuck_energy = 0.0
        """Heat generated by the current, lost to the air, and lost to the chucks, J."""
        self._prepare(cells)
        self._update()
        self._transform()

    def _prepare(self, cells: int) -> None:
        """Allocate the buffers and compute the coefficients of a step."""
        alloy = self.alloy
        c, latent = alloy.specific_heat, alloy.latent_heat
        self._enthalpy = c * self.temperature - latent * self.martensite
        self._cell_masses = alloy.density * self.area * self.cell_lengths
        self._ohm_per_resistivity = self.cell_lengths / self.area
        self._heat_per_current = 1.0 / (alloy.density * self.area**2)
        heating_width = alloy.austenite_finish - alloy.austenite_start
        cooling_width = alloy.martensite_start - alloy.martensite_finish
        self._heating = (c * alloy.austenite_finish, 1 / (c * heating_width + latent))
        self._cooling = (c * alloy.martensite_start, 1 / (c * cooling_width + latent))
        slope_a = alloy.resistivity_austenite * alloy.coefficient_austenite
        slope_m = alloy.resistivity_martensite * alloy.coefficient_martensite
        base_a = alloy.resistivity_austenite - slope_a * REFERENCE_TEMPERATURE
        base_m = alloy.resistivity_martensite - slope_m * REFERENCE_TEMPERATURE
        self._austenite_line = (base_a, slope_a)
        self._jump_line = (base_m - base_a, slope_m - slope_a)
        self._loss_temperatures = np.linspace(-100.0, 1500.0, 321)
        grid = self._loss_temperatures
        self._loss_fluxes = convection(grid, self.ambient, self.diameter) * (grid - self.ambient)
        self._loss_fluxes += radiation(grid, self.ambient, alloy.emissivity)
        self._surfaces = np.pi * self.diameter * self.cell_lengths
        self._resistivity, self._exchange, self._buffer, self._upper, self._lower = np.zeros((5, cells))
        self._stress_formed, self._stress_kept = np.zeros((2, cells))
        self._padded = np.full(cells + 2, self.ambient)
        self._flux = np.zeros(cells + 1)
        self._air_power = self._chuck_power = self._elapsed = 0.0
        diffusivity = alloy.conductivity_austenite / (alloy.density * c)
        shortest = float(self.cell_lengths.min())
        self._interval = min(_UPDATE_INTERVAL, _STABLE_SHARE * shortest**2 / (3.0 * diffusivity))

    @property
    def mean_temperature(self) -> float:
        """Mean temperature along the rod, C, as a resistance measurement shows it."""
        return float(self.temperature @ self.cell_lengths) / self.length

    @property
    def middle_temperature(self) -> float:
        """Temperature at the centre of the rod, C."""
        middle = len(self.temperature) // 2
        return float(self.temperature[middle - 1] + self.temperature[middle]) / 2

    @property
    def stored_energy(self) -> float:
        """Enthalpy relative to austenite at 0 C, J."""
        return float(self._enthalpy @ self._cell_masses)

    @property
    def structure_lost(self) -> NDArray[np.bool_]:
        """Mask of the cells that exceeded 600 C."""
        return np.asarray(self.highest_temperature > STRUCTURE_LOST)

    @property
    def strain(self) -> Floats:
        """Bending strain at the surface, from the curvature beyond the set shape."""
        return np.asarray(self.diameter / 2 * np.hypot(*(self.shape - self.set_shape)[:, 1:].T))

    def bend(self, shape: Floats) -> None:
        """Impose twist rate and two curvatures (1/m), one row per cell, as held by the arms."""
        self.shape[:] = shape
        self.set_fraction[:] = 0.0
        self._update_stress()

    def release(self) -> None:
        """Release the rod, which springs back to its set shape."""
        self.bend(self.set_shape)

    def step(self, dt: float, current: float) -> None:
        """Advance by `dt` seconds at `current` A, in stable steps of 5 ms or less."""
        while dt > self._interval:
            self._advance(self._interval, current)
            dt -= self._interval
        self._advance(dt, current)

    def _advance(self, dt: float, current: float) -> None:
        heat, square = self._buffer, current * current
        if square:
            self.joule_energy += square * self.resistance * dt
        np.multiply(self._resistivity, square * self._heat_per_current, out=heat)
        heat += self._exchange
        heat *= dt
        self._enthalpy += heat
        self._transform()
        self._elapsed += dt
        if self._elapsed >= self._interval - 1e-9:
            self._update()

    def _transform(self) -> None:
        """Compute share of martensite, temperature and resistance from the enthalpy."""
        alloy, enthalpy, share, temperature = self.alloy, self._enthalpy, self.martensite, self.temperature
        upper, lower, resistivity = self._upper, self._lower, self._resistivity
        # Including latent heat, a branch of the loop is a straight line over the enthalpy too.
        np.subtract(self._heating[0], enthalpy, out=upper)
        upper *= self._heating[1]
        np.maximum(upper, self._stress_kept, out=upper)
        np.subtract(self._cooling[0], enthalpy, out=lower)
        lower *= self._cooling[1]
        np.maximum(lower, self._stress_formed, out=lower)
        np.minimum(lower, 1.0, out=lower)
        np.minimum(share, upper, out=share)
        np.maximum(share, lower, out=share)
        np.multiply(share, alloy.latent_heat, out=temperature)
        temperature += enthalpy
        temperature /= alloy.specific_heat
        np.multiply(temperature, self._jump_line[1], out=upper)
        upper += self._jump_line[0]
        upper *= share
        np.multiply(temperature, self._austenite_line[1], out=resistivity)
        resistivity += self._austenite_line[0]
        resistivity += upper
        if self.resistance != np.inf:
            self.resistance = float(resistivity @ self._ohm_per_resistivity)

    def _update(self) -> None:
        """Update the slow quantities: heat to air, neighbours and chucks; highest temperature, set shape, stress."""
        alloy, temperature = self.alloy, self.temperature
        elapsed, self._elapsed = self._elapsed, 0.0
        self.air_energy += self._air_power * elapsed
        self.chuck_energy += self._chuck_power * elapsed
        np.maximum(self.highest_temperature, temperature, out=self.highest_temperature)
        change = alloy.conductivity_martensite - alloy.conductivity_austenite
        halves = self.cell_lengths / (2 * self.area * (alloy.conductivity_austenite + change * self.martensite))
        flux, padded = self._flux, self._padded
        padded[1:-1] = temperature
        np.subtract(padded[1:], padded[:-1], out=flux)
        flux[1:-1] /= halves[1:] + halves[:-1]
        flux[0] /= halves[0]
        flux[-1] /= halves[-1]
        air = self._surfaces * np.interp(temperature, self._loss_temperatures, self._loss_fluxes)
        np.subtract(flux[1:], flux[:-1], out=self._exchange)
        self._exchange -= air
        self._exchange /= self._cell_masses
        self._air_power = float(air.sum())
        self._chuck_power = float(flux[0] - flux[-1])
        hottest = float(temperature.max())
        if hottest > MELTING_TEMPERATURE:
            self.resistance = np.inf
        if hottest > SETTING_STARTS:
            share = -np.expm1(-elapsed * setting_rate(temperature))
            self.set_fraction += (1.0 - self.set_fraction) * share
            self.set_shape += (self.shape - self.set_shape) * share[:, None]
        if self.shape.any():
            self._update_stress()

    def _update_stress(self) -> None:
        """Compute the least and largest share of martensite under the bending stress."""
        alloy = self.alloy
        strains = np.outer(self.strain, _FIBRES)
        for share, start in (
            (self._stress_formed, alloy.martensite_start),
            (self._stress_kept, alloy.austenite_finish),
        ):
            plateau = np.maximum(0.0, alloy.stress_rate * (self.temperature - start)) / alloy.modulus
            fibres = np.clip((strains - plateau[:, None]) / alloy.transformation_strain, 0.0, 1.0)
            np.matmul(fibres, _FIBRE_WEIGHTS, out=share)


def setting_rate(temperature: Floats) -> Floats:
    """Return the rate at which a shape is set, 1/s: 0 to 450 C, 1/20 at 500 C, 1/10 at 525 C.

    Assumed law, for lack of a published one. It meets "half a minute and more at 500 to 550 C" (Kellogg;
    industrialheating).
    """
    reference = 1.0 / (_SETTING_TEMPERATURE + KELVIN)
    arrhenius = np.exp(_SETTING_ENERGY / GAS_CONSTANT * (reference - 1.0 / (temperature + KELVIN))) / _SETTING_TIME
    return np.asarray(arrhenius * np.clip((temperature - SETTING_STARTS) / (SETTING_FULL - SETTING_STARTS), 0.0, 1.0))
