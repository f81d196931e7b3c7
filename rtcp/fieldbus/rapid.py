"""RAPID streaming as a bus: joint targets by Simple Message over TCP to a program on the controller (`abb/rapid`).

The program answers a point when it has accepted it; the next point waits for that answer, and newer targets replace a
waiting one. Nothing here blocks. Units on the wire: rad, float32.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic_ns
from typing import Final

from rtcp.config.buses import RapidBus
from rtcp.config.model import VIRTUAL, ArmConfig
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.simple_message import messages
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder, FrameError
from rtcp.ipc.names import MISSING_WORDS
from rtcp.ipc.states import DriveState, Missing

_FOLLOW: Final = 1
"""Command of a joint's outputs (`rtcp.config.buses.JOINT_OUTPUTS`)."""
_COMMANDED: Final = struct.Struct("<ddB")
_MEASURED: Final = struct.Struct("<dBB")
_UNIT: Final = struct.Struct("<IIBdBB")
_READ_BYTES: Final = 4096
_MOST_READS: Final = 64
"""Most reads in a cycle: enough to read all old states at once after a stall."""
_RECONNECT_NS: Final = 1_000_000_000
"""Interval between two attempts to connect, ns (ROS-Industrial driver specification)."""
_CONNECT_NS: Final = 3_000_000_000
_LARGEST: Final = 1e3
"""Largest valid measurement, rad."""
_START_RAD: Final = 0.01
"""Greatest distance of a stream's first target from the joints' positions, rad: the program starts from there."""


class Connection:
    """A TCP connection to one of the controller's servers, with automatic reconnection; does not block.

    Args:
        name: name of the server in messages.
        host: IPv4 address.
        port: TCP port of the server.
    """

    def __init__(self, name: str, host: str, port: int) -> None:
        self.problem = f"no answer from its {name} at {host}:{port} yet"
        """Why there is no connection, or why the last one ended."""
        self.is_open = False
        self._name = name
        self._address = host, port
        self._socket: socket.socket | None = None
        self._decoder = FrameDecoder(messages.ByteOrder.LITTLE)
        self._due_ns = 0
        """Instant of the next attempt to connect; while connecting: of the timeout, ns."""

    def receive(self, now_ns: int) -> list[Frame]:
        """Connect if there is no connection, and return the received frames."""
        if self._socket is None:
            if now_ns >= self._due_ns:
                self._connect(now_ns)
            return []
        if not self.is_open and not self._connected(self._socket, now_ns):
            return []
        frames: list[Frame] = []
        try:
            for _ in range(_MOST_READS):
                data = self._socket.recv(_READ_BYTES)
                if not data:
                    self._lose("the controller closed the connection", now_ns)
                    break
                frames += self._decoder.feed(data)
                if len(data) < _READ_BYTES:
                    break
        except BlockingIOError:
            pass
        except OSError as error:
            self._lose(os.strerror(error.errno or 0), now_ns)
        except FrameError as error:
            self._lose(str(error), now_ns)
        return frames

    def send(self, data: bytes, now_ns: int) -> None:
        """Send a message; end the connection where the send buffer is full, as the controller does not read."""
        if self._socket is None or not self.is_open:
            return
        try:
            sent = self._socket.send(data, socket.MSG_NOSIGNAL)
        except OSError as error:
            self._lose(os.strerror(error.errno or 0), now_ns)
            return
        if sent < len(data):
            self._lose("it does not read", now_ns)

    def end(self, problem: str, now_ns: int) -> None:
        """Close an open connection; the next attempt to connect follows after `_RECONNECT_NS`."""
        if self.is_open:
            self._lose(problem, now_ns)

    def close(self) -> None:
        """Close the connection for good."""
        self.is_open = False
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self, now_ns: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._due_ns = now_ns + _CONNECT_NS
        number = self._socket.connect_ex(self._address)
        if number not in (0, errno.EINPROGRESS):
            self._lose(os.strerror(number), now_ns)

    def _connected(self, connecting: socket.socket, now_ns: int) -> bool:
        if not select.select((), (connecting,), (), 0.0)[1]:
            if now_ns > self._due_ns:
                self._lose(os.strerror(errno.ETIMEDOUT), now_ns)
            return False
        number = connecting.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if number:
            self._lose(os.strerror(number), now_ns)
            return False
        self._decoder = FrameDecoder(messages.ByteOrder.LITTLE)
        self.is_open = True
        return True

    def _lose(self, problem: str, now_ns: int) -> None:
        self.close()
        self._due_ns = now_ns + _RECONNECT_NS
        host, port = self._address
        self.problem = f"no connection to its {self._name} at {host}:{port}: {problem}"


