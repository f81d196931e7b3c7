"""The registry of faults in simulated instants: numbers, times, scripts, bursts."""

from __future__ import annotations

from typing import Any

import pytest

from rtcp.virtual.faults.fault import FOR_EVER, FaultRefused
from rtcp.virtual.faults.registry import MOST_ACTIVE, FaultRegistry, Planned, parse
from tests.virtual.line import MS, Line

S = 1000 * MS


def planned(**mapping: Any) -> Planned:
    found, findings = parse(mapping)
    assert found is not None, findings
    return found


class Kept:
    """A registry with three slaves, what it sent and what it complained of."""

    def __init__(self, *script: Planned) -> None:
        self.line = Line()
        self.t = self.line.now
        self.sent: list[bytes] = []
        self.said: list[str] = []
        self.registry = FaultRegistry(self.line.segment, self.sent.append, self.t, script, self.said.append)

    def begin(self, **mapping: Any) -> int:
        return self.registry.begin(planned(**mapping), self.t)

    def active(self, t: int | None = None) -> list[int]:
        return [each["id"] for each in self.registry.listing(self.t if t is None else t)]

    def pass_time(self, ns: int) -> None:
        """Let time pass, with every event of the registry at its instant."""
        until = self.t + ns
        while self.registry.due <= until:
            self.t = max(self.t, self.registry.due)
            self.registry.tick(self.t)
        self.t = until


def test_an_empty_book_waits_for_nothing() -> None:
    kept = Kept()
    assert (kept.registry.due, kept.active()) == (FOR_EVER, [])


def test_a_fault_is_active_until_it_is_mended() -> None:
    kept = Kept()
    number = kept.begin(fault="loss", rate=0.5)
    kept.pass_time(10 * S)
    assert kept.registry.listing(kept.t) == [{
        "id": number, "fault": {"fault": "loss", "rate": 0.5, "seed": 0}, "since_s": 10.0, "left_s": None,
        "counts": {"lost_before": 0, "lost_behind": 0},
    }]  # fmt: skip
    assert kept.registry.clear(number, kept.t) == [number]
    assert (kept.active(), kept.registry.frames.active) == ([], False)


def test_a_fault_that_lasts_ends_at_its_time() -> None:
    kept = Kept()
    kept.begin(fault="loss", rate=0.5, lasts=1.5)
    kept.pass_time(S)
    assert kept.registry.listing(kept.t)[0]["left_s"] == pytest.approx(0.5)
    kept.pass_time(S // 2 - 1)
    assert kept.registry.frames.active
    kept.pass_time(1)
    assert (kept.active(), kept.registry.frames.active, kept.registry.due) == ([], False, FOR_EVER)


def test_all_are_mended_at_once_and_numbers_are_not_given_twice() -> None:
    kept = Kept()
    first = [kept.begin(fault="loss", rate=0.5), kept.begin(fault="cable", after=1)]
    assert kept.registry.clear(None, kept.t) == first
    assert kept.registry.clear(None, kept.t) == []
    assert kept.begin(fault="garble", rate=0.5) > max(first)


def test_a_broken_cable_is_whole_again_when_its_time_is_over() -> None:
    kept = Kept()
    kept.begin(fault="cable", after=1, lasts=0.1)
    assert len(kept.line.segment.topology.reached) == 1
    kept.pass_time(100 * MS)
    assert len(kept.line.segment.topology.reached) == 3


def test_a_script_begins_and_ends_faults_at_its_times() -> None:
    kept = Kept(planned(fault="loss", rate=1.0, at=1, lasts=2), planned(fault="cable", after=2, at=2))
    assert kept.registry.due == kept.t + S
    seen = []
    for _ in range(4):
        seen.append([each["fault"]["fault"] for each in kept.registry.listing(kept.t)])
        kept.pass_time(S)
    assert seen == [[], ["loss"], ["loss", "cable"], ["cable"]]


def test_what_the_segment_refuses_of_a_script_is_told_and_the_rest_goes_on() -> None:
    kept = Kept(planned(fault="drive", slave=1, error="encoder", at=1), planned(fault="loss", rate=1.0, at=2))
    kept.pass_time(3 * S)
    assert len(kept.said) == 1
    assert kept.said[0].startswith("the script's fault drive at 1 s is left out: ")
    assert len(kept.active()) == 1


def test_a_burst_that_has_passed_is_not_active_any_more() -> None:
    kept = Kept()
    number = kept.begin(fault="garble", burst=1)
    kept.registry.answers(bytes(60), kept.t)
    assert kept.active() == []
    with pytest.raises(FaultRefused, match=f"fault {number} is not active any more"):
        kept.registry.clear(number, kept.t)


def test_a_late_answer_is_what_the_book_waits_for_next() -> None:
    kept = Kept()
    kept.begin(fault="delay", ms=5, rate=1.0)
    kept.registry.answers(b"late", kept.t)
    assert kept.registry.due == kept.t + 5 * MS
    kept.pass_time(5 * MS)
    assert kept.sent == [b"late"]


def test_a_fault_that_happens_once_has_a_number_and_is_never_active() -> None:
    kept = Kept()
    assert kept.begin(fault="clock_jump", slave=1, us=50) > 0
    assert kept.active() == []


def test_mending_what_never_was_is_refused_with_what_is_active() -> None:
    kept = Kept()
    kept.begin(fault="loss", rate=0.5)
    with pytest.raises(FaultRefused, match="there was no fault 7; active now: 1"):
        kept.registry.clear(7, kept.t)
    assert kept.active() == [1]


def test_a_refused_fault_leaves_nothing_behind() -> None:
    kept = Kept()
    with pytest.raises(FaultRefused):
        kept.begin(fault="cable", after=9)
    assert kept.active() == []


def test_there_is_an_end_to_the_number_of_faults() -> None:
    kept = Kept()
    for _ in range(MOST_ACTIVE):
        kept.begin(fault="loss", rate=0.5)
    with pytest.raises(FaultRefused, match=f"{MOST_ACTIVE} faults are active already"):
        kept.begin(fault="loss", rate=0.5)
