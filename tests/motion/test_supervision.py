"""What is measured beyond a limit for too many cycles in a row is found, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.config.model import SupervisionConfig
from rtcp.ipc.events import EmergencyStop, FollowingError, OverSpeed, OverTorque
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState

from .guard_checker import JOINTS_ONLY

CYCLES = 5
CONFIG = replace(JOINTS_ONLY, supervision=SupervisionConfig(cycles=CYCLES, speed=1.5, torque=2.0, following_error=0.1))
Kind = type[OverSpeed] | type[OverTorque] | type[FollowingError]
BOUNDS: dict[Kind, float] = {OverSpeed: 1.5 * 1.5, OverTorque: 2.0 * CONFIG.joints[1].torque, FollowingError: 0.1}
"""Of the second joint: its limit is 1.5 rad/s."""
KINDS = pytest.mark.parametrize("kind", BOUNDS)


def put(state: ArmState, kind: Kind, axis: int, value: float) -> None:
    """Let a joint measure so much."""
    if kind is OverSpeed:
        state.actual_velocity[axis] = value
    elif kind is OverTorque:
        state.actual_torque[axis] = value
    else:
        state.actual[axis] = state.commanded[axis] + value


class Seen:
    """A supervision and what it checks."""

    def __init__(self) -> None:
        self.limits = Limits(CONFIG)
        self.watch = Supervision(CONFIG, self.limits)
        self.state = ArmState(2)

    def look(self, kind: Kind, *values: float) -> list[EmergencyStop | None]:
        """Look once for each of these values of the second joint."""
        found = []
        for value in values:
            put(self.state, kind, 1, value)
            found.append(self.watch.check(self.state))
        return found


@KINDS
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_limit_that_is_passed_in_so_many_cycles_in_a_row_is_found_in_the_last(kind: Kind, sign: float) -> None:
    value = sign * BOUNDS[kind] * 1.001
    *before, last = Seen().look(kind, *[value] * CYCLES)
    assert before == [None] * (CYCLES - 1)
    assert last == kind(1, pytest.approx(value), BOUNDS[kind])


@KINDS
def test_at_the_limit_nothing_is_found(kind: Kind) -> None:
    assert Seen().look(kind, *[BOUNDS[kind]] * 50) == [None] * 50


@KINDS
def test_one_good_cycle_begins_the_count_anew(kind: Kind) -> None:
    bad = BOUNDS[kind] * 2
    values = ([bad] * (CYCLES - 1) + [0.0]) * 20
    assert Seen().look(kind, *values) == [None] * len(values)


@KINDS
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_what_is_no_number_is_beyond_every_limit(kind: Kind, value: float) -> None:
    assert Seen().look(kind, *[value] * CYCLES)[-1] is not None


@KINDS
def test_after_a_reset_the_count_begins_anew(kind: Kind) -> None:
    seen = Seen()
    seen.look(kind, *[BOUNDS[kind] * 2] * (CYCLES - 1))
    seen.watch.reset()
    found = seen.look(kind, *[BOUNDS[kind] * 2] * CYCLES)
    assert [one is not None for one in found] == [False] * (CYCLES - 1) + [True]


def test_the_limits_that_are_in_force_are_those_that_count() -> None:
    seen = Seen()
    assert seen.look(OverSpeed, *[1.0] * CYCLES)[-1] is None
    seen.limits.velocity[1] = 0.5
    seen.watch.take(seen.limits)
    assert seen.look(OverSpeed, *[1.0] * CYCLES)[-1] == OverSpeed(1, 1.0, 0.75)


@given(
    cycles=st.lists(st.tuples(*[st.sampled_from([0.0, 1.0, -1.0, 1.01, -1.01, 7.0, nan])] * 6), min_size=1, max_size=60)
)
def test_found_is_exactly_what_was_bad_in_each_of_the_last_cycles(cycles: Sequence[Sequence[float]]) -> None:
    seen = Seen()
    bounds = [[1.5 * 0.5, 1.5 * 1.5], [2.0 * joint.torque for joint in CONFIG.joints], [0.1, 0.1]]
    kinds: list[Kind] = list(BOUNDS)
    rows = [0] * 6
    for parts in cycles:
        for n, part in enumerate(parts):
            row, axis = divmod(n, 2)
            put(seen.state, kinds[row], axis, part * bounds[row][axis])
            rows[n] = 0 if abs(part) <= 1.0 else rows[n] + 1
        found = seen.watch.check(seen.state)
        assert (found is not None) == any(row >= CYCLES for row in rows)
        if found is not None:
            assert rows[2 * kinds.index(type(found)) + found.axis] >= CYCLES
            return
