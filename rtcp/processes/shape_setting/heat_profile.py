"""The profile of a heating: temperature or ratio, times, the rod's properties; `heat_command` makes the loop's numbers.

The loop imports this module: no validator, no numpy. Files: `rtcp.processes.shape_setting.profile`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Final

from annotated_types import Ge, Le

from rtcp.config.numbers import NotNegative
from rtcp.processes.shape_setting import temperature
from rtcp.processes.shape_setting.heat_balance import ThermalProperties, natural_convection
from rtcp.processes.shape_setting.messages import PROFILE_RANGES, RATIO_RANGES, ProfileKey, RatioKey, SetHeatProfile

# The ranges that the loop checks again.
_RANGES = {key: (Ge(least), Le(greatest)) for key, (least, greatest) in PROFILE_RANGES.items()}
_ROOM, _TARGET, _RAMP = _RANGES[ProfileKey.INITIAL_C], _RANGES[ProfileKey.TARGET_C], _RANGES[ProfileKey.RAMP_K_S]
_COOL, _CURRENT, _POWER = (_RANGES[key] for key in (ProfileKey.COOL_C, ProfileKey.MAX_CURRENT, ProfileKey.MAX_POWER))
_RATIO = RATIO_RANGES[RatioKey.TARGET_RATIO]
_Room = Annotated[float, _ROOM[0], _ROOM[1]]
_POWER_OF_NEED: Final = 1.3
"""Default of the power limit by the power that the target and the ramp need."""
_CONDUCTIVITY: Final = 18.0
"""Of austenite, W/(m K)."""
_END_UNCERTAINTY: Final = 0.15

NITINOL: Final = temperature.Alloy(8.9e-7, 1.78e-10, 0.1)
"""Superelastic Nitinol by one source, as in config/shape_setting/nitinol.yaml."""
OF_THE_ROD: Final = 0.0
"""Length or diameter that `HeatProfile.of_rod` replaces by that of the rod, m."""
_ENDS: Final = temperature.ColdEnds(OF_THE_ROD, 0.0087, _END_UNCERTAINTY)
_THERMAL: Final = ThermalProperties(OF_THE_ROD, 3.225e6, 42.0, 0.5, 0.06)


@dataclass(frozen=True)
class Limits:
    """Limits of the heater with this rod."""

    current: Annotated[float, _CURRENT[0], _CURRENT[1]] = 50.0
    """Greatest average current, A."""
    power: Annotated[float, _POWER[0], _POWER[1]] = 0.0
    """Greatest average power, W. Default: 1.3 times the power that the target and the ramp need."""


@dataclass(frozen=True)
class HeatProfile:
    """A profile: either `target_c` or `target_ratio`, time at it, and the rod's properties."""

    alloy: temperature.Alloy = NITINOL
    ends: temperature.ColdEnds = _ENDS
    """Default: by length and diameter of the rod (`of_rod`)."""
    thermal: ThermalProperties = _THERMAL
    """Default: by the diameter of the rod (`of_rod`)."""
    target_c: Annotated[float, _TARGET[0], _TARGET[1]] = 0.0
    """Temperature in the middle of the rod, C; Nitinol loses its structure above 600 C."""
    target_ratio: Annotated[float, Ge(_RATIO[0]), Le(_RATIO[1])] = 0.0
    """Ratio of the resistance at the target to the initial one, in place of `target_c` (equation 4.3 of the thesis)."""
    hold_s: NotNegative = 120.0
    """Time at the target, s."""
    ramp_k_s: Annotated[float, _RAMP[0], _RAMP[1]] = 50.0
    """Rise of the setpoint in the middle, K/s."""
    cool_c: Annotated[float, _COOL[0], _COOL[1]] = 80.0
    """Temperature in the middle at which the relay opens and the rod can be released, C."""
    initial_c: _Room = 20.0
    """Temperature of the rod when its initial resistance is measured, C: of the room, or of a preheat above Af."""
    initial_uncertainty_k: NotNegative = 1.0
    """Standard uncertainty of `initial_c`, K."""
    chuck_c: _Room = 20.0
    """Temperature of the chucks, C."""
    ratio_uncertainty: Annotated[float, Ge(0), Le(0.1)] = 0.001
    """Standard uncertainty of the ratio of resistances: contacts, noise, offsets; 0.002 is some 10 K."""
    limits: Limits = field(default_factory=Limits)

    def of_rod(self, length: float, diameter: float) -> HeatProfile:
        """Return the profile with everything that it leaves out: ends, thermal, target temperature, limit of the power.

        Args:
            length: of the rod between the chucks, m, where `ends` is left out.
            diameter: of the rod, m, where `thermal` is left out.
        """
        thermal, ends = self.thermal, self.ends
        if thermal.diameter == OF_THE_ROD:
            thermal = replace(thermal, diameter=diameter, convection=natural_convection(diameter))
        if ends.length == OF_THE_ROD:
            cold = temperature.cold_end_length(thermal.diameter, _CONDUCTIVITY, thermal.heat_transfer)
            ends = replace(ends, length=length, end_length=cold)
        profile = replace(self, ends=ends, thermal=thermal)
        if self.target_ratio:
            scale = temperature.ratio_scale(self.alloy, ends, self.initial_c, self.chuck_c)
            profile = replace(profile, target_c=scale.middle(self.target_ratio), target_ratio=0.0)
        if not self.limits.power:
            limits = replace(self.limits, power=_POWER_OF_NEED * profile.needed_power)
            profile = replace(profile, limits=limits)
        return profile

    @property
    def needed_power(self) -> float:
        """Power that a complete profile needs to hold the target and to rise by the ramp, W."""
        thermal, rod = self.thermal, (self.ends.length, self.target_c, self.chuck_c)
        return thermal.convected(*rod) + thermal.radiated(*rod) + thermal.stored(self.ends.length) * self.ramp_k_s


