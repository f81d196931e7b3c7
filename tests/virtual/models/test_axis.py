"""`Axis.glide`, written out for speed, equals single steps to the bit."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rtcp.virtual.models.mechanics import _POSITION_GAIN, _TRACKER, Axis, Mechanics

SPEEDS = st.floats(-3.0, 3.0)
STEP_S = 0.0005


def axis(velocity: float, gravity: float, external: float, limit: float, braked: bool) -> Axis:
    mechanics = Mechanics(0.8, 1.5, 0.7, holding_torque=30.0, load_mass_moment=gravity, gravity_phase=0.4, position=0.3)
    result = Axis(mechanics)
    result.release()
    result.torque_limit = limit
    result.offset = 0.01
    mechanics.velocity = velocity
    mechanics.external_torque = external
    mechanics.braked = braked
    result.synchronise()
    return result


def step(axis: Axis, goal: float, slope: float, fastest: float) -> float:
    """One step of a drive in CSP, by the methods of the axis."""
    if slope:
        move = slope * STEP_S
        if (goal - axis.demand - move) * move <= 1e-12:
            axis.demand, slope = goal, 0.0
        else:
            axis.demand += move
    error = axis.demand - axis.reference
    velocity = axis.reference_velocity = axis.reference_velocity + _TRACKER * _TRACKER * error * STEP_S
    axis.reference += (velocity + 2.0 * _TRACKER * error) * STEP_S
    velocity += _POSITION_GAIN * (axis.reference - velocity * STEP_S - axis.mechanics.position - axis.offset)
    axis.run(max(-fastest, min(fastest, velocity)), STEP_S)
    return slope


def state(axis: Axis) -> tuple[float, ...]:
    return (
        axis.demand, axis.reference, axis.reference_velocity, axis.torque, axis.saturated, axis.mechanics.position,
        axis.mechanics.velocity, axis._integral,
    )  # fmt: skip


@given(
    velocity=SPEEDS | st.just(0.0), gravity=st.sampled_from([0.0, 2.0, -1.0]), external=st.floats(-60.0, 60.0),
    limit=st.sampled_from([0.0, 5.0, 50.0]), braked=st.booleans(), distance=st.floats(-0.02, 0.02),
    slope=SPEEDS | st.just(0.0), fastest=st.floats(0.0, 3.0), count=st.integers(1, 5),
)  # fmt: skip
def test_gliding_is_the_same_as_tracking_step_by_step(
    velocity: float, gravity: float, external: float, limit: float, braked: bool, distance: float, slope: float,
    fastest: float, count: int,
) -> None:  # fmt: skip
    gliding, stepped = (axis(velocity, gravity, external, limit, braked) for _ in range(2))
    goal = gliding.demand + distance
    left = stepped_left = slope
    for _ in range(20):
        left = gliding.glide(goal, left, fastest, STEP_S, count)
        for _ in range(count):
            stepped_left = step(stepped, goal, stepped_left, fastest)
        assert (left, *state(gliding)) == (stepped_left, *state(stepped))
