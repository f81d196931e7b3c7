"""The guard between two arms of a cell, without a loop: its bounds hold, and what it remembers changes no decision."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, dist, sin
from random import Random

import pytest

from kinematics.capsules import distance
from rtcp.config.cell import Base, Member
from rtcp.ipc.events import MotionEnded, PartnerForeign, PartnerNear
from rtcp.ipc.refusals import LimitsTooNearPartner
from rtcp.motion.guards.neighbours import Body, Neighbours, body_of, certain, parting
from rtcp.motion.step_group import Partner, StepGroup

from .guard_checker import ARM

CLEARANCE, DT, DELAY = 0.02, 0.01, 0.04
ACCELERATION = (2.0, 1.5, 3.0, 4.0, 2.5, 5.0)
STILL = [0.0] * 6
SEEDS = pytest.mark.parametrize("seed", range(3))


def body(y: float = 0.0) -> Body:
    """An arm whose base is at `y`, m."""
    made = body_of(Member("arm", ARM, Base((0.0, y, 0.0))), ACCELERATION)
    assert made is not None
    return made


def drawn(chance: Random, most: float) -> list[float]:
    return [chance.uniform(-most, most) for _ in range(6)]


def turned(velocity: float, acceleration: float, delay: float, time: float) -> float:
    """Angle of a joint after `time`, rad, that keeps its velocity for `delay` and then brakes."""
    position, step = 0.0, 1e-3
    for n in range(round(time / step)):
        left = abs(velocity) - acceleration * max((n + 0.5) * step - delay, 0.0)
        position += step * max(left, 0.0) * (1.0 if velocity > 0.0 else -1.0)
    return position


def during_a_stop(q: Sequence[float], velocity: Sequence[float], delay: float, time: float) -> list[float]:
    return [a + turned(v, rate, delay, time) for a, v, rate in zip(q, velocity, ACCELERATION, strict=True)]


def ends(arm: Body, q: Sequence[float]) -> list[tuple[float, ...]]:
    """Both ends of each body's axis, m."""
    arm.place(q)
    axes = arm.placed.axes
    starts = [tuple(axes[at : at + 3]) for at in range(0, len(axes), 6)]
    return starts + [tuple(a + b for a, b in zip(axes[at : at + 3], axes[at + 3 : at + 6], strict=True))
                     for at in range(0, len(axes), 6)]  # fmt: skip


@SEEDS
@pytest.mark.parametrize("delay", [0.001, 0.08])
def test_no_point_moves_further_than_the_bounds_until_the_arm_rests(seed: int, delay: float) -> None:
    chance, arm = Random(seed), body()
    for joint in (*range(6), None) * 2:
        q = chance.choice((drawn(chance, 1.5), [0.0, 1.5, *drawn(chance, 0.1)[2:]]))  # bent, or stretched out
        velocity = [v if joint in (n, None) else 0.0 for n, v in enumerate(drawn(chance, 1.0))]
        rest = during_a_stop(q, velocity, delay, 1.0)
        farthest = max(dist(a, b) for a, b in zip(ends(arm, q), ends(arm, rest), strict=True))
        assert farthest <= arm.travel(velocity, delay) + 1e-6
        assert farthest <= arm.moved(q, rest) + 1e-9
        assert arm.moved(q, rest) == pytest.approx(arm.travel(velocity, delay), rel=1e-2, abs=1e-3)
        arm.stop(q, velocity, delay)
        assert arm.end == pytest.approx(rest, abs=1e-3)


