"""The registry of faults in simulated instants: numbers, times, scripts, bursts."""

from __future__ import annotations

from typing import Any

import pytest

from rtcp.virtual.faults.fault import FOR_EVER, FaultRefused
from rtcp.virtual.faults.registry import MOST_ACTIVE, FaultRegistry, Planned, parse
from tests.virtual.line import MS, Line

S = 1000 * MS


def planned(**mapping: Any) -> Planned:
    fault, findings = parse(mapping)
    assert fault is not None, findings
    return fault


class Bench:
    """A registry with three slaves, the frames it sent and the messages it reported."""

    def __init__(self, *script: Planned) -> None:
        self.line = Line()
        self.t = self.line.now
        self.sent: list[bytes] = []
        self.reported: list[str] = []
        self.registry = FaultRegistry(self.line.segment, self.sent.append, self.t, script, self.reported.append)

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


def test_a_fault_is_active_until_it_is_cleared() -> None:
    bench = Bench()
    number = bench.begin(fault="loss", rate=0.5)
    bench.pass_time(10 * S)
    assert bench.registry.listing(bench.t) == [{
        "id": number, "fault": {"fault": "loss", "rate": 0.5, "seed": 0}, "since_s": 10.0, "left_s": None,
        "counts": {"lost_before": 0, "lost_behind": 0},
    }]  # fmt: skip
    assert bench.registry.clear(number, bench.t) == [number]
    assert (bench.active(), bench.registry.frames.active) == ([], False)


def test_a_fault_that_lasts_ends_at_its_time() -> None:
    bench = Bench()
    bench.begin(fault="loss", rate=0.5, lasts=1.5)
    bench.pass_time(S)
    assert bench.registry.listing(bench.t)[0]["left_s"] == pytest.approx(0.5)
    bench.pass_time(S // 2 - 1)
    assert bench.registry.frames.active
    bench.pass_time(1)
    assert (bench.active(), bench.registry.frames.active, bench.registry.due) == ([], False, FOR_EVER)


def test_all_are_cleared_at_once_and_numbers_are_not_given_twice() -> None:
    bench = Bench()
    first = [bench.begin(fault="loss", rate=0.5), bench.begin(fault="cable", after=1)]
    assert bench.registry.clear(None, bench.t) == first
    assert bench.registry.clear(None, bench.t) == []
    assert bench.begin(fault="garble", rate=0.5) > max(first)


def test_a_script_begins_and_ends_faults_at_its_times() -> None:
    bench = Bench(planned(fault="loss", rate=1.0, at=1, lasts=2), planned(fault="cable", after=2, at=2))
    assert bench.registry.due == bench.t + S
    active = []
    for _ in range(4):
        active.append([each["fault"]["fault"] for each in bench.registry.listing(bench.t)])
        bench.pass_time(S)
    assert active == [[], ["loss"], ["loss", "cable"], ["cable"]]


def test_a_fault_of_a_script_that_the_segment_refuses_is_reported_and_the_others_begin() -> None:
    bench = Bench(planned(fault="drive", slave=1, error="encoder", at=1), planned(fault="loss", rate=1.0, at=2))
    bench.pass_time(3 * S)
    assert len(bench.reported) == 1
    assert bench.reported[0].startswith("the script's fault drive at 1 s is left out: ")
    assert len(bench.active()) == 1


def test_a_burst_that_has_passed_is_not_active_any_more() -> None:
    bench = Bench()
    number = bench.begin(fault="garble", burst=1)
    bench.registry.answers(bytes(60), bench.t)
    assert bench.active() == []
    with pytest.raises(FaultRefused, match=f"fault {number} is not active any more"):
        bench.registry.clear(number, bench.t)


def test_a_late_answer_is_the_next_event_of_the_registry() -> None:
    bench = Bench()
    bench.begin(fault="delay", ms=5, rate=1.0)
    bench.registry.answers(b"late", bench.t)
    assert bench.registry.due == bench.t + 5 * MS
    bench.pass_time(5 * MS)
    assert bench.sent == [b"late"]


def test_clearing_an_unknown_fault_is_refused_with_the_active_ones() -> None:
    bench = Bench()
    bench.begin(fault="loss", rate=0.5)
    with pytest.raises(FaultRefused, match="there was no fault 7; active now: 1"):
        bench.registry.clear(7, bench.t)
    assert bench.active() == [1]


def test_there_is_an_end_to_the_number_of_faults() -> None:
    bench = Bench()
    for _ in range(MOST_ACTIVE):
        bench.begin(fault="loss", rate=0.5)
    with pytest.raises(FaultRefused, match=f"{MOST_ACTIVE} faults are active already"):
        bench.begin(fault="loss", rate=0.5)
