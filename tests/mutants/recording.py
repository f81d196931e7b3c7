"""Which tests execute a statement: recorded by marks that are put into the sources as Python loads them.

coverage.py with a context for each test would record the same; these tests then take two and a half times as long.
A statement is known by its function and its first line, so that a record outlives other changes of the file.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib.machinery import SourceFileLoader
from itertools import chain
from pathlib import Path
from time import process_time
from types import CodeType, ModuleType
from typing import Any, NamedTuple

_HITS = "__hits__"
"""In a module with marks: a byte for each mark, 1 once it was executed."""

_DEFAULTS = "tests/config/test_pages.py::test_the_generated_parts"
"""Tests that compare each default of a configuration file with the documentation."""


class Statement(NamedTuple):
    """A statement of a file, by its function and its first line."""

    function: str
    text: str


class _Marks(ast.NodeTransformer):
    """Puts a mark before each sequence of statements that are executed together, in functions."""

    def __init__(self, source: str) -> None:
        self._lines, self._names = source.splitlines(), [""]
        self.statements: list[list[Statement]] = []
        """The statements after each mark."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        name = node.name if isinstance(node, ast.FunctionDef | ast.ClassDef) else ""
        self._names.append(f"{self._names[-1]}.{name}" if name else self._names[-1])
        super().generic_visit(node)
        for field in ("body", "orelse", "finalbody"):
            block = getattr(node, field, None)
            if isinstance(block, list) and not isinstance(node, ast.Module | ast.ClassDef):
                setattr(node, field, list(self._marked(block)))
        self._names.pop()
        return node

    def _marked(self, block: list[ast.stmt]) -> Iterator[ast.stmt]:
        is_new = True
        for statement in block:
            is_docstring = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if is_new and not is_docstring:
                mark = ast.parse(f"{_HITS}[{len(self.statements)}] = 1").body[0]
                for part in ast.walk(mark):
                    ast.copy_location(part, statement)
                self.statements.append([])
                yield mark
                is_new = False
            if not is_docstring:
                text = self._lines[statement.lineno - 1].strip()
                self.statements[-1].append(Statement(self._names[-1], text))
            yield statement
            is_new = is_new or hasattr(statement, "body")


def marked(source: str) -> tuple[ast.Module, list[list[Statement]]]:
    """Return the file with marks, and the statements after each of them."""
    marks, tree = _Marks(source), ast.parse(source)
    tree = marks.visit(tree)
    imports = (i + 1 for i, node in enumerate(tree.body) if getattr(node, "module", "") == "__future__")
    at = max(imports, default=1)  # 1: after the docstring
    tree.body.insert(at, ast.parse(f"{_HITS} = bytearray({len(marks.statements)})").body[0])
    return ast.fix_missing_locations(tree), marks.statements


def statement_at(source: str, line: int) -> Statement | None:
    """Return the innermost statement that the line belongs to; None outside functions, where the import executes it."""
    function, found = "", None
    node: ast.AST | None = ast.parse(source)
    while node is not None:
        is_function = isinstance(node, ast.FunctionDef) or found is not None
        function += f".{node.name}" if isinstance(node, ast.FunctionDef | ast.ClassDef) else ""
        parts = (part for part in ast.iter_child_nodes(node) if isinstance(part, ast.stmt | ast.ExceptHandler))
        node = next((part for part in parts if part.lineno <= line <= (part.end_lineno or 0)), None)
        if is_function and isinstance(node, ast.stmt):
            found = Statement(function, source.splitlines()[node.lineno - 1].strip())
    return found


def _sha(source: str) -> str:
    return hashlib.sha256(source.encode()).hexdigest()


def _digest(path: Path) -> str:
    """Return a digest of a file of tests, and of what the files beside it share."""
    shared = (file for file in path.parent.glob("*.py") if not file.name.startswith("test_"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in (path, *sorted(shared)))).hexdigest()


class _Record(NamedTuple):
    """What the tests of one file did."""

    executed: dict[str, dict[str, dict[str, list[str]]]]
    """Source -> function -> statement -> tests."""
    seconds: dict[str, float]
    failed: set[str]


