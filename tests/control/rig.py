"""A rig: the loop's parts, a small arm of real device models, and everything that goes over the wire between."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from time import monotonic_ns
from types import SimpleNamespace
from typing import Any, NamedTuple

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, InputConfig, InputsConfig, OutputsConfig
from rtcp.control.bus_service import BusService
from rtcp.control.cycle import Cycle, record_schema
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import Command, Disable, Enable, Halt, Home, MoveJoints, Reset, SetDriveMode, Shutdown
from rtcp.ipc.events import EmergencyStop, Event
from rtcp.ipc.names import Names
from rtcp.ipc.observer import Answer, EventRecord, Observer
from rtcp.ipc.states import DriveMode, State
from rtcp.realtime.discipline import Discipline
from rtcp.virtual.models import create
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage

PERIOD_S = 0.001
COUNTS = 10000
ENABLE_TIMEOUT_S = 0.2
DEBOUNCE_S = 0.005
"""Of the emergency stop's input, which a reset waits for as well."""
LOST_CYCLES = 40
CSP, CSV, CST = 8, 9, 10
EMERGENCIES = {kind for kind in Event.kinds if issubclass(kind, EmergencyStop)}
"""Events of the emergency stop: tested in test_emergency_stop.py."""
CONTROLWORD, QUICK_STOP_OPTION, MODES_OF_OPERATION = 0x6040, 0x605A, 0x6060
VOLTAGE_OFF, QUICK_STOP, SWITCH_ON, ENABLE_OPERATION = 0x00, 0x02, 0x07, 0x0F
UNDER_VOLTAGE = 0x3220
SPEED = 0.3
NOTHING_PRESSED = 0x033F
"""Levels at the box's inputs: stick neutral, toggle at arm (9), emergency stop closed (10)."""
EMERGENCY_STOP_INPUT = 9
"""Channel of the box, from 0."""
WITH_TORQUE = (0x27, 0x07)
"""Statuswords, masked, of Operation Enabled and Quick Stop Active (CiA 402-2, object 0x6041)."""


def small_arm() -> ArmConfig:
    """The first two joints of the default arm with its IO box, on a network interface: nothing is widened there."""
    config = load(default_config())
    return replace(
        config,
        slaves=config.slaves[:3],
        joints=config.joints[:2],
        cycle=replace(config.cycle, period_us=PERIOD_S * 1e6),
        bus=replace(config.bus, interface="eth0", lost_cycles=LOST_CYCLES),
        enable_timeout_s=ENABLE_TIMEOUT_S,
        arm=None,
    )


CONFIG = small_arm()


def master(bus: object) -> Any:
    """A master with a bus that a test made."""
    return SimpleNamespace(supervised=bus, config=CONFIG)


SWITCH_INPUT = 10
"""Channel of the enabling switch, from 0."""


def with_switch(**stops: str) -> ArmConfig:
    """The small arm with an enabling switch, and stop reactions by key."""
    inputs = replace(CONFIG.inputs, enabling_switch=InputConfig(SWITCH_INPUT + 1))
    return replace(CONFIG, inputs=inputs, stops=replace(CONFIG.stops, **stops))  # type: ignore[arg-type]


LONGEST_STEP = CONFIG.joints[0].velocity * PERIOD_S * COUNTS + 1
"""Counts; one more than the speed limit allows, for the rounding of both ends."""


