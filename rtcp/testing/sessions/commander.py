"""A commander of a simulated arm that acts like a user, a broken program and a bad day; the checker beside it."""

from __future__ import annotations

import mmap
import struct
from collections import Counter
from collections.abc import Sequence
from math import inf
from random import Random
from typing import Any, NamedTuple

from rtcp.config.model import MOST_AXES, ArmConfig
from rtcp.config.segment import SegmentConfig
from rtcp.ipc.commands import COMMANDS, Command, Enable, Halt, Reset, SetLimits, SetTool, SetZero
from rtcp.ipc.layout import EVENTS_HEAD_AT
from rtcp.ipc.message import PAYLOAD_SIZE, Joints, MalformedMessage
from rtcp.ipc.states import ControlMode, State
from rtcp.motion.limits import Values, rows
from rtcp.testing.inputs import Inputs
from rtcp.testing.sessions.actions import NONSENSE
from rtcp.testing.sessions.checker import Bounds, FrameChecker, Reading
from rtcp.testing.sessions.coverage import Coverage, Place, commands_of
from rtcp.testing.sessions.environment import Environment
from rtcp.testing.sessions.mechanics import MechanicsChecker
from rtcp.testing.simulation import Frame, Simulation
from rtcp.virtual.models.servo import ServoAxis

ODD_INTEGERS = (-1, 0, 7, 99, 1 << 40, -(1 << 63), (1 << 63) - 1)
FAULTS = (0x2310, 0x3210, 0x3220, 0x4310, 0x8130, 0x8400, 0x8611, 0x8612, 0x7305)
START_S = 3.0
STOP_S = 0.4
"""Longest time of a stop, beside that of slowing down from full speed, s."""
_TO_SAFEOP, _SYNC_MANAGER_WATCHDOG = 4, 0x001B


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


def random_command(kind: type[Command], random: Random, joints: int) -> Command:
    """Return a command of a kind, with fields that are of the right types and of any value."""
    return kind(*(_random_field(field, random, joints) for field in kind.field_types.values()))


def _random_field(kind: Any, random: Random, joints: int) -> Any:
    if kind == Joints:
        return tuple(_random_number(random) for _ in range(random.choice((0, 2, joints, joints, joints, MOST_AXES))))
    if kind is float:
        return _random_number(random)
    if kind is int:
        return random.choice((random.randrange(8), random.choice(ODD_INTEGERS)))
    if kind is str:
        return "".join(chr(random.randrange(32, 0x300)) for _ in range(random.choice((0, 1, 8, 300))))
    return random.choice((False, True) if kind is bool else list(kind))


def _random_number(random: Random) -> float:
    return random.choice(NONSENSE) if random.random() < 0.03 else random.uniform(-3.0, 3.0)


class Entry(NamedTuple):
    """What was done or happened, for whoever has to find out why a session failed."""

    time_ns: int
    text: str

    def __str__(self) -> str:
        return f"{self.time_ns * 1e-9:.4f} {self.text}"


