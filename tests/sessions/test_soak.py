"""Sessions on a cluster: the same rows wherever they run, workers that die, a planted violation and its black box.

Workers are real processes.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest

from rtcp import __version__
from rtcp.config import default_config, load
from rtcp.config.segment import load_segment
from rtcp.ipc.recording import RecordingError, read
from rtcp.testing.sessions.black_box import replay
from rtcp.testing.sessions.run import run_session
from rtcp.testing.sessions.session import Result
from tests.leftovers import Leftovers
from tests.sessions.session import narrowed, run_narrowed, session_of, two_workers

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")

import pyarrow.parquet as pq
from distributed import Client

from rtcp.testing.sessions import cluster as sessions_cluster
from rtcp.testing.sessions.cluster import (
    Batch,
    Parts,
    Run,
    SessionPlan,
    SessionRun,
    SessionSummary,
    SoakError,
    cluster,
    run_batch,
)

pytestmark = pytest.mark.timeout(900)
CONFIG = load(default_config())
SEGMENT = load_segment(CONFIG.source.parent / CONFIG.bus.segment)
FASTER = replace(CONFIG, joints=(replace(CONFIG.joints[0], velocity=0.1), *CONFIG.joints[1:]))
SHORT_S = 0.1
DEADLY = 4
"""Seed whose session ends its worker."""


def plan(count: int, seconds: float = SHORT_S, first: int = 1) -> SessionPlan:
    return SessionPlan(CONFIG, SEGMENT, first, count, seconds)


@pytest.fixture(scope="module")
def client(leftovers: Leftovers) -> Iterator[Client]:
    with two_workers(leftovers) as made:
        yield made


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """The table without the costs of each session."""
    rows: list[dict[str, Any]] = pq.read_table(folder).to_pylist()
    for row in rows:
        costs = row.pop("cpu_s"), row.pop("wall_s")
        assert row["outcome"] == "worker_died" or min(costs) > 0.0
    return rows


def soaked(client: Client, wanted: SessionPlan, folder: Path, **arguments: Any) -> SessionSummary:
    soak = SessionRun(
        client, wanted, Parts(folder, wanted), arguments.pop("progress", lambda summary: None), **arguments
    )
    soak.run()
    return soak.summary


def test_the_same_seeds_give_the_same_rows_to_the_bit_wherever_they_run(client: Client, tmp_path: Path) -> None:
    wanted = plan(4, seconds=0.5)
    with patch.object(sessions_cluster, "PART", 3):
        summary = soaked(client, wanted, tmp_path / "soak")
    assert [path.name for path in sorted((tmp_path / "soak").iterdir())] == [
        "part-000000.parquet",
        "part-000001.parquet",
    ]
    here = [asdict(run_session(seed, CONFIG, 0.5)) for seed in range(1, 5)]
    for row in here:
        del row["cpu_s"], row["wall_s"]
    assert rows_of(tmp_path / "soak") == [{"digest": wanted.digest, "seconds": 0.5, **row} for row in here]
    assert len({row["cycles"] for row in here}) > 1
    assert summary.outcomes == {"passed": 4}
    for name in ("largest_step", "largest_acceleration", "largest_speed"):
        assert getattr(summary, name) == max(row[name] for row in here) > 0.0
    assert min(sum(row[count] for row in here) for count in ("commands", "faults")) > 0
    assert len(summary.workers) == 2


def test_a_worker_that_is_killed_loses_no_session(client: Client, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill_one(summary: SessionSummary) -> None:
        if not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    summary = soaked(client, plan(24), tmp_path, progress=kill_one)
    assert summary.outcomes == {"passed": 24}
    assert [row["seed"] for row in rows_of(tmp_path)] == list(range(1, 25))


def deadly(wanted: SessionPlan, seeds: Sequence[int]) -> Batch:
    if DEADLY in seeds:
        os.kill(os.getpid(), signal.SIGKILL)
    return run_batch(wanted, seeds)


def hanging(wanted: SessionPlan, seeds: Sequence[int]) -> Batch:
    def hang(seed: int, *arguments: Any) -> Result:
        while seed == DEADLY:
            pass
        return run_session(seed, *arguments)

    batches = []
    for seed in seeds:
        # However slow the host is, no other session is taken for one that hangs.
        limit_s = 1.0 if seed == DEADLY else 600.0
        with patch.multiple(sessions_cluster, run_session=hang, HANG_S=limit_s, HANG_RATIO=0.0):
            batches.append(run_batch(wanted, [seed]))
    return batches[-1]._replace(results=[result for batch in batches for result in batch.results])


def test_a_session_that_hangs_ends_its_process() -> None:
    pid = os.fork()
    if not pid:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # for the stack, which goes there
        hanging(plan(1, first=DEADLY), [DEADLY])
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 1


HANGS = pytest.mark.long("test_a_session_that_hangs_ends_its_process")


@pytest.mark.parametrize("run", [deadly, pytest.param(hanging, marks=HANGS)])
def test_a_session_that_ends_its_worker_again_or_hangs_is_a_result_and_no_other_is_lost(
    client: Client, tmp_path: Path, run: Run
) -> None:
    summary = soaked(client, plan(10), tmp_path, run=run)
    assert summary.outcomes == {"passed": 9, "worker_died": 1}
    assert {row["seed"]: row["outcome"] for row in rows_of(tmp_path)} == {
        seed: "worker_died" if seed == DEADLY else "passed" for seed in range(1, 11)
    }
    assert [failure.seed for failure in summary.failures] == [DEADLY]


def test_what_is_known_at_an_interruption_is_written_and_the_same_sessions_go_on_from_there(
    client: Client, tmp_path: Path
) -> None:
    def interrupt(summary: SessionSummary) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        soaked(client, plan(12), tmp_path, progress=interrupt)
    known = rows_of(tmp_path)
    assert 0 < len(known) < 12
    ran: list[int] = []
    summary = soaked(client, plan(12), tmp_path, progress=lambda summary: ran.append(summary.sessions))
    assert (min(ran) > len(known), summary.outcomes) == (True, {"passed": 12})
    rows = rows_of(tmp_path)
    assert [row["seed"] for row in rows] == list(range(1, 13))
    assert [row for row in rows if row in known] == known
    for other in (plan(12, seconds=0.2), plan(11), plan(12, first=2), replace(plan(12), config=FASTER)):
        with pytest.raises(SoakError, match="give another folder") as raised:
            soaked(client, other, tmp_path)
        assert raised.value.reason == "output"
    assert rows_of(tmp_path) == rows


def test_a_planted_violation_is_in_the_table_is_replayed_alone_and_its_black_box_opened(
    client: Client, tmp_path: Path
) -> None:
    summary = soaked(client, plan(6, seconds=1.5), tmp_path / "soak", run=run_narrowed)
    failed = summary.failures[0]
    row = next(row for row in rows_of(tmp_path / "soak") if row["seed"] == failed.seed)
    assert row["outcome"] == "violation"
    assert '"kind": "velocity"' in row["violation"]
    with narrowed():
        result, done = replay(failed.seed, CONFIG, 1.5, tmp_path / "box.mcap")
    assert replace(result, cpu_s=0.0, wall_s=0.0) == replace(failed, cpu_s=0.0, wall_s=0.0)
    recording = read(tmp_path / "box.mcap")
    about = recording.about
    assert about.what in [moment.message for moment in about.timeline if moment.time_ns == about.time_ns]
    assert "velocity" in about.what
    # The step is where the recording has it: the target moves faster there than a tenth of the limit.
    assert about.what.startswith(f"{int(recording.records['time_ns'][about.at]) * 1e-9:.4f} s")
    at, period_s = about.at, about.period_ns * 1e-9
    targets = recording.records["sent_position"][at - 2 : at + 1]
    speeds = abs(targets[1:] - targets[:-1]).max(axis=0) / period_s
    assert any(speed > 0.1 * joint.velocity for speed, joint in zip(speeds, CONFIG.joints, strict=True))
    assert any(entry.endswith("accepted") for entry in done)


def test_a_black_box_is_never_overwritten(tmp_path: Path) -> None:
    file = tmp_path / "box.mcap"
    file.write_bytes(b"mine")
    with pytest.raises(RecordingError) as caught:
        replay(1, CONFIG, SHORT_S, file)
    assert (caught.value.kind, file.read_bytes()) == ("exists", b"mine")


def other_version(wanted: SessionPlan, seeds: Sequence[int]) -> Batch:
    batch = run_batch(wanted, seeds)
    return batch if 1 in seeds else batch._replace(results=[replace(r, version="0.0.1") for r in batch.results])


@contextlib.contextmanager
def scheduler(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """A scheduler and a worker as another machine has them, and the scheduler's address."""
    file = folder / "scheduler.json"
    common = ("--scheduler-file", str(file), "--host", "127.0.0.1", "--no-dashboard")
    with contextlib.ExitStack() as opened:
        processes = [
            opened.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", f"distributed.cli.dask_{name}", *common, *options],
                    stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder,
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
                )
            )
            for name, options in (("scheduler", ["--port", "0"]), ("worker", ["--nthreads", "1", "--no-nanny"]))
        ]  # fmt: skip
        for process in processes:
            opened.callback(process.kill)
        while not file.exists() or not (text := file.read_text()):
            time.sleep(0.05)
        yield processes[0], json.loads(text)["address"]


