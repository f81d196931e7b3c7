"""The homing of one joint (CiA 402-2, homing mode): its drive finds its home by itself, the other joints hold.

How it homes (method, speeds, acceleration, home offset) is in the drive: 0x6098, 0x6099, 0x609A, 0x607C, written by
the start-up SDOs of its description. Afterwards it counts from its home; the joint's zero offset counts on from there.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

from rtcp.control.arm import Arm
from rtcp.control.joint_group import Joints
from rtcp.devices.cia402 import ENABLE_OPERATION, Cia402Drive
from rtcp.devices.drive import CSP
from rtcp.ipc.events import Event, Homed, HomingFailed, Stopped

HOMING: Final = 6
"""Mode of operation (CiA 402-2, object 0x6060)."""
START = ENABLE_OPERATION | 0x10
"""Controlword with the start bit; taking the bit away interrupts (CiA 402-2, homing mode)."""


class Shown(Enum):
    """Meaning of the statusword of a drive in mode 6."""

    UNDER_WAY = "homing is under way"
    AT_REST = "homing is not started, or was interrupted"
    FOUND = "home is found, the drive is not yet at rest"
    ATTAINED = "homing has succeeded"
    FAILING = "homing has failed, the drive is not yet at rest"
    FAILED = "homing has failed"


_BITS = 0x3400
# Bits 13 (homing error), 12 (homing attained) and 10 (target reached) of the statusword (CiA 402-2, homing mode)
SHOWN: dict[int, Shown] = {
    0x0000: Shown.UNDER_WAY,
    0x0400: Shown.AT_REST,
    0x1000: Shown.FOUND,
    0x1400: Shown.ATTAINED,
    0x2000: Shown.FAILING,
    0x2400: Shown.FAILED,
    # Reserved: what shows an error has not succeeded.
    0x3000: Shown.FAILING,
    0x3400: Shown.FAILED,
}


class HomingPhase(Enum):
    """How far a homing is; the last five end it."""

    IDLE = "idle"
    ENTERING = "the drive changes to mode 6"
    SEARCHING = "the drive looks for its home"
    STOPPING = "the drive comes to rest"
    LEAVING = "the drive changes back to CSP"
    HOMED = "homed"
    FAILED = "the drive reports a homing error, or found no home in time"
    STOPPED = "stopped before it was at home"
    STUCK = "the drive does not change its mode"
    RUNNING = "the drive does not come to rest"


ENDED = frozenset({HomingPhase.HOMED, HomingPhase.FAILED, HomingPhase.STOPPED, HomingPhase.STUCK, HomingPhase.RUNNING})

_P = HomingPhase
_MODE_S: Final = 1.0
_REST_S: Final = 3.0
_LONGEST_S: Final = 60.0
_STILL_RAD_S: Final = 0.01
_TOLD_CYCLES: Final = 10
"""Cycles for which the statusword may still show the end of an earlier homing: it lags behind the controlword."""


class Homing:
    """Controls the homing of a drive: `start` once, then `step` every cycle after `decode`, until it has `ended`.

    The drive is enabled, in CSP and at standstill at the start and again at the end. While it homes, nothing but this
    object sets its controlword and its mode, and the joint's setpoint is `position`, whatever it reads: at the home
    the drive begins to count anew, and `position` jumps with it. A drive that leaves Operation Enabled is not this
    object's matter: the caller sees it, and calls `abandon`.
    """

    __slots__ = (
        "_cycles", "_drive", "_latched", "_longest", "_mode_cycles", "_outcome", "_rest", "_turned", "phase", "shown",
        "shown_mode",
    )  # fmt: skip

    def __init__(self, period_s: float, longest_s: float = _LONGEST_S) -> None:
        """Make what homes one drive at a time.

        Args:
            period_s: of the cycle, s.
            longest_s: how long a drive may look for its home, s.
        """
        self._longest = round(longest_s / period_s)
        self._mode_cycles = round(_MODE_S / period_s)
        self._rest = round(_REST_S / period_s)
        self._drive: Cia402Drive | None = None
        self._cycles = 0
        self._latched = False
        self._turned = False
        """Whether the drive has shown mode 6: until then it may still follow its target."""
        self._outcome = _P.STOPPED
        self.phase = _P.IDLE
        self.shown = 0
        """Statusword that ended the search, for the sentence about a failure."""
        self.shown_mode = HOMING
        """Mode at that time: another one where the drive does not home."""

    @property
    def ended(self) -> bool:
        """Whether the homing is over, well or not; the drive is then in CSP, but where it is STUCK or RUNNING."""
        return self.phase in ENDED

    @property
    def position(self) -> float:
        """The joint's setpoint, rad: the last one until the drive is in mode 6, then where the drive is, and from its
        way back to CSP on where it was then."""
        drive = self._drive
        if drive is None:
            return 0.0
        return drive.position if self._turned and not self._latched else drive.target_position

    def start(self, drive: Cia402Drive) -> None:
        """Begin; `drive` is enabled, in CSP and at standstill."""
        self._drive = drive
        self._latched = self._turned = False
        self._outcome = _P.STOPPED
        self.shown, self.shown_mode = 0, HOMING
        drive.mode = HOMING
        self._enter(_P.ENTERING)

    def stop(self) -> None:
        """Let the drive come to rest and go back to CSP; does nothing once it is at its home, or has ended."""
        if self.phase in (_P.ENTERING, _P.SEARCHING):
            self._enter(_P.STOPPING)

    def abandon(self) -> None:
        """Release the drive: it has faulted, or another stop takes over."""
        if self._drive is not None and not self.ended:
            self._drive.mode = CSP
            self._enter(_P.STOPPED)

    def step(self) -> HomingPhase:
        """Do one cycle; return how far it is. Does nothing before `start` and after the end."""
        drive = self._drive
        if drive is None or self.ended:
            return self.phase
        self._cycles += 1
        if drive.mode_display == HOMING:
            self._turned = True
        drive.controlword = ENABLE_OPERATION
        phase = self.phase
        if phase is _P.ENTERING:
            if drive.mode_display == HOMING:
                # The start bit was low in mode 6 for a cycle: from here it rises.
                self._enter(_P.SEARCHING)
                drive.controlword = START
            elif self._cycles > self._mode_cycles:
                self.shown, self.shown_mode = drive.statusword, drive.mode_display
                self._leave(_P.FAILED)
        elif phase is _P.SEARCHING:
            self._search(drive)
        elif phase is _P.STOPPING:
            if abs(drive.velocity) < _STILL_RAD_S and self._cycles > _TOLD_CYCLES:
                self._leave(self._outcome)
            elif self._cycles > self._rest:
                # In CSP its target would stand where it is now: a jerk for a joint that turns. It is stopped otherwise.
                self._enter(_P.RUNNING)
        elif drive.mode_display == CSP and self._cycles > 1:
            self._enter(self._outcome)
        elif self._cycles > self._mode_cycles:
            self._enter(_P.STUCK)
        return self.phase

    def _search(self, drive: Cia402Drive) -> None:
        drive.controlword = START
        if self._cycles <= _TOLD_CYCLES:
            return
        shown = SHOWN[drive.statusword & _BITS]
        if drive.mode_display != HOMING:
            # The drive left the mode on its own: its bits have another meaning there.
            self._fail(drive, _P.STUCK)
        elif shown is Shown.ATTAINED:
            self.shown = drive.statusword
            self._leave(_P.HOMED)
        elif shown in (Shown.FAILED, Shown.FAILING) or self._cycles > self._longest:
            self._fail(drive, _P.FAILED)

    def _fail(self, drive: Cia402Drive, outcome: HomingPhase) -> None:
        self.shown = drive.statusword
        self._outcome = outcome
        drive.controlword = ENABLE_OPERATION
        self._enter(_P.STOPPING)

    def _leave(self, outcome: HomingPhase) -> None:
        """Go back to CSP, where the target is the place the drive is at now: latched once, or the arm would sag."""
        drive = self._drive
        if drive is not None:
            drive.controlword = ENABLE_OPERATION
            drive.mode = CSP
            if self._turned:
                drive.latch()
            self._latched = True
        self._outcome = outcome
        self._enter(_P.LEAVING)

    def _enter(self, phase: HomingPhase) -> None:
        self.phase = phase
        self._cycles = 0


class HomingSequence:
    """One homing at a time; `step` once a cycle until it has `ended`.

    Args:
        arm: enabled, at rest, in CSP.
        joints: all of the platform; those beside the arm's move on.
        period_s: the cycle, s.
    """

    def __init__(self, arm: Arm, joints: Joints, period_s: float) -> None:
        self._arm = arm
        self._joints = joints
        self._homing = Homing(period_s)
        self.axis = 0

    def begin(self, axis: int) -> None:
        """Let the drive of a joint begin."""
        drive = self._arm.drives[axis]
        assert isinstance(drive, Cia402Drive), "the command is refused for another"
        self.axis = axis
        self._homing.start(drive)

    def stop(self) -> None:
        """Bring the drive to rest and back to CSP."""
        self._homing.stop()

    def abandon(self) -> None:
        """Release the drive, which is commanded elsewhere."""
        self._homing.abandon()

    def returned_to_range(self) -> bool:
        """Move a joint whose home is a little outside its range to the edge; return whether it is there."""
        arm, axis = self._arm, self.axis
        if arm.beyond_range(axis) > 0.0:
            low, high, position = arm.limits.low[axis], arm.limits.high[axis], arm.state.commanded
            position[axis] = min(max(position[axis], low), high)
            arm.latch()
            arm.command()
        return arm.beyond_range(axis) <= 0.0

    def step(self) -> None:
        """Run a cycle; the setpoint of the joint is where its drive shows it, those of the others stand."""
        arm, axis, homing = self._arm, self.axis, self._homing
        self._joints.command_others()
        if homing.ended:
            return
        homing.step()
        arm.state.commanded[axis] = homing.position
        arm.output_limiter.latch(axis, homing.position)
        arm.latch()

    @property
    def under_way(self) -> bool:
        """Whether it has begun and is not over."""
        return self._homing.phase is not HomingPhase.IDLE and not self._homing.ended

    @property
    def stuck(self) -> bool:
        """Whether the drive does not change its mode."""
        return self._homing.phase is HomingPhase.STUCK

    @property
    def still_moving(self) -> bool:
        """Whether the drive does not come to rest."""
        return self._homing.phase is HomingPhase.RUNNING

    @property
    def leaving(self) -> bool:
        """Whether the drive no longer searches: it comes to rest, or returns to CSP."""
        return self._homing.phase not in (HomingPhase.ENTERING, HomingPhase.SEARCHING)

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return self._homing.ended

    @property
    def outcome(self) -> Event:
        """How it ended."""
        homing = self._homing
        if homing.phase is HomingPhase.HOMED:
            return Homed(self.axis, homing.position)
        return (
            HomingFailed(self.axis, homing.shown, homing.shown_mode)
            if homing.phase is HomingPhase.FAILED
            else Stopped()
        )
