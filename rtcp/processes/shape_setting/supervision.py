"""From the inputs of a cycle to the rows of the interlocks: which statement of the table is true."""

from __future__ import annotations

from typing import Final

from rtcp.control.part import PartContext
from rtcp.ipc.states import State
from rtcp.motion.step_group import Partner
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_balance import HeatBalance
from rtcp.processes.shape_setting.interlocks import TABLE, Mode, Row
from rtcp.processes.shape_setting.resistance import ResistanceMeter
from rtcp.processes.shape_setting.temperature import RatioScale

_PLATFORM: Final = frozenset({State.HOLDING, State.MOVING})
"""States with enabled drives: every emergency stop, also a partner's, every fault and `rtcp disable` leave them."""

_COOLING: Final = 0.06
"""Greatest fall of the ratio of a rod that cools, 1/s: twice that of the virtual one of 0.5 mm at 500 C."""
_STEP: Final = 0.01
"""Fall of the ratio that is accepted at once: noise and contacts."""


class Inputs:
    """The inputs of the control box in one cycle; digital ones as booleans."""

    def __init__(self) -> None:
        self.key_auto = self.key_manual = False
        self.button_a = self.button_b = False
        self.circuit_a = self.circuit_b = False
        self.relay_closed = self.fuse_ok = self.gate_sense = False
        self.chassis_voltage = self.battery_voltage = 0.0
        self.voltage = self.current = 0.0
        self.sample = self.alive = -1.0

    @property
    def mode(self) -> Mode:
        """The position of the key; Off while it is at both others."""
        if self.key_auto is self.key_manual:
            return Mode.OFF
        return Mode.AUTO if self.key_auto else Mode.MANUAL


