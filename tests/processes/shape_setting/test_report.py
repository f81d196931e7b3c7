"""The facts and the data of a report; its pictures are drawn by `rtcp shape-set` in `tests/e2e`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtcp.config.find import default_config
from rtcp.processes.rod import Rod, integrate
from rtcp.processes.shape_setting.heat_profile import HeatProfile
from rtcp.processes.shape_setting.job import Job, read_job
from rtcp.processes.shape_setting.report import _facts, _plain, _temperatures, write_report
from rtcp.processes.shape_setting.run import Outcome


@pytest.fixture(scope="module")
def example() -> tuple[Job, HeatProfile]:
    return read_job(default_config().parent / "shape_setting" / "arc.yaml")


def outcome_of(samples: int = 0) -> Outcome:
    """A run with so many samples of a rise from 20 C by 1 K each 0.2 s."""
    outcome = Outcome(strain=0.00153, initial_resistance=0.34567, energy=812.4)
    for i in range(samples):
        outcome.times.append(0.2 * i)
        for values in outcome.samples.values():
            values.append(20.0 + i)
    return outcome


def test_the_facts_of_a_run_have_its_values_in_units_for_people(example: tuple[Job, HeatProfile]) -> None:
    outcome = outcome_of(400)
    outcome.highest, outcome.released = np.array([300.0, 512.34, 400.0]), np.zeros((3, 3))
    outcome.straight, outcome.error = (0.012, 0.0345), (0.00234, 0.00123)
    facts = _facts(*example, outcome, "")
    assert facts.pop("target").startswith("510")
    assert facts == {
        "result": "the profile is complete",
        "rod": "1 mm, 0.3 m between the chucks",
        "largest strain of the bend": "0.15 %",
        "initial resistance": "345.670 mohm",
        "energy": "812 J",
        "hottest middle, by the resistance": "419.0 C",
        "hottest place of the rod": "512.3 C",
        "released rod against the wanted one": "1.23 mm rms, 2.34 mm at most",
        "ends that stay straight": "12 mm and 34 mm",
    }


def test_a_rod_that_is_set_nowhere_is_said_to_be_straight(example: tuple[Job, HeatProfile]) -> None:
    outcome = outcome_of()
    outcome.released, outcome.straight = np.zeros((3, 3)), (0.3, 0.3)
    assert _facts(*example, outcome, "")["ends that stay straight"].startswith("the whole rod")


def test_a_run_that_ended_early_says_why_and_leaves_out_what_was_not_measured(
    tmp_path: Path, example: tuple[Job, HeatProfile]
) -> None:
    outcome = outcome_of(1)
    outcome.samples["middle_temperature"] = []
    outcome.steps, outcome.interlocks = [(3.21, "the rod is <bent>")], {"fuse": "latched"}
    page = write_report(tmp_path, *example, Outcome(steps=outcome.steps, interlocks=outcome.interlocks), "cut & gone")
    text = page.read_text()
    for part in ("<th scope=row>result<td>cut &amp; gone<", "<td>3.2 s<td>the rod is &lt;bent&gt;<",
                 "<th scope=row>fuse<td>latched<"):  # fmt: skip
        assert part in text
    assert "<img" not in text
    content = json.loads((tmp_path / "report.json").read_text())
    assert set(content["facts"]) == {"result", "rod", "largest strain of the bend", "target", "initial resistance",
                                     "energy"}  # fmt: skip
    assert "along" not in content
    assert (content["steps"], content["wanted"]) == ([[3.21, "the rod is <bent>"]], None)


def test_the_temperatures_along_the_rod_are_of_at_most_300_instants(example: tuple[Job, HeatProfile]) -> None:
    assert _temperatures(example[1], outcome_of(1)) is None
    for samples, instants in ((2, 2), (300, 300), (1000, 300)):
        times, places, grid = _temperatures(example[1], outcome_of(samples))
        assert (times.shape, places.shape, grid.shape) == ((instants,), (61,), (61, instants))
        assert (times[0], times[-1]) == (0.0, pytest.approx(0.2 * (samples - 1)))
        assert (places[0], places[-1]) == (0.0, 0.3)
        assert grid[30, -1] == pytest.approx(20.0 + samples - 1)


def test_the_data_of_a_report_are_lists_of_numbers(example: tuple[Job, HeatProfile]) -> None:
    outcome = outcome_of(2)
    outcome.held = integrate(Rod(0.3, 1e-3), np.zeros(6)).p
    content = _plain({"result": "x"}, outcome, _temperatures(example[1], outcome))
    assert content["held"] == outcome.held.tolist()
    assert content["samples"]["ratio"] == [20.0, 21.0]
    assert content["along"]["times"] == [0.0, 0.2]
    assert content["along"]["s"][-1] == 0.3
    assert content["along"]["celsius"][30] == pytest.approx([20.0, 21.0])
    json.dumps(content)
