"""The circuit that heats a rod: battery, fuse, relay, MOSFET, shunt and rod; its measurements and its faults.

Values are from chapter 4 of the thesis (12 V battery of 1000 A cranking current, fuse 300 A, relay 500 A in series,
MOSFET 200 A, shunt 1000 A, two channels of 24 bit) unless marked as assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from math import inf
from random import Random

FULL_SCALE = (1 << 23) - 1
"""Largest count of a 24-bit channel."""


class SensePoint(Enum):
    """Sense point of the voltage."""

    ROD = auto()
    """Four-wire, on the rod between the chucks: no contact resistance in u."""
    LUG = auto()
    """On the cable lugs of the chucks: contacts and chucks count as rod."""


class Sampling(Enum):
    """Sampling of the two channels."""

    SIMULTANEOUS = auto()
    """u and i together, in every step."""
    ALTERNATING = auto()
    """u and i in alternate steps, as with a multiplexed converter; a channel keeps its count in between."""


class CircuitFault(Enum):
    """Faults of the circuit."""

    CONTACT_LOOSE = auto()
    """The first chuck's contact changes at random between 5 and 50 mohm."""
    POWER_WIRE_BROKEN = auto()
    SENSE_WIRE_BROKEN = auto()
    """u reads zero."""
    GATE_STUCK_ON = auto()
    """The MOSFET conducts without a command: shorted, its usual failure."""
    GATE_STUCK_OFF = auto()
    RELAY_WELDED = auto()
    """The main contact stays closed and therefore the mirror contact open."""
    BATTERY_WEAK = auto()
    """Six times the internal resistance, 1.5 V less."""
    VOLTAGE_OFFSET = auto()
    """u reads 50 mV too much."""
    CURRENT_OFFSET = auto()
    """i reads 1 A too much."""
    ROD_SHORTED = auto()
    """1 mohm from chuck to chuck."""
    INSULATION_BROKEN = auto()
    """100 ohm from chuck to robot frame."""
    FUSE_BLOWN = auto()
    """Also set when the fuse blows by itself; clearing it replaces the fuse."""


@dataclass(frozen=True)
class CircuitData:
    """Values of the parts, assumed if the thesis has none; together 12 V and 12 mohm."""

    open_voltage: float = 12.0
    """Open-circuit voltage of the full battery, V."""
    voltage_drop: float = 1.0
    """Drop of the open-circuit voltage from full to empty, V."""
    capacity: float = 70.0
    """Ah."""
    charger_current: float = 10.0
    """Current of the permanently connected charger, A."""
    battery_resistance: float = 6.0e-3
    """ohm."""
    lead_resistance: float = 2.94e-3
    """Fuse, relay and cables up to the lugs, ohm."""
    lug_resistance: float = 1.0e-3
    """Both chucks from lug to jaws, ohm."""
    contact_resistance: float = 0.5e-3
    """Of each jaw on the rod, ohm."""
    mosfet_resistance: float = 1.0e-3
    """On resistance, ohm."""
    shunt_resistance: float = 60e-6
    """60 mV at 1000 A, ohm."""
    fuse_rating: float = 300.0
    """A."""
    fuse_melting: float = 8e5
    """Integral of I^2 minus the rating's square at which the fuse opens, A^2 s: 3 s at 600 A."""
    relay_closing: float = 0.015
    """s; 10 to 20 ms is usual."""
    relay_opening: float = 0.012
    """s."""
    voltage_range: float = 15.0
    """u at full scale, V."""
    current_range: float = 1000.0
    """i at full scale, A."""
    noise: float = 20.0
    """Standard deviation of a sample, counts."""
    voltage_offset: float = 0.0
    """V."""
    current_offset: float = 0.0
    """A."""
    voltage_gain: float = 1.0
    """Reading of u by its true value."""
    current_gain: float = 1.0
    """Reading of i by its true value."""
    monitor_voltage: float = 5.0
    """Voltage of the insulation monitor between the floating circuit and the robot frame, V."""
    monitor_resistance: float = 100e3
    """ohm."""
    insulation: float = 10e6
    """ohm."""


_LOOSE_CONTACT = (5e-3, 50e-3)
_WEAK_FACTOR, _WEAK_DROP = 6.0, 1.5
_VOLTAGE_FAULT, _CURRENT_FAULT = 0.05, 1.0
_SHORT = 1e-3
_BROKEN_INSULATION = 100.0


