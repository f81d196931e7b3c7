"""The CiA 402 drive: two tables and the code that walks them (CiA 402-2, clause 8: finite state automaton)."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import ClassVar, Final, cast

from rtcp.config.model import DRIVEN_OUTPUTS, MODE_CHANNELS, SlaveConfig
from rtcp.devices.drive import CSP, CST, CSV, Drive, TargetState
from rtcp.devices.driver import DeviceError, integer_range
from rtcp.fieldbus.pdo import ImageLayout
from rtcp.ipc.states import DriveState

# (mask, value) of the statusword -> state (CiA 402-2, table 29)
STATES: dict[tuple[int, int], DriveState] = {
    (0x4F, 0x00): DriveState.NOT_READY_TO_SWITCH_ON,
    (0x4F, 0x40): DriveState.SWITCH_ON_DISABLED,
    (0x6F, 0x21): DriveState.READY_TO_SWITCH_ON,
    (0x6F, 0x23): DriveState.SWITCHED_ON,
    (0x6F, 0x27): DriveState.OPERATION_ENABLED,
    (0x6F, 0x07): DriveState.QUICK_STOP_ACTIVE,
    (0x4F, 0x0F): DriveState.FAULT_REACTION_ACTIVE,
    (0x4F, 0x08): DriveState.FAULT,
}

DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON = 0x0000, 0x0002, 0x0006, 0x0007
ENABLE_OPERATION, FAULT_RESET = 0x000F, 0x0080
"""Commands of the controlword (CiA 402-2, table 27)."""

_S = DriveState
# (state, target) -> controlword of the next step (CiA 402-2, figure 7); default DISABLE_VOLTAGE.
CONTROLWORDS: dict[tuple[DriveState, TargetState], int] = {
    **{(state, target): DISABLE_VOLTAGE for state in DriveState for target in TargetState},
    (_S.SWITCH_ON_DISABLED, TargetState.ENABLED): SHUTDOWN,
    (_S.READY_TO_SWITCH_ON, TargetState.ENABLED): SWITCH_ON,
    (_S.SWITCHED_ON, TargetState.ENABLED): ENABLE_OPERATION,
    (_S.OPERATION_ENABLED, TargetState.ENABLED): ENABLE_OPERATION,
    # Transition 16: holds the arm, which `disable voltage` would let fall.
    (_S.QUICK_STOP_ACTIVE, TargetState.ENABLED): ENABLE_OPERATION,
    (_S.SWITCHED_ON, TargetState.DISABLED): SHUTDOWN,
    (_S.OPERATION_ENABLED, TargetState.DISABLED): SWITCH_ON,
    (_S.SWITCHED_ON, TargetState.RESET): SHUTDOWN,
    (_S.OPERATION_ENABLED, TargetState.RESET): SWITCH_ON,
    # A fault is reset on request only.
    (_S.FAULT, TargetState.RESET): FAULT_RESET,
    # In every state: if a false statusword hides an enabled drive, `disable voltage` would let the arm fall.
    # Without torque a drive comes to, or stays in, `switch on disabled` (transitions 7 and 10); one in fault stays.
    **{(state, TargetState.QUICK_STOPPED): QUICK_STOP for state in DriveState},
}

_WITHOUT_TORQUE = frozenset({_S.SWITCH_ON_DISABLED, _S.NOT_READY_TO_SWITCH_ON, _S.FAULT})

# States in which a target is reached.
REACHED: dict[TargetState, frozenset[DriveState]] = {
    TargetState.ENABLED: frozenset({_S.OPERATION_ENABLED}),
    TargetState.DISABLED: _WITHOUT_TORQUE,
    TargetState.TORQUE_OFF: _WITHOUT_TORQUE,
    TargetState.QUICK_STOPPED: _WITHOUT_TORQUE | {_S.QUICK_STOP_ACTIVE},
    TargetState.RESET: frozenset({_S.SWITCH_ON_DISABLED}),
}

STATE_BITS = 0x6F
"""Statusword bits of the state."""
_STATE_OF = tuple(
    next((state for (mask, value), state in STATES.items() if word & mask == value), DriveState.UNKNOWN)
    for word in range(0x80)
)
_EXACT: Final = 1e-9
"""Largest round-off of a conversion between counts and SI units, in either unit."""
_INPUTS = ("statusword", "position", "velocity", "torque", "modes_of_operation_display")
_WITH_SPEED = (CSP, CSV)
_NEEDED = {CSP: MODE_CHANNELS["csp"], CSV: MODE_CHANNELS["csv"], CST: MODE_CHANNELS["cst"]}
_ENABLED = DriveState.OPERATION_ENABLED
_WITH_TARGET = (ENABLE_OPERATION, QUICK_STOP)
"""Controlwords that keep the target."""


def _slots(image: ImageLayout, names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of channels in an image; -1: not mapped."""
    slots = map(image.find, names)
    return tuple(-1 if channel is None else image.channels.index(channel) for channel in slots)


