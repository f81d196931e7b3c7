"""Commands, refusals and events of the heater. Events have the numbers 127 to 149."""

from __future__ import annotations

from enum import IntEnum
from math import inf
from types import MappingProxyType
from typing import Final

from rtcp.ipc.commands import ANYWHERE, AT_REST, Command, ProcessCommand
from rtcp.ipc.events import Event, ProcessEnded
from rtcp.ipc.refusals import Refusal
from rtcp.processes.shape_setting.interlocks import Mode, Row


class HeaterState(IntEnum):
    """State of the heater."""

    OFF = 0
    """The key is at Off."""
    READY = 1
    """The relay is open."""
    ARMED = 2
    """The relay is closed, the gate is off."""
    MEASURING = 3
    """Pulses for the initial resistance."""
    HEATING = 4
    """The setpoint rises."""
    HOLDING = 5
    COOLING = 6
    """Only pulses that measure."""
    DONE = 7
    """The profile is complete, the relay is open."""
    TRIPPED = 8
    """A row of the interlocks has latched."""


class RodPhase(IntEnum):
    """Phase of the straight, unloaded rod, as the operator knows it from its Af."""

    UNKNOWN = 0
    AUSTENITE = 1
    MARTENSITE = 2


# -- commands ----------------------------------------------------------------------------------------------------------


class ArmHeater(ProcessCommand):
    """Close the heater's relay; the gate stays off. It lasts until the mirror contact shows a closed relay."""

    states = AT_REST


class MeasureResistance(ProcessCommand):
    """Measure the initial resistance by a few pulses: of the straight, unloaded rod, all austenite."""

    straight_and_unloaded: bool
    """The operator confirms that nothing bends the rod: stress makes martensite, worth 7 to 20 % of resistance."""
    phase: RodPhase
    """The phase that the operator confirms; only austenite is measured, whose line the profile has."""
    is_cold: bool = False
    """The operator confirms that the rod has the temperature of the room: it is another rod, or was never hot."""


class ProfileKey(IntEnum):
    """A number of `SetHeatProfile`, by its position there."""

    INITIAL_C = 0
    CHUCK_C = 1
    KELVIN_PER_RATIO = 2
    MEAN_BY_MIDDLE = 3
    UNCERTAINTY_K = 4
    TARGET_C = 5
    RAMP_K_S = 6
    HOLD_S = 7
    COOL_C = 8
    MAX_CURRENT = 9
    MAX_POWER = 10
    HEAT_CAPACITY = 11
    CONVECTED = 12
    RADIATED = 13
    TOLERANCE = 14


PROFILE_RANGES: Final = MappingProxyType({
    ProfileKey.INITIAL_C: (-20.0, 200.0),
    ProfileKey.CHUCK_C: (-20.0, 200.0),
    ProfileKey.KELVIN_PER_RATIO: (500.0, 100_000.0),
    ProfileKey.MEAN_BY_MIDDLE: (0.1, 1.0),
    ProfileKey.UNCERTAINTY_K: (0.0, 1000.0),
    ProfileKey.TARGET_C: (50.0, 600.0),
    ProfileKey.RAMP_K_S: (0.1, 500.0),
    ProfileKey.HOLD_S: (0.0, inf),
    ProfileKey.COOL_C: (20.0, 400.0),
    ProfileKey.MAX_CURRENT: (0.1, 300.0),
    ProfileKey.MAX_POWER: (0.1, 5000.0),
    ProfileKey.HEAT_CAPACITY: (0.01, 1000.0),
    ProfileKey.CONVECTED: (0.1, 5000.0),
    ProfileKey.RADIATED: (0.0, 5000.0),
    ProfileKey.TOLERANCE: (0.0, 0.3),
})  # fmt: skip
"""Least and greatest values of a profile's numbers; the configuration narrows target and hold further."""


class SetHeatProfile(Command):
    """Set the profile of the next heating (`rtcp.processes.shape_setting.profile`, `PROFILE_RANGES`)."""

    states = AT_REST
    initial_c: float
    """Temperature of the rod at its initial resistance, C."""
    chuck_c: float
    """Temperature of the chucks, C."""
    kelvin_per_ratio: float
    """Resistivity at `initial_c` by its slope: rise of the mean temperature at twice the initial resistance, K."""
    mean_by_middle: float
    """Rise of the mean by that of the middle, over the temperature of the chucks."""
    uncertainty_k: float
    """Standard uncertainty of the target in the middle by alloy, room and cold ends, K."""
    target_c: float
    """Of the middle, C."""
    ramp_k_s: float
    """Of the middle, K/s."""
    hold_s: float
    cool_c: float
    """Middle at which the relay opens, C."""
    max_current: float
    """Limit of the average current, A."""
    max_power: float
    """Limit of the average power, W."""
    heat_capacity: float
    """Heat capacity of the rod between the chucks, J/K."""
    convected: float
    """Power that the rod loses by convection if all of it has the target temperature, W."""
    radiated: float
    """Power that the rod loses by radiation then, W."""
    tolerance: float
    """Relative tolerance of the measured power against heat capacity and losses."""


