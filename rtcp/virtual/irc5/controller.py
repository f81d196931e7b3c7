"""The controller: one panel, its mechanical units with the ways of their datagrams, and the requests of an operator."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

from rtcp.config.document import shown
from rtcp.virtual.irc5.config import Irc5Config, UnitConfig
from rtcp.virtual.irc5.faults import SHARES, DatagramFaults
from rtcp.virtual.irc5.mechanical_unit import MechanicalUnit, RapidRefused
from rtcp.virtual.irc5.panel import Enabling, Mode, Panel, PanelRefused, Stop

_LONGEST_DELAY = 250
"""Cycles that a datagram may be late: 1 s."""
_HIGHEST_UTILIZATION = 1000.0
"""%."""
_ONCE: dict[str, Callable[[MechanicalUnit], None]] = {
    "seqno_restart": MechanicalUnit.restart_session,
    "rapid_stop": MechanicalUnit.stop_rapid,
    "convergence": MechanicalUnit.end_by_convergence,
    "mci_error": lambda unit: unit.fail("50453 move not allowed (a fault on command)"),
    "collision": lambda unit: unit.fail("a collision was detected (a fault on command)", collision=True),
}
"""Faults that happen and are over."""
_FAULTS = (*_ONCE, "utilization", "silent", "late", *SHARES)
_BUTTONS: dict[str, Callable[[Panel], None]] = {
    "motors_on": Panel.press_motors_on,
    "motors_off": Panel.switch_motors_off,
}
_SWITCHES: dict[str, tuple[str, type[Enum], Callable[[Panel, Any], None]]] = {
    "mode": ("mode", Mode, Panel.select_mode),
    "enabling": ("position", Enabling, Panel.hold_enabling),
    "stop": ("circuit", Stop, Panel.open_circuit),
    "release": ("circuit", Stop, Panel.close_circuit),
}
"""Request -> its key, the values that the key may have, and what does it."""


class RequestRefused(Exception):
    """What an operator asks for is not possible: a sentence."""


class Unit:
    """A mechanical unit and its UDP connection."""

    def __init__(self, config: UnitConfig, panel: Panel, resume_after_motors_off: bool) -> None:
        self.mechanical = MechanicalUnit(config, panel, resume_after_motors_off)
        self.to_pc, self.from_pc = DatagramFaults(config.port), DatagramFaults(config.port + 1)

    def step(self, received: Iterable[bytes], clock_s: float) -> list[bytes]:
        """Let one period of the unit pass with what the PC sent in it; return what goes to the PC."""
        for datagram in self.from_pc.cycle(received):
            self.mechanical.receive(datagram)
        sent = self.mechanical.step(clock_s)
        return self.to_pc.cycle(() if sent is None else (sent,))

    def start_rapid(self, request: dict[str, Any]) -> None:
        """Press Start."""
        self.mechanical.start_rapid()

    def stop_rapid(self, request: dict[str, Any]) -> None:
        """Press Stop."""
        self.mechanical.stop_rapid()

    def clear(self, request: dict[str, Any]) -> None:
        """End the faults that last."""
        self.to_pc.clear()
        self.from_pc.clear()
        self.mechanical.utilization_override = None

    def fault(self, request: dict[str, Any]) -> None:
        """Let a fault happen or begin.

        Raises:
            RequestRefused, RapidRefused: with a sentence.
        """
        kind, direction = request.get("fault"), request.get("direction", "to_pc")
        if not isinstance(kind, str) or kind not in _FAULTS:
            raise RequestRefused(f"fault: found {shown(kind)}, allowed is one of {', '.join(_FAULTS)}")
        if direction not in ("to_pc", "from_pc"):
            raise RequestRefused(f"direction: found {shown(direction)}, allowed is one of to_pc, from_pc")
        datagrams = self.to_pc if direction == "to_pc" else self.from_pc
        if kind in _ONCE:
            _ONCE[kind](self.mechanical)
        elif kind == "utilization":
            self.mechanical.utilization_override = _number(request, _HIGHEST_UTILIZATION)
        elif kind == "silent":
            datagrams.silent = True
        elif kind == "late":
            datagrams.late = int(_number(request, _LONGEST_DELAY))
        else:
            datagrams.shares[kind] = _number(request, 1.0)

    def status(self) -> dict[str, Any]:
        """Return what the unit does, as plain values."""
        unit = self.mechanical
        return {
            "mci": unit.mci.name.lower(),
            "rapid_running": unit.rapid_running,
            "position_deg": list(unit.actual),
            "velocity_deg_s": unit.speeds,
            "collision": unit.collision,
            "counts": dict(unit.counts),
            "events": list(unit.events),
        }


_OF_UNITS: dict[str, tuple[tuple[str, ...], Callable[[Unit, dict[str, Any]], None]]] = {
    "start_rapid": (("unit",), Unit.start_rapid),
    "stop_rapid": (("unit",), Unit.stop_rapid),
    "clear": (("unit",), Unit.clear),
    "fault": (("unit", "fault", "value", "direction"), Unit.fault),
}
"""Request -> its keys, and what does it; without `unit` it concerns all units."""
_KEYS: dict[str, tuple[str, ...]] = (
    {"status": ()}
    | dict.fromkeys(_BUTTONS, ())
    | {verb: (switch[0],) for verb, switch in _SWITCHES.items()}
    | {verb: keys for verb, (keys, _) in _OF_UNITS.items()}
)


class Controller:
    """An IRC5 in simulated time: `panel.advance` and each unit's `step` let time pass."""

    def __init__(self, config: Irc5Config) -> None:
        """Build the controller; with `autostart`, in Auto, its motors are on and RAPID runs.

        Raises:
            ConfigError: the file of an arm does not exist or is wrong, or a unit begins outside its ranges.
        """
        self.panel = Panel(Mode(config.mode), config.emergency_stop_category)
        resume = not config.do_not_restart_after_motors_off
        self.units = {unit.name: Unit(unit, self.panel, resume) for unit in config.units}
        if config.autostart and self.panel.mode is Mode.AUTO:
            self.panel.press_motors_on()
            for unit in self.units.values():
                unit.mechanical.start_rapid()

    def request(self, request: dict[str, Any]) -> Any:
        """Do what an operator asks for, as `{"do": "stop", "circuit": "emergency"}`; return plain values.

        Raises:
            RequestRefused: with a sentence.
        """
        verb = request.get("do")
        if not isinstance(verb, str) or verb not in _KEYS:
            raise RequestRefused(f"do: found {shown(verb)}, allowed is one of {', '.join(_KEYS)}")
        for key in request:
            if key != "do" and key not in _KEYS[verb]:
                raise RequestRefused(f"{key}: {verb} has no such key; allowed are {', '.join(('do', *_KEYS[verb]))}")
        try:
            if verb in _BUTTONS:
                _BUTTONS[verb](self.panel)
            elif verb in _SWITCHES:
                key, kind, switch = _SWITCHES[verb]
                switch(self.panel, _choice(kind, request, key))
            elif verb in _OF_UNITS:
                for unit in self._named(request.get("unit")):
                    _OF_UNITS[verb][1](unit, request)
            else:
                return self._status()
        except (PanelRefused, RapidRefused) as error:
            raise RequestRefused(str(error)) from error
        return None

    def _named(self, name: object) -> list[Unit]:
        if name is None:
            return list(self.units.values())
        if not isinstance(name, str) or name not in self.units:
            raise RequestRefused(f"unit: found {shown(name)}, allowed is one of {', '.join(self.units)}")
        return [self.units[name]]

    def _status(self) -> dict[str, Any]:
        panel = self.panel
        return {
            "mode": panel.mode.value,
            "motors": panel.motors.value,
            "enabling": panel.enabling.value,
            "open": sorted(stop.value for stop in panel.open),
            "latched": panel.latched,
            "units": {name: unit.status() for name, unit in self.units.items()},
        }


def _number(request: dict[str, Any], most: float) -> float:
    value = request.get("value")
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= most:
        raise RequestRefused(f"value: found {shown(value)}, allowed is a number from 0 to {most:g}")
    return float(value)


def _choice(kind: type[Enum], request: dict[str, Any], key: str) -> Enum:
    found = request.get(key)
    for choice in kind:
        if choice.value == found:
            return choice
    raise RequestRefused(f"{key}: found {shown(found)}, allowed is one of {', '.join(c.value for c in kind)}")
