"""A motion in step from the view of one arm: records of its partners, and its own record. Plain numbers.

The loop updates the partners once a cycle (`rtcp.control.partners`); the controller of the motion reads them and writes
this arm's record, which the loop publishes.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from rtcp.ipc.events import MotionEnded, PartnerLeft, PartnerNotReady, PartnerSilent
from rtcp.ipc.refusals import (
    MotionNumberAhead,
    MotionNumberUsed,
    PartnerMissing,
    PartnerOfAnotherCell,
    Refusal,
    UnknownPartner,
)
from rtcp.ipc.states import State


class StepPhase(IntEnum):
    """Phase of an arm in a motion in step."""

    NONE = 0
    ARMED = 1
    """Accepted; waits for the common instant."""
    MOVING = 2
    BRAKING = 3
    """Brakes along its path, together with the group."""
    DONE = 4
    """Arrived."""
    ENDED = 5
    """Stopped before the end."""


_NEWEST_NS: Final = 60_000_000_000
"""Upper bound on the lead of a motion's number over CLOCK_MONOTONIC: numbers taken from that clock stay usable."""
_LONGEST_WAIT_NS: Final = 1_000_000_000
"""Upper bound on the wait for partners to open a stream in step."""
_ARRIVED = (State.MOVING, State.STOPPING, State.HOLDING)
_UNDER_WAY = (StepPhase.ARMED, StepPhase.MOVING)
_IN_STEP = (StepPhase.ARMED, StepPhase.MOVING, StepPhase.BRAKING)


class Partner:
    """The newest record of another arm; lists have one number per joint: rad, rad/s."""

    def __init__(self, joints: int) -> None:
        self.time_ns = 0
        """CLOCK_MONOTONIC of its cycle; 0: no record."""
        self.state = State.OFF
        self.emergency_stop = False
        """True while its emergency stop is pressed."""
        self.motion_allowed = False
        """True while its enabling switch is pressed, or if it has none."""
        self.motion = 0
        self.phase = StepPhase.NONE
        self.brake_ns = 0
        self.path_s = 0.0
        """Its path time, s."""
        self.position = [0.0] * joints
        """Commanded."""
        self.velocity = [0.0] * joints
        """Commanded."""
        self.acceleration = [1.0] * joints
        """Limits in force, rad/s^2; `rtcp.control.partners` begins with the configured ones."""
        self.cell = 0
        """Digest of the cell it was started with."""


