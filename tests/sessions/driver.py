"""A commander of a simulated arm that acts like a user, a broken program and a bad day; the checker beside it."""

from __future__ import annotations

import mmap
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from random import Random
from typing import Any

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.ipc.commands import COMMANDS, Command, Enable, Reset, SetLimits, SetZero
from rtcp.ipc.message import PAYLOAD_SIZE, Joints, MalformedMessage
from rtcp.ipc.states import State
from rtcp.launch.simulation import Frame, Simulation
from rtcp.motion.limits import Values, rows
from tests.arm_geometry import box_gaps, depth, own_gap, points
from tests.sessions.actions import NONSENSE
from tests.sessions.frame_checker import COUNTS, Bounds, FrameChecker

KINDS = sorted((kind for kind in COMMANDS if kind.__module__ == Command.__module__), key=lambda kind: kind.name)
"""All commands of the platform; a test of another file may have registered its own."""
ODD_INTEGERS = (-1, 0, 7, 99, 1 << 40, -(1 << 63), (1 << 63) - 1)
PERIODS_US = (1000, 1250, 1500, 2000)
DRIVE_MODES = (8, 9, 10)
FAULTS = (0x2310, 0x3210, 0x3220, 0x4310, 0x8130, 0x8400, 0x8611, 0x8612, 0x7305)
EMERGENCY_STOP_BIT, TOGGLE_BIT = 1 << 9, 1 << 8
START_S = 3.0


@cache
def configuration() -> ArmConfig:
    """The default arm."""
    return load(default_config())


def bounds_of(config: ArmConfig) -> Bounds:
    """Return the limits of the configuration."""
    joints = config.joints
    cartesian = config.cartesian
    return Bounds(
        [joint.position.min for joint in joints],
        [joint.position.max for joint in joints],
        [joint.velocity for joint in joints],
        [joint.acceleration for joint in joints],
        [joint.torque for joint in joints],
        None if cartesian.box is None else (*cartesian.box.min, *cartesian.box.max),
        [(*zone.min, *zone.max) for zone in cartesian.keep_out],
    )


def is_free(bounds: Bounds, q: Sequence[float], clearance: float = 0.0) -> bool:
    """Whether all bodies are off each keep-out box and each other, and the tool inside the box, by `clearance` m."""
    if bounds.box is not None and depth(points(q)[0], bounds.box) < clearance:
        return False
    return all(gap > clearance for gap in (own_gap(q), *(gap for box in bounds.keep_out for gap in box_gaps(q, box))))


class Raw:
    """Bytes in the place of a command: doubles where the fields of the kind `number` would be."""

    name = "raw"

    def __init__(self, number: int, numbers: Sequence[float]) -> None:
        self.number = number
        count = PAYLOAD_SIZE // 8
        self.payload = struct.pack(f"<{count}d", *[*numbers, *[0.0] * count][:count])

    def __repr__(self) -> str:
        return f"Raw({self.number}, {self.payload.hex()})"

    @property
    def decoded(self) -> Command | None:
        """The command that the bytes are, or None."""
        try:
            return COMMANDS.unpack_from(self.number, self.payload, 0)
        except MalformedMessage:
            return None

    def pack_into(self, memory: mmap.mmap | bytearray, at: int) -> None:
        """Write the bytes."""
        memory[at : at + PAYLOAD_SIZE] = self.payload


def random_command(random: Random) -> Command:
    """Return a command of any kind, with fields that are of the right types and of any value.

    Not SetLimits: it would put limits of an old plan in force, of which the checker hears nothing.
    """
    kind = random.choice([kind for kind in KINDS if kind is not SetLimits])
    return kind(*(_random_field(field, random) for _, field in kind._fields))


def _random_field(kind: Any, random: Random) -> Any:
    if kind == Joints:
        return tuple(_random_number(random) for _ in range(random.choice((0, 2, 6, 6, 6, 8))))
    if kind is float:
        return _random_number(random)
    if kind is int:
        return random.choice((random.randrange(8), random.choice(ODD_INTEGERS)))
    return random.choice((False, True) if kind is bool else list(kind))


def _random_number(random: Random) -> float:
    return random.choice(NONSENSE) if random.random() < 0.03 else random.uniform(-3.0, 3.0)


