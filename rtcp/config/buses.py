"""The kinds of bus beside EtherCAT: their keys under `bus`, and their nodes.

A robot controller has no slaves. Its joints, and the mechanical unit as a whole, are nodes with process images of their
own, laid out as the PDOs of a slave: the loop handles both alike. Packages add kinds by the entry point
`rtcp.buses` (docs/extending.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

from annotated_types import Ge, Gt, Le

from rtcp.config.find import class_of_kind
from rtcp.config.findings import Finding
from rtcp.config.model import (
    VIRTUAL,
    ArmFile,
    BusConfig,
    Capability,
    DataTypeName,
    DeviceDescription,
    Pdo,
    PdoEntry,
    SlaveConfig,
)
from rtcp.config.numbers import Name, Positive

ENTRY_POINTS = "rtcp.buses"
_ANY_ADDRESS = "0.0.0.0"
_ADDRESS = re.compile(r"(?:\d{1,3}\.){3}\d{1,3}", re.ASCII)
Rows = tuple[tuple[str, DataTypeName, str], ...]
"""Channels: name, type, unit."""

JOINT_OUTPUTS: Rows = (
    ("target_position", "float64", "rad"),
    ("target_velocity", "float64", "rad/s"),
    ("command", "uint8", ""),
)
"""`command`: 0 stand still, 1 follow the targets, 2 stop and discard accepted targets."""
JOINT_INPUTS: Rows = (
    ("position", "float64", "rad"),
    ("state", "uint8", ""),
    ("missing", "uint8", ""),
)
"""`state` is a `rtcp.ipc.states.DriveState`, `missing` a `Missing`."""
BOARD_OUTPUTS: Rows = (("outputs", "uint16", ""),)
BOARD_INPUTS: Rows = (("inputs", "uint16", ""),)
"""The board of a controller: bit 0 is terminal 1."""

CONTROLLER_STATUS: Rows = (
    ("drives_powered", "int8", ""),
    ("e_stopped", "int8", ""),
    ("operating_mode", "int8", ""),
)
"""Input channels by which a slave or a unit tells the state of a robot controller: whether its motors are on, whether
its emergency stop is active (1, 0), and the position of its key (1 manual, 2 automatic); -1: unknown. A bus declares
those that its messages contain. What no slave declares is unknown in RobotStatus."""

_CONTROLLERS_OWN: Mapping[Capability, str] = {
    "sdo": "a robot controller has no SDO: its parameters are set at its display",
    "states": "a robot controller has no AL states: `rtcp status` shows its motors and its program",
    "clocks": "a robot controller has no distributed clocks: its messages set the pace",
    "torque": "the robot controller takes no torque and reports none",
    "homing": "the robot controller keeps the zero positions of its joints: calibrate them there",
    "power": "the robot controller has the power: people there switch its motors on and start its program",
}


def bus_class(kind: str) -> type[BusConfig]:
    """Return the configuration class of a kind of bus; raises as `class_of_kind`."""
    return class_of_kind(BusConfig, ENTRY_POINTS, kind)


def is_address(text: str) -> bool:
    """Whether a text is an IPv4 address."""
    return _ADDRESS.fullmatch(text) is not None


def node(name: str, kind: str, outputs: Rows, inputs: Rows, watchdog_s: float) -> SlaveConfig:
    """Return a node with these channels, which stops by itself `watchdog_s` after the last message."""

    def pdos(index: int, rows: Rows) -> tuple[Pdo, ...]:
        entries = tuple(PdoEntry(0x2000, i, kind, name, unit=unit) for i, (name, kind, unit) in enumerate(rows, 1))
        return (Pdo(index, entries),) if entries else ()

    device = DeviceDescription(
        name, kind, 0, 0, pdos(0x1600, outputs), pdos(0x1A00, inputs), watchdog_ms=1000.0 * watchdog_s
    )
    return SlaveConfig(name, device)


@dataclass(frozen=True)
class ControllerBus(BusConfig):
    """Base of all buses to a robot controller."""

    LACKS: ClassVar[Mapping[Capability, str]] = _CONTROLLERS_OWN
    VIRTUAL_PROCESS: ClassVar[tuple[str, ...]] = ("rtcp.virtual.irc5", "--private")
    VIRTUAL_CONTROL: ClassVar[str] = "irc5"
    HAS_ONE_CONNECTION: ClassVar[bool] = False
    """Whether all mechanical units of a controller share one connection, which one platform of a cell holds."""

    def at_controller(self, address: str) -> ControllerBus:
        """Return this bus for the controller at an IPv4 address, in place of the virtual controller."""
        return replace(self, interface=address)

    @staticmethod
    def joints_and_unit(joints: Sequence[str], inputs: Rows, unit: SlaveConfig) -> tuple[SlaveConfig, ...]:
        """Return one node for each joint, with these inputs and the unit's watchdog, then the mechanical unit."""
        watchdog_s = 1e-3 * unit.device.watchdog_ms
        return (*(node(name, "joint", JOINT_OUTPUTS, inputs, watchdog_s) for name in joints), unit)

    def findings(self, arm: ArmFile) -> Iterator[Finding]:
        """Yield the keys that need a capability which the bus lacks, and an invalid address."""
        name = self.interface
        if name != VIRTUAL and not is_address(name):
            yield Finding(("bus", "interface"), "interface", found=name, allowed=f"{VIRTUAL}, or an IPv4 address")
        if arm.drive_mode == "cst" or arm.control_mode == "torque":
            key, mode = ("drive_mode", arm.drive_mode) if arm.drive_mode == "cst" else ("control_mode", "torque")
            yield Finding((key,), "torque_on_bus", found=mode, bus=self.kind, lack=self.LACKS["torque"])
        for key, reaction in vars(arm.stops).items():
            if reaction == "torque_off":
                yield Finding(("stops", key), "torque_off_on_bus", found=reaction, bus=self.kind)
        if arm.gripper is not None and arm.gripper.joint is not None:
            yield Finding(("gripper", "joint"), "drive_on_bus", bus=self.kind)
        if arm.external_axes:
            yield Finding(("external_axes",), "drive_on_bus", bus=self.kind)