class StartHeating(ProcessCommand):
    """Heat by the profile: ramp, hold, cool down."""


class RatioKey(IntEnum):
    """A number of `SetTargetRatio`, by its position there."""

    TARGET_RATIO = 0
    HOLD_S = 1
    LENGTH = 2
    INITIAL_C = 3


RATIO_RANGES: Final = MappingProxyType({
    RatioKey.TARGET_RATIO: (1.001, 2.0),
    RatioKey.HOLD_S: (0.0, inf),
    RatioKey.LENGTH: (0.1, 0.5),
    RatioKey.INITIAL_C: (-20.0, 70.0),
})  # fmt: skip
"""Least and greatest values of those numbers; the configuration narrows the hold further."""
ROD_DIAMETERS: Final = (0.3e-3, 4e-3)
"""Diameters of rods that are heated by the ratio alone, m."""


class SetTargetRatio(Command):
    """Heat rods of any diameter to a ratio of resistances: the measured initial resistance shows the diameter.

    It takes the place of a heat profile, and lasts until `set_heat_profile`.
    """

    states = AT_REST
    target_ratio: float
    """Resistance at the target by the initial resistance (equation 4.3 of the thesis)."""
    hold_s: float = 120.0
    """Time at the target, s."""
    length: float = 0.0
    """Length of the rod between the chucks, m; 0: `rod_length` of the configuration."""
    initial_c: float = 20.0
    """Temperature of rod, air and chucks at the measurement of the initial resistance, C."""


class HeatRod(ProcessCommand):
    """Do all steps for one rod: close the relay, measure the initial resistance, heat, hold, cool down."""

    states = AT_REST
    straight_and_unloaded: bool
    """As of `MeasureResistance`."""
    phase: RodPhase
    """As of `MeasureResistance`."""
    is_cold: bool = False
    """As of `MeasureResistance`."""


class StopHeating(Command):
    """Turn gate and relay off."""

    states = ANYWHERE
    needs_lease = False


class ResetTrips(Command):
    """Forget the latched rows whose cause is gone; the heater starts nothing by that."""

    states = AT_REST


# -- refusals ----------------------------------------------------------------------------------------------------------


class HeatForbidden(Refusal):
    """the interlock {row} forbids heat in mode {mode}: see the table in docs/shape_setting.md, then arm the heater"""

    row: Row
    mode: Mode


class TripLatched(Refusal):
    """the interlock {row} has latched: remove its cause, then reset_trips, then arm the heater"""

    row: Row


class CauseRemains(Refusal):
    """the cause of the latched interlock {row} is still there: remove it, then reset_trips again"""

    row: Row


class BatteryLow(Refusal):
    """the battery has {voltage:.4g} V, at least {limit:.4g} V are needed (least_battery_voltage): charge it"""

    voltage: float
    limit: float


class WrongHeaterState(Refusal):
    """the heater is {state}, the command needs it {needed}"""

    state: HeaterState
    needed: HeaterState


class RodNotConfirmed(Refusal):
    """the initial resistance needs a straight, unloaded rod of austenite, {phase} was confirmed: unload it, or warm it
    above its Af and state that temperature in the profile"""

    phase: RodPhase


class ResistanceNotMeasured(Refusal):
    """there is no initial resistance: arm the heater, then measure_resistance"""


class RodStillHot(Refusal):
    """the rod may have been hot {elapsed_s:.0f} s ago, by a heating or before this start: an initial resistance is
    measured {wait_s:.0f} s after it, or with is_cold of a rod that has the temperature of the room (rod_cooling_s)"""

    elapsed_s: float
    wait_s: float


class NoHeatProfile(Refusal):
    """there is no heat profile: set_heat_profile or set_target_ratio first"""


class ProfileNumberOutOfRange(Refusal):
    """the profile's {quantity}: found {value:.6g}, allowed is a number from {least:g} to {greatest:g}"""

    quantity: ProfileKey
    value: float
    least: float
    greatest: float


class RatioNumberOutOfRange(Refusal):
    """{quantity}: found {value:.6g}, allowed is a number from {least:g} to {greatest:g}"""

    quantity: RatioKey
    value: float
    least: float
    greatest: float


