"""Faults of slaves, of the cables between them and of their devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar

from annotated_types import Ge, Gt, Le

from rtcp.virtual.device import DeviceModel, FreezableInputs
from rtcp.virtual.distributed_clock import Clock, SyncGenerator
from rtcp.virtual.faults.fault import (
    Cable,
    DeviceFault,
    End,
    Fault,
    FaultRefused,
    Frames,
    Port,
    Position,
    SlaveFault,
    StrikingFault,
    cable_of,
    place_of,
    slave_at,
)
from rtcp.virtual.models import DiewuIoBox
from rtcp.virtual.models.diewu import BrokenTerminals
from rtcp.virtual.models.protection import ErrorCode
from rtcp.virtual.protocol import AlState
from rtcp.virtual.segment import Damage, Segment
from rtcp.virtual.slave import Slave

AlCode = Annotated[int, Ge(1), Le(0xFFFF)]
DriveError = Literal[
    "over-current", "over-voltage", "under-voltage", "over-temperature", "encoder", "over-speed", "following-error"
]
JOYSTICK = 0x3F
"""The joystick's lines: the first six inputs."""

_D = TypeVar("_D", bound=DeviceModel)


# -- cables and supply ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CableFault(Fault):
    """The cable behind slave `after` is broken: frames return there and do not reach the slaves beyond."""

    name = "cable"
    after: Cable
    port: Port = 1

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Cut the cable."""
        cable = cable_of(segment, self.after, self.port)

        def join(_: int) -> None:
            segment.topology.join(cable)
            segment.rewire()

        segment.topology.cut(cable)
        segment.rewire()
        return join


@dataclass(frozen=True)
class PowerFault(SlaveFault):
    """A slave has no supply: no frame passes it. After power-on its registers are reset, in INIT."""

    name = "power"

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Switch the supply off."""
        slave_at(segment, self.slave)

        def on(t: int) -> None:
            segment.topology.power_on(self.slave, t)
            segment.rewire()

        segment.topology.power_off(self.slave, t)
        segment.rewire()
        return on


@dataclass
class Corrupt(StrikingFault):
    """Frames are damaged on the cable behind slave `after`, on the way `out` or `back`: their checksum is wrong.

    Out: the slaves before it have processed the frame; the next one counts an error (0x0300), those beyond count a
    forwarded one (0x0308). Back: all slaves have processed it; slave `after` counts an error at port 1 (0x0302), those
    before it count a forwarded one (0x0309). In both cases the master receives nothing.
    """

    name = "corrupt"
    counted = ("corrupted",)
    after: Cable
    way: Literal["out", "back"] = "out"
    port: Port = 1

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Begin to damage frames."""
        damage = Damage(cable_of(segment, self.after, self.port), self.strikes, self.way == "back")
        return self.listed(segment.damages, damage)


# -- the state machine, mailboxes and the working counter -----------------------------------------------------------


@dataclass(frozen=True)
class AlRefuse(SlaveFault):
    """A slave refuses to go to `state`, with AL status code `code`."""

    name = "al_refuse"
    state: Literal["PRE-OP", "SAFE-OP", "OP"] = "OP"
    code: AlCode = 0x0001

    def begin(self, slave: Slave, t: int) -> End:
        """Begin to refuse."""
        refusals, refusal = slave.faults.refusals, (_state(self.state), self.code)
        refusals.append(refusal)
        return lambda _: refusals.remove(refusal)


@dataclass(frozen=True)
class AlHang(SlaveFault):
    """A slave hangs in its AL state: it neither executes nor refuses requests."""

    name = "al_hang"

    def begin(self, slave: Slave, t: int) -> End:
        """Begin to hang; requests received meanwhile are executed at the end."""

        def go_on(t: int) -> None:
            slave.faults.hangs -= 1
            slave.application.attend(t)

        slave.faults.hangs += 1
        return go_on


@dataclass(frozen=True)
class AlFall(SlaveFault):
    """A slave leaves OP by itself, once, to SAFE-OP or PRE-OP with the error flag and `code`."""

    name = "al_fall"
    once = True
    state: Literal["PRE-OP", "SAFE-OP"] = "SAFE-OP"
    code: AlCode = 0x0001

    def begin(self, slave: Slave, t: int) -> None:
        """Leave OP."""
        if slave.application.state != AlState.OP:
            state = slave.application.state.name.replace("_", "-")
            raise FaultRefused(f"slave {self.slave} is in {state}: al_fall takes a slave out of OP")
        slave.application.fall(_state(self.state), self.code)


@dataclass(frozen=True)
class SdoLate(SlaveFault):
    """A slave answers each SDO `ms` late."""

    name = "sdo_late"
    ms: Annotated[float, Gt(0), Le(60_000)]

    def begin(self, slave: Slave, t: int) -> End:
        """Begin to delay the answers."""
        delays, delay = slave.faults.sdo_delays, round(self.ms * 1e6)
        delays.append(delay)
        return lambda _: delays.remove(delay)


@dataclass(frozen=True)
class SdoAbort(SlaveFault):
    """A slave aborts each SDO service with `code`; `index` selects an object, 0: all."""

    name = "sdo_abort"
    code: Annotated[int, Ge(1), Le(0xFFFFFFFF)] = 0x08000020
    index: Annotated[int, Ge(0), Le(0xFFFF)] = 0

    def begin(self, slave: Slave, t: int) -> End:
        """Begin to abort."""
        aborts, abort = slave.faults.sdo_aborts, (self.index, self.code)
        aborts.append(abort)
        return lambda _: aborts.remove(abort)


@dataclass
class WorkingCounter(StrikingFault):
    """A slave processes process data but does not increment the working counter."""

    name = "wkc"
    counted = ("not_counted",)
    slave: Position

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Begin to omit the slave."""
        return self.listed(segment.miscounts, (slave_at(segment, self.slave), self.strikes))


