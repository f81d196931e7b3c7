"""ABB's Externally Guided Motion as a bus: over UDP the controller sends messages, each is answered once.

ABB, Application manual Externally Guided Motion, 3HAC073318-001 rev K. Degrees and millimeters on the wire, SI in the
process images (`rtcp.config.buses`).
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Sequence
from math import degrees, nan, radians
from pathlib import Path
from time import monotonic_ns, sleep
from typing import Any, Final

try:
    from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
except ImportError as error:
    raise ImportError("protobuf is not installed: pip install 'rtcp[abb]'") from error

from rtcp.config.buses import EgmBus
from rtcp.config.model import VIRTUAL, ArmConfig
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.master import Master, PacedData
from rtcp.ipc.names import MISSING_WORDS
from rtcp.ipc.states import DriveState, Missing

_DATA, _CORRECTION = 2, 3
_MOTORS_ON, _RAPID_STOPPED = 1, 1
_MCI_ERROR, _MCI_RUNNING = 1, 3
_DATAGRAM: Final = 2048
_MOST_WAITING: Final = 64
"""Most datagrams read in one cycle: a flood must not delay the cycle."""
_MOST_DROPPED: Final = 4096
_RECEIVE_BUFFER: Final = 65536
"""Size of the socket's buffer, bytes: some 50 datagrams; older ones are useless."""
_PACE_MESSAGES: Final = 25
"""Number of messages over which the controller's interval is measured."""
_PACE_SHARE: Final = 0.05
_VELOCITY_MESSAGES: Final = 5
"""Number of messages over which velocities are averaged: 20 ms."""
_LARGEST: Final = 1e6
"""Largest valid measurement, degrees or mm."""
_COMMANDED: Final = struct.Struct("<ddB")
_MEASURED: Final = struct.Struct("<dBBd")
_UNIT: Final = struct.Struct("<5BdI6I9db")
_POWERED: Final = {1: 1, 2: 0}
"""EGM's state of the motors -> whether they are on; others: unknown, -1."""
_NO_FORCE: Final = (nan,) * 6
_COUNTER: Final = 0xFFFFFFFF
_EXTERNAL: Final = 2
"""Index of the seventh axis in the kinematic order: j1, j2, external, j3 ... j6."""


def _classes() -> list[Any]:
    """Return the classes of the messages from and to the controller, and of a force, from a separate pool."""
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString((Path(__file__).parent / "rtcp_egm.binpb").read_bytes())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.AddSerializedFile(file.SerializeToString())
    names = ("Robot", "Sensor", "MeasuredForce", "MeasuredForce6")
    return [message_factory.GetMessageClass(pool.FindMessageTypeByName(f"rtcp.egm.{name}")) for name in names]


