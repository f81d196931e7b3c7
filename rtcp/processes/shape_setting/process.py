"""The heater as a part of the cycle: interlocks first, then measuring, heating, holding, cooling; outputs last."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf, pi, sqrt
from typing import Any, Final

from rtcp.control.part import PartContext
from rtcp.control.processes import Process, ProcessSetup
from rtcp.ipc.commands import Command
from rtcp.ipc.events import Event
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.schema import Field
from rtcp.ipc.states import State
from rtcp.motion.step_group import Partner
from rtcp.processes.shape_setting import messages
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.control import CurrentControl, Ramp
from rtcp.processes.shape_setting.heat_balance import HeatBalance
from rtcp.processes.shape_setting.heat_profile import NITINOL, HeatProfile, heat_command
from rtcp.processes.shape_setting.interlocks import Interlocks, Mode, Row, first_row
from rtcp.processes.shape_setting.resistance import InitialResistance, ResistanceMeter
from rtcp.processes.shape_setting.supervision import Inputs, Supervision
from rtcp.processes.shape_setting.temperature import RatioScale

_AT_REST: Final = frozenset(
    {messages.HeaterState.OFF, messages.HeaterState.READY, messages.HeaterState.DONE, messages.HeaterState.TRIPPED}
)
_HEAT: Final = frozenset({messages.HeaterState.HEATING, messages.HeaterState.HOLDING})
_BUSY: Final = _HEAT | {messages.HeaterState.MEASURING, messages.HeaterState.COOLING}
_HOT: Final = _HEAT | {messages.HeaterState.COOLING}
_HALF: Final = 0.5
"""Threshold between the levels of a digital channel."""
_BELOW_K: Final = 20.0
"""A rod that seems colder than room and chucks by more than this, K, has a changed contact."""
_COOLED_K: Final = 10.0
"""Least rise over the initial temperature, K, at which a rod that was heated to a ratio counts as cool."""
_DEAD: Final = 1 << Row.LOST_CYCLE | 1 << Row.STALE_INPUT
_NO_AGE: Final = 9999.0
"""Age of a value that was never received, s; a record is also written as JSON, which has no infinity."""
_FIELDS: Final = (
    Field("state", "uint8", "", "What it is doing (HeaterState)."),
    Field("busy", "uint8", "", "1: it waits for its relay to close, measures, heats, holds or cools."),
    Field("mode", "uint8", "", "Position of the key: 0 Off, 1 Manual, 2 Auto."),
    Field("cause", "uint8", "", "Row of the interlocks that ended the last heating; 31: none."),
    Field("forbids", "uint32", "", "Rows that keep the relay from closing now, a bit each."),
    Field("latched", "uint32", "", "Rows that have latched, a bit each."),
    Field("gate", "uint8", "", "What the gate is commanded; 1: on."),
    Field("relay", "uint8", "", "What the relay is commanded; 1: closed."),
    Field("relay_closed", "uint8", "", "Mirror contact of the relay; 1: closed."),
    Field("gate_sense", "uint8", "", "Measured state of the gate; 1: on throughout the conversion."),
    Field("current", "float64", "A", "Measured current through the rod."),
    Field("inputs_alive", "uint8", "", "1: the inputs come, and their counters run; 0: they are old."),
    Field("rod_hot_s", "float64", "s", "Time for which the rod may be hot, and is not measured; 0: it is cold."),
    Field("resistance", "float64", "ohm", "Of the newest conversion with the gate on throughout."),
    Field("resistance_age", "float64", "s", "Its age; 9999: there is none."),
    Field("initial_resistance", "float64", "ohm", "Mean of the pulses; 0: not measured."),
    Field("initial_uncertainty", "float64", "ohm", "Its standard uncertainty."),
    Field("ratio", "float64", "", "Resistance by the initial one; 0: unknown."),
    Field("target_ratio", "float64", "", "Setpoint of the ratio."),
    Field("setpoint_middle", "float64", "C", "Setpoint of the temperature in the middle of the rod."),
    Field("mean_temperature", "float64", "C", "Estimate of the mean temperature."),
    Field("middle_temperature", "float64", "C", "Estimate of the temperature in the middle."),
    Field("least_middle", "float64", "C", "Least temperature in the middle by the measured power."),
    Field("most_middle", "float64", "C", "Greatest temperature in the middle by the measured power."),
    Field("middle_uncertainty", "float64", "K", "Standard uncertainty of the middle at the target."),
    Field("average_current", "float64", "A", "Exponential average."),
    Field("target_current", "float64", "A", "What the average is held at."),
    Field("energy", "float64", "J", "Into the rod since heating was started."),
)


class ShapeSetting(Process):
    """See `ShapeSettingConfig`."""

    def __init__(self, config: ShapeSettingConfig, setup: ProcessSetup) -> None:
        super().__init__(config, setup)
        self._config = config
        period_s = setup.period_s
        self._passed_s, self._before_ns = 0.0, 0
        """Time since the cycle before, s: longer than a period where ticks were skipped."""
        signals = setup.signals
        self._digital = [
            (name, signals[getattr(config, name)])
            for name in ("key_auto", "key_manual", "button_a", "button_b", "circuit_a", "circuit_b", "relay_closed",
                         "fuse_ok", "gate_sense")
        ]  # fmt: skip
        self._analog = [
            (name, signals[getattr(config, name)])
            for name in ("chassis_voltage", "battery_voltage", "voltage", "current", "sample", "alive")
        ]
        self._gate_output, self._relay_output = signals[config.gate], signals[config.relay]
        self._green, self._yellow = signals[config.lamp_green], signals[config.lamp_yellow]
        # An arm that the cell does not have counts as one that was never alive.
        arms = [setup.partners.get(name) or Partner(0) for name in config.arms]
        self.inputs = Inputs()
        self.interlocks = Interlocks()
        self.balance = HeatBalance()
        self.supervision = Supervision(config, period_s, arms, self.balance)
        self.meter = ResistanceMeter(period_s, config.short_resistance, config.open_resistance)
        self.initial = InitialResistance()
        self.control = CurrentControl(
            period_s, config.average_s, config.proportional, config.integral, config.derivative
        )  # fmt: skip
        self.ramp = Ramp()
        self.state = messages.HeaterState.OFF
        self._profile: messages.SetHeatProfile | None = None
        self._by_ratio: messages.SetTargetRatio | None = None
        """What takes the place of a profile: each measured rod gets its own by that."""
        self._closing = False
        """Whether a command waits for the relay to close."""
        self._goes_on = False
        """Whether a command goes on by itself: from the relay to the measurement, from there to the heat."""
        self._scale = RatioScale(0.0, 1.0, 0.0, 1.0)
        self.gate = False
        self.energy = self.uncertainty_k = 0.0
        self._lease = 0
        self._cooled_c = inf
        """Temperature to which the middle of the last rod has cooled, C; infinite: the rod is not said to be cold."""
        self._elapsed_s = self._pulse_s = self._hold_s = 0.0
        # A heating before this start is not known here.
        self._since_heat_s = 0.0
        """Time since the rod was, or may have been, heated, s."""
        self._wait_s = self._longest_wait_s = config.rod_cooling_s
        """Time after that heat before a rod is measured, s, and the longest: of a rod that was at its melting point."""
        self._pending: list[Event] = []
        """Events of commands and of `safe`; the next cycle reports them."""

    def fields(self) -> Sequence[Field]:
        """Return the fields of `_FIELDS`."""
        return _FIELDS

    # -- commands -----------------------------------------------------------------------------------------------------

    def accept(self, command: Command, lease: int) -> Refusal | None:
        """Carry out a command, or return why not."""
        if isinstance(command, messages.StopHeating):
            return self._stop()
        if isinstance(command, messages.ResetTrips):
            return self._reset_trips()
        if isinstance(command, messages.SetHeatProfile):
            refusal = self._set_profile(command)
            if refusal is None:
                self._by_ratio = None
            return refusal
        if isinstance(command, messages.SetTargetRatio):
            return self._set_ratio(command)
        if isinstance(command, messages.ArmHeater):
            return self._arm()
        if isinstance(command, messages.HeatRod):
            return self._heat_rod(command, lease)
        if self.state is not messages.HeaterState.ARMED:
            return messages.WrongHeaterState(self.state, messages.HeaterState.ARMED)
        if isinstance(command, messages.MeasureResistance):
            return self._measure(command, lease)
        return self._start(lease)

    def _stop(self) -> Refusal | None:
        self.safe()
        return None

    def _reset_trips(self) -> Refusal | None:
        was, remains = self.interlocks.latched, self.interlocks.reset(self.supervision.holds)
        if remains:
            return messages.CauseRemains(first_row(remains))
        if was:
            self._pending.append(messages.TripsReset())
        return None

    def _set_profile(self, command: messages.SetHeatProfile) -> Refusal | None:
        if self.state not in _AT_REST and self.state is not messages.HeaterState.ARMED:
            return messages.WrongHeaterState(self.state, messages.HeaterState.ARMED)
        config = self._config
        greatest_of = {
            messages.ProfileKey.TARGET_C: config.greatest_target_c,
            messages.ProfileKey.HOLD_S: config.longest_s,
        }
        for key, (least, most) in messages.PROFILE_RANGES.items():
            value, greatest = getattr(command, key.name.lower()), min(most, greatest_of.get(key, most))
            if not least <= value <= greatest:
                return messages.ProfileNumberOutOfRange(key, value, least, greatest)
        ramp_s = (command.target_c - command.initial_c) / command.ramp_k_s
        if not command.hold_s + ramp_s <= config.longest_s:
            return messages.ProfileNumberOutOfRange(
                messages.ProfileKey.HOLD_S, command.hold_s, 0.0, max(config.longest_s - ramp_s, 0.0)
            )
        if not command.chuck_c < command.target_c:
            least, _ = messages.PROFILE_RANGES[messages.ProfileKey.CHUCK_C]
            return messages.ProfileNumberOutOfRange(
                messages.ProfileKey.CHUCK_C, command.chuck_c, least, command.target_c
            )  # fmt: skip
        if not command.initial_c < command.cool_c < command.target_c:
            return messages.CoolingOutOfRange(command.cool_c, command.initial_c, command.target_c)
        scale = RatioScale(
            command.initial_c, command.kelvin_per_ratio, command.chuck_c, command.mean_by_middle
        )  # fmt: skip
        self._profile, self._scale = command, scale
        is_first = not self.balance.is_known
        self.balance.set_rod(
            command.initial_c, command.chuck_c, command.target_c, command.heat_capacity, command.convected,
            command.radiated, command.tolerance,
        )  # fmt: skip
        self.supervision.set_rod(scale, command.target_c)
        self._longest_wait_s = min(config.rod_cooling_s, self.balance.longest_cooling_s)
        if is_first:  # the rod that may have been hot before is this one, or another one that is cold
            self._wait_s = min(self._wait_s, self._longest_wait_s)
        return None

    def _set_ratio(self, command: messages.SetTargetRatio) -> Refusal | None:
        if self.state not in _AT_REST and self.state is not messages.HeaterState.ARMED:
            return messages.WrongHeaterState(self.state, messages.HeaterState.ARMED)
        length = command.length or self._config.rod_length
        command = messages.SetTargetRatio(command.target_ratio, command.hold_s, length, command.initial_c)
        ramp_s = (self._config.greatest_target_c - command.initial_c) / HeatProfile.ramp_k_s
        longest_hold_s = max(self._config.longest_s - ramp_s, 0.0)
        for key, (least, most) in messages.RATIO_RANGES.items():
            value, greatest = getattr(command, key.name.lower()), min(most, longest_hold_s)
            if key is not messages.RatioKey.HOLD_S:
                greatest = most
            if not least <= value <= greatest:
                return messages.RatioNumberOutOfRange(key, value, least, greatest)
        self._by_ratio = command
        return None

    def _size_rod(self, wanted: messages.SetTargetRatio) -> Refusal | None:
        """Make the profile of the measured rod: its resistance and its length show its diameter (equation 4.1)."""
        resistance = self.initial.value
        diameter = sqrt(4.0 * NITINOL.resistivity(wanted.initial_c) * wanted.length / (pi * resistance))
        profile = HeatProfile(
            target_ratio=wanted.target_ratio, hold_s=wanted.hold_s, initial_c=wanted.initial_c,
            chuck_c=wanted.initial_c, cool_c=max(HeatProfile.cool_c, wanted.initial_c + _COOLED_K),
        ).of_rod(wanted.length, diameter)  # fmt: skip
        thin, thick = messages.ROD_DIAMETERS
        if not thin <= diameter <= thick or self._set_profile(heat_command(profile)) is not None:
            least, _ = messages.PROFILE_RANGES[messages.ProfileKey.TARGET_C]
            return messages.RodUnfit(
                resistance, 1e3 * diameter, profile.target_c, least, self._config.greatest_target_c
            )  # fmt: skip
        # The pulses before were balanced without this rod; they are worth some kelvin.
        self.balance.begin()
        self._pending.append(messages.RodSized(1e3 * diameter, profile.target_c))
        return None

    def _heat_rod(self, command: messages.HeatRod, lease: int) -> Refusal | None:
        """Arm; the cycle goes on with the measurement and the heat."""
        if self._profile is None and self._by_ratio is None:
            return messages.NoHeatProfile()
        if (
            refusal := self._unfit_to_measure(command.straight_and_unloaded, command.phase, command.is_cold)
            or self._arm()
        ):
            return refusal
        self._goes_on, self._lease = True, lease
        return None

    def _unfit_to_measure(self, is_free: bool, phase: messages.RodPhase, is_cold: bool) -> Refusal | None:
        if not is_free or phase is not messages.RodPhase.AUSTENITE:
            return messages.RodNotConfirmed(phase)
        if (hot_s := self._hot_s()) and not is_cold:
            return messages.RodStillHot(self._since_heat_s, self._since_heat_s + hot_s)
        return None

    def _hot_s(self) -> float:
        """Return for how long the rod may still be hot, s."""
        return max(self._wait_s - self._since_heat_s, 0.0)

    def _arm(self) -> Refusal | None:
        interlocks, config = self.interlocks, self._config
        if interlocks.latched:
            return messages.TripLatched(first_row(interlocks.latched))
        if self.state not in _AT_REST:
            return messages.WrongHeaterState(self.state, messages.HeaterState.READY)
        holds = self.supervision.holds
        if self.inputs.relay_closed:
            return messages.HeatForbidden(Row.RELAY_FEEDBACK, interlocks.mode)
        if not interlocks.close(holds):
            return messages.HeatForbidden(first_row(interlocks.forbids(holds)), interlocks.mode)
        voltage = self.inputs.battery_voltage
        if voltage < config.least_battery_voltage:
            interlocks.open()
            return messages.BatteryLow(voltage, config.least_battery_voltage)
        self.state, self._elapsed_s = messages.HeaterState.ARMED, 0.0
        self._closing = True
        self.control.reset()
        self._pending.append(messages.HeaterArmed(interlocks.mode))
        return None

    def _measure(self, command: messages.MeasureResistance, lease: int) -> Refusal | None:
        if refusal := self._unfit_to_measure(command.straight_and_unloaded, command.phase, command.is_cold):
            return refusal
        if not self.inputs.relay_closed:
            return messages.HeatForbidden(Row.RELAY_FEEDBACK, self.interlocks.mode)
        self._begin_pulses(lease)
        return None

    def _begin_pulses(self, lease: int) -> None:
        self.initial.begin()
        self.balance.begin()
        if self._by_ratio is not None:
            # Another rod: what is known of the one before does not hold.
            self._profile = None
            self.balance.forget_rod()
        self._cooled_c = inf
        # The rod in the chucks counts as cold now.
        self._pulse_s, self._lease, self._wait_s = 0.0, lease, 0.0
        self.state = messages.HeaterState.MEASURING

    def _start(self, lease: int) -> Refusal | None:
        if self._profile is None and self._by_ratio is None:
            return messages.NoHeatProfile()
        if not self.initial.value:
            return messages.ResistanceNotMeasured()
        if not self.inputs.relay_closed:
            return messages.HeatForbidden(Row.RELAY_FEEDBACK, self.interlocks.mode)
        if self._by_ratio is not None and (refusal := self._size_rod(self._by_ratio)):
            return refusal
        profile = self._profile
        assert profile is not None
        measured = profile.kelvin_per_ratio / profile.mean_by_middle * self.initial.uncertainty / self.initial.value
        self.uncertainty_k = hypot(profile.uncertainty_k, measured)
        self.ramp.begin(self._scale.middle(1.0), profile.target_c, profile.ramp_k_s)
        self.control.reset()
        self.energy = self._elapsed_s = 0.0
        self._lease = lease
        self.state = messages.HeaterState.HEATING
        self._pending.append(messages.HeatingStarted(profile.target_c, self._scale.ratio_for_middle(profile.target_c)))
        return None

    # -- the cycle ----------------------------------------------------------------------------------------------------

    @property
    def ratio(self) -> float:
        """Resistance by the initial one; 0: unknown."""
        return self.meter.resistance / self.initial.value if self.initial.value else 0.0

    def update(self, context: PartContext) -> None:
        """Do a cycle."""
        # Powered, in every state: a fault does not disconnect the battery.
        self._green.value = 1.0
        if context.state is State.STARTING:
            # The inputs are not valid yet.
            self._open()
            return
        now_ns = context.now_ns
        self._passed_s = 1e-9 * (now_ns - self._before_ns) if self._before_ns else context.period_s
        self._before_ns = now_ns
        self._read()
        self._since_heat_s += self._passed_s
        if self.state in _HOT:
            self._note_heat()
        inputs, interlocks, meter = self.inputs, self.interlocks, self.meter
        power = inputs.voltage * inputs.current
        # In the first cycle without inputs the gate is still on.
        self.balance.update(power if context.good or self.gate else 0.0, self._passed_s)
        meter.update(inputs.voltage, inputs.current, inputs.sample, inputs.gate_sense)
        holds = self.supervision.update(
            inputs, meter, self.initial.value, context, self._lease, interlocks.closed, self.gate
        )  # fmt: skip
        latched = interlocks.latched
        if holds & 1 << Row.GATE_FEEDBACK:
            # Whatever was commanded, a current may heat the rod.
            self._note_heat()
        if interlocks.update(inputs.mode, holds):
            self._report_cause(context, interlocks.latched & ~latched)
            self._open()
        for event in self._pending:
            context.report(event)
        self._pending.clear()
        self.control.measure(inputs.current)
        if context.good and self.state in _BUSY:
            self.energy += power * self._passed_s
        self._watch_cold_rod(context)
        if not interlocks.closed:
            self._rest()
        else:
            self._work(context)
        self._write(context)

    def _watch_cold_rod(self, context: PartContext) -> None:
        """Report a rod that becomes hot after it was said to be cold."""
        if self.balance.most_c > self._cooled_c + self._config.excess_temperature:
            context.report(messages.RodHotAgain(self.balance.most_c, self._cooled_c))
            self._open()
            self._note_heat()
            self._cooled_c = inf

    def _note_heat(self) -> None:
        """Count the time from now on: the rod is, or may be, heated."""
        self._since_heat_s, self._wait_s = 0.0, self._longest_wait_s

    def _read(self) -> None:
        inputs = self.inputs
        for name, signal in self._digital:
            setattr(inputs, name, signal.value > _HALF)
        for name, signal in self._analog:
            setattr(inputs, name, signal.value)

    def _report_cause(self, context: PartContext, latches: int) -> None:
        row, supervision = self.interlocks.cause, self.supervision
        if latches:
            context.report(messages.HeaterTripped(row, supervision.values[row], supervision.limits[row]))
        else:
            context.report(messages.HeatEnded(row, self.interlocks.mode))

    def _rest(self) -> None:
        """Show why the relay is open."""
        mode = self.interlocks.mode
        if mode is Mode.OFF:
            # With the key out the rod may be changed.
            self.initial.forget()
        if self.interlocks.latched:
            # Contacts, wires or the rod itself may have changed.
            self.initial.forget()
            self.state = messages.HeaterState.TRIPPED
        elif mode is Mode.OFF:
            self.state = messages.HeaterState.OFF
        elif self.state is not messages.HeaterState.DONE:
            self.state = messages.HeaterState.READY

    def _work(self, context: PartContext) -> None:
        """Decide on the gate for this cycle."""
        if self.state is messages.HeaterState.ARMED:
            self._wait(context)
        elif self.state is messages.HeaterState.MEASURING:
            self._pulse(context)
        elif self.state is messages.HeaterState.COOLING:
            self._cool(context)
        else:
            self._heat(context)

    def _wait(self, context: PartContext) -> None:
        """Open a relay that is not used: no commander supervises an armed heater."""
        if self._closing and self.inputs.relay_closed:
            self._closing = False
            if self._goes_on:
                self._begin_pulses(self._lease)
                return
        self._elapsed_s += self._passed_s
        if self._elapsed_s > self._config.armed_s:
            context.report(messages.ArmedTooLong(self._config.armed_s))
            self._open()

    def _pulse(self, context: PartContext) -> None:
        """Do a cycle of the pulses: the gate is on until a conversion with the gate on throughout has come."""
        initial, config = self.initial, self._config
        self._pulse_s += self._passed_s
        if self.gate and self.meter.fresh:
            initial.add(self.meter.resistance)
            self.gate, self._pulse_s = False, 0.0
            if initial.pulses == config.pulses:
                initial.finish()
                lease, goes_on, self._goes_on = self._lease, self._goes_on, False
                self.state, self._lease, self._elapsed_s = messages.HeaterState.ARMED, 0, 0.0
                if initial.uncertainty > config.greatest_initial_uncertainty * initial.value:
                    percent, limit = initial.uncertainty / initial.value, config.greatest_initial_uncertainty
                    context.report(messages.ResistanceUncertain(initial.value, 100.0 * percent, 100.0 * limit))
                    initial.forget()
                    if goes_on:
                        self._open()
                else:
                    context.report(messages.ResistanceMeasured(initial.value, initial.uncertainty, initial.pulses))
                    if goes_on:
                        self._go_on(context, lease)
        elif self._pulse_s >= config.pulse_interval_s or not initial.pulses:
            self.gate = True

    def _go_on(self, context: PartContext, lease: int) -> None:
        """Heat the rod that was just measured, or report why not and open the relay."""
        refusal = self._start(lease)
        if refusal is not None:
            # The relay is closed, and profile and resistance are there: only the rod itself can be refused.
            assert isinstance(refusal, messages.RodUnfit)
            context.report(
                messages.RodRejected(
                    refusal.resistance, refusal.diameter_mm, refusal.target_c, refusal.least_c, refusal.greatest_c
                )
            )
            self._open()

    def _heat(self, context: PartContext) -> None:
        config, meter, control, profile, scale = self._config, self.meter, self.control, self._profile, self._scale
        assert profile is not None
        middle = scale.middle(self.ratio)
        reached = self.ramp.update(middle, self._passed_s)
        self._elapsed_s += self._passed_s
        if meter.voltage:
            limit = min(profile.max_current, profile.max_power / meter.voltage)
            setpoint = scale.ratio_for_middle(self.ramp.setpoint_c)
            control.update(setpoint, self.ratio, meter.current, limit)
        self.gate = control.gate or meter.age_s >= config.sense_interval_s
        if self.state is messages.HeaterState.HEATING and reached:
            self.state, self._hold_s = messages.HeaterState.HOLDING, 0.0
            context.report(messages.HoldBegun(middle, profile.hold_s))
        elif self.state is messages.HeaterState.HOLDING:
            self._hold_s += self._passed_s
            if self._hold_s >= profile.hold_s:
                self.state, self.gate, self._hold_s = messages.HeaterState.COOLING, False, 0.0
                control.reset()
                context.report(messages.CoolingBegun(self.energy))
                return
        if self._elapsed_s > config.longest_s:
            context.report(messages.TargetNotReached(middle, config.longest_s))
            self._open()

    def _cool(self, context: PartContext) -> None:
        assert self._profile is not None
        self.gate = self.meter.age_s >= self._config.cooling_interval_s
        middle = self._scale.middle(self.ratio)
        self._hold_s += self._passed_s
        least = min(self._profile.initial_c, self._profile.chuck_c) - _BELOW_K
        is_cool = self.balance.most_c <= self._profile.cool_c + self._config.excess_temperature
        if self.meter.fresh and is_cool and least <= middle <= self._profile.cool_c:
            context.report(messages.ShapeSet(middle))
            self._open()
            # The rod is removed now: the next one is measured again.
            self.initial.forget()
            self.state = messages.HeaterState.DONE
            self._cooled_c = self._profile.cool_c
            self._since_heat_s = self._hold_s
            # Both thermometers have followed this rod until it was cool.
            self._wait_s = min(self._wait_s, self._hold_s + self.balance.time_to_cold())
        elif self._hold_s > self._config.longest_cooling_s:
            context.report(messages.CoolingTooLong(middle, self._config.longest_cooling_s))
            self._open()

    def _write(self, context: PartContext) -> None:
        closed = self.interlocks.closed
        # The one place where anything is turned on: the walk of the table in this cycle has permitted it.
        self.gate = self.gate and closed and self.inputs.relay_closed and context.good
        self._relay_output.value = float(closed)
        self._gate_output.value = float(self.gate)
        self._yellow.value = float(closed)

    def safe(self) -> None:
        """Turn gate and relay off; they stay off until the heater is armed again."""
        if self.interlocks.closed:
            self._pending.append(messages.HeatStopped())
        self._open()

    def _open(self) -> None:
        self.interlocks.open()
        self.gate = self._closing = self._goes_on = False
        self._lease = 0
        self._relay_output.value = self._gate_output.value = self._yellow.value = 0.0
        self.control.reset()
        self.meter.forget()
        self.supervision.forget_gradient()
        if self.state not in _AT_REST:
            self.state = messages.HeaterState.READY

    def publish(self, values: list[Any], at: int) -> None:
        """Write the values of `_FIELDS`."""
        interlocks, meter, initial, control = self.interlocks, self.meter, self.initial, self.control
        inputs = self.inputs
        ratio, scale = self.ratio, self._scale
        values[at : at + len(_FIELDS)] = (
            self.state, self._closing or self.state in _BUSY, interlocks.mode, interlocks.cause,
            interlocks.forbids(self.supervision.holds), interlocks.latched,
            self.gate, interlocks.closed, inputs.relay_closed, inputs.gate_sense, inputs.current,
            self._before_ns > 0 and not self.supervision.holds & _DEAD,
            self._hot_s(),
            meter.resistance, min(meter.age_s, _NO_AGE), initial.value, initial.uncertainty,
            ratio, scale.ratio_for_middle(self.ramp.setpoint_c), self.ramp.setpoint_c,
            scale.mean(ratio) if ratio else 0.0, scale.middle(ratio) if ratio else 0.0,
            self.balance.least_c, self.balance.most_c, self.uncertainty_k, control.average, control.target, self.energy,
        )  # fmt: skip
