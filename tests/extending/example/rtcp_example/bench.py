"""A bus of another kind: a bench whose joints are numbers in the loop's process, and follow within a cycle."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from rtcp.config.buses import JOINT_INPUTS, JOINT_OUTPUTS, node
from rtcp.config.model import ArmConfig, BusConfig, SlaveConfig
from rtcp.config.numbers import Name
from rtcp.fieldbus.master import Master
from rtcp.ipc.states import DriveState, Missing

OUTPUTS, INPUTS = struct.Struct("<ddB"), struct.Struct("<dBB")


@dataclass(frozen=True)
class BenchBus(BusConfig):
    """The keys under `bus` of an arm on a bench."""

    kind: Name = "bench"
    interface: Name = "bench"
    start: float = 0.0
    """Position of all joints at the start, rad."""

    MASTER: ClassVar[str] = "rtcp_example.bench:BenchMaster"
    LACKS: ClassVar = {
        "sdo": "a bench has no objects",
        "states": "a bench has no slaves",
        "clocks": "a bench has no distributed clocks",
        "torque": "a bench knows no torque",
    }

    def nodes(self, joints: Sequence[str], period_us: float) -> tuple[SlaveConfig, ...]:
        return tuple(node(name, "joint", JOINT_OUTPUTS, JOINT_INPUTS, watchdog_s=0.1) for name in joints)


class BenchData:
    """Process data: what was sent in a cycle is measured in the next."""

    expected_wkc = 1
    dc_time = missed = stale = 0

    def __init__(self, joints: int, start: float) -> None:
        self.positions = [start] * joints

    def send(self) -> None:
        pass

    def receive(self) -> int:
        return 1

    def input(self, index: int) -> bytes:
        return INPUTS.pack(self.positions[index], DriveState.OPERATION_ENABLED, Missing.NOTHING)

    def set_output(self, index: int, data: bytes) -> None:
        position, _, command = OUTPUTS.unpack(data)
        if command:
            self.positions[index] = position


class BenchMaster(Master):
    """The loop's side of a bench."""

    @staticmethod
    def check_interface(name: str) -> None:
        pass

    def start(self, directory: Path, report: Callable[[str], None]) -> BenchData:
        config: ArmConfig = self.config
        assert isinstance(config.bus, BenchBus)
        report(f"a bench of {len(config.joints)} joints")
        return BenchData(len(config.joints), config.bus.start)

    def close(self) -> None:
        pass
