"""A measurement beyond its limit in too many cycles in a row raises its event, and nothing else does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.config.model import SupervisionConfig
from rtcp.ipc.events import EmergencyStop, FollowingError, OverSpeed, OverTorque
from rtcp.ipc.refusals import ThresholdTooLow
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import ArmState

from .conftest import near
from .guard_checker import JOINTS_ONLY

PERIOD_S = JOINTS_ONLY.cycle.period_us * 1e-6
CONFIG = replace(
    JOINTS_ONLY,
    supervision=SupervisionConfig(cycles=5, speed=1.5, torque=2.0, torque_s=8 * PERIOD_S, following_error=0.1),
)
Kind = type[OverSpeed] | type[OverTorque] | type[FollowingError]
BOUNDS: dict[Kind, float] = {OverSpeed: 1.5 * 1.5, OverTorque: 2.0 * CONFIG.joints[1].torque, FollowingError: 0.1}
"""Bound of each kind for the second joint, whose velocity limit is 1.5 rad/s."""
CYCLES: dict[Kind, int] = {OverSpeed: 5, OverTorque: 8, FollowingError: 5}
KINDS = pytest.mark.parametrize("kind", BOUNDS)


def put(state: ArmState, kind: Kind, axis: int, value: float) -> None:
    """Set the measured value of a joint."""
    if kind is OverSpeed:
        state.actual_velocity[axis] = value
    elif kind is OverTorque:
        state.actual_torque[axis] = value
    else:
        state.actual[axis] = state.commanded[axis] + value


class Supervised:
    """A supervision and the state that it checks."""

    def __init__(self) -> None:
        self.limits = Limits(CONFIG)
        self.supervision = Supervision(CONFIG, self.limits)
        self.state = ArmState(2)

    def check(self, kind: Kind, *values: float) -> list[EmergencyStop | None]:
        """Check once for each of these values of the second joint."""
        events = []
        for value in values:
            put(self.state, kind, 1, value)
            events.append(self.supervision.check(self.state))
        return events


@KINDS
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_limit_that_is_passed_in_so_many_cycles_in_a_row_is_found_in_the_last(kind: Kind, sign: float) -> None:
    value = sign * BOUNDS[kind] * 1.001
    *before, last = Supervised().check(kind, *[value] * CYCLES[kind])
    assert before == [None] * (CYCLES[kind] - 1)
    assert last == kind(1, near(value), BOUNDS[kind])


@KINDS
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_limit_that_every_joint_passes_at_once_is_found(kind: Kind, sign: float) -> None:
    arm, value = Supervised(), 10.0 * sign * BOUNDS[kind]
    put(arm.state, kind, 0, value)
    assert isinstance(arm.check(kind, *[value] * CYCLES[kind])[-1], kind)


@KINDS
def test_after_a_reset_the_count_begins_anew(kind: Kind) -> None:
    arm = Supervised()
    arm.check(kind, *[BOUNDS[kind] * 2] * (CYCLES[kind] - 1))
    arm.supervision.reset()
    events = arm.check(kind, *[BOUNDS[kind] * 2] * CYCLES[kind])
    assert [event is not None for event in events] == [False] * (CYCLES[kind] - 1) + [True]


@pytest.mark.parametrize("kind", [OverSpeed, OverTorque])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limits_that_are_in_force_are_those_that_count(kind: Kind, sign: float) -> None:
    arm, value = Supervised(), sign * 0.9 * BOUNDS[kind]
    assert arm.check(kind, *[value] * CYCLES[kind])[-1] is None
    (arm.limits.velocity if kind is OverSpeed else arm.limits.torque)[1] *= 0.5
    arm.supervision.take(arm.limits)
    assert arm.check(kind, *[value] * CYCLES[kind])[-1] == kind(1, near(value), near(0.5 * BOUNDS[kind]))


@KINDS
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_threshold_is_not_lowered_below_what_is_measured(kind: Kind, sign: float) -> None:
    arm, at = Supervised(), 0.9 * BOUNDS[kind]
    put(arm.state, kind, 1, sign * at)

    def lowered(fraction: float) -> Values:
        speed, torque, error = (each * (fraction if n == list(BOUNDS).index(kind) else 1.0) for n, each in enumerate(
            Values.configured(CONFIG).supervision))  # fmt: skip
        return replace(Values.configured(CONFIG), supervision=(speed, torque, error))

    assert arm.supervision.first_exceeded(arm.state, lowered(0.91)) is None
    refusal = arm.supervision.first_exceeded(arm.state, lowered(0.89))
    assert refusal == ThresholdTooLow(1, list(BOUNDS).index(kind), near(at), near(0.89 * BOUNDS[kind]))
    put(arm.state, kind, 1, sign * 1.1 * BOUNDS[kind])
    assert arm.supervision.first_exceeded(arm.state, Values.configured(CONFIG)) is None


PART = st.sampled_from([0.0, 1.0, -1.0, 1.01, -1.01, inf, -inf, nan])
"""Measured values as parts of the bound."""


@given(cycles=st.lists(st.tuples(*[PART] * 6), min_size=1, max_size=60))
def test_found_is_exactly_what_was_bad_in_each_of_the_last_cycles(cycles: Sequence[Sequence[float]]) -> None:
    arm = Supervised()
    bounds = [[1.5 * 0.5, 1.5 * 1.5], [2.0 * joint.torque for joint in CONFIG.joints], [0.1, 0.1]]
    kinds: list[Kind] = list(BOUNDS)
    rows = [0] * 6
    for parts in cycles:
        for n, part in enumerate(parts):
            row, axis = divmod(n, 2)
            put(arm.state, kinds[row], axis, part * bounds[row][axis])
            rows[n] = 0 if abs(part) <= 1.0 else rows[n] + 1
        event = arm.supervision.check(arm.state)
        found = [row >= CYCLES[kinds[n // 2]] for n, row in enumerate(rows)]
        assert (event is not None) == any(found)
        if event is not None:
            assert isinstance(event, OverSpeed | OverTorque | FollowingError)
            assert found[2 * kinds.index(type(event)) + event.axis]
            return
