"""The controller: its panel, its mechanical units with their datagrams, and the operator's requests."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

from rtcp.config.findings import shown
from rtcp.virtual.irc5.config import Irc5Config, UnitConfig
from rtcp.virtual.irc5.faults import SHARES, DatagramFaults
from rtcp.virtual.irc5.mechanical_unit import MechanicalUnit
from rtcp.virtual.irc5.panel import Enabling, Mode, Panel, Stop
from rtcp.virtual.irc5.streaming import STREAMING_FAULTS, TERMINALS, RapidStreaming
from rtcp.virtual.request_socket import RequestRefused, choose

_LONGEST_DELAY = 250
"""Upper bound on the delay of a datagram, cycles: 1 s."""
_HIGHEST_UTILIZATION = 1000.0
"""%."""
_ONCE: dict[str, Callable[[MechanicalUnit], None]] = {
    "seqno_restart": MechanicalUnit.restart_session,
    "rapid_stop": MechanicalUnit.stop_rapid,
    "convergence": MechanicalUnit.end_by_convergence,
    "mci_error": lambda unit: unit.fail("50453 move not allowed (a fault on command)"),
    "collision": lambda unit: unit.fail("a collision was detected (a fault on command)", collision=True),
}
"""Faults without duration."""
_FAULTS = (*_ONCE, "utilization", "silent", "late", *SHARES)
_UNIT_FAULTS_OF_STREAMING = ("arm_lost", "rapid_stop", "mci_error", "collision")
"""Faults of a unit that also exist without EGM, and the loss of an arm."""


class Unit:
    """A mechanical unit and its UDP connection."""

    def __init__(self, config: UnitConfig, panel: Panel, resume_after_motors_off: bool, uses_egm: bool) -> None:
        self.mechanical = MechanicalUnit(config, panel, resume_after_motors_off, uses_egm)
        self.to_pc, self.from_pc = DatagramFaults(config.port), DatagramFaults(config.port + 1)

    def step(self, received: Iterable[bytes], clock_s: float) -> list[bytes]:
        """Advance by one period with the PC's datagrams; return the datagrams to the PC."""
        for datagram in self.from_pc.cycle(received):
            self.mechanical.receive(datagram)
        sent = self.mechanical.step(clock_s)
        return self.to_pc.cycle(() if sent is None else (sent,))

    def clear(self) -> None:
        """End all faults."""
        self.to_pc.clear()
        self.from_pc.clear()
        self.mechanical.utilization_override = None

    def fault(self, request: dict[str, Any]) -> None:
        """Let a fault happen or begin.

        Raises:
            RequestRefused: with a sentence.
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
        """Return the state of the unit as plain values."""
        unit = self.mechanical
        return {
            "remote": f"{unit.config.remote}:{unit.config.port}",
            "mci": unit.mci.name.lower(),
            "rapid_running": unit.rapid_running,
            "position_deg": list(unit.actual),
            "velocity_deg_s": unit.speeds,
            "collision": unit.collision,
            "counts": dict(unit.counts),
            "events": list(unit.events),
        }


class Controller:
    """An IRC5 in simulated time, advanced by `panel.advance` and each unit's `step`."""

    def __init__(self, config: Irc5Config) -> None:
        """With `autostart`, in Auto, motors are on and RAPID runs.

        Raises:
            ConfigError: the file of an arm is missing or invalid, or a unit starts outside its ranges.
        """
        self.panel = Panel(Mode(config.mode), config.emergency_stop_category)
        resume = not config.do_not_restart_after_motors_off
        self.units = {unit.name: Unit(unit, self.panel, resume, config.rapid is None) for unit in config.units}
        self.streaming: RapidStreaming | None = None
        if config.rapid is not None:
            units = {name: unit.mechanical for name, unit in self.units.items()}
            self.streaming = RapidStreaming(units, self.panel, config.rapid)
        if config.autostart and self.panel.mode is Mode.AUTO:
            self.panel.press_motors_on()
            for unit in self.units.values():
                unit.mechanical.start_rapid()

    def request(self, request: dict[str, Any]) -> Any:
        """Execute an operator's request, as `{"do": "stop", "circuit": "emergency"}`; return plain values.

        Raises:
            RequestRefused: with a sentence.
        """
        return choose(_VERBS, dict(request))(self, request)

    def named(self, name: object) -> list[Unit]:
        """Return the unit of this name, None: all.

        Raises:
            RequestRefused: there is none.
        """
        if name is None:
            return list(self.units.values())
        if not isinstance(name, str) or name not in self.units:
            raise RequestRefused(f"unit: found {shown(name)}, allowed is one of {', '.join(self.units)}")
        return [self.units[name]]

    def clear(self, request: dict[str, Any]) -> None:
        """End the faults that last.

        Raises:
            RequestRefused: there is no such unit.
        """
        if self.streaming is not None:
            self.streaming.clear()
        for unit in self.named(request.get("unit")):
            unit.clear()

    def fault(self, request: dict[str, Any]) -> None:
        """Let a fault happen or begin.

        Raises:
            RequestRefused: with a sentence.
        """
        kind, streaming = request.get("fault"), self.streaming
        if streaming is not None and kind in STREAMING_FAULTS:
            streaming.faults.add(str(kind))
            return
        if streaming is not None and kind not in _UNIT_FAULTS_OF_STREAMING:
            allowed = ", ".join((*STREAMING_FAULTS, *_UNIT_FAULTS_OF_STREAMING))
            raise RequestRefused(f"fault: found {shown(kind)}, allowed with rapid is one of {allowed}")
        for unit in self.named(request.get("unit")):
            if streaming is not None and kind == "arm_lost":
                streaming.lose(unit.mechanical.config.name)
            else:
                unit.fault(request)

    def status(self) -> dict[str, Any]:
        """Return the state of the controller and its units as plain values."""
        panel = self.panel
        return {
            "mode": panel.mode.value,
            "motors": panel.motors.value,
            "enabling": panel.enabling.value,
            "open": sorted(stop.value for stop in panel.open),
            "latched": panel.latched,
            "units": {name: unit.status() for name, unit in self.units.items()},
        } | ({} if self.streaming is None else {"streaming": self.streaming.status()})


