"""`rtcp soak --simulated`: bad input, a run on a local cluster, a failed seed and its black box."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from rtcp.config import default_config
from tests.leftovers import Leftovers
from tests.sessions.session import narrowed, run_narrowed, run_still, two_workers

CLUSTER = all(map(importlib.util.find_spec, ("distributed", "pyarrow")))
needs_cluster = pytest.mark.skipif(not CLUSTER, reason="needs rtcp[cluster]")
pytestmark = pytest.mark.timeout(600)


def run_batch(plan: Any, seeds: Any) -> Any:
    """Run a batch as the product does."""
    from rtcp.testing.sessions import cluster

    return cluster.run_batch(plan, seeds)


@pytest.fixture(scope="module")
def workers(leftovers: Leftovers) -> Iterator[Any]:
    with two_workers(leftovers) as client:
        yield client


@pytest.fixture
def soak(rtcp: Callable[..., Any], workers: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Run sessions into `tmp_path / "results"`, their batches by a function of the test."""

    def run(run_batch: Callable[..., Any], *arguments: str) -> Any:
        from rtcp.testing.sessions import cluster

        monkeypatch.setattr(cluster, "SessionRun", partial(cluster.SessionRun, run=run_batch))
        monkeypatch.setattr(cluster, "cluster", lambda address: contextlib.nullcontext(workers))
        return rtcp("soak", "--simulated", "--out", str(tmp_path / "results"), *arguments)

    return run


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--sessions", "0"), "--sessions 0 is not allowed: 1 to"),
        (("--sessions", "1000000001"), "--sessions 1000000001 is not allowed: 1 to"),
        (("--seed", "99999999999999999999"), "--seed 99999999999999999999 is not allowed: 0 to"),
        (("--seconds", "nan"), "--seconds nan is not allowed"),
        (("--coverage-from", "0"), "--coverage-from 0 is not allowed: at least 1"),
        (("--minutes", "2"), "give --sessions and --seconds"),
        (("--keep", "box.mcap", "--sessions", "2"), "--keep runs one session"),
        (("--keep", "/nowhere/box.mcap", "--seconds", "0.1"), "--keep /nowhere/box.mcap: no recording can be written"),
        (("--config", str(default_config().parent / "abb_irb120.yaml")), "for arms of CiA 402 drives: slave joint_1"),
        (("--config", str(default_config().parent / "heater.yaml")), "it has no joints"),
        (("--config", str(default_config().parent / "cell.yaml")), "for arms of CiA 402 drives: slave joint_1"),
        pytest.param(("--out", "/proc/nowhere"), "/proc/nowhere: results cannot be written there", marks=needs_cluster),
        pytest.param(("--scheduler", "no://x"), "--scheduler no://x: no Dask scheduler answers", marks=needs_cluster),
    ],
)
def test_a_request_that_cannot_be_carried_out_is_one_line_and_leaves_nothing(
    rtcp: Callable[..., Any], arguments: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    ended = rtcp("soak", "--simulated", *arguments)
    assert (ended.code, ended.out) == (2, "")
    assert words in ended.err
    assert ended.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_an_option_of_sessions_needs_simulated(rtcp: Callable[..., Any]) -> None:
    ended = rtcp("soak", "--seconds", "2")
    assert (ended.code, ended.err) == (2, "rtcp: --seconds needs --simulated\n")


def test_without_its_packages_it_says_what_to_install(
    rtcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "rtcp.testing.sessions.cluster", raising=False)
    monkeypatch.setitem(sys.modules, "dask", None)
    ended = rtcp("soak", "--simulated", "--sessions", "1")
    assert ended.code == 2
    assert "pip install 'rtcp[cluster]'" in ended.err


def test_one_session_is_replayed_alone_and_its_black_box_opened(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "box.mcap"
    ended = rtcp("soak", "--simulated", "--seed", "7", "--seconds", "0.5", "--keep", str(file), "--json")
    assert ended.code == 0
    done = json.loads(ended.out)["done"]
    shown = json.loads(rtcp("faults", "show", str(file), "--json").out)
    messages = [entry.partition(" ")[2] for entry in done]
    assert [entry["message"] for entry in shown["timeline"] if entry["message"] in messages] == messages
    assert "READY Enable() -> accepted" in messages
    again = rtcp("soak", "--simulated", "--seed", "7", "--keep", str(file))
    assert (again.code, "not overwritten" in again.err) == (2, True)
    assert "SESSION" in rtcp("faults", "show", str(file)).out
    missing = rtcp("faults", "show", str(tmp_path / "none.mcap"))
    assert (missing.code, "no such file" in missing.err) == (2, True)


@needs_cluster
def test_sessions_on_a_local_cluster_end_with_a_table_and_its_files(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    out = tmp_path / "results"
    ended = rtcp(
        "soak", "--simulated", "--sessions", "3", "--seed", "5", "--seconds", "0.2", "--out", str(out), "--json"
    )
    assert ended.code == 0, ended.err
    summary = json.loads(ended.out)
    assert (summary["outcomes"], summary["results"]) == ({"passed": 3}, str(out))
    assert sorted(file.name for file in out.iterdir()) == ["coverage.json", "part-000000.parquet"]
    coverage = json.loads((out / "coverage.json").read_text())
    assert coverage == summary["coverage"]
    assert coverage["events"]["ready"] == 3
    assert "sent: halt moving joint csp" in coverage["empty"]
    again = rtcp("soak", "--simulated", "--sessions", "3", "--out", str(out))
    assert (again.code, "give another folder" in again.err, again.out) == (2, True, "")


@needs_cluster
def test_the_file_of_a_cell_runs_sessions_of_its_arms_together(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    shutil.copytree(default_config().parent, tmp_path / "config")
    file, out = tmp_path / "config" / "two.yaml", tmp_path / "results"
    file.write_text("""
        name: two
        arms:
          - {name: left, config: assistive_arm.yaml}
          - {name: right, config: assistive_arm.yaml, base: {position: [-1.5, 0, 0], rpy: [0, 0, pi]}}
        """)
    soak = ("soak", "--simulated", "--config", str(file), "--seconds", "1", "--json")
    ended = rtcp(*soak, "--sessions", "2", "--out", str(out))
    assert ended.code == 0, ended.err
    summary = json.loads(ended.out)
    assert (summary["outcomes"], summary["coverage"]["empty"]) == ({"passed": 2}, [])
    assert summary["coverage"]["sent"]
    assert rtcp(*soak, "--keep", str(tmp_path / "box.mcap")).code == 0


@needs_cluster
def test_a_session_that_ends_its_process_is_not_repeated_in_this_one(soak: Callable[..., Any], tmp_path: Path) -> None:
    from tests.sessions.test_soak import DEADLY, deadly

    ended = soak(deadly, "--sessions", "6", "--seconds", "0.1", "--json")
    assert ended.code == 5
    (failure,) = json.loads(ended.out)["failures"]
    assert (failure["seed"], failure["outcome"], failure["black_box"]) == (DEADLY, "worker_died", "")
    assert sorted(file.name for file in (tmp_path / "results").iterdir()) == ["coverage.json", "part-000000.parquet"]


@needs_cluster
def test_a_failed_seed_is_kept_with_its_black_box_and_the_command_that_replays_it(
    rtcp: Callable[..., Any], soak: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with narrowed():
        ended = soak(run_narrowed, "--sessions", "4", "--seed", "3", "--seconds", "1.5")
    assert ended.code == 5
    lines = ended.out.splitlines()
    shown = next(line for line in lines if "rtcp faults show" in line).split()
    replay = next(line for line in lines if "--keep" in line).partition("rtcp ")[2].split()
    assert ": velocity " in json.loads(rtcp(*shown[shown.index("rtcp") + 1 :], "--json").out)["what"]
    monkeypatch.chdir(tmp_path)
    with narrowed():
        assert rtcp(*replay).code == 5
    assert (tmp_path / replay[-1]).is_file()


@needs_cluster
def test_the_coverage_is_shown_and_rows_that_stay_empty_are_named(soak: Callable[..., Any]) -> None:
    ended = soak(run_batch, "--sessions", "3", "--seconds", "1", "--coverage-from", "4")
    assert ended.code == 0, ended.err
    assert "commands sent, by state" in ended.out
    assert re.search(r"events: .*ready 3", ended.out.replace("\n", " "))
    again = soak(run_batch, "--sessions", "3", "--seconds", "1", "--coverage-from", "3")
    assert again.code == 5
    assert re.search(
        r"\d+ rows of the coverage table are empty after 3 sessions \(\S+coverage.json\): sent: ", again.err
    )


@needs_cluster
def test_what_ends_a_run_leaves_its_summary(soak: Callable[..., Any], tmp_path: Path) -> None:
    from tests.sessions.test_soak import other_version

    ended = soak(other_version, "--sessions", "40", "--seconds", "0.1", "--json")
    assert (ended.code, "has rtcp 0.0.1" in ended.err) == (5, True)
    assert json.loads(ended.out)["results"] == str(tmp_path / "results")


@needs_cluster
@pytest.mark.parametrize("begun", [True, False])
def test_ctrl_c_of_a_terminal_ends_all_workers_and_shows_what_is_known(
    rtcp_process: Callable[..., subprocess.Popen[str]], wait_until: Callable[..., None], tmp_path: Path, begun: bool
) -> None:
    out = tmp_path / "results"
    process = rtcp_process(
        "soak", "--simulated", "--sessions", "4000", "--seconds", "0.1", "--out", str(out), start_new_session=True
    )
    # A terminal reaches all processes of the command.
    wait_until(out.is_dir if begun else lambda: bool(psutil.Process(process.pid).children(recursive=True)))
    time.sleep(1.0 if begun else 0.0)  # the first sessions are submitted
    workers = psutil.Process(process.pid).children(recursive=True)
    assert workers
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120.0)
    assert process.returncode == 130
    assert re.fullmatch(r"rtcp: interrupted after \d+ sessions\n" if begun else "(rtcp: interrupted.*\n)?", errors)
    assert psutil.wait_procs(workers, timeout=30.0)[1] == []


@needs_cluster
def test_a_soak_of_an_arm_that_never_moves_does_not_pass(soak: Callable[..., Any]) -> None:
    ended = soak(run_still, "--sessions", "2", "--seconds", "0.1")
    assert (ended.code, "no session moved the arm" in ended.err) == (5, True)


def test_a_segment_that_does_not_fit_is_refused_before_the_first_session(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    config = tmp_path / "config"
    shutil.copytree(default_config().parent, config)
    segment = config / "segment.yaml"
    first, *slaves = segment.read_text().split("\n  - ")
    segment.write_text("\n  - ".join([first, *slaves[:4]]))
    ended = rtcp("soak", "--simulated", "--sessions", "2", "--config", str(config / default_config().name))
    assert (ended.code, "4 slaves answer, the configuration (key `slaves`) lists 7" in ended.err) == (2, True)
