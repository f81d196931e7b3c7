"""Values in the elements of an ESI file; harmless mistakes are accepted with a warning."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

from rtcp.esi.model import EsiError
from rtcp.esi.xml_tree import Node, Warnings

LIST_LIMIT = 4096
"""PDOs of a direction, entries of a PDO, and the like."""
NAME_LIMIT = 255
"""Characters of a name; more are cut, as an SII image does."""
ENGLISH = "1033"
"""LcId of English."""
_HEXADECIMAL = re.compile(r"#?x+(?:0x)?([0-9a-f]{1,16})|#([0-9a-f]{1,16})|0x([0-9a-f]{1,16})", re.IGNORECASE)
_DECIMAL = re.compile(r"[+-]?\d{1,20}", re.ASCII)
_HEX_BYTES = re.compile(r"(?:[0-9a-f]{2})*", re.IGNORECASE)
_TRUE = {"1": True, "true": True, "0": False, "false": False, "": False}
_T = TypeVar("_T")


def number(text: str | None) -> int | None:
    """Return an integer of an ESI file: `#x1A`, `0x1A`, `26`, `#x0x1A`; None: it is none."""
    text = (text or "").strip()
    if _DECIMAL.fullmatch(text):
        return int(text)
    match = _HEXADECIMAL.fullmatch(text)
    return int(match[1] or match[2] or match[3], 16) if match else None


def name_of(node: Node, tag: str = "Name") -> str:
    """Return a name in English; in the language without a number, or the first, where there is none in English."""
    names = [name for name in node.below(tag) if name.text]
    for language in (ENGLISH, None, "0"):
        for name in names:
            if name.attributes.get("LcId") == language:
                return name.text[:NAME_LIMIT]
    return names[0].text[:NAME_LIMIT] if names else ""


class Values:
    """Reads values; keeps the warnings. A path is that of `Node.value`."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.warnings = Warnings(path)

    def error(self, node: Node, problem: str) -> EsiError:
        """Return an error at an element."""
        return EsiError(f"{self.path}:{node.line}", problem)

    def number(
        self, node: Node, path: str, default: int | None = None, low: int = -(1 << 63), high: int = (1 << 64) - 1
    ) -> int:
        """Return a number from low to high; without a default it must be there."""
        text = node.value(path)
        value = number(text)
        if value is None:
            if default is None:
                problem = f"{path} is {text[:40]!r}, not a number" if text else f"{path} is missing"
                raise self.error(node, f"{node.tag}: {problem}")
            if text:
                self.warnings.add(node.line, f"{node.tag}: {path} is {text[:40]!r}, not a number; {default} is used")
            value = default
        if not low <= value <= high:
            raise self.error(node, f"{node.tag}: {path} is {value}; it can be {low} to {high}")
        return value

    def flag(self, node: Node, path: str) -> bool:
        """Return whether an attribute is set."""
        text = (node.value(path) or "").strip().lower()
        if text in _TRUE:
            return _TRUE[text]
        self.warnings.add(node.line, f"{node.tag}: {path} is {text[:40]!r}, neither true nor false")
        return bool((number(text) or 0) & 1)

    def data(self, node: Node, path: str, limit: int = 1 << 16) -> bytes:
        """Return the bytes of an element in hexadecimal, as far as they are such."""
        text = re.sub(r"[\s,]|#x|0x", "", node.value(path) or "", flags=re.IGNORECASE)
        match = _HEX_BYTES.match(text)
        digits = match[0] if match else ""
        if len(digits) != len(text):
            self.warnings.add(node.line, f"{node.tag}: {path} is {text[:40]!r}, not bytes in hexadecimal; it is cut")
        return bytes.fromhex(digits)[:limit]

    def each(self, nodes: list[Node], build: Callable[[Node], _T | None]) -> tuple[_T, ...]:
        """Return the results of `build` for the elements, without failed ones."""
        if len(nodes) > LIST_LIMIT:
            raise self.error(nodes[0], f"{len(nodes)} elements {nodes[0].tag}; there can be {LIST_LIMIT}")
        return tuple(item for item in map(build, nodes) if item is not None)