class StepGroup:
    """The motion in step that an arm takes part in, and its partners in the order of the cell.

    Args:
        silence_s: upper bound on the age of a partner's newest record and on its lag along the path, s.
        notice_s: time between the announcement and the start of braking, s; by then every partner has seen it.
        cell: digest of the cell this arm was started with.
    """

    def __init__(self, silence_s: float = 0.0, notice_s: float = 0.0, cell: int = 0) -> None:
        self.members: list[Partner] = []
        self.cell = cell
        self.foreign = -1
        """First partner without a cell, of another cell, or with other files of the same cell; -1: none."""
        self._silence_ns = round(silence_s * 1e9)
        self.notice_ns = round(notice_s * 1e9)
        self.motion = 0
        """Number of the motion, common to all its arms; 0: none yet."""
        self.phase = StepPhase.NONE
        self.brake_ns = 0
        """CLOCK_MONOTONIC at which the group begins to brake; 0: not braking."""
        self.path_s = 0.0
        """Path time of this arm, s."""
        self._start_ns = self._armed_ns = 0
        self.mask = 0
        """Bit mask of the partners that take part."""

    def refusal(self, motion: int, mask: int, now_ns: int) -> Refusal | None:
        """Return why this arm cannot take part in a motion, or None."""
        if motion <= 0 or not 0 <= mask < 1 << len(self.members):
            return UnknownPartner(mask.bit_length(), len(self.members))
        if motion > now_ns + _NEWEST_NS:
            # A greater number would make all clock numbers unusable.
            return MotionNumberAhead(motion, now_ns)
        if motion <= self.motion:
            # A partner's record may still say DONE of a motion with this number.
            return MotionNumberUsed(motion, self.motion)
        silent = self.silent(mask, now_ns)
        if silent >= 0:
            return PartnerMissing(silent)
        return PartnerOfAnotherCell(self.foreign) if self.foreign >= 0 else None

    def lost(self, now_ns: int, has_setpoint: bool) -> MotionEnded | None:
        """Return why an arm without a path ends a motion in step, or None.

        Motion begins once all have accepted it and each has its first setpoint.
        """
        silent, absent = self.silent(self.mask, now_ns), self.not_armed()
        if self.phase is not StepPhase.ARMED:
            waiting = self.waiting()
            if waiting >= 0 and now_ns - self._armed_ns > _LONGEST_WAIT_NS:
                return PartnerNotReady(waiting)
            return PartnerSilent(silent) if silent >= 0 else PartnerLeft(absent) if absent >= 0 else None
        self._armed_ns = self._armed_ns or now_ns
        refused = self.refused()
        if silent >= 0 or refused >= 0:
            return PartnerNotReady(silent if silent >= 0 else refused)
        if absent >= 0:
            return PartnerNotReady(absent) if now_ns - self._armed_ns > _LONGEST_WAIT_NS else None
        if has_setpoint:
            self.phase, self._armed_ns = StepPhase.MOVING, now_ns
        return None

    def waiting(self) -> int:
        """Return the first partner that waits for its first setpoint, or -1."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and partner.motion == self.motion and partner.phase is StepPhase.ARMED:
                return index
        return -1

    def is_finished(self) -> bool:
        """Whether a partner ended the motion regularly, by its commander."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and partner.motion == self.motion and partner.phase is StepPhase.DONE:
                return True
        return False

    def join(self, motion: int, mask: int, start_ns: int) -> None:
        """Join a motion that begins at an instant of CLOCK_MONOTONIC, by which all partners must have joined.

        An instant of 0: the motion has no path and begins when all have joined.
        """
        self.motion, self.mask, self._start_ns = motion, mask, start_ns
        self.phase, self.brake_ns, self.path_s = StepPhase.ARMED, 0, 0.0
        self._armed_ns = 0

    @property
    def under_way(self) -> bool:
        """Whether this arm is in a motion that has not ended."""
        return self.phase in _IN_STEP

    def leave(self) -> None:
        """End the motion early."""
        if self.phase in _IN_STEP:
            self.phase = StepPhase.ENDED

    def silent(self, mask: int, now_ns: int) -> int:
        """Return the first partner of the bit mask `mask` that no longer publishes records, or -1."""
        for index, partner in enumerate(self.members):
            if mask >> index & 1 and now_ns - partner.time_ns > self._silence_ns:
                return index
        return -1

    def not_armed(self) -> int:
        """Return the first partner in the motion that has not accepted it or has left it; -1: none."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and not (partner.motion == self.motion and self._keeps(partner)):
                return index
        return -1

    def refused(self) -> int:
        """Return the first partner that left the motion before its start, or -1."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and partner.motion == self.motion and not self._keeps(partner):
                return index
        return -1

    def braking(self) -> int:
        """Return the first partner that has announced braking, or -1; set `brake_ns` to the earliest announcement."""
        first = -1
        for index, partner in enumerate(self.members):
            due = partner.brake_ns
            if self.mask >> index & 1 and due and partner.motion == self.motion:
                first = index if first < 0 else first
                self.brake_ns = due if not self.brake_ns or due < self.brake_ns else self.brake_ns
        return first

    def _keeps(self, partner: Partner) -> bool:
        """Whether a partner has accepted the motion, has arrived, or is on schedule."""
        phase = partner.phase
        if phase is StepPhase.DONE:
            # It keeps holding a common load until this arm has arrived too.
            return self.phase is not StepPhase.ARMED and partner.state in _ARRIVED
        if phase in _UNDER_WAY and self._start_ns:
            # Includes a partner that did not start in time.
            behind_ns = partner.time_ns - self._start_ns - 1e9 * partner.path_s
            if behind_ns > self._silence_ns:
                return False
        moves = partner.state in (State.MOVING, State.STOPPING) and phase in _IN_STEP
        return moves and (partner.state is State.MOVING or partner.brake_ns != 0)
