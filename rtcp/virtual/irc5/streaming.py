"""RAPID streaming in simulated time: the motion server's task, the state server's task, a motion task per unit.

As in `abb/rapid`: one message at a time; a point goes to all motion tasks at once, and the reply follows its
acceptance; after WaitSyncTask's timeout without acceptance the reply is FAILURE.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from math import degrees, radians
from random import Random
from typing import Any

from rtcp.virtual.irc5.config import RapidConfig
from rtcp.virtual.irc5.mechanical_unit import MechanicalUnit
from rtcp.virtual.irc5.messages import ROBOT_AXES, MciState
from rtcp.virtual.irc5.motion_task import SHORTEST_MOVE_S, MotionTask, Move
from rtcp.virtual.irc5.panel import Mode, Motors, Panel, PanelRefused, Stop
from rtcp.virtual.irc5.simple_message import (
    CommType,
    Frame,
    JointPoint,
    MessageType,
    ReplyCode,
    SpecialSequence,
    board_state,
    joint_position,
    pack,
    read_integer,
    read_joint_point,
    status,
)

MOST_POINTS = 200
"""Upper bound on the points of a downloaded path."""
STOPPING_SEQUENCES = (SpecialSequence.STOP_TRAJECTORY, SpecialSequence.START_DOWNLOAD)
STREAMING_FAULTS = ("socket_cut", "half_message", "silent_state", "silent_motion", "server_crash")
"""Faults of the connections; socket_cut is a single event, the others last until cleared. After server_crash the
sockets stay open and nobody serves them; to clear it starts the server's tasks again, which take their ports anew."""
TERMINALS = 16
"""Inputs, and outputs, of the board, a DSQC 652."""


