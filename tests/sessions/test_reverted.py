"""The fixes that `python -m tests.sessions.reverted` takes out: the list is complete and fits the present tree."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path

import pytest

from tests.copied_tree import ROOT
from tests.sessions.reverted.__main__ import UNREACHABLE, Unreachable, patches


@pytest.mark.parametrize("patch", patches([]), ids=lambda patch: patch.stem)
def test_each_patch_takes_its_fix_out_of_the_present_tree(patch: Path) -> None:
    subprocess.run(["git", "apply", "--check", "-C1", str(patch)], cwd=ROOT, check=True)


@pytest.mark.parametrize("fix", UNREACHABLE, ids=lambda fix: fix.fix)
def test_each_fix_that_no_session_finds_has_a_test(fix: Unreachable) -> None:
    file, _, name = fix.test.partition("::")
    nodes = ast.walk(ast.parse((ROOT / file).read_text()))
    assert name in {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
