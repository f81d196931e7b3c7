"""A cell: several arms on one host, the places of their bases, and shared settings. `cell_file` reads its file."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

from rtcp.config.model import ArmConfig, ConfigError
from rtcp.config.numbers import Name, Turn, Vector
from rtcp.config.serialization import to_json

_PATHS = ("source", "directory", "file")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}", re.ASCII)


@dataclass(frozen=True)
class Base:
    """Pose of an arm's base in the world."""

    position: Vector = (0.0, 0.0, 0.0)
    """x, y, z, m."""
    rpy: Annotated[tuple[Turn, ...], MinLen(3), MaxLen(3)] = (0.0, 0.0, 0.0)
    """rx, ry, rz, rad: R = Rx(rx) Ry(ry) Rz(rz)."""


@dataclass(frozen=True)
class CellArm:
    """An arm of the cell: a platform of its own."""

    name: Name
    """Name of the platform: `rtcp --name NAME status`."""
    config: Name
    """File of the arm, relative to this file."""
    base: Base = field(default_factory=Base)


@dataclass(frozen=True)
class CellProcess:
    """A platform of processes beside motion, without an arm."""

    name: Name
    """Name of the platform."""
    config: Name
    """Its file, relative to this file."""


@dataclass(frozen=True)
class Share:
    """Settings that the arms share."""

    emergency_stop: bool = True
    """Whether the emergency stop of one arm is that of all."""


@dataclass(frozen=True)
class CellController:
    """A robot controller with several arms of the cell: its mechanical units."""

    arms: Annotated[tuple[Name, ...], MinLen(2), MaxLen(4)]
    """Names of the arms, in the order of the units. The platform of the first holds what the arms share: the connection
    of RAPID streaming, and the virtual controller. By EGM the UDP port of each arm is one above that of the arm before,
    from `bus.port` of the first."""
    segment: str = ""
    """File of the virtual controller, beside the arm's file; left out: `bus.segment` of the first arm."""


@dataclass(frozen=True)
class CellSettings:
    """Settings both of a cell's file and of the configuration that its loops receive."""

    name: Name
    """Name of the cell."""
    share: Share = field(default_factory=Share)
    silence_s: Annotated[float, Gt(0), Le(0.5)] | None = None
    """Largest age of a partner's newest record in a motion in step, s; left out: two cycles of the slowest arm."""
    clearance: Annotated[float, Ge(0), Le(1)] = 0.02
    """Distance that bodies of two arms keep, m."""
    controllers: tuple[CellController, ...] = ()
    """Robot controllers that have several of the arms; an arm that none names has a controller of its own."""


@dataclass(frozen=True)
class Member:
    """An arm as its partners see it."""

    name: str
    config: ArmConfig
    base: Base
    directory: Path = Path()
    """Runtime directory of its platform."""


@dataclass(frozen=True)
class ControllerUnits:
    """The arms of one robot controller, and which of them is this platform's."""

    members: tuple[Member, ...]
    """In the order of the mechanical units."""
    index: int


@dataclass(frozen=True)
class CellConfig(CellSettings):
    """A cell with the configurations of its arms, in the order of the file, and the file."""

    arms: tuple[Member, ...] = ()
    source: Path = Path()
    processes: tuple[Member, ...] = ()
    """Platforms of processes beside motion."""

    @property
    def members(self) -> tuple[Member, ...]:
        """All platforms: the arms, then those of processes."""
        return self.arms + self.processes

    def member(self, name: str) -> Member:
        """Return the platform with this name; raises ConfigError."""
        for member in self.members:
            if member.name == name:
                return member
        names = ", ".join(member.name for member in self.members)
        text = f'{self.source}: found no arm with the name "{name}", allowed is one of {names}'
        raise ConfigError([text], "choice")

    def units_of(self, name: str) -> ControllerUnits | None:
        """Return the arms of the controller of an arm; None: it has one of its own."""
        for controller in self.controllers:
            if name in controller.arms:
                return ControllerUnits(tuple(map(self.member, controller.arms)), controller.arms.index(name))
        return None

    @property
    def slowest_s(self) -> float:
        """Longest cycle among the arms, s."""
        return 1e-6 * max(arm.config.cycle.period_us for arm in self.arms)

    @property
    def digest(self) -> int:
        """64-bit hash of the content of the cell and its files, without their paths."""
        text = json.dumps(_without_paths(to_json(self)), sort_keys=True)
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")

    @property
    def longest_silence_s(self) -> float:
        """Largest age of a partner's newest record, s."""
        return 2.0 * self.slowest_s if self.silence_s is None else self.silence_s


def _without_paths(value: Any) -> Any:
    """Return a JSON value without the paths of files."""
    if isinstance(value, dict):
        return {key: _without_paths(item) for key, item in value.items() if key not in _PATHS}
    return [_without_paths(item) for item in value] if isinstance(value, list) else value


def is_platform_name(name: str) -> bool:
    """Return whether a platform may have this name: it names a directory, beside `lock`, and a namespace of ROS."""
    return _NAME.fullmatch(name) is not None and name != "lock"