def state_of(statusword: int) -> DriveState:
    """Return the state of a statusword; UNKNOWN if the standard does not define it."""
    return _STATE_OF[statusword & STATE_BITS]


def blind_outputs(drive: Drive, goal: TargetState, sent: bytes) -> bytes:
    """Return the outputs of a drive whose driver raises: `sent` with the controlword of a quick stop or of no torque.

    Args:
        drive: the drive; one of another bus has no controlword, and zeros are its command to stand.
        goal: a state without torque; any other one is a quick stop.
        sent: outputs that the driver has encoded last. A drive that reacts late may still follow their target.
    """
    if drive.rpdo.find("controlword") is None:
        return bytes(drive.output_bytes)
    word = DISABLE_VOLTAGE if goal in (TargetState.DISABLED, TargetState.TORQUE_OFF) else QUICK_STOP
    channels = zip(drive.rpdo.channels, drive.codec_out.unpack(sent), strict=True)
    return drive.codec_out.pack(*(word if channel.name == "controlword" else value for channel, value in channels))


class Cia402Drive(Drive):
    """A drive in SI units: `decode`, `advance`, set targets, `encode`. Widths and factors are the description's.

    `encode` also takes `controlword`. A velocity that is not mapped is the mean one over 20 ms. In CSP the drive takes
    `speed_limit` from the field of the target velocity. A drive whose PDOs lack the mode of operation, or its display,
    stays in CSP, to which a start-up SDO sets it. With feed-forward, the offsets 0x60B1 and 0x60B2 are those of
    `offsets` while the drive is enabled in CSP and CSV, else 0. Whatever else is mapped has its safe value, which the
    bus takes from the drive where the description states none.

    Args:
        slave: the slave's name and description.
        period_s: the cycle, s.
        speed_limit: what the drive is given as its speed limit in CSP, rad/s; fixed once it is enabled.
        zero: what the drive shows where the joint is at 0, rad.

    Raises:
        DeviceError: the description lacks a channel, or one has a type or a factor that cannot serve.
    """

    HAS_STATUSWORD: ClassVar[bool] = True
    REQUIRED_OUTPUTS = ("controlword", "target_position")
    REQUIRED_INPUTS = ("statusword", "position")

    def __init__(self, slave: SlaveConfig, period_s: float, *, speed_limit: float = 0.0, zero: float = 0.0) -> None:
        super().__init__(slave, period_s, speed_limit=speed_limit, zero=zero)
        self._out, self._in = _slots(self.rpdo, DRIVEN_OUTPUTS), _slots(self.tpdo, _INPUTS)
        targets = [None if slot < 0 else self.rpdo.channels[slot] for slot in self._out[1:4]]
        if any(channel is not None and channel.factor == 0 for channel in targets):
            raise DeviceError(f"{self.device}: a factor of 0 in `rpdo` is not allowed")
        for slot in (self._in[0], self._in[4]):
            if slot >= 0:
                integer_range(self.tpdo.channels[slot])  # statusword and mode: raises where one is no integer
        self.changes_mode = self._out[4] >= 0 and self._in[4] >= 0
        """True: its mode of operation can be commanded, and is shown; False: it stays in CSP."""
        self._limits = tuple((0, 0) if channel is None else integer_range(channel) for channel in targets)
        self._scales = tuple(0.0 if channel is None else 1.0 / channel.factor for channel in targets)
        self._in_factors = tuple(0.0 if slot < 0 else self.tpdo.channels[slot].factor for slot in self._in[1:4])
        self.resolution, self.velocity_resolution = abs(self._in_factors[0]), abs(self._in_factors[1])
        (self._temperature_slot,) = _slots(self.tpdo, ("temperature",))
        self._unpack, self._pack = self.codec_in.unpack, self.codec_out.pack
        if self._in[4] < 0:
            # The mode to which the start-up SDO sets it stands behind what the drive sends.
            unpack = self._unpack
            self._unpack = lambda data: (*unpack(data), CSP)
            self._in = (*self._in[:4], len(self.tpdo.channels))
        self._fields = cast(list[int], [self._counts_of(channel) for channel in self.rpdo.channels])
        self._position_slot, self._scale, self._range = self._out[1], self._scales[0], self._limits[0]
        self._factor = self.rpdo.channels[self._position_slot].factor
        self.controlword = DISABLE_VOLTAGE
        self._sent_mode, self._sent_word, self._changed = 0, -1, True
        """Mode and controlword of the present outputs, and whether the drive's state has changed since."""
        self._was_enabled = False
        self._reset_calls = 0
        """Calls of `advance` since the fault reset bit was first set."""

    def supports(self, mode: int) -> bool:
        """Whether the process data has the channels of a mode (CSP, CSV, CST)."""
        outputs, inputs = _NEEDED[mode]
        return all(map(self.rpdo.find, outputs)) and all(map(self.tpdo.find, inputs))

    def decode(self, data: bytes) -> None:
        """Decode the inputs of the cycle (`input_bytes` long). Until the drive is enabled the target follows them."""
        values = self._unpack(data)
        status, position, velocity, torque, mode = self._in
        by_position, by_velocity, by_torque = self._in_factors
        word: int = values[status]
        if word != self.statusword:
            self.statusword = word
            self.state = _STATE_OF[word & STATE_BITS]
            self._changed = True
        drive_position = values[position] * by_position
        self.position = here = drive_position - self._zero
        self.velocity = values[velocity] * by_velocity if velocity >= 0 else self._measured_velocity(drive_position)
        if torque >= 0:
            self.torque = values[torque] * by_torque
        display: int = values[mode]
        if display != self.mode_display:
            self.mode_display = display
            self._changed = True
        if self._temperature_slot >= 0:
            self.temperature = values[self._temperature_slot] * self.tpdo.channels[self._temperature_slot].factor
        if self.controlword not in _WITH_TARGET:
            self.target_position = here

    def advance(self, target: TargetState) -> bool:
        """Choose the controlword of the next step towards `target` by the actual state; return whether it is there.

        It is called while the drive does not follow setpoints: the offsets become 0.
        """
        state, offsets = self.state, self.offsets
        if offsets is not None:
            offsets.clear()
        word = CONTROLWORDS[state, target]
        if word == ENABLE_OPERATION:
            # At the transition, and again if the drive left the state by itself; never while it is enabled.
            if self.controlword != ENABLE_OPERATION or (self._was_enabled and state is not _ENABLED):
                self.latch()
            self._was_enabled = state is _ENABLED
        elif word == FAULT_RESET:
            # A rising edge resets (CiA 402-2, transition 15), in some drives only a bit that stays set for some ms: set
            # it for a while, clear it for as long, then try again.
            pulse = ceil(self.reset_pulse_s / self.period_s - _EXACT)
            if self._reset_calls >= pulse:
                word = DISABLE_VOLTAGE
            self._reset_calls = (self._reset_calls + 1) % (2 * pulse)
        else:
            self._reset_calls = 0
        self.controlword = word
        return state in REACHED[target]

    def encode(self) -> bytes:
        """Return the outputs of the cycle.

        Velocity and torque are sent only to a drive that is enabled and commanded to be. The velocity (in CSP: the
        speed limit) is sent once the drive displays the commanded mode: in a change from CSV to CSP it would take the
        limit for a target velocity, and run. A drive that still displays CST ignores it, and needs it when it changes.
        The torque has no effect in CSP and CSV, is valid when CST begins, and stays until CST has ended.
        A target that is not finite leaves its field unchanged; one out of the field's range is clamped to it. A target
        inside the joint's range is rounded to a count inside the range, a velocity or a torque towards zero.
        """
        fields, at, word, commanded = self._fields, self._position_slot, self.controlword, self.mode
        counts = (self.target_position + self._zero) * self._scale
        low, high = self._range
        count = round(counts) if low <= counts <= high else self._counts(counts, 0, fields[at])
        sent = count * self._factor - self._zero
        if (sent > self.high + _EXACT or sent < self.low - _EXACT) and self.low <= self.target_position <= self.high:
            count += 1 if count < counts else -1
        fields[at] = count
        # In CSP only the position changes while the drive follows it.
        if commanded != CSP or self._changed or commanded != self._sent_mode or word != self._sent_word:
            self._sent_mode, self._sent_word, self._changed = commanded, word, False
            self._fill(fields, word, commanded)
        offsets = self.offsets
        if offsets is not None:
            shown = self.mode_display
            at_once = word != ENABLE_OPERATION or self.state is not _ENABLED or CST in (commanded, shown)
            follows = commanded in _WITH_SPEED and shown in _WITH_SPEED
            offsets.write(fields, follows and not at_once, at_once)
        return self._pack(*fields)

    def _fill(self, fields: list[int], word: int, commanded: int) -> None:
        """Fill in all outputs but the position."""
        control, _, velocity, torque, mode = self._out
        _, by_velocity, by_torque = self._scales
        fields[control] = word
        if mode >= 0:
            fields[mode] = commanded
        speed = effort = 0
        if word == ENABLE_OPERATION and self.state is _ENABLED:
            if commanded == CST:
                effort = self._counts(self.target_torque * by_torque, 2, fields[torque])
            elif self.mode_display == CST:
                effort = fields[torque]
            if commanded in _WITH_SPEED and self.mode_display in (commanded, CST):
                # A speed limit is positive even if joint and drive turn in opposite directions.
                wanted = abs(self.speed_limit * by_velocity) if commanded == CSP else self.target_velocity * by_velocity
                speed = self._counts(wanted, 1, fields[velocity])
        if velocity >= 0:
            fields[velocity] = speed
        if torque >= 0:
            fields[torque] = effort

    def _counts(self, value: float, index: int, last: int) -> int:
        low, high = self._limits[index]
        if low <= value <= high:
            return int(value + _EXACT if value > 0.0 else value - _EXACT)
        if value - value != 0.0:
            # NaN or infinite: keep the last counts.
            return last
        return low if value < low else high
