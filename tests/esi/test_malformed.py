"""Mutated files and images: each is read, or refused with one typed error."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.esi import mutate

ROOT = Path(__file__).parents[2]


def test_hundreds_of_mutated_files_and_images_raise_no_other_error(tmp_path: Path) -> None:
    assert mutate.failing(0, 300, tmp_path) == []


@pytest.mark.long("test_hundreds_of_mutated_files_and_images_raise_no_other_error")
@pytest.mark.timeout(7200)
def test_a_hundred_thousand_mutated_files_and_images_raise_no_other_error_and_take_bounded_memory() -> None:
    command = [sys.executable, "-m", "tests.esi.mutate", "1000", "100000"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""
    memory = re.search(r"(\d+) MiB", result.stderr)
    assert memory is not None
    assert int(memory[1]) < 400
