"""Sessions of many seeds on a Dask cluster, and their results as Parquet files.

The seeds are cut into batches, a task each. Only some tasks a worker are under way, so that a million sessions need no
more memory than a hundred. A worker that dies takes its batch along: the batch is repeated, each of its sessions alone,
and a session that ends its worker again, or hangs, is reported as `worker_died`.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import hashlib
import json
import logging
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Literal, NamedTuple

import dask
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
from distributed import Client, Future, LocalCluster, as_completed
from distributed.scheduler import KilledWorker

import rtcp
from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.config.segment import SegmentConfig
from rtcp.config.serialization import to_json
from rtcp.testing.sessions.coverage import Coverage
from rtcp.testing.sessions.run import Segment, run_session
from rtcp.testing.sessions.session import Result

PART = 1000
"""Sessions of a part of the results: the seeds of a file are the same wherever and in whatever order they ran."""
BATCH = 8
"""Most sessions of a task: several seconds of work, against a millisecond of the scheduler's."""
UPDATES = 20
"""Least number of tasks of each thread, where sessions are enough: progress shows, an interruption loses less."""
TASKS_PER_THREAD = 3
"""Tasks under way for each thread of the workers."""
COVERAGE_FILE = "coverage.json"
"""File of the coverage table in the folder of the results."""
SHOWN_FAILURES = 10
"""Failures that a summary has; the files have all."""
HANG_S, HANG_RATIO = 60.0, 200.0
"""Longest time of a session, s, and for each second simulated; beyond, its worker prints where it hangs, and ends."""
TIMEOUT_S = 10.0
"""Time for a scheduler to answer and for its first worker to come, s."""
_TYPES = {"int": pa.int64(), "float": pa.float64(), "str": pa.string(), "Outcome": pa.string()}
_COLUMNS = [pa.field(column.name, _TYPES[str(column.type)]) for column in fields(Result)]
SCHEMA = pa.schema([pa.field("digest", pa.string()), pa.field("seconds", pa.float64()), *_COLUMNS])

_LOCAL = {
    # Nobody but its own sessions ends a local worker: at the first death its batch is taken apart.
    "distributed.scheduler.allowed-failures": 0,
    # The profiler keeps an hour of stacks: the worker would grow all that time.
    "distributed.worker.profile.enabled": False,
}
"""Configuration of a local cluster."""

Reason = Literal["scheduler", "workers", "version", "output", "lost"]


class SoakError(Exception):
    """The sessions cannot be run; the message says where and why.

    Attributes:
        reason: scheduler (it does not answer), workers (there are none, or with several threads), version (a worker has
            another one), output (the results cannot be written, or are those of others), lost (the scheduler ended).
        fields: the values found and allowed, by name.
    """

    def __init__(self, reason: Reason, message: str, **fields: Any) -> None:
        super().__init__(message)
        self.reason, self.fields = reason, fields


