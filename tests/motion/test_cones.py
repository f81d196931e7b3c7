"""An axis of the tool stays inside its cone, however the arm is moved; a tool that begins outside may turn back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import cos, nan, sin

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from kinematics.forward import frames
from rtcp.config.model import ArmConfig, Cone
from rtcp.ipc.events import BoxReached, NotLeavingBox
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import ImpossibleLimit, LimitsExcludeArm, LimitWidened
from rtcp.ipc.schema import FIRST_CONE, HELD_BOX_AT, HELD_CONE
from rtcp.motion.controllers import JogController
from rtcp.motion.guards.compliance import TORQUE_MARGIN_M, TORQUE_REACTION_S, ComplianceGuard
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.guards.zones import POINTER_M, Zones
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import Phase
from tests.samples import examples

from .conftest import Drive
from .guard_checker import ARM, MODEL, SHAPE, GuardChecker
from .test_zones import DIRECTION, JOINTS, driven

Q = (0.3, -0.5, 1.2, 0.2, 0.7, -0.4)
WALLED = replace(ARM.cartesian, box=None, keep_out=())


def with_cones(*cones: Cone) -> ArmConfig:
    return replace(ARM, cartesian=replace(WALLED, cones=cones))


def around(q: Sequence[float], axis: str, off: float, room: float) -> Cone:
    """Return a cone from whose surface the axis of the tool at `q` is `room` rad away, `off` rad from its middle."""
    rotation = frames(MODEL, q)[6].rotation
    first = "xyz".index(axis)
    along, across = ([rotation[column + 3 * row] for row in range(3)] for column in (first, (first + 1) % 3))
    direction = tuple(cos(off) * a + sin(off) * b for a, b in zip(along, across, strict=True))
    return Cone("cup", direction, off + room, axis)  # type: ignore[arg-type]


def angle_at(checker: GuardChecker | Drive, cone: Cone) -> float:
    return SHAPE.tilt(checker.state.commanded, "xyz".index(cone.axis), cone.direction)


def outward(q: Sequence[float], cone: Cone) -> float:
    """Return the sign of the speed of joint 5 that turns the tool's z axis away from the middle of its cone."""
    here, there = (SHAPE.tilt((*q[:4], q[4] + turn, q[5]), 2, cone.direction) for turn in (0.0, 0.01))
    return 1.0 if there > here else -1.0


@given(
    q=JOINTS,
    axis=st.sampled_from("xyz"),
    off=st.floats(0.05, 2.8),
    room=st.sampled_from([0.0, 1e-6, 1e-3, 0.02, 0.2]),
    dt=st.sampled_from([0.002, 0.005, 0.02]),
    legs=st.lists(st.tuples(DIRECTION, st.integers(1, 40), st.booleans()), min_size=1, max_size=4),
)
@settings(max_examples=examples(250))
def test_who_began_inside_a_cone_never_leaves_it(
    q: Sequence[float], axis: str, off: float, room: float, dt: float, legs: list[tuple[list[float], int, bool]]
) -> None:
    cone = around(q, axis, off, room)
    checker = GuardChecker(with_cones(cone), q, dt)
    assume(max(checker.depths()) <= 0.0)
    for direction, cycles, tolerates_saturation in legs:
        driven(checker, direction, cycles, tolerates_saturation)
    checker.request([nan] * 6, tolerates_saturation=False)
    checker.stop()


@given(q=JOINTS, axis=st.sampled_from("xyz"), off=st.floats(0.0, 3.0), room=st.floats(-0.5, 0.5))
def test_the_angle_to_a_cone_is_that_of_the_oracle(q: Sequence[float], axis: str, off: float, room: float) -> None:
    cone = around(q, axis, off, room)
    distance, zone = Zones(MODEL, Limits(with_cones(cone)), 0.01).box_distance(frames(MODEL, q))
    assert (distance / POINTER_M, zone) == (pytest.approx(room, abs=1e-6), FIRST_CONE)
    assert SHAPE.tilt(q, "xyz".index(axis), cone.direction) == pytest.approx(off, abs=1e-6)


def test_a_turn_comes_to_rest_just_before_the_surface_and_names_the_cone() -> None:
    cone = around(Q, "z", 0.6, 0.3)
    checker = GuardChecker(with_cones(cone), Q, 0.002)
    driven(checker, [0.0, 0.0, 0.0, 0.0, outward(Q, cone), 0.0], 800)
    assert cone.angle - 0.002 < angle_at(checker, cone) <= cone.angle
    ended = checker.guard.ended
    assert isinstance(ended, BoxReached)
    assert ended.box == FIRST_CONE
    assert "rad from the cone cup (cartesian.cones[0] in" in Names(with_cones(cone)).message(ended)


