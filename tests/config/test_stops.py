"""The ladder of stops in the arm's file: what the shipped one says, and the sentence for each mistake."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import StopsConfig

FILE = "assistive_arm.yaml"
MISTAKES = {
    "frames that are lost cannot be a controlled stop": (
        ("lost_frames: quick_stop", "lost_frames: controlled_stop"),
        'stops.lost_frames: found the text "controlled_stop", allowed is one of quick_stop, torque_off',
    ),
    "holding is nobody's choice": (
        ("lease_ended: controlled_stop", "lease_ended: hold"),
        'stops.lease_ended: found the text "hold", allowed is one of controlled_stop, quick_stop, torque_off',
    ),
    "the emergency stop cannot leave the torque on": (
        ("emergency_stop: quick_stop", "emergency_stop: controlled_stop"),
        'stops.emergency_stop: found the text "controlled_stop", allowed is one of quick_stop, torque_off',
    ),
    "a rung that there is not": (
        ("clock_lost: quick_stop", "clock_lost: fast"),
        'stops.clock_lost: found the text "fast", allowed is one of controlled_stop, quick_stop, torque_off',
    ),
    "off is a text of its own, and no rung": (
        ("supervision: quick_stop", "supervision: off"),
        'stops.supervision: found the text "off", allowed is one of quick_stop, torque_off',
    ),
    "an event that there is not": (
        ("slave_lost: quick_stop", "slaves_lost: quick_stop"),
        "stops.slaves_lost: this key does not exist; did you mean slave_lost? allowed are lost_frames, slave_lost, "
        "drive_fault, clock_lost, emergency_stop, supervision, lease_ended, enabling_switch",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_one_sentence_with_key_found_and_allowed(
    problems_after: Callable[..., list[str]], mistake: str
) -> None:
    change, sentence = MISTAKES[mistake]
    problems = problems_after(FILE, change)
    assert len(problems) == 1
    assert problems[0].endswith(sentence)


def test_the_shipped_rungs_are_the_defaults() -> None:
    assert load(default_config()).stops == StopsConfig()


def test_without_the_section_the_defaults_hold(directory: Path) -> None:
    path = directory / FILE
    text = path.read_text()
    begin, end = text.index("stops:\n"), text.index("# Terminals of the IO box")
    path.write_text(text[:begin] + text[end:])
    assert load(Path(FILE)).stops == StopsConfig()


def test_a_rung_that_is_allowed_is_read(directory: Path) -> None:
    path = directory / FILE
    path.write_text(path.read_text().replace("lease_ended: controlled_stop", "lease_ended: torque_off", 1))
    assert load(Path(FILE)).stops == StopsConfig(lease_ended="torque_off")
