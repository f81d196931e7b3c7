"""The real loop on mutated process data: statuswords, positions, modes, the stick's byte, counters and clock."""

from __future__ import annotations

import struct
import time
import traceback
from dataclasses import replace
from random import Random

from rtcp.config import default_config, load
from rtcp.ipc.commands import Disable, Enable, Halt, MoveJoints, Reset
from rtcp.ipc.states import State
from rtcp.testing.simulation import Frame, Simulation
from tests.malformed.mutate import EDGES
from tests.malformed.mutated_frames import Memory, Outcome

WIRE = struct.Struct("<HiiiB")
COUNTS = 10_000.0
ENABLE_OPERATION = 0x0F
STATE_MASK, OPERATION_ENABLED = 0x6F, 0x27
CSP, CSV, CST = 8, 9, 10
START = (0.0, 0.3, 1.2, 0.0, 0.5, 0.0)
MARGIN = 0.03
"""rad; so far outside its range a joint may be enabled, to be brought back."""
_SHARES = (0.0, 0.002, 0.05, 0.5)
_STRETCH = 400


class Garbler:
    """Wraps `receive` of the process data: mutates a share of the answers."""

    def __init__(self, simulation: Simulation, random: Random) -> None:
        self.share = 0.0
        self.mutated = 0
        self._data = simulation.data
        self._random = random
        self._receive = simulation.data.receive
        simulation.data.receive = self.receive  # type: ignore[method-assign]

    def receive(self) -> int:
        wkc = self._receive()
        data, random = self._data, self._random
        if wkc < 0 or random.random() >= self.share:
            return wkc
        self.mutated += 1
        if random.random() < 0.1:
            data.dc_time = random.choice((0, -1, -(1 << 63), (1 << 63) - 1, data.dc_time ^ 1 << random.randrange(63)))
        if random.random() < 0.1:
            data.wkc = random.choice((0, 1, 20, 22, 63, 0xFFFF))
            return data.wkc
        data.inputs = list(data.inputs)
        for _ in range(random.choice((1, 1, 1, 3, 7))):
            at = random.randrange(len(data.inputs))
            data.inputs[at] = self._mutated(data.inputs[at])
        return wkc

    def _mutated(self, given: bytes) -> bytes:
        """Other bytes, of the same length: a frame's length is judged before."""
        random = self._random
        mutated = bytearray(given)
        kind = random.random()
        if kind < 0.3:
            mutated[random.randrange(len(mutated))] ^= 1 << random.randrange(8)
        elif kind < 0.5:
            at = random.randrange(len(mutated))
            mutated[at : at + 4] = random.randbytes(len(mutated[at : at + 4]))
        elif kind < 0.7 and len(mutated) == WIRE.size:
            status, position, velocity, torque, mode = WIRE.unpack(mutated)
            wild = random.choice(
                (
                    -(1 << 31),
                    (1 << 31) - 1,
                    0,
                    max(-(1 << 31), min(position + random.randrange(-20_000, 20_000), (1 << 31) - 1)),
                )
            )
            fields = random.choice((
                (random.choice(EDGES), position, velocity, torque, mode), (status, wild, velocity, torque, mode),
                (status, position, wild, torque, mode), (status, position, velocity, wild, mode),
                (status, position, velocity, torque, random.randrange(256)),
            ))  # fmt: skip
            mutated[:] = WIRE.pack(*fields)
        elif kind < 0.85:
            mutated[:] = random.choice((b"\x00", b"\xff", b"\x80", b"\x7f")) * len(mutated)
        else:
            mutated[:] = random.randbytes(len(mutated))
        return bytes(mutated)


class Watch:
    """Checks every frame: the targets of enabled drives.

    Enabled by its own word: what the loop has heard of it may be wrong.
    """

    def __init__(self, simulation: Simulation) -> None:
        config = simulation.config
        slots = {slave.name: slot for slot, slave in enumerate(config.slaves)}
        self._slots = [slots[joint.slave] for joint in config.joints]
        self._words = [model.objects[0x6041, 0] for model in simulation.models]
        self._joints = config.joints
        self._dt = config.cycle.period_us * 1e-6
        self._before: list[tuple[int, int] | None] = [None] * len(self._joints)
        self.failures: list[str] = []
        self.enabled = 0
        self.largest = 0.0
        """Largest step, as a fraction of the speed limit's step in a cycle."""

    def see(self, frame: Frame) -> None:
        for axis, (slot, joint) in enumerate(zip(self._slots, self._joints, strict=True)):
            control, position, velocity, torque, mode = WIRE.unpack(frame.sent[slot])
            if control != ENABLE_OPERATION or int(self._words[axis].value) & STATE_MASK != OPERATION_ENABLED:
                self._before[axis] = None
                continue
            self.enabled += 1
            here, where = position / COUNTS, f"at {frame.now_ns * 1e-9:.4f} joint {axis + 1}"
            if mode == CSP:
                low, high = joint.position.min - MARGIN, joint.position.max + MARGIN
                if not low <= here <= high:
                    self.failures.append(f"{where}: target {here} rad, allowed {low} to {high}")
                if (before := self._before[axis]) is not None and before[1] == mode:
                    step = (abs(position - before[0]) - 1) / COUNTS / (joint.velocity * self._dt)
                    self.largest = max(self.largest, step)
                    if step > 1.0:
                        self.failures.append(f"{where}: a step of {step:.1f} times what the speed limit allows")
            if abs(velocity) > joint.velocity * COUNTS + 1:
                self.failures.append(f"{where}: {velocity} counts/s, more than its speed limit")
            if mode == CST and abs(torque) > joint.torque * COUNTS + 1:
                self.failures.append(f"{where}: {torque} counts of torque, more than its limit")
            self._before[axis] = (position, mode)


