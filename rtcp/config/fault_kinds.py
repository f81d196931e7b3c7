"""The kinds of faults of the virtual segment: one dataclass each, with what is allowed for its keys.

Positions count from 1, as on the cable; 0 is the master. A package outside adds a kind by a subclass of `PluginFault`
and an entry point of the group `rtcp.faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le

Position = Annotated[int, Ge(1), Le(255)]
Cable = Annotated[int, Ge(0), Le(254)]
"""The cable behind this slave; 0: between the master and slave 1."""
Rate = Annotated[float, Gt(0), Le(1)]
Burst = Annotated[int, Ge(1), Le(100_000)]
Seed = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
AlStateName = Literal["PRE-OP", "SAFE-OP", "OP"]
DriveError = Literal[
    "over-current", "over-voltage", "under-voltage", "over-temperature", "encoder", "over-speed", "following-error"
]
Protocol = Literal["arp", "ip", "lldp", "ethercat", "any"]
InputFault = Literal["high", "low", "bounce"]
Way = Literal["out", "back"]


@dataclass(frozen=True)
class CableFault:
    """The cable behind slave `after` is broken: frames turn round there, the slaves behind hear nothing."""

    name: ClassVar[str] = "cable"
    after: Cable


@dataclass(frozen=True)
class PowerFault:
    """A slave has no supply: no frame passes it. When it comes back its registers are those of power-on, in INIT."""

    name: ClassVar[str] = "power"
    slave: Position


@dataclass(frozen=True)
class AlRefuse:
    """A slave refuses to go to `state`, with AL status code `code`."""

    name: ClassVar[str] = "al_refuse"
    slave: Position
    state: AlStateName = "OP"
    code: Annotated[int, Ge(1), Le(0xFFFF)] = 0x0001


@dataclass(frozen=True)
class AlHang:
    """A slave hangs in its AL state: what is asked of it is neither done nor refused."""

    name: ClassVar[str] = "al_hang"
    slave: Position


@dataclass(frozen=True)
class AlFall:
    """A slave leaves OP by itself, once, to SAFE-OP or PRE-OP with the error flag and `code`."""

    name: ClassVar[str] = "al_fall"
    slave: Position
    state: Literal["PRE-OP", "SAFE-OP"] = "SAFE-OP"
    code: Annotated[int, Ge(1), Le(0xFFFF)] = 0x0001


@dataclass(frozen=True)
class SdoLate:
    """A slave answers each SDO `ms` later than it would."""

    name: ClassVar[str] = "sdo_late"
    slave: Position
    ms: Annotated[float, Gt(0), Le(60_000)]


@dataclass(frozen=True)
class SdoAbort:
    """A slave aborts each SDO service (of object `index` only, unless that is 0) with `code`."""

    name: ClassVar[str] = "sdo_abort"
    slave: Position
    code: Annotated[int, Ge(1), Le(0xFFFFFFFF)] = 0x08000020
    index: Annotated[int, Ge(0), Le(0xFFFF)] = 0


@dataclass(frozen=True)
class Loss:
    """Frames are lost: each with the probability `rate`, or the next `burst` of them and no more."""

    name: ClassVar[str] = "loss"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Delay:
    """Answers come `ms` late."""

    name: ClassVar[str] = "delay"
    ms: Annotated[float, Gt(0), Le(1000)]
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Duplicate:
    """Answers come twice."""

    name: ClassVar[str] = "duplicate"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Reorder:
    """An answer comes after the one that follows it."""

    name: ClassVar[str] = "reorder"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Corrupt:
    """Frames are damaged on the cable behind slave `after`, on their way `out` or `back`: their checksum is wrong.

    Out: the slaves before it have worked; the next one counts an error (0x0300), those behind it count a forwarded one
    (0x0308). Back: all slaves have worked; slave `after` counts an error at port 1 (0x0302), those before it count a
    forwarded one (0x0309). Either way the master gets nothing.
    """

    name: ClassVar[str] = "corrupt"
    after: Cable
    way: Way = "out"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Garble:
    """`bits` bits of answers are turned over behind the last checksum: what no Ethernet card would notice."""

    name: ClassVar[str] = "garble"
    bits: Annotated[int, Ge(1), Le(1000)] = 1
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class WorkingCounter:
    """A slave takes part in process data but does not count itself in the working counter."""

    name: ClassVar[str] = "wkc"
    slave: Position
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class DriveFault:
    """A drive meets an error, sends its emergency message and reacts as its fault reaction says.

    While the fault lasts a fault reset is refused; `lasts` left out: a single occurrence, which a reset clears.
    """

    name: ClassVar[str] = "drive"
    slave: Position
    error: DriveError


@dataclass(frozen=True)
class Sync0Lost:
    """A slave's SYNC0 stops."""

    name: ClassVar[str] = "sync0"
    slave: Position


