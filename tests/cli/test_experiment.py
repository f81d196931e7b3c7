"""`rtcp experiment` and `rtcp report` with fake experiments: folders, tables, pages and exit codes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli import experiment
from rtcp.telemetry.experiments import EXPERIMENTS
from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup, read_result


def made_up(name: str, here: float | None) -> type[Experiment]:
    """An experiment with one figure that is to be at most 1; without a figure it fails."""

    class MadeUp(Experiment):
        title = f"An experiment called {name}"

        def run(self, setup: Setup) -> list[Row]:
            if here is None:
                raise ExperimentFailed("there is no arm")
            return [Row("deviation", "mm", here, 0.5, most=1.0)]

    MadeUp.name = name
    return MadeUp


@pytest.fixture
def experiments(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = {"good": 0.25, "bad": 2.0, "failing": None}
    for name, here in kinds.items():
        monkeypatch.setitem(EXPERIMENTS, name, made_up(name, here))
    monkeypatch.setattr(experiment, "NAMES", tuple(kinds))


@pytest.mark.usefixtures("experiments")
@pytest.mark.parametrize(
    ("name", "code", "text"), [("good", 0, "met"), ("bad", 1, "MISSED"), ("failing", 5, "failing: there is no arm")]
)
def test_an_experiment_ends_with_1_where_a_figure_misses_its_aim(
    rtcp: Callable[..., Any], tmp_path: Path, name: str, code: int, text: str
) -> None:
    ended = rtcp("experiment", name, "--out", str(tmp_path / "out"))
    assert (ended.code, text in ended.out + ended.trouble) == (code, True)
    assert "thesis" in ended.out
    assert read_result(tmp_path / "out").met is (code == 0)


@pytest.mark.usefixtures("experiments")
def test_all_are_carried_out_whatever_fails_and_make_one_page(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    for folder in ("a", "b"):
        ended = rtcp("experiment", "all", "--out", str(tmp_path / folder))
        assert ended.code == 5
        assert "report.html" in ended.out
    page = (tmp_path / "a" / "report.html").read_text()
    assert all(text in page for text in ("called good", "called bad", "there is no arm", "<th>thesis</th>"))
    ended = rtcp("report", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "both.html"))
    assert (ended.code, ended.out) == (0, f"report: {tmp_path}/both.html\n")
    assert (tmp_path / "both.html").read_text().count('"number">0.25') >= 2
