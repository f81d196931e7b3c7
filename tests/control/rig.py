"""A rig: the simulation of a small arm with a log of its process data, and faults of its drives and frames."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, InputConfig
from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.commands import Disable, Enable, Halt, Home, MoveJoints, Reset, SetDriveMode, Shutdown
from rtcp.ipc.events import Event
from rtcp.ipc.observer import Answer
from rtcp.ipc.states import DriveMode, State
from rtcp.realtime.discipline import Discipline
from rtcp.testing import Simulation

PERIOD_S = 0.001
COUNTS = 10000
ENABLE_TIMEOUT_S = 0.2
DEBOUNCE_S = 0.005
"""Debounce time of the emergency stop's input; a reset waits for it too."""
LOST_CYCLES = 40
CSP, CSV, CST = 8, 9, 10
CONTROLWORD, MODES_OF_OPERATION = 0x6040, 0x6060
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
    """The first two joints of the default arm with its IO box, on a network interface, where no limit is widened."""
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


SEGMENT = SegmentConfig(
    (
        SegmentSlave("diewu-io", options={"inputs": NOTHING_PRESSED}),
        SegmentSlave("cubemars-orh70", options={"load_inertia": 2.0}),
        SegmentSlave("cubemars-orh60", options={"load_inertia": 0.5}),
    ),
    CONFIG.source,
)


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
        """Whether the drive follows, or may still follow, the target of this frame."""
        return self.has_torque and self.controlword in (ENABLE_OPERATION, QUICK_STOP)


_WIRE = struct.Struct("<Hiiib")
_OBJECTS = (CONTROLWORD, 0x607A, 0x60FF, 0x6071, MODES_OF_OPERATION)


class CycleFrame(NamedTuple):
    """State of the machine and process data of a cycle."""

    state: State
    drives: tuple[DriveFrame, ...]


class Followed(Discipline):
    """A discipline whose `locked` the test sets: the segment has no reference clock."""

    def observe(self, woken: int, dc_time: int) -> None:
        pass

    def holdover(self) -> None:
        pass


_Event = TypeVar("_Event", bound=Event)


