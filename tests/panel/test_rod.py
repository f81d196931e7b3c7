"""The rod that two arms bend, in the panel of one of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.api.cell import rod_file
from rtcp.config.cell_file import load_cell
from rtcp.config.find import default_config
from rtcp.panel.partners import Partners


def test_a_panel_sees_the_curves_of_the_rod_from_its_own_base(tmp_path: Path) -> None:
    cell = load_cell(default_config().with_name("cell.yaml"))
    partners = Partners()
    partners.own = replace(cell.arms[0], directory=tmp_path / "left")
    partners.find()
    assert partners.rod == []
    # The left arm stands at y = 0.457 and looks along -y: what is at the world's origin is 0.457 m before it.
    rod = {"pid": os.getpid(), "curves": [[[0.0, 0.0, 0.4], [0.0, 0.1, 0.4]]]}
    rod_file(tmp_path).write_text(json.dumps(rod))
    partners.find()
    assert partners.rod == [[pytest.approx([0.457, 0.0, 0.4]), pytest.approx([0.357, 0.0, 0.4])]]
    os.utime(rod_file(tmp_path), (0.0, 0.0))
    partners.find()
    assert partners.rod == []
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    curves = [{"pid": pid, "curves": rod["curves"]} for pid in (int(dead.stdout), 10**30, "x", None)]
    for damaged in ("{", "3", '[["x"]]', *map(json.dumps, curves), json.dumps({**rod, "curves": [[[1, 2]]]})):
        rod_file(tmp_path).write_text(damaged)
        partners.find()
        assert partners.rod == []
