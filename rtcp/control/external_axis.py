"""An external axis: a drive that is no joint of the arm, moved by its own profiles, beside the arm's controllers."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from math import inf
from typing import Any, Final

from rtcp.config.model import ArmConfig, ExternalAxis
from rtcp.control.homing import HOMING, Homing, HomingPhase
from rtcp.control.joint_group import JointGroup
from rtcp.control.part import PartContext
from rtcp.devices.cia402 import ENABLE_OPERATION
from rtcp.devices.drive import configure_drive, slave_of
from rtcp.devices.profile_drive import (
    ACKNOWLEDGED,
    HALT,
    NEW_SETPOINT,
    PROFILE_POSITION,
    PROFILE_VELOCITY,
    TARGET_REACHED,
    ProfileDrive,
)
from rtcp.ipc.commands import LONGEST_RUN_S
from rtcp.ipc.events import (
    AxisAtRest,
    AxisFailed,
    AxisModeLost,
    AxisNotReplaced,
    AxisStillMoving,
    Event,
    LeftRange,
)
from rtcp.ipc.refusals import (
    AxisAtEnd,
    AxisBusy,
    AxisDisabled,
    AxisHoldOutOfRange,
    AxisModeMissing,
    AxisNotHomed,
    AxisOutOfRange,
    AxisSpeedOutOfRange,
    Refusal,
)
from rtcp.ipc.schema import axis_fields
from rtcp.ipc.states import DriveState, State
from rtcp.motion.guards.trajectory_guard import GuardResult

_ANSWER_S: Final = 1.0
"""Time for a drive to acknowledge a set-point, or to display a mode, s."""
_HALT_S: Final = 3.0
"""Time beyond the ramp within which a halted axis must be at rest, s."""
_SPARE_S: Final = 5.0
"""Time beyond twice the profile within which an axis must be at its target, s."""
_LAG_S: Final = 0.05
"""Time for which what a drive shows may be older than its last command, s."""
_REACTION_S, _RAMP = 0.1, 0.8
"""Before the end of its range an axis is halted as if its drive reacted so late, s, and ramped at so much of its
`acceleration`: a loop that follows the ramp lags behind it."""
_STILL: Final = 0.01
"""Speed below which a halted axis is at rest: a part of its speed limit."""
_BEYOND: Final = 0.02
"""Distance beyond the end of its range, m or rad, at which an axis that still moves outward is a fault."""
_UNKNOWN: Final = frozenset({State.STARTING, State.FAULT, State.EMERGENCY_STOP, State.RESETTING})


class AxisPhase(Enum):
    """What an external axis does."""

    REST = "at rest"
    OFFERING = "a set-point is offered"
    MOVING = "on its way to a set-point"
    CHANGING = "the drive changes to profile velocity"
    RUNNING = "runs at a velocity"
    HALTING = "halted, comes to rest"
    RETURNING = "the drive changes back to the mode in which it rests"
    STAYING = "the set-point that was stopped is replaced by where the axis stands"
    HOMING = "the drive searches its home"


_P = AxisPhase
_STOPPING = frozenset({_P.HALTING, _P.RETURNING, _P.STAYING})
_IN_MODE = frozenset({_P.OFFERING, _P.MOVING, _P.RUNNING})
"""Phases in which the drive must display the mode."""


class ExternalAxisGroup(JointGroup):
    """The drive of an external axis: enabled and disabled with the arm, moved independently.

    The drive makes the profiles, so that there is no setpoint here: the commanded position is the actual one. The
    axis is at rest with no set-point under way; a set-point that was stopped, or that the drive may have kept while it
    was disabled or in another mode, is replaced before it rests, so that nothing can begin anew. Positions and speeds
    are in the axis' unit.

    Args:
        config: configuration with the axis' joint alone.
        axis: the axis.
        number: its number among all axes.

    Raises:
        DeviceError: its device's description is not suitable.
    """

    def __init__(self, config: ArmConfig, axis: ExternalAxis, number: int) -> None:
        zero = config.zero_offsets[number] if config.zero_offsets else 0.0
        supervision = replace(config.supervision, torque=inf, acceleration=inf)
        config = replace(config, joints=(axis.joint,), supervision=supervision)
        slot, slave = slave_of(config, axis.joint)
        drive = ProfileDrive(slave, config.cycle.period_us * 1e-6)
        configure_drive(drive, config, axis.joint, zero)
        super().__init__(axis.name, axis_fields(axis), config, [(slot, drive)], number)
        self.returns_to_range = False
        drive.still = _STILL * axis.velocity
        self.drive = drive
        self.axis = axis
        self.phase = AxisPhase.REST
        self.lease = 0
        """Lease of the commander of its motion."""
        self.homed = "homing" not in axis.modes
        """Whether its positions count from its home, or it needs none."""
        self.problem: Event | None = None
        """Fault of the axis in this cycle."""
        self._low = -inf if axis.position is None else axis.position.min
        self._high = inf if axis.position is None else axis.position.max
        self._positions = "position" in axis.modes
        self._rest_mode = PROFILE_POSITION if self._positions else PROFILE_VELOCITY
        self._homing = Homing(config.homing, config.drive_waits.mode_ms * 1e-3, self.period_s, self._rest_mode)
        self._answer, self._lag = self._cycles(_ANSWER_S), self._cycles(_LAG_S)
        self._halt_cycles = self._cycles(_HALT_S + axis.velocity / axis.acceleration)
        self._waited = self._longest = self._held = self._astray = 0
        self._target = self._velocity = 0.0
        self._raised = self._outdated = self._set_point = False
        """Whether bit 4 offers a set-point; whether another one has replaced that; whether the drive may have one that
        is not where the axis stands."""
        self._reports = self._reached = False
        """Whether the end of a motion is to be published; whether the axis has reached its target."""
        self._ended: Event | None = None
        """How a motion has failed, or a homing ended."""
        drive.mode = self._rest_mode
        drive.profile_velocity = axis.velocity

    def _cycles(self, seconds: float) -> int:
        return max(1, round(seconds / self.period_s))

    # -- commands -----------------------------------------------------------------------------------------------------

    def move(self, position: float, speed: float, lease: int) -> Refusal | None:
        """Move to a position, at most at `speed`, for the commander of `lease`; 0: at the speed limit."""
        refusal = self._refusal(PROFILE_POSITION, self._positions)
        if refusal is not None:
            return refusal
        speed = speed or self.axis.velocity
        if not (self._low <= position <= self._high and self.drive.can_target(position)):
            return AxisOutOfRange(self.first, position)
        least = self.drive.least_profile_velocity
        if not least <= speed <= self.axis.velocity:
            return AxisSpeedOutOfRange(self.first, speed, least, self.axis.velocity)
        self._target, self.lease = position, lease
        self.drive.profile_velocity = speed
        distance = abs(position - self.drive.position)
        self._longest = self._cycles(2.0 * (distance / speed + speed / self.axis.acceleration) + _SPARE_S)
        # The drive may have taken the former set-point and not yet acknowledged it.
        self._raised = self._outdated = self._raised and self.phase is _P.OFFERING
        self._set_point, self._reports, self._reached = True, True, False
        self._enter(_P.OFFERING)
        return None

    def run(self, velocity: float, hold_s: float, lease: int) -> Refusal | None:
        """Run at a velocity for `hold_s`, for the commander of `lease`; again: at another one, for as long anew."""
        refusal = self._refusal(PROFILE_VELOCITY, "velocity" in self.axis.modes)
        if refusal is not None:
            return refusal
        if not abs(velocity) <= self.axis.velocity:
            return AxisSpeedOutOfRange(self.first, velocity, 0.0, self.axis.velocity)
        if not 0.0 < hold_s <= LONGEST_RUN_S:
            return AxisHoldOutOfRange(self.first, hold_s, LONGEST_RUN_S)
        if self._reaches_end(velocity):
            return AxisAtEnd(self.first, self.drive.position)
        self._velocity, self.lease = velocity, lease
        self._held = self._cycles(hold_s)
        self._reports, self._reached = True, False
        if self.phase is not _P.RUNNING:
            self._enter(_P.CHANGING)
        return None

    def home(self, home: float, lease: int) -> Refusal | None:
        """Search the home of the axis, where its drive counts `home` (0x607C; NaN: not known), for `lease`."""
        if "homing" not in self.axis.modes:
            return AxisModeMissing(self.first, HOMING)
        if self.drive.state is not DriveState.OPERATION_ENABLED:
            return AxisDisabled(self.first)
        if self.phase is not _P.REST:
            return AxisBusy(self.first)
        self.homed, self.lease = False, lease
        self._homing.start(self.drive, home)
        self._enter(_P.HOMING)
        return None

    def _refusal(self, mode: int, has_mode: bool) -> Refusal | None:
        """Return why no motion in a mode can begin, or None."""
        if not has_mode:
            return AxisModeMissing(self.first, mode)
        if self.drive.state is not DriveState.OPERATION_ENABLED:
            return AxisDisabled(self.first)
        # A motion in the same mode is replaced.
        replaceable = (_P.OFFERING, _P.MOVING) if mode == PROFILE_POSITION else (_P.CHANGING, _P.RUNNING)
        if self.phase is not _P.REST and self.phase not in replaceable:
            return AxisBusy(self.first)
        return None if self.homed else AxisNotHomed(self.first)

    # -- the cycle ----------------------------------------------------------------------------------------------------

    def update(self, context: PartContext) -> None:
        """Publish the end of a motion; forget the home when nobody knows whether the drive keeps counting."""
        super().update(context)
        if not context.good and context.state in _UNKNOWN and "homing" in self.axis.modes:
            self.homed = False
        if self._ended is not None:
            context.publish(self._ended)
            self._ended = None
        if self._reports and self.phase is _P.REST:
            self._reports = False
            if context.all_enabled:
                context.publish(AxisAtRest(self.first, self.drive.position, self._reached))

    def publish(self, values: list[Any]) -> None:
        """Write what its drive shows and was sent."""
        drive, at = self.drive, self.at
        values[at : at + 9] = (
            drive.position, drive.velocity, self._target if self._positions else drive.position,
            self._velocity if self.phase is _P.RUNNING else 0.0, drive.mode_display, drive.state, drive.statusword,
            self.phase is not _P.REST, self.homed,
        )  # fmt: skip

    def command(self) -> GuardResult:
        """Do one cycle: controlword, mode and targets of the drive, while it is enabled."""
        drive = self.drive
        self.problem = None
        self.state.commanded[0] = drive.position
        if drive.state is not DriveState.OPERATION_ENABLED:
            return GuardResult.PASS
        self._waited += 1
        phase = self.phase
        drive.target_velocity = self._velocity if phase is _P.RUNNING else 0.0
        if phase is _P.HOMING:
            self._home()
            return GuardResult.PASS
        drive.target_position = self._target
        drive.controlword = ENABLE_OPERATION
        if phase is _P.OFFERING or phase is _P.STAYING:
            self._offer()
        elif phase is _P.MOVING:
            self._move()
        elif phase is _P.CHANGING:
            self._change()
        elif phase is _P.RUNNING:
            self._run()
        elif phase is _P.HALTING:
            self._halt()
        elif phase is _P.RETURNING:
            self._return()
        elif self._set_point:
            # Enabled anew: some drives have kept their set-point.
            drive.controlword = HALT
            if drive.mode_display == self._rest_mode:
                self._rest()
        self._supervise()
        return GuardResult.PASS

    def _enter(self, phase: AxisPhase) -> None:
        self.phase = phase
        self._waited = self._astray = 0

    def _offer(self) -> None:
        """Offer the set-point by the rising edge of bit 4, once the drive acknowledges no earlier one."""
        drive = self.drive
        acknowledged = drive.statusword & ACKNOWLEDGED
        if not self._raised:
            self._raised = not acknowledged
        elif acknowledged and self._outdated:
            # This acknowledges the former one: bit 4 rises anew once bit 12 has fallen.
            self._raised = self._outdated = False
        elif acknowledged:
            if self.phase is _P.STAYING:
                self._set_point = False
                self._enter(_P.REST)
            else:
                self._enter(_P.MOVING)
            return
        if self._raised:
            # The first one after a halt also ends the halt: the drive never continues to the former set-point.
            drive.controlword = NEW_SETPOINT
        elif self.phase is _P.STAYING:
            drive.controlword = HALT
        if self._waited <= self._answer:
            return
        if self.phase is _P.STAYING:
            drive.controlword = HALT
            self.problem = AxisNotReplaced(self.first, drive.statusword)
        else:
            self._fail()

    def _move(self) -> None:
        """Wait for the target: an axis has arrived where the drive says so and its position agrees."""
        if self.drive.statusword & TARGET_REACHED and self._arrived:
            self._set_point, self._reached = False, True
            self._enter(_P.REST)
        elif self._waited > self._longest:
            self._fail()

    def _change(self) -> None:
        drive = self.drive
        drive.mode = PROFILE_VELOCITY
        if drive.mode_display == PROFILE_VELOCITY:
            self._enter(_P.RUNNING)
        elif self._waited > self._answer:
            self._lose_mode()

    def _run(self) -> None:
        """Run until the hold time has passed, or as far from the end of the range as the axis needs to halt."""
        self._held -= 1
        if self._held <= 0 or self._velocity == 0.0 or self._reaches_end(self._velocity):
            self.stop()

    def _halt(self) -> None:
        drive = self.drive
        drive.controlword = HALT
        if abs(drive.velocity) < drive.still and self._waited > self._lag:
            self._velocity = 0.0
            if drive.mode != self._rest_mode:
                self._enter(_P.RETURNING)
            else:
                self._rest()
        elif self._waited > self._halt_cycles:
            self.problem = AxisStillMoving(self.first, drive.velocity)

    def _rest(self) -> None:
        """Rest where the axis stands; a set-point that the drive may have elsewhere is replaced first."""
        self._target = self.drive.position
        if self._set_point:
            self._raised = self._outdated = False
            self._enter(_P.STAYING)
        else:
            self._enter(_P.REST)

    def _return(self) -> None:
        drive = self.drive
        drive.controlword = HALT
        drive.mode = self._rest_mode
        if drive.mode_display == self._rest_mode:
            self._set_point = self._positions
            self._rest()
        elif self._waited > self._answer:
            self._lose_mode()

    def _home(self) -> None:
        homing, drive = self._homing, self.drive
        homing.step()
        if not homing.ended:
            if homing.phase is HomingPhase.LEAVING:
                # In profile position it could continue to a set-point of before.
                drive.controlword = HALT
            return
        phase = homing.phase
        if phase is HomingPhase.RUNNING:
            self.problem = AxisStillMoving(self.first, drive.velocity)
        elif phase is HomingPhase.STUCK:
            self._lose_mode()
        else:
            self.homed = phase is HomingPhase.HOMED
            self._ended = homing.end_of(self.first)
            if self._ended is None:
                self._reports, self._reached = True, False
            drive.controlword = HALT
            self._set_point = self._positions
            self._rest()

    def _fail(self) -> None:
        """Halt an axis whose drive does not carry out its motion."""
        drive = self.drive
        self._ended = AxisFailed(self.first, drive.statusword, drive.mode_display)
        self.stop()

    def _lose_mode(self) -> None:
        drive = self.drive
        self.problem = AxisModeLost(self.first, drive.mode_display, drive.mode)

    def _supervise(self) -> None:
        """A drive that leaves its mode, or an axis that moves on beyond its range, is a fault."""
        drive = self.drive
        self._astray = self._astray + 1 if self.phase in _IN_MODE and drive.mode_display != drive.mode else 0
        if self._astray > self._lag:
            self._lose_mode()
        here, velocity, still = drive.position, drive.velocity, drive.still
        if (here > self._high + _BEYOND and velocity > still) or (here < self._low - _BEYOND and velocity < -still):
            self.problem = LeftRange(self.first, here)

    @property
    def _arrived(self) -> bool:
        return abs(self._target - self.drive.position) <= self.axis.tolerance

    def _reaches_end(self, velocity: float) -> bool:
        """Return whether an axis halted in this cycle from `velocity` would pass an end of its range."""
        here, now = self.drive.position, self.drive.velocity
        fastest = max(abs(velocity), abs(now))
        way = 0.5 * fastest * fastest / (_RAMP * self.axis.acceleration) + fastest * _REACTION_S
        return (velocity > 0.0 and here + way >= self._high) or (velocity < 0.0 and here - way <= self._low)

    # -- as the machine commands all joints ---------------------------------------------------------------------------

    @property
    def moves_by_command(self) -> bool:
        """Whether it moves and does not stop."""
        return (
            self.phase is not _P.REST
            and self.phase not in _STOPPING
            and not (self.phase is _P.HOMING and self._homing.leaving)
        )

    @property
    def at_rest(self) -> bool:
        """Whether the axis stands, so that its torque may go; its set-point is replaced when it is next enabled."""
        return self.phase is _P.REST or self.phase is _P.STAYING

    @property
    def ready(self) -> bool:
        """Whether a motion can begin."""
        return self.phase is _P.REST

    def stop(self) -> None:
        """Halt the axis."""
        if self.phase is _P.HOMING:
            self._homing.stop()
        elif self.phase is not _P.REST and self.phase not in _STOPPING:
            self._enter(_P.HALTING)

    def hold(self) -> None:
        """Forget the motion: the drives are stopped by other means."""
        if self.phase is _P.HOMING:
            self._homing.abandon()
        self._velocity = 0.0
        self._set_point = self._positions
        self.problem = None
        self._enter(_P.REST)

    def latch(self) -> None:
        """Rest where the drive stands."""
        self._target = self.drive.position

    def track_actual(self) -> None:
        """Follow a drive without torque; it changes to the mode in which it rests."""
        super().track_actual()
        if self.drive.state not in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE):
            self.drive.mode = self._rest_mode
