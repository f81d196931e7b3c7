"""A heater on signals of its own, with a lumped rod behind the gate; no slave and no bus."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

from rtcp.ipc.commands import Command
from rtcp.ipc.events import Event
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.states import State
from rtcp.motion.step_group import Partner
from rtcp.processes import ProcessSetup, Signal
from rtcp.processes.shape_setting import messages
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.interlocks import Mode
from rtcp.processes.shape_setting.process import ShapeSetting

PERIOD_S = 0.0005
LATENCY = 2
"""Cycles from the gate's command to the conversion that shows it."""
CONFIG = ShapeSettingConfig("shape_setting", "heater", arms=("left", "right"), relay_close_s=0.005, relay_open_s=0.005)
PROFILE = messages.SetHeatProfile(
    20.0, 20.0, 5000.0, 1.0, 5.0, 500.0, 200.0, 0.2, 400.0, 50.0, 1000.0,
    heat_capacity=0.75, convected=24.0, radiated=0.0, tolerance=0.03,
)  # fmt: skip
CONFIRMED = messages.MeasureResistance(True, messages.RodPhase.AUSTENITE)
LEASE = 7


class Context:
    """A fake `PartContext` that collects events; the compiled class cannot be extended."""

    def __init__(self) -> None:
        self.period_s = PERIOD_S
        self.cycle = self.now_ns = 0
        self.state, self.good, self.commander = State.HOLDING, True, True
        """The lease is held while `commander` is true."""
        self.events: list[Event] = []

    def report(self, event: Event) -> None:
        self.events.append(event)

    def lease_held(self, lease: int) -> bool:
        return self.commander and lease == LEASE


class Rig:
    """A heater and its simulated hardware; `forced` inputs do not follow the hardware."""

    def __init__(
        self, config: ShapeSettingConfig = CONFIG, resistance: float = 0.34, heat_capacity: float = 0.75
    ) -> None:
        self.config = config
        names = [text for _, _, text in config.channels()]
        self.values = dict.fromkeys(names, 0.0)
        self.partners = {name: Partner(6) for name in config.arms}
        self.context = Context()
        self.forced: dict[str, float] = {}
        self.initial, self.capacity = resistance, heat_capacity
        self.celsius, self.loss = 20.0, 0.05
        self.commands = [False] * LATENCY
        self.relay_cycles = 0
        self.arms_follow = True
        setup = ProcessSetup(PERIOD_S, {name: Signal(self.values, name) for name in names}, self.partners)
        self.heater = ShapeSetting(config, setup)
        self.heater._since_heat_s = inf  # the rod is cold, without the platform's waiting time
        self.set(battery_voltage=12.5, fuse_ok=1, chassis_voltage=5.0)
        for arm in self.partners.values():
            arm.state, arm.motion_allowed = State.HOLDING, True

    def set(self, **inputs: float) -> None:
        for key, value in inputs.items():
            self.values[getattr(self.config, key)] = float(value)

    def get(self, key: str) -> float:
        return self.values[getattr(self.config, key)]

    @property
    def gate(self) -> bool:
        return self.get("gate") > 0.5

    @property
    def relay(self) -> bool:
        return self.get("relay") > 0.5

    @property
    def resistance(self) -> float:
        return self.initial * (1.0 + 2e-4 * (self.celsius - 20.0))

    def hardware(self) -> None:
        """The inputs from the slaves: the relay takes 3 ms, a conversion shows the gate of two cycles before."""
        closed = self.get("relay_closed") > 0.5
        self.relay_cycles = self.relay_cycles + 1 if closed is not self.relay else 0
        if self.relay_cycles > 6:
            closed = self.relay
        self.commands.append(self.gate and closed)
        conducts = self.commands.pop(0) and closed
        current = 12.0 / (self.resistance + 0.012) if conducts else 0.0
        power = current * current * self.resistance - self.loss * (self.celsius - 20.0)
        self.celsius += power * PERIOD_S / self.capacity
        self.set(
            relay_closed=closed, gate_sense=conducts, current=current, voltage=current * self.resistance,
            sample=(self.get("sample") + 1) % 65536, alive=(self.get("alive") + 1) % 65536,
        )  # fmt: skip

    def cycle(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            self.context.now_ns += 500_000
            self.context.cycle += 1
            if self.context.good:
                self.hardware()
                self.set(**self.forced)
            if self.arms_follow:
                for arm in self.partners.values():
                    arm.time_ns = self.context.now_ns
            self.heater.update(self.context)  # type: ignore[arg-type]

    def until(self, state: messages.HeaterState, cycles: int = 20_000) -> None:
        for _ in range(cycles):
            if self.heater.state is state:
                return
            self.cycle()
        raise AssertionError(f"{self.heater.state.name} after {cycles} cycles, not {state.name}")

    def send(self, command: Command) -> Refusal | None:
        return self.heater.accept(command, LEASE if command.needs_lease else 0)

    def key(self, mode: Mode) -> None:
        self.set(key_manual=mode is Mode.MANUAL, key_auto=mode is Mode.AUTO)

    def permit(self, mode: Mode) -> None:
        """Set key, and button or the robot's circuit, as an operator does for a mode."""
        self.key(mode)
        is_manual = mode is Mode.MANUAL
        self.set(button_a=is_manual, button_b=is_manual, circuit_a=not is_manual, circuit_b=not is_manual)
        self.cycle(2)

    def arm(self, mode: Mode = Mode.AUTO) -> None:
        self.permit(mode)
        assert self.send(messages.ArmHeater()) is None
        self.cycle(12)
        assert self.heater.state is messages.HeaterState.ARMED

    def heat(
        self, mode: Mode = Mode.AUTO, state: messages.HeaterState = messages.HeaterState.HEATING, **profile: Any
    ) -> None:
        """Arm, measure, start; return in a state, with the gate on where it heats."""
        self.arm(mode)
        assert self.send(CONFIRMED) is None
        self.until(messages.HeaterState.ARMED)
        target_c = profile.get("target_c", PROFILE.target_c)
        properties = {"heat_capacity": self.capacity, "convected": self.loss * (target_c - 20.0)} | profile
        assert self.send(replace(PROFILE, **properties)) is None
        assert self.send(messages.StartHeating()) is None
        self.until(state)
        for _ in range(200):
            if self.gate or state not in (messages.HeaterState.HEATING, messages.HeaterState.HOLDING):
                return
            self.cycle()
        raise AssertionError("the gate never came on")
