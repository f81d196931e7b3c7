"""The controller: one panel, its mechanical units with the ways of their datagrams, and the requests of an operator."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, TypeVar

from rtcp.config.document import shown
from rtcp.virtual.irc5.config import Irc5Config, UnitConfig
from rtcp.virtual.irc5.faults import SHARES, DatagramFaults
from rtcp.virtual.irc5.mechanical_unit import MechanicalUnit, RapidRefused
from rtcp.virtual.irc5.panel import Enabling, Mode, Panel, PanelRefused, Stop

E = TypeVar("E", bound=Enum)
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
_KEYS = {
    "status": (), "mode": ("mode",), "enabling": ("position",), "motors_on": (), "motors_off": (),
    "stop": ("circuit",), "release": ("circuit",), "start_rapid": ("unit",), "stop_rapid": ("unit",),
    "fault": ("unit", "fault", "value", "direction"), "clear": ("unit",),
}  # fmt: skip
"""Requests and the keys that they may have; without `unit` they concern all units."""


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


class Controller:
    """An IRC5 in simulated time: `panel.advance` and each unit's `step` let time pass."""

    def __init__(self, config: Irc5Config) -> None:
        """Build the controller; with `autostart`, in Auto, its motors are on and RAPID runs.

        Raises:
            ConfigError: the file of an arm does not exist or is wrong.
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
            return self._do(verb, request)
        except (PanelRefused, RapidRefused) as error:
            raise RequestRefused(str(error)) from error

    def _do(self, verb: str, request: dict[str, Any]) -> Any:
        panel = self.panel
        match verb:
            case "status":
                return self._status()
            case "mode":
                panel.select_mode(_choice(Mode, request, "mode"))
            case "enabling":
                panel.hold_enabling(_choice(Enabling, request, "position"))
            case "motors_on":
                panel.press_motors_on()
            case "motors_off":
                panel.switch_motors_off()
            case "stop":
                panel.open_circuit(_choice(Stop, request, "circuit"))
            case "release":
                panel.close_circuit(_choice(Stop, request, "circuit"))
            case _:
                for unit in self._named(request):
                    self._do_to(unit, verb, request)
        return None

    def _named(self, request: dict[str, Any]) -> list[Unit]:
        name = request.get("unit")
        if name is None:
            return list(self.units.values())
        if not isinstance(name, str) or name not in self.units:
            raise RequestRefused(f"unit: found {shown(name)}, allowed is one of {', '.join(self.units)}")
        return [self.units[name]]

    @staticmethod
    def _do_to(unit: Unit, verb: str, request: dict[str, Any]) -> None:
        match verb:
            case "start_rapid":
                unit.mechanical.start_rapid()
            case "stop_rapid":
                unit.mechanical.stop_rapid()
            case "clear":
                unit.to_pc.clear()
                unit.from_pc.clear()
                unit.mechanical.utilization_override = None
            case "fault":
                _begin(unit, request)

    def _status(self) -> dict[str, Any]:
        panel = self.panel
        return {
            "mode": panel.mode.value,
            "motors": panel.motors.value,
            "enabling": panel.enabling.value,
            "open": sorted(stop.value for stop in panel.open),
            "latched": panel.latched,
            "units": {name: _status_of(unit.mechanical) for name, unit in self.units.items()},
        }


def _status_of(unit: MechanicalUnit) -> dict[str, Any]:
    return {
        "mci": unit.mci.name.lower(),
        "rapid_running": unit.rapid_running,
        "position_deg": list(unit.actual),
        "velocity_deg_s": unit.speeds,
        "collision": unit.collision,
        "counts": dict(unit.counts),
        "events": list(unit.events),
    }


def _begin(unit: Unit, request: dict[str, Any]) -> None:
    kind = request.get("fault")
    if not isinstance(kind, str) or kind not in _FAULTS:
        raise RequestRefused(f"fault: found {shown(kind)}, allowed is one of {', '.join(_FAULTS)}")
    if kind in _ONCE:
        _ONCE[kind](unit.mechanical)
        return
    if kind == "utilization":
        unit.mechanical.utilization_override = _number(request, _HIGHEST_UTILIZATION)
        return
    direction = request.get("direction", "to_pc")
    if direction not in ("to_pc", "from_pc"):
        raise RequestRefused(f"direction: found {shown(direction)}, allowed is one of to_pc, from_pc")
    faults = unit.to_pc if direction == "to_pc" else unit.from_pc
    if kind == "silent":
        faults.silent = True
    elif kind == "late":
        faults.late = int(_number(request, _LONGEST_DELAY))
    else:
        faults.shares[kind] = _number(request, 1.0)


def _number(request: dict[str, Any], most: float) -> float:
    value = request.get("value")
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= most:
        raise RequestRefused(f"value: found {shown(value)}, allowed is a number from 0 to {most:g}")
    return float(value)


def _choice(kind: type[E], request: dict[str, Any], key: str) -> E:
    found = request.get(key)
    for choice in kind:
        if choice.value == found:
            return choice
    raise RequestRefused(f"{key}: found {shown(found)}, allowed is one of {', '.join(c.value for c in kind)}")
