"""The configuration as the platform uses it: frozen, checked whole by `rtcp.config.schema`, SI units throughout.

This module imports nothing heavy: the loop's process holds these objects and no validator.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen

from kinematics.model import ArmModel
from rtcp.config.operation import (
    CartesianConfig,
    InputsConfig,
    JogConfig,
    MotionName,
    OutputsConfig,
    WatchConfig,
)
from rtcp.config.stops import StopsConfig

U8 = Annotated[int, Ge(0), Le(0xFF)]
U16 = Annotated[int, Ge(0), Le(0xFFFF)]
U32 = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Fraction = Annotated[float, Gt(0), Lt(1)]
Name = Annotated[str, MinLen(1), MaxLen(64)]

DataTypeName = Literal["bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
                       "float32", "float64"]  # fmt: skip
DriveModeName = Literal["csp", "csv", "cst"]


@dataclass(frozen=True)
class PdoEntry:
    """One mapped object: `value in SI = counts * factor`. Index 0 is padding and has no name of use."""

    index: U16
    sub_index: U8
    type: DataTypeName
    name: Name
    factor: float = 1.0


@dataclass(frozen=True)
class Pdo:
    """A process data object (0x16xx from the master, 0x1Axx to it) and the entries mapped into it, in order."""

    index: U16
    channels: Annotated[tuple[PdoEntry, ...], MinLen(1)]


@dataclass(frozen=True)
class StartupSdo:
    """An SDO written in PRE-OP and read back; `optional` ones may be absent from the device."""

    index: U16
    sub_index: U8
    type: DataTypeName
    value: float
    name: str = ""
    optional: bool = False


@dataclass(frozen=True)
class DeviceDescription:
    """A kind of slave, from `config/devices/<key>.yaml`."""

    name: Name
    kind: Literal["cia402", "io"]
    vendor_id: U32
    product_id: U32
    rpdo: tuple[Pdo, ...]
    """Outputs of the master, assigned through 0x1C12."""
    tpdo: tuple[Pdo, ...]
    """Inputs of the master, assigned through 0x1C13."""
    configurable_pdos: bool = True
    """False where the device's mapping is fixed: it is then read and compared, never written."""
    complete_access: bool = True
    """False where the device answers SDO complete access of its PDO assignment wrongly though its EEPROM offers it."""
    sdo: tuple[StartupSdo, ...] = ()
    assign_activate: U16 = 0
    """DC AssignActivate word of the ESI (0x0300: SYNC0; 0x0700: SYNC0 and SYNC1); 0: no distributed clocks."""
    sync0_shift_us: float = 0.0
    watchdog_ms: Annotated[float, Gt(0), Le(6000)] = 100.0
    """Process-data (sync manager) watchdog: the drive stops when no output arrives for so long."""


@dataclass(frozen=True)
class SlaveConfig:
    """A slave of the segment, in the order of the cable: position is its index + 1."""

    name: Name
    device: DeviceDescription


@dataclass(frozen=True)
class Range:
    """A closed interval; `min < max`."""

    min: float
    max: float


@dataclass(frozen=True)
class Joint:
    """A joint, the drive that moves it and its limits (rad, rad/s, rad/s^2, rad/s^3, Nm)."""

    name: Name
    slave: Name
    position: Range
    velocity: Annotated[float, Ge(0.001)]
    acceleration: Annotated[float, Ge(0.001)]
    jerk: Annotated[float, Ge(0.001)]
    torque: Positive
    csv_gain: NotNegative = 10.0
    """Position gain of the loop closed in CSV, 1/s."""
    cst_stiffness: NotNegative = 600.0
    """Joint stiffness in CST, Nm/rad."""
    cst_damping: NotNegative = 60.0
    """Joint damping in CST, Nm s/rad."""
    cst_integral: NotNegative = 1200.0
    """Integral gain in CST, Nm/(rad s)."""