@SEEDS
@pytest.mark.parametrize("delays", [(0.001, 0.08), (0.08, 0.001)])
def test_two_arms_that_stop_after_their_delays_keep_the_distance_that_was_guaranteed(
    seed: int, delays: tuple[float, float]
) -> None:
    chance, left, right = Random(seed), body(0.3), body(-0.3)
    for _ in range(12):
        q, p, v, w = drawn(chance, 1.2), drawn(chance, 1.2), drawn(chance, 1.0), drawn(chance, 1.0)
        least, here, then = certain(left, q, v, right, p, w, delays)
        apart = []
        for time in (0.0, 0.05, 0.1, 0.2, 0.4, 1.0):
            left.place(during_a_stop(q, v, delays[0], time))
            right.place(during_a_stop(p, w, delays[1], time))
            apart.append(distance(left.placed, right.placed)[0])
        assert least <= min(apart) + 1e-6
        travelled = left.travel(v, delays[0]) + right.travel(w, delays[1])
        assert least == pytest.approx(max(here - travelled, min(here, then) - 0.5 * travelled))
        assert (here, then) == (pytest.approx(apart[0]), pytest.approx(apart[-1], abs=1e-3))


class Two:
    """A guard of an arm with the records of its partners, in the order of the cell."""

    def __init__(self, *partners: Body | None) -> None:
        self.group = StepGroup()
        self.group.members = [Partner(6) for _ in partners]
        for partner in self.group.members:
            partner.time_ns = 1
        self.guard = Neighbours(body(0.3), partners, self.group, CLEARANCE, DT, DELAY)

    def ahead(self, q: Sequence[float], velocity: Sequence[float], *records: Sequence[Sequence[float]]) -> object:
        """Return the answer of the guard, with positions and velocities of the partners."""
        for partner, (position, speeds) in zip(self.group.members, records, strict=False):
            partner.position[:], partner.velocity[:] = position, speeds
        return self.guard.ahead(q, velocity)


def decision(q: Sequence[float], v: Sequence[float], p: Sequence[float], w: Sequence[float]) -> MotionEnded | None:
    """Return what a guard without a memory says: this arm brakes after a cycle, its partner after the delay."""
    own, other = body(0.3), body(-0.3)
    least, here, then = certain(own, q, v, other, p, w, (DT, DELAY))
    parts = parting(own, q, v, other, p, w, (DT, DELAY), CLEARANCE)
    return None if least > CLEARANCE or parts else PartnerNear(0, max(min(here, then), 0.0))


class Waving:
    """An arm whose joints swing about a pose bent forward; the first turns it towards and away from its partner."""

    def __init__(self, chance: Random) -> None:
        self._middle = [angle + chance.uniform(-0.3, 0.3) for angle in (0.0, 1.1, 0.4, 0.0, 0.0, 0.0)]
        self._width = [1.5, *(chance.uniform(0.1, 0.4) for _ in range(5))]
        self._rate = [chance.uniform(0.3, 0.9) for _ in range(6)]

    def at(self, time: float) -> tuple[list[float], list[float]]:
        """Return positions and velocities."""
        swings = list(zip(self._middle, self._width, self._rate, strict=True))
        return [m + a * sin(r * time) for m, a, r in swings], [a * r * cos(r * time) for _, a, r in swings]


@pytest.mark.parametrize("seed", [0, 2, 3, 4, 5, 6])
def test_what_the_guard_remembers_of_earlier_cycles_changes_no_decision(seed: int) -> None:
    chance, two = Random(seed), Two(body(-0.3))
    left, right = Waving(chance), Waving(chance)
    answers = []
    for n in range(400):
        (q, v), (p, w) = left.at(0.05 * n), right.at(0.05 * n)
        v, w = ([chance.choice((-1.0, 0.0, 0.1, 1.0)) * speed for speed in speeds] for speeds in (v, w))
        answers.append(two.ahead(q, v, (p, w)))
        assert answers[-1] == decision(q, v, p, w)
    assert 10 < answers.count(None) < 390


NEAR = [-1.9, 1.1, 0.4, 0.0, 0.0, 0.0]
"""Position 7 mm from a partner that stands upright, less than the clearance; the first joint turns away from 0."""
UPRIGHT = (STILL, STILL)


def first(speed: float) -> list[float]:
    return [speed, *STILL[1:]]


