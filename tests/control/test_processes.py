"""Processes beside motion as parts of the cycle, on a platform without an arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, InputsConfig, OutputsConfig
from rtcp.control.part import PartContext
from rtcp.ipc.commands import Command, Disable, MoveJoints, Reset
from rtcp.ipc.events import ProcessFailed
from rtcp.ipc.refusals import ProcessRaised, Refusal
from rtcp.ipc.schema import Field
from rtcp.ipc.states import State
from rtcp.processes import InputChannel, OutputChannel, Process, ProcessConfig, ProcessSetup
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models.diewu import RELEASED

SAFE = 0x0300
"""Safe value of the outputs, other than zero."""
RAISES = 7


class Blink(Command):
    """Show `pattern` at the outputs."""

    states = frozenset(State)
    pattern: int


class Dark(Refusal):
    """pattern 0 shows nothing: choose another one"""


@dataclass(frozen=True)
class LampConfig(ProcessConfig):
    """Copies its pattern to the outputs of a box, while none of its inputs is pressed."""

    PROCESS = "tests.control.test_processes:Lamp"
    COMMANDS = (Blink,)
    inputs: InputChannel = "io.inputs"
    outputs: OutputChannel = "io.outputs"


class Lamp(Process):
    """See `LampConfig`."""

    def __init__(self, config: LampConfig, setup: ProcessSetup) -> None:
        super().__init__(config, setup)
        self._inputs, self._outputs = setup.signals[config.inputs], setup.signals[config.outputs]
        self.pattern = 0
        self.raises = False
        self.updates = 0

    def fields(self) -> Sequence[Field]:
        return (Field("pattern", "uint16", "", "What it shows."),)

    def accept(self, command: Command, lease: int) -> Refusal | None:
        assert isinstance(command, Blink)
        if not command.pattern:
            return Dark()
        if command.pattern == RAISES:
            raise RuntimeError("no such pattern")
        self.pattern = command.pattern
        return None

    def update(self, context: PartContext) -> None:
        self.updates += 1
        if self.raises:
            raise RuntimeError("the lamp is gone")
        self._outputs.value = self.pattern if self._inputs.value == RELEASED else 0

    def publish(self, values: list[Any], at: int) -> None:
        values[at] = self.pattern

    def safe(self) -> None:
        self.pattern = 0


@pytest.fixture
def config(tmp_path: Path) -> ArmConfig:
    (tmp_path / "segment.yaml").write_text("slaves: [{model: diewu-io}]\n")
    box = load(default_config())
    device = replace(box.slaves[0].device, kind="generic")
    pdos = tuple(replace(pdo, channels=tuple(replace(c, safe=SAFE) for c in pdo.channels)) for pdo in device.rpdo)
    slave = replace(box.slaves[0], device=replace(device, rpdo=pdos))
    platform = replace(box, joints=(), slaves=(slave,), arm=None, source=tmp_path / "lamp.yaml", gripper=None)
    return replace(platform, inputs=InputsConfig(), outputs=OutputsConfig(), processes=(LampConfig("lamp", "lamp"),))


@pytest.fixture
def running(config: ArmConfig) -> Iterator[Simulation]:
    with Simulation(config) as made:
        made.bring_to(State.READY)
        made.acquire()
        yield made


def lamp(running: Simulation) -> Lamp:
    part = next(part for part in running.loop.parts if part.name == "lamp")
    process = part.process  # type: ignore[attr-defined]
    assert isinstance(process, Lamp)
    return process


def shown(running: Simulation) -> int:
    """Return the levels at the box's outputs two cycles later."""
    for _ in range(2):
        running.cycle()
    assert running.box is not None
    return running.box.outputs


def test_a_process_is_commanded_and_writes_its_channels_without_an_arm(running: Simulation) -> None:
    running.do(Blink(5))
    assert shown(running) == 5
    record = running.observer.latest()
    assert record is not None
    assert int(record["lamp_pattern"][0]) == 5
    assert running.send(Blink(0)).refusal == Dark()
    running.hold()
    assert shown(running) == 5
    running.do(Disable())
    running.bring_to(State.READY, 1.0)


def test_what_it_reads_acts_within_two_cycles(running: Simulation) -> None:
    running.send(Blink(5))
    assert shown(running) == 5
    assert running.box is not None
    running.box.set_input(0, False)
    assert shown(running) == 0


def test_a_motion_command_of_a_platform_without_an_arm_is_refused(running: Simulation) -> None:
    running.hold()
    assert running.send(MoveJoints((), 0.5, True)).refusal is not None
    assert running.send(MoveJoints((0.1,), 0.5, True)).refusal is not None


def test_a_fault_makes_it_safe_until_it_is_commanded_again(running: Simulation) -> None:
    running.send(Blink(5))
    running.data.lose(running.config.bus.lost_cycles + 5)
    running.bring_to(State.FAULT, 1.0)
    assert shown(running) == SAFE
    running.send(Reset())
    running.bring_to(State.READY)
    assert shown(running) == 0
    running.send(Blink(6))
    assert shown(running) == 6


def test_one_that_raises_is_a_fault_with_safe_outputs_each_time(running: Simulation) -> None:
    for pattern in (5, 6):
        running.send(Blink(pattern))
        assert shown(running) == pattern
        lamp(running).raises, before = True, lamp(running).updates
        outputs = set()
        for _ in range(20):
            running.cycle()
            outputs.add(running.box.outputs)
        assert outputs == {pattern, SAFE}
        assert (running.state, lamp(running).updates) == (State.FAULT, before + 1)
        assert isinstance(running.send(Blink(pattern)).refusal, ProcessRaised)
        record = running.observer.latest()
        assert record is not None
        assert int(record["lamp_pattern"][0]) == 0
        lamp(running).raises = False
        running.run(0.1)
        assert shown(running) == SAFE
        running.send(Reset())
        running.bring_to(State.READY)
        assert shown(running) == 0
        assert lamp(running).pattern == 0
    assert sum(isinstance(record.event, ProcessFailed) for record in running.events) == 2


def test_one_that_raises_in_a_command_is_a_fault_too(running: Simulation) -> None:
    running.send(Blink(RAISES))
    running.bring_to(State.FAULT, 0.1)
    assert shown(running) == SAFE