class Circuit:
    """The circuit; gate and rod are constant within a step."""

    def __init__(
        self,
        data: CircuitData | None = None,
        *,
        sense_point: SensePoint = SensePoint.ROD,
        sampling: Sampling = Sampling.SIMULTANEOUS,
        seed: int = 0,
    ) -> None:
        self.data = data or CircuitData()
        self.sense_point = sense_point
        self.sampling = sampling
        self.faults: set[CircuitFault] = set()
        """Present faults; changed by `inject` and `clear`."""
        self.charge = 1.0
        """Of the battery, 0 to 1."""
        self.current = 0.0
        """Through the shunt, A."""
        self.voltage = 0.0
        """At the sense point, V."""
        self.battery_voltage = self.data.open_voltage
        """At the battery's poles, V."""
        self.relay_closed = False
        """True: the main contact is closed."""
        self.mirror_closed = True
        """True: the mirror contact is closed (IEC 60947-4-1, annex F), never together with the main contact."""
        self.voltage_count = self.current_count = 0
        """Last converted samples of u and i, 24 bit, signed."""
        self.voltage_step = self.current_step = 0
        """Number of the step in which each sample was converted, from 1; equal for u and i of one instant."""
        self._steps = 0
        self._relay_moved = 0.0
        self._fuse_heat = 0.0
        self._random = Random(seed)

    @property
    def fuse_intact(self) -> bool:
        """Whether the fuse conducts."""
        return CircuitFault.FUSE_BLOWN not in self.faults

    @property
    def chuck_to_frame_voltage(self) -> float:
        """Reading of the insulation monitor, V: about 5; near 0 with broken insulation."""
        data = self.data
        broken = CircuitFault.INSULATION_BROKEN in self.faults
        insulation = _BROKEN_INSULATION if broken else data.insulation
        return data.monitor_voltage * insulation / (insulation + data.monitor_resistance)

    def inject(self, fault: CircuitFault) -> None:
        """Add a fault, effective from the next step."""
        self.faults.add(fault)

    def clear(self, fault: CircuitFault) -> None:
        """Remove a fault, if present."""
        self.faults.discard(fault)
        if fault is CircuitFault.FUSE_BLOWN:
            self._fuse_heat = 0.0

    def step(self, dt: float, gate: bool, relay: bool, rod_resistance: float) -> float:
        """Advance by `dt` seconds with the two commands; return the current through the rod, A.

        `rod_resistance`: between the chucks, ohm; infinite for a melted rod.
        """
        data, faults = self.data, self.faults
        self._steps += 1
        self._move_relay(dt, relay)
        source, resistance = data.open_voltage - data.voltage_drop * (1.0 - self.charge), data.battery_resistance
        contacts, short = 2 * data.contact_resistance, inf
        conducts = gate
        if faults:
            if CircuitFault.BATTERY_WEAK in faults:
                source -= _WEAK_DROP
                resistance *= _WEAK_FACTOR
            if CircuitFault.CONTACT_LOOSE in faults:
                contacts += self._random.uniform(*_LOOSE_CONTACT)
            if CircuitFault.ROD_SHORTED in faults:
                short = _SHORT
            conducts = (gate or CircuitFault.GATE_STUCK_ON in faults) and CircuitFault.GATE_STUCK_OFF not in faults
            if CircuitFault.POWER_WIRE_BROKEN in faults or CircuitFault.FUSE_BLOWN in faults:
                conducts = False
        rod_current = self.current = self.voltage = 0.0
        if conducts and self.relay_closed:
            before_chucks = resistance + data.lead_resistance + data.mosfet_resistance + data.shunt_resistance
            before_chucks += data.lug_resistance
            branch = rod_resistance + contacts
            load = branch if short == inf else short / (1.0 + short / branch)
            self.current = source / (before_chucks + load)
            chuck_voltage = source - self.current * before_chucks
            rod_current = chuck_voltage / branch
            if self.sense_point is SensePoint.LUG:
                self.voltage = chuck_voltage + self.current * data.lug_resistance
            else:
                self.voltage = chuck_voltage - rod_current * contacts
        self.battery_voltage = source - self.current * resistance
        flow = (data.charger_current - self.current) * dt / (3600.0 * data.capacity)
        self.charge = min(1.0, max(0.0, self.charge + flow))
        self._heat_fuse(dt)
        self._sample()
        return rod_current

    def _move_relay(self, dt: float, command: bool) -> None:
        data = self.data
        if command is self.relay_closed:
            self._relay_moved = 0.0
        else:
            self._relay_moved += dt
            if self._relay_moved >= (data.relay_closing if command else data.relay_opening) - 1e-9:
                self.relay_closed = command
                self._relay_moved = 0.0
        if CircuitFault.RELAY_WELDED in self.faults:
            self.relay_closed = True
        self.mirror_closed = not self.relay_closed and self._relay_moved == 0.0

    def _heat_fuse(self, dt: float) -> None:
        data = self.data
        excess = self.current * self.current - data.fuse_rating * data.fuse_rating
        self._fuse_heat = max(0.0, self._fuse_heat + excess * dt)
        if self._fuse_heat > data.fuse_melting:
            self.faults.add(CircuitFault.FUSE_BLOWN)

    def resample(self) -> tuple[int, int]:
        """Convert u and i once more within the step, and return the counts."""
        self._sample()
        return self.voltage_count, self.current_count

    def _sample(self) -> None:
        data, faults = self.data, self.faults
        alternating = self.sampling is Sampling.ALTERNATING
        if not alternating or self._steps % 2:
            voltage = 0.0 if CircuitFault.SENSE_WIRE_BROKEN in faults else self.voltage
            voltage = voltage * data.voltage_gain + data.voltage_offset
            voltage += _VOLTAGE_FAULT if CircuitFault.VOLTAGE_OFFSET in faults else 0.0
            self.voltage_count = self._count(voltage / data.voltage_range)
            self.voltage_step = self._steps
        if not alternating or not self._steps % 2:
            current = data.current_gain * self.current + data.current_offset
            current += _CURRENT_FAULT if CircuitFault.CURRENT_OFFSET in faults else 0.0
            self.current_count = self._count(current / data.current_range)
            self.current_step = self._steps

    def _count(self, share: float) -> int:
        """Return the count of a share of the range, with noise, limited to 24 bit."""
        count = round(share * FULL_SCALE + self._random.gauss(0.0, self.data.noise))
        return max(-FULL_SCALE - 1, min(FULL_SCALE, count))