def _state(name: str) -> AlState:
    return AlState[name.replace("-", "_")]


# -- clocks ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ClockFault(SlaveFault):
    """Base of the faults of a distributed clock."""

    def begin(self, slave: Slave, t: int) -> End | None:
        """Begin in a slave with a clock."""
        if slave.clock is None:
            raise FaultRefused(f"slave {self.slave} ({slave.device.identity.name}) has no distributed clock")
        return self.disturb(slave, slave.clock, t)

    def disturb(self, slave: Slave, clock: Clock, t: int) -> End | None:
        """Begin in the clock of `slave`, as `start`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Sync0Lost(ClockFault):
    """A slave's SYNC0 stops."""

    name = "sync0"

    def disturb(self, slave: Slave, clock: Clock, t: int) -> End:
        """Stop the pulses."""

        def resume(t: int) -> None:
            slave.faults.sync0_losses -= 1
            if not slave.faults.sync0_losses and (sync0 := _sync0(slave)) is not None:
                sync0.resume(t)

        slave.faults.sync0_losses += 1
        if (sync0 := _sync0(slave)) is not None:
            sync0.suspend()
        return resume


@dataclass(frozen=True)
class ClockJump(ClockFault):
    """A slave's clock jumps by `us`, once."""

    name = "clock_jump"
    once = True
    us: Annotated[float, Ge(-1_000_000), Le(1_000_000)]

    def disturb(self, slave: Slave, clock: Clock, t: int) -> None:
        """Jump."""
        clock.jump(round(self.us * 1000))
        if (sync0 := _sync0(slave)) is not None and sync0.due is not None:
            sync0.schedule(t)


@dataclass(frozen=True)
class ClockDrift(ClockFault):
    """The drift of a slave's own clock increases by `ppm`."""

    name = "clock_drift"
    ppm: Annotated[float, Ge(-1000), Le(1000)] = 200.0

    def disturb(self, slave: Slave, clock: Clock, t: int) -> End:
        """Begin to drift."""

        def change(ppm: float, t: int) -> None:
            slave.faults.drift_ppm += ppm
            # The present clock: a power cycle may have replaced it.
            if slave.clock is not None:
                slave.clock.change_drift(ppm, t)

        change(self.ppm, t)
        return lambda t: change(-self.ppm, t)


def _sync0(slave: Slave) -> SyncGenerator | None:
    return None if slave.esc.dc is None else slave.esc.dc.sync0


