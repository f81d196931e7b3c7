"""A YAML file as plain values, with the line of every key.

Scalars follow YAML 1.2's core schema and not 1.1, whose `on`, `1:30` and `010` become a boolean, 90 and 8, and whose
`1e-3` stays a text. Repeated keys, which YAML forbids and most readers accept, are mistakes.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
)
from ruamel.yaml.reader import ReaderError

from rtcp.config.findings import Finding, KeyPath
from rtcp.config.model import ConfigError

_LARGEST, _MOST_VALUES, _DEEPEST = 1 << 20, 20_000, 50
"""Limits of a file, in bytes or characters, values and levels: an alias counts as all of its content."""
_LONGEST_NUMBER = 100
"""Most characters of an integer; Python refuses to convert some thousand."""
_KINDS = {
    stat.S_IFDIR: "a directory", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}  # fmt: skip
_CONSTANTS = {"": None, "~": None, "null": None, "Null": None, "NULL": None, "true": True, "True": True, "TRUE": True,
              "false": False, "False": False, "FALSE": False}  # fmt: skip
_OPEN = object()
"""Value of an anchor whose end is not read yet."""
_SURROGATE = re.compile("[\ud800-\udfff]")
_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)|0x[0-9a-fA-F]+|0o[0-7]+")
_FLOAT = re.compile(
    r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)


@dataclass
class Document:
    """The content of one file: `data` holds dict, list, str, int, float, bool and None only."""

    path: Path
    data: Any = None
    lines: dict[KeyPath, int] = field(default_factory=dict)
    """Line (from 1) of each key or list entry."""
    unusual: set[KeyPath] = field(default_factory=set)
    """Keys whose value is marked as intended although it looks like one in another unit, see `take_marks`."""

    def line(self, where: KeyPath) -> int:
        """Return the line of a key, or of the nearest one above it that exists."""
        while where and where not in self.lines:
            where = where[:-1]
        return self.lines.get(where, 1)

    def take_marks(self) -> None:
        """Replace each `{value: VALUE, unusual: true}` by its value, and add its key to `unusual`."""
        self.data = self._unmarked(self.data, ())

    def _unmarked(self, value: Any, where: KeyPath) -> Any:
        if isinstance(value, list):
            return [self._unmarked(entry, (*where, i)) for i, entry in enumerate(value)]
        if not isinstance(value, dict):
            return value
        if value.keys() == {"value", "unusual"} and value["unusual"] is True:
            self.unusual.add(where)
            return value["value"]
        return {key: self._unmarked(entry, (*where, key)) for key, entry in value.items()}

    def empty_keys(self) -> set[KeyPath]:
        """Return the keys that have no value."""
        return set(_empty(self.data, ()))

    def placed(self, findings: Iterable[Finding]) -> list[Finding]:
        """Return the findings with file and line, in the order of the lines."""
        placed = [finding.at(self.path, self.line(finding.where)) for finding in findings]
        return sorted(placed, key=lambda finding: finding.line or 0)


def _empty(value: Any, where: KeyPath) -> Iterator[KeyPath]:
    if value is None:
        yield where
    elif isinstance(value, list | dict):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _empty(entry, (*where, key))


def read(path: Path) -> Document:
    """Read a YAML file whose top level is a mapping.

    Raises:
        ConfigError: the file is missing, unreadable, no regular file, or no text; or as `parse`.
    """
    return parse(text_of(path), path)


def parse(text: str, path: Path) -> Document:
    """Return the document of a YAML text; `path` is named in the findings.

    Raises:
        ConfigError: it is no YAML, empty, no mapping, larger than any configuration, or repeats keys.
    """
    known = _parsed(text, path)
    return Document(path, deepcopy(known.data), dict(known.lines))


@lru_cache(maxsize=64)
def _parsed(text: str, path: Path) -> Document:
    """As `parse`. Remembered because a simulation reads the same files again for every arm that it makes."""
    document = Document(path)
    builder = _Builder(text, document.lines)
    try:
        document.data = builder.document()
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = (mark.line + 1, mark.column + 1) if mark else ()
        raise ConfigError([Finding((), "not_yaml", reason=_reason(error)).at(path, *place)]) from error
    except ReaderError as error:
        finding = Finding((), "control_character", found=ord(text[error.position]))
        raise ConfigError([finding.at(path, text.count("\n", 0, error.position) + 1)]) from error
    except _TooMuch as error:
        raise ConfigError([error.finding.at(path)]) from error
    if document.data is None and not builder.findings:
        raise _unusable(path, "empty_file", need="a mapping of keys to values is")
    if not isinstance(document.data, dict):
        kind = "a list" if isinstance(document.data, list) else "a single value"
        raise ConfigError([Finding((), "no_mapping", found=kind).at(path, 1)])
    if builder.findings:
        raise ConfigError(document.placed(builder.findings))
    return document


def text_of(path: Path) -> str:
    """Return the content of a text file.

    Raises:
        ConfigError: the file is missing, unreadable, no regular file, no text, or larger than any configuration.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
        # Checked before the file is opened: opening a pipe waits for its other end.
        if kind != stat.S_IFREG:
            raise _unusable(path, "no_regular_file", found=_KINDS.get(kind, "something else"))
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise _unusable(path, "too_large", limit=_LARGEST, what="bytes")
        return content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise _unusable(path, "no_file") from error
    except OSError as error:
        raise _unusable(path, "unreadable", reason=error.strerror) from error
    except UnicodeDecodeError as error:
        raise _unusable(path, "not_utf8", found=error.object[error.start], byte=error.start) from error


