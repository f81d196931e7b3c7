"""Events that come again and again: reported at once, then counted."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from rtcp.control.bus_service import LogThrottle
from rtcp.ipc.events import EmergencyMessage, ErrorReported, Event, MessagesLeftOut

HOT = ErrorReported("it is hot")


class Reports:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 50.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        self.reported: list[Event] = []
        self.throttle = LogThrottle(self.reported.append, 2, 3)

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.throttle.report_due()


@pytest.fixture
def reports(monkeypatch: pytest.MonkeyPatch) -> Reports:
    return Reports(monkeypatch)


def test_a_message_is_logged_at_once_and_then_every_ten_seconds_with_its_count(reports: Reports) -> None:
    for _ in range(25):
        reports.throttle.report(HOT)
        reports.pass_time(1.0)
    assert reports.reported == [HOT, replace(HOT, again=9, seconds=10.0), replace(HOT, again=10, seconds=10.0)]


def test_a_sentence_that_came_once_more_and_then_no_longer_is_not_lost(reports: Reports) -> None:
    reports.throttle.report(HOT)
    reports.throttle.report(HOT)
    reports.pass_time(10.0)
    assert reports.reported == [HOT, replace(HOT, again=1, seconds=10.0)]
    reports.pass_time(10.0)
    reports.throttle.report(HOT)
    assert reports.reported[2:] == [HOT]


def test_of_many_different_sentences_a_few_are_said_and_the_others_counted(reports: Reports) -> None:
    for second in range(10):
        for number in range(20):
            reports.throttle.report(EmergencyMessage(3, second, number, 0))
        reports.pass_time(1.0)
    assert reports.reported == [
        *(EmergencyMessage(3, 0, number, 0) for number in (0, 1)),
        MessagesLeftOut(3, 198, 10.0),
    ]