@dataclass(frozen=True)
class EgmBus(ControllerBus):
    """ABB's Externally Guided Motion: the controller sends a message every few ms and gets an answer to each."""

    kind: Name = "egm"
    interface: Name = VIRTUAL
    """`virtual`, or the IPv4 address of this host to which the controller sends; `0.0.0.0`: any."""
    segment: str = "irc5.yaml"
    """File of the virtual controller, relative to the arm's file."""
    lost_cycles: Annotated[int, Ge(1), Le(1000)] = 3
    """Count of missing messages that is a fault: each counts 1, each received one takes off 1/10."""
    timeout_scale: Annotated[float, Ge(1), Le(100)] = 15.0
    """Factor on time limits on the virtual bus, where the host may be slow: [real time](realtime.md)."""
    port: Annotated[int, Ge(1), Le(65535)] = 6511
    """UDP port: that of the unit's UdpUc device, one for each mechanical unit."""
    controller: str = ""
    """IPv4 address of the controller; none: the first sender, until it falls silent."""
    unit: Name = "robot"
    """Name of the mechanical unit in records and status."""
    comm_timeout_s: Annotated[float, Gt(0), Le(1)] = 0.2
    """CommTimeout of EGMSetupUC, s: time after the last answer at which the controller stops."""

    MASTER: ClassVar[str] = "rtcp.fieldbus.egm:EgmMaster"

    UNIT_INPUTS: ClassVar[Rows] = (
        ("motors", "uint8", ""),
        ("rapid", "uint8", ""),
        ("mci", "uint8", ""),
        ("converged", "uint8", ""),
        ("collision", "uint8", ""),
        ("utilization", "float64", "%"),
        ("move_index", "uint32", ""),
        ("session", "uint32", ""),
        ("lost", "uint32", ""),
        ("doubled", "uint32", ""),
        ("disordered", "uint32", ""),
        ("superseded", "uint32", ""),
        ("foreign", "uint32", ""),
        *((f"measured_force_{axis}", "float64", "N") for axis in "xyz"),
        *((f"measured_torque_{axis}", "float64", "Nm") for axis in "xyz"),
        *((f"path_deviation_{axis}", "float64", "m") for axis in "xyz"),
        *CONTROLLER_STATUS[:1],
    )
    """Numbers of `motors`, `rapid` and `mci` are EGM's (docs/abb.md). `path_deviation`: the flange as measured minus as
    planned by the controller. Force and torque are no numbers (nan) while no sensor sends them. Counters count messages
    since the start. EGM tells neither the emergency stop nor the key."""

    def at_controller(self, address: str) -> EgmBus:
        """As `ControllerBus`. The controller sends to this host: at any of its addresses where the file names none."""
        interface = _ANY_ADDRESS if self.interface == VIRTUAL else self.interface
        return replace(self, interface=interface, controller=address)

    def nodes(self, joints: Sequence[str], period_us: float) -> tuple[SlaveConfig, ...]:
        """Return the joints and the mechanical unit."""
        inputs = (*JOINT_INPUTS, ("velocity", "float64", "rad/s"))
        unit = node(self.unit, "generic", (), self.UNIT_INPUTS, self.comm_timeout_s)
        return self.joints_and_unit(joints, inputs, unit)

    def findings(self, arm: ArmFile) -> Iterator[Finding]:
        """Yield the values that EGM does not support."""
        yield from super().findings(arm)
        if len(arm.joints) not in (6, 7):
            yield Finding(("joints",), "joints_of_egm", found=len(arm.joints))
        if (lost_s := self.lost_cycles * arm.cycle.period_us * 1e-6) > self.comm_timeout_s:
            wanted = f"at most bus.comm_timeout_s, {self.comm_timeout_s:g} s: the controller stops by itself then"
            unit = f" cycles, {lost_s:g} s"
            yield Finding(("bus", "lost_cycles"), "lost_cycles", found=self.lost_cycles, unit=unit, allowed=wanted)
        period, rest = arm.cycle.period_us, arm.cycle.period_us % EGM_PERIOD_US
        if min(rest, EGM_PERIOD_US - rest) > 0.02 * EGM_PERIOD_US or period < 0.9 * EGM_PERIOD_US:
            yield Finding(("cycle", "period_us"), "period_of_egm", found=period, period_us=EGM_PERIOD_US)


