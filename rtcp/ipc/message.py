"""Frozen dataclasses as bytes of a fixed size: the form in which commands, refusals and events cross shared memory.

A field is an int, a float, a bool, an IntEnum, `Joints`, or a text. A reader with the same registry gets an equal
object.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import mmap
import re
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeAlias, TypeVar

from rtcp.config.model import MOST_AXES

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:
    # typing has it from Python 3.11 on, and typing_extensions is no dependency of the loop's process.
    def dataclass_transform(**_: bool) -> Callable[[type], type]:  # noqa: D103
        return lambda kind: kind


Joints: TypeAlias = tuple[float, ...]
"""One number a joint, at most `MOST_AXES`."""
TEXT_SIZE = 496
"""Bytes of a text (UTF-8) of a message."""
PAYLOAD_SIZE = TEXT_SIZE + 16
"""Bytes of the largest message: a text and two more fields."""

_CODES: dict[object, str] = {int: "q", float: "d", bool: "?", str: f"{TEXT_SIZE}s"}
_JOINTS = struct.Struct(f"<q{MOST_AXES}d")
_PADDING = (0.0,) * MOST_AXES


class MalformedMessage(ValueError):
    """Bytes that are no message: unknown number, or an invalid field."""


@dataclass_transform(frozen_default=True)
class Message:
    """Base of all families. A subclass is a frozen dataclass; its `name` and `number` identify it in every process.

    `class Halt(Command)` registers a kind, `class MotionCommand(Command, abstract=True)` does not. The docstring of a
    refusal or an event is its message: a format string of its fields and of the words of `rtcp.ipc.names`.
    """

    name: ClassVar[str]
    number: ClassVar[int]
    kinds: ClassVar[Kinds[Any]]
    """All kinds of the family."""
    field_types: ClassVar[dict[str, Any]]
    """Types of the fields by their names."""
    cuts_texts: ClassVar[bool] = False
    """Whether a longer text is cut; else it is refused."""
    _format: ClassVar[struct.Struct]

    def __init_subclass__(cls, *, abstract: bool = False, number: int | None = None) -> None:
        """Make the class a dataclass and register it.

        Args:
            abstract: a base of others: not registered.
            number: of the kind; None: derived from its name.

        Raises:
            ValueError: the number is taken, or a field's type cannot be packed.
        """
        # Comparison and text are those below: made for each of 220 kinds they slow every start down.
        dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
        if abstract:
            return
        cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
        cls.number = zlib.crc32(cls.name.encode()) if number is None else number
        cls.field_types = {field.name: _type_of(cls, field) for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
        cls._format = struct.Struct("<" + "".join(map(_code, cls.field_types.values())))
        if cls._format.size > PAYLOAD_SIZE:
            raise ValueError(f"{cls.name}: {cls._format.size} bytes, at most {PAYLOAD_SIZE} fit")
        cls.kinds.add(cls)

    @property
    def _values(self) -> tuple[Any, ...]:
        return tuple([getattr(self, name) for name in self.field_types])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Message) or type(other) is not type(self):
            return NotImplemented
        return self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    def __repr__(self) -> str:
        values = zip(self.field_types, self._values, strict=True)
        return f"{type(self).__qualname__}({', '.join(f'{name}={value!r}' for name, value in values)})"

    def pack_into(self, memory: mmap.mmap | bytearray, at: int) -> None:
        """Write the fields, `PAYLOAD_SIZE` bytes at most.

        Raises:
            ValueError: more joints than `MOST_AXES`, or a text that is too long.
        """
        values: list[Any] = []
        for name, kind in self.field_types.items():
            value = getattr(self, name)
            if kind != Joints:
                if kind is str and len(value := value.encode(errors="replace")) > TEXT_SIZE and not self.cuts_texts:
                    raise ValueError(f"{self.name}.{name}: {len(value)} bytes, at most {TEXT_SIZE} fit")
                values.append(value)
                continue
            if len(value) > MOST_AXES:
                raise ValueError(f"{self.name}.{name}: {len(value)} joints, at most {MOST_AXES} fit")
            values.append(_JOINTS.pack(len(value), *value, *_PADDING[len(value) :]))
        self._format.pack_into(memory, at, *values)

    def as_json(self) -> dict[str, Any]:
        """Return the fields for JSON; enums by their names in lower case."""
        values = ((name, getattr(self, name)) for name in self.field_types)
        return {name: value.name.lower() if isinstance(value, IntEnum) else value for name, value in values}


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
            return kind(*(_decoder(hint)(value) for hint, value in zip(kind.field_types.values(), values, strict=True)))
        except Exception as error:  # the class of another package may check its fields
            raise MalformedMessage(f"{kind.name}: {error}") from None


def _type_of(cls: type[Message], field: dataclasses.Field[Any]) -> Any:
    """Return the type of a field; `get_type_hints` would evaluate all annotations of all bases, for each kind."""
    if not isinstance(field.type, str):
        return field.type
    owner = next(base for base in cls.__mro__ if field.name in inspect.get_annotations(base))
    return _evaluated(owner.__module__, field.type)


@functools.cache
def _evaluated(module: str, annotation: str) -> Any:
    return eval(annotation, vars(sys.modules[module]))


def _code(kind: object) -> str:
    if kind == Joints:
        return f"{_JOINTS.size}s"
    if isinstance(kind, type) and issubclass(kind, IntEnum):
        return "q"
    if kind not in _CODES:
        raise ValueError(f"a field of the type {kind} cannot be packed")
    return _CODES[kind]


def _decoder(kind: Any) -> Callable[[Any], Any]:
    if kind == Joints:
        return _joints
    return _text if kind is str else kind if issubclass(kind, IntEnum) else _as_is


def _joints(packed: bytes) -> Joints:
    count, *values = _JOINTS.unpack(packed)
    if not 0 <= count <= MOST_AXES:
        raise MalformedMessage(f"{count} joints, at most {MOST_AXES} are possible")
    return tuple(values[:count])


def _text(packed: bytes) -> str:
    return packed.rstrip(b"\0").decode(errors="replace")


def _as_is(value: Any) -> Any:
    return value
