"""What is written out in an axis for speed does, to the bit, what its parts do."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rtcp.virtual.models.mechanics import _POSITION_GAIN, _TRACKER, Axis, Mechanics

SPEEDS = st.floats(-3.0, 3.0)
STEP_S = 0.0005


def axis(velocity: float, gravity: float, external: float, limit: float, braked: bool) -> Axis:
    mechanics = Mechanics(0.8, 1.5, 0.7, holding_torque=30.0, load_mass_moment=gravity, gravity_phase=0.4, position=0.3)
    made = Axis(mechanics)
    made.release()
    made.torque_limit = limit
    made.offset = 0.01
    mechanics.velocity = velocity
    mechanics.external_torque = external
    mechanics.braked = braked
    made.synchronise()
    return made


def step(it: Axis, goal: float, slope: float, fastest: float) -> float:
    """One step of a drive in CSP, from the parts."""
    if slope:
        move = slope * STEP_S
        if (goal - it.demand - move) * move <= 1e-12:
            it.demand, slope = goal, 0.0
        else:
            it.demand += move
    error = it.demand - it.reference
    velocity = it.reference_velocity = it.reference_velocity + _TRACKER * _TRACKER * error * STEP_S
    it.reference += (velocity + 2.0 * _TRACKER * error) * STEP_S
    velocity += _POSITION_GAIN * (it.reference - velocity * STEP_S - it.mechanics.position - it.offset)
    it.run(max(-fastest, min(fastest, velocity)), STEP_S)
    return slope


def seen(it: Axis) -> tuple[float, ...]:
    return (
        it.demand, it.reference, it.reference_velocity, it.torque, it.saturated, it.mechanics.position,
        it.mechanics.velocity, it._integral,
    )  # fmt: skip


@given(
    velocity=SPEEDS | st.just(0.0), gravity=st.sampled_from([0.0, 2.0, -1.0]), external=st.floats(-60.0, 60.0),
    limit=st.sampled_from([0.0, 5.0, 50.0]), braked=st.booleans(), way=st.floats(-0.02, 0.02),
    slope=SPEEDS | st.just(0.0), fastest=st.floats(0.0, 3.0), count=st.integers(1, 5),
)  # fmt: skip
def test_gliding_is_the_same_as_tracking_step_by_step(
    velocity: float, gravity: float, external: float, limit: float, braked: bool, way: float, slope: float,
    fastest: float, count: int,
) -> None:  # fmt: skip
    one, other = (axis(velocity, gravity, external, limit, braked) for _ in range(2))
    goal = one.demand + way
    left = other_left = slope
    for _ in range(20):
        left = one.glide(goal, left, fastest, STEP_S, count)
        for _ in range(count):
            other_left = step(other, goal, other_left, fastest)
        assert (left, *seen(one)) == (other_left, *seen(other))
