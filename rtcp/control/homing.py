"""Homing of one joint (CiA 402-2, homing mode): its drive searches its home by itself, the other joints hold.

Method, speeds, acceleration and home offset are parameters of the drive: 0x6098, 0x6099, 0x609A, 0x607C, written by the
start-up SDOs of its description. Afterwards it counts from its home; the joint's zero offset is relative to that.
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
"""Controlword with the start bit; clearing the bit interrupts (CiA 402-2, homing mode)."""


class HomingStatus(Enum):
    """Meaning of the statusword of a drive in mode 6."""

    UNDER_WAY = "homing is under way"
    AT_REST = "homing is not started, or was interrupted"
    FOUND = "home is found, the drive is not yet at rest"
    ATTAINED = "homing has succeeded"
    FAILING = "homing has failed, the drive is not yet at rest"
    FAILED = "homing has failed"


_BITS = 0x3400
# Bits 13 (homing error), 12 (homing attained) and 10 (target reached) of the statusword (CiA 402-2, homing mode)
HOMING_STATUS: dict[int, HomingStatus] = {
    0x0000: HomingStatus.UNDER_WAY,
    0x0400: HomingStatus.AT_REST,
    0x1000: HomingStatus.FOUND,
    0x1400: HomingStatus.ATTAINED,
    0x2000: HomingStatus.FAILING,
    0x2400: HomingStatus.FAILED,
    # Reserved: with the error bit it counts as failed.
    0x3000: HomingStatus.FAILING,
    0x3400: HomingStatus.FAILED,
}


class HomingPhase(Enum):
    """Phase of a homing; the last five end it."""

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
_LAG_CYCLES: Final = 10
"""Cycles for which the statusword may still show the end of an earlier homing: it lags behind the controlword."""


class Homing:
    """Controls the homing of a drive: `start` once, then `step` every cycle after `decode`, until it has `ended`.

    The drive is enabled, in CSP and at standstill at the start and again at the end. While it homes, only this object
    sets its controlword and its mode, and the joint's setpoint is `position`: at the home the drive begins to count
    anew, and `position` jumps with it. The caller supervises that the drive stays in Operation Enabled, else it calls
    `abandon`.
    """

    __slots__ = (
        "_back", "_cycles", "_drive", "_latched", "_longest", "_mode_cycles", "_outcome", "_rest", "_turned", "phase",
        "shown", "shown_mode",
    )  # fmt: skip

    def __init__(self, period_s: float, longest_s: float = _LONGEST_S, back: int = CSP) -> None:
        """Prepare to home one drive at a time.

        Args:
            period_s: period of the cycle, s.
            longest_s: longest search of a drive for its home, s.
            back: mode of operation before and after.
        """
        self._back = back
        self._longest = round(longest_s / period_s)
        self._mode_cycles = round(_MODE_S / period_s)
        self._rest = round(_REST_S / period_s)
        self._drive: Cia402Drive | None = None
        self._cycles = 0
        self._latched = False
        self._turned = False
        """Whether the drive has displayed mode 6: until then it may still follow its target."""
        self._outcome = _P.STOPPED
        self.phase = _P.IDLE
        self.shown = 0
        """Statusword that ended the search, for the event of a failure."""
        self.shown_mode = HOMING
        """Mode display at that time; not 6 where the drive left homing."""

    @property
    def ended(self) -> bool:
        """Whether the homing has ended, in success or failure; the drive is then in CSP, except in STUCK or RUNNING."""
        return self.phase in ENDED

    @property
    def position(self) -> float:
        """Setpoint of the joint, rad: the last one until the drive is in mode 6, then its actual position, and from the
        change back to CSP on the position at that time."""
        drive = self._drive
        if drive is None:
            return 0.0
        return drive.position if self._turned and not self._latched else drive.target_position

    def start(self, drive: Cia402Drive) -> None:
        """Begin to home `drive`, which is enabled, in CSP and at standstill."""
        self._drive = drive
        self._latched = self._turned = False
        self._outcome = _P.STOPPED
        self.shown, self.shown_mode = 0, HOMING
        drive.mode = HOMING
        self._enter(_P.ENTERING)

    def stop(self) -> None:
        """Bring the drive to rest and back to CSP; no effect once it is at its home, or has ended."""
        if self.phase in (_P.ENTERING, _P.SEARCHING):
            self._enter(_P.STOPPING)

    def abandon(self) -> None:
        """Release the drive: it has faulted, or another stop takes over."""
        if self._drive is not None and not self.ended:
            self._drive.mode = self._back
            self._enter(_P.STOPPED)

    def step(self) -> HomingPhase:
        """Do one cycle and return the phase. No effect before `start` and after the end."""
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
                # The start bit was low in mode 6 for a cycle; its rising edge starts the search.
                self._enter(_P.SEARCHING)
                drive.controlword = START
            elif self._cycles > self._mode_cycles:
                self.shown, self.shown_mode = drive.statusword, drive.mode_display
                self._leave(_P.FAILED)
        elif phase is _P.SEARCHING:
            self._search(drive)
        elif phase is _P.STOPPING:
            if abs(drive.velocity) < _STILL_RAD_S and self._cycles > _LAG_CYCLES:
                self._leave(self._outcome)
            elif self._cycles > self._rest:
                # CSP would stop a turning joint with a jerk, so it is stopped otherwise.
                self._enter(_P.RUNNING)
        elif drive.mode_display == self._back and self._cycles > 1:
            self._enter(self._outcome)
        elif self._cycles > self._mode_cycles:
            self._enter(_P.STUCK)
        return self.phase

    def _search(self, drive: Cia402Drive) -> None:
        drive.controlword = START
        if self._cycles <= _LAG_CYCLES:
            return
        status = HOMING_STATUS[drive.statusword & _BITS]
        if drive.mode_display != HOMING:
            # The drive left the mode by itself; the bits have another meaning there.
            self._fail(drive, _P.STUCK)
        elif status is HomingStatus.ATTAINED:
            self.shown = drive.statusword
            self._leave(_P.HOMED)
        elif status in (HomingStatus.FAILED, HomingStatus.FAILING) or self._cycles > self._longest:
            self._fail(drive, _P.FAILED)

    def _fail(self, drive: Cia402Drive, outcome: HomingPhase) -> None:
        self.shown = drive.statusword
        self._outcome = outcome
        drive.controlword = ENABLE_OPERATION
        self._enter(_P.STOPPING)

    def _leave(self, outcome: HomingPhase) -> None:
        """Return to CSP, with the present position as target: latched once, or the arm would sag."""
        drive = self._drive
        if drive is not None:
            drive.controlword = ENABLE_OPERATION
            drive.mode = self._back
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
        joints: all joints of the platform; those beside the arm's move on.
        period_s: period of the cycle, s.
    """

    def __init__(self, arm: Arm, joints: Joints, period_s: float) -> None:
        self._arm = arm
        self._joints = joints
        self._homing = Homing(period_s)
        self.axis = 0

    def begin(self, axis: int) -> None:
        """Start the homing of a joint's drive."""
        drive = self._arm.drives[axis]
        assert isinstance(drive, Cia402Drive), "the command is refused for another"
        self.axis = axis
        self._homing.start(drive)

    def stop(self) -> None:
        """Bring the drive to rest and back to CSP."""
        self._homing.stop()

    def abandon(self) -> None:
        """Release the drive: another stop commands it."""
        self._homing.abandon()

    def returned_to_range(self) -> bool:
        """Move a joint whose home is slightly outside its range to the edge; return whether it is there."""
        arm, axis = self._arm, self.axis
        if arm.beyond_range(axis) > 0.0:
            low, high, position = arm.limits.low[axis], arm.limits.high[axis], arm.state.commanded
            position[axis] = min(max(position[axis], low), high)
            arm.latch()
            arm.command()
        return arm.beyond_range(axis) <= 0.0

    def step(self) -> None:
        """Do one cycle; the joint's setpoint is its drive's position, the setpoints of the others stay."""
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
        """Whether it has begun and has not ended."""
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
        """Whether the search has ended: the drive comes to rest, or returns to CSP."""
        return self._homing.phase not in (HomingPhase.ENTERING, HomingPhase.SEARCHING)

    @property
    def ended(self) -> bool:
        """Whether the homing has ended."""
        return self._homing.ended

    @property
    def outcome(self) -> Event:
        """Event of its end."""
        homing = self._homing
        if homing.phase is HomingPhase.HOMED:
            return Homed(self.axis, homing.position)
        return (
            HomingFailed(self.axis, homing.shown, homing.shown_mode)
            if homing.phase is HomingPhase.FAILED
            else Stopped()
        )