def _unusable(path: Path, code: str, **fields: object) -> ConfigError:
    return ConfigError([Finding((), code, **fields).at(path)])


def _reason(error: MarkedYAMLError) -> str:
    problem = error.problem or "unknown"
    if "'\\t'" in problem or "tab" in problem:
        return "a tab cannot indent; use spaces"
    return f"{problem} {error.context}" if error.context else problem


class _TooMuch(Exception):
    """The file, or its content with aliases expanded, is larger than any configuration."""

    def __init__(self, code: str, **fields: object) -> None:
        self.finding = Finding((), code, **fields)


class _Builder:
    """Turns YAML's events into values, with their lines and findings."""

    def __init__(self, text: str, lines: dict[KeyPath, int]) -> None:
        self.findings: list[Finding] = []
        self._events: Iterator[Any] = YAML(typ="safe", pure=True).parse(text)
        self._lines = lines
        self._values = self._characters = self._depth = 0
        self._anchors: dict[str, object] = {}

    def document(self) -> object:
        """Return the value of the only document; None where there is none."""
        for event in self._events:
            if isinstance(event, StreamEndEvent):
                return None
            if isinstance(event, DocumentStartEvent):
                break
        value = self._value(next(self._events), ())
        next(self._events)
        if not isinstance(after := next(self._events), StreamEndEvent):
            raise MarkedYAMLError(problem="found a second document", problem_mark=after.start_mark)
        return value

    def _count(self, text: str = "") -> None:
        """Count a value, or the characters of its text; raises _TooMuch beyond a limit."""
        self._values += not text
        self._characters += len(text)
        for used, limit, unit in (
            (self._values, _MOST_VALUES, "values"),
            (self._characters, _LARGEST, "characters"),
        ):
            if used > limit:
                hint = "; an alias counts as everything that it stands for"
                raise _TooMuch("too_large", limit=limit, what=unit, hint=hint)
        if self._depth >= _DEEPEST:
            raise _TooMuch("too_deep")

    def _value(self, event: Any, where: KeyPath) -> object:
        self._lines.setdefault(where, event.start_mark.line + 1)
        if isinstance(event, AliasEvent):
            return self._alias(event, where)
        if event.anchor is not None:
            self._anchors[event.anchor] = _OPEN
        self._count()
        if event.tag is not None:
            self.findings.append(Finding(where, "tag", found=event.tag))
        self._depth += 1
        value: object
        if isinstance(event, MappingStartEvent):
            value = self._mapping(where)
        elif isinstance(event, SequenceStartEvent):
            value = self._sequence(where)
        else:
            value = self._scalar(event, where)
        self._depth -= 1
        if event.anchor is not None:
            self._anchors[event.anchor] = value
        return value

    def _alias(self, event: AliasEvent, where: KeyPath) -> object:
        if event.anchor not in self._anchors:
            raise MarkedYAMLError(problem=f"found undefined alias {event.anchor!r}", problem_mark=event.start_mark)
        value = self._anchors[event.anchor]
        if value is _OPEN:
            self.findings.append(Finding(where, "endless_alias"))
            return None
        self._count_again(value)
        return value

    def _count_again(self, value: object) -> None:
        self._count()
        self._depth += 1
        if isinstance(value, str):
            self._count(value)
        elif isinstance(value, list | dict):
            for inner in value if isinstance(value, list) else (*value, *value.values()):
                self._count_again(inner)
        self._depth -= 1

    def _sequence(self, where: KeyPath) -> list[object]:
        values: list[object] = []
        while not isinstance(event := next(self._events), SequenceEndEvent):
            values.append(self._value(event, (*where, len(values))))
        return values

    def _mapping(self, where: KeyPath) -> dict[str, object]:
        values: dict[str, object] = {}
        while not isinstance(event := next(self._events), MappingEndEvent):
            line = event.start_mark.line + 1
            key = self._value(event, (*where, "?"))
            self._lines.pop((*where, "?"))
            if not isinstance(key, str):
                text = event.value if isinstance(event, ScalarEvent) else "a list or mapping"
                self.findings.append(Finding(where, "key_no_text", found=text, at=line))
                self._value(next(self._events), where)
                continue
            inner = (*where, key)
            if key in values:
                self.findings.append(Finding(inner, "key_twice", first=self._lines[inner], at=line))
                self._value(next(self._events), inner)
                continue
            self._lines[inner] = line
            values[key] = self._value(next(self._events), inner)
        return values

    def _scalar(self, event: ScalarEvent, where: KeyPath) -> object:
        text = str(event.value)
        self._count(text)
        if lone := _SURROGATE.search(text):
            self.findings.append(Finding(where, "half_character", found=ord(lone[0])))
            return ""
        if event.tag is not None or not event.implicit[0]:
            return text
        if text in _CONSTANTS:
            return _CONSTANTS[text]
        if _INTEGER.fullmatch(text):
            if len(text) > _LONGEST_NUMBER:
                self.findings.append(Finding(where, "long_number", found=len(text), limit=_LONGEST_NUMBER))
                return None
            return int(text) if text.lstrip("+-").isdigit() else int(text, 0)
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan")) if _FLOAT.fullmatch(text) else text
