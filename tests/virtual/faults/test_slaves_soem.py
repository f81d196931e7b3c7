"""Faults under a real master over a real cable."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.forked import answer_of
from tests.virtual.conftest import segment


@pytest.mark.platform
def test_a_real_master_sees_each_fault_and_brings_all_back_after_a_broken_cable_and_a_loss_of_supply(
    tmp_path: Path,
) -> None:
    config, control = tmp_path / "segment.yaml", tmp_path / "control"
    slaves = "".join(f"  - {{model: {model}}}\n" for model in ["diewu-io", *["cubemars-orh70"] * 6])
    config.write_text("slaves:\n" + slaves, encoding="utf-8")
    with segment(config, "--control", str(control)) as pid:
        result = answer_of("tests.virtual.faults.soem_recovery_child", str(pid), "ecat0", str(control))
    assert (result["slaves"], result["op"]) == (7, 8)
    # -1: the host delayed the frame beyond the master's timeout.
    assert {*result["broken"]} <= {9, -1}
    assert 9 in result["broken"]
    assert result["links"] == [3, 3, 1]
    assert result["watched"] == [True] * 3 + [False] * 4
    assert result["lost_links"] == [0, 0, 0x0100, 0x0001, 0, 0, 0]
    assert result["behind"] == [[8, 0], [0x14, 0x1B], [0x14, 0x1B]]
    assert result["cleared"][0] == 8
    assert {*result["cleared"][1]} <= {21, -1}
    assert {*result["dark"], *result["back"]} <= {18, -1}
    assert result["recovered"] > 0
    assert result["reconfigured"] > 0
    assert result["again"][0] == 8
    assert {*result["again"][1]} <= {21, -1}
    assert {*result["not_counted"]} <= {18, -1}
    assert result["damaged"].count(-1) >= 5
    assert result["errors"] == [0, 0, 0, 0, 5, 5 * 256, 5 * 256]
    assert result["abort"] == 0x08000022
    assert {*result["fallen"]} <= {19, -1}
    assert result["al"] == [[8, 0], [0x14, 0x1234], [8, 0]]