class RapidStreaming:
    """`receive` takes a message of the motion client; `step` advances by a period and returns the due reply."""

    def __init__(self, units: Mapping[str, MechanicalUnit], panel: Panel, config: RapidConfig) -> None:
        self.config = config
        self.tasks = {name: MotionTask(unit, panel, config) for name, unit in units.items()}
        self.counts: Counter[str] = Counter()
        """Number of messages by result."""
        self.faults: set[str] = set()
        """Active `STREAMING_FAULTS`, including a pending socket_cut."""
        self.ports = {"motion_port": config.motion_port, "state_port": config.state_port}
        """TCP ports; the server replaces 0 by the assigned ones."""
        self.inputs = self.outputs = 0
        """Levels of the board, bit 0 is number 1."""
        self._panel = panel
        self._frame: Frame | None = None
        self._point: JointPoint | None = None
        """Point of the message, until the arms that it stops are at rest."""
        self._refused = False
        self._last: tuple[float, ...] = ()
        """Last commanded positions, rad; empty: the actual ones."""
        self._offered: list[JointPoint] = []
        """Points awaiting acceptance."""
        self._download: list[JointPoint] | None = None
        """Points of an incomplete path; None: streaming."""
        self._waited_s = 0.0
        self._random = Random(0)
        self._sequence = 0

    @property
    def is_busy(self) -> bool:
        """Whether a message is in progress; meanwhile RAPID reads no other one."""
        return self._frame is not None

    def receive(self, frame: Frame) -> None:
        """Begin to process a message."""
        self._frame, self._waited_s, self._offered = frame, 0.0, []
        self._point = read_joint_point(frame, ROBOT_AXES * len(self.tasks))
        self._refused = self._point is None and not self._carry_out(frame)
        if self._point is not None and self._point.sequence in STOPPING_SEQUENCES:
            self.stop()

    def _carry_out(self, frame: Frame) -> bool:
        """Carry out a message that is no point; return whether it was accepted."""
        value = read_integer(frame)
        if frame.msg_type == MessageType.PING:
            return True
        if frame.msg_type == MessageType.BOARD_OUTPUTS and value is not None and 0 <= value < 1 << TERMINALS:
            self.outputs = value
            return True
        if frame.msg_type == MessageType.MOTORS and value == 0:
            self._panel.switch_motors_off()
            return True
        if frame.msg_type == MessageType.MOTORS and value == 1 and self._panel.mode is Mode.AUTO:
            try:
                self._panel.press_motors_on()
            except PanelRefused:
                return False
            return True
        return False

    def set_input(self, number: int, level: bool) -> None:
        """Set the level of an input of the board, 1 to 16."""
        bit = 1 << number - 1
        self.inputs = self.inputs | bit if level else self.inputs & ~bit

    def switch_motors_off(self) -> None:
        """Switch the motors off: no client has come for `motors_off_s`."""
        self._panel.switch_motors_off()

    def stop(self) -> None:
        """Stop all arms and clear their queues, after a stop message or a disconnect."""
        self._download = None
        self._last = ()
        for task in self.tasks.values():
            task.stop()

    def disconnect(self) -> None:
        """Handle the disconnect of the motion client."""
        self._frame = None
        self.stop()

    def step(self, dt: float) -> bytes | None:
        """Advance by one period; return the due reply."""
        for task in self.tasks.values():
            task.step(dt)
        frame, self._waited_s = self._frame, self._waited_s + dt
        code = None if frame is None else self._reply_code()
        if frame is None or code is None:
            return None
        self._frame = None
        self.counts[code.name.lower()] += 1
        return pack(frame.msg_type, CommType.REPLY, code) if frame.comm_type == CommType.REQUEST else None

    def state(self, with_board: bool = False) -> bytes:
        """Return a JOINT_POSITION and a STATUS, as the state server sends them, and the BOARD_STATE."""
        tasks, panel = self.tasks.values(), self._panel
        delay = self._random.uniform(*self.config.position_delay_s)
        joints = [radians(joint) for task in tasks for joint in task.reported(delay)]
        self._sequence += 1
        return (
            joint_position(self._sequence - 1, joints)
            + status(
                powered=panel.motors is not Motors.OFF,
                e_stopped=Stop.EMERGENCY in panel.open,
                failed=any(task.lost or task.unit.mci is MciState.ERROR for task in tasks),
                in_motion=any(any(task.unit.speeds) for task in tasks),
                automatic=panel.mode is Mode.AUTO,
                possible=all(task.runs for task in tasks),
            )
            + (board_state(self.inputs, self.outputs) if with_board else b"")
        )

    def clear(self) -> None:
        """End all faults."""
        self.faults.clear()
        for task in self.tasks.values():
            task.lost = False

    def lose(self, name: str) -> None:
        """Fail a unit: it stops on its brakes; the others continue with their queues."""
        self.tasks[name].unit.fail("the arm is lost (a fault on command)")
        self.tasks[name].lost = True

    def status(self) -> dict[str, Any]:
        """Return the state of the tasks as plain values."""
        return {
            **self.ports,
            "moves_ahead": {name: task.moves_ahead for name, task in self.tasks.items()},
            "downloaded": 0 if self._download is None else len(self._download),
            "counts": dict(self.counts),
            "faults": sorted(self.faults),
            "board": {
                f"{kind}{i + 1}": word >> i & 1
                for kind, word in (("DI", self.inputs), ("DO", self.outputs))
                for i in range(TERMINALS)
            },
        }

    def _reply_code(self) -> ReplyCode | None:
        """Return the reply code; None while RAPID waits for arms to stop or for room in the queues."""
        tasks = self.tasks.values()
        if any(task.stopping for task in tasks):
            return None
        if self._point is not None:
            self._take(self._point)
            self._point = None
        if self._refused:
            return ReplyCode.FAILURE
        if self._offered:
            path = self._offered[-1].sequence == SpecialSequence.END_TRAJECTORY
            if not all(task.is_ready for task in tasks):
                if self._waited_s < self.config.accept_timeout_s:
                    return None
                if path:
                    self._last = ()
                return ReplyCode.FAILURE
            for i, task in enumerate(tasks):
                moves = [Move(_of_unit(point, i), point.duration) for point in self._offered]
                task.execute([*moves[:-1], moves[-1]._replace(fine=path)])
            self._last = self._offered[-1].joints
        return ReplyCode.SUCCESS

    def _take(self, point: JointPoint) -> None:
        """Offer, collect or refuse a point."""
        if point.sequence == SpecialSequence.STOP_TRAJECTORY:
            return
        if point.sequence == SpecialSequence.START_DOWNLOAD:
            self._download = []
        elif point.sequence == 0 and self._download is not None:
            self._download, self._last = None, ()
        last = self._last or [radians(joint) for task in self.tasks.values() for joint in task.unit.actual]
        step = degrees(max(abs(there - here) for there, here in zip(point.joints, last, strict=True)))
        if step > self.config.max_speed * max(point.duration, SHORTEST_MOVE_S):
            self._refused = True
        elif self._download is None:
            self._offered = [point]
        elif len(self._download) == MOST_POINTS:
            self._refused = True
        else:
            self._download.append(point)
            self._last = point.joints
            if point.sequence == SpecialSequence.END_TRAJECTORY:
                self._offered, self._download = self._download, None


def _of_unit(point: JointPoint, index: int) -> tuple[float, ...]:
    """Return the joints of a unit, degrees."""
    return tuple(degrees(joint) for joint in point.joints[ROBOT_AXES * index : ROBOT_AXES * (index + 1)])
