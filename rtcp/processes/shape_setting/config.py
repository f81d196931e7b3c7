"""Keys of the process `shape_setting`. Imports nothing heavy: the loop holds these objects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Annotated

from annotated_types import Ge, Gt, Le

from rtcp.config.findings import Finding
from rtcp.config.model import DeviceDescription, InputChannel, OutputChannel, ProcessConfig
from rtcp.config.numbers import Name, NotNegative, Positive
from rtcp.processes.shape_setting.messages import (
    ArmHeater,
    HeaterState,
    HeatRod,
    MeasureResistance,
    ResetTrips,
    SetHeatProfile,
    SetTargetRatio,
    StartHeating,
    StopHeating,
)

_ANALOG = ("voltage", "current", "sample", "chassis_voltage", "battery_voltage", "alive")
_DIGITAL = (
    "gate_sense", "key_auto", "key_manual", "button_a", "button_b", "circuit_a", "circuit_b", "relay_closed", "fuse_ok",
    "gate", "relay", "lamp_green", "lamp_yellow",
)  # fmt: skip
_ORDERED = (
    ("short_resistance", "open_resistance"), ("least_chassis_voltage", "greatest_chassis_voltage"),
)  # fmt: skip
_Short = Annotated[float, Gt(0), Le(1)]
_Cycles = Annotated[int, Ge(1), Le(1000)]


@dataclass(frozen=True)
class ShapeSettingConfig(ProcessConfig):
    """A heater for Nitinol rods: battery, relay, gate (MOSFET), two-channel analog terminal, remote with a key."""

    PROCESS = "rtcp.processes.shape_setting.process:ShapeSetting"
    COMMANDS = (
        ArmHeater, MeasureResistance, SetHeatProfile, SetTargetRatio, StartHeating, HeatRod, StopHeating, ResetTrips,
    )  # fmt: skip
    STATES = HeaterState
    LAMPS = MappingProxyType({"green": "lamp_green", "yellow": "lamp_yellow", "red": "relay_closed"})
    PLOT = ("setpoint_middle", "middle_temperature", "mean_temperature", "average_current")

    def findings(self, devices: Mapping[str, DeviceDescription]) -> Iterator[Finding]:
        """Yield mistakes against the slaves, channels missing or used twice, and limits out of order."""
        yield from super().findings(devices)
        first: dict[str, str] = {}
        types = {
            f"{name}.{entry.name}": entry.type
            for name, device in devices.items()
            for pdo in (*device.tpdo, *device.rpdo)
            for entry in pdo.channels
        }
        for entry in fields(self):
            text = getattr(self, entry.name)
            if entry.name in _ANALOG or entry.name in _DIGITAL:
                if not text:
                    yield Finding((entry.name,), "length", found=text, allowed="SLAVE.CHANNEL")
                elif first.setdefault(text, entry.name) != entry.name:
                    yield Finding((entry.name,), "repeated", found=text, what="channel", of=first[text])
                elif entry.name in _DIGITAL and types.get(text, "bool") not in ("bool", "uint8"):
                    wanted = "a channel of type bool or uint8"
                    yield Finding((entry.name,), "type_of_channel", found=types[text], channel=text, allowed=wanted)
        for low, high in _ORDERED:
            if not getattr(self, low) < getattr(self, high):
                wanted = f"less than {high}, {getattr(self, high):g}"
                yield Finding((low,), "too_high", found=getattr(self, low), allowed=wanted)

    voltage: InputChannel = "measure.voltage"
    """Voltage between two points of the rod, V: of the same instant as `current`."""
    current: InputChannel = "measure.current"
    """Current through the rod, A."""
    sample: InputChannel = "measure.sample"
    """Counter of the conversions of `voltage` and `current`, 16 bits."""
    gate_sense: InputChannel = "measure.gate_sense"
    """1: the gate was on throughout the conversion."""
    key_auto: InputChannel = "control.key_auto"
    """Key switch at Auto."""
    key_manual: InputChannel = "control.key_manual"
    """Key switch at Manual."""
    button_a: InputChannel = "control.button_a"
    """Button of the remote, first channel; 1: held."""
    button_b: InputChannel = "control.button_b"
    """Button of the remote, second channel."""
    circuit_a: InputChannel = "control.circuit_a"
    """Safety circuit of the robot, first channel; 1: closed."""
    circuit_b: InputChannel = "control.circuit_b"
    """Safety circuit of the robot, second channel."""
    relay_closed: InputChannel = "control.relay_closed"
    """Mirror contact of the main relay; 1: closed."""
    fuse_ok: InputChannel = "control.fuse_ok"
    """1: the fuse is good."""
    chassis_voltage: InputChannel = "control.chassis_voltage"
    """Voltage between the chucks and the robot's frame, V."""
    battery_voltage: InputChannel = "control.battery_voltage"
    """Voltage of the battery, V."""
    alive: InputChannel = "control.alive"
    """Counter of the box, 16 bits."""
    gate: OutputChannel = "control.gate"
    """Gate of the MOSFET; 1: on."""
    relay: OutputChannel = "control.relay"
    """Main relay; 1: closed. The red lamp is wired to it."""
    lamp_green: OutputChannel = "control.lamp_green"
    """Lamp for powered: on in every state, in faults too."""
    lamp_yellow: OutputChannel = "control.lamp_yellow"
    """Lamp for armed: the relay is commanded to close."""

    arms: tuple[Name, ...] = ()
    """Arms of the cell that have to be engaged in mode Auto; empty: none."""
    arm_silence_s: _Short = 0.01
    """Age of an arm's newest record at which the arm counts as lost, s."""
    discrepancy_s: _Short = 0.05
    """Longest time for which the two channels of an input may differ, s."""
    relay_close_s: _Short = 0.03
    """Time of the relay to close, s; then its mirror contact has to agree."""
    relay_open_s: _Short = 0.03
    """Time of the relay to open, s."""
    gate_cycles: _Cycles = 8
    """Cycles after a command to the gate until its feedback has to agree."""
    leakage_current: Positive = 0.5
    """Greatest measured current with the gate off, A: more is a gate that leaks, or an offset."""
    lost_cycles: _Cycles = 1
    """Cycles in a row without inputs that latch; the gate is off in the first already."""
    stale_cycles: _Cycles = 4
    """Cycles without a change of `sample` or `alive` at which inputs count as stale."""
    over_current: Positive = 280.0
    """Greatest current, A; below the fuse's."""
    over_voltage: Positive = 15.0
    """Greatest voltage of rod and battery, V."""
    rod_length: Annotated[float, Ge(0.1), Le(0.5)] = 0.3
    """Length of the rod between the chucks, m, for `set_target_ratio` without a length."""
    least_battery_voltage: NotNegative = 11.5
    """Least voltage of the battery for the heater to be armed, V."""
    open_resistance: Positive = 5.0
    """Resistance of an open circuit, ohm; greater than that of any rod."""
    short_resistance: Positive = 0.008
    """Resistance of a short circuit, ohm; smaller than that of any rod."""
    temperature_tolerance: Positive = 25.0
    """The mean temperature by the resistance may be this far outside the temperatures that the power allows, K."""
    excess_temperature: Positive = 30.0
    """The greatest temperature that the measured power allows may exceed the target by this, K. After the cooling it
    may exceed `cool_c` by this."""
    greatest_gradient: Positive = 1.0
    """Greatest plausible change of the ratio, 1/s; full power heats a thin rod by some 0.15 1/s."""
    gradient_s: _Short = 0.005
    """Shortest time over which the gradient is taken, s."""
    least_chassis_voltage: float = 2.5
    """Least voltage between the chucks and the robot's frame, V: an insulation monitor puts some 5 V there."""
    greatest_chassis_voltage: float = 7.5
    """Greatest voltage between the chucks and the robot's frame, V."""
    pulses: Annotated[int, Ge(2), Le(100)] = 4
    """Pulses of a measurement of the initial resistance."""
    pulse_interval_s: _Short = 0.1
    """Interval of those pulses, s."""
    greatest_initial_uncertainty: Annotated[float, Gt(0), Le(0.1)] = 0.003
    """Greatest relative uncertainty of the initial resistance; 0.002 is worth some 10 K."""
    rod_cooling_s: Annotated[float, Ge(0), Le(3600)] = 600.0
    """Greatest time after a heating, and after each start of the platform, before an initial resistance is measured, s.
    The heat balance of the rod shortens it to when this rod is cold; `is_cold` ends it."""
    greatest_target_c: Annotated[float, Gt(0), Le(600)] = 600.0
    """Greatest target in the middle of the rod, C: Nitinol loses its structure above."""
    longest_cooling_s: Positive = 600.0
    """Longest time of cooling down, s; then the relay opens."""
    average_s: _Short = 0.01
    """Time constant of the exponential average of the current, s."""
    proportional: Positive = 150.0
    """Gain: share of the full current by the error of the ratio; the same for all diameters."""
    integral: NotNegative = 200.0
    """Gain of the integral, 1/s."""
    derivative: NotNegative = 0.0
    """Gain of the derivative of the measured ratio, s."""
    sense_interval_s: _Short = 0.1
    """Age of the resistance at which the gate is turned on to measure while heating and holding, s; in a thick rod a
    pulse of 1.5 ms every 50 ms is as much as it loses."""
    cooling_interval_s: _Short = 1.0
    """The same while the rod cools, s: each pulse heats by some 0.3 to 0.8 K."""
    armed_s: Positive = 30.0
    """Longest time of an armed heater without pulses or heat, s."""
    longest_s: Positive = 900.0
    """Longest time of ramp and hold, s."""
