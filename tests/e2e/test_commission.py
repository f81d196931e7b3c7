"""`rtcp commission` on the virtual arm with a supply of 24 V: every joint turns alone, and a record is kept."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from tests.e2e.conftest import CUBEMARS, Platform

pytestmark = [pytest.mark.platform, CUBEMARS]


@pytest.fixture
def at_24_volts(platform: Platform) -> Platform:
    """A platform on drives with a supply of 24 V, not enabled."""
    platform.be_patient(2000)
    segment = Path(platform.environment["RTCP_CONFIG"]).with_name("segment.yaml")
    text, drives = re.subn(r"(serial: [2-7])", r"\1, bus_voltage: 24", segment.read_text())
    assert drives == 6
    segment.write_text(text)
    platform.rtcp("start", "--detach")
    return platform


def test_every_joint_is_commissioned_at_24_volts(at_24_volts: Platform, tmp_path: Path) -> None:
    platform = at_24_volts
    given = {"encoder_calibrated": True, "electrical_offset": 3.3749, "clear": True, "direction": True}
    answers = tmp_path / "answers.yaml"
    answers.write_text(yaml.safe_dump({f"joint{number}": given for number in range(1, 7)}))
    platform.rtcp("commission", "--answers", str(answers))
    record = yaml.safe_load(Path(platform.environment["RTCP_CONFIG"]).with_suffix(".commissioning.yaml").read_text())
    assert [entry["passed"] for entry in record["joints"].values()] == [True] * 6
    for entry in record["joints"].values():
        assert entry["moved"] == pytest.approx(0.02, abs=2e-3)
        assert entry["returned"] == pytest.approx(0.0, abs=2e-3)
    status = platform.status()
    assert status["state"] == "ready"
    assert platform.rtcp("sdo", "read", "drive1", "0x2000:2", "--type", "uint16").stdout.split()[-1] == "2400"