@pytest.mark.long("test_what_is_known_at_an_interruption_is_written_and_the_same_sessions_go_on_from_there")
def test_a_scheduler_that_ends_is_said_and_what_is_known_is_kept(tmp_path: Path) -> None:
    with scheduler(tmp_path) as (process, address), cluster(address) as client:
        assert soaked(client, plan(4), tmp_path / "whole").outcomes == {"passed": 4}
        with pytest.raises(SoakError) as raised:
            soaked(client, plan(60), tmp_path / "part", progress=lambda summary: process.kill())
    known = rows_of(tmp_path / "part")
    assert 0 < len(known) < 60
    assert (raised.value.reason, raised.value.fields["sessions"]) == ("lost", len(known))


def test_a_worker_of_another_version_is_refused_by_its_name(client: Client, tmp_path: Path) -> None:
    with pytest.raises(SoakError) as caught:
        soaked(client, plan(2, first=2), tmp_path, run=other_version)
    assert (caught.value.reason, caught.value.fields["found"]) == ("version", "0.0.1")
    answers = {"tcp://one:1": __version__, "tcp://two:2": ModuleNotFoundError("rtcp")}
    with pytest.raises(SoakError, match=r"tcp://two:2 has no rtcp"):
        sessions_cluster._check_versions(SimpleNamespace(run=lambda *_, **__: answers))


