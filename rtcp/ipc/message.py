"""Frozen dataclasses as bytes of a fixed size: the form in which commands, refusals and events cross shared memory.

A field is an int, a float, a bool, an IntEnum, or `Joints`. Whoever knows the registry reads the same object back.
"""

from __future__ import annotations

import dataclasses
import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeAlias, TypeVar, get_type_hints

from rtcp.config.model import MOST_AXES

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:
    # typing has it from Python 3.11 on, and typing_extensions is no dependency of the loop's process.
    def dataclass_transform(**_: bool) -> Callable[[type], type]:  # noqa: D103
        return lambda kind: kind


Joints: TypeAlias = tuple[float, ...]
"""One number a joint, at most `MOST_AXES`."""
PAYLOAD_SIZE = 8 * (MOST_AXES + 6)
"""Bytes of the largest message: a number for each joint, its count, and five more fields."""

_CODES: dict[object, str] = {int: "q", float: "d", bool: "?"}
_JOINTS = struct.Struct(f"<q{MOST_AXES}d")
_PADDING = (0.0,) * MOST_AXES


class MalformedMessage(ValueError):
    """Bytes that are no message: unknown number, or a field without a meaning."""


@dataclass_transform(frozen_default=True)
class Message:
    """Base of all families. A subclass is a frozen dataclass; its `name` and `number` identify it in every process.

    `class Halt(Command)` registers a kind, `class MotionCommand(Command, abstract=True)` does not. The docstring of a
    refusal or an event is its message: a format string of its fields and of what `rtcp.ipc.names` knows.
    """

    name: ClassVar[str]
    number: ClassVar[int]
    kinds: ClassVar[Kinds[Any]]
    """All kinds of the family."""
    _format: ClassVar[struct.Struct]
    _fields: ClassVar[tuple[tuple[str, Any], ...]]

    def __init_subclass__(cls, *, abstract: bool = False, number: int | None = None) -> None:
        """Make the class a dataclass and register it.

        Args:
            abstract: a base of others: not registered.
            number: of the kind; None: one made of its name.

        Raises:
            ValueError: the number is taken, or a field's type cannot be packed.
        """
        dataclasses.dataclass(frozen=True)(cls)
        if abstract:
            return
        cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
        cls.number = zlib.crc32(cls.name.encode()) if number is None else number
        hints = get_type_hints(cls)
        cls._fields = tuple((field.name, hints[field.name]) for field in dataclasses.fields(cls))  # type: ignore[arg-type]
        cls._format = struct.Struct("<" + "".join(_code(kind) for _, kind in cls._fields))
        if cls._format.size > PAYLOAD_SIZE:
            raise ValueError(f"{cls.name}: {cls._format.size} bytes, at most {PAYLOAD_SIZE} fit")
        cls.kinds.add(cls)

    def pack_into(self, memory: mmap.mmap | bytearray, at: int) -> None:
        """Write the fields, `PAYLOAD_SIZE` bytes at most.

        Raises:
            ValueError: more joints than `MOST_AXES`.
        """
        values: list[Any] = []
        for name, kind in self._fields:
            value = getattr(self, name)
            if kind != Joints:
                values.append(value)
                continue
            if len(value) > MOST_AXES:
                raise ValueError(f"{self.name}.{name}: {len(value)} joints, at most {MOST_AXES} fit")
            values.append(_JOINTS.pack(len(value), *value, *_PADDING[len(value) :]))
        self._format.pack_into(memory, at, *values)

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON has them; enums by their names in lower case."""
        found = ((name, getattr(self, name)) for name, _ in self._fields)
        return {name: value.name.lower() if isinstance(value, IntEnum) else value for name, value in found}


M = TypeVar("M", bound=Message)


class Kinds(Generic[M]):
    """The kinds of one family of messages, by number and by name."""

    def __init__(self) -> None:
        self._by_number: dict[int, type[M]] = {}

    def __iter__(self) -> Iterator[type[M]]:
        return iter(self._by_number.values())

    def __getitem__(self, number: int) -> type[M]:
        """Return the kind of a number; raises MalformedMessage."""
        try:
            return self._by_number[number]
        except KeyError:
            raise MalformedMessage(f"no kind of message has the number {number}") from None

    def named(self, name: str) -> type[M] | None:
        """Return the kind of a name, or None."""
        return next((kind for kind in self if kind.name == name), None)

    def add(self, kind: type[M]) -> None:
        """Register a kind; raises ValueError where its number is taken."""
        if kind.number in self._by_number:
            raise ValueError(f"{kind.name}: the number {kind.number} is that of {self._by_number[kind.number].name}")
        self._by_number[kind.number] = kind

    def unpack_from(self, number: int, memory: mmap.mmap | bytes, at: int) -> M:
        """Read a message; raises MalformedMessage."""
        kind = self[number]
        values = kind._format.unpack_from(memory, at)
        try:
            return kind(*(_decoder(one)(value) for (_, one), value in zip(kind._fields, values, strict=True)))
        except ValueError as error:
            raise MalformedMessage(f"{kind.name}: {error}") from None


def _code(kind: object) -> str:
    if kind == Joints:
        return f"{_JOINTS.size}s"
    if isinstance(kind, type) and issubclass(kind, IntEnum):
        return "q"
    if kind not in _CODES:
        raise ValueError(f"a field of the type {kind} cannot be packed")
    return _CODES[kind]


def _decoder(kind: Any) -> Callable[[Any], Any]:
    return _joints if kind == Joints else kind if issubclass(kind, IntEnum) else _as_is


def _joints(packed: bytes) -> Joints:
    count, *values = _JOINTS.unpack(packed)
    if not 0 <= count <= MOST_AXES:
        raise MalformedMessage(f"{count} joints, at most {MOST_AXES} are possible")
    return tuple(values[:count])


def _as_is(value: Any) -> Any:
    return value
