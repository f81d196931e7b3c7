"""Checks plain values against a frozen dataclass: pydantic finds what is wrong, this module says what is allowed.

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

from rtcp.config.document import Document, Finding, KeyPath, dotted, shown
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

    With `needs`, the rule is one of a whole file: it runs where these keys are valid, whatever is wrong with others;
    `EVERY_KEY`: where all are.
    """

    def attach(check: R) -> R:
        if needs:
            _FILE_RULES.setdefault(kind, []).append(FileRule(needs, check))
        else:
            # The model cannot name pydantic: the method by which pydantic asks a class for its schema is put in here.
            setattr(kind, "__get_pydantic_core_schema__", staticmethod(_schema_with(check)))  # noqa: B010
        return check

    return attach


def _schema_with(check: Rule[Any]) -> Callable[[Any, Any], Any]:
    def run(value: Any) -> Any:
        wrong: list[InitErrorDetails] = [
            {"type": PydanticCustomError("rule", "{text}", {"text": text}), "loc": where, "input": None}
            for where, text in check(value)
        ]
        if wrong:
            raise ValidationError.from_exception_data("rules", wrong)
        return value

    def schema(source: Any, handler: Any) -> Any:
        inner = handler(source)
        # Its name goes to the schema with the rule: by it pydantic finds the schema where the class is used again.
        return core_schema.no_info_after_validator_function(run, inner, ref=inner.pop("ref", None))

    return schema


class Checker(Generic[T]):
    """Makes objects of one frozen dataclass out of plain values, or names every mistake in them."""

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
            (one.name, Union[hints[one.name], None], field(default=None))  # noqa: UP007
            for one in fields(self.kind)  # type: ignore[arg-type]
            if one.default is MISSING and one.default_factory is MISSING
        ]
        return _adapter_of(make_dataclass(self.kind.__name__, required, bases=(self.kind,), frozen=True, kw_only=True))

    def check(self, data: object, *more: FileRule) -> tuple[T | None, list[Finding]]:
        """Return the object, or None and every mistake; `more` rules are checked with those of the file."""
        findings: list[Finding] = []
        invalid: set[object] = set()
        made: T | None = None
        try:
            made = _validated(self._adapter, data)
        except ValidationError as error:
            # Pydantic counts the valid entries of a list: one with wrong entries is not too short for that reason.
            found = [
                detail
                for detail in error.errors(include_url=False)
                if detail["type"] != "too_short" or len(detail["input"]) < detail["ctx"]["min_length"]
            ]
            findings = [
                self._finding(detail["type"], detail["loc"][1:], detail["input"], detail["msg"]) for detail in found
            ]
            invalid = {detail["loc"][1] for detail in found if len(detail["loc"]) > 1}
        findings += self._file_findings(made, data, invalid, more)
        return (None if findings else made), findings

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of such a file, for editors; it has no rules between values."""
        found = self._adapter.json_schema()
        made: dict[str, Any] = _with_pi({"$defs": found["$defs"], **found["items"]})
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **made}

    def read(self, document: Document, *more: FileRule) -> T:
        """Return the object of a file; `more` rules as of `check`.

        Raises:
            ConfigError: with one sentence for every mistake.
        """
        made, findings = self.check(document.data, *more)
        if made is None:
            raise ConfigError(document.sentences(findings))
        return made

    def _file_findings(
        self, made: T | None, data: object, invalid: set[object], more: Iterable[FileRule]
    ) -> Iterator[Finding]:
        rules = [*(rule for kind in self.kind.__mro__ for rule in _FILE_RULES.get(kind, ())), *more]
        if not rules or not isinstance(data, dict):
            return
        if made is None:
            known = set(keys(self.kind)) - invalid
            made = _validated(self._partial, {key: value for key, value in data.items() if key in known})
        for one in rules:
            if not (invalid if EVERY_KEY in one.needs else invalid.intersection(one.needs)):
                yield from one.check(made)

    def _finding(self, reason: str, where: KeyPath, found: object, message: str) -> Finding:
        if reason == "rule":
            return where, message
        if reason == "missing":
            return where[:-1], f"the key {where[-1]} is missing; it must be {allowed(annotation(self.kind, where))}"
        if reason == "unexpected_keyword_argument":
            if new := self._renamed.get(dotted(where)):
                return where, f"this key is now called {new}; rename it"
            return where, unknown_key(str(where[-1]), keys(annotation(self.kind, where[:-1])))
        wanted = annotation(self.kind, where)
        if reason in ("too_short", "too_long") and isinstance(found, list) and found:
            return where, f"found a list of {len(found)}, allowed is {allowed(wanted)}"
        return where, f"found {shown(found)}, allowed is {allowed(wanted)}{_hint(wanted, found)}"


def _adapter_of(kind: type) -> TypeAdapter[Any]:
    # Pydantic takes a configuration for a dataclass only from outside: from the list around it.
    around: Any = types.GenericAlias(list, (kind,))
    return TypeAdapter(around, config=_STRICT)


def _with_pi(schema: Any) -> Any:
    """Return a schema whose numbers may be written with pi."""
    if isinstance(schema, list):
        return [_with_pi(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("type") == "number":
        return {"anyOf": [schema, {"type": "string", "pattern": "pi"}]}
    return {key: _with_pi(value) for key, value in schema.items()}


def _validated(adapter: TypeAdapter[Any], data: object) -> Any:
    """Return the object; by way of JSON, whose strict reading turns lists into tuples and mappings into dataclasses."""
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
    return [one.name for one in fields(bare_type(kind))]


def unknown_key(key: str, known: list[str], what: str = "key") -> str:
    """Return the sentence for a key, or another name, that does not exist."""
    close = difflib.get_close_matches(key, known, n=1)
    guess = f"did you mean {close[0]}? " if close else ""
    return f"this {what} does not exist; {guess}allowed are {', '.join(known)}"


def allowed(kind: object) -> str:
    """Return in words what a type with its bounds allows: `an integer from 0 to 255`."""
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


def _hint(wanted: object, found: object) -> str:
    """Return what YAML may have made of a value that looks right to its writer."""
    bare = bare_type(wanted)
    if isinstance(found, str) and bare in (int, float):
        try:
            float(int(found, 0)) if found[:2].lower() == "0x" else float(found)
        except ValueError:
            return "; write the number alone, the key names its unit" if len(found.split()) == 2 else ""
        leading_zero = len(found) > 1 and found[0] == "0" and found[1].isdigit()
        return f"; write it without {'leading zeros' if leading_zero else 'quotes'}"
    if isinstance(found, str) and bare is bool and found.lower() in ("yes", "no", "on", "off"):
        return "; yes, no, on and off are texts here"
    if isinstance(found, (int, float)) and bare is str:
        return "; write it in quotes"
    if isinstance(found, (int, float)) and {FractionOfPi, Le} <= {type(bound) for bound in _bounds(wanted)}:
        return "; angles are in rad: write 90 degrees as pi/2"
    return ""
