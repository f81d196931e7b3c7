"""RAPID streaming as a bus: joint targets by Simple Message over TCP to a program on the controller (`abb/rapid`).

The program answers a point when it has accepted it; the next point waits for that answer, and newer targets replace a
waiting one. Nothing here blocks. Units on the wire: rad, float32.

The joints of all arms of one controller are in one point. In a cell the platform of the first arm holds the connection,
and exchanges targets and positions with the platforms of the other arms (`rtcp.fieldbus.rapid_units`).
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
from rtcp.config.cell import ControllerUnits
from rtcp.config.model import VIRTUAL, ArmConfig
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.master import Master
from rtcp.fieldbus.rapid_units import (
    COMMANDED,
    FOLLOW,
    MEASURED,
    ORDER,
    UNIT,
    SharedUnitData,
    UnitExchange,
)
from rtcp.fieldbus.simple_message import messages
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder, FrameError
from rtcp.ipc.names import MISSING_WORDS
from rtcp.ipc.states import DriveState, Missing

_UNKNOWN: Final = messages.Status()
_BOARD: Final = struct.Struct("<H")
_INTEGER: Final = struct.Struct("<i")
_BOARD_STATE: Final = struct.Struct("<ii")
_MOTORS_MESSAGE: Final = 65001
_BOARD_STATE_MESSAGE: Final = 65002
_BOARD_OUTPUTS_MESSAGE: Final = 65003
"""Extensions of `abb/rapid`, from the range of message types that REP-I0004 leaves free."""
_ACKNOWLEDGED: Final = (int(messages.MessageType.PING), _MOTORS_MESSAGE, _BOARD_OUTPUTS_MESSAGE)
"""Requests whose reply says only that they were received."""
_HEARTBEAT_NS: Final = 500_000_000
"""Interval of PING on a connection that is idle, ns; the program counts a client as lost after 2 s."""
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
        self.heard_ns = 0
        """Instant of the last received data, or of the connection's begin, ns."""
        self.sent_ns = 0
        """Instant of the last sent message, ns; 0: nothing was sent on this connection."""

    def receive(self, now_ns: int, may_connect: bool = True) -> list[Frame]:
        """Connect if there is no connection, and return the received frames."""
        if self._socket is None:
            if may_connect and now_ns >= self._due_ns:
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
                self.heard_ns = now_ns
                # The controller holds the next small message back until this one is acknowledged (RFC 896).
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
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
        self.sent_ns = now_ns
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
        self.is_open, self.heard_ns, self.sent_ns = True, now_ns, 0
        return True

    def _lose(self, problem: str, now_ns: int) -> None:
        self.close()
        self._due_ns = now_ns + _RECONNECT_NS
        host, port = self._address
        self.problem = f"no connection to its {self._name} at {host}:{port}: {problem}"


class _Unit:
    """A mechanical unit as the stream sees it.

    Args:
        name: name of its arm.
        first: index of its first joint in the points.
        joints: number of its joints.
    """

    def __init__(self, name: str, first: int, joints: int) -> None:
        self.name = name
        self.axes = range(first, first + joints)
        self.in_stream = False
        """Whether its targets are those of the points: it began to follow where its joints stood."""
        self.blocked = False
        """Whether it is commanded to follow, but its targets are not sent."""


