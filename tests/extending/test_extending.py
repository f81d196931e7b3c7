"""A package outside adds a controller, a kind of device and a fault (`docs/extending.md`): the example, installed and
run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from .conftest import EXAMPLE, add_thermometer

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("config")
    shutil.copytree(REPOSITORY / "config", directory, dirs_exist_ok=True)
    return add_thermometer(directory)


@pytest.fixture(scope="module")
def play(installed: Path, config: Path) -> Any:
    """Return what a scene of `play.py` prints; one process, which finds the package, plays all of them."""
    done = subprocess.run(
        [sys.executable, str(HERE / "play.py"), str(config)],
        check=False, capture_output=True, text=True, cwd=config.parent,
        env={**os.environ, "PYTHONPATH": str(installed)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout).__getitem__


@pytest.fixture(scope="module")
def swayed(play: Any) -> Any:
    return play("sway")


def test_a_controller_of_another_package_moves_the_arm_and_ends_where_it_began(swayed: Any) -> None:
    positions = swayed["positions"]
    assert len(positions) * swayed["period_s"] == pytest.approx(2.0, abs=0.01)
    assert max(positions) == pytest.approx(0.0174, abs=0.0005)
    assert min(positions) == pytest.approx(-0.0174, abs=0.0005)
    assert swayed["arrived"] == ["HOLDING", pytest.approx(0.0, abs=1e-9)]
    fastest = max(abs(b - a) for a, b in pairwise(positions)) / swayed["period_s"]
    assert fastest < 0.02 * (2.0 * 3.1416 + 1.5708)


def test_a_halt_stops_it_before_its_end(swayed: Any) -> None:
    assert swayed["halted_at"] != 0.0
    assert swayed["stopped"]


def test_its_refusal_reads_as_those_of_the_platform(swayed: Any) -> None:
    assert swayed["refused"] == ("joint6: 1 rad at 5 Hz exceeds its velocity or acceleration: reduce one of them")


def test_a_driver_of_another_package_decodes_what_the_model_of_that_package_sends(play: Any) -> None:
    played = play("thermometer")
    assert played["driver"] == "Thermometer"
    first, second = played["counts"]
    assert played["values"] == {"first": pytest.approx(first * 0.1), "second": pytest.approx(second * 0.1)}
    assert played["values"]["first"] == pytest.approx(300.0)
    assert played["values"]["second"] == pytest.approx(played["model"][1], abs=0.1)
    assert played["values"]["second"] > 304.0
    assert played["record"] == [played["values"]["first"], played["values"]["second"]]
    assert played["unit"] == "K"


def test_its_command_that_is_no_motion_is_refused_and_accepted_and_its_events_are_reported(play: Any) -> None:
    played = play("alarm")
    assert played["refused"].startswith("an alarm at 200 K would be active at once")
    assert played["accepted"]
    assert played["states"] == ["HOLDING", "FAULT"]
    warm, hot = played["events"]
    assert warm.startswith("the second channel has 305.")
    assert hot.endswith("more than 10 K above the alarm")
    assert played["fault"] == 1002


def test_a_fault_of_another_package_begins_ends_and_is_refused_where_it_does_not_fit(play: Any) -> None:
    played = play("wire_break")
    assert played["shown"] == [3000, 0x7FFF, 3000]
    assert played["refused"] == "slave 1 is no thermometer"
    assert len(played["wrong"]) == 1
    assert played["wrong"][0].startswith("slave: found 0")


def test_the_gateway_lists_the_command_as_a_method_that_checks_its_parameters(play: Any) -> None:
    played = play("methods")
    assert played["documentation"].startswith("Swing a joint")
    assert played["streams"] is False
    wrong, missing = sorted(played["findings"])
    assert "duration_s is missing" in missing
    assert wrong.startswith("frequency: ")


def test_no_other_test_sees_what_the_package_registers(installed: Path) -> None:
    tests = REPOSITORY / "tests"
    listing = ("config/test_plugins.py", "faults/test_soak.py")
    chosen = "registered or kind or random_fault_is"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not platform", "-k", chosen]
    done = subprocess.run(
        [*command, *(str(tests / name) for name in listing)],
        check=False, capture_output=True, text=True, cwd=REPOSITORY, env={**os.environ, "PYTHONPATH": str(installed)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


def test_the_page_shows_every_file_of_the_example_whole() -> None:
    page = (REPOSITORY / "docs" / "extending.md").read_text()
    assert len(page) <= 10_200
    for name in ("pyproject.toml", "thermometer.yaml", "sway.py", "thermometer.py", "virtual.py"):
        path = next(EXAMPLE.rglob(name))
        text = re.sub(r'\A""".*?"""\n\n', "", path.read_text(), flags=re.DOTALL)
        assert f"\n{text}```" in page, path


def test_the_page_of_processes_shows_the_process_of_the_example_whole() -> None:
    text = re.sub(r'\A""".*?"""\n\n', "", (EXAMPLE / "rtcp_example" / "fan.py").read_text(), flags=re.DOTALL)
    assert f"\n{text}```" in (REPOSITORY / "docs" / "processes.md").read_text()


def test_a_process_of_another_package_reads_its_channel_and_takes_its_command(play: Any) -> None:
    played = play("fan")
    assert played["before"] == [pytest.approx(played["kelvin"], abs=5.0), 0]
    assert played["after"][1] == 1
    assert played["halted"][1] == 0


def test_the_page_of_buses_shows_the_bus_of_the_example_whole() -> None:
    text = re.sub(r'\A""".*?"""\n\n', "", (EXAMPLE / "rtcp_example" / "bench.py").read_text(), flags=re.DOTALL)
    assert f"\n{text}```" in (REPOSITORY / "docs" / "buses.md").read_text()
