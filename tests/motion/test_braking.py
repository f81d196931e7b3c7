"""Predictions of the guard's stop, compared with the stop itself, cycle by cycle."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st

from kinematics.forward import frames
from rtcp.motion.guards.braking import fastest_stoppable, touched, travel
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Limits
from tests.arm_geometry import CLEARANCE, RADIUS, box_gaps, own_gap, points
from tests.samples import examples

from .guard_checker import ARM, with_boxes

WIDE = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
MODEL = ARM.arm
assert MODEL is not None
JOINTS = st.tuples(*(st.floats(0.9 * joint.position.min, 0.9 * joint.position.max) for joint in ARM.joints))
SPEEDS = st.tuples(*(st.sampled_from([0.0, 1.0, -1.0]) | st.floats(-1.0, 1.0) for _ in ARM.joints))
RATES = st.tuples(*(st.sampled_from([2.0, 0.5]) for _ in ARM.joints))
SIZES = st.sampled_from([0.0004, 0.002, 0.01, 0.05, 0.3])


def stopped(mean: Sequence[float], rates: Sequence[float], q: Sequence[float], dt: float) -> list[list[float]]:
    """Every configuration of the stop: `q` first, then cycle by cycle until it rests."""
    w, path = list(mean), [list(q)]
    while any(w):
        w = [max(v - a * dt, 0.0) if v > 0.0 else min(v + a * dt, 0.0) for v, a in zip(w, rates, strict=True)]
        path.append([here + v * dt for here, v in zip(path[-1], w, strict=True)])
    return path


@given(room=st.floats(1e-9, 10.0), u=st.floats(1e-6, 0.1), dt=st.floats(1e-4, 0.1))
def test_from_the_fastest_stoppable_speed_the_stop_ends_exactly_at_the_edge(room: float, u: float, dt: float) -> None:
    # So small a change of speed would take a million cycles.
    u = max(u, (room / dt) * 1e-3)
    w = fastest_stoppable(room, u, dt)
    travelled = 0.0
    while w > 0.0:
        travelled += w * dt
        w = w - u if w > u else 0.0
    assert travelled == pytest.approx(room, rel=1e-9)


@given(q=JOINTS, parts=SPEEDS, rates=RATES, dt=st.sampled_from([0.001, 0.004, 0.02]))
@settings(max_examples=examples(40))
def test_no_point_travels_further_than_is_reported(
    q: Sequence[float], parts: Sequence[float], rates: Sequence[float], dt: float
) -> None:
    speeds = [part * joint.velocity for part, joint in zip(parts, ARM.joints, strict=True)]
    step, whole = travel(speeds, rates, Zones(MODEL, Limits(ARM), CLEARANCE).reach, dt)
    before = [angle - v * dt for angle, v in zip(q, speeds, strict=True)]
    for bound, there in ((step, q), (whole, stopped(speeds, rates, q, dt)[-1])):
        for start, end in zip(points(before), points(there), strict=True):
            assert sum((a - b) ** 2 for a, b in zip(start, end, strict=True)) ** 0.5 <= bound + 1e-12


@given(
    q=JOINTS,
    parts=SPEEDS,
    rates=RATES,
    dt=st.sampled_from([0.01, 0.02]),
    which=st.integers(0, 2),
    when=st.floats(0.0, 1.0),
    off=st.tuples(*[st.floats(-1.3, 1.3)] * 3),
    sizes=st.tuples(SIZES, SIZES, SIZES),
)
@settings(max_examples=examples(300))
def test_a_stop_that_is_reported_to_be_free_is_free_in_every_cycle_and_one_with_room_is_reported_to_be(
    q: Sequence[float],
    parts: Sequence[float],
    rates: Sequence[float],
    dt: float,
    which: int,
    when: float,
    off: Sequence[float],
    sizes: Sequence[float],
) -> None:
    speeds = [part * joint.velocity for part, joint in zip(parts, ARM.joints, strict=True)]
    before = [angle - v * dt for angle, v in zip(q, speeds, strict=True)]
    path = [before, *stopped(speeds, rates, q, dt)]
    # A box of any shape beside or across the path of a body.
    at = points(path[round(when * (len(path) - 1))])[which]
    middle = [x + part * (size + RADIUS + CLEARANCE) for x, part, size in zip(at, off, sizes, strict=True)]
    box = [x + sign * size for sign in (-1.0, 1.0) for x, size in zip(middle, sizes, strict=True)]
    assume(min(*box_gaps(before, box), own_gap(before)) >= 0.0)
    zones = Zones(MODEL, Limits(with_boxes(WIDE, box)), CLEARANCE)
    contact = touched(zones, frames(MODEL, before), frames(MODEL, q), q, speeds, rates, dt)
    room = min(min(*box_gaps(angles, box), own_gap(angles)) for angles in path)
    if contact is None:
        event("free")
        assert room >= -1e-8
    elif room < 0.0:
        event("touched")
    else:
        event("said to be touched with room")
        # No farther from the box than the farthest point moves in a cycle, or a few millimetres.
        assert room < 0.003 + travel(speeds, rates, zones.reach, dt)[0]