class Driver:
    """Commands, faults and time; counts what became of them.

    Args:
        config: the arm.
        seed: of the bus.
        positions: rad, where the joints stand at power-on.
    """

    def __init__(self, config: ArmConfig, seed: int, positions: Sequence[float]) -> None:
        self.bounds = bounds_of(config)
        self.limits = Values.configured(config)
        self.simulation = Simulation(config, seed, positions=positions, follow_clock=False)
        slots = {slave.name: slot for slot, slave in enumerate(config.slaves)}
        self.checker = FrameChecker(
            self.bounds,
            config.cycle.period_us * 1e-6,
            [slots[joint.slave] for joint in config.joints],
            self.simulation.data.expected_wkc,
        )
        self.taken: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.happenings: Counter[str] = Counter()
        self.states: Counter[State] = Counter()
        self.log: list[str] = []
        """What was done, for whoever has to find out why it failed."""
        self.stamp = 0.0
        self.simulation.on_frame = self._see
        box = self.simulation.box
        if box is not None:
            box.inputs = 0x033F
        self._pushes: dict[int, float] = {}
        self.simulation.acquire()
        self.simulation.until(lambda: self.state is State.READY, START_S)

    def _see(self, frame: Frame) -> None:
        self.states[self.simulation.state] += 1
        self.checker.check(frame)

    def close(self) -> None:
        """Give the memory back."""
        self.simulation.close()

    @property
    def state(self) -> State:
        """The machine's state."""
        return self.simulation.state

    @property
    def violations(self) -> list[str]:
        """What the checker has found."""
        return self.checker.violations

    @property
    def commanded(self) -> list[float]:
        """The last targets on the bus, rad."""
        models, zeros = self.simulation.models, self.checker.zero
        sent = [int(model.objects[0x607A, 0].value) for model in models]
        return [(counts - zero) / COUNTS for counts, zero in zip(sent, zeros, strict=True)]

    # -- what may be done -------------------------------------------------------------------------------------------

    def wait(self, cycles: int) -> None:
        """Let cycles pass."""
        for _ in range(cycles):
            if self.simulation.done:
                return
            self.simulation.cycle()

    def send(self, command: Command, lease: int | None = None) -> bool:
        """Send a command; return whether it was accepted."""
        if self.simulation.done:
            return False
        self.log.append(f"{self.simulation.now_ns * 1e-9:.4f} {self.state.name} {command}")
        refusal = self.simulation.send(command, lease).refusal
        (self.taken if refusal is None else self.refused)[command.name] += 1
        self.log[-1] += f" -> {refusal}"
        if refusal is None and isinstance(command, SetZero):
            self.checker.zero[command.axis] = round(command.offset * COUNTS)
        return refusal is None

    def send_raw(self, number: int, numbers: Sequence[float]) -> bool:
        """Send bytes that may be no command; return whether they were accepted as one."""
        raw = Raw(number, numbers)
        return self.send(raw.decoded or raw)  # type: ignore[arg-type]

    def set_limits(self, new: Values) -> bool:
        """Change the limits; the checker knows them from the frame on that is worked out under them."""
        plan = rows(new)
        slot = self.simulation.observer.write_plan(plan)
        if not self.send(SetLimits(slot, len(plan))):
            return False
        self.limits = new
        self.bounds.put(new)
        self.checker.changed()
        return True

    def happen(self, name: str, what: str = "") -> None:
        """Note a happening."""
        self.happenings[name] += 1
        self.log.append(f"{self.simulation.now_ns * 1e-9:.4f} {self.state.name} * {name} {what}")

    def enable(self) -> None:
        """Enable, and come back from whatever keeps the arm from it."""
        if self.state in (State.FAULT, State.STOPPED_BY_LIMIT, State.EMERGENCY_STOP):
            self.send(Reset())
            self.simulation.until(lambda: self.state in (State.READY, State.HOLDING, State.FAULT), 0.5)
        if self.state is State.READY:
            self.send(Enable())
            self.simulation.until(lambda: self.state is not State.ENABLING, 0.1)

    def fault(self, axis: int, code: int) -> None:
        """Let a drive fail."""
        self.happen("drive fault", f"{axis} 0x{code:04X}")
        self.simulation.models[axis].inject_fault(code)

    def lose(self, cycles: int, heard: bool) -> None:
        """Lose frames, on their way out or back."""
        self.happen("lost frames", f"{cycles} {'back' if heard else 'out'}")
        self.simulation.data.lose(cycles, heard)

    def drop(self, position: int) -> None:
        """Let a slave leave OP."""
        self.happen("slave left OP", f"{position}")
        self.simulation.bus.drop(position, 4, 0x001B)

    def fall_silent(self) -> None:
        """Renew the lease no longer."""
        self.happen("lease lost")
        self.simulation.fall_silent()

    def acquire(self) -> None:
        """Take the lease again."""
        self.simulation.acquire()

    def push(self, axis: int, torque: float) -> None:
        """Somebody pushes a joint, Nm."""
        self.happen("push", f"{axis} {torque:.1f}")
        # Beside the weight of the arm, which the segment puts there.
        self.simulation.models[axis].mechanics.external_torque += torque - self._pushes.get(axis, 0.0)
        self._pushes[axis] = torque

    def joystick(self, byte: int) -> None:
        """Show a byte at the joystick's inputs."""
        box = self.simulation.box
        if box is not None:
            self.happen("joystick", str(byte))
            box.inputs = box.inputs & 0xFF00 | byte & 0xFF

    def press(self, pressed: bool) -> None:
        """Press or release the emergency stop (normally closed: high is released)."""
        box = self.simulation.box
        if box is not None:
            self.happen("emergency stop" if pressed else "emergency stop released")
            box.inputs = box.inputs & ~EMERGENCY_STOP_BIT if pressed else box.inputs | EMERGENCY_STOP_BIT

    def toggle(self, arm: bool) -> None:
        """Give the joystick to the arm or to the chair."""
        box = self.simulation.box
        if box is not None:
            self.happen("toggle", "arm" if arm else "chair")
            box.inputs = box.inputs | TOGGLE_BIT if arm else box.inputs & ~TOGGLE_BIT


def with_start(config: ArmConfig, period_us: float, mode: str, motion: str = "joint") -> ArmConfig:
    """Return the configuration with another cycle, drive mode and control mode."""
    cycle = replace(config.cycle, period_us=period_us)
    return replace(config, cycle=cycle, drive_mode=mode, control_mode=motion)  # type: ignore[arg-type]
