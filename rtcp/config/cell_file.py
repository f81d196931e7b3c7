"""The file of a cell (`config/cell.yaml`), checked together with those of its arms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from annotated_types import MaxLen, MinLen

from rtcp.config.buses import ControllerBus, EgmBus, RapidBus
from rtcp.config.cell import (
    Base,
    CellArm,
    CellConfig,
    CellController,
    CellProcess,
    CellSettings,
    Member,
    is_platform_name,
)
from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.loader import load
from rtcp.config.model import ConfigError
from rtcp.config.validation import Checker, repeated, rule

MOST_ARMS = 8


@dataclass(frozen=True)
class _CellFile(CellSettings):
    arms: Annotated[tuple[CellArm, ...], MinLen(2), MaxLen(MOST_ARMS)] = field(kw_only=True)
    processes: Annotated[tuple[CellProcess, ...], MaxLen(MOST_ARMS)] = ()


@rule(_CellFile, "arms", "processes")
def _names(cell: _CellFile) -> Iterator[Finding]:
    members: dict[str, Sequence[CellArm | CellProcess]] = {"arms": cell.arms, "processes": cell.processes}
    names = [((key, i, "name"), member.name) for key, group in members.items() for i, member in enumerate(group)]
    for where, name in names:
        if not is_platform_name(name):
            allowed = "a letter, then letters, digits, - and _, at most 32"
            yield Finding(where, "platform_name", found=name, allowed=allowed)
    yield from repeated(names, "name")


@rule(_CellFile, "arms", "controllers")
def _controllers(cell: _CellFile) -> Iterator[Finding]:
    names = [arm.name for arm in cell.arms]
    for i, controller in enumerate(cell.controllers):
        for j, name in enumerate(controller.arms):
            if name not in names:
                where = ("controllers", i, "arms", j)
                yield Finding(where, "choice", found=name, allowed=f"one of {', '.join(names)}")
    arms = [
        (("controllers", i, "arms", j), name)
        for i, controller in enumerate(cell.controllers)
        for j, name in enumerate(controller.arms)
    ]
    yield from repeated(arms, "arm")


_CELL = Checker(_CellFile)


def is_cell_file(path: Path) -> bool:
    """Return whether a file is that of a cell: it lists arms.

    Raises:
        ConfigError: it cannot be read.
    """
    data = read(path).data
    return isinstance(data, dict) and "arms" in data


def load_cell(path: Path) -> CellConfig:
    """Read the file of a cell and those of its arms.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    file = _CELL.read(read(path))
    mistakes: list[Finding] = []

    def members(kind: str, entries: Sequence[CellArm | CellProcess]) -> Iterator[Member]:
        for entry in entries:
            try:
                config = load(path.parent / entry.config)
            except ConfigError as error:
                mistakes.extend(finding.within(f"{path}: {kind} {entry.name}: ") for finding in error.findings)
                continue
            if (kind == "arm") != bool(config.joints):
                has = "joints: it belongs under arms" if config.joints else "no joints: it belongs under processes"
                wrong = Finding((), "wrong_group", file=entry.config, has=has)
                mistakes.append(wrong.within(f"{path}: {kind} {entry.name}: "))
            yield Member(entry.name, config, entry.base if isinstance(entry, CellArm) else Base())

    arms, processes = tuple(members("arm", file.arms)), tuple(members("process", file.processes))
    if not mistakes:
        arms = _with_controllers(path, file.controllers, arms, mistakes)
    if mistakes:
        raise ConfigError(mistakes)
    return CellConfig(file.name, file.share, file.silence_s, file.clearance, file.controllers, arms, path, processes)


def _with_controllers(
    path: Path, controllers: Sequence[CellController], arms: tuple[Member, ...], mistakes: list[Finding]
) -> tuple[Member, ...]:
    """Return the arms with the settings that follow from their place at a controller."""
    by_name = {arm.name: arm for arm in arms}
    for i, controller in enumerate(controllers):
        first = by_name[controller.arms[0]].config.bus
        for j, name in enumerate(controller.arms):
            bus = by_name[name].config.bus
            where = f"{path}: controllers[{i}].arms: {name}: "
            if not isinstance(bus, ControllerBus) or (bus.kind, bus.interface) != (first.kind, first.interface):
                need = f"the kind and the interface of {controller.arms[0]}, and a bus to a robot controller"
                mistakes.append(
                    Finding((), "one_controller", found=f"{bus.kind} {bus.interface}", need=need).within(where)
                )
                continue
            if isinstance(bus, EgmBus) and isinstance(first, EgmBus):
                bus = replace(bus, port=first.port + j)
            if isinstance(bus, RapidBus) and bus.board and j:
                mistakes.append(Finding((), "board_of_first", found=bus.board, first=controller.arms[0]).within(where))
            bus = replace(bus, segment=controller.segment or first.segment)
            by_name[name] = replace(by_name[name], config=replace(by_name[name].config, bus=bus))
    return tuple(by_name[arm.name] for arm in arms)
