"""Profiles of shape setting, in YAML: `read_profile(path)` checks them whole, `heat_command` makes the loop's numbers.

config/shape_setting/nitinol.yaml is an example. Not for the loop: this module loads the validator.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Le

from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.numbers import NotNegative
from rtcp.config.validation import Checker, rule
from rtcp.processes.shape_setting import temperature
from rtcp.processes.shape_setting.heat_balance import ThermalProperties
from rtcp.processes.shape_setting.messages import PROFILE_RANGES, ProfileKey, SetHeatProfile

# The ranges that the loop checks again.
_RANGES = {key: (Ge(least), Le(greatest)) for key, (least, greatest) in PROFILE_RANGES.items()}
_ROOM, _TARGET, _RAMP = _RANGES[ProfileKey.INITIAL_C], _RANGES[ProfileKey.TARGET_C], _RANGES[ProfileKey.RAMP_K_S]
_COOL, _CURRENT, _POWER = (_RANGES[key] for key in (ProfileKey.COOL_C, ProfileKey.MAX_CURRENT, ProfileKey.MAX_POWER))
_SPARE_POWER = 2.0
"""Greatest ratio of the power limit to the power that the rod needs."""
_Room = Annotated[float, _ROOM[0], _ROOM[1]]


@dataclass(frozen=True)
class Limits:
    """Limits of the heater with this rod."""

    current: Annotated[float, _CURRENT[0], _CURRENT[1]] = 50.0
    """Greatest average current, A."""
    power: Annotated[float, _POWER[0], _POWER[1]] = 500.0
    """Greatest average power, W."""


@dataclass(frozen=True)
class HeatProfile:
    """A profile: temperature, time at it, and the rod's properties."""

    alloy: temperature.Alloy
    ends: temperature.ColdEnds
    thermal: ThermalProperties
    target_c: Annotated[float, _TARGET[0], _TARGET[1]]
    """Temperature in the middle of the rod, C; Nitinol loses its structure above 600 C."""
    hold_s: NotNegative
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


@rule(HeatProfile, "target_c", "cool_c", "initial_c", "chuck_c")
def _order(profile: HeatProfile) -> Iterator[Finding]:
    for key in ("cool_c", "initial_c", "chuck_c"):
        if getattr(profile, key) >= profile.target_c:
            wanted = f"less than target_c, {profile.target_c:g}"
            yield Finding((key,), "too_high", found=getattr(profile, key), allowed=wanted)
    if profile.cool_c <= profile.initial_c:
        wanted = f"more than initial_c, {profile.initial_c:g}"
        yield Finding(("cool_c",), "too_low", found=profile.cool_c, allowed=wanted)


@rule(HeatProfile, "thermal", "ends", "target_c", "chuck_c", "ramp_k_s", "limits")
def _power(profile: HeatProfile) -> Iterator[Finding]:
    thermal, rod = profile.thermal, (profile.ends.length, profile.target_c, profile.chuck_c)
    needed = thermal.convected(*rod) + thermal.radiated(*rod) + thermal.stored(profile.ends.length) * profile.ramp_k_s
    if profile.limits.power > _SPARE_POWER * needed:
        wanted = f"at most {_SPARE_POWER:g} times the {needed:.3g} W that the ramp and the target need"
        yield Finding(("limits", "power"), "too_high", found=profile.limits.power, allowed=wanted)


_FILE = Checker(HeatProfile)


def read_profile(path: Path) -> HeatProfile:
    """Return the profile in a YAML file.

    Raises:
        ConfigError: one sentence per mistake, with its line.
    """
    return _FILE.read(read(path))


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


def temperatures_along(
    profile: HeatProfile, s: npt.NDArray[np.float64], middle: npt.ArrayLike
) -> npt.NDArray[np.float64]:
    """Return the temperatures along the rod, (n, k), C, by the solution of a fin.

    Args:
        profile: of the chucks and the cold ends.
        s: places from the rod's start, (n,), m.
        middle: temperatures in the middle, (k,), C.
    """
    half = 0.5 * profile.ends.length / profile.ends.end_length
    x = np.append(np.abs(s / profile.ends.end_length - half), 0.0)
    # cosh(x) / cosh(half) without an overflow, and last in the middle
    cold = np.exp(x - half) * (1.0 + np.exp(-2.0 * x)) / (1.0 + np.exp(-2.0 * half))
    rise = (1.0 - cold[:-1]) / (1.0 - cold[-1])
    return np.asarray(profile.chuck_c + rise[:, None] * (np.asarray(middle, dtype=np.float64) - profile.chuck_c))


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
