"""One axis of a servo drive: power state machine, modes, protection and feedback (CiA 402-2, ETG.6010).

It is common to all drives, which differ in units, modes and objects.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from typing import Final

from rtcp.virtual.models.cia402 import STATE_BITS, DriveState, DriveStateMachine, Status
from rtcp.virtual.models.cyclic_modes import ERROR, LIMIT, REACHED, Motion, Profile, Stop
from rtcp.virtual.models.mechanics import ActuatorSize, Axis, Mechanics
from rtcp.virtual.models.protection import AT_ONCE, Condition, ErrorCode, ErrorLog, Feedback
from rtcp.virtual.models.units import AxisObjects
from rtcp.virtual.objects import Number

SELF_TEST = 0.1
"""Duration of Not Ready To Switch On after power-on, s."""
_HALT: Final = 0x100
_FAULT_RESET: Final = 0x80
_MODE_BITS: Final = 0x3400
"""Bits 10, 12 and 13 of the statusword, whose meaning depends on the mode."""
# Plain ints: enum arithmetic is slow.
_VOLTAGE_ENABLED: Final = int(Status.VOLTAGE_ENABLED)
_WARNING: Final = int(Status.WARNING)
_REMOTE: Final = int(Status.REMOTE)
_LONGEST: Final = Axis.LONGEST_STEP * 1.000001
"""Longest step, and what rounding adds, s."""

Modes = Callable[[Axis, AxisObjects], dict[int, Motion]]
"""Creates the modes of an axis by their numbers in 0x6060; 0 holds the joint."""


class ServoAxis:
    """An axis that turns a joint.

    With the power stage off a brake holds the joint, as the gear alone does not hold the weight of an arm. Tests may
    change `mechanics` and `condition`: a payload, a collision, heat.
    """

    def __init__(self, objects: AxisObjects, size: ActuatorSize, mechanics: Mechanics, condition: Condition,
                 feedback: Feedback, errors: ErrorLog, modes: Modes, max_speed: Number,
                 encoder_range: float) -> None:  # fmt: skip
        """`max_speed` is in counts, `encoder_range` in rad each way. Call `power_on` afterwards."""
        self.objects = objects
        self.size = size
        self.mechanics = mechanics
        self.condition = condition
        self.axis = Axis(mechanics)
        self._units = objects.units
        self._lasting: list[int] = []
        """Injected faults with a lasting cause."""
        self._feedback = feedback
        self._errors = errors
        self._make_modes = modes
        self._max_speed = max_speed
        self._range = encoder_range
        self.mode_bits_lag = 0.0
        """Time for which bits 10, 12 and 13 of the statusword stay those of the former mode, s."""
        self.reset_pulse = 0.0
        """Time for which the fault reset bit must stay set, s; 0: its rising edge resets."""
        self.keeps_set_point = False
        """Whether profile position goes on to its set-point when it begins anew."""
        # Kept, to avoid look-ups in `step`.
        self._controlword = objects.number(0x6040)
        self._mode_wanted = objects.number(0x6060)
        self._mode_display = objects.number(0x6061)
        self._window = objects.number(0x6065)
        self._window_time = objects.number(0x6066)
        self._max_torque = objects.number(0x6072)
        self._torque_limits = [objects.number(index) for index in (0x60E0, 0x60E1) if (index, 0) in objects]
        self._quick_deceleration = objects.number(0x6085)
        self._quick_stop_option = objects.number(0x605A)
        self._shutdown_option = objects.number(0x605B)
        self._disable_option = objects.number(0x605C)
        self._halt_option = objects.number(0x605D)
        self._fault_option = objects.number(0x605E)

    @property
    def state(self) -> DriveState:
        """The state of the power state machine."""
        return self._machine.state

    @property
    def powered(self) -> bool:
        """Whether the power stage is on and the brake open."""
        return self._motion is not None

    def power_on(self) -> None:
        """Power on: reset everything but the position, as the encoder is absolute."""
        self.condition.overload = 0.0
        self.axis.offset = self.axis.torque_limit = 0.0
        self.axis.synchronise()
        self._supplied = True
        self._machine = DriveStateMachine()
        self._stop = Stop(self.axis)
        self._profile = Profile(self.objects)
        self._modes = self._make_modes(self.axis, self.objects)
        self._mode = 0
        self._motion: Motion | None = None
        """Active mode; None while the power stage is off."""
        self._pending = False
        """True: a ramp is in progress that ends in transition 5 or 8."""
        self._busy = True
        self._last_controlword = 0
        self._mode_bits = self._former_bits = 0
        """Bits 10, 12 and 13 now, and those of the former mode."""
        self._lag_left = self._reset_left = 0.0
        self.outputs_valid = False
        self._self_test = SELF_TEST
        self._following_time = 0.0
        self._torque_counts = -1
        self._bits = 0
        self._report_condition()
        self._feedback.publish(self._bits, self.axis, 0.0)

    def power_off(self) -> None:
        """Power off: no torque, the brake closes."""
        self._supplied = False
        self.outputs_valid = False
        self._switch_off(DriveState.NOT_READY_TO_SWITCH_ON)

    def set_outputs_valid(self, valid: bool) -> None:
        """Set whether process data outputs are valid (OP) or ignored, which acts as controlword 0.

        Losing them with the power stage on is fault 0x8130.
        """
        if self.outputs_valid and not valid and self._motion is not None:
            self._fail(ErrorCode.COMMUNICATION)
        self.outputs_valid = valid
        self._compose()

    def inject_fault(self, code: int) -> None:
        """Trigger the fault `code` (0x603F); the reaction is by 0x605E unless the code is in `AT_ONCE`.

        Raises:
            ValueError: `code` is not an error code.
        """
        if not 0x1000 <= code <= 0xFFFF:
            raise ValueError(f"error code 0x{code:X} is none: allowed are 0x1000 to 0xFFFF (CiA 402-2)")
        self._fail(code)

    def begin_fault(self, code: int) -> None:
        """Trigger the fault `code` with a cause that lasts until `end_fault`: until then a fault reset fails."""
        self._lasting.append(code)
        if self._supplied and self._machine.state is not DriveState.NOT_READY_TO_SWITCH_ON:
            self._fail(code)

    def end_fault(self, code: int) -> None:
        """Remove the cause of a fault: a fault reset then succeeds."""
        self._lasting.remove(code)

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds: read the RxPDO objects, move, write the TxPDO objects."""
        if dt <= 0.0:
            return
        if not self._supplied:
            self._stand(dt)
            return
        controlword: int = self._controlword.value if self.outputs_valid else 0
        if self._busy or controlword != self._last_controlword:
            self._control(controlword, dt)
            self._last_controlword = controlword
        mode: int = self._mode_wanted.value
        if mode != self._mode:
            self._choose_mode(mode)
        max_torque: int = self._max_torque.value
        for limit in self._torque_limits:
            # The mechanics know one limit for both directions: the smaller one counts.
            max_torque = min(max_torque, limit.value)
        if max_torque != self._torque_counts:
            self._torque_counts = max_torque
            self.axis.torque_limit = min(self._torque_counts * self._units.torque, self.size.start_stop_torque)
        if dt <= _LONGEST:
            count, h = 1, dt
        else:
            count = ceil(dt / _LONGEST)
            h = dt / count
        axis = self.axis
        motion = self._motion
        following = 0.0
        if motion is None:
            for _ in range(count):
                axis.rest(h)
            bits = 0
        else:
            motion.update(controlword, h, count)
            bits = motion.bits
            if axis.saturated:
                bits |= LIMIT
            if motion.closed:
                following = axis.demand - axis.mechanics.position - axis.offset
                counts: int = self._window.value
                window = counts * self._units.position
                if following > window or following < -window:
                    bits |= ERROR
                    self._following_time += dt
                    if self._following_time * 1000.0 >= self._window_time.value:
                        self._fail(ErrorCode.FOLLOWING_ERROR)
                else:
                    self._following_time = 0.0
        self._protect(dt)
        if self._motion is not motion:
            # A fault ended the mode; its bits are void.
            bits = 0
        if self._lag_left > 0.0:
            self._lag_left -= dt
            bits = bits & ~_MODE_BITS | self._former_bits
        self._mode_bits = bits & _MODE_BITS
        self._feedback.publish(self._bits | bits, axis, following)

    def _stand(self, dt: float) -> None:
        """Advance only the mechanics, without supply."""
        count = ceil(dt / _LONGEST)
        for _ in range(count):
            self.axis.rest(dt / count)

    def _protect(self, dt: float) -> None:
        mechanics = self.mechanics
        counts: int = self._max_speed.value
        fastest = counts * self._units.velocity
        if not -fastest <= mechanics.velocity <= fastest:
            self._fail(ErrorCode.OVER_SPEED)
        if not -self._range <= mechanics.position <= self._range:
            self._fail(ErrorCode.POSITION_RANGE)
        if self.condition.wear(self.axis.torque, dt):
            self._report_condition()
            code = self.condition.fault()
            if code:
                self._fail(code)

    def _report_condition(self) -> None:
        """Update the slow quantities and the warning bit."""
        self._feedback.publish_condition(self.condition, self.axis.torque)
        self._compose()

    def _compose(self) -> None:
        """Compute the bits of the statusword that are constant between events."""
        bits = STATE_BITS[self._machine.state]
        if self._machine.state is not DriveState.NOT_READY_TO_SWITCH_ON:
            bits |= _VOLTAGE_ENABLED
        if self.condition.warning:
            bits |= _WARNING
        if self.outputs_valid:
            bits |= _REMOTE
        self._bits = bits

    def _enter(self, state: DriveState) -> None:
        self._machine.state = state
        self._compose()

    def _control(self, controlword: int, dt: float) -> None:
        """Execute at most one transition of the state machine; start and end its stops."""
        before = self._machine.state
        transition = self._machine.request(controlword)
        if before is DriveState.NOT_READY_TO_SWITCH_ON:
            self._self_test -= dt
            if self._self_test <= 0.0:
                self._enter(DriveState.SWITCH_ON_DISABLED)
                if self._lasting:
                    self._fail(self._lasting[-1])
        elif before is DriveState.FAULT_REACTION_ACTIVE:
            if self._motion is None or self._stop.done:
                self._switch_off(DriveState.FAULT)
        elif before is DriveState.QUICK_STOP_ACTIVE:
            self._control_quick_stop(transition)
        elif self._reset_left > 0.0:
            self._reset_left -= dt
            if self._reset_left <= 0.0:
                self._reset()
            elif not controlword & _FAULT_RESET:
                self._reset_left = 0.0
        elif transition is not None:
            self._follow_transition(*transition)
        elif self._pending and controlword & 0x8F == 0x0F:
            # Enabled again before the end of the ramp of transition 5 or 8.
            self._start_mode()
        if self._machine.state is DriveState.OPERATION_ENABLED and not self._pending:
            self._control_halt(controlword)
        changes = self._pending or self._reset_left > 0.0 or self._machine.state is not before
        self._busy = changes or self._machine.state in (
            DriveState.NOT_READY_TO_SWITCH_ON, DriveState.FAULT_REACTION_ACTIVE, DriveState.QUICK_STOP_ACTIVE,
        )  # fmt: skip

    def _follow_transition(self, transition: int, state: DriveState) -> None:
        if transition == 4:
            self.axis.release()
            self._enter(state)
            self._start_mode()
        elif transition in (5, 8):
            option = self._disable_option if transition == 5 else self._shutdown_option
            if option.value == 0 or (self._pending and self._stop.done):
                self._switch_off(state)
            elif not self._pending:
                self._pending = True
                self._start_stop(quick=False)
        elif transition == 11 and self._quick_stop_option.value:
            self._pending = False
            self._enter(state)
            self._start_stop(quick=self._quick_stop_option.value in (2, 6))
        elif transition == 11:
            self._switch_off(DriveState.SWITCH_ON_DISABLED)
        elif transition == 15 and self.reset_pulse:
            self._reset_left = self.reset_pulse
        elif transition == 15:
            self._reset()
        else:
            self._switch_off(state)

    def _control_quick_stop(self, transition: tuple[int, DriveState] | None) -> None:
        stays = self._quick_stop_option.value in (5, 6)
        if transition is not None and transition[0] == 12:
            self._switch_off(transition[1])
        elif transition is not None and stays:
            self._enter(transition[1])
            self._start_mode()
        elif self._stop.done and not stays:
            self._switch_off(DriveState.SWITCH_ON_DISABLED)

    def _control_halt(self, controlword: int) -> None:
        halted = self._motion is self._stop
        if controlword & _HALT and not halted:
            self._start_stop(quick=self._halt_option.value == 2)
        elif halted and not controlword & _HALT:
            self._motion = self._modes[self._mode]
            self.axis.synchronise()
            self._motion.resume()
            self._motion.watch(self._last_controlword)

    def _start_mode(self) -> None:
        self._pending = False
        self._following_time = 0.0
        self.axis.synchronise()
        self._motion = self._modes[self._mode]
        self._begin_mode()

    def _begin_mode(self) -> None:
        motion = self._modes[self._mode]
        if self.keeps_set_point and self._mode == 1:
            motion.resume()
        else:
            motion.enter()

    def _start_stop(self, *, quick: bool) -> None:
        quickest = max(1, self._quick_deceleration.value) * self._units.acceleration
        self._stop.deceleration = quickest if quick else self._profile.deceleration
        self._stop.enter()
        self._motion = self._stop

    def _switch_off(self, state: DriveState) -> None:
        self._motion = None
        self._pending = False
        self._enter(state)

    def _choose_mode(self, wanted: int) -> None:
        """Change to a supported mode; another value keeps the old one (CiA 402-2, object 0x6060)."""
        if wanted not in self._modes or wanted == 0:
            return
        running = self._motion is self._modes[self._mode]
        # Some drives show that the target is reached in CSP too.
        self._lag_left, self._former_bits = self.mode_bits_lag, self._mode_bits | REACHED
        self._mode = self._mode_display.value = wanted
        if running:
            self._start_mode()
        else:
            self._begin_mode()

    def _fail(self, code: int) -> None:
        """Transition 13: report the fault and begin the fault reaction (0x605E)."""
        state = self._machine.state
        at_once = code in AT_ONCE
        if state is DriveState.FAULT or (state is DriveState.FAULT_REACTION_ACTIVE and not at_once):
            return
        self._errors.add(code)
        self._pending = False
        self._following_time = 0.0
        if self._motion is not None and self._fault_option.value and not at_once:
            self._start_stop(quick=self._fault_option.value == 2)
        else:
            self._motion = None
        self._enter(DriveState.FAULT_REACTION_ACTIVE)
        self._busy = True

    def _reset(self) -> None:
        """Transition 15, refused while the cause of the fault lasts (CiA 402-2, transition 15)."""
        mechanics = self.mechanics
        if self._lasting:
            self._errors.add(self._lasting[-1])
            return
        if self.condition.fault() or abs(mechanics.position) > self._range:
            return
        if abs(mechanics.velocity) > self._max_speed.value * self._units.velocity:
            return
        self._errors.reset()
        self._enter(DriveState.SWITCH_ON_DISABLED)
