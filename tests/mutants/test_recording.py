"""The marks of `make mutants`, and the mistakes that are accepted."""

from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from tests.mutants.recording import marked, statement_at

_SOURCE = '''"""What it is."""

from __future__ import annotations

LIMIT = 3


def speed(x: float) -> float:
    """Return it."""
    if x > LIMIT:
        return (
            1.0
        )
    try:
        return 1 / x
    except ZeroDivisionError:
        x = 0.0
    return x
'''


def test_marks_name_the_statements_that_were_executed_and_change_nothing() -> None:
    tree, statements = marked(_SOURCE)
    names: dict[str, Any] = {}
    exec(compile(tree, "speed.py", "exec"), names)
    for x, result, executed in ((4.0, 1.0, {10, 11}), (0.5, 2.0, {10, 14, 15}), (0.0, 0.0, {10, 14, 15, 17, 18})):
        hits = names["__hits__"]
        hits[:] = bytes(len(hits))
        assert names["speed"](x) == result
        texts = [statement.text for i, hit in enumerate(hits) if hit for statement in statements[i]]
        assert sorted(texts) == sorted(_SOURCE.splitlines()[line - 1].strip() for line in executed)
    assert names["__doc__"] == "What it is."
    assert names["speed"].__doc__ == "Return it."


def test_a_line_belongs_to_the_innermost_statement_and_outside_functions_to_the_import() -> None:
    _, statements = marked(_SOURCE)
    every = {statement for block in statements for statement in block}
    at = [statement_at(_SOURCE, line) for line in (5, 8, 10, 12, 15, 16)]
    assert [None if each is None else each.text for each in at] == [
        *(None, None, "if x > LIMIT:", "return (", "return 1 / x", "try:")
    ]
    assert every >= set(at) - {None}


def test_each_accepted_mistake_has_a_reason_and_its_lines_are_still_in_the_file() -> None:
    root = Path(__file__).resolve().parents[2]
    for entry in YAML(typ="safe").load(Path(__file__).with_name("accepted.yaml")):
        lines = {" ".join(line.split()) for line in (root / entry["file"]).read_text().splitlines()}
        assert lines >= set(entry["correct"].split(" ⏎ ")), entry
        assert entry["reason"]
        assert entry["mutant"] != entry["correct"]


def test_mistakes_are_those_that_a_reviewer_would_choose() -> None:
    pytest.importorskip("cosmic_ray", reason="`make mutants` installs it")
    from tests.mutants.kinds import mutants_of

    source = "def f(a: int | None, b):\n    g(a, b)\n    return max(abs(a - b), 0.5) if a < b and not b else a + 1\n"
    changed = {mutant.code(source).splitlines()[mutant.line - 1].strip() for mutant in mutants_of("f.py", source)}
    assert changed == {
        "pass",
        "g(b, a)",
        "return (abs(a - b)) if a < b and not b else a + 1",
        "return (0.5) if a < b and not b else a + 1",
        "return max((a - b), 0.5) if a < b and not b else a + 1",
        "return max(abs(a + b), 0.5) if a < b and not b else a + 1",
        "return max(abs(a), 0.5) if a < b and not b else a + 1",
        "return max(abs(a - b), 1.0) if a < b and not b else a + 1",
        "return max(abs(a - b), 0.5) if not a < b and not b else a + 1",
        "return max(abs(a - b), 0.5) if a > b and not b else a + 1",
        "return max(abs(a - b), 0.5) if a < b or not b else a + 1",
        "return max(abs(a - b), 0.5) if a < b and  b else a + 1",
        "return max(abs(a - b), 0.5) if a < b else a + 1",
        "return max(abs(a - b), 0.5) if not b else a + 1",
        "return max(abs(a - b), 0.5) if a < b and not b else a - 1",
        "return max(abs(a - b), 0.5) if a < b and not b else a",
        "return max(abs(a - b), 0.5) if a < b and not b else a + 2",
    }