class RapidData(ProcessData):
    """The exchange with the servers of one controller, at the pace of this side's clock.

    Args:
        config: the arm.
        bus: its bus.
        host: IPv4 address of the controller.
        now: clock, ns; a simulated one in tests.
    """

    def __init__(self, config: ArmConfig, bus: RapidBus, host: str, now: Callable[[], int] = monotonic_ns) -> None:
        self._now = now
        self.expected_wkc = 1
        self.dc_time = self.missed = self.stale = 0
        self.motion = Connection("motion server", host, bus.motion_port)
        self.state = Connection("state server", host, bus.state_port)
        self.missing = Missing.CONNECTION
        self.accepted = self.refused = 0
        """Points accepted and refused since the start."""
        self.acceptance_s = 0.0
        """Time from the last point to its acceptance, s."""
        self._axes = axes = len(config.joints)
        on_wire = max(axes, messages.JOINTS)
        self._position = struct.Struct(f"<i{on_wire}f")
        self._point = struct.Struct(f"<i{on_wire}fff")
        self._unused = (0.0,) * (on_wire - axes)
        self._answer_ns = round(bus.answer_timeout_s * 1e9)
        self._state_ns = round(bus.state_period_s * 1e9)
        self._state = DriveState.NOT_READY_TO_SWITCH_ON
        self._status: messages.Status | None = None
        """Newest status of this connection."""
        self._actual = [0.0] * axes
        self._positions_ns = self._status_ns = -self._state_ns - 1
        """Instants of the newest positions and the newest status, ns."""
        self._targets = [0.0] * axes
        self._outputs = [_COMMANDED.pack(0.0, 0.0, 0)] * axes
        self._inputs = [_MEASURED.pack(0.0, DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION)] * axes
        self._inputs.append(bytes(_UNIT.size))
        self._velocity = [joint.velocity for joint in config.joints]
        self._blocked = False
        """Whether targets were not sent: a stop is unanswered, or the first target is too far from the joints."""
        self.refusal = ""
        """Message on a refused point; empty: none was refused."""
        self._reset()

    def _reset(self) -> None:
        """Forget all pending points: the connection has ended, or the joints stand still."""
        self._reference: list[float] = []
        """Program's target, rad: the last accepted one, or the joints' positions at standstill; empty: none."""
        self._reference_ns = 0
        """Instant for which that target was commanded, ns."""
        self._offered: list[float] = []
        """Unanswered target, rad; empty: none."""
        self._offered_ns = 0
        self._waits = False
        """Whether a newer target than the offered one waits."""
        self._sequence = 0
        """Number of the next point; above 0 the program may have points."""
        self._stop_ns = 0
        """Instant at which the unanswered stop was sent, ns; 0: none."""
        self._refused = False
        """Whether a point was refused: the program is stopped, whatever the command."""

    # -- the cycle ----------------------------------------------------------------------------------------------------

    def receive(self) -> int:
        """Read all received messages; return 1, or -1 where positions or status are older than `state_period_s`."""
        now = self._now()
        for frame in self.state.receive(now):
            self._read_state(frame, now)
        for frame in self.motion.receive(now):
            self._read_reply(frame, now)
        asked_ns = self._offered_ns if self._offered else self._stop_ns or now
        if now - asked_ns > self._answer_ns:
            self.motion.end(f"no answer for {1e-9 * self._answer_ns:g} s", now)
        if not self.motion.is_open:
            self._reset()
        if not self.state.is_open:
            self._status = None
        self._show()
        if now - min(self._positions_ns, self._status_ns) <= self._state_ns:
            return 1
        self.missed += 1
        return -1

    def send(self) -> None:
        """Offer the newest targets, or stop the program unless all joints are commanded and allowed to follow."""
        now = self._now()
        follows = True
        for i in range(self._axes):
            self._targets[i], _, command = _COMMANDED.unpack(self._outputs[i])
            follows = follows and command == _FOLLOW
        self._blocked = follows and (self._stop_ns > 0 or not (self._reference or self._offered or self._at_start()))
        if not self.motion.is_open or self._stop_ns:
            return
        if not follows or self._state is not DriveState.OPERATION_ENABLED:
            if self._sequence or self._offered or self._refused:
                self._stop_ns = now
                self._send_point(messages.SpecialSequence.STOP_TRAJECTORY, self._targets, 0.0, now)
            else:
                self._reference = []
        elif not self._blocked:
            self._follow(now)

    def _at_start(self) -> bool:
        """Return whether all targets are within `_START_RAD` of the joints' positions."""
        return all(abs(self._targets[i] - self._actual[i]) <= _START_RAD for i in range(self._axes))

    def _follow(self, now: int) -> None:
        if self._offered:
            self._waits = True
        elif not self._reference or self._targets == self._reference:
            # Standstill needs no message; the time to the next target counts from now.
            self._reference, self._reference_ns = self._targets.copy(), now
            self.refusal = ""
        elif now - self._reference_ns > self._answer_ns:
            # The arm has come to rest by itself and must not move on when a suspended loop continues.
            self.motion.end(f"the loop stood still for {1e-9 * (now - self._reference_ns):.1f} s in a motion", now)
        else:
            duration_s = 1e-9 * (now - self._reference_ns)
            for i, target in enumerate(self._targets):
                # An early cycle must not demand more than the joint's speed limit.
                duration_s = max(duration_s, abs(target - self._reference[i]) / self._velocity[i])
            self._offered, self._offered_ns = self._targets.copy(), now
            self._send_point(self._sequence, self._offered, duration_s, now)

    def _send_point(self, sequence: int, targets: Sequence[float], duration_s: float, now: int) -> None:
        body = self._point.pack(sequence, *targets, *self._unused, 1.0, duration_s)
        frame = Frame(
            messages.MessageType.JOINT_TRAJ_PT, messages.CommType.SERVICE_REQUEST, messages.ReplyCode.INVALID, body
        )
        self.motion.send(frame.pack(messages.ByteOrder.LITTLE), now)

    def input(self, index: int) -> bytes:
        """Return the inputs of a node: the joints in their order, then the unit."""
        return self._inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of a joint; the unit has none."""
        if index < self._axes and len(data) == _COMMANDED.size:
            self._outputs[index] = data

    def close(self) -> None:
        """Stop the program and close the connections; may be called twice."""
        if self._sequence or self._offered:
            self._send_point(messages.SpecialSequence.STOP_TRAJECTORY, self._targets, 0.0, self._now())
        self._reset()
        self.motion.close()
        self.state.close()

    # -- messages -----------------------------------------------------------------------------------------------------

    def _read_state(self, frame: Frame, now: int) -> None:
        """Read a message of the state server; unknown ones are ignored."""
        if frame.msg_type == messages.MessageType.STATUS:
            with contextlib.suppress(messages.MessageError):
                self._status = messages.Status.unpack(frame.body, messages.ByteOrder.LITTLE)
                self._status_ns = now
        elif frame.msg_type == messages.MessageType.JOINT_POSITION and len(frame.body) == self._position.size:
            _, *joints = self._position.unpack(frame.body)
            if all(-_LARGEST <= joint <= _LARGEST for joint in joints):
                self._actual[:] = joints[: self._axes]
                self._positions_ns = now

    def _read_reply(self, frame: Frame, now: int) -> None:
        """Read a reply of the motion server; replies match requests by their order only."""
        if frame.comm_type is not messages.CommType.SERVICE_REPLY:
            return
        accepted = frame.reply_code is messages.ReplyCode.SUCCESS
        if frame.msg_type != messages.MessageType.JOINT_TRAJ_PT or not (self._offered or self._stop_ns):
            self.motion.end("a reply came that nothing had asked for", now)
        elif self._offered:
            if accepted:
                self.accepted += 1
                self.acceptance_s = 1e-9 * (now - self._offered_ns)
                self._reference, self._reference_ns = self._offered, self._offered_ns
                self._sequence += 1
            else:
                # A repetition with more time would be accepted, but would skip the points in between.
                self.refused += 1
                self._refused = True
                self.refusal = (
                    f"the controller's program refused point {self._sequence}: faster than its MAX_SPEED, or no room "
                    "in its queue within ACCEPT_TIMEOUT; see its display, then reset"
                )
            self._offered = []
            self._waits = False
        elif accepted:
            self._reset()
        else:
            # Now only the end of the connection stops the arm.
            self.motion.end("it refused to stop", now)

    def _show(self) -> None:
        """Write the inputs of the joints from the newest messages."""
        status = self._status
        if status is None or not self.motion.is_open:
            state, self.missing = DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION
        elif status.in_error is messages.TriState.TRUE:
            state, self.missing = DriveState.FAULT, Missing.CLEARANCE
        elif status.e_stopped is messages.TriState.TRUE or status.drives_powered is messages.TriState.FALSE:
            state, self.missing = DriveState.SWITCH_ON_DISABLED, Missing.MOTORS
        elif status.motion_possible is messages.TriState.FALSE:
            state, self.missing = DriveState.READY_TO_SWITCH_ON, Missing.PROGRAM
        else:
            ends = self._blocked or self._refused
            state = DriveState.SWITCHED_ON if ends else DriveState.OPERATION_ENABLED
            self.missing = Missing.NOTHING
        self._state = state
        for i in range(self._axes):
            self._inputs[i] = _MEASURED.pack(self._actual[i], state, self.missing)
        is_stopped = status is not None and status.e_stopped is messages.TriState.TRUE
        mode = messages.RobotMode.UNKNOWN if status is None else status.mode
        self._inputs[self._axes] = _UNIT.pack(
            self.accepted & 0xFFFFFFFF, self.refused & 0xFFFFFFFF, self._waits, self.acceptance_s, is_stopped,
            max(mode, 0),
        )  # fmt: skip


class RapidMaster(Master):
    """A bus of kind `rapid`."""

    def __init__(self, config: ArmConfig, interface: str, namespace_pid: int) -> None:
        super().__init__(config, interface, namespace_pid)
        self._data: RapidData | None = None

    @staticmethod
    def check_interface(name: str) -> None:
        """Raise BusError where `name` is no IPv4 address."""
        try:
            socket.inet_pton(socket.AF_INET, name)
        except OSError:
            raise BusError(f"{name} (`interface`) is no IPv4 address: that of the controller is expected") from None

    def start(self, directory: Path, report: Callable[[str], None]) -> RapidData:
        """Begin to connect; the cycle continues that."""
        bus = self.config.bus
        assert isinstance(bus, RapidBus)
        if self.namespace_pid:
            enter(self.namespace_pid)
        host = "127.0.0.1" if bus.interface == VIRTUAL else bus.interface
        report(f"connecting to the controller at {host}, TCP ports {bus.motion_port} and {bus.state_port}")
        self._data = RapidData(self.config, bus, host)
        return self._data

    @property
    def connected(self) -> bool:
        """Whether both servers of the controller answer."""
        return self._data is not None and self._data.missing is not Missing.CONNECTION

    def waiting_for(self) -> str:
        """Return what is missing at the controller."""
        data = self._data
        if data is None or data.missing is Missing.NOTHING:
            return ""
        closed = [each.problem for each in (data.motion, data.state) if not each.is_open]
        return closed[0] if closed else MISSING_WORDS[data.missing]

    def explain(self, axis: int) -> str:
        """Return why a joint left its state."""
        return self.waiting_for() or ("" if self._data is None else self._data.refusal)

    def close(self) -> None:
        """Stop the program and close the connections."""
        if self._data is not None:
            self._data.close()
