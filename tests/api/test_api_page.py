"""The examples of the pages for programmers, run one after the other against the real platform on the virtual bus."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

from rtcp.cli.__main__ import main
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

DOCS = Path(__file__).parents[2] / "docs"


def examples(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


API = examples("api.md", "python")
FILES = [(language, text) for language in ("yaml", "csv") for text in examples("motion.md", language)]
assert ("yaml", (DOCS / "motion.yaml").read_text()) in FILES


@pytest.fixture(autouse=True)
def _of_the_platform(enabled: Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples connect to the shared platform, enabled and at 0."""
    for name, value in enabled.environment.items():
        monkeypatch.setenv(name, value)


def run_program(program: str) -> str:
    """Run a program in this process; return its output."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(program, {"__name__": "__main__"})
    return said.getvalue()


def test_the_first_program_has_ten_lines_and_prints_what_its_page_shows(enabled: Platform) -> None:
    [program], [output] = examples("first_program.md", "python"), examples("first_program.md", "text")
    assert program.count("\n") == 10
    enabled.call("disable")
    assert run_program(program) == output
    assert enabled.status()["state"] == "ready"


def test_the_examples_of_the_api_and_the_readme_run(enabled: Platform) -> None:
    for program in [*API, *examples("../README.md", "python")]:
        status = enabled.until(lambda status: status["state"] in ("ready", "holding"), "rest")
        if status["state"] == "ready":
            enabled.call("enable")
        before = status["cycles"]
        run_program(program)
    assert enabled.status()["cycles"] > before + 250  # a circle of the tool takes its time


def test_the_examples_of_a_motion_file_can_be_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for ending, text in FILES:
        file = tmp_path / f"motion.{ending}"
        file.write_text(text)
        assert main(["run", str(file), "--dry", *(() if "program:" in text else ("--approach",))]) == 0
        assert capsys.readouterr().out.endswith("nothing has moved\n")
    assert main(["run", str(DOCS / "motion.yaml"), "--approach"]) == 0
    assert "arrived" in capsys.readouterr().out
