"""A motion in step from the view of one arm: what it takes from the records of its partners. Plain numbers."""

from __future__ import annotations

from itertools import product

import pytest

from rtcp.ipc.events import PartnerLeft, PartnerNotReady, PartnerSilent
from rtcp.ipc.refusals import (
    MotionNumberAhead,
    MotionNumberUsed,
    PartnerMissing,
    PartnerOfAnotherCell,
    UnknownPartner,
)
from rtcp.ipc.states import State
from rtcp.motion.step_group import Partner, StepGroup, StepPhase

MS, S = 1_000_000, 1_000_000_000
NOW, START, MOTION = 100 * S, 99 * S, 7
SILENCE = 4 * MS
UNDER_WAY = (StepPhase.ARMED, StepPhase.MOVING, StepPhase.BRAKING)


def group(*, start: int = START, mask: int = 0b10, phase: StepPhase = StepPhase.MOVING) -> StepGroup:
    """An arm in a motion with its second partner, which is on schedule; the first one does not take part."""
    made = StepGroup(silence_s=4e-3, notice_s=3e-3)
    made.members = [Partner(6), Partner(6)]
    made.join(MOTION, mask, start)
    made.phase = phase
    there = made.members[1]
    there.time_ns, there.motion, there.phase, there.state = NOW, MOTION, StepPhase.MOVING, State.MOVING
    there.path_s = 1.0
    return made


def absent(made: StepGroup) -> tuple[int, int]:
    return made.not_armed(), made.refused()


@pytest.mark.parametrize("own", [StepPhase.ARMED, StepPhase.MOVING])
def test_a_partner_keeps_to_the_motion_while_it_moves_brakes_as_announced_or_has_arrived(own: StepPhase) -> None:
    for state, phase, brakes in product(State, StepPhase, (False, True)):
        made = group(phase=own)
        there = made.members[1]
        there.state, there.phase, there.brake_ns = state, phase, NOW if brakes else 0
        keeps = phase in UNDER_WAY and (state is State.MOVING or (state is State.STOPPING and brakes))
        if phase is StepPhase.DONE:
            keeps = own is StepPhase.MOVING and state in (State.MOVING, State.STOPPING, State.HOLDING)
        assert absent(made) == ((-1, -1) if keeps else (1, 1)), (state, phase, brakes)
        there.motion = MOTION - 1
        assert absent(made) == (1, -1)  # it has not accepted the motion yet
        made.mask, there.motion = 0b01, MOTION
        assert absent(made)[1] == -1


@pytest.mark.parametrize(("behind_ns", "keeps"), [(SILENCE, True), (SILENCE + 1000, False), (-S, True)])
@pytest.mark.parametrize("phase", UNDER_WAY)
def test_a_partner_that_lags_on_its_path_for_longer_than_silence_lasts_has_left(
    phase: StepPhase, behind_ns: int, keeps: bool
) -> None:
    made = group()
    made.members[1].phase = phase
    made.members[1].path_s = 1.0 - 1e-9 * behind_ns
    assert made.not_armed() == (-1 if keeps or phase is StepPhase.BRAKING else 1)
    assert group(start=0).not_armed() == -1  # a motion without a path has no schedule


@pytest.mark.parametrize(("age_ns", "silent"), [(0, -1), (SILENCE, -1), (SILENCE + 1, 1)])
def test_a_partner_is_silent_when_its_newest_record_is_too_old(age_ns: int, silent: int) -> None:
    made = group()
    assert made.silent(0b10, NOW + age_ns) == silent
    assert made.silent(0b00, NOW + S) == -1
    assert made.silent(0b11, NOW) == 0


def test_the_group_brakes_at_the_earliest_instant_that_a_partner_in_the_motion_has_announced() -> None:
    made = group(mask=0b11)
    first, second = made.members
    assert (made.braking(), made.brake_ns) == (-1, 0)
    first.brake_ns, first.motion = NOW - S, MOTION - 1  # of an earlier motion
    second.brake_ns = NOW + 5
    assert (made.braking(), made.brake_ns) == (1, NOW + 5)
    first.brake_ns, first.motion = NOW + 3, MOTION
    assert (made.braking(), made.brake_ns) == (0, NOW + 3)
    first.brake_ns = NOW + 9
    assert (made.braking(), made.brake_ns) == (0, NOW + 3)
    alone = group(mask=0b01)
    alone.members[1].brake_ns = NOW
    assert (alone.braking(), alone.brake_ns) == (-1, 0)


