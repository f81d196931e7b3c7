"""The model of every configuration file: frozen dataclasses with their ranges, SI units throughout.

This module imports nothing heavy: the loop's process holds these objects and no validator. `rtcp.config.validation`
checks the ranges, `rtcp.config.rules` relations between values. The tables in docs/configuration.md are made of the
attribute docstrings here.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Protocol, get_args, get_type_hints

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

from kinematics.model import ArmModel
from rtcp.config.findings import Finding
from rtcp.config.numbers import (
    U8,
    U16,
    U32,
    Angle,
    Factor,
    Fraction,
    FractionOfPi,
    Length,
    Milliseconds,
    Name,
    NotNegative,
    Positive,
    Rate,
    Speed,
    Terminal,
    Turn,
    Vector,
)
from rtcp.config.scaling import OBJECTS_PER_AXIS, DriveScaling


class HasBox(Protocol):
    """A part of the configuration that is connected to an IO box."""

    @property
    def box(self) -> str | None:
        """Name of the box; None: the only one."""


CHANNEL_KINDS = frozenset({"analog", "encoder", "coupler", "generic"})
"""Kinds of device that have channels without a function."""
PLATFORM_PARTS = frozenset({"cycle", "arm", "gripper", "operator", "tool"})
"""Parts of the cycle that are no devices: their fields have names of their own."""
VIRTUAL = "virtual"
"""Name of the bus that is a segment in software."""
JOINTS = 6
"""Joints of an arm that has `kinematics`."""
MOST_AXES = 10
"""Most joints, a gripper's among them, that commands, plans and recordings can hold."""
ENDLESS = 1e9
"""End of the range of an external axis without ends, m or rad."""
_PROFILE_JERK: Final = 1000.0
"""Jerk of an external axis for each unit of its acceleration, 1/s: the profiles of drives are trapezoidal."""
UNLIMITED_TORQUE = 1e9
"""Limit of joints whose torque is not measured, Nm."""
MOST_TOOLS = 16
"""Most tools of an arm."""
MOST_CONES = 8
"""Most cones that limit the orientation of the tool."""
MOST_POINTS = 4096
"""Most points or poses of a motion file."""

IntegerTypeName = Literal["int8", "uint8", "int16", "uint16", "int24", "uint24", "int32", "uint32",
                          "int40", "uint40", "int48", "uint48", "int56", "uint56", "int64", "uint64"]  # fmt: skip
NumberTypeName = Literal["bool", IntegerTypeName, "float32", "float64"]
DataTypeName = Literal[NumberTypeName, "bits", "bytes"]
BITS: dict[str, int] = {
    "bool": 1, "int8": 8, "uint8": 8, "int16": 16, "uint16": 16, "int24": 24, "uint24": 24, "int32": 32, "uint32": 32,
    "int40": 40, "uint40": 40, "int48": 48, "uint48": 48, "int56": 56, "uint56": 56, "int64": 64, "uint64": 64,
    "float32": 32, "float64": 64,
}  # fmt: skip
"""Lengths of the types in bits; the entry sets that of `bits` and `bytes`."""
LARGEST = {"float32": (2.0 - 2.0**-23) * 2.0**127, "float64": sys.float_info.max}
"""Largest finite values of the types that are no integers."""
AxisNumber = Annotated[int, Ge(1), Le(8)]
"""Axis of a drive, from 1: its objects are 0x800 above those of the axis before (CiA 402)."""
DriveModeName = Literal["csp", "csv", "cst"]
MODE_CHANNELS: dict[DriveModeName, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "csp": ((), ()),
    "csv": (("target_velocity", "modes_of_operation"), ("velocity", "modes_of_operation_display")),
    "cst": (("target_torque", "modes_of_operation"), ("velocity", "torque", "modes_of_operation_display")),
}
"""Channels of rpdo and of tpdo that a drive mode needs beside those of every CiA 402 drive."""
DRIVEN_OUTPUTS = ("controlword", "target_position", "target_velocity", "target_torque", "modes_of_operation")
"""Channels of rpdo that the driver of a CiA 402 drive commands; an axis may have more (`AxisNeeds.driven`)."""
ControlModeName = Literal["joint", "cartesian", "joystick", "velocity", "torque"]
FrameName = Literal["base", "tool"]
Level = Literal["high", "low"]
RecordingFormat = Literal["mcap", "csv"]
HardStop = Literal["quick_stop", "torque_off"]
"""Reactions when setpoints cannot be executed or trusted: the drives stop by themselves."""
AnyStop = Literal["controlled_stop", "quick_stop", "torque_off"]


class ConfigError(Exception):
    """A configuration that cannot be used: `findings` holds every mistake, `problems` one sentence for each."""

    def __init__(self, mistakes: Iterable[Finding | str], code: str = "other") -> None:
        """Take findings, or sentences, which get this code."""
        self.findings = [Finding((), code, text=error) if isinstance(error, str) else error for error in mistakes]
        self.problems = [str(finding) for finding in self.findings]
        super().__init__("\n".join(self.problems))


class PluginError(ConfigError):
    """A class that an installed package registered cannot be used."""

    def __init__(self, entry: EntryPoint, problem: str) -> None:
        super().__init__([f"entry point {entry.name} = {entry.value} of {entry.group} {problem}"], "plugin")


# -- devices: config/devices/*.yaml ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PdoEntry:
    """One mapped object: `value in SI = counts * factor + offset`. Index 0 is padding and needs no name."""

    index: U16
    """Object index; 0: padding."""
    sub_index: U8
    """Object subindex."""
    type: DataTypeName
    """Data type on the wire; `bits`: unsigned, 1 to 64 bits, as BIT2; `bytes`: an array, which no record holds."""
    name: Name = "padding"
    """Channel name; the kind of device determines which names are needed."""
    factor: float = 1.0
    """SI units per count; not 0."""
    unit: str = ""
    """Unit of the value, for people and recordings; at most 32 characters, no comma, colon or line break."""
    bits: Annotated[int, Ge(1), Le(255)] | None = None
    """Length in bits of the types `bits` and `bytes`; of padding of type `bits` up to 255."""
    offset: float = 0.0
    """SI value at 0 counts: value = counts * factor + offset. Not of drives and IO boxes."""
    modulo: Annotated[int, Ge(0)] = 0
    """Of an input: counts after which it begins anew at 0, as an encoder of one turn; its value counts on. 0: never."""
    min: float | None = None
    """Of an output: smallest value that is sent, in the channel's unit; left out: that of `type`."""
    max: float | None = None
    """Of an output: largest value that is sent, in the channel's unit; left out: that of `type`."""
    safe: float | None = None
    """Of an output: value until it is commanded, and after a fault, in the channel's unit. Left out: 0, of a drive
    [its own](drive_settings.md)."""
    axis: AxisNumber | None = None
    """Axis of a drive with several, where one PDO holds channels of more than one; left out: that of the PDO."""

    @property
    def is_number(self) -> bool:
        """Whether it is a channel with a value: no padding, and no array."""
        return self.index != 0 and self.type != "bytes"

    @cached_property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value that is sent, SI: by `min` and `max`, and by the type."""
        ends = sorted(end * self.factor + self.offset for end in type_range(self.type, self.length))
        low, high = max(ends[0], -LARGEST["float64"]), min(ends[1], LARGEST["float64"])
        return (
            low if self.min is None else max(low, self.min),
            high if self.max is None else min(high, self.max),
        )

    @cached_property
    def counts_range(self) -> tuple[float, float]:
        """`range` in counts; that of the type alone where the factor is 0."""
        least, most = type_range(self.type, self.length)
        if not self.factor:
            return least, most
        low, high = sorted((end - self.offset) / self.factor for end in self.range)
        return max(low, least), min(high, most)

    @property
    def length(self) -> int:
        """Length in bits."""
        return BITS.get(self.type) or self.bits or 0


@dataclass(frozen=True)
class Pdo:
    """A process data object and the entries mapped into it, in order."""

    index: Annotated[int, Ge(1), Le(0xFFFF)]
    """PDO mapping object; most lie in 0x1600 to 0x17ff from the master, in 0x1a00 to 0x1bff to it (ETG.1000.6)."""
    channels: Annotated[tuple[PdoEntry, ...], MinLen(1)]
    sync_manager: Annotated[int, Ge(0), Le(7)] | None = None
    """Sync manager, assigned through 0x1C10 + its number; none: the device's only one of that direction."""
    fixed: bool = False
    """True: its entries are fixed in the device; only its assignment is written."""
    start_address: U16 = 0
    """First register that it carries, if its sync manager is a virtual one; 0: it is a real one."""
    axis: AxisNumber = 1
    """Axis of a drive with several that the channels belong to."""
    samples: Annotated[int, Ge(1), Le(255)] = 1
    """Times that it is assigned, for as many values a cycle: a channel is their mean. Above 1: kinds analog, generic.
    """
    sample_increment: U16 = 0
    """Above 0: each value has its own PDO (index + 1) and objects (index + this)."""

    @property
    def assigned(self) -> tuple[Pdo, ...]:
        """The PDOs that are assigned for its values, one for each."""
        step = self.sample_increment
        return tuple(
            replace(
                self,
                index=self.index + n,
                channels=tuple(replace(e, index=e.index + n * step) if e.index else e for e in self.channels),
            )
            if step and n
            else self
            for n in range(self.samples)
        )

    def axis_of(self, entry: PdoEntry) -> int:
        """Return the axis that a channel belongs to."""
        return self.axis if entry.axis is None else entry.axis


