"""Refusals and events of the loop in words: what, where, found, allowed, and the key that sets it."""

from __future__ import annotations

from collections.abc import Callable

from rtcp.config.model import VIRTUAL, ArmConfig
from rtcp.ipc.machine import ALLOWED, TABLE, Code, Command, Refusal, State
from rtcp.ipc.motion_messages import motion_events, motion_refusals
from rtcp.ipc.naming import Matter, Naming, number
from rtcp.ipc.stops import Rung


class Sentences:
    """Words for codes.

    Args:
        config: names the joints and the file in which limits stand.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._config = config
        self._names = Naming(config)
        joint, slave, file, stop = self._names.joint, self._names.slave, self._names.file, self._names.stop
        ends = (Code.LEASE_ENDED, Code.NOT_PERMITTED)
        self.faults = FAULTS | {code for code in ends if self._names.rungs[code] is not Rung.CONTROLLED_STOP}
        """Events that are why the machine is in fault or in the emergency stop: what the ladder of stops adds, too."""
        self._refusals: dict[Refusal, Callable[[Matter], str]] = {
            Refusal.NOT_IN_THIS_STATE: self._not_in_this_state,
            Refusal.NO_LEASE: lambda _: "the lease has run out or is another commander's: nothing was moved",
            Refusal.POSITION_LIMIT: self._position_limit,
            Refusal.NOT_A_NUMBER: lambda m: f"{joint(m.axis)}: target {m.value} is not a finite number",
            Refusal.SPEED: lambda m: (
                f"speed {number(m.value)} rad/s is not allowed: more than 0 and at most {number(m.limit)} rad/s "
                f"(joints[].velocity in {file})"
            ),
            Refusal.MODE: lambda m: (
                f"mode {number(m.value)} is not one of csp (8), csv (9), cst (10)"
                if m.axis < 0
                else f"{joint(m.axis)}: its drive does not map what mode {number(m.value)} needs (`rpdo`, `tpdo`)"
            ),
            Refusal.OUTSIDE_LIMITS: self._outside_limits,
            Refusal.OUTPUT: lambda m: f"output {number(m.value)} does not exist: 1 to {number(m.limit)}",
            Refusal.OUTPUT_VALUE: lambda m: f"output {m.axis}: found {number(m.value)}, allowed is 0 or 1",
            Refusal.NO_OUTPUTS: lambda _: f"no IO box is configured (slaves in {file})",
            Refusal.UNKNOWN: lambda m: f"command {number(m.value)} is unknown to this loop",
            Refusal.NOT_IN_OP: lambda _: "not all slaves are in OP: see `rtcp status`, then `rtcp reset`",
            Refusal.SWITCHING: lambda _: "the drives are changing their mode: try again when they show it",
            Refusal.NOT_STILL: lambda m: (
                f"{joint(m.axis)} turns at {number(m.value)} rad/s: it is enabled at standstill only"
            ),
            Refusal.NO_PLAN: lambda m: (
                f"no trajectory of at most {number(m.limit)} s was found to that target at {number(m.value)} rad/s: "
                "choose a higher speed or a nearer target"
            ),
            Refusal.CLOCK: lambda _: "the cycle does not follow the reference clock yet (`rtcp status`, clocks)",
        }
        self._refusals |= motion_refusals(self._names)
        self._events: dict[int, Callable[[Matter], str]] = {
            Code.BUS_LOST: lambda m: (
                f"process data lost: {_lost(m)} the expected working counter "
                f"({self._lost_cycles()} in {file}): {stop(Code.BUS_LOST)}, `rtcp reset` goes on when the slaves answer"
            ),
            Code.DRIVE_LEFT_ENABLED: lambda m: (
                f"{joint(m.axis)}: the drive left Operation Enabled by itself (statusword 0x{int(m.value):04X}): "
                f"{stop(Code.DRIVE_LEFT_ENABLED)} of all others, `rtcp reset` goes on"
            ),
            Code.ENABLE_STUCK: lambda m: (
                f"{joint(m.axis)}: enabling stuck for {self._config.enable_timeout_s:g} s at statusword "
                f"0x{int(m.value):04X} (enable_timeout_s in {file})"
            ),
            Code.DISABLE_STUCK: lambda m: (
                f"{joint(m.axis)}: the drive did not give up its torque within "
                f"{self._config.enable_timeout_s:g} s (statusword 0x{int(m.value):04X}; enable_timeout_s in "
                f"{file})"
            ),
            Code.SLAVE_NOT_OP: lambda m: (
                f"slave {m.axis} ({slave(m.axis)}) left OP or does not answer: {stop(Code.SLAVE_NOT_OP)}, "
                "`rtcp reset` goes on when it is back"
            ),
            Code.RESET_STUCK: self._reset_stuck,
            Code.RESET_MOVING: lambda m: (
                f"{joint(m.axis)} still turns, at {number(m.value)} rad/s, 3 s after the reset was asked for: "
                "its torque goes only at standstill; `rtcp disable` takes it off at once"
            ),
            Code.HOMING_RUNNING: lambda m: (
                f"{joint(m.axis)} still turns, at {number(m.value)} rad/s, 3 s after its homing was over: "
                f"{stop(Code.HOMING_RUNNING)}, `rtcp reset` goes on"
            ),
            Code.GENERATOR: lambda _: (
                f"the trajectory generator refused its input: {stop(Code.GENERATOR)}, `rtcp reset` goes on"
            ),
            Code.DRIVE_FAULT: lambda m: (
                f"{joint(m.axis)}: the drive is in fault (statusword 0x{int(m.value):04X}): {stop(Code.DRIVE_FAULT)}, "
                "`rtcp reset` goes on"
            ),
            Code.CLOCK_LOST: lambda _: (
                f"the cycle has not followed the reference clock for 1 s: {stop(Code.CLOCK_LOST)}, `rtcp reset` goes on"
            ),
            Code.LEFT_RANGE: self._left_range,
            Code.POSITION_JUMPED: self._position_jumped,
            Code.STANDS_ELSEWHERE: lambda m: (
                f"{joint(m.axis)} stands at {number(m.value)} rad, at the fault it stood at {number(m.limit)} rad: "
                "where nobody moved it and it has not sunk, its drive has lost its zero: check that before "
                "`rtcp enable`"
            ),
            Code.TORQUE_OFF: lambda _: (
                "the drives are told to give up their torque; the fault stays until `rtcp reset`"
            ),
            Code.LEASE_ENDED: lambda _: (
                f"the commander fell silent or gave up its lease: {self._names.end(Code.LEASE_ENDED)}"
            ),
            Code.MODE_STUCK: lambda m: (
                f"{joint(m.axis)}: the drive shows mode {int(m.value)}, {int(m.limit)} was asked for"
            ),
            Code.READY: lambda _: "all slaves are in OP",
            Code.ENABLED: lambda _: "all drives are enabled, the arm holds",
            Code.DISABLED: lambda _: "all drives are disabled",
            Code.RESET: lambda _: "reset: the fault is gone, drives are disabled",
            Code.ARRIVED: lambda _: "the move has arrived",
            Code.BUTTON_UNHEARD: lambda m: (
                f"the IO box has been out of OP for {number(m.value)} s, and with it the emergency stop (inputs."
                f"emergency_stop in {file}) is not heard: it counts as pressed"
            ),
            Code.STOPPED: lambda _: "the arm has stopped and holds",
            Code.DC_LOCKED: lambda _: "the cycle follows the reference clock",
            Code.DC_UNLOCKED: lambda _: "the cycle has lost the reference clock's phase",
            Code.LED_BACK: lambda m: (
                f"{joint(m.axis)} stands {m.value:.2g} rad beyond its range ({self._key(m)}.position in {file}, or "
                f"`rtcp limits`): it is brought back to the edge at {number(m.limit)} rad/s"
            ),
        } | motion_events(self._names)

    @property
    def _file(self) -> str:
        return self._names.file

    def _key(self, matter: Matter) -> str:
        return self._names.key(matter.axis)

    def _joint(self, matter: Matter) -> str:
        return self._names.joint(matter.axis)

    def _lost_cycles(self) -> str:
        bus = self._config.bus
        widened = bus.interface == VIRTUAL and bus.timeout_scale != 1
        return f"bus.lost_cycles times bus.timeout_scale, {bus.timeout_scale:g}," if widened else "bus.lost_cycles"

    def _not_in_this_state(self, matter: Matter) -> str:
        command, state = Command(int(matter.value)), State(matter.axis)
        allowed = ", ".join(sorted(TABLE[other].words for other in ALLOWED[command]))
        way_out = ""
        if Command.RESET in TABLE[state].takes:
            way_out = "; `rtcp reset` first"
        elif state is State.READY and State.HOLDING in ALLOWED[command]:
            way_out = "; `rtcp enable` first"
        elif Command.DISABLE in TABLE[state].takes and ALLOWED[command] == {State.READY} and command != Command.ENABLE:
            way_out = "; `rtcp disable` first"
        return f"{command.name.lower()} is not possible while {TABLE[state].words}; it is while: {allowed}{way_out}"

    def _position_limit(self, matter: Matter) -> str:
        joint = self._config.axes[matter.axis]
        if matter.limit not in (joint.position.min, joint.position.max):
            narrowed = f"{number(matter.limit)} rad, to which its range is narrowed (`rtcp limits show`)"
            return f"{joint.name}: target {number(matter.value)} rad is beyond {narrowed}"
        return (
            f"{joint.name}: target {number(matter.value)} rad is outside its range "
            f"{joint.position.min:g} to {joint.position.max:g} rad ({self._key(matter)}.position in {self._file})"
        )

    def _outside_limits(self, matter: Matter) -> str:
        joint = self._config.axes[matter.axis]
        return (
            f"{joint.name} stands at {number(matter.value)} rad, outside its range {joint.position.min:g} to "
            f"{joint.position.max:g} rad ({self._key(matter)}.position in {self._file}): it is not enabled there"
        )

    def _left_range(self, matter: Matter) -> str:
        joint = self._config.axes[matter.axis]
        return (
            f"{joint.name} left its range of {joint.position.min:g} to {joint.position.max:g} rad while being "
            f"enabled or homed: it stands at {number(matter.value)} rad ({self._key(matter)}.position in {self._file})"
        )

    def _position_jumped(self, matter: Matter) -> str:
        return (
            f"{self._joint(matter)} was followed to {number(matter.limit)} rad while being enabled and is suddenly at "
            f"{number(matter.value)} rad, for {self._config.supervision.cycles} cycles (supervision.cycles in "
            f"{self._file}): it was turned, or its drive shows a false position; "
            f"{self._names.stop(Code.POSITION_JUMPED)}, let it stand, compare it with `rtcp status`; "
            "`rtcp reset` goes on"
        )

    def _reset_stuck(self, matter: Matter) -> str:
        if matter.axis < 0:
            if not matter.value:
                return (
                    "reset did not succeed within 3 s: not all slaves are back in OP (`rtcp status` shows which); mend "
                    "what keeps them, then `rtcp reset`"
                )
            return (
                "reset did not succeed within 3 s: frames do not come back, or the reference clock is not followed "
                "(`rtcp status`)"
            )
        return f"{self._joint(matter)}: the drive stays in fault after reset (statusword 0x{int(matter.value):04X})"

    def refusal(self, code: int, axis: int, value: float, limit: float) -> str:
        """Return the sentence for a refusal."""
        return self._refusals[Refusal(code)](Matter(axis, value, limit))

    def event(self, code: int, axis: int, value: float, limit: float) -> str:
        """Return the sentence for an event."""
        return self._events[code](Matter(axis, value, limit))


EMERGENCIES = frozenset({Code.PRESSED, Code.OVER_SPEED, Code.OVER_TORQUE, Code.FOLLOWING_ERROR})
"""Events that begin the emergency stop, also out of a fault."""

FAULTS = EMERGENCIES | frozenset(
    {
        Code.BUS_LOST,
        Code.DRIVE_LEFT_ENABLED,
        Code.ENABLE_STUCK,
        Code.DISABLE_STUCK,
        Code.SLAVE_NOT_OP,
        Code.RESET_STUCK,
        Code.RESET_MOVING,
        Code.HOMING_RUNNING,
        Code.GENERATOR,
        Code.MODE_STUCK,
        Code.DRIVE_FAULT,
        Code.CLOCK_LOST,
        Code.LEFT_RANGE,
        Code.POSITION_JUMPED,
    }
)
"""Events that are why the machine is in fault or in the emergency stop, whatever the ladder of stops says."""


def _lost(m: Matter) -> str:
    if m.value >= m.limit:
        return f"{number(m.value)} cycles in a row without"
    return f"{number(m.limit)} cycles more without than with"
