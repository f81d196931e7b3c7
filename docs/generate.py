"""Writes the generated parts of these pages: `python docs/generate.py`; a test holds pages and code together.

A generated part stands between `<!-- generated: NAME ARGUMENTS -->` and `<!-- end -->`; NAME is one of `PARTS`.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent))

from rtcp.config import model, segment  # noqa: E402
from rtcp.config.validation import allowed, bare_type  # noqa: E402
from rtcp.processes.shape_setting import interlocks  # noqa: E402
from rtcp.processes.shape_setting.config import ShapeSettingConfig  # noqa: E402

_PART = re.compile(r"(<!-- generated: ([^\n]+) -->\n).*?(<!-- end -->)", re.DOTALL)
_REQUIREMENT = re.compile(r'    "(?!rtcp)([\w.-]+)(.*)",(?:  # (.+))?')
"""A dependency in pyproject.toml: name, versions and marker, reason."""
_FILES: dict[str, tuple[type, str]] = {
    "arm": (model.ArmFile, ""),
    "device": (model.DeviceDescription, ""),
    "segment": (segment.SegmentFile, ""),
    "motion": (model.MotionFile, ""),
    "shape_setting": (ShapeSettingConfig, "processes[]."),
}


class Key(NamedTuple):
    """A key of a configuration file; `[]` in its path stands for each entry of a list."""

    path: str
    allowed: str
    default: str
    meaning: str


@cache
def _meanings(kind: type) -> dict[str, str]:
    """Return the attribute docstrings of a dataclass, those of its bases among them."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = ast.parse(inspect.getsource(base)).body[0]
        assert isinstance(body, ast.ClassDef)
        for entry, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name) and isinstance(after, ast.Expr):
                found[entry.target.id] = inspect.cleandoc(ast.literal_eval(after.value)).replace("\n", " ")
    return found


def keys_of(kind: Any, above: str = "") -> Iterator[Key]:
    """Yield every key below a dataclass, in the order of its fields."""
    hints = get_type_hints(kind, include_extras=True)
    for entry in fields(kind):
        path, bare = above + entry.name, bare_type(hints[entry.name])
        # The other kinds of bus have a page of their own.
        bare = model.EthercatBus if bare is model.BusConfig else bare
        inner = bare_type(get_args(bare)[0]) if get_origin(bare) is tuple else None
        if is_dataclass(inner):
            yield from keys_of(inner, f"{path}[].")
        # A gripper's joint has the keys of the others.
        elif is_dataclass(bare) and not (bare is model.Joint and above):
            yield from keys_of(bare, f"{path}.")
        else:
            default = entry.default if entry.default_factory is MISSING else entry.default_factory()
            meaning = _meanings(kind).get(entry.name, "")
            words = "the keys of one of `joints`" if is_dataclass(bare) else allowed(hints[entry.name])
            yield Key(path, words, _shown(default), meaning)


def _shown(default: object) -> str:
    if default is MISSING:
        return "required"
    if default in (None, (), {}, ""):
        return "none"
    if isinstance(default, tuple):
        return f"[{', '.join(_shown(value) for value in default)}]"
    if isinstance(default, bool):
        return str(default).lower()
    return f"{default:g}" if isinstance(default, int | float) else str(default)


def keys(file: str, *sections: str) -> str:
    """Return the table of keys of the arm's, a device's or the segment's file, or of these sections of it."""
    wanted = [key for key in keys_of(*_FILES[file]) if not sections or re.split(r"[.[]", key.path)[0] in sections]
    return table(
        ["key", "allowed", "default", "meaning"],
        [[f"`{key.path}`", key.allowed, key.default, key.meaning] for key in wanted],
    )


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def machine(part: str) -> str:
    """Return a table of the state machine or of the stop reactions of the shipped arm."""
    from docs import machine_page
    from rtcp.config import default_config, load

    if part == "diagram":
        return f"```mermaid\n{machine_page.diagram()}\n```"
    if part == "reactions":
        return machine_page.reactions(load(default_config()))
    markdown: str = getattr(machine_page, part)()
    return markdown


def methods(part: str) -> str:
    """Return the table of the methods of the control socket, or of the refusals or events that errors name."""
    if part == "table":
        from rtcp.gateway.methods import documented

        rows = [
            [
                f"`{method.name}`{' *' * method.at_once}",
                ", ".join(_parameter(*parameter) for parameter in _parameters(method.parameters)),
                _line(method.about),
            ]
            for method in documented()
        ]
        return table(["method", "parameters", "what it does"], rows)
    from rtcp.ipc.events import EVENTS
    from rtcp.ipc.refusals import REFUSALS

    kinds: Any = {"refusals": REFUSALS, "events": EVENTS}[part]
    return table(
        ["name", "fields", "message"],
        [
            [f"`{kind.name}`", ", ".join(entry.name for entry in fields(kind)) or "none", _line(kind.__doc__)]
            for kind in sorted(kinds, key=lambda kind: kind.name)
            if kind.__module__.startswith("rtcp.")
        ],
    )


def dependencies(section: str) -> str:
    """Return the table of the dependencies in this list of pyproject.toml."""
    project = (FOLDER.parent / "pyproject.toml").read_text()
    lines = re.search(rf"^{section} = \[\n(.*?)^\]", project, re.DOTALL | re.MULTILINE)
    assert lines is not None
    matches = [match for match in map(_REQUIREMENT.fullmatch, lines[1].splitlines()) if match]
    return table(
        ["package", "versions", "reason"],
        [[name, f"`{limits}`" if limits else "any", why] for name, limits, why in map(re.Match.groups, matches)],
    )


def _parameters(kind: type) -> Iterator[tuple[str, str, object]]:
    hints = get_type_hints(kind, include_extras=True)
    for entry in fields(kind):
        yield entry.name, allowed(hints[entry.name]), entry.default


def _parameter(name: str, words: str, default: object) -> str:
    given = "" if default is MISSING else "; default none" if default is None else f"; default {_shown(default)}"
    return f"`{name}` ({words}{given})"


def _line(text: str | None) -> str:
    return " ".join(inspect.cleandoc(text or "").split()).replace("|", "\\|")


PARTS: dict[str, Callable[..., str]] = {
    "dependencies": dependencies,
    "keys": keys,
    "machine": machine,
    "methods": methods,
    "interlocks": interlocks.markdown,
}


def generated(text: str) -> str:
    """Return a page with its generated parts as they have to be."""

    def part(match: re.Match[str]) -> str:
        name, *arguments = match[2].split()
        return f"{match[1]}\n{PARTS[name](*arguments).strip()}\n\n{match[3]}"

    return _PART.sub(part, text)


def main() -> None:
    """Rewrite every page that has generated parts."""
    for page in sorted(FOLDER.glob("*.md")):
        text = page.read_text()
        if (new := generated(text)) != text:
            page.write_text(new)
            print(f"{page.name}: written")


if __name__ == "__main__":
    main()