def test_a_motion_that_is_joined_begins_without_anything_of_the_last_one() -> None:
    made = group(start=0, phase=StepPhase.ARMED)
    made.members[1].phase = StepPhase.ARMED
    made.members[1].motion = 0
    assert made.lost(NOW, has_setpoint=True) is None
    made.brake_ns, made.path_s = NOW, 3.0
    made.leave()
    assert (made.phase, made.under_way) == (StepPhase.ENDED, False)
    made.join(MOTION + 1, 0b10, 0)
    assert (made.phase, made.brake_ns, made.path_s, made.under_way) == (StepPhase.ARMED, 0, 0.0, True)
    # The wait for the partner begins anew.
    made.members[1].time_ns = NOW + S
    assert made.lost(NOW + S, has_setpoint=True) is None
    made.members[1].time_ns = NOW + 2 * S + 1
    assert made.lost(NOW + 2 * S, has_setpoint=True) is None
    assert made.lost(NOW + 2 * S + 1, has_setpoint=True) == PartnerNotReady(1)


def test_without_a_path_the_arm_moves_once_its_partners_have_accepted_and_it_has_a_setpoint() -> None:
    made = group(start=0, phase=StepPhase.ARMED)
    there = made.members[1]
    there.phase = StepPhase.ARMED
    there.time_ns = NOW - S
    assert (made.lost(NOW - S, has_setpoint=False), made.phase) == (None, StepPhase.ARMED)
    there.time_ns = NOW
    assert (made.lost(NOW, has_setpoint=True), made.phase) == (None, StepPhase.MOVING)
    there.time_ns = NOW + S + 1
    assert made.waiting() == 1
    assert made.lost(NOW + S, has_setpoint=True) is None
    assert made.lost(NOW + S + 1, has_setpoint=True) == PartnerNotReady(1)
    there.phase = StepPhase.MOVING
    assert (made.waiting(), made.is_finished()) == (-1, False)
    assert made.lost(NOW + S + 1, has_setpoint=True) is None
    assert made.lost(NOW + S + 1 + SILENCE + 1, has_setpoint=True) == PartnerSilent(1)
    there.phase = StepPhase.DONE
    assert made.is_finished()
    there.motion = MOTION - 1
    assert not made.is_finished()
    there.motion = MOTION
    there.phase = StepPhase.ENDED
    assert made.lost(NOW + S, has_setpoint=True) == PartnerLeft(1)
    assert not made.is_finished()


def test_before_the_start_a_partner_that_is_silent_or_has_left_is_not_ready() -> None:
    for change in ({"time_ns": NOW - SILENCE - 1}, {"phase": StepPhase.ENDED}):
        made = group(start=0, phase=StepPhase.ARMED)
        for name, value in change.items():
            setattr(made.members[1], name, value)
        assert made.lost(NOW, has_setpoint=True) == PartnerNotReady(1)


def test_a_motion_is_refused_by_its_number_its_partners_and_their_silence() -> None:
    made = group()
    assert made.refusal(MOTION + 1, 0b10, NOW) is None
    assert made.refusal(0, 0b10, NOW) == UnknownPartner(2, 2)
    assert made.refusal(MOTION + 1, 0b100, NOW) == UnknownPartner(3, 2)
    assert made.refusal(MOTION, 0b10, NOW) == MotionNumberUsed(MOTION, MOTION)
    assert made.refusal(NOW + 60 * S, 0b10, NOW) is None
    assert made.refusal(NOW + 60 * S + 1, 0b10, NOW) == MotionNumberAhead(NOW + 60 * S + 1, NOW)
    assert made.refusal(MOTION + 1, 0b11, NOW) == PartnerMissing(0)
    made.foreign = 0
    assert made.refusal(MOTION + 1, 0b10, NOW) == PartnerOfAnotherCell(0)
