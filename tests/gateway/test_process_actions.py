"""Clients' commands to processes; the loop is fake, and its platform has no process."""

from __future__ import annotations

from dataclasses import fields

import pytest

from rtcp.processes.shape_setting.messages import MeasureResistance, SetHeatProfile, StartHeating
from tests.gateway.fake_platform import FakePlatform

Q = [0.25, 0.2, 1.0, 0.0, 0.4, 0.0]


@pytest.mark.parametrize(
    ("method", "params"),
    [
        (StartHeating.name, {}),
        (MeasureResistance.name, {"straight_and_unloaded": True, "phase": "austenite"}),
    ],
)
def test_a_command_of_a_process_that_the_platform_has_not_is_refused_with_a_sentence(
    arm: FakePlatform, method: str, params: dict[str, object]
) -> None:
    error = arm.error(method, **params)
    assert (error.kind, error.reason) == ("refused", "no_process")
    assert error.message == f"{method}: this platform has no process that carries it out"
    assert not arm.loop.commands
    assert not arm.observer.holder()


def test_the_hold_of_a_profile_is_no_time_of_a_jog_and_has_to_be_given(arm: FakePlatform) -> None:
    numbers = {entry.name: 1.0 for entry in fields(SetHeatProfile)}
    hold_s = numbers.pop("hold_s")
    error = arm.error("set_heat_profile", **numbers)
    assert (error.kind, str(error)) == ("invalid", "the key hold_s is missing; it must be a number")
    error = arm.error("set_heat_profile", **numbers, hold_s=hold_s, sent_s=0.0)
    assert error.kind == "invalid"
    assert "sent_s" in str(error)
