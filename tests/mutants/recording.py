"""Which tests execute a statement: recorded by marks that are put into the sources as Python loads them.

coverage.py with a context for each test would record the same; these tests then take two and a half times as long.
"""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Iterable, Iterator
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any

_HITS = "__hits__"
"""In a module with marks: a byte for each mark, 1 once it was executed."""


class _Marks(ast.NodeTransformer):
    """Puts a mark before each sequence of statements that are executed together, in functions."""

    def __init__(self) -> None:
        self.lines: list[list[int]] = []
        """The first lines of the statements after each mark."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if isinstance(block, list) and not isinstance(node, ast.Module | ast.ClassDef):
                setattr(node, name, list(self._marked(block)))
        return node

    def _marked(self, block: list[ast.stmt]) -> Iterator[ast.stmt]:
        is_new = True
        for statement in block:
            is_docstring = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if is_new and not is_docstring:
                mark = ast.parse(f"{_HITS}[{len(self.lines)}] = 1").body[0]
                for part in ast.walk(mark):
                    ast.copy_location(part, statement)
                self.lines.append([])
                yield mark
                is_new = False
            if not is_docstring:
                self.lines[-1].append(statement.lineno)
            yield statement
            is_new = is_new or hasattr(statement, "body")


def marked(source: str) -> tuple[ast.Module, list[list[int]]]:
    """Return the file with marks, and the lines after each of them."""
    marks, tree = _Marks(), ast.parse(source)
    tree = marks.visit(tree)
    imports = (i + 1 for i, node in enumerate(tree.body) if getattr(node, "module", "") == "__future__")
    at = max(imports, default=1)  # 1: after the docstring
    tree.body.insert(at, ast.parse(f"{_HITS} = bytearray({len(marks.lines)})").body[0])
    return ast.fix_missing_locations(tree), marks.lines


class Recorder:
    """Plug-in of pytest: records the statements that each test executes, how long it takes, and whether it passes."""

    def __init__(self, files: Iterable[str]) -> None:
        self._marks: dict[str, list[list[int]]] = {}
        self._executed: dict[str, dict[int, set[str]]] = {file: {} for file in files}
        self._seconds: dict[str, float] = {}
        self._failed: set[str] = set()
        load = SourceFileLoader.source_to_code

        def source_to_code(loader: Any, data: Any, path: Any, **options: Any) -> CodeType:
            name = str(path).removeprefix(f"{Path.cwd()}/")
            if name in self._executed:
                data, self._marks[name] = marked(bytes(data).decode())
            return load(loader, data, path, **options)

        SourceFileLoader.source_to_code = source_to_code  # type: ignore[assignment]

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._seconds[report.nodeid] = self._seconds.get(report.nodeid, 0.0) + report.duration
        if not report.passed:
            self._failed.add(report.nodeid)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        for name, lines in self._marks.items():
            module = sys.modules.get(name.removesuffix("/__init__.py").removesuffix(".py").replace("/", "."))
            hits = getattr(module, _HITS, None)
            if hits is not None:
                for i in (i for i, hit in enumerate(hits) if hit):
                    hits[i] = 0
                    for line in lines[i]:
                        self._executed[name].setdefault(line, set()).add(nodeid)

    def save(self, path: Path) -> None:
        """Write what was recorded; tests that failed are named and else left out."""
        tests = [test for test in self._seconds if test not in self._failed]
        number = {test: i for i, test in enumerate(tests)}
        lines = {
            name: {line: sorted(number[test] for test in names if test in number) for line, names in executed.items()}
            for name, executed in self._executed.items()
        }
        seconds = [self._seconds[test] for test in tests]
        content = {"tests": tests, "seconds": seconds, "lines": lines, "failed": sorted(self._failed)}
        path.write_text(json.dumps(content))


class Recording:
    """What was recorded: which tests execute a statement, and how long they take, s."""

    def __init__(self, path: Path) -> None:
        content = json.loads(path.read_text())
        self.failed: list[str] = content["failed"]
        self._tests: list[str] = content["tests"]
        self._seconds: list[float] = content["seconds"]
        self._lines: dict[str, dict[str, list[int]]] = content["lines"]

    def tests(self, path: str, source: str, line: int, longest_s: float) -> tuple[list[str], float, int]:
        """Return the tests of the statement in this line, the fastest file and test first, that take so long together;
        how long they take, s; and how many tests there are in all.
        """
        by_line = self._lines.get(path, {})
        first = first_line(source, line)
        every = {test for tests in by_line.values() for test in tests} if first is None else by_line.get(str(first), [])
        chosen: list[int] = []
        total = 0.0
        for test in sorted(every, key=self._seconds.__getitem__):
            if chosen and total + self._seconds[test] > longest_s:
                break
            total += self._seconds[test]
            chosen.append(test)
        files: dict[str, list[int]] = {}
        for test in chosen:
            files.setdefault(self._tests[test].partition("::")[0], []).append(test)
        return [self._tests[test] for tests in files.values() for test in tests], total, len(every)


def first_line(source: str, line: int) -> int | None:
    """Return the first line of the statement that the line belongs to; None outside functions, where the import
    executes it.
    """
    first, inside = None, False
    node: ast.AST | None = ast.parse(source)
    while node is not None:
        parts = (part for part in ast.iter_child_nodes(node) if isinstance(part, ast.stmt | ast.ExceptHandler))
        is_function = isinstance(node, ast.FunctionDef)
        node = next((part for part in parts if part.lineno <= line <= (part.end_lineno or 0)), None)
        inside = inside or is_function
        if inside and isinstance(node, ast.stmt):
            first = node.lineno
    return first