class Segment:
    """A process image whose other end are the device models, mapped by the virtual segment's own code."""

    def __init__(self) -> None:
        self.drives = [create("cubemars-orh70", load_inertia=2.0), create("cubemars-orh60", load_inertia=0.5)]
        self.devices = [create("diewu-io", inputs=NOTHING_PRESSED), *self.drives]
        self.expected_wkc = 3 * len(self.devices)
        self.dc_time = self.missed = self.stale = 0
        self.carries = True
        """Whether frames go out and come back."""
        self.misunderstood: dict[tuple[int, int], dict[int, int]] = {}
        """What a drive understands instead of what it is sent: (drive from 0, object) -> {sent: understood}."""
        self.away: set[int] = set()
        """Devices (from 0) that no frame reaches: what is in their place of the image stays."""
        self._rx = [PdoImage.from_assignment(device.objects, RX_ASSIGN) for device in self.devices]
        self._tx = [PdoImage.from_assignment(device.objects, TX_ASSIGN) for device in self.devices]
        self._outputs = [bytes(image.byte_length) for image in self._rx]
        self._inputs = [bytearray(image.byte_length) for image in self._tx]
        for device in self.devices:
            device.set_outputs_valid(True)
            # The self-test.
            device.step(0.2)
        for drive in self.drives:
            # As the start-up SDOs of the drive's description set it: ramp down, then hold.
            drive.objects[QUICK_STOP_OPTION, 0].value = 6
        self._answer()

    def send(self) -> None:
        if not self.carries:
            return
        for i, (image, outputs) in enumerate(zip(self._rx, self._outputs, strict=True)):
            if i not in self.away:
                image.unpack(outputs)
        for (axis, index), understood in self.misunderstood.items():
            entry = self.drives[axis].objects[index, 0]
            entry.value = understood.get(entry.value, entry.value)

    def receive(self) -> int:
        # A frame brings what was before it: devices take its outputs over with the SYNC0 after it.
        if self.carries:
            self._answer()
        for device in self.devices:
            device.step(PERIOD_S)
        return self.expected_wkc - 3 * len(self.away) if self.carries else -1

    def input(self, index: int) -> bytes:
        return bytes(self._inputs[index])

    def set_output(self, index: int, data: bytes) -> None:
        assert len(data) == len(self._outputs[index])
        self._outputs[index] = data

    def output(self, index: int) -> bytes:
        return self._outputs[index]

    def _answer(self) -> None:
        for i, (image, inputs) in enumerate(zip(self._tx, self._inputs, strict=True)):
            if i not in self.away:
                image.pack(inputs)


class DriveFrame(NamedTuple):
    """A drive's inputs and outputs of one cycle as they are on the wire, in counts."""

    statusword: int
    position: int
    velocity: int
    torque: int
    mode_display: int
    controlword: int
    target: int
    speed: int
    effort: int
    mode: int

    @property
    def has_torque(self) -> bool:
        return self.statusword & 0x6F in WITH_TORQUE

    @property
    def obeys_target(self) -> bool:
        """Whether the drive goes, or may go on, to the target of this frame."""
        return self.has_torque and self.controlword in (ENABLE_OPERATION, QUICK_STOP)


_WIRE = struct.Struct("<Hiiib")


class CycleFrame(NamedTuple):
    """What is seen of a cycle from outside."""

    state: State
    drives: tuple[DriveFrame, ...]


class Followed(Discipline):
    """A reference clock that is followed for as long as the test says so: the segment here has none."""

    def observe(self, woken: int, dc_time: int) -> None:
        pass

    def holdover(self) -> None:
        pass


