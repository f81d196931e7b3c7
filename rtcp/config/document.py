"""A YAML file as plain values, with the line of every key.

Scalars are read as YAML 1.2's core schema says and not as 1.1, whose `on`, `1:30` and `010` turn into a boolean, 90
and 8, and whose `1e-3` stays a text. Repeated keys, which YAML forbids and most readers pass over, are mistakes.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from rtcp.config.errors import ConfigError

KeyPath = tuple[str | int, ...]
"""Keys and list positions from the top of a file to a value."""

Finding = tuple[KeyPath, str]
"""A mistake: where it is and the rest of its sentence."""

_LARGEST, _MOST_VALUES, _DEEPEST = 1 << 20, 20_000, 50
"""What a file may hold, in bytes or characters, values and levels: aliases count as all that they stand for."""
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@dataclass
class Document:
    """What one file says: `data` holds dict, list, str, int, float, bool and None only."""

    path: Path
    data: object = None
    lines: dict[KeyPath, int] = field(default_factory=dict)
    """Line (from 1) of each key or list entry."""

    def line(self, where: KeyPath) -> int:
        """Return the line of a key, or of the nearest one above it that is there."""
        while where and where not in self.lines:
            where = where[:-1]
        return self.lines.get(where, 1)

    def sentences(self, findings: Iterable[Finding]) -> list[str]:
        """Return one sentence a finding, `file:line: key: text`, in the order of the lines."""
        return [
            f"{self.path}:{self.line(where)}: {dotted(where)}{': ' if where else ''}{text}"
            for where, text in sorted(findings, key=lambda finding: self.line(finding[0]))
        ]


def dotted(where: KeyPath) -> str:
    """Return a key path as people write it: `joints[2].velocity`."""
    text = ""
    for key in where:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
    return text


def read(path: Path) -> Document:
    """Read a YAML file whose top level is a mapping.

    Raises:
        ConfigError: the file is missing, unreadable, no regular file, no text, no YAML, empty, no mapping, larger than
            any configuration, or repeats keys.
    """
    text = text_of(path)
    document = Document(path)
    builder = _Builder(document.lines)
    try:
        root = _Loader(text).get_single_node()
        document.data = None if root is None else builder.value(root, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{mark.line + 1}:{mark.column + 1}: " if mark else " "
        raise ConfigError([f"{path}:{place}this is not valid YAML: {_reason(error)}"]) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        found = f"{ord(text[error.position]):#04x}"
        raise ConfigError(
            [f"{path}:{line}: this is not a text file: it holds the control character {found}"]
        ) from error
    except RecursionError as error:
        raise ConfigError([f"{path}: the lists and mappings are nested too deeply"]) from error
    except _TooMuch as error:
        raise ConfigError([f"{path}: {error}"]) from error
    if root is None:
        raise ConfigError([f"{path}: the file is empty; a mapping of keys to values is expected"])
    if not isinstance(root, yaml.MappingNode):
        kind = "a list" if isinstance(root, yaml.SequenceNode) else "a single value"
        raise ConfigError([f"{path}:1: the file holds {kind}; a mapping of keys to values (`key: value`) is expected"])
    if builder.findings:
        raise ConfigError(document.sentences(builder.findings))
    return document


def text_of(path: Path) -> str:
    """Return what a file says.

    Raises:
        ConfigError: the file is missing, unreadable, no regular file, no text, or larger than any configuration.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
        # Looked at before it is opened, which would wait for the other end of a pipe.
        if kind != stat.S_IFREG:
            raise ConfigError([f"{path}: this is {_KINDS.get(kind, 'something else')}; a regular file is expected"])
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise ConfigError([f"{path}: {_holds_more_than(_LARGEST, 'bytes')}"])
        return content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise ConfigError([f"{path}: there is no such file"]) from error
    except OSError as error:
        raise ConfigError([f"{path}: the file cannot be read: {error.strerror}"]) from error
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        raise ConfigError(
            [f"{path}: this is not a text file: byte {error.start} is {byte:#04x}, which is not UTF-8"]
        ) from error


def _holds_more_than(limit: int, what: str) -> str:
    return f"the file holds more than {limit} {what}; a configuration has at most so many"