@dataclass(frozen=True)
class GripperConfig:
    """A gripper on a digital output, or one that a drive of its own moves: either `output` or `joint` is given."""

    output: Annotated[int, Ge(1), Le(16)] | None = None
    closed: Literal["on", "off"] = "on"
    """The output's state that closes it."""
    joint: Joint | None = None
    """The axis after the arm's joints; its limits are the gripper's, at the drive's shaft."""
    open_position: float | None = None
    closed_position: float | None = None
    """rad, of `joint`: where the gripper is open and where it is closed."""


@dataclass(frozen=True)
class CycleConfig:
    """The cycle: its period, its priority and its place."""

    period_us: Annotated[float, Ge(100), Le(100_000)] = 500.0
    priority: Annotated[int, Ge(1), Le(98)] = 80
    cpu: Annotated[int, Ge(0)] | None = None
    """CPU of the cycle; None: the last one that the process may use."""
    spin_us: Annotated[float, Ge(0), Le(50)] = 40.0
    """The timer wakes so long before the tick; the rest is waited for awake, which takes the timer's jitter out."""


@dataclass(frozen=True)
class BusConfig:
    """The bus: an interface or `virtual`, and how long what may be missing."""

    interface: Name = "virtual"
    segment: str = "segment.yaml"
    """Slaves of the virtual segment; a path relative to the arm's file."""
    receive_fraction: Annotated[float, Gt(0), Le(0.6)] = 0.3
    """How long a frame is waited for, as a fraction of the period."""
    lost_cycles: Annotated[int, Ge(1), Le(1000)] = 40
    """So many cycles in a row without a right working counter, or so many more than with one, are a fault."""
    virtual_patience: Annotated[float, Ge(1), Le(100)] = 25.0
    """So many times wider are limits on lost process data on the virtual bus alone; see `rtcp.config.virtual`."""
    send_phase: Fraction = 0.5
    """Where between two SYNC0 the frame passes the reference slave, as a fraction of the period."""
    op_timeout_s: Positive = 5.0
    watch_ms: Annotated[float, Ge(2), Le(1000)] = 10.0
    """So often the slave watcher, on the thread beside the cycle, asks for the slaves' states."""


@dataclass(frozen=True)
class ArmConfig:
    """The whole configuration of an arm: what `config/assistive_arm.yaml` and the files it names say."""

    name: Name
    slaves: Annotated[tuple[SlaveConfig, ...], MinLen(1)]
    joints: Annotated[tuple[Joint, ...], MinLen(1), MaxLen(10)]
    cycle: CycleConfig
    bus: BusConfig
    mode: DriveModeName = "csp"
    enable_timeout_s: Positive = 3.0
    lease_s: Positive = 0.5
    """A commander that is silent for so long has lost its lease: the arm stops in a controlled way."""
    motion: MotionName = "joint"
    """What the arm takes commands for at the start."""
    cartesian: CartesianConfig = field(default_factory=CartesianConfig)
    jog: JogConfig = field(default_factory=JogConfig)
    watch: WatchConfig = field(default_factory=WatchConfig)
    stops: StopsConfig = field(default_factory=StopsConfig)
    inputs: InputsConfig = field(default_factory=InputsConfig)
    outputs: OutputsConfig = field(default_factory=OutputsConfig)
    gripper: GripperConfig | None = None
    arm: ArmModel | None = None
    """The geometry; None: only joint motion is possible, and no Cartesian guard."""
    zero_offsets: tuple[float, ...] = ()
    """rad, what each axis' drive shows at the axis' zero, in the order of `axes`; empty: all 0."""
    source: Path = Path()
    """The file it was read from."""

    @property
    def axes(self) -> tuple[Joint, ...]:
        """All that drives move: the joints, from base to tool, and after them the gripper's where it has a drive."""
        driven = self.gripper.joint if self.gripper else None
        return self.joints if driven is None else (*self.joints, driven)