@dataclass(frozen=True)
class SessionPlan:
    """What is run: the sessions of consecutive seeds."""

    config: ArmConfig | CellConfig
    segment: Segment
    first: int
    count: int
    seconds: float
    """Simulated time of a session, s."""

    @property
    def digest(self) -> str:
        """Digest of the configuration and of the segment, whatever the place of their files."""
        if isinstance(self.config, CellConfig):
            config: Any = self.config.digest
        else:
            slaves = tuple(replace(slave, file="") for slave in self.config.slaves)
            config = to_json(replace(self.config, source=Path(), slaves=slaves))
        segments = [self.segment] if isinstance(self.segment, SegmentConfig) else self.segment.values()
        text = json.dumps([config, *(to_json(segment.slaves) for segment in segments)], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class Batch(NamedTuple):
    """Results of a task, and the worker that ran it."""

    results: list[Result]
    worker: str
    rss: int
    """Resident memory of the worker's process afterwards, bytes."""


def run_batch(plan: SessionPlan, seeds: Sequence[int]) -> Batch:
    """Run some sessions of a plan in this process."""
    results = []
    for seed in seeds:
        # From a thread of its own, which no loop of a session holds up.
        faulthandler.dump_traceback_later(HANG_S + HANG_RATIO * plan.seconds, exit=True)
        try:
            results.append(run_session(seed, plan.config, plan.seconds, plan.segment))
        finally:
            faulthandler.cancel_dump_traceback_later()
    # The objects of a session refer to each other: among a worker's many others they pile up.
    gc.collect()
    return Batch(results, f"{os.uname().nodename}:{os.getpid()}", psutil.Process().memory_info().rss)


Run = Callable[[SessionPlan, Sequence[int]], Batch]


@dataclass
class Memory:
    """Resident memory of one worker's process, bytes."""

    first: int
    """After its first batch."""
    last: int = 0
    sessions: int = 0


@dataclass
class SessionSummary:
    """What became of the sessions."""

    digest: str
    seed: int
    seconds: float
    """Simulated time of a session, s."""
    outcomes: dict[str, int] = field(default_factory=dict)
    simulated_s: float = 0.0
    cycles: int = 0
    largest_step: float = 0.0
    largest_acceleration: float = 0.0
    largest_speed: float = 0.0
    coverage: Coverage = field(default_factory=Coverage)
    failures: list[Result] = field(default_factory=list)
    """The first failed sessions, by their seeds."""
    workers: dict[str, Memory] = field(default_factory=dict)
    cpu_s: float = 0.0
    """CPU time of all sessions, s."""
    wall_s: float = 0.0

    @property
    def sessions(self) -> int:
        """Sessions with a result."""
        return sum(self.outcomes.values())

    @property
    def failed(self) -> int:
        """Sessions that did not pass."""
        return self.sessions - self.outcomes.get("passed", 0)

    def add(self, result: Result) -> None:
        """Count a session."""
        self.outcomes[result.outcome] = self.outcomes.get(result.outcome, 0) + 1
        self.simulated_s += result.simulated_s
        self.cycles += result.cycles
        self.cpu_s += result.cpu_s
        self.coverage.add(Coverage.from_json(result.coverage))
        for name in ("largest_step", "largest_acceleration", "largest_speed"):
            setattr(self, name, max(getattr(self, name), getattr(result, name)))
        if result.outcome != "passed":
            self.failures = sorted([*self.failures, result], key=lambda each: each.seed)[:SHOWN_FAILURES]

    def add_worker(self, batch: Batch) -> None:
        """Note the memory of a worker."""
        memory = self.workers.setdefault(batch.worker, Memory(batch.rss))
        memory.last = batch.rss
        memory.sessions += len(batch.results)


class Parts:
    """The folder of the results: a Parquet file for each `PART` seeds, written when it is complete.

    Any reader of Parquet takes the folder as one table: pandas, Polars, DuckDB. What a run that was ended left in it is
    `known` and goes on.

    Raises:
        SoakError: other files or other sessions are in it, or it cannot be written.
    """

    def __init__(self, folder: Path, plan: SessionPlan) -> None:
        self.known: set[int] = set()
        """Seeds whose results were there before."""
        self._folder, self._plan, self._digest = folder, plan, plan.digest
        self._results: dict[int, list[Result]] = {}
        with self._writes():
            folder.mkdir(parents=True, exist_ok=True)
            if not os.access(folder, os.W_OK):
                raise PermissionError(13, os.strerror(13))

    def read(self) -> Iterator[Result]:
        """Yield the results that are in the folder.

        Raises:
            SoakError: they are not those of this plan.
        """
        plan = self._plan
        mine, seeds = (self._digest, plan.seconds, rtcp.__version__), range(plan.first, plan.first + plan.count)
        for file in sorted(self._folder.iterdir()):
            if file.suffix == ".mcap" or file.name == COVERAGE_FILE or file.name.endswith(".new"):
                continue
            why, rows = "sessions of another configuration, length, version or seed", []
            try:
                rows = pq.read_table(file, schema=SCHEMA).to_pylist()
            except (OSError, pa.ArrowInvalid) as error:
                why = str(error)
            heads = {(row.pop("digest"), row.pop("seconds"), row["version"]) for row in rows}
            numbers = {(row["seed"] - plan.first) // PART if row["seed"] in seeds else -1 for row in rows}
            if heads != {mine} or {self._file(number) for number in numbers} != {file}:
                message = f"{file} is no result of these sessions ({why}): give another folder"
                raise SoakError("output", message, folder=str(self._folder), file=str(file))
            results = [Result(**row) for row in rows]
            self.known.update(result.seed for result in results)
            if len(rows) < self._size(number := numbers.pop()):
                self._results[number] = results
            yield from results

    def _file(self, number: int) -> Path:
        return self._folder / f"part-{number:06d}.parquet"

    def _size(self, number: int) -> int:
        return min(PART, self._plan.count - number * PART)

    @contextlib.contextmanager
    def _writes(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            message = f"{self._folder}: results cannot be written there: {error.strerror or error}"
            raise SoakError("output", message, folder=str(self._folder)) from error

    def add(self, result: Result) -> None:
        """Add the result of a session."""
        number = (result.seed - self._plan.first) // PART
        results = self._results.setdefault(number, [])
        results.append(result)
        if len(results) == self._size(number):
            self._write(number)

    def finish(self) -> None:
        """Write the parts that are not complete."""
        for number in sorted(self._results):
            self._write(number)

    def write_coverage(self, coverage: Coverage, rows: Coverage) -> Path:
        """Write the whole coverage table and its empty rows; return the file."""
        path = self._folder / COVERAGE_FILE
        with self._writes():
            path.write_text(json.dumps({**coverage.as_dict(), "empty": coverage.empty(rows)}, indent=1))
        return path

    def _write(self, number: int) -> None:
        rows = sorted(self._results.pop(number), key=lambda result: result.seed)
        columns = {column.name: [getattr(row, column.name) for row in rows] for column in _COLUMNS}
        same = {"digest": [self._digest] * len(rows), "seconds": [self._plan.seconds] * len(rows)}
        table = pa.table({**same, **columns}, schema=SCHEMA)
        path = self._file(number)
        new = path.with_name(f".{path.name}.new")
        with self._writes():
            pq.write_table(table, new)
            os.replace(new, path)


@contextlib.contextmanager
def _interruptions_later() -> Iterator[None]:
    """Let a Ctrl-C take effect after the block; processes that begin in it, which a terminal reaches too, ignore it."""
    resource_tracker.ensure_running()  # its start would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[Client]:
    """Yield a client of a scheduler, or of a local cluster with a process on each CPU; at its end the latter ends.

    Raises:
        SoakError: the scheduler does not answer, has no workers, or one of another version or with several threads.
    """
    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if address is None:
        with contextlib.ExitStack() as opened:
            opened.enter_context(dask.config.set(_LOCAL))
            with _interruptions_later():
                local = LocalCluster(
                    n_workers=len(os.sched_getaffinity(0)), threads_per_worker=1, host="127.0.0.1",
                    dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
                )  # fmt: skip
                opened.enter_context(local)
                client = opened.enter_context(Client(local))
            yield client
        return
    try:
        client = Client(address, timeout=TIMEOUT_S)
    except (OSError, ValueError) as error:
        message = f"--scheduler {address}: no Dask scheduler answers within {TIMEOUT_S:g} s: {error}"
        raise SoakError("scheduler", message, address=address) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=TIMEOUT_S)
        except TimeoutError as error:
            message = f"the scheduler {address} has no workers: start them by `dask worker {address} --nthreads 1`"
            raise SoakError("workers", message, address=address) from error
        _check_threads(client)
        _check_versions(client)
        yield client


def _check_threads(client: Client) -> None:
    """Refuse workers with several threads, raising SoakError: they take turns, and one that hangs holds the others."""
    for worker, threads in sorted(client.nthreads().items()):
        if threads > 1:
            message = f"the worker {worker} has {threads} threads: start it by `dask worker ... --nthreads 1`"
            raise SoakError("workers", message, worker=worker, threads=threads)


def _check_versions(client: Client) -> None:
    """Compare the version of every worker with this one; raises SoakError.

    A worker without the package cannot load a function of ours: it evaluates a text.
    """
    wanted = rtcp.__version__
    versions = client.run(eval, "__import__('rtcp').__version__", on_error="return")
    for worker, version in sorted(versions.items()):
        if version != wanted:
            installed = "no rtcp" if isinstance(version, Exception) else f"rtcp {version}"
            message = f"the worker {worker} has {installed}, this command {wanted}: install the same version there"
            raise SoakError("version", message, worker=worker, found=installed, wanted=wanted)


class SessionRun:
    """Runs the sessions of a plan and collects their results.

    Args:
        client: of the cluster.
        plan: what is run.
        parts: where the results are written.
        progress: called with the summary after each task.
        run: runs a batch in a worker; `run_batch`.

    Raises:
        SoakError: the folder of the results has other sessions.
    """

    def __init__(
        self,
        client: Client,
        plan: SessionPlan,
        parts: Parts,
        progress: Callable[[SessionSummary], None],
        run: Run = run_batch,
    ) -> None:
        self.summary = SessionSummary(plan.digest, plan.first, plan.seconds)
        self._client, self._plan, self._parts, self._progress, self._run = client, plan, parts, progress, run
        self._suspects: deque[int] = deque()
        """Seeds whose worker died."""
        for result in parts.read():
            self.summary.add(result)

    def run(self) -> None:
        """Run to the end; what is known by an interruption is written.

        Raises:
            SoakError: a worker has another version, the scheduler ended, or the results cannot be written.
        """
        began = time.monotonic()
        try:
            self._run_batches()
            while self._suspects:
                # One at a time: who dies now is to blame.
                self._run_alone(self._suspects.popleft())
        except (CancelledError, OSError) as error:
            message = f"the scheduler, or the connection to it, ended after {self.summary.sessions} sessions"
            raise SoakError("lost", message, sessions=self.summary.sessions) from error
        finally:
            self.summary.wall_s = time.monotonic() - began
            self._parts.finish()

    def _run_batches(self) -> None:
        batches = self._batches()
        running = as_completed()
        seeds: dict[str, list[int]] = {}
        self._submit(batches, running, seeds)
        for future in running:
            batch = seeds.pop(future.key)
            if not self._take(future):
                self._suspects.extend(batch)
            self._submit(batches, running, seeds)

    def _batches(self) -> Iterator[list[int]]:
        plan, known = self._plan, self._parts.known
        threads = max(sum(self._client.nthreads().values()), 1)
        size = max(1, min(BATCH, plan.count // (UPDATES * threads)))
        seeds = (seed for seed in range(plan.first, plan.first + plan.count) if seed not in known)
        return iter(lambda: list(islice(seeds, size)), [])

    def _submit(self, batches: Iterator[list[int]], running: as_completed, seeds: dict[str, list[int]]) -> None:
        """Submit batches until enough are under way for the workers that there are now."""
        most = TASKS_PER_THREAD * max(sum(self._client.nthreads().values()), 1)
        while len(seeds) < most and (batch := next(batches, None)) is not None:
            future = self._client.submit(self._run, self._plan, batch, pure=False)
            seeds[future.key] = batch
            running.add(future)

    def _run_alone(self, seed: int) -> None:
        if not self._take(self._client.submit(self._run, self._plan, [seed], pure=False)):
            self._add(Result(seed, "worker_died"))
            self._progress(self.summary)

    def _take(self, future: Future) -> bool:
        """Add the results of a batch; return False where its worker died."""
        try:
            batch: Batch = future.result()
        except KilledWorker:
            return False
        except (CancelledError, OSError):
            raise
        except Exception as error:
            # The sessions' own errors are results: the worker could not load what it was sent.
            message = f"a worker cannot run sessions ({type(error).__name__}: {error}): install rtcp {rtcp.__version__}"
            raise SoakError("version", message, found=str(error), wanted=rtcp.__version__) from error
        self.summary.add_worker(batch)
        for result in batch.results:
            if result.version != rtcp.__version__:
                message = f"the worker {batch.worker} has rtcp {result.version}, this command {rtcp.__version__}"
                raise SoakError("version", message, worker=batch.worker, found=result.version)
            self._add(result)
        self._progress(self.summary)
        return True

    def _add(self, result: Result) -> None:
        self.summary.add(result)
        self._parts.add(result)