class EgmData(PacedData):
    """The exchange of messages with one mechanical unit.

    Args:
        bound: the socket at which the unit's messages arrive.
        config: the arm.
        bus: its bus.
    """

    def __init__(self, bound: socket.socket, config: ArmConfig, bus: EgmBus) -> None:
        self.expected_wkc = 1
        self.dc_time = self.missed = self.stale = 0
        self._socket = bound
        self._axes = len(config.joints)
        self._allowed = bus.controller
        # One cycle later than the loop counts `bus.lost_cycles`: its reaction is that to lost messages.
        self._silent_ns = round((bus.lost_cycles + 1) * config.cycle.period_us * 1000)
        self._period_us = config.cycle.period_us
        self._robot_class, self._sensor_class, self._measured_force, self._measured_force_6 = _classes()
        self._robot = self._robot_class()
        """Created anew for each message: a reused protobuf object never frees the memory of earlier messages."""
        self._buffer = bytearray(_DATAGRAM)
        self._view = memoryview(self._buffer)
        self._sender: Any = None
        self._heard_ns = 0
        self._seqno = -1
        self._sent_us = 0
        """Time stamp of the newest message, controller's clock, us."""
        self._answers = 0
        self._answerable = False
        self._linked = False
        """Whether the next message may continue the session of the last one."""
        self._read_ns = self._called_ns = 0
        """Instants of the last read message and of the last return of `receive_until` (CLOCK_MONOTONIC), ns."""
        self._pace_base = (0, 0)
        """Number and time stamp, us, of the message from which the controller's interval is measured."""
        self._has_pace = True
        self._past: deque[tuple[int, list[float]]] = deque(maxlen=_VELOCITY_MESSAGES + 1)
        self._fresh_session = False
        self._standing = [0.0] * self._axes
        """References while no joint is commanded, degrees: the position at the begin of the session or at the stop."""
        self._at: Sequence[float] = self._standing
        """Joint positions of the newest message, degrees."""
        self._references = [0.0] * self._axes
        self._speeds = [0.0] * self._axes
        self.session = self.lost = self.doubled = self.disordered = self.superseded = self.foreign = 0
        """Counts of messages since the start, as `EgmBus.UNIT_INPUTS` has them."""
        self.missing = Missing.CONNECTION
        self.mci = 0
        """EgmMCIState of the newest message."""
        self._outputs = [_COMMANDED.pack(0.0, 0.0, 0)] * self._axes
        self._still = [0.0] * self._axes
        self._inputs = [_MEASURED.pack(0.0, DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION, 0.0)] * self._axes
        self._inputs.append(bytes(_UNIT.size))

    # -- the cycle ----------------------------------------------------------------------------------------------------

    def receive_until(self, deadline_ns: int) -> int:
        """Wait for a message that is newer than the last; return 1, or -1 where none came until `deadline_ns`.

        When the controller falls silent it returns 1 once, so that the loop reads the drives' new state.
        """
        now = monotonic_ns()
        if self._called_ns and now - self._called_ns > self._silent_ns:
            self._drop_backlog()
        # A cycle is one step of the setpoints, also if messages come faster.
        if (early := self._read_ns + 500 * self._period_us - now) > 0:
            sleep(early * 1e-9)
        while not self._read_all():
            now = monotonic_ns()
            if now >= deadline_ns:
                self._called_ns = now
                return self._miss(now)
            select.select((self._socket,), (), (), (deadline_ns - now) * 1e-9)
        self._called_ns = self._read_ns = monotonic_ns()
        return 1

    def _miss(self, now: int) -> int:
        self.missed += 1
        if now - self._heard_ns <= self._silent_ns or self.missing is Missing.CONNECTION:
            return -1
        self.missing = Missing.CONNECTION
        self._linked = self._answerable = False
        self._show(DriveState.NOT_READY_TO_SWITCH_ON, self._at, self._still)
        return 1

    def _drop_backlog(self) -> None:
        """Discard the messages received during a stall of the loop: the controller may have stopped since."""
        self._linked = False
        for _ in range(_MOST_DROPPED):
            try:
                self._socket.recv_into(self._buffer)
            except OSError:
                break
            self.superseded = self.superseded + 1 & _COUNTER

    def receive(self) -> int:
        """Do `receive_until` without waiting."""
        return self.receive_until(0)

    def send(self) -> None:
        """Answer the newest message, once.

        Without a new message nothing is sent, not even a quick stop: the reaction of a controller to answers that it
        receives before its next session is unknown.
        """
        if not self._answerable:
            return
        self._answerable = False
        running = self.mci == _MCI_RUNNING and not self._fresh_session
        for i in range(self._axes):
            position, speed, command = _COMMANDED.unpack(self._outputs[i])
            if command and running:
                self._standing[i] = self._references[i] = degrees(position)
                self._speeds[i] = degrees(speed)
            else:
                self._references[i], self._speeds[i] = self._standing[i], 0.0
        sensor = self._sensor_class()
        sensor.header.mtype = _CORRECTION
        self._answers += 1
        sensor.header.seqno = self._answers
        sensor.header.tm = monotonic_ns() // 1_000_000 & 0xFFFFFFFF
        _set(sensor.planned, self._references)
        _set(sensor.speedRef, self._speeds)
        # The controller follows references from the next message on.
        self._fresh_session = False
        with contextlib.suppress(OSError):
            self._socket.sendto(sensor.SerializeToString(), self._sender)

    def input(self, index: int) -> bytes:
        """Return the inputs of a node: the joints in their order, then the unit."""
        return self._inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of a joint; the unit has none."""
        if index < self._axes and len(data) == _COMMANDED.size:
            self._outputs[index] = data

    # -- messages -----------------------------------------------------------------------------------------------------

    def _read_all(self) -> bool:
        """Read what has arrived; return whether there is a newer message than before."""
        newest: Any = None
        for _ in range(_MOST_WAITING):
            try:
                size, sender = self._socket.recvfrom_into(self._buffer)
            except OSError:
                break
            if self._is_foreign(sender) or not self._parse(size):
                self.foreign = self.foreign + 1 & _COUNTER
                continue
            if not self._follows(sender):
                continue
            if newest is not None:
                self.superseded = self.superseded + 1 & _COUNTER
            newest = self._robot
            if not _takes_references(newest):
                # Even if it is superseded at once: the references sent before are void.
                self._fresh_session = True
        if newest is not None:
            self._decode(newest)
        return newest is not None

    def _is_foreign(self, sender: tuple[str, int]) -> bool:
        if self._allowed and sender[0] != self._allowed:
            return True
        if self._sender is None or sender == self._sender:
            return False
        # Foreign only while the controller sends; after a silence it may be the controller, with another port.
        return monotonic_ns() - self._heard_ns <= self._silent_ns

    def _parse(self, size: int) -> bool:
        self._robot = robot = self._robot_class()
        try:
            robot.ParseFromString(self._view[:size])
        except message.DecodeError:
            return False
        if robot.header.mtype != _DATA or not robot.HasField("feedBack") or not robot.feedBack.HasField("time"):
            return False  # without `time`: before RobotWare 6.07, whose units differ from the manual
        joints = robot.feedBack.joints.joints
        external = robot.feedBack.externalJoints.joints
        if len(joints) != min(self._axes, 6) or len(external) < self._axes - 6:
            return False
        return all(-_LARGEST <= value <= _LARGEST for value in (*joints, *external))

    def _follows(self, sender: Any) -> bool:
        """Return whether a message is newer than the last one of its session, or begins one."""
        seqno, clock = self._robot.header.seqno, self._robot.feedBack.time
        step, sent_us = seqno - self._seqno, 1_000_000 * clock.sec + clock.usec
        now = monotonic_ns()
        known = self._linked and sender == self._sender and now - self._heard_ns <= self._silent_ns
        if known and step == 0:
            self.doubled = self.doubled + 1 & _COUNTER
            return False
        if known and step < 0 and sent_us <= self._sent_us:
            self.disordered = self.disordered + 1 & _COUNTER
            return False
        if not known or step < 0:
            self.session = self.session + 1 & _COUNTER
            self._fresh_session = self._linked = self._has_pace = True
            self._pace_base = seqno, sent_us
            self._past.clear()
        elif step > 1:
            self.lost = self.lost + step - 1 & _COUNTER
        self._measure_pace(seqno, sent_us)
        self._sent_us = sent_us
        self._seqno, self._sender, self._heard_ns = seqno, sender, now
        self._answerable = True
        return True

    def _measure_pace(self, seqno: int, sent_us: int) -> None:
        """Compare the interval of the messages, by the controller's clock, with the period of the cycle."""
        first, began_us = self._pace_base
        if seqno - first >= _PACE_MESSAGES:
            interval = (sent_us - began_us) / (seqno - first)
            self._has_pace = abs(interval - self._period_us) <= _PACE_SHARE * self._period_us
            self._pace_base = seqno, sent_us

    def _velocities(self, at: list[float]) -> list[float]:
        """Return the velocities of the joints by the controller's clock, degrees/s."""
        past = self._past
        past.append((self._sent_us, at))
        began_us, began = past[0]
        if self._sent_us <= began_us:
            return self._still
        scale = 1e6 / (self._sent_us - began_us)
        return [(now - before) * scale for now, before in zip(at, began, strict=True)]

    def _decode(self, robot: Any) -> None:
        at = _in_order(robot.feedBack, self._axes)
        motors, rapid, self.mci = robot.motorState.state, robot.rapidExecState.state, robot.mciState.state
        collision = robot.CollisionInfo.collsionTriggered
        if self.mci == _MCI_ERROR or collision:
            state, self.missing = DriveState.FAULT, Missing.CLEARANCE
        elif motors != _MOTORS_ON:
            state, self.missing = DriveState.SWITCH_ON_DISABLED, Missing.MOTORS
        elif rapid == _RAPID_STOPPED:
            state, self.missing = DriveState.READY_TO_SWITCH_ON, Missing.PROGRAM
        elif self.mci != _MCI_RUNNING or self._fresh_session:
            # The first answer of a session is the unit's position; a joint that followed before stops.
            state = DriveState.SWITCHED_ON
            self.missing = Missing.NOTHING if self.mci == _MCI_RUNNING else Missing.CONTROL
        elif not self._has_pace:
            state, self.missing = DriveState.SWITCHED_ON, Missing.PACE
        else:
            state, self.missing = DriveState.OPERATION_ENABLED, Missing.NOTHING
        if state is not DriveState.OPERATION_ENABLED:
            self._standing[:] = at
        self._show(state, at, self._velocities(at))
        force = self._force(robot.measuredForce) if robot.HasField("measuredForce") else ()
        here, planned = robot.feedBack.cartesian.pos, robot.planned.cartesian.pos
        self._inputs[self._axes] = _UNIT.pack(
            motors & 0xFF, rapid & 0xFF, self.mci & 0xFF, robot.mciConvergenceMet, collision,
            robot.utilizationRate, robot.moveIndex,
            self.session, self.lost, self.doubled, self.disordered, self.superseded, self.foreign,
            *(force[:6] if len(force) >= 6 else _NO_FORCE),
            1e-3 * (here.x - planned.x), 1e-3 * (here.y - planned.y), 1e-3 * (here.z - planned.z),
            _POWERED.get(motors, -1),
        )  # fmt: skip

    def _force(self, encoded: bytes) -> Sequence[float]:
        """Return force and torque at the tool, N and Nm; none where no sensor is active."""
        try:
            gauge = self._measured_force.FromString(encoded)
            force: Sequence[float] = gauge.force if gauge.fcActive else self._measured_force_6.FromString(encoded).force
        except message.DecodeError:
            return ()
        return force if all(-_LARGEST <= value <= _LARGEST for value in force) else ()

    def _show(self, state: DriveState, at: Sequence[float], velocity: Sequence[float]) -> None:
        self._at = at
        for i in range(self._axes):
            self._inputs[i] = _MEASURED.pack(radians(at[i]), state, self.missing, radians(velocity[i]))


