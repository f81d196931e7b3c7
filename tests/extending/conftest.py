"""The example package, installed, and an arm that has its device."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parent / "example"


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the example package, installed by pip."""
    directory = tmp_path_factory.mktemp("example")
    shutil.copytree(EXAMPLE, directory / "source", ignore=shutil.ignore_patterns("__pycache__"))
    target = directory / "installed"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(target)]
    if importlib.util.find_spec("hatchling"):
        command.append("--no-build-isolation")
    subprocess.run([*command, str(directory / "source")], check=True)
    return target


def add_thermometer(directory: Path) -> Path:
    """Put a thermometer behind the last drive of the configuration in a directory; return the arm's file."""
    shutil.copy(EXAMPLE / "thermometer.yaml", directory / "devices")
    arm, segment = directory / "assistive_arm.yaml", directory / "segment.yaml"
    last = "  - {name: drive6, device: cubemars-orh}\n"
    assert last in arm.read_text()
    arm.write_text(arm.read_text().replace(last, last + "  - {name: thermometer, device: thermometer}\n"))
    with segment.open("a") as file:
        file.write("  - {model: example-thermometer, options: {heating: 10}}\n")
    return arm
