"""Checks plain values against a frozen dataclass: pydantic detects the mistakes, this module words them.

Rules between values are attached to the dataclasses with `@rule`; those of the platform's files are in
`rtcp.config.rules`. Only the launcher, the gateway, the segment and the commands load this module, the loop never.
"""

from __future__ import annotations

import difflib
import json
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from functools import cached_property
from typing import Annotated, Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError, core_schema

from rtcp.config.document import Document
from rtcp.config.findings import Finding, KeyPath, dotted
from rtcp.config.model import ConfigError
from rtcp.config.numbers import FractionOfPi

T = TypeVar("T")
Rule = Callable[[T], Iterable[Finding]]
EVERY_KEY = "*"
R = TypeVar("R", bound=Callable[[Any], Iterable[Finding]])

# Strict: "500" and true are no numbers, 2.5 is no integer.
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class FileRule:
    """A rule of a whole file and the keys that must be valid for it."""

    needs: tuple[str, ...]
    check: Rule[Any]


_FILE_RULES: dict[type, list[FileRule]] = {}


def rule(kind: type[T], *needs: str) -> Callable[[R], R]:
    """Attach a rule to a dataclass: it yields the mistakes of an object whose values all have the right types.

    With `needs`, the rule is one of a whole file: it runs if these keys are valid, even if others are not; `EVERY_KEY`:
    if all are.
    """

    def attach(check: R) -> R:
        if needs:
            _FILE_RULES.setdefault(kind, []).append(FileRule(needs, check))
        else:
            # The model must not import pydantic: its hook for a class's own schema is added here.
            setattr(kind, "__get_pydantic_core_schema__", staticmethod(_schema_with(check)))  # noqa: B010
        return check

    return attach


def _schema_with(check: Rule[Any]) -> Callable[[Any, Any], Any]:
    def run(value: Any) -> Any:
        wrong: list[InitErrorDetails] = [
            {"type": PydanticCustomError("rule", "rule", {"finding": finding}), "loc": finding.where, "input": None}
            for finding in check(value)
        ]
        if wrong:
            raise ValidationError.from_exception_data("rules", wrong)
        return value

    def schema(source: Any, handler: Any) -> Any:
        inner = handler(source)
        # The reference moves to the schema with the rule: pydantic looks it up where the class is used again.
        return core_schema.no_info_after_validator_function(run, inner, ref=inner.pop("ref", None))

    return schema


