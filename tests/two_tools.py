"""The default arm with two tools: the bare flange, and a probe that continues joint 6 by 0.3 m and weighs 0.4 kg."""

from __future__ import annotations

import shutil
from pathlib import Path

from rtcp.config import default_config

PROBE_M = 0.3
_TOOLS = f"""
kinematics:
  tools:
    - {{name: flange}}
    - name: probe
      position: [0, 0, {PROBE_M}]
      mass: 0.4
      centre: [0, 0, 0.15]
      bodies: [{{start: [0, 0, 0], end: [0, 0, {PROBE_M}], radius: 0.02}}]
"""


def two_tools(directory: Path) -> Path:
    """Write the configuration into a directory; return the arm's file."""
    shutil.copytree(default_config().parent, directory, dirs_exist_ok=True)
    return add_tools(directory)


def add_tools(directory: Path) -> Path:
    """Give the arm of a directory its tools; return its file."""
    arm = directory / "assistive_arm.yaml"
    before, after = arm.read_text().split("\nkinematics:\n")
    arm.write_text(before + _TOOLS + after)
    return arm