class _TooMuch(Exception):
    """The file is larger than any configuration, or unfolds to more: the rest of a sentence."""


class _Count:
    """Adds up, and ends the reading where it becomes more than a configuration has."""

    def __init__(self, limit: int, what: str) -> None:
        self._left, self._limit, self._what = limit, limit, what

    def add(self, number: int) -> None:
        self._left -= number
        if self._left < 0:
            what = f"{self._what}, an alias counted as all that it stands for"
            raise _TooMuch(_holds_more_than(self._limit, what))


def _reason(error: yaml.MarkedYAMLError) -> str:
    problem = error.problem or "unknown"
    if "'\\t'" in problem:
        return "a tab cannot indent; use spaces"
    return f"{problem} {error.context}" if error.context else problem


class _Loader(yaml.SafeLoader):
    """PyYAML's reader with the scalars of YAML 1.2."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._values = _Count(_MOST_VALUES, "values")

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._values.add(1)
        return super().compose_node(parent, index)


_LONGEST_NUMBER = 100
"""Characters of an integer; Python refuses to convert some thousand."""
_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)|0x[0-9a-fA-F]+|0o[0-7]+")
_FLOAT = re.compile(
    r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)
for _tag, _pattern, _first in (
    ("null", re.compile(r"~|null|Null|NULL|"), ["~", "n", "N", ""]),
    ("bool", re.compile(r"true|True|TRUE|false|False|FALSE"), list("tTfF")),
    ("int", _INTEGER, list("-+0123456789")),
    ("float", _FLOAT, list("-+.0123456789")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern.pattern})\Z"), _first)


class _Builder:
    """Turns YAML nodes into values, noting lines and what is not allowed."""

    def __init__(self, lines: dict[KeyPath, int]) -> None:
        self.lines = lines
        self.findings: list[Finding] = []
        self._open: list[yaml.Node] = []
        self._values = _Count(_MOST_VALUES, "values")
        self._characters = _Count(_LARGEST, "characters")

    def value(self, node: yaml.Node, where: KeyPath) -> object:
        self._values.add(1)
        if len(self._open) >= _DEEPEST:
            raise RecursionError
        self.lines.setdefault(where, node.start_mark.line + 1)
        if any(node is outer for outer in self._open):
            self.findings.append((where, "this alias contains itself"))
            return None
        self._open.append(node)
        try:
            if isinstance(node, yaml.MappingNode):
                return self._mapping(node, where)
            if isinstance(node, yaml.SequenceNode):
                return [self.value(entry, (*where, i)) for i, entry in enumerate(node.value)]
            return self._scalar(node, where)
        finally:
            self._open.pop()

    def _mapping(self, node: yaml.MappingNode, where: KeyPath) -> dict[str, object]:
        values: dict[str, object] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not (isinstance(key_node, yaml.ScalarNode) and key_node.tag == "tag:yaml.org,2002:str"):
                found = key_node.value if isinstance(key_node, yaml.ScalarNode) else "a list or mapping"
                self.findings.append((where, f"found the key {found} in line {line}; a key must be a text"))
                continue
            key = key_node.value
            self._characters.add(len(key))
            inner = (*where, key)
            if key in values:
                first = self.lines[inner]
                self.findings.append((inner, f"this key stands twice, in lines {first} and {line}; keep one of them"))
                continue
            self.lines[inner] = line
            values[key] = self.value(value_node, inner)
        return values

    def _scalar(self, node: yaml.Node, where: KeyPath) -> object:
        text = str(node.value)
        self._characters.add(len(text))
        match node.tag.removeprefix("tag:yaml.org,2002:"):
            case "str":
                return text
            case "null":
                return None
            case "bool" if text.lower() in ("true", "false"):
                return text.lower() == "true"
            case "int" if len(text) > _LONGEST_NUMBER:
                self.findings.append((where, f"this number has {len(text)} digits; allowed are {_LONGEST_NUMBER}"))
                return None
            case "int" if _INTEGER.fullmatch(text):
                return int(text) if text.lstrip("+-").isdigit() else int(text, 0)
            case "float" if _FLOAT.fullmatch(text):
                return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        self.findings.append((where, f"the tag {node.tag} is not allowed; write a plain value"))
        return None
