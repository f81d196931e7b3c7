"""The soak: its random faults, its report, and that it can fail."""

from __future__ import annotations

import json
import os
from random import Random

import pytest

from rtcp.telemetry.soak import GROWTH, Resources, grown, random_fault, resources
from rtcp.virtual.faults.registry import installed, parse
from tests.e2e.conftest import Platform
from tests.faults.run import HOLD_MS

pytestmark = pytest.mark.alone

DRIVES = (2, 3, 4, 5, 6, 7)
HELD = Resources(rss=60 << 20, threads=2, files=10)


def test_every_random_fault_is_one_that_the_segment_accepts() -> None:
    random, chosen = Random(1), set()
    for _ in range(2000):
        fault = random_fault(random, 7, DRIVES)
        planned, findings = parse(fault)
        assert planned is not None, (fault, findings)
        assert 1 <= fault.get("slave", 1) <= 7
        assert 0 <= fault.get("after", 0) <= 6
        chosen.add(fault["fault"])
    # Left out: undetected bit errors, which may report any state or limit; frozen inputs, which nothing detects.
    assert chosen == set(installed()) - {"garble", "input_frozen"}


def test_the_same_seed_gives_the_same_faults() -> None:
    one, other = Random(7), Random(7)
    assert [random_fault(one, 7, DRIVES) for _ in range(50)] == [random_fault(other, 7, DRIVES) for _ in range(50)]


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (Resources(HELD.rss, 3, HELD.files), "3 threads"),
        (Resources(HELD.rss, 2, HELD.files + 1), "11 open files"),
        (Resources(HELD.rss + GROWTH + 1, 2, HELD.files), "62.0 MiB"),
        (None, "has ended"),
    ],
)
def test_a_resource_that_has_grown_is_a_failure(last: Resources | None, words: str) -> None:
    found = grown({"loop": HELD}, {} if last is None else {"loop": last}, settled=True)
    assert len(found) == 1
    assert words in found[0]


def test_equal_resources_unsettled_memory_and_the_gateways_threads_are_no_failure() -> None:
    assert grown({"loop": HELD}, {"loop": HELD}, settled=True) == []
    assert grown({"loop": HELD}, {"loop": Resources(HELD.rss * 2, 2, 10)}, settled=False) == []
    assert grown({"gateway": HELD}, {"gateway": Resources(HELD.rss, 4, 12)}, settled=True) == []


def test_resources_are_those_of_the_process() -> None:
    held = resources(os.getpid())
    assert held is not None
    assert held.rss > 10 << 20
    with open(os.devnull):
        more = resources(os.getpid())
    assert more is not None
    assert more.files == held.files + 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("--minutes", "0"), "above 0"), (("--minutes", "nan"), "above 0"), (("--seed", "-1"), "0 or")],
)
def test_an_impossible_duration_or_seed_is_a_usage_error(arguments: tuple[str, str], words: str) -> None:
    platform = Platform()
    try:
        done = platform.rtcp("soak", *arguments, check=2)
        assert words in done.stderr
    finally:
        platform.end()


def test_a_soak_reports_the_result_of_each_kind_of_fault_and_no_failure() -> None:
    platform = Platform()
    try:
        platform.be_patient(HOLD_MS)
        done = platform.rtcp("soak", "--minutes", "0.12", "--seed", "5", "--json")
        found = json.loads(done.stdout)
        assert found["failures"] == []
        assert found["records"] > 0
        assert found["torn"] == 0
        assert 0.0 < found["largest_step"] <= 1.0 + 1e-6
        counts = found["counts"].values()
        assert sum(count["injected"] for count in counts) >= 1
        assert all(count["injected"] == count["recovered"] for count in counts)
        assert set(found["last"]) == {"loop", "gateway", "segment"}
        assert not (platform.directory / "processes.json").exists()
    finally:
        platform.end()