def test_a_tool_outside_its_cone_may_only_turn_back() -> None:
    cone = around(Q, "z", 0.6, -0.2)
    checker = GuardChecker(with_cones(cone), Q, 0.001)
    before = angle_at(checker, cone)
    assert before > cone.angle
    results = {}
    for sign in (1.0, -1.0):
        checker = GuardChecker(with_cones(cone), Q, 0.001)
        driven(checker, [0.0, 0.0, 0.0, 0.0, sign, 0.0], 200)
        results[angle_at(checker, cone) < before - 0.01] = checker
    assert set(results) == {True, False}
    ended = results[False].guard.ended
    assert isinstance(ended, NotLeavingBox)
    assert ended.depth == pytest.approx(0.2, abs=1e-3)
    assert "0.2 rad beyond the bounds of the cone cup" in Names(with_cones(cone)).message(replace(ended, depth=0.2))


def test_a_jog_turns_the_tool_up_to_its_cone_and_moves_it_there_and_back() -> None:
    cone = around(Q, "z", 0.4, 0.3)
    config = with_cones(cone)

    def started() -> tuple[Drive, JogController]:
        drive = Drive(config, period_s=0.004)
        drive.guard = TrajectoryGuard(config, drive.limits, 0.004)
        jog = drive.at(Q).controller(JogController)
        jog.start()
        return drive, jog

    def deflect(drive: Drive, jog: JogController, twist: list[float], seconds: float) -> float:
        for _ in range(round(seconds / 0.004)):
            if jog.phase is Phase.HOLD:
                jog.start()
            jog.command(twist, in_tool_frame=False)
            drive.cycle(jog)
            assert angle_at(drive, cone) <= cone.angle
        return angle_at(drive, cone)

    twists = [[sign if at == axis else 0.0 for at in range(6)] for axis in range(3, 6) for sign in (0.3, -0.3)]
    arms = [started() for _ in twists]
    angles = [deflect(*arm, twist, 2.0) for arm, twist in zip(arms, twists, strict=True)]
    nearest = max(range(6), key=angles.__getitem__)
    (drive, jog), twist = arms[nearest], twists[nearest]
    assert cone.angle - 0.05 < angles[nearest]
    assert jog.held >> HELD_BOX_AT & 31 == HELD_CONE + 2
    # A translation does not turn the tool: it is free at the surface.
    x = frames(MODEL, drive.state.commanded)[6].position[0]
    deflect(drive, jog, [-0.05, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0)
    assert frames(MODEL, drive.state.commanded)[6].position[0] < x - 0.02
    assert deflect(drive, jog, [-rate for rate in twist], 1.0) < angles[nearest] - 0.1


def test_a_torque_motion_stops_before_the_cone_and_a_small_cone_keeps_half_of_its_angle() -> None:
    for angle in (0.6, 0.06):
        cone = around(Q, "z", 0.5 * angle, 0.5 * angle)
        config = with_cones(cone)
        guard = ComplianceGuard(config, Limits(config), 0.01, TORQUE_MARGIN_M, TORQUE_REACTION_S)
        least = max(angle - TORQUE_MARGIN_M / POINTER_M, 0.5 * angle)
        speed = 0.3 * outward(Q, cone)
        q, reached = list(Q), None
        while reached is None:
            reached = guard.ahead(q, [0.0, 0.0, 0.0, 0.0, speed, 0.0])
            q[4] += speed * 0.001
        assert reached[0] == FIRST_CONE
        assert least - 0.1 < SHAPE.tilt(q, 2, cone.direction) < least + 0.002


def test_a_narrower_cone_is_refused_where_the_tool_or_its_stop_is_outside() -> None:
    cone = around(Q, "z", 0.5, 0.5)
    checker = GuardChecker(with_cones(cone), Q, 0.001)

    def narrowed(angle: float) -> Values:
        widest = checker.limits.widest
        return replace(widest, cones=tuple(each._replace(angle=angle) for each in widest.cones))

    refusal = checker.guard.refusal_of(checker.state, narrowed(0.49))
    assert isinstance(refusal, LimitsExcludeArm)
    assert refusal.box == FIRST_CONE
    assert checker.change(narrowed(0.51))
    assert checker.change(narrowed(1.0))
    driven(checker, [0.0, 0.0, 0.0, 0.0, outward(Q, cone), 0.0], 300)
    here = angle_at(checker, cone)
    assert isinstance(checker.guard.refusal_of(checker.state, narrowed(here + 0.01)), LimitsExcludeArm)
    assert checker.change(narrowed(here + 0.2))


def test_a_cone_is_only_narrowed_and_keeps_its_direction() -> None:
    cone = around(Q, "z", 0.5, 0.5)
    limits = Limits(with_cones(cone))
    (widest,) = limits.widest.cones
    for other, kind in (
        (widest._replace(angle=1.01), LimitWidened), (widest._replace(angle=0.01), ImpossibleLimit),
        (widest._replace(angle=nan), ImpossibleLimit), (widest._replace(x=0.0), ImpossibleLimit),
        (widest._replace(axis=0), ImpossibleLimit),
    ):  # fmt: skip
        refusal = limits.check(replace(limits.widest, cones=(other,)), list(Q), [0.0] * 6)
        assert isinstance(refusal, kind), other
    assert isinstance(limits.check(replace(limits.widest, cones=()), list(Q), [0.0] * 6), ImpossibleLimit)
