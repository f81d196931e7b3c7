"""The cycles that docs/features.md speaks of."""

from __future__ import annotations

import pytest

from rtcp.config import ConfigError, default_config, load, with_period
from rtcp.config.model import CycleConfig
from rtcp.config.validation import allowed, annotation


def test_the_configuration_accepts_cycles_of_100_us_to_100_ms() -> None:
    assert allowed(annotation(CycleConfig, ("period_us",))) == "a number from 100 to 100000"


@pytest.mark.parametrize("period_us", [100, 300, 2000, 9999])
def test_the_shipped_arm_accepts_cycles_of_100_us_to_less_than_10_ms(period_us: float) -> None:
    assert with_period(load(default_config()), period_us).cycle.period_us == period_us


@pytest.mark.parametrize("period_us", [99, 10_000])
def test_the_shipped_arm_refuses_a_cycle_outside_of_these(period_us: float) -> None:
    with pytest.raises(ConfigError, match=r"period_us|watchdog_ms"):
        with_period(load(default_config()), period_us)