class LoopRig(Simulation):
    """The simulation of a small arm whose slaves are in OP.

    The service does not poll the slaves: a test sets `service.lost_slave` and `service.all_op`. In a reset the rig sets
    them, unless `slaves_come_back` is false.
    """

    def __init__(self, config: ArmConfig = CONFIG) -> None:
        super().__init__(config, segment=SEGMENT, follow_clock=False)
        for slave in self.bus.slaves:
            slave.device.step(0.2)  # the self-test
        self._send, self._receive = self.data.send, self.data.receive
        self.data.send, self.data.receive = self._send_altered, self._receive_altered  # type: ignore[method-assign]
        self.misunderstood: dict[tuple[int, int], dict[int, int]] = {}
        """Values that a drive receives in place of the sent ones: (drive from 0, object) -> {sent: received}."""
        self.away: set[int] = set()
        """Slots that no frame reaches: they keep their last outputs."""
        self._delivered = self.data.outputs
        self.bus.request_state(AlState.OP)
        while self.bus.wait_for_state(AlState.OP, 0.0):
            self.now_ns = self._planned
            self._planned += self.period_ns
            self.bus.advance_to(self.now_ns)
            self.data.send()
            self.data.receive()
        self.service.take_turn = lambda poll: None  # type: ignore[method-assign]
        self.slaves_come_back = True
        for position in range(1, 1 + len(config.slaves)):
            self.board.slave(position, AlState.OP, 0)
        self.arm, self.joints, self.operator = self.loop.arm, self.loop.joints, self.loop.operator
        self.machine, self.context = self.loop.machine, self.loop.machine.context
        self.discipline = self.loop._discipline = self.context._discipline = Followed(self.period_ns, 0)
        self.discipline.locked = True
        self.log: list[CycleFrame] = []
        if config.inputs.enabling_switch is not None:
            self.put(SWITCH_INPUT, True)
        self.acquire()

    def _send_altered(self) -> None:
        data = self.data
        outputs, sent = data.outputs, list(data.outputs)
        for slot in self.away:
            sent[slot] = self._delivered[slot]
        for (axis, index), understood in self.misunderstood.items():
            values = list(_WIRE.unpack(sent[1 + axis]))
            at = _OBJECTS.index(index)
            values[at] = understood.get(values[at], values[at])
            sent[1 + axis] = _WIRE.pack(*values)
        data.outputs = self._delivered = sent
        self._send()
        data.outputs = outputs

    def _receive_altered(self) -> int:
        data = self.data
        before = data.inputs
        wkc = self._receive()
        if wkc > 0:
            for slot in self.away:
                data.inputs[slot] = before[slot]
            data.wkc = wkc = wkc - 3 * len(self.away)
        return wkc

    @property
    def kinds(self) -> list[type[Event]]:
        """The kinds of all events so far."""
        return [type(record.event) for record in self.events]

    @property
    def last(self) -> Event:
        """The last event."""
        return self.events[-1].event

    def last_of(self, kind: type[_Event]) -> _Event:
        """The last event of a kind."""
        return [record.event for record in self.events if isinstance(record.event, kind)][-1]

    def cycle(self) -> None:
        if self.slaves_come_back and self.state is State.RESETTING:
            self.service.lost_slave = 0
            self.service.all_op = True
        super().cycle()
        data = self.data
        drives = [
            DriveFrame(*_WIRE.unpack(data.input(slot)), *_WIRE.unpack(data.outputs[slot]))
            for slot in range(1, len(data.outputs))
        ]
        self.log.append(CycleFrame(self.state, tuple(drives)))

    def wait(self, condition: Callable[[], bool], seconds: float = 5.0) -> float:
        """Run until `condition`; return the time it took."""
        began = self.now_ns
        assert self.until(condition, seconds), f"not within {seconds} s, but {self.state.name}; {self.messages}"
        return (self.now_ns - began) * 1e-9

    def finish(self) -> float:
        """Run until the loop may end; return the time it took."""
        return self.wait(lambda: self.done)

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
        assert self.box is not None
        self.box.set_input(channel, level)

    def press(self, pressed: bool = True) -> None:
        """Press or release the emergency stop, and wait for its debounce."""
        self.put(EMERGENCY_STOP_INPUT, not pressed)
        self.run(0.02)

    def lose_frames(self, lost: bool = True) -> None:
        """Lose every answer, or none, from now on."""
        self.data.lose(1 << 60 if lost else 0, heard=True)

    @property
    def powered(self) -> list[bool]:
        """Whether each drive really has torque."""
        return [model.powered for model in self.models]

    def recover(self) -> LoopRig:
        """Reset and enable."""
        self.do(Reset())
        self.bring_to(State.READY)
        return self.enable()

    # -- paths to the states -----------------------------------------------------------------------------------

    def start(self) -> LoopRig:
        self.service.all_op = True
        self.bring_to(State.READY)
        # Inputs count once they are debounced.
        self.run(0.01)
        return self

    def enable(self) -> LoopRig:
        self.do(Enable())
        self.bring_to(State.HOLDING)
        return self

    def hold(self, mode: int = CSP) -> LoopRig:  # type: ignore[override]
        self.start()
        self.do(SetDriveMode(DriveMode(mode)))
        self.enable()
        self.wait(lambda: not self.machine.changing_mode)
        return self

    def set_in_motion(self, mode: int = CSP, direction: int = 1) -> LoopRig:
        """Move both joints at full speed in a direction, 1 or -1, far from their targets."""
        self.hold(mode)
        self.move(direction * 1.8, direction * 1.8)
        self.run(0.6)
        assert all(direction * drive.velocity > 0.9 * SPEED for drive in self.arm.drives)
        return self

    def lead_to(self, state: State, direction: int = 1) -> LoopRig:
        """Bring the machine from its start into `state`, by the commands and faults that lead there.

        Args:
            state: the state.
            direction: 1 or -1, of a motion on the way.
        """
        if state is State.STARTING:
            self.cycle()
        elif state is State.READY:
            self.start()
        elif state is State.ENABLING:
            self.start().do(Enable())
        elif state is State.HOLDING:
            self.hold()
        elif state is State.MOVING:
            self.set_in_motion(direction=direction)
        elif state is State.STOPPING:
            self.set_in_motion(direction=direction).do(Halt())
        elif state is State.DISABLING:
            self.set_in_motion(direction=direction).do(Disable())
        elif state is State.FAULT:
            self.hold()
            self.service.lost_slave = 3
            self.cycle()
        elif state is State.EMERGENCY_STOP:
            self.hold().press()
        elif state is State.STOPPED_BY_LIMIT:
            # The limits close in on a move that was planned under wider ones.
            self.set_in_motion(direction=direction)
            ends = self.arm.limits.high if direction > 0 else self.arm.limits.low
            ends[0] = self.arm.state.commanded[0] + direction * 0.3
            self.bring_to(State.STOPPED_BY_LIMIT)
        elif state is State.HOMING:
            self.hold()
            # The search finds nothing: its speed is too small.
            self.models[0].objects[0x6098, 0].value = 34
            self.models[0].objects[0x6099, 2].value = 1
            self.do(Home(0))
        elif state is State.RESETTING:
            self.lead_to(State.FAULT)
            self.slaves_come_back = False
            self.do(Reset())
        else:
            self.set_in_motion(direction=direction).do(Shutdown())
        assert self.state is state
        return self

    # -- process data -------------------------------------------------------------------------------------------

    def words(self, axis: int) -> list[int]:
        """Controlwords sent to a drive, without repetitions."""
        sent = [cycle.drives[axis].controlword for cycle in self.log]
        return [word for n, word in enumerate(sent) if n == 0 or sent[n - 1] != word]

    def longest_step(self, axis: int) -> int:
        """Largest difference, in counts, of two consecutive targets that the drive obeys."""
        frames = [cycle.drives[axis] for cycle in self.log]
        return max(
            (
                abs(after.target - before.target)
                for before, after in pairwise(frames)
                if before.obeys_target and after.obeys_target
            ),
            default=0,
        )


