"""A motion in step as one arm of the group sees it: its partners, and what it tells them. Plain numbers.

The loop fills in the partners once a cycle (`rtcp.control.partners`); the controller that moves in step reads them, and
writes what the loop publishes of this arm.
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
    """Where an arm is in a motion in step."""

    NONE = 0
    ARMED = 1
    """It has accepted the motion and waits for the common instant."""
    MOVING = 2
    BRAKING = 3
    """Along its path, together with the group."""
    DONE = 4
    """It has arrived."""
    ENDED = 5
    """It has stopped before the end."""


_NEWEST_NS: Final = 60_000_000_000
"""The number of a motion may be this far ahead of CLOCK_MONOTONIC: those who number by that clock never use one up."""
_LONGEST_WAIT_NS: Final = 1_000_000_000
"""For partners to open a stream in step."""
_ARRIVED = (State.MOVING, State.STOPPING, State.HOLDING)
_UNDER_WAY = (StepPhase.ARMED, StepPhase.MOVING)
_IN_STEP = (StepPhase.ARMED, StepPhase.MOVING, StepPhase.BRAKING)


class Partner:
    """The newest record of another arm; lists have one number a joint: rad, rad/s."""

    def __init__(self, joints: int) -> None:
        self.time_ns = 0
        """CLOCK_MONOTONIC of its cycle; 0: there is none."""
        self.state = State.OFF
        self.emergency_stop = False
        """Whether its emergency stop is pressed."""
        self.motion_allowed = False
        """Whether its enabling switch is pressed, or it has none."""
        self.motion = 0
        self.phase = StepPhase.NONE
        self.brake_ns = 0
        self.path_s = 0.0
        """How far it has got, by the path's own time."""
        self.position = [0.0] * joints
        """Commanded."""
        self.velocity = [0.0] * joints
        """Commanded."""
        self.acceleration = [1.0] * joints
        """Limits in force, rad/s^2; `rtcp.control.partners` begins with the configured ones."""
        self.cell = 0
        """Digest of the cell that it was started with."""


class StepGroup:
    """The motion in step that an arm takes part in, and its partners in the order of the cell.

    Args:
        silence_s: how old a partner's newest record may be, and how far it may be behind on its path, s.
        notice_s: how long before it brakes an arm says so, s: every partner has seen it by then.
        cell: digest of the cell that this arm was started with.
    """

    def __init__(self, silence_s: float = 0.0, notice_s: float = 0.0, cell: int = 0) -> None:
        self.members: list[Partner] = []
        self.cell = cell
        self.foreign = -1
        """The first partner that runs as part of another cell, of another state of its files, or of none; or -1."""
        self._silence_ns = round(silence_s * 1e9)
        self.notice_ns = round(notice_s * 1e9)
        self.motion = 0
        """Number of the motion, the same for all its arms; 0: none yet."""
        self.phase = StepPhase.NONE
        self.brake_ns = 0
        """CLOCK_MONOTONIC at which the group begins to brake; 0: it does not."""
        self.path_s = 0.0
        """How far this arm has got on its path, by the path's own time, s."""
        self._start_ns = self._armed_ns = 0
        self.mask = 0
        """The partners that take part, a bit each."""

    def refusal(self, motion: int, mask: int, now_ns: int) -> Refusal | None:
        """Return why this arm cannot take part in a motion, or None."""
        if motion <= 0 or not 0 <= mask < 1 << len(self.members):
            return UnknownPartner(mask.bit_length(), len(self.members))
        if motion > now_ns + _NEWEST_NS:
            # After it no number of a clock could be used any more.
            return MotionNumberAhead(motion, now_ns)
        if motion <= self.motion:
            # A partner may still show that it has arrived in the motion that had this number.
            return MotionNumberUsed(motion, self.motion)
        silent = self.silent(mask, now_ns)
        if silent >= 0:
            return PartnerMissing(silent)
        return PartnerOfAnotherCell(self.foreign) if self.foreign >= 0 else None

    def lost(self, now_ns: int, has_setpoint: bool) -> MotionEnded | None:
        """Return why an arm that follows no path ends a motion in step.

        It moves once all have accepted the motion, and each has its first setpoint.
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
        """Whether a partner has ended the motion in order, as its commander asked."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and partner.motion == self.motion and partner.phase is StepPhase.DONE:
                return True
        return False

    def join(self, motion: int, mask: int, start_ns: int) -> None:
        """Take part in a motion that begins at an instant of CLOCK_MONOTONIC, until which it waits for its partners.

        Without an instant (0) it follows no path, and begins when all have accepted it.
        """
        self.motion, self.mask, self._start_ns = motion, mask, start_ns
        self.phase, self.brake_ns, self.path_s = StepPhase.ARMED, 0, 0.0
        self._armed_ns = 0

    @property
    def under_way(self) -> bool:
        """Whether this arm has accepted a motion that has not ended."""
        return self.phase in _IN_STEP

    def leave(self) -> None:
        """End it early, where it has not ended."""
        if self.phase in _IN_STEP:
            self.phase = StepPhase.ENDED

    def silent(self, mask: int, now_ns: int) -> int:
        """Return the first partner of `mask`, a bit each, that publishes no records any more, or -1."""
        for index, partner in enumerate(self.members):
            if mask >> index & 1 and now_ns - partner.time_ns > self._silence_ns:
                return index
        return -1

    def not_armed(self) -> int:
        """Return the first partner in the motion that has not accepted it, or has left it; -1: all have."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and not (partner.motion == self.motion and self._keeps(partner)):
                return index
        return -1

    def refused(self) -> int:
        """Return the first partner that has left the motion before its beginning, or -1."""
        for index, partner in enumerate(self.members):
            if self.mask >> index & 1 and partner.motion == self.motion and not self._keeps(partner):
                return index
        return -1

    def braking(self) -> int:
        """Return the first partner that brakes along its path, or will, or -1; `brake_ns` becomes the earliest."""
        found = -1
        for index, partner in enumerate(self.members):
            due = partner.brake_ns
            if self.mask >> index & 1 and due and partner.motion == self.motion:
                found = index if found < 0 else found
                self.brake_ns = due if not self.brake_ns or due < self.brake_ns else self.brake_ns
        return found

    def _keeps(self, partner: Partner) -> bool:
        """Whether it has accepted the motion, has arrived, or is where it should be on its path."""
        phase = partner.phase
        if phase is StepPhase.DONE:
            # It holds what both hold, until this one has arrived too.
            return self.phase is not StepPhase.ARMED and partner.state in _ARRIVED
        if phase in _UNDER_WAY and self._start_ns:
            # Also of one that has not begun in time.
            behind_ns = partner.time_ns - self._start_ns - 1e9 * partner.path_s
            if behind_ns > self._silence_ns:
                return False
        moves = partner.state in (State.MOVING, State.STOPPING) and phase in _IN_STEP
        return moves and (partner.state is State.MOVING or partner.brake_ns != 0)
