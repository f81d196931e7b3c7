"""Processes beside motion as parts of the cycle: a heater, a pump, a camera's light.

A process reads channels of the slaves and partners in the cell, and writes channels. It runs after the machine and
before the slaves' outputs are encoded, so that its outputs leave with the frame of the same cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoint
from math import isfinite
from typing import Any

from mypy_extensions import mypyc_attr

from rtcp.config.find import is_foreign, load_class, made_by, plugin_error
from rtcp.config.model import ArmConfig, ProcessConfig
from rtcp.control.part import Device, Part, PartContext, PublishedValues, checked_refusal
from rtcp.control.partners import Partners
from rtcp.ipc.commands import Command
from rtcp.ipc.events import ProcessFailed
from rtcp.ipc.refusals import ProcessRaised, Refusal
from rtcp.ipc.schema import Field, device_field
from rtcp.ipc.states import State
from rtcp.motion.step_group import Partner


class Signal:
    """A channel of a slave, in SI units; `safe`: the safe value of an output."""

    def __init__(self, values: dict[str, float], name: str, safe: float = 0.0) -> None:
        self._values = values
        self._name = name
        self.safe = safe

    def check(self) -> None:
        """Raise ValueError unless the value is a finite number; the driver limits it to the range of the channel."""
        if not isfinite(self.value):
            raise ValueError(f"{self._name}: found {self.value}, allowed is a finite number")

    @property
    def value(self) -> float:
        """Last value from the slave, or value sent to it in this cycle, SI."""
        return self._values[self._name]

    @value.setter
    def value(self, number: float) -> None:
        self._values[self._name] = number


class ProcessSetup:
    """Cycle, channels and partners for a process.

    Args:
        period_s: period of the cycle, s.
        signals: SLAVE.CHANNEL -> signal.
        partners: name -> newest record of the partner in the cell, updated in every cycle.
    """

    def __init__(self, period_s: float, signals: Mapping[str, Signal], partners: Mapping[str, Partner]) -> None:
        self.period_s = period_s
        self.signals = signals
        self.partners = partners


@mypyc_attr(allow_interpreted_subclasses=True)
class Process:
    """Base of all processes: a subclass writes its outputs in every `update`.

    Args:
        config: its keys in the configuration.
        setup: the cycle, the channels and the partners.
    """

    def __init__(self, config: ProcessConfig, setup: ProcessSetup) -> None:
        self.name = config.name
        self.commands = config.COMMANDS

    def fields(self) -> Sequence[Field]:
        """Return its fields of the cycle record, without its own name."""
        return ()

    def accept(self, command: Command, lease: int) -> Refusal | None:
        """Carry out one of the configuration's `COMMANDS`, or return its refusal without any change."""
        raise NotImplementedError

    def update(self, context: PartContext) -> None:
        """Do a cycle: read the inputs, write the outputs, report events by `context.report`."""
        raise NotImplementedError

    def publish(self, values: list[Any], at: int) -> None:
        """Write the values of `fields` into the record, from index `at` on."""

    def safe(self) -> None:
        """Set the outputs to their safe state; called on a fault, on stale inputs and at the end.

        They stay safe until the next command of the process: nothing starts by itself.
        """
        raise NotImplementedError


class ProcessPart(Part):
    """A process in the cycle.

    Its exception is a fault: it is not called any more, and its outputs are safe, until the machine is ready again.

    Args:
        number: index of the process in the configuration, from 0.
        process: the process.
        outputs: all signals that it may write.
    """

    def __init__(self, number: int, process: Process, outputs: Sequence[Signal]) -> None:
        super().__init__(process.name, [device_field(process.name, f) for f in process.fields()], process.commands)
        self.process = process
        self._number = number
        self._outputs = tuple(outputs)
        self._failed = self._reported = False
        self._error: BaseException | None = None
        self._published = PublishedValues(self.fields)
        self.is_timed = is_foreign(process)

    def _fail(self, error: BaseException) -> None:
        self._failed, self._error = True, plugin_error(error)

    def accept(self, command: Command, lease: int) -> Refusal | None:
        """Let the process carry out the command."""
        try:
            return ProcessRaised(self._number) if self._failed else checked_refusal(self.process.accept(command, lease))
        except BaseException as error:
            self._fail(error)
            return ProcessRaised(self._number)

    def update(self, context: PartContext) -> None:
        """Update the process; report its exception as a fault."""
        if self._failed and self._reported and context.state is State.READY:
            self._failed = self._reported = False
            self.safe()
        try:
            if not self._failed:
                self.process.update(context)
                for output in self._outputs:
                    output.check()
        except BaseException as error:
            self._fail(error)
        if self._error is not None:
            context.explain(f"process {self.name}", self._error)
            self._error = None
        if self._failed:
            for output in self._outputs:
                output.value = output.safe
            if not self._reported:
                self._reported = True
                context.report(ProcessFailed(self._number))

    def publish(self, values: list[Any]) -> None:
        """Write the process's values."""
        try:
            if not self._failed:
                published = self._published
                self.process.publish(published.values, 0)
                published.check()
                values[self.at : self.at + published.count] = published.values
        except BaseException as error:
            self._fail(error)
        if self._failed:
            # Zeros: not busy, and off.
            at = self.at
            for field in self.fields:
                values[at : at + field.count] = [0] * field.count
                at += field.count

    def safe(self) -> None:
        """Let the process set its outputs to their safe state."""
        try:
            self.process.safe()
        except BaseException as error:
            self._fail(error)


def make_processes(config: ArmConfig, devices: Sequence[Device], partners: Partners | None) -> list[ProcessPart]:
    """Return a part for each process of the configuration; raises PluginError."""
    inputs = {
        f"{device.name}.{name}": Signal(device.driver.values, name)
        for device in devices
        for name in device.driver.values
    }
    outputs = {
        f"{device.name}.{name}": Signal(device.driver.targets, name, device.driver.safe_values[name])
        for device in devices
        for name in device.driver.targets
    }
    records: dict[str, Partner] = {}
    if partners is not None:
        records = {member.name: record for member, record in zip(partners.members, partners.group.members, strict=True)}
    setup = ProcessSetup(config.cycle.period_us * 1e-6, {**inputs, **outputs}, records)
    parts = []
    for number, keys in enumerate(config.processes):
        entry = EntryPoint(keys.kind, keys.PROCESS, keys.ENTRY_POINTS)
        written = [outputs[text] for _, image, text in keys.channels() if image == "rpdo"]
        kind = load_class(entry, Process)
        with made_by(entry):
            parts.append(ProcessPart(number, kind(keys, setup), written))
    return parts