class Steadiness:
    """Counts the cycles for which a condition has been true."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.cycles = 0

    def exceeds(self, is_true: bool) -> bool:
        """Count a cycle; return whether it has been true for longer than the limit."""
        self.cycles = self.cycles + 1 if is_true else 0
        return self.cycles > self.limit


class Feedback:
    """Compares a command with its feedback, which has its time after a change; then a difference counts at once."""

    def __init__(self, on_cycles: float, off_cycles: float) -> None:
        self._cycles = (off_cycles, on_cycles)
        self._command = False
        self.waited = 0
        """Cycles since the command has changed."""

    def follow(self, command: bool) -> None:
        """Note a command of a cycle whose feedback is missing: later feedback may still answer it."""
        if command is not self._command:
            self._command, self.waited = command, 0

    def differs(self, command: bool, feedback: bool) -> bool:
        """Count a cycle; return whether the feedback differs from the command after its time."""
        self.follow(command)
        self.waited += 1
        return feedback is not command and self.waited > self._cycles[command]


class Supervision:
    """Decides in each cycle which rows hold.

    Args:
        config: limits and times.
        period_s: the cycle, s.
        arms: the newest records of the arms that have to be engaged.
        balance: heat balance of the rod.
    """

    def __init__(
        self, config: ShapeSettingConfig, period_s: float, arms: list[Partner], balance: HeatBalance
    ) -> None:  # fmt: skip
        self._config, self._arms, self._balance = config, arms, balance
        self._scale = RatioScale(0.0, 1.0, 0.0, 1.0)
        self._silence_ns = round(config.arm_silence_s * 1e9)
        discrepancy = config.discrepancy_s / period_s
        self._key, self._button, self._circuit = (Steadiness(discrepancy) for _ in range(3))
        self._sample, self._alive = (Steadiness(config.stale_cycles - 1) for _ in range(2))
        self._lost = Steadiness(config.lost_cycles - 1)
        self._last_sample = self._last_alive = -1.0
        self._relay = Feedback(config.relay_close_s / period_s, config.relay_open_s / period_s)
        self._gate, self._leakage = (Feedback(config.gate_cycles, config.gate_cycles) for _ in range(2))
        self._gradient_s = config.gradient_s
        self._anchor = self._anchor_age_s = 0.0
        self._period_s = period_s
        self.holds = 0
        """Rows whose statement is true, a bit each."""
        self.values = [0.0] * len(TABLE)
        """Value that a row was judged by, in the unit of its limit."""
        self.limits = [1.0] * len(TABLE)
        for row in (Row.KEY_DISCREPANCY, Row.BUTTON_DISCREPANCY, Row.CIRCUIT_DISCREPANCY):
            self.limits[row] = config.discrepancy_s
        self.limits[Row.ARM_LOST] = config.arm_silence_s
        self.limits[Row.RELAY_FEEDBACK] = max(config.relay_close_s, config.relay_open_s)
        self._gate_s = self.limits[Row.GATE_FEEDBACK] = config.gate_cycles * period_s
        self.limits[Row.OVER_CURRENT] = config.over_current
        self.limits[Row.OVER_VOLTAGE] = config.over_voltage
        self.limits[Row.OPEN_CIRCUIT], self.limits[Row.SHORT_CIRCUIT] = config.open_resistance, config.short_resistance
        self.limits[Row.STEEP_GRADIENT] = config.greatest_gradient
        self.limits[Row.INSULATION] = config.least_chassis_voltage
        self.limits[Row.LOST_CYCLE] = config.lost_cycles - 1
        self.limits[Row.STALE_INPUT] = config.stale_cycles * period_s

    def set_rod(self, scale: RatioScale, target_c: float) -> None:
        """Set the temperatures by the resistance, and the target, C."""
        self._scale = scale
        self.limits[Row.EXCESS_HEAT] = target_c + self._config.excess_temperature

    def forget_gradient(self) -> None:
        """Restart the gradient: the circuit was opened."""
        self._anchor = 0.0

    def update(
        self,
        inputs: Inputs,
        meter: ResistanceMeter,
        initial: float,
        context: PartContext,
        lease: int,
        relay: bool,
        gate: bool,
    ) -> int:
        """Judge a cycle; return the rows whose statement is true, a bit each.

        Args:
            inputs: of the cycle.
            meter: resistance of the cycle.
            initial: resistance, ohm; 0: not measured.
            context: of the cycle.
            lease: of who commanded pulses or heat; 0: there are none.
            relay: last command of the relay.
            gate: last command of the gate.
        """
        config, values, good = self._config, self.values, context.good
        holds = 0
        if inputs.mode is not Mode.OFF:
            holds |= 1 << Row.KEY
        if inputs.button_a and inputs.button_b:
            holds |= 1 << Row.BUTTON
        if inputs.circuit_a and inputs.circuit_b:
            holds |= 1 << Row.ROBOT_CIRCUIT
        if context.state in _PLATFORM:
            holds |= 1 << Row.PLATFORM
        if not lease or context.lease_held(lease):
            holds |= 1 << Row.COMMANDER
        holds |= self._judge_arms(context.now_ns)
        values[Row.EXCESS_HEAT] = self._balance.most_c
        if self._balance.is_known and not values[Row.EXCESS_HEAT] <= self.limits[Row.EXCESS_HEAT]:
            holds |= 1 << Row.EXCESS_HEAT
        values[Row.FUSE] = float(inputs.fuse_ok)
        if inputs.fuse_ok:
            holds |= 1 << Row.FUSE
        is_lost = self._lost.exceeds(not good)
        values[Row.LOST_CYCLE] = float(self._lost.cycles)
        if not good:
            # Inputs are those of an earlier cycle: timers stand still.
            self._relay.follow(relay)
            self._gate.follow(gate)
            self._leakage.follow(gate)
            return self._finish(holds | is_lost << Row.LOST_CYCLE | self.holds & _TIMED)
        for row, steadiness, differ in (
            (Row.KEY_DISCREPANCY, self._key, inputs.key_auto and inputs.key_manual),
            (Row.BUTTON_DISCREPANCY, self._button, inputs.button_a is not inputs.button_b),
            (Row.CIRCUIT_DISCREPANCY, self._circuit, inputs.circuit_a is not inputs.circuit_b),
        ):
            if steadiness.exceeds(differ):
                holds |= 1 << row
            values[row] = steadiness.cycles * self._period_s
        if self._relay.differs(relay, inputs.relay_closed):
            holds |= 1 << Row.RELAY_FEEDBACK
        values[Row.RELAY_FEEDBACK] = self._relay.waited * self._period_s
        leaks = not abs(inputs.current) <= config.leakage_current
        if self._gate.differs(gate, inputs.gate_sense) | self._leakage.differs(gate, gate or leaks):
            holds |= 1 << Row.GATE_FEEDBACK
        waited, limits = self._gate.waited * self._period_s, self.limits
        values[Row.GATE_FEEDBACK], limits[Row.GATE_FEEDBACK] = waited, self._gate_s
        if leaks and not gate:
            values[Row.GATE_FEEDBACK], limits[Row.GATE_FEEDBACK] = abs(inputs.current), config.leakage_current
        is_stale = self._sample.exceeds(inputs.sample == self._last_sample)
        is_stale |= self._alive.exceeds(inputs.alive == self._last_alive)
        self._last_sample, self._last_alive = inputs.sample, inputs.alive
        values[Row.STALE_INPUT] = max(self._sample.cycles, self._alive.cycles) * self._period_s
        if is_stale:
            holds |= 1 << Row.STALE_INPUT
        values[Row.OVER_CURRENT] = abs(inputs.current)
        if not values[Row.OVER_CURRENT] <= config.over_current:
            holds |= 1 << Row.OVER_CURRENT
        values[Row.OVER_VOLTAGE] = max(abs(inputs.voltage), inputs.battery_voltage)
        if not values[Row.OVER_VOLTAGE] <= config.over_voltage:
            holds |= 1 << Row.OVER_VOLTAGE
        values[Row.INSULATION] = inputs.chassis_voltage
        is_low = inputs.chassis_voltage < config.least_chassis_voltage
        limits[Row.INSULATION] = config.least_chassis_voltage if is_low else config.greatest_chassis_voltage
        if config.least_chassis_voltage <= inputs.chassis_voltage <= config.greatest_chassis_voltage:
            holds |= 1 << Row.INSULATION
        return self._finish(holds | self._judge_resistance(meter, initial))

    def _finish(self, holds: int) -> int:
        self.holds = holds
        return holds

    def _judge_arms(self, now_ns: int) -> int:
        permitted = engaged = True
        oldest_ns = 0
        for arm in self._arms:
            permitted = permitted and arm.motion_allowed
            engaged = engaged and arm.state is State.HOLDING and not arm.emergency_stop
            oldest_ns = max(oldest_ns, now_ns - arm.time_ns)
        self.values[Row.ARM_LOST] = oldest_ns * 1e-9
        lost = oldest_ns > self._silence_ns
        return permitted << Row.ARMS_PERMITTED | engaged << Row.ARMS_ENGAGED | lost << Row.ARM_LOST

    def _judge_resistance(self, meter: ResistanceMeter, initial: float) -> int:
        config, values, holds = self._config, self.values, 0
        self._anchor_age_s += self._period_s
        if meter.is_open:
            values[Row.OPEN_CIRCUIT], holds = meter.seen, holds | 1 << Row.OPEN_CIRCUIT
        if meter.is_short:
            values[Row.SHORT_CIRCUIT], holds = meter.seen, holds | 1 << Row.SHORT_CIRCUIT
        if not meter.fresh:
            return holds
        if initial and self._balance.is_known:
            # The mean is below the middle by the cold ends. It is not below in a rod whose ends are not cold yet.
            scale, balance, tolerance = self._scale, self._balance, config.temperature_tolerance
            mean = scale.mean(meter.resistance / initial)
            least = scale.mean_of_middle(balance.least_c) - tolerance
            most = balance.most_c + tolerance
            values[Row.IMPLAUSIBLE_TEMPERATURE] = mean
            self.limits[Row.IMPLAUSIBLE_TEMPERATURE] = least if mean < least else most
            if not least <= mean <= most:
                holds |= 1 << Row.IMPLAUSIBLE_TEMPERATURE
        if self._anchor:
            # At once on a step, which is a contact that moves; over `gradient_s` on a slope, above the noise.
            change, limit = meter.resistance / self._anchor - 1.0, config.greatest_gradient
            span_s = max(self._anchor_age_s, self._gradient_s)
            if change < 0.0:
                # Also after a pause, in which a step would pass for a slope: no rod cools faster.
                limit = min(limit, (_COOLING * span_s + _STEP) / span_s)
            values[Row.STEEP_GRADIENT], self.limits[Row.STEEP_GRADIENT] = abs(change) / span_s, limit
            if values[Row.STEEP_GRADIENT] > limit:
                holds |= 1 << Row.STEEP_GRADIENT
        if not self._anchor or self._anchor_age_s >= self._gradient_s:
            self._anchor, self._anchor_age_s = meter.resistance, 0.0
        return holds


_TIMED: Final = sum(
    1 << row
    for row in (
        Row.KEY_DISCREPANCY, Row.BUTTON_DISCREPANCY, Row.CIRCUIT_DISCREPANCY, Row.RELAY_FEEDBACK, Row.GATE_FEEDBACK,
        Row.OVER_CURRENT, Row.OVER_VOLTAGE, Row.INSULATION, Row.STALE_INPUT,
    )
)  # fmt: skip
"""Rows that stay as they were while the inputs are missing."""