class Commander:
    """Commands, faults and time; counts what became of them.

    Args:
        config: the arm.
        seed: of the bus and of the environment.
        positions: of the joints at power-on, rad.
        reading: how its frames are read.
        segment: the slaves; None: the configured segment.
        simulation: the arm's simulation, which the caller starts; None: one is made here and started.

    Attributes:
        coverage: counts of commands by where they were sent, of events and of refusals.
        environment: hands, loads, and measurements that are false.
    """

    def __init__(
        self,
        config: ArmConfig,
        seed: int,
        positions: Sequence[float],
        reading: Reading,
        segment: SegmentConfig | None = None,
        simulation: Simulation | None = None,
    ) -> None:
        self.bounds = Bounds.configured(config)
        self.limits = Values.configured(config)
        starts = simulation is None
        if simulation is None:
            simulation = Simulation(config, seed, positions=positions, segment=segment, follow_clock=False)
            simulation.unlink()
        self.simulation = simulation
        self.kinds = commands_of(simulation)
        """All commands of the arm."""
        count = len(config.joints)
        self.checker = FrameChecker(
            self.bounds, config.cycle.period_us * 1e-6, reading, self.simulation.data.expected_wkc,
            config.zero_offsets[:count],
        )  # fmt: skip
        slaves = {slave.name: on_bus for slave, on_bus in zip(config.slaves, self.simulation.bus.slaves, strict=True)}
        self.servos: list[ServoAxis] = [slaves[j.slave].device.servos[j.axis - 1] for j in config.joints]
        self.taken: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.states: Counter[State] = Counter()
        self.log: list[Entry] = []
        self.coverage = Coverage()
        self.inputs = Inputs(simulation)
        self.environment = Environment(Random(seed), simulation, self.servos, self.inputs, self.count_fault)
        self.checker.stuck_until_ns = self.environment.stuck_until_ns
        self.mechanics = MechanicsChecker(self.checker, config, self.servos)
        self.pressed = self._silent = False
        """Whether an emergency stop is pressed that concerns the arm, and whether the lease is not renewed."""
        self._event = 0
        """Number of the last event in the log."""
        simulation.on_frame = self._see
        if starts:
            self.start()

    def start(self) -> None:
        """Acquire a lease and wait until the machine is ready."""
        self.simulation.acquire()
        self.simulation.until(lambda: self.state is State.READY or self.simulation.done, START_S)

    def _see(self, frame: Frame) -> None:
        state = self.simulation.state
        self.states[state] += 1
        self.checker.check(frame, state)
        self.environment.step(frame.now_ns)
        self.mechanics.check(frame, state, self.environment)
        head = self.simulation.board.words[EVENTS_HEAD_AT]
        if head != self._event:
            # An event has the time of the host.
            for record in self.simulation.observer.events_since(self._event):
                self.log.append(Entry(frame.now_ns, self.simulation.names.message(record.event)))
                self.coverage.events[record.event.name] += 1
                self.mechanics.event(record.event, frame.now_ns)
            self._event = head

    def close(self) -> None:
        """Free the memory."""
        self.simulation.close()

    @property
    def state(self) -> State:
        """The machine's state."""
        return self.simulation.state

    @property
    def seconds(self) -> float:
        """Simulated time since power-on, s."""
        return self.checker.frames * self.simulation.period_ns * 1e-9

    @property
    def commanded(self) -> list[float]:
        """The last targets on the bus, rad."""
        return list(self.checker.targets)

    @property
    def place(self) -> Place:
        """Where a command arrives now."""
        arm = self.simulation.loop.arm
        return Place(self.state, arm.control_mode, arm.wanted_mode)

    @property
    def stopped_ns(self) -> int:
        """When the arm rests if a stop begins now, simulated time."""
        limits = zip(self.limits.velocity, self.limits.acceleration, self.limits.jerk, strict=True)
        return self.simulation.now_ns + round(1e9 * (STOP_S + max(v / a + a / j for v, a, j in limits)))

    def _note(self, text: str) -> None:
        self.log.append(Entry(self.simulation.now_ns, f"{self.state.name} {text}"))

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
        self._note(f"{command}")
        at = len(self.log) - 1
        place = self.place
        under_way = self.simulation.loop.arm.active.name if place.state is State.MOVING else ""
        refusal = self.simulation.send(command, lease).refusal
        self.coverage.command(command.name, place, under_way, refusal)
        (self.taken if refusal is None else self.refused)[command.name] += 1
        answer = "accepted" if refusal is None else self.simulation.names.message(refusal)
        self.log[at] = self.log[at]._replace(text=f"{self.log[at].text} -> {answer}")
        if refusal is None:
            self._tell_checker(command)
        return refusal is None

    def _tell_checker(self, command: Command) -> None:
        """Tell what an accepted command changes for the checks."""
        checker = self.checker
        self.mechanics.accepted(command, self.simulation.now_ns)
        if isinstance(command, SetZero) and command.axis < len(checker.zero):
            checker.zero[command.axis] = command.offset
        elif isinstance(command, SetTool):
            checker.use(command.tool)
        elif isinstance(command, Reset | Enable) and not self.pressed:
            checker.torque_off_from_ns = inf
        if not self._silent:
            checker.rest_from_ns = self.stopped_ns if isinstance(command, Halt) else inf

    def overtake(self, command: Command, stop: type[Command]) -> None:
        """Send a command, and request a stop before the loop has taken the command: the stop overtakes it."""
        simulation = self.simulation
        if simulation.done:
            return
        observer, place = simulation.observer, self.place
        self._note(f"{command}, overtaken by {stop.name}")
        number = observer.command(simulation.lease, command)
        requested_ns = observer.stop(stop)
        self.wait(2)
        for name, answer in (
            (command.name, observer.answer(number)),
            (stop.name, observer.stop_answer(stop, requested_ns)),
        ):
            if answer is not None:
                self.coverage.command(name, place, "", answer.refusal)
                (self.taken if answer.refusal is None else self.refused)[name] += 1
                if answer.refusal is None:
                    self._tell_checker(command if name == command.name else stop())

    def send_raw(self, number: int, numbers: Sequence[float]) -> bool:
        """Send bytes that may be no command; return whether they were accepted as one."""
        raw = Raw(number, numbers)
        return self.send(raw.decoded or raw)  # type: ignore[arg-type]

    def set_limits(self, new: Values, *, widen: bool = False) -> bool:
        """Change the limits; the checker knows them from the first frame that is computed under them."""
        plan = rows(new)
        slot = self.simulation.observer.write_plan(plan)
        if not self.send(SetLimits(slot, len(plan), widen)):
            return False
        self.limits = new
        self.bounds.put(new)
        self.checker.changed()
        return True

    def count_fault(self, name: str, what: str = "") -> None:
        """Note a fault or an action of a person."""
        self.faults[name] += 1
        self._note(f"* {name} {what}")

    def enable(self) -> None:
        """Enable, and end whatever keeps the arm from it."""
        if self.state in (State.FAULT, State.STOPPED_BY_LIMIT, State.EMERGENCY_STOP):
            self.send(Reset())
            self.simulation.until(lambda: self.state in (State.READY, State.HOLDING, State.FAULT), 0.5)
        if self.state is State.READY:
            self.send(Enable())
            self.simulation.until(lambda: self.state is not State.ENABLING, 0.5)

    def fault(self, axis: int, code: int) -> None:
        """Let a drive fail."""
        self.count_fault("drive fault", f"{axis} 0x{code:04X}")
        self.servos[axis].inject_fault(code)

    def lose(self, cycles: int, heard: bool) -> None:
        """Lose frames, on their way out or back."""
        self.count_fault("lost frames", f"{cycles} {'back' if heard else 'out'}")
        self.simulation.data.lose(cycles, heard)

    def drop(self, position: int) -> None:
        """Let a slave leave OP."""
        self.count_fault("slave left OP", f"{position}")
        self.simulation.bus.drop(position, _TO_SAFEOP, _SYNC_MANAGER_WATCHDOG)

    def fall_silent(self) -> None:
        """Stop renewing the lease."""
        self.count_fault("lease lost")
        self.simulation.fall_silent()
        self._silent = True
        record = self.simulation.observer.latest()
        # The joystick moves the arm without a lease.
        if record is not None and int(record["control_mode"][0]) != ControlMode.JOYSTICK:
            lease_ns = round(1e9 * self.simulation.config.lease_s)
            self.checker.rest_from_ns = self.stopped_ns + lease_ns

    def acquire(self) -> None:
        """Acquire a lease again."""
        self.simulation.acquire()
        self._silent, self.checker.rest_from_ns = False, inf

    def push(self, axis: int, torque: float) -> None:
        """Push a joint, Nm."""
        self.count_fault("push", f"{axis} {torque:.1f}")
        self.environment.push(axis, torque)

    def joystick(self, pressed: int) -> None:
        """Press directions and paddles of the joystick, as `Inputs.joystick`."""
        if self.inputs.present:
            self.count_fault("joystick", str(pressed))
            if not self._silent:
                self.checker.rest_from_ns = inf
            self.inputs.joystick(pressed)

    def press(self, pressed: bool) -> None:
        """Press or release the emergency stop."""
        if self.inputs.present:
            self.count_fault("emergency stop" if pressed else "emergency stop released")
            contact, self.pressed = self.simulation.config.inputs.emergency_stop, pressed
            self.inputs.set(contact, pressed)
            if contact is not None and pressed:
                self.checker.torque_off_from_ns = self.stopped_ns

    def switch(self, pressed: bool) -> None:
        """Press or release the enabling switch."""
        if self.environment.switch(pressed):
            self.checker.rest_from_ns = inf if pressed else self.stopped_ns

    def toggle(self, arm: bool) -> None:
        """Switch the joystick to the arm or to the chair."""
        if self.inputs.present:
            self.count_fault("toggle", "arm" if arm else "chair")
            self.inputs.set(self.simulation.config.inputs.arm_toggle, arm)
