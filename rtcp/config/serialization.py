"""Frozen dataclasses to JSON values and back, without the validator: the launcher passes an `ArmConfig` to the loop so.

Fields keep their names, tuples become lists, paths and enum members their text. Round trips are exact.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from rtcp.config.buses import bus_class
from rtcp.config.find import class_of_kind
from rtcp.config.model import BusConfig, ProcessConfig

T = TypeVar("T")
_hints = cache(get_type_hints)


def to_json(value: object) -> Any:
    """Return the JSON form of a dataclass, tuple, path, enum member or scalar; floats may be infinite."""
    if is_dataclass(value):
        return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple | list):
        return [to_json(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    return value.value if isinstance(value, Enum) else value


def from_json(kind: type[T], data: object) -> T:
    """Return the object of this type whose JSON form, by `to_json`, is `data`.

    Types are checked, ranges are not: the writer has validated them.

    Raises:
        ValueError: a key is missing or unknown, or a value has another type; the message names the key.
    """
    value: T = _typed(kind, data, kind.__name__)
    return value


def _typed(kind: Any, data: object, where: str) -> Any:
    if is_dataclass(kind):
        if kind is BusConfig and isinstance(data, Mapping):
            kind = bus_class(str(data.get("kind")))
        if kind is ProcessConfig and isinstance(data, Mapping):
            kind = class_of_kind(ProcessConfig, ProcessConfig.ENTRY_POINTS, str(data.get("kind")))
        return _dataclass(kind, data, where)
    origin, choices = get_origin(kind), get_args(kind)
    if hasattr(kind, "_fields") and isinstance(data, list) and len(data) == len(kind._fields):
        hints = _hints(kind)
        return kind(
            *(_typed(hints[name], entry, f"{where}.{name}") for name, entry in zip(kind._fields, data, strict=True))
        )
    if origin is tuple and isinstance(data, list):
        if choices[-1] is Ellipsis:
            return tuple(_typed(choices[0], entry, f"{where}[{i}]") for i, entry in enumerate(data))
        if len(choices) == len(data):
            entries = zip(choices, data, strict=True)
            return tuple(_typed(choice, entry, f"{where}[{i}]") for i, (choice, entry) in enumerate(entries))
    elif origin is dict and isinstance(data, Mapping):
        return {str(key): _typed(choices[1], entry, f"{where}.{key}") for key, entry in data.items()}
    elif origin in (Union, types.UnionType):
        if data is None and type(None) in choices:
            return None
        (inner,) = (choice for choice in choices if choice is not type(None))
        return _typed(inner, data, where)
    elif origin is Literal:
        if data in choices:
            return data
    elif isinstance(kind, type) and issubclass(kind, Path):
        if isinstance(data, str):
            return kind(data)
    elif isinstance(kind, type) and issubclass(kind, Enum):
        return kind(data)
    elif kind is float:
        # JSON of other writers does not distinguish 1 and 1.0.
        if isinstance(data, float | int) and not isinstance(data, bool):
            return float(data)
    elif type(data) is kind:
        return data
    raise ValueError(f"{where}: found {data!r:.60}, which is no {getattr(kind, '__name__', kind)}")


def _dataclass(kind: Any, data: object, where: str) -> Any:
    hints = _hints(kind)
    names = [field.name for field in fields(kind)]
    if not isinstance(data, Mapping) or isinstance(data, Sequence):
        raise ValueError(f"{where}: found {data!r:.60}, which is no mapping")
    if wrong := set(names) ^ set(data):
        raise ValueError(f"{where}: missing or unknown keys: {', '.join(sorted(map(str, wrong)))}")
    return kind(**{name: _typed(hints[name], data[name], f"{where}.{name}") for name in names})
