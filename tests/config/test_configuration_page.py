"""docs/configuration.md against the dataclasses that the arm's file is read into."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import pytest
import yaml

from rtcp.config import default_config
from rtcp.config.loader import ArmFile
from rtcp.config.model import Joint
from rtcp.config.validation import allowed

PAGE = Path(__file__).resolve().parents[2] / "docs" / "configuration.md"
UNITS = {"", "m", "m/s", "m/s²", "m/s³", "rad", "rad/s", "rad/s²", "rad/s³", "Nm", "Nm/rad", "Nm s/rad", "Nm/(rad s)",
         "kg", "s", "ms", "us", "1/s"}  # fmt: skip


class Row(NamedTuple):
    """A key as the page and the dataclasses say it."""

    key: str
    allowed: str
    default: str


def shown(default: object) -> str:
    if default is MISSING:
        return "required"
    if default is None or default == ():
        return "none"
    if isinstance(default, tuple):
        return f"[{', '.join(f'{value:g}' for value in default)}]"
    return f"{default:g}" if isinstance(default, int | float) else str(default)


def keys_of(kind: Any, above: str = "") -> Iterator[Row]:
    """Every key below a dataclass; `[]` stands for each entry of a list."""
    hints = get_type_hints(kind, include_extras=True)
    for entry in fields(kind):
        key, wanted = above + entry.name, hints[entry.name]
        bare = bare_type(wanted)
        inner = bare_type(get_args(bare)[0]) if get_args(bare) and getattr(bare, "__origin__", None) is tuple else None
        if inner is not None and is_dataclass(inner):
            yield from keys_of(inner, f"{key}[].")
        elif is_dataclass(bare) and (bare is not Joint or not above):
            yield from keys_of(bare, f"{key}.")
        else:
            default = entry.default if entry.default_factory is MISSING else entry.default_factory()
            yield Row(key, allowed(wanted), shown(default))


def table_rows() -> list[list[str]]:
    lines = [line.strip() for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if len(row) == 5]


def test_the_page_has_every_key_with_what_is_allowed_and_its_default() -> None:
    said = [Row(key.strip("`"), wanted, default) for key, _, wanted, default, _ in table_rows()]
    wanted = list(keys_of(ArmFile))
    assert sorted(said) == sorted(wanted)
    assert len({row.key for row in said}) == len(said)


def test_every_key_has_a_meaning_and_a_unit_of_the_si_or_none() -> None:
    for key, unit, _, _, meaning in table_rows():
        assert unit in UNITS, key
        assert meaning, key
    without = {row[0] for row in table_rows() if not row[1] and row[2].startswith("a number")}
    assert without == {
        "`bus.receive_fraction`", "`bus.send_phase`", "`bus.timeout_scale`", "`supervision.speed`", "`supervision.torque`",
    }  # fmt: skip


def test_every_key_of_the_shipped_file_is_on_the_page() -> None:
    def places(node: object, where: str) -> Iterator[str]:
        if isinstance(node, dict):
            for key, value in node.items():
                yield from places(value, f"{where}.{key}" if where else key)
        elif isinstance(node, list) and node and isinstance(node[0], dict):
            for value in node:
                yield from places(value, f"{where}[]")
        else:
            yield where

    known = {row[0].strip("`") for row in table_rows()}
    assert set(places(yaml.safe_load(default_config().read_text()), "")) <= known


@pytest.mark.parametrize("link", re.findall(r"\]\(([^)#:]+)\)", PAGE.read_text()))
def test_what_the_page_links_to_is_there(link: str) -> None:
    assert (PAGE.parent / link).exists()
