"""Exchange between the platforms of a controller's arms, of which one holds the connection (`rtcp.fieldbus.rapid`).

Two datagrams a cycle, over Unix sockets in the runtime directories: the platform with the connection tells each other
one its measurements, which begins that platform's cycle; its targets come back before the next point is made. So all
arms of a point are commanded for one instant. A record of the blackboard would do for the values, not for the pace.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from collections.abc import Callable
from time import monotonic_ns, sleep
from typing import Final

from rtcp.config.buses import RapidBus
from rtcp.config.cell import ControllerUnits, Member
from rtcp.config.model import ArmConfig
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.master import PacedData
from rtcp.ipc.states import DriveState, Missing

_SOCKET: Final = "unit.sock"
"""Socket of each platform, in its runtime directory."""
FOLLOW: Final = 1
"""Command of a joint's outputs (`rtcp.config.buses.JOINT_OUTPUTS`)."""
COMMANDED: Final = struct.Struct("<ddB")
MEASURED: Final = struct.Struct("<dBB")
UNIT: Final = struct.Struct("<IIBdbbb")
ORDER: Final = struct.Struct("<B")
"""Process images of `rtcp.config.buses`: outputs and inputs of a joint, inputs and outputs of the unit."""
_MOST_WAITING: Final = 64
"""Most datagrams read in one cycle."""
_DATAGRAM: Final = 1024
_STATES: Final = tuple(DriveState)
_MISSING: Final = tuple(Missing)


def _targets_layout(joints: int) -> struct.Struct:
    """Return the datagram with targets: index of the unit, whether it follows, order to the motors, instant, rad."""
    return struct.Struct(f"<BBBq{joints}d")


def _measurements_layout(joints: int) -> struct.Struct:
    """Return the datagram with measurements: whether they are fresh, state, missing, inputs of the unit, rad."""
    return struct.Struct(f"<BBB{UNIT.size}s{joints}d")


def _bind(member: Member) -> socket.socket:
    """Return the bound socket of a platform; raises BusError."""
    bound = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    bound.setblocking(False)
    path = member.directory / _SOCKET
    try:
        path.unlink(missing_ok=True)
        bound.bind(str(path))
    except OSError as error:
        bound.close()
        raise BusError(f"{path}: the socket for the other arms of the controller cannot be made: {error}") from error
    return bound


class Partner:
    """An arm of the controller whose platform does not hold the connection."""

    def __init__(self, member: Member) -> None:
        joints = member.config.joints
        self.name = member.name
        self.velocity = [joint.velocity for joint in joints]
        """Speed limits of the joints, rad/s."""
        self.targets = [0.0] * len(joints)
        """Newest targets, rad."""
        self.follows = False
        """Whether its joints are commanded to follow their targets."""
        self.is_suspended = False
        """Whether its platform fell silent while the joints followed: `UnitExchange.follows`."""
        self.sent_ns = 0
        """Instant at which its platform sent that, CLOCK_MONOTONIC, ns; 0: never."""
        self.motors_order = self.given_order = 0
        """Order to the motors: as commanded, and the last one that was given."""
        self.address = str(member.directory / _SOCKET)
        self.layout, self.measurements = _targets_layout(len(joints)), _measurements_layout(len(joints))


