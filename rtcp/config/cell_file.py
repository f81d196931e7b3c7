"""The file of a cell (`config/cell.yaml`), checked whole together with those of its arms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from annotated_types import MaxLen, MinLen

from rtcp.config.cell import Base, CellArm, CellConfig, CellProcess, CellSettings, Member, is_platform_name
from rtcp.config.document import Finding, read
from rtcp.config.loader import load
from rtcp.config.model import ConfigError
from rtcp.config.validation import Checker, rule

MOST_ARMS = 8


@dataclass(frozen=True)
class _CellFile(CellSettings):
    arms: Annotated[tuple[CellArm, ...], MinLen(2), MaxLen(MOST_ARMS)] = field(kw_only=True)
    processes: Annotated[tuple[CellProcess, ...], MaxLen(MOST_ARMS)] = ()


@rule(_CellFile, "arms", "processes")
def _names(cell: _CellFile) -> Iterator[Finding]:
    first: dict[str, str] = {}
    members: dict[str, Sequence[CellArm | CellProcess]] = {"arms": cell.arms, "processes": cell.processes}
    for key, i, name in ((key, i, one.name) for key, group in members.items() for i, one in enumerate(group)):
        if not is_platform_name(name):
            allowed = "a letter, then letters, digits, - and _, at most 32"
            yield (key, i, "name"), f'found the text "{name}", allowed is {allowed}'
        elif first.setdefault(name, f"{key}[{i}]") != f"{key}[{i}]":
            yield (key, i, "name"), f'found "{name}", the name of {first[name]}; each needs its own'


_CELL = Checker(_CellFile)


def load_cell(path: Path) -> CellConfig:
    """Read the file of a cell and those of its arms.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    found = _CELL.read(read(path))
    mistakes: list[str] = []

    def members(kind: str, entries: Sequence[CellArm | CellProcess]) -> Iterator[Member]:
        for one in entries:
            try:
                config = load(path.parent / one.config)
            except ConfigError as error:
                mistakes.extend(f"{path}: {kind} {one.name}: {sentence}" for sentence in str(error).splitlines())
                continue
            if (kind == "arm") != bool(config.joints):
                has = "joints: it belongs under arms" if config.joints else "no joints: it belongs under processes"
                mistakes.append(f"{path}: {kind} {one.name}: {one.config} has {has}")
            yield Member(one.name, config, one.base if isinstance(one, CellArm) else Base())

    arms, processes = tuple(members("arm", found.arms)), tuple(members("process", found.processes))
    if mistakes:
        raise ConfigError(mistakes)
    return CellConfig(found.name, found.share, found.silence_s, found.clearance, arms, path, processes)
