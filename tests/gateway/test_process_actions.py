"""Commands of processes as clients ask for them; the loop is fake, and its platform has no process."""

from __future__ import annotations

import pytest

from rtcp.processes.shape_setting.messages import MeasureResistance, StartHeating
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
