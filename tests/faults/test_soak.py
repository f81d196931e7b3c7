"""The soak: its random faults, its report, and that it can fail."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.cli.__main__ import main
from rtcp.config import default_config, load
from rtcp.telemetry.soak import GROWTH, Counts, Resources, Soak, grown, random_fault, resources
from rtcp.virtual.faults.registry import installed, parse
from tests.e2e.conftest import Platform
from tests.faults.run import HOLD_MS

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
    # Left out: undetected bit errors, which may report any state or limit; frozen inputs, unseen; pushes.
    assert chosen == set(installed()) - {"garble", "input_frozen", "circuit", "contacts", "push"}


def test_the_same_seed_gives_the_same_faults() -> None:
    first, second = Random(7), Random(7)
    assert [random_fault(first, 7, DRIVES) for _ in range(50)] == [random_fault(second, 7, DRIVES) for _ in range(50)]


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
    messages = grown({"loop": HELD}, {} if last is None else {"loop": last}, settled=True)
    assert len(messages) == 1
    assert words in messages[0]


def test_equal_resources_unsettled_memory_and_the_gateways_threads_are_no_failure() -> None:
    assert grown({"loop": HELD}, {"loop": HELD}, settled=True) == []
    assert grown({"loop": HELD}, {"loop": Resources(HELD.rss * 2, 2, 10)}, settled=False) == []
    assert grown({"gateway": HELD}, {"gateway": Resources(HELD.rss, 4, 12)}, settled=True) == []


@pytest.mark.parametrize(
    ("rss_mib", "failures"),
    [
        # Trials of 10 s: the first recordings enlarge the heap, and the last reading is amid another one.
        (lambda trial: 70.0 if trial < 8 else 125.0 if trial == 40 else 92.0, 0),
        (lambda trial: 70.0 + trial, 1),
    ],
)
def test_memory_is_compared_after_the_first_recordings_and_between_them(
    rss_mib: Callable[[int], float], failures: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Scripted(Soak):
        trial = 0

        def _trial(self, number: int, fault: dict[str, Any], workload: str) -> None:
            self.trial = number
            self.summary.counts.setdefault("cable", Counts()).stopped += 1

        def _resources(self) -> dict[str, Resources]:
            return {"gateway": replace(HELD, rss=round(rss_mib(self.trial) * 2**20))}

    config = load(default_config())
    harness: Any = SimpleNamespace(config=config, records=0, torn=0)
    soak = Scripted(harness, {"loop": 1, "gateway": 1, "segment": 1}, 1, print)
    soak._pids = {"gateway": 1}
    monkeypatch.setattr("rtcp.telemetry.soak.time", SimpleNamespace(monotonic=lambda: 10.0 * soak.trial))
    assert len(soak.run(39 / 6).failures) == failures
    assert soak.trial == 40


def test_resources_are_those_of_the_process() -> None:
    usage = resources(os.getpid())
    assert usage is not None
    assert usage.rss > 10 << 20
    with open(os.devnull):
        more = resources(os.getpid())
    assert more is not None
    assert more.files == usage.files + 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("--minutes", "0"), "above 0"), (("--minutes", "nan"), "above 0"), (("--seed", "-1"), "0 to")],
)
def test_an_impossible_duration_or_seed_is_a_usage_error(
    arguments: tuple[str, str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(("soak", *arguments)) == 2
    assert words in capsys.readouterr().err


@pytest.mark.platform
def test_a_soak_reports_the_result_of_each_kind_of_fault_and_no_failure() -> None:
    platform = Platform()
    try:
        platform.be_patient(HOLD_MS)
        done = platform.rtcp("soak", "--minutes", "0.02", "--seed", "5", "--json")
        report = json.loads(done.stdout)
        assert report["failures"] == []
        assert report["records"] > 0
        assert report["torn"] == 0
        assert 0.0 < report["largest_step"] <= 1.0 + 1e-6
        counts = report["counts"].values()
        assert sum(count["injected"] for count in counts) >= 1
        assert all(count["injected"] == count["recovered"] for count in counts)
        assert set(report["last"]) == {"loop", "gateway", "segment"}
        assert not (platform.directory / "processes.json").exists()
    finally:
        platform.end()
