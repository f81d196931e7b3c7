"""Sentences that come again and again: said at once, then counted."""

from __future__ import annotations

import pytest

from rtcp.control import bus_service
from rtcp.control.bus_service import LogThrottle


class Reports:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 50.0
        monkeypatch.setattr(bus_service.time, "monotonic", lambda: self.now)
        self.said: list[str] = []
        self.throttle = LogThrottle(self.said.append, 2, "messages of slave 3")

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.throttle.report_due()


@pytest.fixture
def reports(monkeypatch: pytest.MonkeyPatch) -> Reports:
    return Reports(monkeypatch)


def test_a_message_is_logged_at_once_and_then_every_ten_seconds_with_its_count(reports: Reports) -> None:
    for _ in range(25):
        reports.throttle.report("it is hot")
        reports.pass_time(1.0)
    assert reports.said == ["it is hot", "it is hot (9 times again in 10 s)", "it is hot (10 times again in 10 s)"]


def test_a_sentence_that_came_once_more_and_then_no_longer_is_not_lost(reports: Reports) -> None:
    reports.throttle.report("it is hot")
    reports.throttle.report("it is hot")
    reports.pass_time(10.0)
    assert reports.said == ["it is hot", "it is hot (once again in 10 s)"]
    reports.pass_time(10.0)
    reports.throttle.report("it is hot")
    assert reports.said[2:] == ["it is hot"]


def test_of_many_different_sentences_a_few_are_said_and_the_others_counted(reports: Reports) -> None:
    for second in range(10):
        for number in range(20):
            reports.throttle.report(f"message {second} {number}")
        reports.pass_time(1.0)
    assert reports.said == ["message 0 0", "message 0 1", "further messages of slave 3 were left out: 198 in 10 s"]