class Checker(Generic[T]):
    """Makes objects of one frozen dataclass from plain values, or lists every mistake in them."""

    def __init__(self, kind: type[T], renamed: Mapping[str, str] | None = None) -> None:
        """Check a `kind`; `renamed` maps the dotted paths of old keys to their new names."""
        self.kind = kind
        self._renamed = renamed or {}

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        return _adapter_of(self.kind)

    @cached_property
    def _partial(self) -> TypeAdapter[Any]:
        """Checks the valid part of a file: every key may be left out."""
        hints = get_type_hints(self.kind, include_extras=True)
        required = [
            (key.name, Union[hints[key.name], None], field(default=None))  # noqa: UP007
            for key in fields(self.kind)  # type: ignore[arg-type]
            if key.default is MISSING and key.default_factory is MISSING
        ]
        return _adapter_of(make_dataclass(self.kind.__name__, required, bases=(self.kind,), frozen=True, kw_only=True))

    def check(self, data: object, *more: FileRule) -> tuple[T | None, list[Finding]]:
        """Return the object, or None and every mistake; `more` rules are checked with those of the file."""
        findings: list[Finding] = []
        invalid: set[object] = set()
        value: T | None = None
        try:
            value = _validated(self._adapter, data)
        except ValidationError as error:
            # Pydantic counts the valid entries of a list alone: a list with wrong entries may still be long enough.
            kept = [
                detail
                for detail in error.errors(include_url=False)
                if detail["type"] != "too_short" or len(detail["input"]) < detail["ctx"]["min_length"]
            ]
            findings = [
                self._finding(detail["type"], detail["loc"][1:], detail["input"], detail.get("ctx")) for detail in kept
            ]
            invalid = {detail["loc"][1] for detail in kept if len(detail["loc"]) > 1}
        findings += self._file_findings(value, data, invalid, more)
        return (None if findings else value), findings

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of such a file, for editors; it has no rules between values."""
        adapted = self._adapter.json_schema()
        schema: dict[str, Any] = _with_pi({"$defs": adapted["$defs"], **adapted["items"]})
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}

    def read(self, document: Document, *more: FileRule) -> T:
        """Return the object of a file; `more` rules as of `check`.

        Raises:
            ConfigError: with one sentence for every mistake.
        """
        value, findings = self.check(document.data, *more)
        if value is None:
            raise ConfigError(document.placed(findings))
        return value

    def _file_findings(
        self, value: T | None, data: object, invalid: set[object], more: Iterable[FileRule]
    ) -> Iterator[Finding]:
        rules = [*(rule for kind in self.kind.__mro__ for rule in _FILE_RULES.get(kind, ())), *more]
        if not rules or not isinstance(data, dict):
            return
        if value is None:
            known = set(keys(self.kind)) - invalid
            value = _validated(self._partial, {key: entry for key, entry in data.items() if key in known})
        for rule_ in rules:
            if not (invalid if EVERY_KEY in rule_.needs else invalid.intersection(rule_.needs)):
                yield from rule_.check(value)

    def _finding(self, reason: str, where: KeyPath, value: object, context: Mapping[str, Any] | None) -> Finding:
        if reason == "rule":
            of_object: Finding = (context or {})["finding"]
            return Finding(where, of_object.code, **of_object.fields)
        if reason == "missing":
            need = f"it must be {allowed(annotation(self.kind, where))}"
            return Finding(where[:-1], "missing", key=where[-1], need=need)
        if reason == "unexpected_keyword_argument":
            if new := self._renamed.get(dotted(where)):
                return Finding(where, "renamed", new=new)
            return unknown(where, str(where[-1]), keys(annotation(self.kind, where[:-1])))
        wanted = annotation(self.kind, where)
        if reason in ("too_short", "too_long") and isinstance(value, list) and value:
            return Finding(where, "size", found=len(value), allowed=allowed(wanted))
        return Finding(
            where, _CODES.get(reason, "type"), found=value, allowed=allowed(wanted), hint=_hint(wanted, value)
        )


_CODES = (
    {"literal_error": "choice"}
    | dict.fromkeys(("string_too_short", "string_too_long", "too_short", "too_long"), "length")
    | dict.fromkeys(("finite_number", "greater_than", "greater_than_equal", "less_than", "less_than_equal"), "range")
)
"""Codes of pydantic's reasons; of the others the code is `type`."""


def _adapter_of(kind: type) -> TypeAdapter[Any]:
    # Pydantic accepts a configuration for a dataclass only from an outer type: the list around it.
    around: Any = types.GenericAlias(list, (kind,))
    return TypeAdapter(around, config=_STRICT)