@dataclass(frozen=True)
class ClockJump:
    """A slave's clock jumps by `us`, once."""

    name: ClassVar[str] = "clock_jump"
    slave: Position
    us: Annotated[float, Ge(-1_000_000), Le(1_000_000)]


@dataclass(frozen=True)
class ClockDrift:
    """A slave's own clock runs fast by `ppm` more than it did."""

    name: ClassVar[str] = "clock_drift"
    slave: Position
    ppm: Annotated[float, Ge(-1000), Le(1000)] = 200.0


@dataclass(frozen=True)
class TerminalFault:
    """An input terminal of the IO box is stuck `high` or `low`, or bounces with a half period of `ms`."""

    name: ClassVar[str] = "input"
    number: Annotated[int, Ge(1), Le(16)]
    how: InputFault
    ms: Annotated[float, Gt(0), Le(1000)] = 2.0


@dataclass(frozen=True)
class InputsFrozen:
    """Inputs and counter of an IO box keep their value, as if its processor hung; frames are answered as ever."""

    name: ClassVar[str] = "input_frozen"
    slave: Position


@dataclass(frozen=True)
class StickCode:
    """The joystick's six inputs show `value`, whatever the stick does; 63 is neutral, most values mean nothing."""

    name: ClassVar[str] = "stick_code"
    value: Annotated[int, Ge(0), Le(63)]


@dataclass(frozen=True)
class Noise:
    """Frames of other protocols, and malformed ones of EtherCAT's type, `rate_hz` of them a second."""

    name: ClassVar[str] = "noise"
    rate_hz: Annotated[float, Gt(0), Le(10_000)] = 100.0
    protocol: Protocol = "any"
    seed: Seed = 0


@dataclass(frozen=True)
class PluginFault:
    """Base of the kinds of faults of packages outside: a frozen dataclass, whose fields are the keys of the fault.

    The first line of its docstring is what `rtcp segment kinds` shows. A key `slave` of type `Position` is checked
    against the segment's slaves.
    """

    name: ClassVar[str]

    def begin(self, devices: Sequence[Any]) -> Callable[[int], None]:
        """Let the fault begin; return what ends it, called with the instant, ns.

        Args:
            devices: the device models (`rtcp.virtual.device.DeviceModel`) in the order of the cable.

        Raises:
            FaultRefused: (`rtcp.virtual.faults.devices`) the segment cannot have this fault.
        """
        raise NotImplementedError


Fault = (
    CableFault | PowerFault | AlRefuse | AlHang | AlFall | SdoLate | SdoAbort | Loss | Delay | Duplicate | Reorder
    | Corrupt | Garble | WorkingCounter | DriveFault | Sync0Lost | ClockJump | ClockDrift | TerminalFault
    | InputsFrozen | StickCode | Noise | PluginFault
)  # fmt: skip
_KINDS: tuple[type[Fault], ...] = (
    CableFault, PowerFault, AlRefuse, AlHang, AlFall, SdoLate, SdoAbort, Loss, Delay, Duplicate, Reorder, Corrupt,
    Garble, WorkingCounter, DriveFault, Sync0Lost, ClockJump, ClockDrift, TerminalFault, InputsFrozen, StickCode,
    Noise,
)  # fmt: skip
FAULTS = MappingProxyType({kind.name: kind for kind in _KINDS})
"""Every kind of fault of this package by the name that commands and scripts give it."""
ONCE = (AlFall, ClockJump)
"""Faults that happen and are over: they do not last and cannot be cleared."""
ENTRY_POINTS = "rtcp.faults"


@cache
def installed() -> Mapping[str, type[Fault]]:
    """Return every kind of fault by its name: those of this package, then those of packages outside.

    Raises:
        RuntimeError: an entry point is not a dataclass that extends `PluginFault`, or its name is taken.
    """
    found: dict[str, type[Fault]] = dict(FAULTS)
    for entry in sorted(entry_points(group=ENTRY_POINTS)):
        loaded = entry.load()
        if not (
            isinstance(loaded, type) and issubclass(loaded, PluginFault) and "__dataclass_fields__" in vars(loaded)
        ):
            raise RuntimeError(
                f"entry point {entry.name} = {entry.value} of {ENTRY_POINTS} is no dataclass that extends PluginFault"
            )
        if found.setdefault(loaded.name, loaded) is not loaded:
            raise RuntimeError(
                f"entry point {entry.name} = {entry.value} of {ENTRY_POINTS}: there is another fault {loaded.name}; "
                "change its `name`"
            )
    return MappingProxyType(found)
