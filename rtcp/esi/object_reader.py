"""The object dictionary of an ESI file: objects, their data types and values."""

from __future__ import annotations

from typing import NamedTuple

from rtcp.esi import types
from rtcp.esi.model import DictionaryObject, EsiError, ObjectCode, ObjectEntry
from rtcp.esi.values import LIST_LIMIT, Values, name_of, number
from rtcp.esi.xml_tree import Node

ENTRY_LIMIT = 200_000
"""Subindexes in all dictionaries of a file; a type that many objects share counts with each."""
_MAX_BITS = 1 << 22
_STATES = (("PREOP", "P"), ("SAFEOP", "S"), ("OP", "O"))


class FileTooLarge(EsiError):
    """The file exceeds a limit; reading stops."""


class _Part(NamedTuple):
    """A subindex of a type."""

    sub_index: int
    node: Node
    type: str
    bits: int
    element: bool
    """True: element of an array."""


class ObjectReader:
    """Reads the dictionaries of a file's devices and modules."""

    def __init__(self, values: Values) -> None:
        self._values = values
        self._entries = 0

    def dictionary(self, node: Node) -> tuple[DictionaryObject, ...]:
        """Return the objects of a device or module, of all its profiles."""
        objects: dict[int, DictionaryObject] = {}
        warn = self._values.warnings.add
        for dictionary in node.below("Profile/Dictionary"):
            data_types: dict[str, Node] = {}
            for item in dictionary.below("DataTypes/DataType"):
                data_types.setdefault(item.value("Name") or "", item)
            for item in dictionary.below("Objects/Object"):
                try:
                    built = self._object(item, data_types)
                except EsiError as error:
                    warn(item.line, f"an object is left out: {error.problem}")
                    continue
                if built.index in objects:
                    warn(item.line, f"object 0x{built.index:04X} occurs twice; the first is used")
                    continue
                objects[built.index] = built
                self._entries += len(built.entries)
                if self._entries > ENTRY_LIMIT:
                    where = f"{self._values.path}:{item.line}"
                    raise FileTooLarge(where, f"dictionaries of more than {ENTRY_LIMIT} subindexes")
        return tuple(objects[index] for index in sorted(objects))

    def _object(self, node: Node, data_types: dict[str, Node]) -> DictionaryObject:
        values = self._values
        index = values.number(node, "Index", low=0, high=0xFFFF)
        type_name = node.value("Type") or ""
        data_type = data_types.get(type_name)
        nodes = data_type.below("SubItem") if data_type is not None else []
        info, flags = node.first("Info"), node.first("Flags")
        code = ObjectCode.VARIABLE
        if not nodes:
            part = _Part(0, node, type_name, values.number(node, "BitSize", 0), False)
            entries = [self._entry(part, name_of(node), flags, info, data_types)]
        else:
            parts = self._parts(nodes, data_types)
            code = ObjectCode.ARRAY if any(part.element for part in parts) else ObjectCode.RECORD
            sub_items = _matched(info.below("SubItem") if info is not None else [], parts)
            by_number: dict[int, ObjectEntry] = {}
            for part, item in zip(parts, sub_items, strict=True):
                name = (name_of(item) if part.element and item is not None else "") or name_of(part.node)
                own = item.first("Info") if item is not None else part.node
                entry = self._entry(part, name, part.node.first("Flags") or flags, own, data_types)
                by_number.setdefault(part.sub_index, entry)
            entries = [by_number[sub_index] for sub_index in sorted(by_number)]
        return DictionaryObject(index, name_of(node), code, tuple(entries), values.flag(node, "Index/@DependOnSlot"))

    def _parts(self, nodes: list[Node], data_types: dict[str, Node]) -> list[_Part]:
        """Return the subindexes of a type; an array's elements one by one."""
        values = self._values
        parts: list[_Part] = []
        for node in nodes:
            type_name = node.value("Type") or ""
            bits = values.number(node, "BitSize", 0)
            array = data_types[type_name].first("ArrayInfo") if type_name in data_types else None
            following = parts[-1].sub_index + 1 if parts else 0
            if number(node.value("SubIdx")) is None and array is not None:
                count = values.number(array, "Elements", 0, low=0, high=255)
                first = max(values.number(array, "LBound", 1), following, 1)
                element = data_types[type_name].value("BaseType") or ""
                known = types.named(element)  # the length of the whole array is wrong in some files
                element_bits = known.bits if known is not None and known.bits else bits // max(count, 1)
                parts += [_Part(first + i, node, element, element_bits, True) for i in range(min(count, 256 - first))]
            else:
                sub_index = values.number(node, "SubIdx", following, low=0, high=255)
                parts.append(_Part(sub_index, node, type_name, bits, False))
            if len(parts) > LIST_LIMIT:
                raise values.error(node, f"a type of more than {LIST_LIMIT} subindexes")
        if not parts:
            raise values.error(nodes[0], "a type without subindexes")
        return parts

    def _entry(
        self, part: _Part, name: str, flags: Node | None, info: Node | None, data_types: dict[str, Node]
    ) -> ObjectEntry:
        base, bits = self._base_type(part, data_types)
        access = flags.value("Access") if flags is not None else None
        rights = (access or "ro").lower()
        states = ((flags.value("Access/@WriteRestrictions") if flags is not None else None) or "").upper().split("_")
        mapping = ((flags.value("PdoMapping") if flags is not None else None) or "").upper()
        unit = number(info.value("Unit")) if info is not None else None
        return ObjectEntry(
            sub_index=part.sub_index,
            name=name,
            type=base.name,
            bits=bits,
            readable=rights != "wo",
            writable=rights in ("rw", "wo"),
            write_states="".join(letter for state, letter in _STATES if state in states),
            rx_mappable="R" in mapping,
            tx_mappable="T" in mapping,
            default=self._value_of(info, base, "Default", name),
            minimum=self._value_of(info, base, "Min", name),
            maximum=self._value_of(info, base, "Max", name),
            unit=None if unit is None else unit & 0xFFFFFFFF,
        )

    def _base_type(self, part: _Part, data_types: dict[str, Node]) -> tuple[types.BaseType, int]:
        """Return the base type under a name of the file, and its length."""
        name, bits = part.type, part.bits
        for _ in range(8):  # types that name each other in a circle end here
            base_type, declared = types.named(name), data_types.get(name)
            bits = bits or (base_type.bits if base_type is not None else 0)
            bits = bits or (self._values.number(declared, "BitSize", 0) if declared is not None else 0)
            base = declared.value("BaseType") if declared is not None else None
            if base_type is not None or not base:
                break
            name = base
        if not 0 <= bits <= _MAX_BITS:
            raise self._values.error(part.node, f"{part.node.tag} of {bits} bits")
        base_type = types.resolve(name, bits)
        return base_type, bits or base_type.bits

    def _value_of(self, info: Node | None, base: types.BaseType, attribute: str, name: str) -> bytes | None:
        """Return a value of `Info`: data, a text or a number; a number's bytes have the type's length."""
        if info is None:
            return None
        warn = self._values.warnings.add
        data: bytes | None = None
        if info.first(f"{attribute}Data") is not None:
            data = self._values.data(info, f"{attribute}Data")
        elif text := info.value(f"{attribute}String"):
            data = text.encode("utf-8", "replace")
        elif text := info.value(f"{attribute}Value"):
            try:
                value: types.Value | None = text if base.kind in (types.Kind.TEXT, types.Kind.REAL) else number(text)
                data = types.encode(base, float(text) if value is None else value)
            except (EsiError, ValueError):
                warn(info.line, f"{name}: {attribute}Value {text[:40]!r} is no {base.name}; it is left out")
        if data and base.size and base.kind not in (types.Kind.TEXT, types.Kind.BYTES):
            if any(data[base.size :]):
                warn(info.line, f"{name}: {attribute}Data has {len(data)} bytes, the type {base.size}; it is cut")
            data = data[: base.size].ljust(base.size, b"\0")
        return data


def _matched(infos: list[Node], parts: list[_Part]) -> list[Node | None]:
    """Return the values of each subindex: by position, as their names often differ; by name where some are missing."""
    if len(infos) < len(parts):
        named = {name_of(info): info for info in reversed(infos)}
        by_name = [named.get(name_of(part.node)) for part in parts]
        if sum(value is not None for value in by_name) == len(infos):
            return list(by_name)
    return [infos[position] if position < len(infos) else None for position in range(len(parts))]
