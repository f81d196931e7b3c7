"""Drives of six makers, from an ESI file to an arm whose joints move as commanded, with nothing edited but figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import ConfigError, load_device
from rtcp.config.device_file import file_text
from rtcp.esi.reader import find_device, read_esi
from tests.makers.arms import FOLDER, GOAL, MAKERS, make, move


@pytest.mark.parametrize("name", MAKERS)
def test_an_arm_of_this_makers_drives_moves_as_commanded_once_the_figures_are_filled_in(
    tmp_path: Path, name: str
) -> None:
    shafts, reported = move(make(tmp_path, name, MAKERS[name].figures))
    assert shafts == pytest.approx(GOAL, abs=2e-3)
    assert reported == pytest.approx(GOAL, abs=2e-3)


def test_a_wrong_figure_moves_the_joints_wrongly_although_the_arm_reports_its_goal(tmp_path: Path) -> None:
    """The test above can fail: the drives on the segment know nothing of the figures."""
    wrong = {**MAKERS["copley_bel"].figures, "encoder_increments": 25000}
    shafts, reported = move(make(tmp_path, "copley_bel", wrong))
    assert reported == pytest.approx(GOAL, abs=2e-3)
    assert max(abs(found - goal) for found, goal in zip(shafts, GOAL, strict=True)) > 0.1


@pytest.mark.parametrize("name", MAKERS)
def test_without_the_figures_the_file_is_refused_with_all_of_them_at_once(tmp_path: Path, name: str) -> None:
    file = tmp_path / "drive.yaml"
    file.write_text(file_text(find_device(read_esi(FOLDER / f"{name}.xml"))))
    with pytest.raises(ConfigError) as refused:
        load_device(file)
    assert {finding.code for finding in refused.value.findings} == {"no_value"}
    assert {finding.where[-1] for finding in refused.value.findings} == {*MAKERS[name].figures}
