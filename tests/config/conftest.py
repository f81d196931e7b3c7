"""A copy of the shipped configuration that a test may change."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from rtcp.config import ConfigError, load, load_kinematics
from rtcp.config.findings import Finding

SHIPPED = Path(__file__).resolve().parents[2] / "config"


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The shipped configuration in the working directory, so that sentences show short paths.

    `geometry.yaml` is the IRB 120 with the keys `name` and `kinematics` alone.
    """
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "abb_irb120.yaml").read_text()
    (tmp_path / "geometry.yaml").write_text("name: abb-irb120\n\n" + text[text.index("kinematics:") :])
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def findings_after(directory: Path) -> Callable[..., list[Finding]]:
    """Replace the first `old` of a file by `new`, read it (devices by the arm's file) and return the findings."""

    def spoil(file: str, *changes: tuple[str, str]) -> list[Finding]:
        path = directory / file
        text = path.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path.write_text(text)
        reader: Callable[[Path], object] = load_kinematics if file == "geometry.yaml" else load
        with pytest.raises(ConfigError) as caught:
            reader(Path("assistive_arm.yaml" if file.startswith("devices") else file))
        return caught.value.findings

    return spoil
