"""A process beside motion: a fan that a thermometer switches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.control.part import PartContext
from rtcp.ipc.commands import AT_REST, Command
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.schema import Field
from rtcp.processes import InputChannel, OutputChannel, Process, ProcessConfig, ProcessSetup


class RunFan(Command):
    """Turn the fan on above `kelvin`."""

    states = AT_REST
    kelvin: float


@dataclass(frozen=True)
class FanConfig(ProcessConfig):
    """A fan that a thermometer switches."""

    PROCESS = "rtcp_example.fan:Fan"
    COMMANDS = (RunFan,)
    PLOT = ("kelvin",)
    temperature: InputChannel = "thermometer.second"
    """Measured temperature, K."""
    fan: OutputChannel = ""
    """1: the fan turns; empty: there is none, and the field `on` shows what it would do."""


class Fan(Process):
    """See `FanConfig`."""

    def __init__(self, config: FanConfig, setup: ProcessSetup) -> None:
        super().__init__(config, setup)
        self._temperature, self._fan = setup.signals[config.temperature], setup.signals.get(config.fan)
        self._above, self._on = float("inf"), False

    def fields(self) -> Sequence[Field]:
        return (Field("kelvin", "float64", "K", "Temperature."), Field("on", "uint8", "", "1: the fan turns."))

    def accept(self, command: Command, lease: int) -> Refusal | None:
        assert isinstance(command, RunFan)
        self._above = command.kelvin
        return None

    def update(self, context: PartContext) -> None:
        self._on = self._temperature.value > self._above
        self._write()

    def publish(self, values: list[Any], at: int) -> None:
        values[at : at + 2] = self._temperature.value, self._on

    def safe(self) -> None:
        self._above, self._on = float("inf"), False
        self._write()

    def _write(self) -> None:
        if self._fan is not None:
            self._fan.value = float(self._on)