class LoopRig:
    """The loop's parts without the loop: each call of `cycle` does what `Loop.run` does once, in its order.

    The service thread is not started; the rig does what it would do: slaves reach OP, and come back after a reset.
    """

    def __init__(
        self, board: Blackboard, observer: Observer, *, with_box: bool = True, config: ArmConfig = CONFIG
    ) -> None:
        self.data = Segment()
        self.models = self.data.drives
        period_ns = round(PERIOD_S * 1e9)
        if not with_box:
            config = replace(
                config,
                slaves=(replace(config.slaves[0], device=config.slaves[1].device), *config.slaves[1:]),
                inputs=InputsConfig(),
                outputs=OutputsConfig(),
                gripper=None,
            )
        self._own: list[Blackboard | Observer] = []
        if board.schema != (schema := record_schema(config)):
            board = Blackboard(board.path.with_suffix(".own"), schema, period_ns)
            observer = Observer(board.path)
            board.path.unlink()
            self._own = [observer, board]
        self.board, self.observer = board, observer
        self.discipline = Followed(period_ns, 0)
        self.discipline.locked = True
        self.service = BusService(
            master(None), board, [(2, 1), (3, 1)], [joint.name for joint in CONFIG.joints], 5.0, 0, 80
        )
        self.slaves_come_back = True
        for position in range(1, 1 + len(config.slaves)):
            board.slave(position, AlState.OP, 0)
        self.now_ns = monotonic_ns()
        self.loop = Cycle(config, self.data, board, self.service, self.discipline, lambda: self.now_ns)
        self.arm, self.joints, self.operator = self.loop.arm, self.loop.joints, self.loop.operator
        self.box = next((box for _, box in self.loop.machine.context.boxes), None)
        self.machine, self.context = self.loop.machine, self.loop.machine.context
        self.names = Names(config)
        self.log: list[CycleFrame] = []
        self._events_before = max((event.number for event in observer.events_since(0)), default=0)
        self.lease = observer.acquire("the rig", 3600.0)

    def release(self) -> None:
        """Release the lease, and the blackboard where it is the rig's own."""
        self.observer.release(self.lease)
        for own in self._own:
            own.close()

    @property
    def state(self) -> State:
        return self.machine.state

    @property
    def events(self) -> list[EventRecord]:
        return self.observer.events_since(self._events_before)

    @property
    def kinds(self) -> list[type[Event]]:
        """The kinds of all events so far."""
        return [type(record.event) for record in self.events]

    @property
    def last(self) -> Event:
        """The last event."""
        return self.events[-1].event

    def cycle(self) -> None:
        data = self.data
        if self.slaves_come_back and self.state is State.RESETTING:
            self.service.lost_slave = 0
            self.service.all_op = True
        self.now_ns = monotonic_ns()
        self.loop.cycle(self.now_ns, self.now_ns)
        self.log.append(
            CycleFrame(
                self.state,
                tuple(
                    DriveFrame(*_WIRE.unpack(data.input(slot)), *_WIRE.unpack(data.output(slot)))
                    for slot in range(1, len(data.devices))
                ),
            )
        )

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.cycle()

    def wait(self, condition: Callable[[], bool], seconds: float = 5.0) -> float:
        """Run until `condition`; return the time it took."""
        for n in range(round(seconds / PERIOD_S) + 1):
            if condition():
                return n * PERIOD_S
            self.cycle()
        raise AssertionError(f"not within {seconds} s, but {self.state.name}; {self.messages}")

    def until(self, state: State, seconds: float = 5.0) -> float:
        """Run until the machine is in `state`; return the time it took."""
        return self.wait(lambda: self.state is state, seconds)

    def finish(self) -> float:
        """Run until the loop may end; return the time it took."""
        return self.wait(lambda: self.machine.closed)

    def send(self, command: Command, lease: int | None = None) -> Answer:
        """Send a command, run one cycle and return the answer to it."""
        number = self.observer.command(self.lease if lease is None else lease, command)
        self.cycle()
        answer = self.observer.answer(number)
        assert answer is not None
        return answer

    def do(self, command: Command) -> None:
        """Send a command that is accepted."""
        refusal = self.send(command).refusal
        assert refusal is None, self.names.message(refusal)

    def move(self, *target: float, speed: float = SPEED) -> None:
        self.do(move_to(*target, speed=speed))

    def refused(self, answer: Answer) -> str:
        """Return the message of a refusal."""
        assert answer.refusal is not None
        return self.names.message(answer.refusal)

    @property
    def messages(self) -> list[str]:
        """The messages of all events so far."""
        return [self.names.message(record.event) for record in self.events]

    def put(self, channel: int, level: bool) -> None:
        """Set an input of the box."""
        self.data.devices[0].set_input(channel, level)

    def press(self, pressed: bool = True) -> None:
        """Press the emergency stop, or release it, and let it be seen."""
        self.put(EMERGENCY_STOP_INPUT, not pressed)
        self.run(0.02)

    @property
    def powered(self) -> list[bool]:
        """Whether each drive really has torque."""
        return [model.powered for model in self.models]

    def recover(self) -> LoopRig:
        """Reset and enable."""
        self.do(Reset())
        self.until(State.READY)
        return self.enable()

    # -- ways to the states -------------------------------------------------------------------------------------

    def start(self) -> LoopRig:
        self.service.all_op = True
        self.until(State.READY)
        # Inputs count once they are debounced.
        self.run(0.01)
        return self

    def enable(self) -> LoopRig:
        self.do(Enable())
        self.until(State.HOLDING)
        return self

    def hold(self, mode: int = CSP) -> LoopRig:
        self.start()
        self.do(SetDriveMode(DriveMode(mode)))
        self.enable()
        self.wait(lambda: not self.machine.changing_mode)
        return self

    def set_in_motion(self, mode: int = CSP) -> LoopRig:
        """Both joints, at full speed on a long way."""
        self.hold(mode)
        self.move(1.8, 1.8)
        self.run(0.6)
        assert all(drive.velocity > 0.9 * SPEED for drive in self.arm.drives)
        return self

    def bring_to(self, state: State) -> LoopRig:
        """Lead the machine into `state` from its beginning, by what leads there on a robot."""
        if state is State.STARTING:
            self.cycle()
        elif state is State.READY:
            self.start()
        elif state is State.ENABLING:
            self.start().do(Enable())
        elif state is State.HOLDING:
            self.hold()
        elif state is State.MOVING:
            self.set_in_motion()
        elif state is State.STOPPING:
            self.set_in_motion().do(Halt())
        elif state is State.DISABLING:
            self.set_in_motion().do(Disable())
        elif state is State.FAULT:
            self.hold()
            self.service.lost_slave = 3
            self.cycle()
        elif state is State.EMERGENCY_STOP:
            self.hold().press()
        elif state is State.STOPPED_BY_LIMIT:
            # The limits close in on a move that was planned under wider ones.
            self.set_in_motion()
            self.arm.limits.high[0] = self.arm.state.commanded[0] + 0.3
            self.until(State.STOPPED_BY_LIMIT)
        elif state is State.HOMING:
            self.hold()
            # A search that finds nothing: the speed is too small.
            self.models[0].objects[0x6098, 0].value = 34
            self.models[0].objects[0x6099, 2].value = 1
            self.do(Home(0))
        elif state is State.RESETTING:
            self.bring_to(State.FAULT)
            self.slaves_come_back = False
            self.do(Reset())
        else:
            self.set_in_motion().do(Shutdown())
        assert self.state is state
        return self

    # -- what is seen on the wire -------------------------------------------------------------------------------

    def words(self, axis: int) -> list[int]:
        """The controlwords that a drive was sent, each once where it was repeated."""
        sent = [cycle.drives[axis].controlword for cycle in self.log]
        return [word for n, word in enumerate(sent) if n == 0 or sent[n - 1] != word]

    def longest_step(self, axis: int) -> int:
        """The longest step, in counts, between two targets in a row that the drive obeyed."""
        said = [cycle.drives[axis] for cycle in self.log]
        return max(
            (
                abs(after.target - before.target)
                for before, after in pairwise(said)
                if before.obeys_target and after.obeys_target
            ),
            default=0,
        )


