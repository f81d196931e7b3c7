"""Homing of one joint (CiA 402-2, homing mode): its drive searches its home by itself, the other joints hold.

Method, speeds, acceleration and home offset are parameters of the drive: 0x6098, 0x6099, 0x609A, 0x607C, written by the
start-up SDOs of its description. Afterwards it counts from its home; the joint's zero offset is relative to that.
"""

from __future__ import annotations

from enum import Enum
from math import ceil, isnan, nan
from typing import Final

from rtcp.config.model import ArmConfig, HomingConfig
from rtcp.control.arm import Arm
from rtcp.control.joint_group import Joints
from rtcp.devices.cia402 import ENABLE_OPERATION, Cia402Drive
from rtcp.devices.drive import CSP
from rtcp.ipc.events import Event, Homed, HomedElsewhere, HomingFailed, Stopped

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
    """Phase of a homing; the last six end it."""

    IDLE = "idle"
    ENTERING = "the drive changes to mode 6"
    SEARCHING = "the drive looks for its home"
    STOPPING = "the drive comes to rest"
    LEAVING = "the drive changes back to CSP"
    HOMED = "homed"
    FAILED = "the drive reports a homing error, or found no home in time"
    ELSEWHERE = "the drive reports success at a position that is not its home offset"
    STOPPED = "stopped before it was at home"
    STUCK = "the drive does not change its mode"
    RUNNING = "the drive does not come to rest"


_P = HomingPhase
ENDED = frozenset({_P.HOMED, _P.FAILED, _P.ELSEWHERE, _P.STOPPED, _P.STUCK, _P.RUNNING})


