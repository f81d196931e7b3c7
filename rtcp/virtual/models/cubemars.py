"""The Cubemars ORH drive: a CiA 402 servo drive with its motor, gear and load, as objects and time that passes."""

from __future__ import annotations

from math import ceil, pi
from types import MappingProxyType
from typing import ClassVar

from rtcp.virtual.device import DeviceModel, Option, number
from rtcp.virtual.models.cia402 import STATE_BITS, DriveState, DriveStateMachine, Status
from rtcp.virtual.models.cyclic_modes import (
    ERROR,
    LIMIT,
    CyclicPosition,
    CyclicTorque,
    CyclicVelocity,
    Hold,
    Motion,
    Profile,
    Stop,
)
from rtcp.virtual.models.drive_objects import UNIT, define_objects
from rtcp.virtual.models.mechanics import SIZES, ActuatorSize, Axis, Mechanics
from rtcp.virtual.models.profile_modes import Homing, ProfilePosition, ProfileVelocity
from rtcp.virtual.models.protection import AT_ONCE, ENCODER_RANGE, Condition, ErrorCode, ErrorLog, Feedback
from rtcp.virtual.objects import ObjectDictionary
from rtcp.virtual.pdo import define_pdo_objects

RX_PDO = ((0x6040, 0, 16), (0x607A, 0, 32), (0x60FF, 0, 32), (0x6071, 0, 32), (0x6060, 0, 8))
TX_PDO = ((0x6041, 0, 16), (0x6064, 0, 32), (0x606C, 0, 32), (0x6077, 0, 32), (0x6061, 0, 8))

_SELF_TEST = 0.1
"""How long (s) the drive stays in Not Ready To Switch On after power-on."""
_HALT = 0x100
_LONGEST = Axis.LONGEST_STEP * 1.000001