def _number(request: dict[str, Any], most: float) -> float:
    value = request.get("value")
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= most:
        raise RequestRefused(f"value: found {shown(value)}, allowed is a number from 0 to {most:g}")
    return float(value)


def _choice(kind: type[Enum], request: dict[str, Any], key: str) -> Enum:
    value = request.get(key)
    for choice in kind:
        if choice.value == value:
            return choice
    raise RequestRefused(f"{key}: found {shown(value)}, allowed is one of {', '.join(c.value for c in kind)}")


def _set_input(controller: Controller, request: dict[str, Any]) -> None:
    streaming, name, level = controller.streaming, request.get("input"), request.get("level")
    names = [f"DI{i + 1}" for i in range(TERMINALS)]
    if streaming is None:
        raise RequestRefused("the board is served with rapid only")
    if name not in names:
        raise RequestRefused(f"input: found {shown(name)}, allowed is one of {', '.join(names)}")
    if level not in ("on", "off"):
        raise RequestRefused(f"level: found {shown(level)}, allowed is one of on, off")
    streaming.set_input(names.index(str(name)) + 1, level == "on")


_Do = Callable[[Controller, dict[str, Any]], Any]


def _press(button: Callable[[Panel], None]) -> _Do:
    return lambda controller, _: button(controller.panel)


def _switch(switch: Callable[[Panel, Any], None], key: str, kind: type[Enum]) -> _Do:
    return lambda controller, request: switch(controller.panel, _choice(kind, request, key))


def _for_each(do: Callable[[MechanicalUnit], None]) -> _Do:
    def of_units(controller: Controller, request: dict[str, Any]) -> None:
        for unit in controller.named(request.get("unit")):
            do(unit.mechanical)

    return of_units


_VERBS: dict[str, tuple[tuple[str, ...], _Do]] = {
    "status": ((), lambda controller, _: controller.status()),
    "motors_on": ((), _press(Panel.press_motors_on)),
    "motors_off": ((), _press(Panel.switch_motors_off)),
    "mode": (("mode",), _switch(Panel.select_mode, "mode", Mode)),
    "enabling": (("position",), _switch(Panel.hold_enabling, "position", Enabling)),
    "stop": (("circuit",), _switch(Panel.open_circuit, "circuit", Stop)),
    "release": (("circuit",), _switch(Panel.close_circuit, "circuit", Stop)),
    "start_rapid": (("unit",), _for_each(MechanicalUnit.start_rapid)),
    "stop_rapid": (("unit",), _for_each(MechanicalUnit.stop_rapid)),
    "clear": (("unit",), Controller.clear),
    "input": (("input", "level"), _set_input),
    "accelerometer": (
        ("unit",),
        lambda controller, request: {
            unit.mechanical.config.name: unit.mechanical.accelerometer.take()
            for unit in controller.named(request.get("unit"))
        },
    ),
    "fault": (("unit", "fault", "value", "direction"), Controller.fault),
}
"""Verb of a request -> its keys and its handler."""
