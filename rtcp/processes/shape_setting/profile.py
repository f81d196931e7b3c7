"""Profiles of shape setting in YAML: `read_profile(path)` checks them whole.

config/shape_setting/nitinol.yaml is an example. Not for the loop: this module loads the validator.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.model import ConfigError
from rtcp.config.validation import Checker, rule
from rtcp.processes.shape_setting.heat_profile import OF_THE_ROD, HeatProfile
from rtcp.processes.shape_setting.messages import PROFILE_RANGES, ProfileKey

_SPARE_POWER = 2.0
"""Greatest ratio of the power limit to the power that the rod needs."""


@rule(HeatProfile, "target_c", "target_ratio")
def _target(profile: HeatProfile) -> Iterator[Finding]:
    if bool(profile.target_c) == bool(profile.target_ratio):
        count = "both" if profile.target_c else "neither"
        yield Finding((), "one_of_both", found=f"{count} of target_c and target_ratio", allowed="one of them")


@rule(HeatProfile, "target_c", "target_ratio", "cool_c", "initial_c", "chuck_c")
def _order(profile: HeatProfile) -> Iterator[Finding]:
    if not profile.target_c:
        return
    for key in ("cool_c", "initial_c", "chuck_c"):
        if getattr(profile, key) >= profile.target_c:
            wanted = f"less than target_c, {profile.target_c:g}"
            yield Finding((key,), "too_high", found=getattr(profile, key), allowed=wanted)
    if profile.cool_c <= profile.initial_c:
        wanted = f"more than initial_c, {profile.initial_c:g}"
        yield Finding(("cool_c",), "too_low", found=profile.cool_c, allowed=wanted)


@rule(HeatProfile, "thermal", "ends", "target_c", "target_ratio", "chuck_c", "ramp_k_s", "limits")
def _power(profile: HeatProfile) -> Iterator[Finding]:
    if not profile.target_c or OF_THE_ROD in (profile.ends.length, profile.thermal.diameter):
        return
    needed = profile.needed_power
    if profile.limits.power > _SPARE_POWER * needed:
        wanted = f"at most {_SPARE_POWER:g} times the {needed:.3g} W that the ramp and the target need"
        yield Finding(("limits", "power"), "too_high", found=profile.limits.power, allowed=wanted)


_FILE = Checker(HeatProfile)


def read_profile(path: Path, length: float = OF_THE_ROD, diameter: float = OF_THE_ROD) -> HeatProfile:
    """Return the profile in a YAML file, complete.

    Args:
        path: the file.
        length: of the rod between the chucks, m, for a file without `ends`; 0: not known.
        diameter: of the rod, m, for a file without `thermal`; 0: not known.

    Raises:
        ConfigError: one sentence per mistake, with its line.
    """
    document = read(path)
    profile = _FILE.read(document)
    missing = [
        Finding((), "missing", key=key, need=f"it states the {name} of the rod, as a job of `rtcp shape-set` does")
        for key, name, stated, known in (
            ("ends", "length", profile.ends.length, length),
            ("thermal", "diameter", profile.thermal.diameter, diameter),
        )
        if OF_THE_ROD == stated == known
    ]  # fmt: skip
    if missing:
        raise ConfigError(document.placed(missing))
    complete = profile.of_rod(length, diameter)
    least, most = PROFILE_RANGES[ProfileKey.TARGET_C]
    findings = [*_order(complete), *_power(complete)]
    if not least <= complete.target_c <= most:
        wanted = f"a ratio at which the middle of the rod has {least:g} to {most:g} C"
        findings.append(Finding(("target_ratio",), "too_high", found=profile.target_ratio, allowed=wanted))
    if findings:
        raise ConfigError(document.placed(findings))
    return complete


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
