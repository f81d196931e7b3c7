"""A commander that plays with a simulated arm as a user, a broken program and a bad day would; the judge beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from math import inf, nan

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.ipc.machine import Command, State
from rtcp.launch.simulation import Frame, Simulation
from rtcp.motion.limits import Values, rows
from tests.sessions.geometry import Box, depth, points
from tests.sessions.judge import COUNTS, Bounds, Judge

PERIODS_US = (1000, 1250, 1500, 2000)
DRIVE_MODES = (8, 9, 10)
FAULTS = (0x2310, 0x3210, 0x3220, 0x4310, 0x8130, 0x8400, 0x8611, 0x8612, 0x7305)
NONSENSE = (nan, inf, -inf, 1e300, -1e300, 1e9, -1e9, 0.0)
STICK = (63, 62, 61, 59, 55, 47, 31)
"""Codes of the stick, the facts' table."""
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
    keep_out: list[Box] = [(zone.min, zone.max) for zone in cartesian.keep_out]
    return Bounds(
        [joint.position.min for joint in joints],
        [joint.position.max for joint in joints],
        [joint.velocity for joint in joints],
        [joint.acceleration for joint in joints],
        [joint.torque for joint in joints],
        None if cartesian.box is None else (cartesian.box.min, cartesian.box.max),
        keep_out,
    )


def is_free(bounds: Bounds, q: Sequence[float], clearance: float = 0.0) -> bool:
    """Whether elbow, wrist and tool are outside every keep-out box, and the tool inside the box, by `clearance` m."""
    seen = points(q)
    if bounds.box is not None and depth(seen[2], bounds.box) < clearance:
        return False
    return all(depth(point, box) < -clearance for box in bounds.keep_out for point in seen)


class Driver:
    """Commands, mishaps and time; counts what became of them.

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
        self.judge = Judge(
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
        self.simulation.acquire()
        self.simulation.until(lambda: self.state is State.READY, START_S)

    def _see(self, frame: Frame) -> None:
        self.states[self.simulation.parts.behaviour.state] += 1
        self.judge.see(frame)

    def close(self) -> None:
        """Give the memory back."""
        self.simulation.close()

    @property
    def state(self) -> State:
        """The machine's state."""
        return self.simulation.state

    @property
    def violations(self) -> list[str]:
        """What the judge has found."""
        return self.judge.violations

    @property
    def commanded(self) -> list[float]:
        """The last targets on the bus, rad."""
        models, zeros = self.simulation.models, self.judge.zero
        told = [int(model.objects[0x607A, 0].value) for model in models]
        return [(counts - zero) / COUNTS for counts, zero in zip(told, zeros, strict=True)]

    # -- what may be done -------------------------------------------------------------------------------------------

    def wait(self, cycles: int) -> None:
        """Let cycles pass."""
        for _ in range(cycles):
            if self.simulation.done:
                return
            self.simulation.cycle()

    def order(self, kind: int, numbers: Sequence[float] = (), lease: int | None = None) -> bool:
        """Give a command; return whether it was taken."""
        if self.simulation.done:
            return False
        known = kind in Command.__members__.values()
        name = Command(kind).name.lower() if known else "unknown"
        self.log.append(f"{self.simulation.now_ns * 1e-9:.4f} {self.state.name} {name} {[*numbers]}")
        answer = self.simulation.order(kind, numbers, lease)
        taken = answer.refusal == 0
        (self.taken if taken else self.refused)[name] += 1
        self.log[-1] += f" -> {answer.refusal}"
        if taken and name == "zero":
            self.judge.zero[int(numbers[0])] = round(numbers[1] * COUNTS)
        return taken

    def set_limits(self, new: Values) -> bool:
        """Change the limits; the judge knows them from the frame on that is worked out under them."""
        plan = rows(new)
        slot = self.simulation.observer.write_plan(plan)
        if not self.order(Command.LIMITS, [slot, len(plan)]):
            return False
        self.limits = new
        bounds = self.bounds
        bounds.low[:], bounds.high[:] = new.low, new.high
        bounds.velocity[:], bounds.acceleration[:], bounds.torque[:] = new.velocity, new.acceleration, new.torque
        bounds.box = None if new.box is None else (new.box[:3], new.box[3:])
        bounds.keep_out[:] = [(box[:3], box[3:]) for box in new.keep_out]
        self.judge.changed()
        return True

    def happen(self, name: str, what: str = "") -> None:
        """Note a happening."""
        self.happenings[name] += 1
        self.log.append(f"{self.simulation.now_ns * 1e-9:.4f} {self.state.name} * {name} {what}")

    def enable(self) -> None:
        """Enable, and come back from whatever keeps the arm from it."""
        if self.state in (State.FAULT, State.STOPPED_BY_LIMIT, State.EMERGENCY_STOP):
            self.order(Command.RESET)
            self.simulation.until(lambda: self.state in (State.READY, State.HOLDING, State.FAULT), 0.5)
        if self.state is State.READY:
            self.order(Command.ENABLE)
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
        self.simulation.models[axis].mechanics.external_torque = torque

    def stick(self, byte: int) -> None:
        """Show a byte at the stick's inputs."""
        box = self.simulation.box
        if box is not None:
            self.happen("stick", str(byte))
            box.inputs = box.inputs & 0xFF00 | byte & 0xFF

    def press(self, pressed: bool) -> None:
        """Press or release the emergency stop (normally closed: high is released)."""
        box = self.simulation.box
        if box is not None:
            self.happen("emergency stop" if pressed else "emergency stop released")
            box.inputs = box.inputs & ~EMERGENCY_STOP_BIT if pressed else box.inputs | EMERGENCY_STOP_BIT

    def toggle(self, arm: bool) -> None:
        """Give the stick to the arm or to the chair."""
        box = self.simulation.box
        if box is not None:
            self.happen("toggle", "arm" if arm else "chair")
            box.inputs = box.inputs | TOGGLE_BIT if arm else box.inputs & ~TOGGLE_BIT


def with_start(config: ArmConfig, period_us: float, mode: str, motion: str = "joint") -> ArmConfig:
    """Return the configuration with another cycle, drive mode and motion mode."""
    cycle = replace(config.cycle, period_us=period_us)
    return replace(config, cycle=cycle, drive_mode=mode, control_mode=motion)  # type: ignore[arg-type]