class RodUnfit(Refusal):
    """by its initial resistance, {resistance:.4g} ohm, and its length the rod is {diameter_mm:.3g} mm thick, and its
    middle has {target_c:.4g} C at the target ratio: allowed are 0.3 to 4 mm and {least_c:g} to {greatest_c:g} C; check
    contacts, length and ratio"""

    resistance: float
    diameter_mm: float
    target_c: float
    least_c: float
    greatest_c: float


class CoolingOutOfRange(Refusal):
    """cool_c: found {cool_c:.6g}, allowed is more than initial_c, {initial_c:.6g}, and less than target_c,
    {target_c:.6g}: correct the profile"""

    cool_c: float
    initial_c: float
    target_c: float


# -- events ------------------------------------------------------------------------------------------------------------


class HeaterArmed(Event, number=127):
    """the heater is armed in mode {mode}: its relay is commanded to close"""

    mode: Mode


class ResistanceMeasured(Event, number=128):
    """initial resistance of the rod: {resistance:.6g} ohm, standard uncertainty {uncertainty:.2g} ohm, of {pulses}
    pulses"""

    resistance: float
    uncertainty: float
    pulses: int


class HeatingStarted(Event, number=129):
    """heating to {target_c:.6g} C in the middle of the rod, ratio of resistances {ratio:.5g}"""

    target_c: float
    ratio: float


class HoldBegun(Event, number=130):
    """the middle of the rod has {middle_c:.5g} C: holding for {hold_s:g} s"""

    middle_c: float
    hold_s: float


class CoolingBegun(Event, number=131):
    """the hold is complete after {energy:.5g} J: the rod cools"""

    energy: float


class ShapeSet(Event, number=132):
    """the middle of the rod has {middle_c:.5g} C, the relay opens: the rod can be released; do not touch it above
    60 C"""

    middle_c: float


class HeatStopped(ProcessEnded, number=133):
    """the heater was stopped from outside: gate and relay are commanded off; arm it to heat again"""


class HeatEnded(ProcessEnded, number=134):
    """the interlock {row} ended the heat in mode {mode}: gate and relay are commanded off; restore it, then arm the
    heater"""

    row: Row
    mode: Mode


class ResistanceUncertain(ProcessEnded, number=139):
    """the initial resistance is {resistance:.6g} ohm with {percent:.2g} % uncertainty, {limit:.2g} % are allowed
    (greatest_initial_uncertainty): check the contacts, then measure again"""

    resistance: float
    percent: float
    limit: float


class CoolingTooLong(ProcessEnded, number=140):
    """the middle of the rod has {middle_c:.5g} C after {limit_s:g} s of cooling (longest_cooling_s): the relay opens;
    the profile's cool_c may be below what the rod's resistance returns to"""

    middle_c: float
    limit_s: float


class HeaterTripped(ProcessEnded, number=135):
    """the interlock {row} tripped at {value:.5g}, limit {limit:.5g}: gate and relay are commanded off; remove the
    cause, then reset_trips"""

    row: Row
    value: float
    limit: float


class TripsReset(Event, number=136):
    """the latched interlocks are reset: arm the heater to heat again"""


class TargetNotReached(ProcessEnded, number=137):
    """ramp and hold took longer than {longest_s:g} s (longest_s), the middle of the rod has {middle_c:.5g} C: gate and
    relay are commanded off; check the battery and the profile's limits"""

    middle_c: float
    longest_s: float


class RodHotAgain(Event, number=141):
    """by the measured power the middle of the rod may have {middle_c:.5g} C after it had cooled to {cool_c:g} C
    (cool_c): gate and relay are commanded off; do not touch the rod, and disconnect the battery"""

    is_warning = True
    middle_c: float
    cool_c: float


class RodRejected(ProcessEnded, number=142):
    """by its initial resistance, {resistance:.4g} ohm, and its length the rod is {diameter_mm:.3g} mm thick, and its
    middle has {target_c:.4g} C at the target ratio: allowed are 0.3 to 4 mm and {least_c:g} to {greatest_c:g} C; the
    relay opens; check contacts, length and ratio"""

    resistance: float
    diameter_mm: float
    target_c: float
    least_c: float
    greatest_c: float


class RodSized(Event, number=143):
    """by its initial resistance the rod is {diameter_mm:.3g} mm thick; the target ratio is {target_c:.4g} C in its
    middle"""

    diameter_mm: float
    target_c: float


class ArmedTooLong(ProcessEnded, number=138):
    """the heater was armed for {armed_s:g} s (armed_s) without pulses or heat: its relay opens; arm it again"""

    armed_s: float