def move_to(*target: float, speed: float = SPEED) -> MoveJoints:
    """A move of all joints, which arrive together."""
    return MoveJoints(target, speed, True)


def turn(rig: LoopRig, axis: int, inertia: float, velocity: float, torque: float) -> None:
    """Turn a joint from outside: too heavy for its drive, or with more torque than that has."""
    joint = rig.models[axis].mechanics
    joint.inertia, joint.velocity, joint.external_torque = inertia, velocity, torque


def let_go(rig: LoopRig) -> None:
    """End what `turn` began."""
    for axis in range(2):
        turn(rig, axis, 1.0, 0.0, 0.0)


def acquire_lease(rig: LoopRig) -> None:
    rig.lease = rig.observer.acquire("the rig", 3600.0)


Step = Callable[[LoopRig], object]
CAUSES: dict[str, tuple[Step, Step]] = {
    "lost_frames": (
        lambda rig: setattr(rig.data, "carries", False),
        lambda rig: setattr(rig.data, "carries", True),
    ),
    "slave_lost": (lambda rig: setattr(rig.service, "lost_slave", 3), lambda rig: None),
    "drive_fault": (lambda rig: rig.models[1].inject_fault(UNDER_VOLTAGE), lambda rig: None),
    "clock_lost": (
        lambda rig: setattr(rig.discipline, "locked", False),
        lambda rig: setattr(rig.discipline, "locked", True),
    ),
    "emergency_stop": (
        lambda rig: rig.put(EMERGENCY_STOP_INPUT, False),
        lambda rig: rig.put(EMERGENCY_STOP_INPUT, True),
    ),
    "supervision": (lambda rig: turn(rig, 1, 1e5, 0.9, 0.0), let_go),
    "lease_ended": (lambda rig: rig.observer.release(rig.lease), acquire_lease),
    "enabling_switch": (lambda rig: rig.put(SWITCH_INPUT, False), lambda rig: rig.put(SWITCH_INPUT, True)),
}
"""For each key of `stops` what causes one of its events, and what ends the cause. The clock is missed after 1 s."""