class CubemarsDrive(DeviceModel):
    """A Cubemars ORH drive; each size is a subclass.

    With the power stage off a brake holds the joint, which its gear alone would not do under the
    weight of an arm. `mechanics` and `condition` may be changed from outside: a payload, a collision, heat.
    """

    # The true numbers of the manufacturer are not known to this project; these are placeholders.
    vendor_id = 0x00000B5C
    product_code = 0x00040201
    device_type = 0x00020192  # servo drive, CiA 402
    group = "Servo drives"
    size: ClassVar[ActuatorSize]
    options = MappingProxyType({
        "load_inertia": Option(None, 0.0, 50.0, "inertia of the load at the joint, kg m^2"),
        "load_mass_moment": Option(0.0, -50.0, 50.0, "mass of the load times its distance from the axis, kg m"),
        "gravity_phase": Option(0.0, -2 * pi, 2 * pi, "0: the load stands upright at q = 0, pi: it hangs, rad"),
        "friction": Option(None, 0.0, 50.0, "Coulomb friction, Nm"),
        "viscous_friction": Option(None, 0.0, 50.0, "viscous friction, Nm s/rad"),
        "holding_torque": Option(None, 0.0, 500.0, "torque of the brake that closes with the power stage off, Nm"),
        "initial_position": Option(0.0, -20.0, 20.0, "position of the encoder at power-on, rad"),
        "temperature": Option(30.0, -40.0, 200.0, "ambient temperature, and of the motor at power-on, C"),
        "bus_voltage": Option(48.0, 0.0, 100.0, "supply, V"),
    })  # fmt: skip

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        size, option, objects = self.size, self.option, self.objects
        self.mechanics = Mechanics(
            size.rotor_inertia + option("load_inertia", size.load_inertia),
            option("friction", size.coulomb),
            option("viscous_friction", size.viscous),
            holding_torque=option("holding_torque", size.start_stop_torque),
            load_mass_moment=option("load_mass_moment"),
            gravity_phase=option("gravity_phase"),
            position=option("initial_position"),
        )
        self.condition = Condition(size, option("temperature"), option("bus_voltage"))
        self.axis = Axis(self.mechanics)
        self._lasting: list[int] = []
        """Faults whose cause lasts, made from outside."""
        self._feedback = Feedback(objects, size.rated_torque)
        self._errors = ErrorLog(objects, self.emergencies)
        self._bind()
        self.power_on()

    def define(self, objects: ObjectDictionary) -> None:
        """Add the objects of the drive and its PDOs, which the master may map anew."""
        define_objects(objects, self.size, int(self.option("sync_error_limit")))
        define_pdo_objects(objects, {0x1600: RX_PDO}, {0x1A00: TX_PDO}, [0x1600], [0x1A00], fixed=False)

    def power_on(self) -> None:
        """The supply comes back: all is as at power-on. The joint stands where it stands; its encoder is absolute."""
        super().power_on()
        objects = self.objects
        self.condition.overload = 0.0
        self.axis.offset = self.axis.torque_limit = 0.0
        self.axis.synchronise()
        self._supplied = True
        self._machine = DriveStateMachine()
        self._stop = Stop(self.axis)
        self._profile = Profile(objects)
        self._modes: dict[int, Motion] = {
            0: Hold(self.axis),
            1: ProfilePosition(self.axis, objects),
            3: ProfileVelocity(self.axis, objects),
            6: Homing(self.axis, objects),
            8: CyclicPosition(self.axis, objects),
            9: CyclicVelocity(self.axis, objects),
            10: CyclicTorque(self.axis, objects),
        }
        self._mode = 0
        self._motion: Motion | None = None
        """What moves the axis; None while the power stage is off."""
        self._pending = False
        """Whether a ramp is under way that ends in transition 5 or 8."""
        self._busy = True
        self._last_controlword = 0
        self.outputs_valid = False
        self._self_test = _SELF_TEST
        self._following_time = 0.0
        self._torque_counts = -1
        self._bits = 0
        self._report_condition()
        self._feedback.publish(self._bits, self.axis, 0.0)

    def _bind(self) -> None:
        """Keep the entries that `step` needs: it looks nothing up."""
        objects = self.objects
        self._controlword = number(objects, 0x6040)
        self._mode_wanted = number(objects, 0x6060)
        self._mode_display = number(objects, 0x6061)
        self._window = number(objects, 0x6065)
        self._window_time = number(objects, 0x6066)
        self._max_torque = number(objects, 0x6072)
        self._max_speed = number(objects, 0x6080)
        self._quick_deceleration = number(objects, 0x6085)
        self._quick_stop_option = number(objects, 0x605A)
        self._shutdown_option = number(objects, 0x605B)
        self._disable_option = number(objects, 0x605C)
        self._halt_option = number(objects, 0x605D)
        self._fault_option = number(objects, 0x605E)

    @property
    def state(self) -> DriveState:
        """The state of the power state machine."""
        return self._machine.state

    @property
    def powered(self) -> bool:
        """Whether the power stage is on and the brake open."""
        return self._motion is not None

    def power_off(self) -> None:
        """The supply goes: no torque, the brake closes."""
        self._supplied = False
        self.outputs_valid = False
        self._switch_off(DriveState.NOT_READY_TO_SWITCH_ON)

    def set_outputs_valid(self, valid: bool) -> None:
        """Set whether process data outputs are valid (OP) or ignored; ignored, the controlword counts as 0.

        Losing them with the power stage on is fault 0x8130.
        """
        if self.outputs_valid and not valid and self._motion is not None:
            self._fail(ErrorCode.COMMUNICATION)
        self.outputs_valid = valid
        self._compose()

    def inject_fault(self, code: int) -> None:
        """Let the fault `code` (0x603F) happen now; codes outside `AT_ONCE` react as 0x605E says.

        Raises:
            ValueError: `code` is no error code.
        """
        if not 0x1000 <= code <= 0xFFFF:
            raise ValueError(f"error code 0x{code:X} is none: allowed are 0x1000 to 0xFFFF (CiA 402-2)")
        self._fail(code)

    def begin_fault(self, code: int) -> None:
        """Let the fault `code` happen now, and its cause last until `end_fault`: no fault reset succeeds."""
        self._lasting.append(code)
        if self._supplied and self._machine.state is not DriveState.NOT_READY_TO_SWITCH_ON:
            self._fail(code)

    def end_fault(self, code: int) -> None:
        """Let the cause of a fault be gone: from now on a fault reset succeeds."""
        self._lasting.remove(code)

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass: obey the RxPDO objects, move, write the TxPDO objects."""
        if dt <= 0.0:
            return
        if not self._supplied:
            self._stand(dt)
            return
        controlword = self._controlword.value if self.outputs_valid else 0
        if self._busy or controlword != self._last_controlword:
            self._last_controlword = controlword
            self._control(controlword, dt)
        if self._mode_wanted.value != self._mode:
            self._choose_mode(self._mode_wanted.value)
        if self._max_torque.value != self._torque_counts:
            self._torque_counts = self._max_torque.value
            self.axis.torque_limit = min(self._torque_counts * UNIT, self.size.start_stop_torque)
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
                window = self._window.value * UNIT
                if following > window or following < -window:
                    bits |= ERROR
                    self._following_time += dt
                    if self._following_time * 1000.0 >= self._window_time.value:
                        self._fail(ErrorCode.FOLLOWING_ERROR)
                else:
                    self._following_time = 0.0
        self._protect(dt)
        if self._motion is not motion:
            # A fault has ended the mode, and with it what its bits say.
            bits = 0
        self._feedback.publish(self._bits | bits, axis, following)

    def _stand(self, dt: float) -> None:
        """Without supply only the mechanics go on."""
        count = ceil(dt / _LONGEST)
        for _ in range(count):
            self.axis.rest(dt / count)

    def _protect(self, dt: float) -> None:
        mechanics = self.mechanics
        fastest = self._max_speed.value * UNIT
        if not -fastest <= mechanics.velocity <= fastest:
            self._fail(ErrorCode.OVER_SPEED)
        if not -ENCODER_RANGE <= mechanics.position <= ENCODER_RANGE:
            self._fail(ErrorCode.POSITION_RANGE)
        if self.condition.wear(self.axis.torque, dt):
            self._report_condition()
            code = self.condition.fault()
            if code:
                self._fail(code)

    def _report_condition(self) -> None:
        """Refresh what changes slowly, and the warning bit."""
        self._feedback.publish_condition(self.condition, self.axis.torque)
        self._compose()

    def _compose(self) -> None:
        """Work out the bits of the statusword that do not change from step to step."""
        bits = STATE_BITS[self._machine.state]
        if self._machine.state is not DriveState.NOT_READY_TO_SWITCH_ON:
            bits |= Status.VOLTAGE_ENABLED
        if self.condition.warning:
            bits |= Status.WARNING
        if self.outputs_valid:
            bits |= Status.REMOTE
        self._bits = int(bits)

    def _enter(self, state: DriveState) -> None:
        self._machine.state = state
        self._compose()

    def _control(self, controlword: int, dt: float) -> None:
        """Walk at most one transition of the state machine; start and end the stops that go with it."""
        before = self._machine.state
        asked = self._machine.request(controlword)
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
            self._control_quick_stop(asked)
        elif asked is not None:
            self._follow_transition(*asked)
        elif self._pending and controlword & 0x8F == 0x0F:
            # Enabled again before the ramp of transition 5 or 8 has ended.
            self._start_mode()
        if self._machine.state is DriveState.OPERATION_ENABLED and not self._pending:
            self._control_halt(controlword)
        self._busy = self._pending or self._machine.state is not before or self._machine.state in (
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
        elif transition == 15:
            self._reset()
        else:
            self._switch_off(state)

    def _control_quick_stop(self, asked: tuple[int, DriveState] | None) -> None:
        stays = self._quick_stop_option.value in (5, 6)
        if asked is not None and asked[0] == 12:
            self._switch_off(asked[1])
        elif asked is not None and stays:
            self._enter(asked[1])
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

    def _start_mode(self) -> None:
        self._pending = False
        self._following_time = 0.0
        self.axis.synchronise()
        self._motion = self._modes[self._mode]
        self._motion.enter()

    def _start_stop(self, *, quick: bool) -> None:
        quickest = max(1, self._quick_deceleration.value) * UNIT
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
        self._mode = self._mode_display.value = wanted
        if running:
            self._start_mode()
        else:
            self._modes[wanted].enter()

    def _fail(self, code: int) -> None:
        """Transition 13: tell the fault and begin the reaction to it (0x605E)."""
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
        """Transition 15, refused for as long as what caused the fault lasts (CiA 402-2, transition 15)."""
        mechanics = self.mechanics
        if self._lasting:
            self._errors.add(self._lasting[-1])
            return
        if self.condition.fault() or abs(mechanics.position) > ENCODER_RANGE:
            return
        if abs(mechanics.velocity) > self._max_speed.value * UNIT:
            return
        self._errors.reset()
        self._enter(DriveState.SWITCH_ON_DISABLED)


class CubemarsOrh40(CubemarsDrive):
    """ORH40, 5.4 Nm rated."""

    size, name, order_code = SIZES["orh40"], "Cubemars ORH40", "Cubemars-ORH40"


class CubemarsOrh50(CubemarsDrive):
    """ORH50, 16 Nm rated."""

    size, name, order_code = SIZES["orh50"], "Cubemars ORH50", "Cubemars-ORH50"


class CubemarsOrh60(CubemarsDrive):
    """ORH60, 28 Nm rated."""

    size, name, order_code = SIZES["orh60"], "Cubemars ORH60", "Cubemars-ORH60"


class CubemarsOrh70(CubemarsDrive):
    """ORH70, 40 Nm rated."""

    size, name, order_code = SIZES["orh70"], "Cubemars ORH70", "Cubemars-ORH70"