def test_a_worker_with_several_threads_is_refused_by_its_name() -> None:
    with pytest.raises(SoakError, match="the worker tcp://w has 4 threads") as raised:
        sessions_cluster._check_threads(SimpleNamespace(nthreads=lambda: {"tcp://v": 1, "tcp://w": 4}))
    assert raised.value.reason == "workers"


def test_the_digest_follows_what_is_configured_and_not_where_it_lies() -> None:
    moved = replace(CONFIG, source=Path("/elsewhere/arm.yaml"))
    digests = [replace(plan(1), config=config).digest for config in (CONFIG, moved, FASTER)]
    assert digests[0] == digests[1] != digests[2]


def test_a_worker_keeps_nothing_of_its_sessions_though_the_collector_never_runs_by_itself() -> None:
    def kept() -> tuple[int, int, int, int]:
        maps = len(Path("/proc/self/maps").read_text().splitlines())
        return len(gc.get_objects()), len(os.listdir("/proc/self/fd")), maps, threading.active_count()

    gc.disable()
    try:
        run_batch(plan(2), [1, 2])
        objects, files, maps, threads = kept()
        run_batch(plan(6), range(3, 9))
        more_objects, more_files, more_maps, more_threads = kept()
    finally:
        gc.enable()
    assert more_threads == threads
    assert more_files - files < 3  # the cluster of other tests has some
    assert more_objects - objects < 1000  # of six sessions, each of which has some thousand
    assert more_maps - maps < 4


def test_a_session_whose_process_is_killed_leaves_no_file_behind() -> None:
    session = session_of(1)
    try:
        session.commander.start()
        assert not session.commander.simulation.path.parent.exists()
        assert session.commander.simulation.observer.latest() is not None
    finally:
        session.commander.close()