@pytest.mark.parametrize("far", [[0.0, 1.1, 0.4, 0.0, 0.0, 0.0], [0.5, 0.3, 0.1, 0.2, 0.0, 0.0]])
@pytest.mark.parametrize("both", [(NEAR, STILL), (STILL, [-NEAR[0], *NEAR[1:]])])
@pytest.mark.parametrize("own", [True, False])
def test_a_distance_from_before_either_arm_came_near_is_not_used(
    own: bool, both: tuple[list[float], list[float]], far: list[float]
) -> None:
    two, (q, p) = Two(body(-0.3)), both
    for _ in range(2):
        assert two.ahead(far if own else q, first(1e-3), (p if own else far, STILL)) is None
        nearer = 0.1 if q is NEAR else -0.1
        assert isinstance(two.ahead(q, [nearer] * 6, (p, STILL)), PartnerNear)


@pytest.mark.parametrize(("speed", "may"), [(0.0, True), (-0.05, True), (0.01, False), (-0.5, True), (0.4, False)])
def test_arms_that_are_too_near_may_rest_and_part_and_nothing_else(speed: float, may: bool) -> None:
    two = Two(body(-0.3))
    two.ahead(NEAR, first(-1.0), UPRIGHT)  # where that stop would have ended does not count
    answer = two.ahead(NEAR, first(speed), UPRIGHT)
    assert answer is None if may else isinstance(answer, PartnerNear)


def test_one_body_that_comes_nearer_forbids_the_parting_of_all_others() -> None:
    own, other = body(0.3), body(-0.3)
    pairs = [((i, j),) for i in range(len(own.placed.radii)) for j in range(len(other.placed.radii))]
    chance, allowed, refused = Random(5), 0, 0
    for _ in range(150):
        q, v = [a + 0.3 * b for a, b in zip(NEAR, drawn(chance, 1.0), strict=True)], drawn(chance, 0.3)
        own.place(q)
        other.place(STILL)
        before = [distance(own.placed, other.placed, pair)[0] for pair in pairs]
        parts = parting(own, q, v, other, STILL, STILL, (DT, DELAY), CLEARANCE)
        nearer = 0.0
        for n in range(1, 41):
            own.stop(q, v, DT, 0.01 * n)
            after = [distance(own.placed, other.placed, pair)[0] for pair in pairs]
            nearer = max(nearer, *(min(b, CLEARANCE) - a for a, b in zip(after, before, strict=True)))
        if parts:
            allowed += 1
            assert nearer < 1e-4
        elif nearer > 0.0:
            refused += 1
    assert allowed > 10
    assert refused > 10


@pytest.mark.parametrize(("share", "may"), [(1.0, True), (0.8, True), (0.2, False)])
def test_limits_under_which_the_arm_would_not_stop_before_its_partner_are_refused(share: float, may: bool) -> None:
    two, velocity = Two(body(-0.3)), first(0.3)
    q = [NEAR[0] - 0.15, *NEAR[1:]]
    assert two.ahead(q, velocity, UPRIGHT) is None
    slower = [share * rate for rate in ACCELERATION]
    refusal = two.guard.refusal_of(q, velocity, slower)
    assert refusal is None if may else isinstance(refusal, LimitsTooNearPartner)
    assert two.guard.refusal_of(q, STILL, slower) is None
    # The limits in force have not changed.
    assert two.ahead(q, velocity, UPRIGHT) is None


def test_every_partner_counts_whose_geometry_and_record_are_known_and_the_near_one_is_named() -> None:
    far = body(9.0)
    for partners, named in (([far, body(-0.3)], 1), ([body(-0.3), far], 0), ([None, far], None), ([far], None)):
        two = Two(*partners)
        answer = two.ahead(NEAR, first(0.05), *[UPRIGHT] * len(partners))
        assert answer is None if named is None else isinstance(answer, PartnerNear) and answer.partner == named
    two = Two(body(-0.3))
    two.group.members[0].time_ns = 0
    assert two.ahead(NEAR, first(0.05), UPRIGHT) is None


def test_beside_a_partner_of_another_cell_the_arm_may_only_rest() -> None:
    two = Two(body(9.0), body(9.0))
    two.group.foreign = 1
    assert two.ahead(NEAR, first(-0.05)) == PartnerForeign(1)
    assert two.ahead(NEAR, STILL) is None
