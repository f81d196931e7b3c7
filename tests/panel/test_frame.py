"""What the frame says and keeps: next steps, sentences, alarms, trends."""

from __future__ import annotations

import itertools
import time

import pytest

from rtcp.api import EventRecord, State
from rtcp.panel.live import NEXT, Live, sentence
from rtcp.panel.trends import KEPT_S, SAMPLE_S, Trends


def test_every_state_has_words_for_what_to_do_next() -> None:
    assert set(NEXT) == {state.name.lower() for state in State}


def test_alarms_that_nobody_has_acknowledged_are_kept_longest() -> None:
    live = Live(lambda secret: True)
    events = [
        EventRecord(number, f"2026-11-26T00:{number:04}", "drive_fault", {}, "", "fault") for number in range(1, 252)
    ]
    live._keep_alarms(events[:200])
    live.acknowledge(events[100:150], "Ada")
    live._keep_alarms(events[200:250])
    assert live.alarms == [*events[:100], *events[150:250]]
    assert live._acknowledged == {}
    live._keep_alarms(events[250:])
    assert live.alarms == [*events[1:100], *events[150:]]


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ("paused: `rtcp resume` continues the motion", "Paused."),
        (
            "the emergency stop is pressed (inputs.emergency_stop in arm.yaml): release it, then `rtcp reset`",
            "The emergency stop is pressed: release it.",
        ),
        (
            "slave 3 (drive2) does not answer: torque off; `rtcp reset` when it is back",
            "Slave 3 (drive2) does not answer: torque off.",
        ),
        ("", ""),
    ],
)
def test_the_header_says_in_sentences_what_needs_no_terminal(message: str, text: str) -> None:
    assert sentence(message) == text


def test_a_trend_keeps_an_hour_and_the_largest_of_each_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    now = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: float(next(now)))
    status = {
        "joint_names": ["joint1"],
        "joints": {"actual_torque": [0.0]},
        "wakeup_us": {"p99": 1.0},
        "exchange_us": {"p99": 1.0},
        "compute_us": {"p99": 1.0},
        "dc": None,
        "missed": 7,
    }
    hour = Trends()
    for at in range(2 * int(KEPT_S)):
        status["joints"] = {"actual_torque": [-5.0 if at == KEPT_S + 2 else 1.0]}
        hour.read(status, [10.0], [None])
    trend = hour.all["joint1 torque"]
    assert len(trend.samples) == KEPT_S / SAMPLE_S
    line = trend.line(2 * KEPT_S)
    assert len(line) <= 181
    assert max(line, key=lambda point: point[1]) == (pytest.approx(1.0, abs=0.01), 50.0)
    assert line[-1] == (pytest.approx(0.0, abs=0.01), 10.0)
    assert "joint1 temperature" not in hour.all
    assert {value for _, value in hour.all["skipped cycles"].samples} == {0.0}
