"""The file of a virtual IRC5."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.config.findings import Finding
from rtcp.virtual.irc5.config import load_irc5
from rtcp.virtual.irc5.controller import Controller
from rtcp.virtual.irc5.panel import Motors
from tests.findings import findings_of, summary

SHIPPED = Path(__file__).parents[3] / "config" / "irc5.yaml"


def findings(tmp_path: Path, text: str) -> list[Finding]:
    path = tmp_path / "irc5.yaml"
    path.write_text(text, encoding="utf-8")
    return findings_of(lambda: Controller(load_irc5(path)))


def test_the_shipped_file_is_an_irb_120_that_waits_for_references() -> None:
    controller = Controller(load_irc5(SHIPPED))
    assert controller.panel.motors is Motors.ON
    assert controller.units["ROB_1"].mechanical.ranges[5] == pytest.approx((-400.0, 400.0))


def test_names_and_ports_are_the_units_own(tmp_path: Path) -> None:
    text = "units:\n  - {name: A, port: 1}\n  - {name: A, port: 1}\n"
    assert [summary(finding, "3 : of=") for finding in findings(tmp_path, text)] == [
        "3 units[1].name: repeated of=units[0].name", "3 units[1].port: repeated of=units[0].port",
    ]  # fmt: skip


def test_there_are_four_units_at_most(tmp_path: Path) -> None:
    text = "units:\n" + "".join(f"  - {{name: A{i}, port: {i + 1}}}\n" for i in range(5))
    (finding,) = findings(tmp_path, text)
    assert summary(finding, "1 : found=") == "1 units: size found=5"


def test_seven_joints_need_the_range_of_the_seventh(tmp_path: Path) -> None:
    text = "units:\n  - {name: A, port: 1, initial_position: [0, 0, 0, 0, 0, 0, 0]}\n"
    (finding,) = findings(tmp_path, text)
    assert summary(finding, "2 : found=") == "2 units[0].initial_position: count found=7"


def test_an_initial_position_outside_the_range_is_named(tmp_path: Path) -> None:
    text = "units:\n  - {name: A, port: 1, initial_position: [0, 120, 0, 0, 0, 0]}\n"
    (finding,) = findings(tmp_path, text)
    assert str(finding) == "initial_position of A: found 120 for joint 2, allowed is a number from -110 to 110"


def test_an_arm_that_is_not_there_is_named(tmp_path: Path) -> None:
    assert "irb_9000" in str(findings(tmp_path, "units:\n  - {name: A, port: 1, arm: irb_9000}\n")[0])


@pytest.mark.parametrize(
    ("unit", "rapid", "expected"),
    [
        ("period_s: 0.008", "{}", "4 units[1].period_s: unlike"),
        ("external_joint: {min: 0, max: 1, velocity: 1}, initial_position: [0, 0, 0, 0, 0, 0, 0]", "{}",
         "4 units[1].external_joint: seventh_joint"),
        ("robotware: 6", "{position_delay_s: [0.02, 0.01]}", "1 rapid.position_delay_s: order"),
    ],
)  # fmt: skip
def test_what_rapid_streaming_cannot_do_is_named(tmp_path: Path, unit: str, rapid: str, expected: str) -> None:
    text = f"rapid: {rapid}\nunits:\n  - {{name: A, port: 1}}\n  - {{name: B, port: 2, {unit}}}\n"
    (finding,) = findings(tmp_path, text)
    assert summary(finding, expected) == expected
