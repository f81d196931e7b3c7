"""The example of the docs: its task by a policy that was not learnt, and a few steps of learning."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'rtcp[gym]'")

from tests.e2e.conftest import Platform

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/reach.py"


@pytest.fixture(scope="module")
def reach() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reach", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def straight(observation: Any) -> Any:
    """Lead the tool straight to its target, by the scaled actions of the task."""
    return np.clip(2.0 * observation["to_target"] / 0.25, -1.0, 1.0)


def test_its_task_is_done_by_whoever_goes_straight_to_the_target(reach: ModuleType) -> None:
    assert reach.evaluate(straight, 2) == 1.0
    assert reach.evaluate(lambda observation: np.zeros(3), 1) == 0.0


@pytest.mark.platform
@pytest.mark.long("test_its_task_is_done_by_whoever_goes_straight_to_the_target")
def test_its_task_is_done_on_a_platform_too(
    reach: ModuleType, enabled: Platform, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in enabled.environment.items():
        monkeypatch.setenv(name, value)
    assert reach.on_the_robot(straight, 2) == 1.0


@pytest.mark.platform
@pytest.mark.long("test_its_task_is_done_by_whoever_goes_straight_to_the_target")
@pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="stable-baselines3 is not installed, which brings torch",
)
def test_it_learns_writes_its_policy_and_moves_the_robot_by_it(enabled: Platform, tmp_path: Path) -> None:
    def run(*arguments: str, **environment: str) -> str:
        command = [sys.executable, str(EXAMPLE), *arguments]
        done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    policy = str(tmp_path / "reach.zip")
    assert "320 steps" in run("train", policy, "--steps", "320")
    assert "of 2 targets reached within 0.02 m" in run("evaluate", policy, "--episodes", "2")
    assert "of 1 targets reached" in run("deploy", policy, "--episodes", "1", **enabled.environment)