class RapidData(ProcessData):
    """The exchange with the servers of one controller, at the pace of this side's clock.

    Args:
        config: the arm.
        bus: its bus.
        host: IPv4 address of the controller.
        now: clock, ns; a simulated one in tests.
        exchange: with the platforms of the other arms of the controller; None: there is one arm.
    """

    def __init__(
        self,
        config: ArmConfig,
        bus: RapidBus,
        host: str,
        now: Callable[[], int] = monotonic_ns,
        exchange: UnitExchange | None = None,
    ) -> None:
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
        self._exchange = exchange
        self._own = len(config.joints)
        self._units = [_Unit(config.name if exchange is None else exchange.name, 0, self._own)]
        self._velocity = [joint.velocity for joint in config.joints]
        for partner in () if exchange is None else exchange.partners:
            self._units.append(_Unit(partner.name, len(self._velocity), len(partner.velocity)))
            self._velocity += partner.velocity
        self._axes = axes = len(self._velocity)
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
        self._outputs = [COMMANDED.pack(0.0, 0.0, 0)] * self._own
        self._inputs = [MEASURED.pack(0.0, DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION)] * self._own
        self._inputs.append(bytes(UNIT.size))
        self._has_board = bool(bus.board)
        if self._has_board:
            self._inputs.append(bytes(_BOARD.size))
        self._wanted_word = self._sent_word = 0
        """Outputs of the board: as commanded, and as last sent on this connection; -1: none was sent."""
        self._motors_order = self._given_order = 0
        """Order to the motors: as commanded, and the last one that was given."""
        self.refusal = ""
        """Message on a refused point, or on a stop because of another arm; empty: neither happened."""
        self._forget_requests()

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
        for unit in self._units:
            unit.in_stream = False

    def _forget_requests(self) -> None:
        """Forget all that belongs to a connection that has ended."""
        self._reset()
        self._asked: dict[int, int] = dict.fromkeys(_ACKNOWLEDGED, 0)
        """Type of a message that is only acknowledged -> instant at which the unanswered one was sent, ns; 0: none."""
        self._sent_word = -1
        # An order that nobody could carry out is not carried out later.
        self._given_order = self._motors_order
        for partner in () if self._exchange is None else self._exchange.partners:
            partner.given_order = partner.motors_order

    # -- the cycle ----------------------------------------------------------------------------------------------------

    def receive(self) -> int:
        """Read all received messages; return 1, or -1 where positions or status are older than `state_period_s`."""
        now = self._now()
        for frame in self.state.receive(now):
            self._read_state(frame, now)
        if now - self.state.heard_ns > self._answer_ns:
            # The cable or the controller: without a message TCP would take minutes to notice.
            self.state.end(f"no message for {1e-9 * self._answer_ns:g} s", now)
        # The state comes first: without it no motion is allowed.
        for frame in self.motion.receive(now, self._status is not None):
            self._read_reply(frame, now)
        if now - self._oldest_request(now) > self._answer_ns:
            self.motion.end(f"no answer for {1e-9 * self._answer_ns:g} s", now)
        if not self.motion.is_open:
            self._forget_requests()
        if not self.state.is_open:
            self._status = None
        is_fresh = now - min(self._positions_ns, self._status_ns) <= self._state_ns
        self._show(is_fresh)
        if is_fresh:
            return 1
        self.missed += 1
        return -1

    def _oldest_request(self, now: int) -> int:
        """Return when the oldest unanswered request was sent; `now` where there is none."""
        oldest = self._offered_ns if self._offered else self._stop_ns or now
        for sent_ns in self._asked.values():
            if 0 < sent_ns < oldest:
                oldest = sent_ns
        return oldest

    def send(self) -> None:
        """Offer the newest targets, or stop the program unless every joint is commanded and allowed to follow."""
        now = self._now()
        self._beat(self.state, messages.CommType.TOPIC, now)
        follows = self._read_commands(now)
        if not self.motion.is_open:
            return
        self._beat(self.motion, messages.CommType.SERVICE_REQUEST, now)
        self._send_orders(now)
        if self._stop_ns:
            return
        if not follows or self._state is not DriveState.OPERATION_ENABLED:
            if self._sequence or self._offered or self._refused:
                self._stop(now)
            else:
                self._reference = []
        else:
            self._follow(now)

    def _read_commands(self, now: int) -> bool:
        """Take the targets and commands of all units; return whether one is in the stream, and none ends it.

        A unit whose targets are not where its joints stand does not enter the stream. A unit that ends its motion
        before its joints are there ends that of all: the program stops all arms.
        """
        own = self._units[0]
        own_follows = True
        for i in own.axes:
            self._targets[i], _, command = COMMANDED.unpack(self._outputs[i])
            own_follows = own_follows and command == FOLLOW
        exchange = self._exchange
        if exchange is not None:
            exchange.read()
        follows, goes_on = False, True
        for number, unit in enumerate(self._units):
            unit_follows, is_suspended = own_follows, False
            if exchange is not None and number:
                partner = exchange.partners[number - 1]
                unit_follows = exchange.follows(number - 1, now - self._answer_ns)
                is_suspended = partner.is_suspended
                for i, target in zip(unit.axes, partner.targets, strict=True):
                    self._targets[i] = target
            if unit.in_stream and not unit_follows and len(self._units) > 1 and not self._rests(unit):
                goes_on = False
                self.refusal = f"the controller's program was stopped for all its arms, because {unit.name} was stopped"
            unit.in_stream = unit_follows and ((unit.in_stream and not self._stop_ns) or self._at_start(unit))
            unit.blocked = not unit.in_stream and (unit_follows or is_suspended)
            if unit.in_stream:
                follows = True
            else:
                resting = self._offered or self._reference or self._actual
                for i in unit.axes:
                    self._targets[i] = resting[i]
        return follows and goes_on

    def _rests(self, unit: _Unit) -> bool:
        """Return whether the joints of a unit are where its last point leads."""
        reference = self._offered or self._reference
        return not reference or all(abs(reference[i] - self._actual[i]) <= _START_RAD for i in unit.axes)

    def _at_start(self, unit: _Unit) -> bool:
        """Return whether all targets of a unit are within `_START_RAD` of its joints' positions."""
        return all(abs(self._targets[i] - self._actual[i]) <= _START_RAD for i in unit.axes)

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

    def _stop(self, now: int) -> None:
        self._stop_ns = now
        self._send_point(messages.SpecialSequence.STOP_TRAJECTORY, self._targets, 0.0, now)

    def _send_point(self, sequence: int, targets: Sequence[float], duration_s: float, now: int) -> None:
        body = self._point.pack(sequence, *targets, *self._unused, 1.0, duration_s)
        self._send(self.motion, messages.MessageType.JOINT_TRAJ_PT, messages.CommType.SERVICE_REQUEST, body, now)

    def _beat(self, connection: Connection, comm_type: messages.CommType, now: int) -> None:
        """Send a heartbeat where nothing else was sent for its interval, and at the begin of a connection."""
        if not connection.is_open or now - connection.sent_ns < _HEARTBEAT_NS:
            return
        if comm_type is messages.CommType.SERVICE_REQUEST:
            if self._oldest_request(now) < now:
                return  # the answer is due anyway
            self._asked[messages.MessageType.PING] = now
        self._send(connection, messages.MessageType.PING, comm_type, b"", now)

    def _send_orders(self, now: int) -> None:
        """Send the outputs of the board, and an order to the motors, where they have changed."""
        if self._has_board and self._wanted_word != self._sent_word and not self._asked[_BOARD_OUTPUTS_MESSAGE]:
            self._sent_word = self._wanted_word
            self._ask(_BOARD_OUTPUTS_MESSAGE, self._wanted_word, now)
        self._given_order = self._give_order(self._motors_order, self._given_order, now)
        for partner in () if self._exchange is None else self._exchange.partners:
            partner.given_order = self._give_order(partner.motors_order, partner.given_order, now)

    def _give_order(self, order: int, given: int, now: int) -> int:
        """Give an order to the motors if it has changed; return the last one that was given."""
        if order == given or self._asked[_MOTORS_MESSAGE]:
            return given
        if order in (1, 2):
            self._ask(_MOTORS_MESSAGE, 2 - order, now)
        return order

    def _ask(self, msg_type: int, value: int, now: int) -> None:
        self._asked[msg_type] = now
        self._send(self.motion, msg_type, messages.CommType.SERVICE_REQUEST, _INTEGER.pack(value), now)

    @staticmethod
    def _send(connection: Connection, msg_type: int, comm_type: messages.CommType, body: bytes, now: int) -> None:
        frame = Frame(msg_type, comm_type, messages.ReplyCode.INVALID, body)
        connection.send(frame.pack(messages.ByteOrder.LITTLE), now)

    def input(self, index: int) -> bytes:
        """Return the inputs of a node: the joints in their order, then the unit, then the board."""
        return self._inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of a joint, of the unit, or of the board."""
        if index < self._own and len(data) == COMMANDED.size:
            self._outputs[index] = data
        elif index == self._own and len(data) == ORDER.size:
            (self._motors_order,) = ORDER.unpack(data)
        elif index == self._own + 1 and len(data) == _BOARD.size:
            (self._wanted_word,) = _BOARD.unpack(data)

    def close(self) -> None:
        """Stop the program and close the connections; may be called twice."""
        if self._sequence or self._offered:
            self._send_point(messages.SpecialSequence.STOP_TRAJECTORY, self._targets, 0.0, self._now())
        self._reset()
        self.motion.close()
        self.state.close()
        if self._exchange is not None:
            self._exchange.close()

    @property
    def problem(self) -> str:
        """Why there is no connection; empty: both are open."""
        closed = [each.problem for each in (self.state, self.motion) if not each.is_open]
        return closed[0] if closed else ""

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
        elif frame.msg_type == _BOARD_STATE_MESSAGE and self._has_board and len(frame.body) == _BOARD_STATE.size:
            inputs, _ = _BOARD_STATE.unpack(frame.body)
            self._inputs[self._own + 1] = _BOARD.pack(inputs & 0xFFFF)

    def _read_reply(self, frame: Frame, now: int) -> None:
        """Read a reply of the motion server; replies match requests of one type by their order only."""
        if frame.comm_type is not messages.CommType.SERVICE_REPLY:
            return
        if self._asked.get(frame.msg_type):
            # Also a refusal is a sign of life; a program of an earlier version knows none of these messages.
            self._asked[frame.msg_type] = 0
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

    def _show(self, is_fresh: bool) -> None:
        """Write the inputs of the joints from the newest messages, and tell the other platforms theirs."""
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
            state, self.missing = DriveState.OPERATION_ENABLED, Missing.NOTHING
        self._state = DriveState.SWITCHED_ON if self._refused and self.missing is Missing.NOTHING else state
        told = status or _UNKNOWN
        about = UNIT.pack(
            self.accepted & 0xFFFFFFFF, self.refused & 0xFFFFFFFF, self._waits, self.acceptance_s,
            told.drives_powered, told.e_stopped, told.mode,
        )  # fmt: skip
        for number, unit in enumerate(self._units):
            of_unit = state
            ends = self._refused or unit.blocked
            if state is DriveState.OPERATION_ENABLED and ends:
                of_unit = DriveState.SWITCHED_ON
            if number == 0:
                for i in unit.axes:
                    self._inputs[i] = MEASURED.pack(self._actual[i], of_unit, self.missing)
                self._inputs[self._own] = about
            elif self._exchange is not None:
                positions = self._actual[unit.axes.start : unit.axes.stop]
                self._exchange.tell(number - 1, is_fresh, of_unit, self.missing, about, positions)


class RapidMaster(Master):
    """A bus of kind `rapid`."""

    def __init__(self, config: ArmConfig, interface: str, namespace_pid: int) -> None:
        super().__init__(config, interface, namespace_pid)
        self._data: RapidData | SharedUnitData | None = None
        self._units: ControllerUnits | None = None

    @staticmethod
    def check_interface(name: str) -> None:
        """Raise BusError where `name` is no IPv4 address."""
        try:
            socket.inet_pton(socket.AF_INET, name)
        except OSError:
            raise BusError(f"{name} (`interface`) is no IPv4 address: that of the controller is expected") from None

    def share(self, units: ControllerUnits) -> None:
        """Exchange this arm's joints with the platform of the controller's first arm, which holds the connection."""
        self._units = units

    def start(self, directory: Path, report: Callable[[str], None]) -> RapidData | SharedUnitData:
        """Begin to connect; the cycle continues that."""
        bus = self.config.bus
        assert isinstance(bus, RapidBus)
        units = self._units
        if units is not None and units.index:
            self._data = SharedUnitData(self.config, bus, units)
            report(f"the platform {units.members[0].name} holds the connection to the controller")
            return self._data
        exchange = None if units is None else UnitExchange(units)
        if self.namespace_pid:
            enter(self.namespace_pid)
        host = "127.0.0.1" if bus.interface == VIRTUAL else bus.interface
        report(f"connecting to the controller at {host}, TCP ports {bus.motion_port} and {bus.state_port}")
        self._data = RapidData(self.config, bus, host, exchange=exchange)
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
        closed = data.problem
        return closed or MISSING_WORDS[data.missing]

    def explain(self, axis: int) -> str:
        """Return why a joint left its state."""
        return self.waiting_for() or ("" if self._data is None else self._data.refusal)

    def close(self) -> None:
        """Stop the program and close the connections."""
        if self._data is not None:
            self._data.close()