EGM_PERIOD_US = 4032.0
"""The controller's own period: \\SampleRate 4 is 4.032 ms (3HAC073318-001)."""


@dataclass(frozen=True)
class RapidBus(ControllerBus):
    """RAPID streaming: joint targets by Simple Message to a program on the controller, which queues them."""

    kind: Name = "rapid"
    interface: Name = VIRTUAL
    """`virtual`, or the controller's IPv4 address."""
    segment: str = "irc5_rapid.yaml"
    """File of the virtual controller, relative to the arm's file."""
    lost_cycles: Annotated[int, Ge(1), Le(1000)] = 10
    """Number of cycles without a state message that is a fault: in a row, or in excess of those with one."""
    timeout_scale: Annotated[float, Ge(1), Le(100)] = 3.0
    """Factor on time limits on the virtual bus, where the host may be slow: [real time](realtime.md)."""
    motion_port: Annotated[int, Ge(1), Le(65535)] = 11000
    """TCP port of the motion server."""
    state_port: Annotated[int, Ge(1), Le(65535)] = 11002
    """TCP port of the state server."""
    unit: Name = "robot"
    """Name of the mechanical unit in records and status."""
    state_period_s: Positive = 0.05
    """Longest interval between two state messages, s; later cycles count as lost until the next message."""
    answer_timeout_s: Positive = 1.0
    """Time without answer to a point or a heartbeat, or without state, after which a connection counts as lost, s."""
    board: str = ""
    """Name of the controller's board of 16 inputs and 16 outputs, as a DSQC 652; then it is an IO box."""

    MASTER: ClassVar[str] = "rtcp.fieldbus.rapid:RapidMaster"
    HAS_ONE_CONNECTION: ClassVar[bool] = True

    UNIT_INPUTS: ClassVar[Rows] = (
        ("accepted", "uint32", ""),
        ("refused", "uint32", ""),
        ("waiting", "uint8", ""),
        ("acceptance_s", "float64", "s"),
        *CONTROLLER_STATUS,
    )
    """Points accepted and refused since the start; whether one waits, and how long the last acceptance took."""
    UNIT_OUTPUTS: ClassVar[Rows] = (("motors_order", "uint8", ""),)
    """A change to 1 orders Motors On, which the controller carries out in automatic mode only; a change to 2 Motors
    Off."""

    def nodes(self, joints: Sequence[str], period_us: float) -> tuple[SlaveConfig, ...]:
        """Return the joints and the mechanical unit."""
        unit = node(self.unit, "generic", self.UNIT_OUTPUTS, self.UNIT_INPUTS, self.answer_timeout_s)
        nodes = self.joints_and_unit(joints, JOINT_INPUTS, unit)
        if not self.board:
            return nodes
        return (*nodes, node(self.board, "io", BOARD_OUTPUTS, BOARD_INPUTS, self.answer_timeout_s))

    def findings(self, arm: ArmFile) -> Iterator[Finding]:
        """Yield the values that RAPID streaming does not support."""
        yield from super().findings(arm)
        if self.board in (self.unit, *(joint.name for joint in arm.joints)):
            yield Finding(("bus", "board"), "repeated", found=self.board, what="name", of="the unit or a joint")