class Recorder:
    """Plug-in of pytest: records the statements that each test executes, its CPU time, and whether it passes.

    It writes a record into `folder` for each of the files of tests.
    """

    def __init__(self, sources: Iterable[str], files: Iterable[str], folder: Path) -> None:
        self._folder, self._files = folder, list(files)
        self._sources: dict[str, str] = {}
        self._marks: dict[str, list[list[Statement]]] = {}
        self._began_s = 0.0
        self._file = ""
        self._records: dict[str, _Record] = {}
        marking, load = frozenset(sources), SourceFileLoader.source_to_code

        def source_to_code(loader: Any, data: Any, path: Any, **options: Any) -> CodeType:
            name = str(path).removeprefix(f"{Path.cwd()}/")
            if name in marking:
                self._sources[name] = _sha(bytes(data).decode())
                data, self._marks[name] = marked(bytes(data).decode())
            return load(loader, data, path, **options)

        SourceFileLoader.source_to_code = source_to_code  # type: ignore[assignment]

    def _start(self, file: str) -> None:
        """Write what the tests of the last file did, and begin or continue another: pytest may order tests anew."""
        if self._file:
            record = self._records[self._file]
            seconds = {test: seconds for test, seconds in record.seconds.items() if test not in record.failed}
            failed, digest = sorted(record.failed), _digest(Path(self._file))
            content = {"digest": digest, "seconds": seconds, "failed": failed, "sources": self._sources}
            path = record_of(self._folder, self._file)
            path.write_text(json.dumps(content | {"executed": record.executed}))
        self._file = file
        self._records.setdefault(file, _Record({}, {}, set()))

    def _take(self) -> set[tuple[str, Statement]]:
        """Return the statements of each source that were executed since the last call."""
        executed: set[tuple[str, Statement]] = set()
        for name, module in self._modules():
            hits: bytearray = getattr(module, _HITS)
            executed.update((name, each) for i, hit in enumerate(hits) if hit for each in self._marks[name][i])
            hits[:] = bytes(len(hits))
        return executed

    def _modules(self) -> Iterator[tuple[str, ModuleType]]:
        for name in self._marks:
            module = sys.modules.get(name.removesuffix("/__init__.py").removesuffix(".py").replace("/", "."))
            if hasattr(module, _HITS):
                yield name, module

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        file = nodeid.partition("::")[0]
        if file != self._file:
            self._start(file)
        for _, module in self._modules():
            for value in list(vars(module).values()):
                # Each test computes by itself what functions keep of a test before.
                getattr(value, "cache_clear", lambda: None)()
        self._take()
        self._began_s = process_time()

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._records[self._file].failed.add(report.nodeid)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        record = self._records[self._file]
        record.seconds[nodeid] = process_time() - self._began_s
        for name, (function, text) in self._take():
            record.executed.setdefault(name, {}).setdefault(function, {}).setdefault(text, []).append(nodeid)

    def pytest_sessionfinish(self) -> None:
        for file in ("", *(file for file in self._files if not record_of(self._folder, file).exists()), ""):
            self._start(file)


def record_of(folder: Path, file: str) -> Path:
    """Return the record of a file of tests."""
    return folder / f"{file.replace('/', '+')}.json"


class Recording:
    """What was recorded: which tests execute a statement, and the CPU time that they take, s."""

    def __init__(self, folder: Path) -> None:
        self.missing: list[str] = []
        """Files of tests that changed since, or were never recorded."""
        self.failed: list[str] = []
        self._seconds: dict[str, float] = {}
        self._records: list[dict[str, Any]] = []
        self._folder = folder

    def read(self, files: Iterable[Path]) -> None:
        """Read the records of these files of tests."""
        for file in files:
            path = record_of(self._folder, str(file))
            content: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"digest": ""}
            if content["digest"] != _digest(file):
                self.missing.append(str(file))
                continue
            self.failed += content["failed"]
            self._seconds |= content["seconds"]
            self._records.append(content)

    def tests(
        self, path: str, source: str, statement: Statement | None, longest_s: float
    ) -> tuple[list[str], float, int]:
        """Return the tests of a statement that take so long together, file by file; how long they take, s; and how many
        tests there are in all. The fastest variant of each test comes first, then the next one of each.

        None stands for what the import executes: the tests of the file, and of the documented defaults. In a file that
        changed since, a statement that was never executed has the tests of its function.
        """
        found: set[str] = set()
        for record in self._records:
            functions = record["executed"].get(path, {})
            blocks = functions.values() if statement is None else [functions.get(statement.function, {})]
            if statement is not None and (statement.text in blocks[0] or record["sources"].get(path) == _sha(source)):
                blocks = [{"": blocks[0].get(statement.text, ())}]
            found.update(chain.from_iterable(chain.from_iterable(block.values() for block in blocks)))
        if statement is None:
            found.update(test for test in self._seconds if test.startswith(_DEFAULTS))
        chosen: dict[str, list[str]] = {}
        total = 0.0
        variants: Counter[str] = Counter()
        order: list[tuple[int, float, str]] = []
        for test in sorted(found & self._seconds.keys(), key=self._seconds.__getitem__):
            order.append((variants[test.partition("[")[0]], self._seconds[test], test))
            variants[test.partition("[")[0]] += 1
        for _, _, test in sorted(order):
            if chosen and total + self._seconds[test] > longest_s:
                break
            total += self._seconds[test]
            chosen.setdefault(test.partition("::")[0], []).append(test)
        return list(chain.from_iterable(chosen.values())), total, len(found)