@dataclass(frozen=True)
class StartupSdo:
    """An SDO written in PRE-OP and read back."""

    index: U16
    """Object index."""
    sub_index: U8
    """Object subindex."""
    type: Literal[NumberTypeName, "bytes"]
    """Data type of the object; `bytes`: a text, an array, or several entries at once."""
    value: float | None = None
    """Value to write, in the range of `type`; not of the type `bytes`."""
    name: str = ""
    """Text for messages."""
    optional: bool = False
    """True: the device may lack the object."""
    data: str = ""
    """Bytes to write, of the type `bytes`, in hexadecimal, as "54 41 4E 4B"."""
    complete: bool = False
    """True: written by SDO complete access: `data` are all entries from `sub_index` 0 or 1 on, read-only ones too."""

    @property
    def length(self) -> int:
        """Length in bytes."""
        return len(bytes.fromhex(self.data)) if self.type == "bytes" else max(BITS[self.type] // 8, 1)

    @property
    def integer_data(self) -> bytes:
        """`value` of an integer type as it is written (ETG.1000.6, 5.6.5: little endian)."""
        return int(self.value or 0).to_bytes(self.length, "little", signed=self.type.startswith("int"))


LimitName = Literal["position_min", "position_max", "velocity", "torque"]


@dataclass(frozen=True)
class LimitObject:
    """An object of a drive that limits its joint by itself. At the start it gets the joint's limit and is read back."""

    index: U16
    """Object index."""
    sub_index: U8
    """Object subindex."""
    type: IntegerTypeName
    """Data type of the object."""
    limit: LimitName
    """Limit that it holds: ends of the position, speed, or torque; see [limits](drive_settings.md)."""
    factor: float | None = None
    """SI units per count; left out: that of the drive's position, velocity or torque channel. Not 0."""
    axis: AxisNumber = 1
    """Axis of a drive with several."""


@dataclass(frozen=True)
class DeviceDescription:
    """A kind of slave, from `config/devices/<key>.yaml`."""

    name: Name
    """Device name, for messages."""
    kind: Name
    """Driver: `cia402` moves joints, `io` is a box of inputs and outputs, `analog`, `encoder` and `generic` have named
    channels, `coupler` has none; further ones from installed packages."""
    vendor_id: U32
    """Vendor id (0x1018:01); another one on the bus is refused."""
    product_id: U32
    """Product code (0x1018:02); another one on the bus is refused."""
    rpdo: tuple[Pdo, ...] = ()
    """Outputs of the master, by sync manager; without `sync_manager` assigned through 0x1C12."""
    tpdo: tuple[Pdo, ...] = ()
    """Inputs of the master, by sync manager; without `sync_manager` assigned through 0x1C13."""
    configurable_pdos: bool = True
    """False: the mapping is fixed in the device; it is compared and never written."""
    coe: bool = True
    """False: the device has no CoE or no mailbox; its lengths are compared with its EEPROM, its mapping is fixed."""
    complete_access: bool = True
    """False: the device answers SDO complete access of its PDO assignment wrongly although its EEPROM offers it."""
    sdo: tuple[StartupSdo, ...] = ()
    assign_activate: U16 = 0
    """DC AssignActivate word of the ESI: 0x0300 for SYNC0, 0x0700 for SYNC0 and SYNC1, 0 for no distributed clock."""
    sync0_shift_us: float = 0.0
    """SYNC0 shift, us; less than one cycle in either direction."""
    sync0_factor: Factor = 1
    """Cycle of SYNC0: above 0 a multiple of `cycle.period_us`, below 0 its part (-10: a tenth); 0: `sync0_cycle_us`."""
    sync0_cycle_us: NotNegative = 0.0
    """Cycle of SYNC0 where `sync0_factor` is 0, us."""
    sync1_factor: Factor = 0
    """Cycle of SYNC1: above 0 a multiple of SYNC0's, below 0 of `cycle.period_us`; 0: `sync1_cycle_us`."""
    sync1_cycle_us: NotNegative = 0.0
    """Cycle of SYNC1 where `sync1_factor` is 0, us; 0: that of SYNC0."""
    sync1_shift_us: NotNegative = 0.0
    """Time from SYNC0 to SYNC1, us."""
    watchdog_ms: Annotated[float, Gt(0), Le(6000)] = 100.0
    """Process-data (sync manager) watchdog, ms: without outputs for this time the device stops."""
    scaling: tuple[DriveScaling, ...] = ()
    """Of a CiA 402 drive: one for all its axes, or one an axis. Channels without `factor` have theirs from here."""
    limits: tuple[LimitObject, ...] = ()
    """Of a CiA 402 drive: the objects with which it limits its joints."""

    @property
    def has_channels(self) -> bool:
        """Whether commands see its channels by name, and set those of `rpdo`."""
        return self.kind in CHANNEL_KINDS

    @property
    def outputs(self) -> tuple[PdoEntry, ...]:
        """The channels of `rpdo` that are numbers."""
        return tuple(entry for pdo in self.rpdo for entry in pdo.channels if entry.is_number)

    @property
    def inputs(self) -> tuple[PdoEntry, ...]:
        """The channels of `tpdo` that are numbers."""
        return tuple(entry for pdo in self.tpdo for entry in pdo.channels if entry.is_number)

    @property
    def is_box(self) -> bool:
        """Whether inputs and outputs with a function may be on it: it maps channels of these names."""
        if self.kind in ("io", "cia402") or self.has_channels:
            return self.kind == "io"
        mapped = [{entry.name for pdo in pdos for entry in pdo.channels} for pdos in (self.rpdo, self.tpdo)]
        return "outputs" in mapped[0] and "inputs" in mapped[1]

    @property
    def axes(self) -> tuple[int, ...]:
        """The axes that its channels belong to."""
        axes = {pdo.axis_of(entry) for pdo in (*self.rpdo, *self.tpdo) for entry in pdo.channels if entry.index}
        return tuple(sorted(axes)) or (1,)

    def of_axis(self, axis: int) -> DeviceDescription:
        """Return the description with the channels of the other axes as padding."""
        if self.axes == (axis,):
            return self
        return replace(self, rpdo=_of_axis(self.rpdo, axis), tpdo=_of_axis(self.tpdo, axis))

    def scaling_of(self, axis: int) -> DriveScaling | None:
        """Return the scaling of an axis; None: its channels have factors alone."""
        if len(self.scaling) == 1:
            return self.scaling[0]
        return self.scaling[axis - 1] if axis <= len(self.scaling) else None

    def startup(self, index: int, axis: int = 1) -> float | None:
        """Return the start-up SDO's value of an object (subindex 0) of an axis; `index`: that of the first axis."""
        index += (axis - 1) * OBJECTS_PER_AXIS
        return next((sdo.value for sdo in reversed(self.sdo) if (sdo.index, sdo.sub_index) == (index, 0)), None)

    def channel(self, name: str) -> PdoEntry | None:
        """Return the channel of a name, the outputs first; None: it does not exist."""
        entries = (entry for pdo in (*self.rpdo, *self.tpdo) for entry in pdo.channels)
        return next((entry for entry in entries if entry.name == name), None)

    def wire_range(self, name: str) -> tuple[float, float]:
        """Return the range of a channel, SI; infinite if it does not exist."""
        entry = self.channel(name)
        return (-math.inf, math.inf) if entry is None else entry.range


def _of_axis(pdos: Sequence[Pdo], axis: int) -> tuple[Pdo, ...]:
    return tuple(
        replace(
            pdo,
            channels=tuple(
                entry if pdo.axis_of(entry) == axis else replace(entry, index=0, sub_index=0, name=PdoEntry.name)
                for entry in pdo.channels
            ),
        )
        for pdo in pdos
    )


def type_range(kind: str, bits: int = 0) -> tuple[float, float]:
    """Return the smallest and the largest finite number of a type; `bits`: length where the type has none."""
    largest = LARGEST.get(kind)
    return integer_range(kind, bits) if largest is None else (-largest, largest)


def integer_range(kind: str, bits: int = 0) -> tuple[int, int]:
    """Return the smallest and the largest number of an integer type; `bits`: length where the type has none."""
    bits = BITS.get(kind, bits)
    return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind.startswith("int") else (0, 2**bits - 1)


# -- the arm: config/assistive_arm.yaml --------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlaveEntry:
    """A slave as the arm's file lists it."""

    name: Name
    """Slave name; unique."""
    device: Name
    """Device file: `devices/NAME.yaml` beside the arm's file, or a path that ends in .yaml."""
    alias: U16 = 0
    """Station alias, which identifies the slave at any place; 0: identified by its place among slaves without."""


@dataclass(frozen=True)
class AxisNeeds:
    """What an axis needs of the settings that its drive holds itself, in its `unit` and Nm."""

    joint: Name
    axis: AxisNumber
    """Axis of the drive."""
    position: tuple[float, float]
    """Lowest and highest position that the drive shows within the joint's range."""
    velocity: float
    """Speed limit of the joint, `unit`/s."""
    following_error: float
    """Following error at which the supervision stops the arm; infinite: it is not supervised."""
    holding_torque: float
    """Torque that carries the arm itself in the worst pose of its range, Nm; 0: unknown."""
    supervised_torque: float
    """Measured torque at which the supervision stops the arm, Nm; infinite: the torque is not measured."""
    deceleration: float
    """Least deceleration of a quick stop, `unit`/s²: it ends within the time that the platform waits for it."""
    quick_stops: tuple[str, ...] = ()
    """Keys of `stops` whose reaction is a quick stop."""
    driven: tuple[str, ...] = ()
    """Output channels that are driven beside `DRIVEN_OUTPUTS`: the offsets of feed-forward, or 0x6081 of an external
    axis."""
    halt_deceleration: float = 0.0
    """Deceleration from which the platform computes where an external axis must be halted, `unit`/s²; 0: a joint."""
    unit: Literal["m", "rad"] = "rad"
    """Unit of its positions."""


@dataclass(frozen=True)
class SlaveConfig:
    """A slave of the segment, in the order of the cable: position is its index + 1."""

    name: Name
    device: DeviceDescription
    file: str = ""
    """Path of the device's file; empty: made by a program."""
    alias: int = 0
    """Station alias; 0: the slave is identified by its place."""
    limits: tuple[StartupSdo, ...] = ()
    """Limits of its joints, written after the start-up SDOs (`rtcp.config.drive_limits.with_limits`)."""
    needs: tuple[AxisNeeds, ...] = ()
    """What its joints need of it (`rtcp.config.drive_limits.with_limits`)."""

    def needs_of(self, axis: int) -> AxisNeeds | None:
        """Return what the joint that an axis of the drive moves needs of it; None: it moves none."""
        return next((needs for needs in self.needs if needs.axis == axis), None)

    def unit_of(self, axis: int) -> str:
        """Return the unit of the positions of an axis of the drive; it needs `needs`."""
        needs = self.needs_of(axis)
        return "rad" if needs is None else needs.unit


@dataclass(frozen=True)
class Range:
    """A closed interval; `min < max`."""

    min: float
    """Lower position limit, rad."""
    max: float
    """Upper position limit, rad; greater than `min`."""


@dataclass(frozen=True)
class AbsoluteLimits:
    """How far `rtcp limits set --widen` may go beyond the limits of a joint; what is left out is not widened."""

    position: Range | None = None
    """Widest range, rad; it holds the `position` of the joint."""
    velocity: Rate | None = None
    """Highest speed limit, rad/s."""
    torque: Positive | None = None
    """Highest torque limit, Nm."""


@dataclass(frozen=True)
class Joint:
    """A joint, the drive that moves it and its limits. No target beyond them reaches the drive."""

    name: Name
    """Joint name; unique, and not `joints`."""
    slave: Name
    """Drive that moves the joint: a name under `slaves` of kind `cia402`; unique, or with another `axis`."""
    position: Range
    velocity: Rate
    """Speed limit, rad/s; in CSP also the drive's own limit."""
    acceleration: Rate
    """Acceleration limit, rad/s²; also determines stopping distances."""
    jerk: Rate
    """Jerk limit, rad/s³."""
    torque: Positive
    """Torque limit, Nm."""
    csv_gain: NotNegative = 10.0
    """Position gain in CSV, 1/s."""
    cst_stiffness: NotNegative = 600.0
    """Joint stiffness in CST, Nm/rad."""
    cst_damping: NotNegative = 60.0
    """Joint damping in CST, Nm s/rad; follows the inertia at the drive."""
    cst_integral: NotNegative = 1200.0
    """Integral gain in CST, Nm/(rad s)."""
    axis: AxisNumber = 1
    """Axis of `slave`, where its drive has several."""
    drive_torque: Positive | None = None
    """Largest torque that the drive gives, Nm, written to it at the start (0x6072); left out: that of the drive.

    A larger `supervision.torque` threshold is refused, because it could never be exceeded."""
    inertia: NotNegative = 0.0
    """Inertia that the drive turns, seen from the joint, kg m², for `feed_forward.acceleration`."""
    absolute: AbsoluteLimits = field(default_factory=AbsoluteLimits)

    @property
    def place(self) -> str:
        """The drive that moves it, in words: slave, and axis if it is not the first."""
        return self.slave if self.axis == 1 else f"{self.slave}, axis {self.axis}"


@dataclass(frozen=True)
class Travel(Range):
    """The range of an external axis; `min < max`."""

    min: float
    """Lower end, m or rad."""
    max: float
    """Upper end, m or rad; greater than `min`."""


AxisMode = Literal["position", "velocity", "homing"]
"""Modes of operation of an external axis: profile position (1), profile velocity (3), homing (6); CiA 402-2."""


@dataclass(frozen=True)
class ExternalAxis:
    """An axis that is no joint of the arm, as a linear axis or a conveyor: its drive makes the profile of each motion.

    Positions are in `unit`, speeds in `unit`/s."""

    name: Name
    """Axis name, unique among joints and slaves too; its fields of the record begin with it."""
    slave: Name
    """Drive that moves the axis: a name under `slaves` of kind `cia402`; unique, or with another `axis`."""
    velocity: Rate
    """Speed limit, m/s or rad/s; also the speed of a motion without one."""
    acceleration: Rate
    """Acceleration of the drive's profile, m/s² or rad/s²: what 0x6083 and 0x6084 are among its start-up SDOs."""
    unit: Literal["m", "rad"] = "rad"
    """Unit of its positions; the factors in the device file are of the same unit."""
    position: Travel | None = None
    """Range of its positions; left out: the axis has no ends, as a conveyor."""
    modes: Annotated[tuple[AxisMode, ...], MinLen(1)] = ("position",)
    """What it is used for. It rests in profile position, without `position` in profile velocity at speed 0. With
    `homing` it moves only after it was homed since the start, the last emergency stop and the last loss of its drive.
    """
    tolerance: Positive = 1e-3
    """Largest distance from its target at which it has arrived, m or rad."""
    axis: AxisNumber = 1
    """Axis of `slave`, where its drive has several."""

    @property
    def joint(self) -> Joint:
        """The same axis with the keys of a joint, in its own unit."""
        ends = self.position or Range(-ENDLESS, ENDLESS)
        jerk = _PROFILE_JERK * self.acceleration
        return Joint(
            self.name, self.slave, ends, self.velocity, self.acceleration, jerk, UNLIMITED_TORQUE, axis=self.axis
        )


@dataclass(frozen=True)
class GripperConfig:
    """A gripper on a digital output, or one with a drive of its own: either `output` or `joint` is given."""

    output: Terminal | None = None
    """Output that moves the gripper."""
    box: Name | None = None
    """IO box of `output`; needed with several boxes."""
    closed: Literal["on", "off"] | None = None
    """Output state that closes the gripper; none: on. Only with `output`."""
    joint: Joint | None = None
    """Axis after the arm's joints, with the keys of one of `joints`; its limits are at the drive's shaft."""
    open_position: float | None = None
    """Position of `joint` where the gripper is open, rad; needed with `joint`."""
    closed_position: float | None = None
    """Position of `joint` where the gripper is closed, rad; needed with `joint`."""


@dataclass(frozen=True)
class CycleConfig:
    """The cycle: its period, its priority and its CPU."""

    period_us: Annotated[float, Ge(100), Le(100_000)] = 500.0
    """Cycle period, us."""
    priority: Annotated[int, Ge(1), Le(98)] = 80
    """SCHED_FIFO priority; below that of the network card's interrupt."""
    cpu: Annotated[int, Ge(0)] | None = None
    """CPU of the cycle; none: the last one that the process may use."""
    spin_us: Annotated[float, Ge(0), Le(50)] = 40.0
    """Busy wait before the tick, us; removes the timer's jitter."""


Capability = Literal["sdo", "states", "clocks", "torque", "homing", "power"]
"""Capabilities of a bus beside process data: SDO, supervision of slaves by AL states, distributed clocks; and of its
drives: torque targets and measured torque, homing, switching their power on."""


@dataclass(frozen=True)
class BusConfig:
    """The bus and its tolerances. Each kind is a subclass, found by the entry point `rtcp.buses`."""

    kind: Name = "ethercat"
    """Kind of bus: `ethercat`, `egm` or `rapid`; further ones from installed packages."""
    interface: Name = VIRTUAL
    """`virtual`, or a network interface of at most 15 characters."""
    segment: str = "segment.yaml"
    """File of the virtual segment, relative to the arm's file."""
    lost_cycles: Annotated[int, Ge(1), Le(1000)] = 40
    """Count of lost cycles (wrong working counter) that is a fault: each counts 1, each good one takes off 1/10."""
    timeout_scale: Annotated[float, Ge(1), Le(100)] = 100.0
    """Factor on time limits on the virtual bus, where the host may be slow: [real time](realtime.md)."""
    op_timeout_s: Positive = 5.0
    """Timeout for all slaves from INIT to OP, s."""

    MASTER: ClassVar[str] = ""
    """Class of the loop's end, `module:name`; see `rtcp.fieldbus.master.Master`."""
    VIRTUAL_PROCESS: ClassVar[tuple[str, ...]] = ()
    """Module and options of the process at the other end if `interface` is `virtual`."""
    VIRTUAL_CONTROL: ClassVar[str] = "segment"
    """Name of that process's control socket: `segment` or `irc5`."""
    LACKS: ClassVar[Mapping[Capability, str]] = {}
    """Capabilities that the bus lacks, with a sentence why."""

    def nodes(self, joints: Sequence[str], period_us: float) -> tuple[SlaveConfig, ...]:
        """Return the nodes of a bus without slaves: each joint by its name, then others; none: the file lists slaves.

        Args:
            joints: names of the joints.
            period_us: the cycle, us.
        """
        return ()

    def findings(self, arm: ArmFile) -> Iterator[Finding]:
        """Yield the values of a whole file that this bus does not support."""
        yield from ()


@dataclass(frozen=True)
class EthercatBus(BusConfig):
    """EtherCAT: slaves on a cable."""

    receive_fraction: Annotated[float, Gt(0), Le(0.6)] = 0.3
    """Receive timeout, fraction of the period."""
    send_phase: Fraction = 0.5
    """Instant between two SYNC0 at which the frame passes the reference clock, fraction of the period."""
    clock_lost_s: Positive = 1.0
    """Time without lock to the reference clock that is a fault, s."""
    watch_ms: Annotated[float, Ge(2), Le(1000)] = 10.0
    """Interval at which the slave watcher reads the slaves' states, ms."""

    MASTER: ClassVar[str] = "rtcp.fieldbus.soem:SoemMaster"
    VIRTUAL_PROCESS: ClassVar[tuple[str, ...]] = ("rtcp.virtual",)


@dataclass(frozen=True)
class Box:
    """A box along the base's axes: the tool stays inside it. `min < max` in each coordinate."""

    min: Vector
    """Corner x, y, z of the box that the tool stays in, m; left out: no box."""
    max: Vector
    """Opposite corner, m; greater in each coordinate."""


@dataclass(frozen=True)
class KeepOut:
    """A box that no body of the arm may enter: the user, the chair."""

    name: Name
    """Name for messages and `rtcp limits set NAME.min.x`; unique, no dot, not `box`, `joints` or a joint's name."""
    min: Vector
    """Corner x, y, z, m; all bodies of the arm but the base stay outside: [bodies](kinematics.md#bodies)."""
    max: Vector
    """Opposite corner, m; greater in each coordinate."""


@dataclass(frozen=True)
class Cone:
    """Directions in which an axis of the tool may point: at most `angle` from `direction`."""

    name: Name
    """Name for messages and `rtcp limits set NAME.angle`; unique, as the name of a keep-out box."""
    direction: Vector
    """Direction as multiples of the base's unit vectors, of any length above 0."""
    angle: Annotated[float, FractionOfPi(), Ge(0.05), Le(3.09)]
    """Largest angle between the axis and the direction, rad."""
    axis: Literal["x", "y", "z"] = "z"
    """Axis of the tool's frame."""


@dataclass(frozen=True)
class SingularityLimits:
    """Minimum distances that Cartesian motion keeps from singularities; 0 disables a limit."""

    shoulder: NotNegative = 0.03
    """Distance of the wrist center from axis 1, m."""
    elbow: NotNegative = 0.08
    """Angle of the elbow from stretched or folded, rad."""
    wrist: NotNegative = 0.08
    """Angle of joint 5 from where axes 4 and 6 are in line, rad."""


@dataclass(frozen=True)
class CartesianConfig:
    """Limits of the tool: boxes and cones hold in every mode, speeds and singularities in Cartesian motion."""

    speed: Annotated[float, Gt(0), Le(0.25)] = 0.25
    """Tool speed limit, m/s; at most 0.25 under manual control (ISO 10218-1)."""
    acceleration: Positive = 0.5
    """Tool acceleration limit, m/s²."""
    jerk: Positive = 5.0
    """Tool jerk limit, m/s³."""
    angular_speed: Annotated[float, Gt(0), Le(2)] = 0.5
    """Tool rotation speed limit, rad/s."""
    angular_acceleration: Positive = 1.0
    """Tool rotation acceleration limit, rad/s²."""
    angular_jerk: Positive = 10.0
    """Tool rotation jerk limit, rad/s³."""
    clearance: NotNegative = 0.01
    """Distance that the arm's bodies keep from keep-out boxes and from each other, m."""
    box: Box | None = None
    keep_out: tuple[KeepOut, ...] = ()
    cones: Annotated[tuple[Cone, ...], MaxLen(MOST_CONES)] = ()
    singularity: SingularityLimits = field(default_factory=SingularityLimits)


@dataclass(frozen=True)
class JogConfig:
    """Speeds and frame of the joystick."""

    speed: Annotated[float, Gt(0), Le(0.25)] = 0.1
    """Joystick speed, m/s; at most `cartesian.speed`."""
    angular_speed: Annotated[float, Gt(0), Le(2)] = 0.3
    """Joystick rotation speed, rad/s; at most `cartesian.angular_speed`."""
    frame: FrameName = "base"
    """Frame of the joystick's directions."""


@dataclass(frozen=True)
class GuidingConfig:
    """Hand guiding: [what it does, and what to check first](guiding.md)."""

    speed: Annotated[float, Gt(0), Le(0.25)] = 0.25
    """Largest speed of the tool, m/s."""
    joint_speed: Annotated[float, Gt(0), Le(2)] = 0.5
    """Largest speed of each joint, rad/s; at most its `velocity`."""
    hold: Annotated[float, Gt(0), Le(0.5)] = 0.06
    """Torque that moves no joint yet, fraction of its `torque`: greater errors of the weight make the arm drift."""
    damping: Annotated[float, Ge(0), Le(1)] = 0.1
    """Damping that the hand feels, fraction of each joint's `cst_damping`."""
    weight_error: Annotated[float, Gt(0), Le(1)] = 0.1
    """Largest difference of a joint's torque at rest from its weight, fraction of its `torque`; friction counts too."""
    enabling_switch: bool = True
    """Whether it is refused on a real bus where `inputs.enabling_switch` is left out."""


@dataclass(frozen=True)
class AbsoluteSupervision:
    """How far `rtcp limits set --widen` may raise the thresholds of the supervision; what is left out is not raised."""

    speed: Annotated[float, Ge(1), Le(10)] | None = None
    """Highest multiple of the joint's `velocity`."""
    torque: Annotated[float, Ge(1), Le(10)] | None = None
    """Highest multiple of the joint's `torque`."""
    following_error: Annotated[float, Gt(0), Le(1)] | None = None
    """Largest following error, rad."""


SUPERVISION: Final = ("speed", "torque", "following_error")
"""Names of the thresholds of the supervision."""


@dataclass(frozen=True)
class SupervisionConfig:
    """Limits on measured values; the emergency stop follows when one is exceeded for `cycles` in a row, torque for
    `torque_s`.

    False measurements are not used; `cycles` in a row are a fault.
    """

    cycles: Annotated[int, Ge(1), Le(1000)] = 5
    """Cycles in a row beyond a limit that cause the emergency stop, or with a false measurement that cause a fault."""
    speed: Annotated[float, Ge(1), Le(10)] = 1.5
    """Measured speed limit, multiple of the joint's `velocity`."""
    torque: Annotated[float, Ge(1), Le(10)] = 1.01
    """Measured torque limit, multiple of the joint's `torque`."""
    torque_s: Annotated[float, Gt(0), Le(10)] = 0.1
    """Time beyond the torque limit that causes the emergency stop, s."""
    following_error: Annotated[float, Gt(0), Le(1)] = 0.15
    """Following error limit, rad: commanded minus actual position."""
    absolute: AbsoluteSupervision = field(default_factory=AbsoluteSupervision)
    position_tolerance: Annotated[float, Gt(0), Le(1)] = 0.002
    """A measured position is false if its step is larger than the way at the measured speed limit plus this, rad."""
    acceleration: Annotated[float, Ge(1), Le(1000)] = 25.0
    """Largest possible acceleration, multiple of the joint's `acceleration`: a speed that changes faster is false."""
    velocity_gap: Annotated[float, Gt(0), Le(10)] = 0.4
    """Largest difference of positions and measured speed in 0.1 s, as a fraction of the way at the joint's speed."""


@dataclass(frozen=True)
class FeedForwardConfig:
    """Offsets for drives that map 0x60B1 and 0x60B2: [feed-forward](motion.md#feed-forward)."""

    velocity: Annotated[float, Ge(0), Le(1)] = 0.0
    """Fraction of the setpoint's velocity sent as the velocity offset in CSP."""
    gravity: Annotated[float, Ge(0), Le(1)] = 0.0
    """Fraction of the joints' weight sent as the torque offset in CSP and CSV."""
    acceleration: Annotated[float, Ge(0), Le(1)] = 0.0
    """Fraction of `inertia` times the setpoint's acceleration sent as the torque offset in CSP and CSV."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that the drives need for it."""
        torque = ("torque_offset",) if self.gravity or self.acceleration else ()
        return (*(("velocity_offset",) if self.velocity else ()), *torque)


@dataclass(frozen=True)
class SettleConfig:
    """When a motion with a target is complete: the measured joints are where the joints are commanded."""

    tolerance: Annotated[float, Gt(0), Le(1)] = 0.002
    """Largest distance of each measured joint from its target at the end of a motion, rad."""
    time_s: Annotated[float, Gt(0), Le(60)] = 3.0
    """Longest time from the end of the setpoints until all joints are within the tolerance, s; else the motion fails
    with the event `not_settled`."""


@dataclass(frozen=True)
class HomingConfig:
    """Waits and bounds of `rtcp home`: [homing](homing.md#homing)."""

    settle_ms: Annotated[float, Gt(0), Le(10_000)] = 100.0
    """Longest delay of a drive's statusword and position behind its mode display and its controlword, ms. The start bit
    follows the mode display after this time; bits that were never clear are believed this time after the start bit."""
    search_s: Annotated[float, Gt(0), Le(3600)] = 60.0
    """Longest search of a drive for its home, s."""
    rest_s: Annotated[float, Gt(0), Le(60)] = 3.0
    """Longest time in which a drive comes to rest after its homing has ended, s."""
    tolerance: Annotated[float, Gt(0), Le(1000)] = 0.2
    """Largest distance of a homed drive's position from its home offset (0x607C), rad: a drive that brakes behind its
    switch or index pulse stands beside its home."""


_FRAME_CYCLES: Final = 3
"""Cycles from a command to the status that answers it, in a drive that needs no time: frame, SYNC0, frame."""


@dataclass(frozen=True)
class DriveWaitsConfig:
    """How long the platform waits for its drives. The times are the same for any cycle."""

    answer_ms: Annotated[float, Gt(0), Le(1000)] = 10.0
    """Longest delay of a drive's statusword and velocity behind its controlword, ms: standstill and the absence of
    torque count this long after the command."""
    reset_pulse_ms: Annotated[float, Gt(0), Le(1000)] = 10.0
    """Time for which the fault reset bit (bit 7 of the controlword) is set, ms; it is then clear for as long, and set
    again, until the drive has left its fault."""
    reset_ms: Annotated[float, Gt(0), Le(60_000)] = 3000.0
    """Longest time of `rtcp reset` until slaves, clock and drives are ready again, ms; the debounce time of the
    emergency stop is added."""
    mode_ms: Annotated[float, Gt(0), Le(60_000)] = 1000.0
    """Longest time until a drive shows a commanded mode of operation (0x6061), ms."""
    brake_ms: Annotated[float, Gt(0), Le(10_000)] = 100.0
    """Time in which the drives take the weight of the arm after all are enabled, ms: brakes open in it."""
    off_ms: Annotated[float, Gt(0), Le(10_000)] = 1000.0
    """Longest time until a drive shows no torque, ms: then the slaves leave OP anyway, in an emergency stop after this
    time, at the end of the platform after twice this time."""

    def answer_cycles(self, period_s: float) -> int:
        """Return the number of cycles after which a drive has answered, the way of the frames included."""
        return math.ceil(self.answer_ms * 1e-3 / period_s - 1e-9) + _FRAME_CYCLES


@dataclass(frozen=True)
class StopsConfig:
    """The stop reaction to each event. Stop categories are those of IEC 60204-1."""

    lost_frames: HardStop = "quick_stop"
    """The count of lost cycles has reached `bus.lost_cycles`."""
    slave_lost: HardStop = "quick_stop"
    """A slave has left OP or does not answer."""
    drive_fault: HardStop = "quick_stop"
    """A drive is in fault or has left Operation Enabled by itself: the reaction of all others."""
    clock_lost: AnyStop = "quick_stop"
    """The cycle was not locked to the reference clock for `bus.clock_lost_s`."""
    emergency_stop: HardStop = "quick_stop"
    """The emergency stop input is active: torque goes off at standstill (category 1) or at once (category 0)."""
    supervision: HardStop = "quick_stop"
    """Speed, torque or following error exceeded its limit for `supervision.cycles`: category 1 or 0 likewise."""
    lease_ended: AnyStop = "controlled_stop"
    """The commander of a motion was silent for `lease_s`, released its lease, or its connection closed."""
    enabling_switch: AnyStop = "controlled_stop"
    """The enabling switch was released while something moves."""
    power_off_after_s: Positive | None = None
    """After the controlled stop of `lease_ended` the arm holds for this time, then its drives are disabled, s, unless
    somebody commands it; null: it holds."""


@dataclass(frozen=True)
class InputConfig:
    """An input terminal of the IO box with a meaning."""

    number: Terminal
    """Input terminal; none of a box is used twice."""
    active: Level = "high"
    """Active level."""
    debounce_ms: Milliseconds = 5.0
    """Debounce time, ms."""
    box: Name | None = None
    """IO box of the input; needed with several boxes."""


@dataclass(frozen=True)
class EmergencyStopConfig(InputConfig):
    """The emergency stop's input. Its level has no default: a wrong one would show only in an emergency."""

    active: Level = field()
    """Level that means pressed; low for a normally closed contact, where a cut wire stops the arm too."""


InputChannel = Annotated[str, "tpdo"]
"""A channel that a slave sends, written SLAVE.CHANNEL."""
OutputChannel = Annotated[str, "rpdo"]
"""A channel that a slave receives, written SLAVE.CHANNEL."""


BEYOND_FULL: Final = 1.1
"""Largest inclination of a stick that is intact, multiple of the full one."""


@dataclass(frozen=True)
class StickAxisConfig:
    """An axis of an analog stick."""

    channel: InputChannel
    """Channel with the inclination, SLAVE.CHANNEL, of a device of kind `analog`, `encoder` or `generic`."""
    neutral: float = 0.0
    """Value at rest, in the channel's unit."""
    full: float = 1.0
    """Change of the value from rest to the full inclination forward or left, in the channel's unit; not 0. A negative
    one where the value falls. A value beyond 1.1 times it stops the arm; that of a cut wire, 0, has to be one."""


@dataclass(frozen=True)
class AnalogStickConfig:
    """The stick of the joystick on analog channels: its inclination replaces the four directions."""

    forward: StickAxisConfig
    left: StickAxisConfig
    dead_zone: Annotated[float, Gt(0), Le(0.5)] = 0.1
    """Fraction of the full inclination, about rest, that is neutral."""
    curve: Annotated[float, Ge(1), Le(4)] = 1.0
    """Exponent of the fraction of the speed over that of the inclination: 1 is proportional, 2 is finer near rest."""


@dataclass(frozen=True)
class JoystickConfig:
    """The terminals of the joystick, all active low through pull-ups, or all active high."""

    forward: Terminal = 1
    """Input terminal of this direction."""
    backward: Terminal = 2
    """Input terminal of this direction."""
    left: Terminal = 3
    """Input terminal of this direction."""
    right: Terminal = 4
    """Input terminal of this direction."""
    mode_up: Terminal = 5
    """Input terminal of the paddle: next joystick mode, on release."""
    mode_down: Terminal = 6
    """Input terminal of the paddle: previous joystick mode, on release."""
    active: Level = "low"
    """Level that means pressed, for all six."""
    debounce_ms: Milliseconds = 5.0
    """Debounce time, ms."""
    box: Name | None = None
    """IO box of the joystick; needed with several boxes."""
    analog: AnalogStickConfig | None = None


@dataclass(frozen=True)
class NamedTerminal:
    """A terminal of the IO box that programs use by a name."""

    name: Name
    """Name for programs (`robot.io`); unique among inputs and outputs, no dot, not that of a function."""
    number: Terminal
    """Terminal of the IO box; none of a box is used twice."""
    box: Name | None = None
    """IO box of the terminal; needed with several boxes."""


@dataclass(frozen=True)
class InputsConfig:
    """Inputs with a meaning; one that is left out does not exist."""

    joystick: JoystickConfig | None = None
    arm_toggle: InputConfig | None = None
    """Active: the joystick moves the arm; inactive: the wheelchair, and the arm holds still."""
    enabling_switch: InputConfig | None = None
    """Active: motion is allowed. Release stops; pressing again moves nothing until a new command."""
    emergency_stop: EmergencyStopConfig | None = None
    """Active: pressed."""
    named: tuple[NamedTerminal, ...] = ()
    """Inputs that programs read by a name."""


@dataclass(frozen=True)
class OutputsConfig:
    """Outputs with a meaning; one that is left out does not exist."""

    state_lamp: Terminal | None = None
    """Output terminal: on while drives have torque; none of a box is used twice."""
    motion_lamp: Terminal | None = None
    """Output terminal: on while the arm moves."""
    heartbeat: Terminal | None = None
    """Output terminal: toggled each cycle, for an oscilloscope."""
    box: Name | None = None
    """IO box of these outputs; needed with several boxes."""
    named: tuple[NamedTerminal, ...] = ()
    """Outputs that programs set by a name."""


@dataclass(frozen=True)
class RecordingConfig:
    """Content and place of a recording; as `recording` in the arm's file it starts with the platform."""

    out: str | None = None
    """Absolute path of a directory, or of a file; none: `recordings/` in the platform's state directory."""
    formats: tuple[RecordingFormat, ...] = ()
    """Formats; none: the ending of `out`, or mcap."""
    signals: tuple[str, ...] = ()
    """Fields of a cycle record or patterns (`*_position`); none: all. CSV has its own columns, then these."""
    every: Annotated[int, Ge(1), Le(1_000_000)] = 1
    """Every Nth cycle."""
    seconds: Positive | None = None
    """Duration of the recording, s; none: until it is stopped, or the platform."""
    max_file_mb: Annotated[int, Ge(1)] | None = None
    """Size of a file at which the next one begins, MB; none: no limit."""
    max_file_seconds: Annotated[float, Ge(1)] | None = None
    """Age of a file at which the next one begins, s; none: no limit."""
    keep: Annotated[int, Ge(1)] | None = None
    """Newest files of the recording that are kept, of each format; none: all."""
    reserve_mb: Annotated[int, Ge(0)] = 256
    """Free space of the disk below which the recording ends, MB."""


@dataclass(frozen=True)
class SimpleMessageConfig:
    """Where Simple Message is served; see [Simple Message](simple_message.md)."""

    bind: str = "127.0.0.1"
    """Address that it listens at; any client that reaches it can move the arm."""
    motion_port: Annotated[int, Ge(0), Le(65535)] = 11000
    """TCP port; 0: a free one, which the log names."""
    state_port: Annotated[int, Ge(0), Le(65535)] = 11002
    """TCP port; 0: a free one, which the log names."""
    byte_order: Literal["auto", "little", "big"] = "auto"
    """Byte order of the clients; auto: that of their messages, else little."""
    joint_feedback: bool = False
    """Whether velocities are sent too, which the reference client complains of."""


@dataclass(frozen=True)
class RosConfig:
    """Services for ROS that run as long as the platform."""

    simple_message: SimpleMessageConfig = field(default_factory=SimpleMessageConfig)


@dataclass(frozen=True)
class Row:
    """A row of modified (Craig) parameters: T(i-1, i) = Rx(alpha) Tx(a) Rz(q + offset) Tz(d)."""

    alpha: Turn
    """Twist, rad; one of six rows, base to flange, see [kinematics](kinematics.md)."""
    a: Length
    """Link length, m."""
    d: Length
    """Link offset, m."""
    offset: Turn = 0.0
    """Joint offset, rad: theta = q + offset."""


@dataclass(frozen=True)
class MechanicalLimit:
    """Mechanical range and speed of a joint."""

    min: Angle
    """Lower mechanical end, rad; without `limits`: the ranges of `joints`."""
    max: Angle
    """Upper mechanical end, rad; greater than `min`."""
    velocity: Speed | None = None
    """Largest speed, rad/s; none: not known."""


@dataclass(frozen=True)
class Link:
    """Mass and center of mass of the link that moves with a joint."""

    mass: NotNegative
    """Link mass, kg; `links` left out: gravity is not compensated."""
    centre: Vector
    """Center of mass x, y, z in the joint's frame, m."""


@dataclass(frozen=True)
class Tool:
    """The transform from the flange (frame 6) to the tool."""

    position: Vector = (0.0, 0.0, 0.0)
    """Tool position x, y, z from the flange, m."""
    rpy: Annotated[tuple[Turn, ...], MinLen(3), MaxLen(3)] = (0.0, 0.0, 0.0)
    """Tool rotation rx, ry, rz, rad: R = Rx(rx) Ry(ry) Rz(rz)."""


@dataclass(frozen=True)
class Body:
    """A body of the arm: a cylinder with a ball at each end."""

    link: Annotated[int, Ge(0), Le(JOINTS)]
    """Link of the body: 0 the base, 6 the flange and the tool; `bodies` left out: made of `dh` and `tool`."""
    start: Vector
    """Start x, y, z of the axis in the frame of the link, m."""
    end: Vector
    """End of the axis, m; the same point: a ball."""
    radius: Positive
    """Radius, m."""


@dataclass(frozen=True)
class ToolBody:
    """A body of a tool: a cylinder with a ball at each end."""

    start: Vector
    """Start x, y, z of the axis from the flange, m; `bodies` left out: one from the flange to the tool point."""
    end: Vector
    """End of the axis, m; the same point: a ball."""
    radius: Positive
    """Radius, m."""


@dataclass(frozen=True)
class NamedTool:
    """A tool that `rtcp tool` chooses; the first is in use after the start."""

    name: Name
    """Name of the tool; unique."""
    position: Vector = (0.0, 0.0, 0.0)
    """Tool position x, y, z from the flange, m; `tools` left out: the one of `tool`."""
    rpy: Annotated[tuple[Turn, ...], MinLen(3), MaxLen(3)] = (0.0, 0.0, 0.0)
    """Tool rotation rx, ry, rz, rad: R = Rx(rx) Ry(ry) Rz(rz)."""
    mass: NotNegative = 0.0
    """Mass of the tool, kg."""
    centre: Vector = (0.0, 0.0, 0.0)
    """Center of mass x, y, z from the flange, m."""
    bodies: tuple[ToolBody, ...] | None = None


@dataclass(frozen=True)
class PayloadConfig:
    """Limits of the payload."""

    max_mass: NotNegative = 0.0
    """Largest mass that `rtcp payload` accepts, kg; 0: none."""


@dataclass(frozen=True)
class Kinematics:
    """The arm's geometry; `limits` may be left out beside `joints`, `links` where masses are not known."""

    dh: Annotated[tuple[Row, ...], MinLen(JOINTS), MaxLen(JOINTS)]
    limits: Annotated[tuple[MechanicalLimit, ...], MinLen(JOINTS), MaxLen(JOINTS)] | None = None
    links: Annotated[tuple[Link, ...], MinLen(JOINTS), MaxLen(JOINTS)] | None = None
    tool: Tool = field(default_factory=Tool)
    tools: Annotated[tuple[NamedTool, ...], MaxLen(MOST_TOOLS)] = ()
    bodies: Annotated[tuple[Body, ...], MinLen(1)] | None = None

    @property
    def every_tool(self) -> tuple[NamedTool, ...]:
        """The tools; if none is named, the only one."""
        return self.tools or (NamedTool(ArmModel.tool_name, self.tool.position, self.tool.rpy),)


@dataclass(frozen=True)
class ProcessConfig:
    """A process of the platform. Each kind is a subclass, found by the entry point `rtcp.processes`."""

    kind: Name
    """Kind of process, of an installed package: `shape_setting`, or another one."""
    name: Name
    """Name in records, status and commands; lower case letters, digits and underscores."""

    ENTRY_POINTS: ClassVar[str] = "rtcp.processes"
    PROCESS: ClassVar[str] = ""
    """Class of the cycle's part, `module:name`: a `rtcp.processes.Process`."""
    COMMANDS: ClassVar[tuple[type[Any], ...]] = ()
    """Commands (`rtcp.ipc.commands.Command`) that it accepts; no other part of the platform does."""
    STATES: ClassVar[type[IntEnum] | None] = None
    """States of its field `state`, if it has one; for status and panel."""
    LAMPS: ClassVar[Mapping[str, str]] = {}
    """Lamps on the panel: colour -> key of the displayed channel."""
    PLOT: ClassVar[tuple[str, ...]] = ()
    """Fields that the panel draws over time."""

    @classmethod
    def state_in_words(cls, number: int) -> str:
        """Return the name of a state, the value of the field `state`, in words; empty: it has no states."""
        if cls.STATES is None:
            return ""
        return next((state.name for state in cls.STATES if state == number), "unknown").lower().replace("_", " ")

    def findings(self, devices: Mapping[str, DeviceDescription]) -> Iterator[Finding]:
        """Yield the channels that the slaves, by name, lack or that cannot be used."""
        used: dict[str, str] = {}
        for key, image, text in self.channels():
            slave, _, channel = text.partition(".")
            if slave in devices and all(
                channel in (entry.name for pdo in getattr(devices[slave], direction) for entry in pdo.channels)
                for direction in ("rpdo", "tpdo")
            ):
                yield Finding((key,), "channel_of_both", found=text, of=slave)
            mapped = [
                entry.name
                for pdo in (getattr(devices[slave], image) if slave in devices else ())
                for entry in pdo.channels
                if entry.index
            ]
            if slave not in devices:
                yield Finding((key,), "channel", found=text, allowed=f"SLAVE.CHANNEL with one of {', '.join(devices)}")
            elif devices[slave].is_box:
                yield Finding((key,), "channel_of_box", found=text)
            elif channel not in mapped:
                yield Finding((key,), "no_channel", found=text, image=image, of=slave, allowed=mapped or "none")
            elif image == "rpdo" and text in used:
                yield Finding((key,), "channel_written", found=text, of=used[text])
            used[text] = key

    def channels(self) -> Iterator[tuple[str, Literal["tpdo", "rpdo"], str]]:
        """Yield key, image and text of every channel that the keys name; an empty text names none."""
        hints = get_type_hints(type(self), include_extras=True)
        for entry in fields(self):
            hint = hints[entry.name]
            if hint in (InputChannel, OutputChannel) and (text := getattr(self, entry.name)):
                yield entry.name, get_args(hint)[1], text


@dataclass(frozen=True)
class ArmSettings:
    """Settings both of the arm's file and of the configuration made of it."""

    name: Name
    """Name of the arm, also of its file of zero offsets."""
    joints: Annotated[tuple[Joint, ...], MinLen(0), MaxLen(MOST_AXES)] = ()
    cycle: CycleConfig = field(default_factory=CycleConfig)
    bus: BusConfig = field(default_factory=EthercatBus)
    drive_mode: DriveModeName = "csp"
    """Drive mode at the start: cyclic synchronous position, velocity or torque; `rtcp mode` changes it."""
    control_mode: ControlModeName = "joint"
    """Control mode at the start; see [control modes](configuration.md#control-modes)."""
    enable_timeout_s: Positive = 3.0
    """Timeout until all drives are enabled, or without torque, s."""
    lease_s: Positive = 0.5
    """Silence of the commander that ends its lease, s; see [whose silence](motion.md#whose-silence-stops-the-arm)."""
    rest_pose: Annotated[tuple[Angle, ...], MinLen(1), MaxLen(MOST_AXES)] | None = None
    """Joint positions to which `rtcp move --rest-pose` and the panel lead, rad."""
    cartesian: CartesianConfig = field(default_factory=CartesianConfig)
    jog: JogConfig = field(default_factory=JogConfig)
    guiding: GuidingConfig = field(default_factory=GuidingConfig)
    supervision: SupervisionConfig = field(default_factory=SupervisionConfig)
    feed_forward: FeedForwardConfig = field(default_factory=FeedForwardConfig)
    settle: SettleConfig = field(default_factory=SettleConfig)
    homing: HomingConfig = field(default_factory=HomingConfig)
    drive_waits: DriveWaitsConfig = field(default_factory=DriveWaitsConfig)
    stops: StopsConfig = field(default_factory=StopsConfig)
    inputs: InputsConfig = field(default_factory=InputsConfig)
    outputs: OutputsConfig = field(default_factory=OutputsConfig)
    gripper: GripperConfig | None = None
    external_axes: Annotated[tuple[ExternalAxis, ...], MaxLen(MOST_AXES)] = ()
    """Axes that are no joints of the arm: [external axes](external_axes.md)."""
    payload: PayloadConfig = field(default_factory=PayloadConfig)
    recording: RecordingConfig | None = None
    ros: RosConfig | None = None
    processes: tuple[ProcessConfig, ...] = ()
    """Processes beside motion: [processes](processes.md)."""

    @property
    def axes(self) -> tuple[Joint, ...]:
        """All driven axes: the joints, from base to tool, the gripper's if it has a drive, then the external axes."""
        driven = self.gripper.joint if self.gripper else None
        return (*self.joints, *(() if driven is None else (driven,)), *(axis.joint for axis in self.external_axes))

    @property
    def first_external(self) -> int:
        """Number of the first external axis among `axes`."""
        return len(self.axes) - len(self.external_axes)

    def unit_of(self, axis: int) -> str:
        """Return the unit of the positions of an axis by its number among `axes`: m or rad."""
        external = axis - self.first_external
        return self.external_axes[external].unit if 0 <= external < len(self.external_axes) else "rad"


@dataclass(frozen=True)
class ArmFile(ArmSettings):
    """The content of the arm's file: its slaves only name their device."""

    slaves: Annotated[tuple[SlaveEntry, ...], MinLen(1)] = field(kw_only=True)
    kinematics: Kinematics | None = None


@dataclass(frozen=True)
class ArmConfig(ArmSettings):
    """The whole configuration of an arm: `config/assistive_arm.yaml` and the files that it names."""

    slaves: tuple[SlaveConfig, ...] = field(kw_only=True)
    arm: ArmModel | None = None
    """The geometry with the first tool; None: only joint motion is possible, and no Cartesian guard."""
    other_tools: tuple[ArmModel, ...] = ()
    """The geometry with each of the other tools."""
    zero_offsets: tuple[float, ...] = ()
    """Position of each drive at its axis' zero, rad, in the order of `axes`; empty: all 0."""
    source: Path = Path()
    """The file it was read from."""

    def with_devices(self, devices: Sequence[DeviceDescription]) -> ArmConfig:
        """Return the configuration with other descriptions of its slaves, in their order."""
        pairs = zip(self.slaves, devices, strict=True)
        return replace(self, slaves=tuple(replace(slave, device=device) for slave, device in pairs))

    @property
    def models(self) -> tuple[ArmModel, ...]:
        """The geometry with each tool, by the tools' numbers; empty: unknown."""
        return () if self.arm is None else (self.arm, *self.other_tools)

    @property
    def tool_names(self) -> tuple[str, ...]:
        """Names of the tools, by their numbers; at least one."""
        return tuple(model.tool_name for model in self.models) or (ArmModel.tool_name,)

    def model_of(self, tool: str) -> ArmModel | None:
        """Return the geometry with a tool by its name; None: there is none."""
        return next((model for model in self.models if model.tool_name == tool), None)

    @property
    def ethercat(self) -> EthercatBus:
        """The keys of an EtherCAT bus; on another kind their defaults."""
        return self.bus if isinstance(self.bus, EthercatBus) else EthercatBus()

    @property
    def boxes(self) -> tuple[str, ...]:
        """Names of the IO boxes, in the order of the cable."""
        return tuple(slave.name for slave in self.slaves if slave.device.is_box)

    def box_of(self, user: HasBox | None) -> str:
        """Return the IO box of an input or output with a function; empty: there is none."""
        boxes = self.boxes
        named = None if user is None else user.box
        return named if named is not None else boxes[0] if boxes else ""

    def measures(self, channel: str) -> bool:
        """Return whether the drive of every joint sends this input, as `velocity` or `torque`."""
        devices = {slave.name: slave.device for slave in self.slaves}
        images = [devices[joint.slave].of_axis(joint.axis).tpdo for joint in self.joints]
        return all(any(entry.name == channel for pdo in image for entry in pdo.channels) for image in images)

    @property
    def process_outputs(self) -> frozenset[tuple[str, str]]:
        """Slave and channel of every output that a process writes: no command sets it."""
        written = (
            text.partition(".") for part in self.processes for _, image, text in part.channels() if image == "rpdo"
        )
        return frozenset((slave, channel) for slave, _, channel in written)

    def terminals(self, section: InputsConfig | OutputsConfig) -> dict[str, tuple[str, int]]:
        """Return box and number of each terminal that a section names, by its name or the key of its function."""
        if not self.boxes:
            return {}
        places: dict[str, tuple[str, int]] = {}
        for key, value in vars(section).items():
            if isinstance(value, int):
                places[key] = self.box_of(section if isinstance(section, OutputsConfig) else None), value
            elif isinstance(value, tuple):
                places |= {named.name: (self.box_of(named), named.number) for named in value}
            elif isinstance(value, InputConfig):
                places[key] = self.box_of(value), value.number
            elif isinstance(value, JoystickConfig):
                places |= {name: (self.box_of(value), pin) for name, pin in vars(value).items() if isinstance(pin, int)}
        return places


# -- motion files ------------------------------------------------------------------------------------------------------

_Numbers = Annotated[tuple[Angle, ...], MinLen(1), MaxLen(MOST_AXES)]
_Coordinates = Annotated[tuple[Angle, ...], MinLen(6), MaxLen(6)]


@dataclass(frozen=True)
class Point:
    """A point of a trajectory."""

    t: NotNegative
    """Time, s; it rises from point to point."""
    q: _Numbers
    """Joint positions from base to tool, rad."""
    v: _Numbers | None = None
    """Joint velocities, rad/s; for all points or for none."""
    a: _Numbers | None = None
    """Joint accelerations, rad/s²; only with `v`, for all points or for none."""


@dataclass(frozen=True)
class Stop:
    """The end of a line, an arc or a move by the joints; it has either `pose` or `q`."""

    pose: _Coordinates | None = None
    """x, y, z, rx, ry, rz of the tool, m and rad."""
    q: _Coordinates | None = None
    """Joint positions that have the pose, rad."""
    speed: Positive | None = None
    """Speed of the tool on the way to it, m/s; None: that of the path. By the joints: of the fastest one, rad/s."""
    via: Annotated[tuple[float, ...], MinLen(3), MaxLen(3)] | None = None
    """x, y, z, m: the tool gets there on the arc through it; None: on a line."""
    angle: Angle | None = None
    """Angle to travel on the circle through here, `via` and the stop, rad; None: up to the stop."""
    by_joints: bool = False
    """Whether the joints lead there, not a line."""
    blend: NotNegative = 0.0
    """Radius within which the corner at this stop is rounded, m, at most half of the ways; 0: the tool rests there."""


@dataclass(frozen=True)
class NamedPose:
    """A place of a program; it has either `pose` or `q`."""

    name: Name
    """Name in the steps of a program."""
    pose: _Coordinates | None = None
    """x, y, z, rx, ry, rz of the tool, m and rad."""
    q: _Coordinates | None = None
    """Joint positions, rad."""


@dataclass(frozen=True)
class Step:
    """A step of a program: one of `move`, `line`, `arc`, `gripper`, `axis`, `output`, `wait_for`, `wait_s`, `tool`,
    `run`."""

    move: Name | None = None
    """Move to this pose by the joints."""
    line: Name | None = None
    """Move to this pose on a straight line."""
    arc: Name | None = None
    """Move to this pose on the arc through `via`."""
    via: Name | None = None
    """Pose through whose place an arc leads."""
    angle: Angle | None = None
    """Angle to travel on the circle through the three places, rad; None: up to the pose."""
    speed: Positive | None = None
    """Speed of the tool, m/s; None: that of the file. By the joints: of the fastest one, rad/s. Of an axis: its own."""
    blend: NotNegative = 0.0
    """Radius within which the corner to the next motion is rounded, m; 0: the tool rests."""
    gripper: Literal["open", "close"] | None = None
    """Open or close the gripper."""
    axis: Name | None = None
    """Move this external axis: to `position`, with `velocity` for `time_s`, or to its home with `home`."""
    position: float | None = None
    """Target of an axis, m or rad."""
    velocity: float | None = None
    """Velocity of an axis, m/s or rad/s; the next steps begin at once. 0: the axis stops."""
    time_s: Positive | None = None
    """How long an axis runs, s; it also stops where the program ends."""
    home: bool = False
    """Search the home of an axis."""
    output: Name | None = None
    """Set this output to `value`."""
    wait_for: Name | None = None
    """Wait until this input has `value`."""
    value: bool = True
    """Level of an output or an input."""
    timeout_s: Positive | None = None
    """Longest wait for an input, s; None: for ever."""
    wait_s: Positive | None = None
    """Time to wait, s."""
    tool: Name | None = None
    """Use this tool from here on."""
    run: Name | None = None
    """Run this part."""
    times: Annotated[int, Ge(0), Le(1_000_000)] = 1
    """How often a part runs; 0: for ever."""


@dataclass(frozen=True)
class ProgramPart:
    """Steps that are run by name."""

    name: Name
    """Name in the steps of a program."""
    steps: Annotated[tuple[Step, ...], MinLen(1), MaxLen(MOST_POINTS)]


@dataclass(frozen=True)
class MotionFile:
    """A motion: one of `trajectory`, `path` and `program` has entries."""

    trajectory: Annotated[tuple[Point, ...], MaxLen(MOST_POINTS)] = ()
    path: Annotated[tuple[Stop, ...], MaxLen(MOST_POINTS)] = ()
    speed: Positive | None = None
    """Speed of the tool on paths and in programs, m/s; None: `cartesian.speed` of the arm's file."""
    poses: Annotated[tuple[NamedPose, ...], MaxLen(MOST_POINTS)] = ()
    program: Annotated[tuple[Step, ...], MaxLen(MOST_POINTS)] = ()
    parts: Annotated[tuple[ProgramPart, ...], MaxLen(MOST_POINTS)] = ()