class Homing:
    """Controls the homing of a drive: `start` once, then `step` every cycle after `decode`, until it has `ended`.

    The drive is enabled, in CSP and at standstill at the start and again at the end. While it homes, only this object
    sets its controlword and its mode, and the joint's setpoint is `position`: at the home the drive begins to count
    anew, and `position` jumps with it. The caller supervises that the drive stays in Operation Enabled, else it calls
    `abandon`.

    Drives show mode 6 before they update bits 10, 12 and 13 of the statusword: until then these are the bits of CSP, or
    of an earlier homing. So the start bit follows the mode display after `settle_ms`, and an end counts once all three
    bits were clear after the start, or, because a homing at the present position never clears them, after `settle_ms`.
    A success that lasts `settle_ms` without interruption ends the homing, if the position agrees; until then it can be
    stopped.
    """

    __slots__ = (
        "_attained", "_back", "_clear", "_cycles", "_drive", "_home", "_latched", "_mode_cycles", "_outcome", "_rest",
        "_search", "_settle", "_tolerance", "_turned", "phase", "shown", "shown_mode",
    )  # fmt: skip

    def __init__(self, config: HomingConfig, mode_s: float, period_s: float, back: int = CSP) -> None:
        """Prepare to home one drive at a time.

        Args:
            config: delays of the drives, and bounds.
            mode_s: longest time of a change of the mode, s.
            period_s: period of the cycle, s.
            back: mode of operation before and after.
        """
        self._back = back
        self._settle = ceil(config.settle_ms * 1e-3 / period_s - 1e-9)
        self._search = round(config.search_s / period_s)
        self._rest = round(config.rest_s / period_s)
        self._mode_cycles = round(mode_s / period_s)
        self._tolerance = config.tolerance
        self._drive: Cia402Drive | None = None
        self._home = nan
        self._cycles = 0
        self._clear = False
        """Whether bits 10, 12 and 13 were clear since the start bit rose."""
        self._attained = 0
        """Consecutive cycles in which the drive has reported success."""
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
    def leaving(self) -> bool:
        """Whether the search has ended: the drive comes to rest, or returns to its mode."""
        return self.phase is not _P.ENTERING and self.phase is not _P.SEARCHING

    def end_of(self, axis: int) -> Homed | HomedElsewhere | HomingFailed | None:
        """Return the event of the end, with the number of the drive's axis; None: it was stopped."""
        drive = self._drive
        if self.phase is _P.HOMED:
            return Homed(axis, self.position)
        if self.phase is _P.ELSEWHERE and drive is not None:
            return HomedElsewhere(axis, self.position + drive.zero, self._home)
        return HomingFailed(axis, self.shown, self.shown_mode) if self.phase is _P.FAILED else None

    @property
    def position(self) -> float:
        """Setpoint of the joint, rad: the last one until the drive is in mode 6, then its actual position, and from the
        change back to CSP on the position at that time."""
        drive = self._drive
        if drive is None:
            return 0.0
        return drive.position if self._turned and not self._latched else drive.target_position

    def start(self, drive: Cia402Drive, home: float = nan) -> None:
        """Begin to home `drive`, which is enabled, in CSP and at standstill.

        Args:
            drive: the drive.
            home: its home offset (0x607C), rad, in which its position must end; NaN: not known, any position will do.
        """
        self._drive = drive
        self._home = home
        self._latched = self._turned = False
        self._outcome = _P.STOPPED
        self.shown, self.shown_mode = 0, HOMING
        drive.mode = HOMING
        self._enter(_P.ENTERING)

    def stop(self) -> None:
        """Bring the drive to rest and back to CSP; no effect once the search has ended."""
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
        if drive.mode_display == HOMING and not self._turned:
            self._turned = True
            if self.phase is _P.ENTERING:
                self._cycles = 0
        drive.controlword = ENABLE_OPERATION
        phase = self.phase
        if phase is _P.ENTERING:
            if drive.mode_display == HOMING and self._cycles >= self._settle:
                # The start bit was low in mode 6; its rising edge starts the search.
                self._clear, self._attained = False, 0
                self._enter(_P.SEARCHING)
                drive.controlword = START
            elif self._cycles > self._mode_cycles + self._settle * self._turned:
                self.shown, self.shown_mode = drive.statusword, drive.mode_display
                self._leave(_P.FAILED)
        elif phase is _P.SEARCHING:
            self._look(drive)
        elif phase is _P.STOPPING:
            if abs(drive.velocity) < drive.still and self._cycles > self._settle:
                self._leave(self._outcome)
            elif self._cycles > self._rest + self._settle:
                # CSP would stop a turning joint with a jerk, so it is stopped otherwise.
                self._enter(_P.RUNNING)
        elif drive.mode_display == self._back and self._cycles > 1:
            self._enter(self._outcome)
        elif self._cycles > self._mode_cycles:
            self._enter(_P.STUCK)
        return self.phase

    def _look(self, drive: Cia402Drive) -> None:
        """Look whether the search has ended: by bits that the drive has updated since the start."""
        drive.controlword = START
        status = HOMING_STATUS[drive.statusword & _BITS]
        if status is HomingStatus.UNDER_WAY:
            self._clear = True
        if not self._clear and self._cycles <= self._settle:
            return
        # One report of success may be a stale one, and some drives turn on to their zero after it.
        self._attained = self._attained + 1 if status is HomingStatus.ATTAINED else 0
        if drive.mode_display != HOMING:
            # The drive left the mode by itself; the bits have another meaning there.
            self._fail(drive, _P.STUCK)
        elif status is HomingStatus.ATTAINED:
            # The position jumps as the drive begins to count anew: late in some drives, and others show a speed then.
            if self._attained > self._settle and not self._is_home(drive):
                self._fail(drive, _P.ELSEWHERE)
            elif self._attained > self._settle:
                self.shown = drive.statusword
                self._leave(_P.HOMED)
        elif status in (HomingStatus.FAILED, HomingStatus.FAILING) or self._cycles > self._search:
            self._fail(drive, _P.FAILED)

    def _is_home(self, drive: Cia402Drive) -> bool:
        """Whether the drive counts from the home that it has found, where the home offset is known.

        Makers read the sign of 0x607C both ways, and some drives turn on to their zero after they have found the home.
        """
        home, shown, tolerance = self._home, drive.position + drive.zero, self._tolerance
        return isnan(home) or min(abs(shown - home), abs(shown + home), abs(shown)) <= tolerance

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
        config: waits and bounds.
    """

    def __init__(self, arm: Arm, joints: Joints, config: ArmConfig) -> None:
        self._arm = arm
        self._joints = joints
        self._homing = Homing(config.homing, config.drive_waits.mode_ms * 1e-3, config.cycle.period_us * 1e-6)
        self.axis = 0

    def begin(self, axis: int, home: float = nan) -> None:
        """Start the homing of a joint's drive; `home`: its home offset, rad, NaN where it is not known."""
        drive = self._arm.drives[axis]
        assert isinstance(drive, Cia402Drive), "the command is refused for another"
        self.axis = axis
        self._homing.start(drive, home)

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
        return self._homing.leaving

    @property
    def ended(self) -> bool:
        """Whether the homing has ended."""
        return self._homing.ended

    @property
    def outcome(self) -> Event:
        """Event of its end."""
        return self._homing.end_of(self.axis) or Stopped()