def _takes_references(robot: Any) -> bool:
    is_on = robot.motorState.state == _MOTORS_ON and robot.rapidExecState.state != _RAPID_STOPPED
    return bool(is_on and robot.mciState.state == _MCI_RUNNING)


def _in_order(part: Any, axes: int) -> list[float]:
    """Return the joint positions of a message in kinematic order, degrees."""
    joints = list(part.joints.joints)
    return joints if axes <= 6 else [*joints[:_EXTERNAL], part.externalJoints.joints[0], *joints[_EXTERNAL:]]


def _set(part: Any, values: Sequence[float]) -> None:
    if len(values) > 6:
        part.joints.joints[:] = (*values[:_EXTERNAL], *values[_EXTERNAL + 1 :])
        part.externalJoints.joints[:] = (values[_EXTERNAL],)
    else:
        part.joints.joints[:] = values


class EgmMaster(Master):
    """A bus of kind `egm`."""

    def __init__(self, config: ArmConfig, interface: str, namespace_pid: int) -> None:
        super().__init__(config, interface, namespace_pid)
        self._socket: socket.socket | None = None
        self._data: EgmData | None = None

    @staticmethod
    def check_interface(name: str) -> None:
        """Raise BusError where this host has no such address."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((name, 0))
            except OSError as error:
                raise BusError(f"address {name} (`interface`) is none of this host's: {error.strerror}") from error

    def start(self, directory: Path, report: Callable[[str], None]) -> EgmData:
        """Bind the port of the unit."""
        bus = self.config.bus
        assert isinstance(bus, EgmBus)
        if self.namespace_pid:
            enter(self.namespace_pid)
        address = "127.0.0.1" if bus.interface == VIRTUAL else bus.interface
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        try:
            self._socket.bind((address, bus.port))
        except OSError as error:
            raise BusError(
                f"UDP port {bus.port} of {address} (bus.port) cannot be opened: {error.strerror}; does another program "
                "use it?"
            ) from error
        report(f"UDP port {bus.port} of {address} is open for the controller")
        self._data = EgmData(self._socket, self.config, bus)
        return self._data

    @property
    def connected(self) -> bool:
        """Whether the controller sends."""
        return self._data is not None and self._data.missing is not Missing.CONNECTION

    def waiting_for(self) -> str:
        """Return what is missing at the controller."""
        data = self._data
        return "" if data is None or data.missing is Missing.NOTHING else MISSING_WORDS[data.missing]

    def explain(self, axis: int) -> str:
        """Return why a joint left its state."""
        data = self._data
        if data is None:
            return ""
        if data.missing is Missing.NOTHING:
            return f"session {data.session} of EGM has begun since: the controller's program was started again"
        return MISSING_WORDS[data.missing]

    def close(self) -> None:
        """Close the port; the controller, whose last speed reference is 0, stops by its CommTimeout."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
