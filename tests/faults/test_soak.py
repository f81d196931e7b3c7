"""The soak: what it draws, what it tells, and that it can fail."""

from __future__ import annotations

import json
import os
from random import Random

import pytest

from rtcp.config.faults import FAULTS, parse
from rtcp.telemetry.trials.resources import GROWTH, Resources, grown, resources
from rtcp.telemetry.trials.soak import draw
from tests.e2e.conftest import Platform
from tests.faults.run import SHIPPED_MS

pytestmark = pytest.mark.alone

DRIVES = (2, 3, 4, 5, 6, 7)
HELD = Resources(rss=60 << 20, threads=2, files=10)


def test_every_fault_that_is_drawn_is_one_that_the_segment_takes() -> None:
    random, drawn = Random(1), set()
    for _ in range(2000):
        fault = draw(random, 7, DRIVES)
        planned, findings = parse(fault)
        assert planned is not None, (fault, findings)
        assert 1 <= fault.get("slave", 1) <= 7
        assert 0 <= fault.get("after", 0) <= 6
        drawn.add(fault["fault"])
    # Bits that no checksum sees are turned in the matrix: what a drive then says it is, it may say of any limit.
    # Frozen inputs nobody notices: there is nothing to count.
    assert drawn == set(FAULTS) - {"garble", "input_frozen"}


def test_the_same_seed_draws_the_same_faults() -> None:
    one, other = Random(7), Random(7)
    assert [draw(one, 7, DRIVES) for _ in range(50)] == [draw(other, 7, DRIVES) for _ in range(50)]


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (Resources(HELD.rss, 3, HELD.files), "3 threads"),
        (Resources(HELD.rss, 2, HELD.files + 1), "11 open files"),
        (Resources(HELD.rss + GROWTH + 1, 2, HELD.files), "62.0 MiB"),
        (None, "has ended"),
    ],
)
def test_what_a_process_holds_more_of_is_a_failure(last: Resources | None, words: str) -> None:
    found = grown({"loop": HELD}, {} if last is None else {"loop": last}, settled=True)
    assert len(found) == 1
    assert words in found[0]


def test_a_process_that_holds_what_it_held_is_none() -> None:
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
def test_what_cannot_be_is_a_usage_error(arguments: tuple[str, str], words: str) -> None:
    platform = Platform()
    try:
        done = platform.rtcp("soak", *arguments, check=2)
        assert words in done.stderr
    finally:
        platform.end()


def test_a_soak_tells_what_became_of_its_faults_and_that_nothing_was_lost() -> None:
    platform = Platform()
    try:
        platform.be_patient(SHIPPED_MS)
        done = platform.rtcp("soak", "--minutes", "0.12", "--seed", "5", "--json")
        found = json.loads(done.stdout)
        assert found["failures"] == []
        assert found["records"] > 0
        assert found["torn"] == 0
        assert 0.0 < found["largest_step"] <= 1.0 + 1e-6
        accounts = found["accounts"].values()
        assert sum(account["injected"] for account in accounts) >= 1
        assert all(account["injected"] == account["recovered"] for account in accounts)
        assert set(found["last"]) == {"loop", "gateway", "segment"}
        assert not (platform.directory / "processes.json").exists()
    finally:
        platform.end()