def run(count: int, seed: int) -> Outcome:
    """Run the loop until `count` answers were mutated, a third in each drive mode; a failure names kind and cycle."""
    outcome = Outcome("loop behind the master")
    for at, mode in enumerate(("csp", "csv", "cst")):
        part = _run(count // 3, seed + at, mode)
        outcome.frames += part.frames
        outcome.seconds += part.seconds
        outcome.starts += part.starts
        outcome.kinds += part.kinds
        outcome.failures += [f"{mode}, {failure}" for failure in part.failures]
        outcome.objects = max(outcome.objects, part.objects)
        outcome.kilobytes = max(outcome.kilobytes, part.kilobytes)
    return outcome


def _run(count: int, seed: int, mode: str) -> Outcome:
    outcome = Outcome(mode)
    random = Random(seed)
    config = load(default_config())
    config = replace(config, drive_mode=mode, cycle=replace(config.cycle, period_us=1000.0))  # type: ignore[arg-type]
    began = time.monotonic()
    memory: Memory | None = None
    with Simulation(config, seed, positions=START) as simulation:
        garbler, watch = Garbler(simulation, random), Watch(simulation)
        simulation.on_frame = watch.see
        simulation.acquire()
        simulation.bring_to(State.READY)
        while garbler.mutated < count and len(outcome.failures) < 10:
            if memory is None and garbler.mutated >= 0.3 * count:
                memory = Memory()
            garbler.share = random.choice(_SHARES)
            try:
                _send_something(simulation, random)
                for _ in range(random.randrange(_STRETCH)):
                    before = simulation.now_ns
                    simulation.cycle()
                    if not 0 < simulation.now_ns - before < 3_000_000:
                        outcome.failures.append(f"the next cycle came {simulation.now_ns - before} ns later")
            except Exception:
                outcome.failures.append(f"after {garbler.mutated}:\n{traceback.format_exc()}")
            outcome.kinds[simulation.state.name] += 1
            outcome.failures += watch.failures[: 10 - len(outcome.failures)]
            watch.failures.clear()
        garbler.share = 0.0
        outcome.starts += _sane(simulation)
        if not outcome.starts:
            outcome.failures.append(f"cannot be enabled afterwards: {simulation.state.name}, {simulation.events[-3:]}")
        outcome.frames = garbler.mutated
        outcome.kinds["cycles with a drive enabled"] = watch.enabled // 6
    outcome.seconds = time.monotonic() - began
    if memory is not None:
        memory.report(outcome)
    return outcome


def _send_something(simulation: Simulation, random: Random) -> None:
    """Enable, move, jog, halt, move back: a random command that fits the state, sometimes one that does not."""
    state = simulation.state
    if state in (State.FAULT, State.STOPPED_BY_LIMIT, State.EMERGENCY_STOP):
        simulation.send(Reset())
    elif state is State.READY:
        simulation.send(Enable())
    elif random.random() < 0.6:
        speed = random.choice((0.0, 0.5))
        simulation.send(MoveJoints(tuple(q + random.uniform(-0.3, 0.3) for q in START), speed, True))
    else:
        simulation.send(random.choice((Halt(), Disable(), Enable(), Reset())))


def _sane(simulation: Simulation) -> bool:
    """Whether the arm holds again after the answers are right."""
    simulation.run(0.5)
    for _ in range(5):
        if simulation.state not in (State.READY, State.HOLDING, State.MOVING):
            simulation.send(Reset())
            simulation.run(1.0)
        if simulation.state is State.READY:
            simulation.send(Enable())
            simulation.run(1.0)
        if simulation.state is State.HOLDING:
            return True
    return False
