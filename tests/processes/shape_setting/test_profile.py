"""Profiles in YAML, their mistakes, and the command to the loop."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import trapezoid

from rtcp.processes.shape_setting.heat_profile import heat_command, target_ratio, target_temperatures
from rtcp.processes.shape_setting.job import read_job
from rtcp.processes.shape_setting.profile import read_profile, temperatures_along
from rtcp.processes.shape_setting.temperature import Place
from tests.findings import findings_of, summary
from tests.processes.shape_setting.rig import Rig

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "config" / "shape_setting" / "nitinol.yaml"


def test_the_example_is_a_profile_that_the_heater_takes() -> None:
    profile = read_profile(EXAMPLE)
    assert Rig().send(heat_command(profile)) is None
    mean, middle = target_temperatures(profile)
    assert (mean.place, middle.place) == (Place.MEAN, Place.MIDDLE)
    assert middle.celsius == pytest.approx(profile.target_c)
    assert 20.0 < middle.celsius - mean.celsius < 35.0
    assert 1.08 < target_ratio(profile) < 1.11


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("target_c: 510", "target_c: 5100", "16 target_c: range"),
        ("cool_c: 80 ", "cool_c: 520", "19 cool_c: range"),
        ("cool_c: 80\n", "cool_c: 21\n", "19 cool_c: too_low"),
        ("alpha: 1.78e-10", "alpha: 2e-4", "4 alloy.alpha: range"),
        ("hold_s: 120", "hold: 120", "17 hold: unknown"),
        ("length: 0.3 ", "length: 300 ", "7 ends.length: range"),
        ("power: 55 ", "power: 150 ", "24 limits.power: too_high"),
        ("target_c: 510 ", "target_ratio: 1.2 ", "16 target_ratio: too_high"),
        ("target_c: 510 ", "target_c: 510\ntarget_ratio: 1.09 ", "2 : one_of_both"),
        ("tolerance: 0.06 ", "tolerance: 0.6 ", "15 thermal.tolerance: range"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, old: str, new: str, expected: str) -> None:
    text = EXAMPLE.read_text()
    file = tmp_path / "rod.yaml"
    file.write_text(text.replace(old if old in text else old.rstrip(), new))
    assert expected in [summary(finding, expected) for finding in findings_of(lambda: read_profile(file))]


def test_a_profile_of_a_ratio_alone_takes_everything_else_from_the_rod(tmp_path: Path) -> None:
    file = tmp_path / "ratio.yaml"
    file.write_text("target_ratio: 1.09\n")
    profile = read_profile(file, length=0.3, diameter=1e-3)
    assert target_ratio(profile) == pytest.approx(1.09)
    shipped = read_profile(EXAMPLE)
    assert profile.ends.end_length == pytest.approx(shipped.ends.end_length, rel=0.05)
    assert profile.thermal.convection == pytest.approx(shipped.thermal.convection, rel=0.02)
    assert 1.2 < profile.limits.power / profile.needed_power < 1.4
    assert Rig().send(heat_command(profile)) is None
    assert read_profile(file, length=0.3, diameter=2e-3).thermal.convection < 0.8 * shipped.thermal.convection
    for_a_job = tmp_path / "job.yaml"
    for_a_job.write_text(EXAMPLE.with_name("arc.yaml").read_text().replace("nitinol.yaml", file.name))
    assert read_job(for_a_job)[1] == profile
    missing = [summary(finding, "") for finding in findings_of(lambda: read_profile(file))]
    assert len(missing) == 2


def test_the_temperatures_along_the_rod_have_chucks_middle_and_mean_of_the_scale() -> None:
    profile = read_profile(EXAMPLE)
    s = np.linspace(0.0, profile.ends.length, 3001)
    grid = temperatures_along(profile, s, [profile.chuck_c, 510.0])
    assert grid.shape == (3001, 2)
    assert grid[:, 0] == pytest.approx(profile.chuck_c)
    assert (grid[0, 1], grid[1500, 1], grid[-1, 1]) == pytest.approx((profile.chuck_c, 510.0, profile.chuck_c))
    share = (trapezoid(grid[:, 1], s) / profile.ends.length - profile.chuck_c) / (510.0 - profile.chuck_c)
    assert share == pytest.approx(profile.ends.mean_by_middle(), rel=1e-4)
    thin = replace(profile, ends=replace(profile.ends, end_length=1e-5))
    assert temperatures_along(thin, s, [510.0])[1, 0] == pytest.approx(510.0, abs=0.1)


def test_the_loops_modules_load_no_validator_and_no_numpy() -> None:
    program = (
        "import sys, rtcp.processes.shape_setting.config, rtcp.processes.shape_setting.process\n"
        "print({'pydantic', 'numpy', 'ruamel', 'scipy'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
