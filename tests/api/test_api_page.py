"""The examples of the pages for programmers, run one after the other against the real platform on the virtual bus."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

DOCS = Path(__file__).parents[2] / "docs"


def examples(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


API = examples("api.md", "python")
FILES = [(language, text) for language in ("yaml", "csv") for text in examples("motion.md", language)]
assert ("yaml", (DOCS / "motion.yaml").read_text()) in FILES


@pytest.fixture(scope="module")
def platform() -> Iterator[Platform]:
    started = Platform()
    started.be_patient(2000)
    started.rtcp("start", "--detach")
    yield started
    started.end()


def enable(platform: Platform) -> None:
    """Each example starts enabled, because `--longest` may leave out the example before it."""
    if platform.status()["state"] == "ready":
        platform.call("enable")


def output_of(platform: Platform, program: str) -> str:
    environment = {**os.environ, "RTCP_RUNTIME_DIR": str(platform.directory)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + platform.logs()
    return done.stdout


def test_the_first_program_has_ten_lines_and_prints_what_its_page_shows(platform: Platform) -> None:
    [program], [output] = examples("first_program.md", "python"), examples("first_program.md", "text")
    assert program.count("\n") == 10
    assert output_of(platform, program) == output
    assert platform.status()["state"] == "ready"


@pytest.mark.parametrize("number", range(len(API)))
def test_an_example_of_the_api_runs(platform: Platform, number: int) -> None:
    enable(platform)
    output_of(platform, API[number])


@pytest.mark.parametrize("number", range(len(FILES)))
def test_an_example_of_a_motion_file_runs(platform: Platform, tmp_path: Path, number: int) -> None:
    ending, text = FILES[number]
    (tmp_path / f"motion.{ending}").write_text(text)
    enable(platform)
    if "program:" in text:
        # tests/e2e/test_paths.py runs it; its input and output are not in the default configuration.
        assert platform.rtcp("run", str(tmp_path / "motion.yaml"), "--dry").stdout.endswith("nothing has moved\n")
        return
    assert "arrived" in platform.rtcp("run", str(tmp_path / f"motion.{ending}"), "--approach").stdout


def test_the_readme_draws_a_circle(platform: Platform) -> None:
    [program] = examples("../README.md", "python")
    before = platform.status()["cycles"]
    output_of(platform, program)
    assert platform.status()["cycles"] > before + 1000
    assert platform.status()["state"] == "ready"