def _with_pi(schema: Any) -> Any:
    """Return a schema whose numbers may be written with pi."""
    if isinstance(schema, list):
        return [_with_pi(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("type") == "number":
        return {"anyOf": [schema, {"type": "string", "pattern": "pi"}]}
    return {key: _with_pi(value) for key, value in schema.items()}


def _validated(adapter: TypeAdapter[Any], data: object) -> Any:
    """Return the object, read from JSON: strict mode then turns lists into tuples and mappings into dataclasses."""
    return adapter.validate_json(json.dumps([data]))[0]


def annotation(kind: object, where: KeyPath) -> object:
    """Return the type, with its bounds, of the value at a key path below a dataclass."""
    for key in where:
        bare = bare_type(kind)
        if is_dataclass(bare):
            kind = get_type_hints(bare, include_extras=True)[str(key)]
        else:
            kind = get_args(bare)[0 if isinstance(key, int) else 1]
    return kind


def keys(kind: object) -> list[str]:
    """Return the keys of a dataclass."""
    return [field.name for field in fields(bare_type(kind))]


def unknown(where: KeyPath, name: str, known: Iterable[str], noun: str = "key") -> Finding:
    """Return the finding of a key, or another name, that does not exist."""
    close = difflib.get_close_matches(name, known := list(known), n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return Finding(where, "unknown", what=noun, found=name, allowed=known, hint=hint)


Place = tuple[KeyPath, object]
"""A value and its keys."""


def repeated(places: Iterable[Place], noun: str) -> Iterator[Finding]:
    """Yield each place whose value is also at an earlier one."""
    first: dict[object, KeyPath] = {}
    for where, value in places:
        if (before := first.setdefault(value, where)) != where:
            yield Finding(where, "repeated", found=value, what=noun, of=dotted(before))


def allowed(kind: object) -> str:
    """Return the values that a type with its bounds allows, in words: `an integer from 0 to 255`."""
    bounds = {type(bound): bound for bound in _bounds(kind)}
    bare = bare_type(kind)
    if get_origin(bare) is Literal:
        return f"one of {', '.join(str(choice) for choice in get_args(bare))}"
    if bare in (int, float):
        also = ", or a fraction of pi, as -pi/2 or 11*pi/12" if FractionOfPi in bounds else ""
        return ("an integer" if bare is int else "a number") + _span(bounds) + also
    if bare is bool:
        return "true or false"
    if bare is str:
        return "a text" + (f" of 1 to {bounds[MaxLen].max_length} characters" if MaxLen in bounds else "")
    if get_origin(bare) is tuple:
        of = {float: "numbers", int: "integers"}.get(bare_type(get_args(bare)[0]), "entries")
        if MinLen in bounds and MaxLen in bounds:
            least, most = bounds[MinLen].min_length, bounds[MaxLen].max_length
            return f"a list of {least}{'' if least == most else f' to {most}'} {of}"
        if MaxLen in bounds:
            return f"a list of at most {bounds[MaxLen].max_length} {of}"
        return "a list" + (" with at least one entry" if MinLen in bounds else "")
    if is_dataclass(bare):
        return f"a mapping with the keys {', '.join(keys(bare))}"
    return "a mapping"


def bare_type(kind: object) -> Any:
    """Return a type without its bounds and without None."""
    if get_origin(kind) is Annotated:
        return bare_type(get_args(kind)[0])
    if get_origin(kind) in (Union, types.UnionType):
        return bare_type(next(choice for choice in get_args(kind) if choice is not type(None)))
    return kind


def _bounds(kind: object) -> Iterable[Any]:
    if get_origin(kind) is Annotated:
        return get_args(kind)[1:]
    return _bounds(get_args(kind)[0]) if get_origin(kind) in (Union, types.UnionType) else ()


def _span(bounds: dict[type, Any]) -> str:
    def number(bound: Any) -> str:
        return f"{bound:g}" if isinstance(bound, float) else str(bound)

    if Ge in bounds and Le in bounds:
        return f" from {number(bounds[Ge].ge)} to {number(bounds[Le].le)}"
    limits = []
    if Gt in bounds:
        limits.append(f"greater than {number(bounds[Gt].gt)}")
    if Ge in bounds:
        limits.append(f"of at least {number(bounds[Ge].ge)}")
    if Lt in bounds:
        limits.append(f"less than {number(bounds[Lt].lt)}")
    if Le in bounds:
        limits.append(f"at most {number(bounds[Le].le)}")
    return " " + " and ".join(limits) if limits else ""


def _hint(wanted: object, value: object) -> str:
    """Return a hint on how YAML reads a value that looks right to its writer."""
    bare = bare_type(wanted)
    if isinstance(value, str) and bare in (int, float):
        try:
            float(int(value, 0)) if value[:2].lower() == "0x" else float(value)
        except ValueError:
            return "; write the number alone, the key names its unit" if len(value.split()) == 2 else ""
        leading_zero = len(value) > 1 and value[0] == "0" and value[1].isdigit()
        return f"; write it without {'leading zeros' if leading_zero else 'quotes'}"
    if isinstance(value, str) and bare is bool and value.lower() in ("yes", "no", "on", "off"):
        return "; yes, no, on and off are texts here"
    if isinstance(value, (int, float)) and bare is str:
        return "; write it in quotes"
    if isinstance(value, (int, float)) and {FractionOfPi, Le} <= {type(bound) for bound in _bounds(wanted)}:
        return "; angles are in rad: write 90 degrees as pi/2"
    return ""