def target_ratio(profile: HeatProfile) -> float:
    """Return the ratio of resistances at which the middle has its target temperature."""
    scale = temperature.ratio_scale(profile.alloy, profile.ends, profile.initial_c, profile.chuck_c)
    return scale.ratio_for_middle(profile.target_c)


def target_temperatures(profile: HeatProfile) -> tuple[temperature.Temperature, temperature.Temperature]:
    """Return the temperatures of mean and middle at the target, with their uncertainties."""
    scale = temperature.ratio_scale(profile.alloy, profile.ends, profile.initial_c, profile.chuck_c)
    mean = temperature.mean_temperature(
        profile.alloy, scale, target_ratio(profile), profile.ratio_uncertainty, profile.initial_uncertainty_k
    )
    return mean, temperature.middle_temperature(profile.ends, scale, mean)


def heat_command(profile: HeatProfile) -> SetHeatProfile:
    """Return the command that brings a profile to the loop."""
    scale = temperature.ratio_scale(profile.alloy, profile.ends, profile.initial_c, profile.chuck_c)
    thermal, length = profile.thermal, profile.ends.length
    return SetHeatProfile(
        initial_c=scale.initial_c,
        chuck_c=scale.chuck_c,
        kelvin_per_ratio=scale.kelvin_per_ratio,
        mean_by_middle=scale.mean_by_middle,
        uncertainty_k=target_temperatures(profile)[1].uncertainty_k,
        target_c=profile.target_c,
        ramp_k_s=profile.ramp_k_s,
        hold_s=profile.hold_s,
        cool_c=profile.cool_c,
        max_current=profile.limits.current,
        max_power=profile.limits.power,
        heat_capacity=thermal.stored(length),
        convected=thermal.convected(length, profile.target_c, profile.chuck_c),
        radiated=thermal.radiated(length, profile.target_c, profile.chuck_c),
        tolerance=thermal.tolerance,
    )