# -- devices --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DriveErrorFault(DeviceFault):
    """A drive has an error, sends its emergency message and executes its fault reaction.

    While the fault lasts a fault reset is refused; without `lasts` it is a single event, which a reset clears.
    """

    name = "drive"
    once_unless_it_lasts = True
    slave: Position
    error: DriveError
    axis: Annotated[int, Ge(1), Le(8)] = 1

    def begin(self, devices: Sequence[DeviceModel]) -> End:
        """Trigger the error."""
        device = devices[place_of(devices, self.slave)]
        if not device.servos:
            raise FaultRefused(f"slave {self.slave} ({device.identity.name}) is no drive")
        if self.axis > len(device.servos):
            raise FaultRefused(f"axis: found {self.axis}, but slave {self.slave} has {len(device.servos)}")
        drive = device.servos[self.axis - 1]
        code = ErrorCode[self.error.upper().replace("-", "_")]
        drive.begin_fault(code)
        return lambda _: drive.end_fault(code)


@dataclass(frozen=True)
class InputsFrozen(DeviceFault):
    """Inputs and counters of a box or meter freeze, as if its processor hung; it still answers frames."""

    name = "input_frozen"
    slave: Position

    def begin(self, devices: Sequence[DeviceModel]) -> End:
        """Freeze the inputs."""
        box = devices[place_of(devices, self.slave)]
        if not isinstance(box, FreezableInputs):
            raise FaultRefused(f"slave {self.slave} ({box.identity.name}) is no IO box")

        def thaw(_: int) -> None:
            box.freezes -= 1

        box.freezes += 1
        return thaw


def _device_at(devices: Sequence[DeviceModel], number: int, kind: type[_D], words: str) -> _D:
    device = devices[place_of(devices, number)]
    if not isinstance(device, kind):
        raise FaultRefused(f"slave {number} ({device.identity.name}) is no {words}")
    return device


Newton = Annotated[float, Ge(-500), Le(500)]


@dataclass(frozen=True)
class Push(Fault):
    """A force (N) and a torque (Nm) act at the tool, in the axes of the base."""

    name = "push"
    x: Newton = 0.0
    y: Newton = 0.0
    z: Newton = 0.0
    rx: Newton = 0.0
    ry: Newton = 0.0
    rz: Newton = 0.0

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Begin to push."""
        if segment.arm is None:
            raise FaultRefused("no arm to push: the segment's file names none with geometry, or has no six drives")
        return segment.arm.push((self.x, self.y, self.z, self.rx, self.ry, self.rz))


class TerminalsFault(DeviceFault):
    """Base of the faults of the first IO box's input terminals."""

    def begin(self, devices: Sequence[DeviceModel]) -> End:
        """Break the terminals."""
        box = next((device for device in devices if isinstance(device, DiewuIoBox)), None)
        if box is None:
            raise FaultRefused(f"there is no IO box on the segment: {self.name} is a fault of its inputs")
        broken = self.broken(box.inputs)
        box.broken.append(broken)
        return lambda _: box.broken.remove(broken)

    def broken(self, inputs: int) -> BrokenTerminals:
        """Return the broken terminals; `inputs`: present levels."""
        raise NotImplementedError


@dataclass(frozen=True)
class TerminalFault(TerminalsFault):
    """An input terminal of the IO box is stuck `high` or `low`, or bounces with a half period of `ms`."""

    name = "input"
    number: Annotated[int, Ge(1), Le(16)]
    how: Literal["high", "low", "bounce"]
    ms: Annotated[float, Gt(0), Le(1000)] = 2.0

    def broken(self, inputs: int) -> BrokenTerminals:
        """Return the terminal; a bouncing one starts at the opposite level."""
        mask = 1 << self.number - 1
        if self.how == "bounce":
            return BrokenTerminals(mask, ~inputs, self.ms * 1e-3)
        return BrokenTerminals(mask, mask if self.how == "high" else 0)


@dataclass(frozen=True)
class JoystickCode(TerminalsFault):
    """The joystick's six inputs are stuck at `value`; 63 is neutral, most values are invalid."""

    name = "joystick_code"
    value: Annotated[int, Ge(0), Le(63)]

    def broken(self, inputs: int) -> BrokenTerminals:
        """Return the joystick's terminals."""
        return BrokenTerminals(JOYSTICK, self.value)
