"""One scene a function, played in a process that has the example package installed: `play.py CONFIG` prints JSON.

A process of its own: what a package registers stays registered for the process's life.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rtcp.config import load
from rtcp.control.part import Device
from rtcp.ipc.commands import Halt
from rtcp.ipc.names import Names
from rtcp.ipc.states import State
from rtcp.testing.simulation import Frame, Simulation


def started(path: Path) -> Simulation:
    """An enabled arm."""
    simulation = Simulation(load(path), follow_clock=False)
    simulation.hold()
    return simulation


def sway(path: Path) -> Any:
    """The commanded position of joint 6 through a sway, its end, a refused one, and a halt."""
    from rtcp_example.sway import Sway

    with started(path) as simulation:
        names, state = Names(simulation.config), simulation.loop.arm.state
        begin = state.commanded[5]
        positions: list[float] = []
        answer = simulation.send(Sway(5, 0.02, 1.0, 2.0))
        assert simulation.state is State.MOVING, answer
        while simulation.state is State.MOVING:
            positions.append(state.commanded[5] - begin)
            simulation.cycle()
        arrived = simulation.state.name, state.commanded[5] - begin
        refused = simulation.send(Sway(5, 1.0, 5.0, 2.0)).refusal
        simulation.send(Sway(5, 0.02, 1.0, 2.0))
        simulation.run(0.7)
        halted_at = state.commanded[5] - begin
        simulation.send(Halt())
        stopped = simulation.until(lambda: simulation.state is State.HOLDING, 1.0)
        return {
            "positions": positions,
            "period_s": simulation.period_ns * 1e-9,
            "arrived": arrived,
            "refused": refused and names.message(refused),
            "halted_at": halted_at,
            "stopped": stopped,
        }


def fan(path: Path) -> Any:
    """Output of the process before its command, after it, and after a halt."""
    from rtcp_example.fan import RunFan

    own = path.with_name("fan.yaml")
    own.write_text(path.read_text() + "\nprocesses: [{kind: fan, name: fan}]\n")
    with started(own) as simulation:

        def published() -> list[float]:
            simulation.run(0.01)
            record = simulation.observer.latest()
            assert record is not None
            return [float(record["fan_kelvin"][0]), int(record["fan_on"][0])]

        before = published()
        simulation.do(RunFan(before[0] - 1.0))
        after = published()
        simulation.send(Halt())
        kelvin = next(device for device in simulation.loop.devices if device.name == "thermometer").driver.values[
            "second"
        ]
        return {"before": before, "after": after, "halted": published(), "kelvin": kelvin}


def thermometer(path: Path) -> Any:
    """Decoded and recorded temperatures, beside the bytes on the bus and those of the model."""
    with started(path) as simulation:
        frames: list[Frame] = []
        simulation.on_frame = frames.append
        simulation.run(0.5)
        part = next(part for part in simulation.loop.parts if part.name == "thermometer")
        assert isinstance(part, Device)
        slot, driver = part.slot, part.driver
        counts = struct.unpack("<hh", frames[-1].received[slot])
        record = simulation.observer.latest()
        assert record is not None
        model: Any = simulation.bus.slaves[slot].device
        return {
            "driver": type(driver).__name__,
            "values": driver.values,
            "counts": counts,
            "model": model.kelvin,
            "record": [float(record[0]["thermometer_first"]), float(record[0]["thermometer_second"])],
            "unit": simulation.observer.schema["thermometer_first"].unit,
        }


def alarm(path: Path) -> Any:
    """Its command, refused and accepted, the event that follows, and the fault that stops the arm."""
    from rtcp_example.thermometer import SetAlarm

    with started(path) as simulation:
        names = Names(simulation.config)
        refused = simulation.send(SetAlarm(200.0)).refusal
        accepted = simulation.send(SetAlarm(305.0)).refusal is None
        simulation.until(lambda: simulation.events[-1].event.name == "warm", 5.0)
        states = [simulation.state.name]
        simulation.bring_to(State.FAULT)
        states.append(simulation.state.name)
        return {
            "refused": refused and names.message(refused),
            "accepted": accepted,
            "states": states,
            "events": [names.message(record.event) for record in simulation.events if record.event.number > 1000],
            "fault": int(simulation.loop.machine.fault),
        }


def wire_break(path: Path) -> Any:
    """The fault on a real segment object: named as a script names it, begun and cleared by the registry."""
    from rtcp.config.segment import load_segment
    from rtcp.virtual.faults.fault import FaultRefused
    from rtcp.virtual.faults.registry import FaultRegistry, parse
    from rtcp.virtual.segment import make_segment

    config = load(path)
    segment = make_segment(load_segment(config.source.parent / config.bus.segment), time.monotonic_ns())
    model: Any = segment.slaves[7].device
    registry = FaultRegistry(segment, lambda frame: None, time.monotonic_ns())
    shown: list[int] = []

    def step() -> None:
        model.step(0.001)
        shown.append(model.objects[0x6000, 1].value)

    planned, _ = parse({"fault": "wire_break", "slave": 8})
    other, _ = parse({"fault": "wire_break", "slave": 1})
    assert planned is not None
    assert other is not None
    step()
    number = registry.begin(planned, time.monotonic_ns())
    step()
    registry.clear(number, time.monotonic_ns())
    step()
    refused = ""
    try:
        registry.begin(other, time.monotonic_ns())
    except FaultRefused as error:
        refused = str(error)
    _, wrong = parse({"fault": "wire_break", "slave": 0})
    return {"shown": shown, "refused": refused, "wrong": [str(finding) for finding in wrong]}


def methods(path: Path) -> Any:
    """The method that the gateway makes of the command, and its answer to wrong parameters."""
    from rtcp.gateway.methods import Methods
    from rtcp.gateway.status_snapshot import StatusSnapshot
    from rtcp.ipc.session import Session

    async def end_platform() -> list[str]:
        return []

    with Simulation(load(path)) as simulation, tempfile.TemporaryDirectory() as directory:
        session = Session(simulation.config, "virtual", "ecat0", 0, time.monotonic_ns())
        snapshot = StatusSnapshot(simulation.observer, session, {})
        table = Methods(simulation.observer, snapshot, session, Path(directory), end_platform).table
        entry = table["sway"]
        _, findings = entry.parameters.check({"axis": 5, "amplitude": 0.02, "frequency": "fast"})
        return {
            "documentation": entry.documentation,
            "streams": entry.streams,
            "findings": [str(finding) for finding in findings],
        }


if __name__ == "__main__":
    _, config = sys.argv
    scenes = (sway, thermometer, alarm, wire_break, methods, fan)
    json.dump({play.__name__: play(Path(config)) for play in scenes}, sys.stdout)