def about(value: float, **tolerance: Any) -> Any:
    """`pytest.approx` as a field of an event or a refusal."""
    return pytest.approx(value, **tolerance)


def move_to(*target: float, speed: float = SPEED) -> MoveJoints:
    """A move of all joints, which arrive together."""
    return MoveJoints(target, speed, True)


def turn(rig: LoopRig, axis: int, inertia: float, velocity: float, torque: float) -> None:
    """Turn a joint against its drive, by a large inertia or an external torque; the drive may give all its torque."""
    limits = rig.arm.limits
    speed, _, error = limits.supervision
    limits.supervision = (speed, 1.5, error)
    rig.arm.supervision.take(limits)
    joint = rig.models[axis].mechanics
    joint.inertia, joint.velocity, joint.external_torque = inertia, velocity, torque


def let_go(rig: LoopRig) -> None:
    """Undo `turn` on both joints."""
    for axis in range(2):
        turn(rig, axis, 1.0, 0.0, 0.0)


DIRECTIONS = pytest.mark.parametrize("direction", [1, -1])
MOTIONS = pytest.mark.parametrize(("mode", "direction"), [(CSP, 1), (CSP, -1), (CSV, -1), (CST, 1), (CST, -1)])
"""Drive modes and directions of a motion."""

Step = Callable[[LoopRig], object]
CAUSES: dict[str, tuple[Step, Step]] = {
    "lost_frames": (LoopRig.lose_frames, lambda rig: rig.lose_frames(False)),
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
    "lease_ended": (lambda rig: rig.observer.release(rig.lease), LoopRig.acquire),
    "halt": (lambda rig: rig.do(Halt()), lambda rig: None),
    "enabling_switch": (lambda rig: rig.put(SWITCH_INPUT, False), lambda rig: rig.put(SWITCH_INPUT, True)),
}
"""For each key of `stops` the cause of one of its events, and the end of the cause. A clock is lost after 1 s."""