class UnitExchange:
    """The end of the platform that holds the connection.

    Raises:
        BusError: its socket cannot be made.
    """

    def __init__(self, units: ControllerUnits) -> None:
        self.name = units.members[0].name
        self._socket = _bind(units.members[0])
        self.partners = [Partner(member) for member in units.members[1:]]

    def read(self) -> None:
        """Take the newest targets of each partner."""
        for _ in range(_MOST_WAITING):
            try:
                data = self._socket.recv(_DATAGRAM)
            except OSError:
                return
            index = data[0] - 1 if data else -1
            if not 0 <= index < len(self.partners) or len(data) != self.partners[index].layout.size:
                continue
            partner = self.partners[index]
            _, follows, partner.motors_order, sent_ns, *targets = partner.layout.unpack(data)
            if all(target - target == 0.0 for target in targets):  # else one is no finite number
                partner.targets[:], partner.follows, partner.sent_ns = targets, bool(follows), sent_ns

    def follows(self, index: int, oldest_ns: int) -> bool:
        """Return whether the targets of a partner are to be followed.

        A partner that follows and has sent nothing since `oldest_ns` was suspended: its arm has come to rest by itself.
        The partner must then command its joints to stand before its targets count again.
        """
        partner = self.partners[index]
        partner.is_suspended = partner.follows and (partner.is_suspended or partner.sent_ns < oldest_ns)
        return partner.follows and not partner.is_suspended

    def tell(
        self, index: int, is_fresh: bool, state: DriveState, missing: Missing, about: bytes, positions: list[float]
    ) -> None:
        """Send measurements to a partner; without a platform there they are lost."""
        partner = self.partners[index]
        with contextlib.suppress(OSError):
            data = partner.measurements.pack(is_fresh, state, missing, about, *positions)
            self._socket.sendto(data, partner.address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SharedUnitData(PacedData):
    """The process data of an arm whose controller is connected to the platform of another arm.

    Args:
        config: the arm.
        bus: its bus.
        units: the arms of the controller.
        now: clock, ns; a simulated one in tests.

    Raises:
        BusError: its socket cannot be made.
    """

    def __init__(
        self, config: ArmConfig, bus: RapidBus, units: ControllerUnits, now: Callable[[], int] = monotonic_ns
    ) -> None:
        self._now = now
        self.expected_wkc = 1
        self.dc_time = self.missed = self.stale = 0
        self.missing = Missing.CONNECTION
        self.refusal = "the controller's program refused a point or was stopped for another of its arms"
        self._holder = units.members[0]
        self._address = str(self._holder.directory / _SOCKET)
        self._index = units.index
        self._socket = _bind(units.members[units.index])
        self._axes = axes = len(config.joints)
        self._targets, self._measurements = _targets_layout(axes), _measurements_layout(axes)
        self._period_ns = round(config.cycle.period_us * 1000)
        self._silent_ns = round(bus.answer_timeout_s * 1e9)
        self._read_ns = self._heard_ns = 0
        """Instants of the last return with a datagram, and of the last datagram, ns."""
        self._actual = [0.0] * axes
        self._outputs = [COMMANDED.pack(0.0, 0.0, 0)] * axes
        self._inputs = [MEASURED.pack(0.0, DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION)] * axes
        self._inputs.append(bytes(UNIT.size))
        self._motors_order = 0

    @property
    def problem(self) -> str:
        """Why there are no measurements; empty: there are."""
        if self.missing is not Missing.CONNECTION:
            return ""
        if self._now() - self._heard_ns <= self._silent_ns:
            return f"the platform {self._holder.name} has no connection to the controller"
        return f"no message from the platform {self._holder.name}, which holds the connection to the controller"

    def receive_until(self, deadline_ns: int) -> int:
        """Wait for measurements; return 1, or -1 where none came until `deadline_ns`, or only old ones.

        When the other platform falls silent it returns 1 once, so that the loop reads the drives' new state.
        """
        # A cycle is one step of the setpoints, also if datagrams come faster.
        if (early := self._read_ns + self._period_ns // 2 - self._now()) > 0:
            sleep(early * 1e-9)
        while (is_fresh := self._read()) is None:
            now = self._now()
            if now >= deadline_ns:
                return self._miss(now)
            select.select((self._socket,), (), (), (deadline_ns - now) * 1e-9)
        self._read_ns = self._heard_ns = self._now()
        if is_fresh:
            return 1
        self.missed += 1
        return -1

    def receive(self) -> int:
        """Do `receive_until` without waiting."""
        return self.receive_until(0)

    def _miss(self, now: int) -> int:
        self.missed += 1
        if now - self._heard_ns <= self._silent_ns or self.missing is Missing.CONNECTION:
            return -1
        self._show(DriveState.NOT_READY_TO_SWITCH_ON, Missing.CONNECTION)
        return 1

    def _read(self) -> bool | None:
        """Take the newest measurements; return whether they are fresh, None: none came."""
        is_fresh: bool | None = None
        for _ in range(_MOST_WAITING):
            try:
                data = self._socket.recv(_DATAGRAM)
            except OSError:
                break
            if len(data) != self._measurements.size:
                continue
            fresh, state, missing, about, *positions = self._measurements.unpack(data)
            is_fresh = bool(fresh)
            self._actual[:] = positions
            self._inputs[self._axes] = about
            self._show(_STATES[state], _MISSING[missing])
        return is_fresh

    def _show(self, state: DriveState, missing: Missing) -> None:
        self.missing = missing
        for i in range(self._axes):
            self._inputs[i] = MEASURED.pack(self._actual[i], state, missing)

    def send(self) -> None:
        """Send the targets to the platform that holds the connection."""
        targets, follows = [], True
        for outputs in self._outputs:
            target, _, command = COMMANDED.unpack(outputs)
            targets.append(target)
            follows = follows and command == FOLLOW
        data = self._targets.pack(self._index, follows, self._motors_order, self._now(), *targets)
        with contextlib.suppress(OSError):
            self._socket.sendto(data, self._address)

    def input(self, index: int) -> bytes:
        """Return the inputs of a node: the joints in their order, then the unit."""
        return self._inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of a joint, or of the unit."""
        if index < self._axes and len(data) == COMMANDED.size:
            self._outputs[index] = data
        elif index == self._axes and len(data) == ORDER.size:
            (self._motors_order,) = ORDER.unpack(data)

    def close(self) -> None:
        """Say that no joint follows any more, and close the socket."""
        self._outputs = [COMMANDED.pack(0.0, 0.0, 0)] * self._axes
        self.send()
        self._socket.close()
