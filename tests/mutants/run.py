"""`make mutants`: put small mistakes into a copy of this tree, one at a time, and see whether the tests notice them.

A first run of the tests records which of them execute which statement; `.mutants` keeps it, and a changed file of
tests is recorded again. For each mistake the tests of its statement run until one fails. They run
in a fork of a process that has loaded the libraries, so that a mistake takes about two seconds more than its tests.
"""

from __future__ import annotations

import argparse
import difflib
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from tests.copied_tree import ROOT, copy_tree
from tests.mutants.kinds import Mutant, mutants_of
from tests.mutants.recording import Recorder, Recording, record_of, statement_at

TARGETS = (
    *("rtcp/control", "rtcp/devices", "rtcp/fieldbus/process_data.py", "rtcp/motion/drive_writers.py"),
    *("rtcp/motion/guards", "rtcp/motion/step_group.py", "rtcp/processes/shape_setting", "rtcp/realtime/discipline.py"),
)
TESTS = "not platform and not long"
"""Marker expression of the tests, as in `make check`."""
FOLDERS = ("devices", "realtime", "processes", "fieldbus", "motion", "control", "cell", "sessions", "config", "faults")
TESTS_S = 30.0
"""The tests of one mistake take this CPU time at most. The others are left out, and the report says so."""
_PLAIN = ("-q", "-p", "no:cacheprovider", "-p", "no:randomly")
LEAST_KILLED = 85.0
MEMORY_BYTES = 8 << 30
"""A mistake can make a loop endless, and the loop must not take the memory of the host."""


class _Chosen:
    """Plug-in of pytest: keeps the chosen tests, in their order."""

    def __init__(self, tests: Iterable[str]) -> None:
        self._place = {test: place for place, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted((item for item in items if item.nodeid in self._place), key=lambda i: self._place[i.nodeid])


def _forked(work: Callable[[], int], log: Path, cpu_s: float, limit_s: float) -> int | None:
    """Do the work in a child process with its output in a file; return its exit status, None after a time limit.

    An endless loop ends by its CPU time, so that a busy host makes no test fail; what only waits ends by the clock.
    """
    child = os.fork()
    if child == 0:
        status = 70
        try:
            os.setsid()
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            sys.modules.pop("tests", None)
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(out, 1)
            os.dup2(out, 2)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
            resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s), int(cpu_s) + 1))
            status = work()
        finally:
            sys.stdout.flush()
            os._exit(status)
    end = time.monotonic() + limit_s
    try:
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                child, code = 0, os.waitstatus_to_exitcode(status)
                return None if code in (-signal.SIGXCPU, -signal.SIGKILL) else code
            time.sleep(0.02)
        return None
    finally:
        if child:
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)


def _files(target: str) -> list[str]:
    path = ROOT / target
    return [str(file.relative_to(ROOT)) for file in ([path] if path.is_file() else sorted(path.rglob("*.py")))]


def _record(files: list[str], folder: Path) -> int:
    """Run these files of tests and record which statements each test executes. In the child process, in the copy."""
    recorder = Recorder((file for target in TARGETS for file in _files(target)), files, folder)
    return int(pytest.main([*_PLAIN, "-m", TESTS, *files], plugins=[recorder]))


def _recorded(log: Path) -> Recording:
    """Return the record, after the files of tests that changed have been recorded again."""
    folder = ROOT / ".mutants"
    folder.mkdir(exist_ok=True)
    recording = Recording(folder)
    recording.read(file for name in FOLDERS for file in sorted(Path("tests", name).rglob("test_*.py")))
    if recording.missing:
        print(f"recording what the tests of {len(recording.missing)} files execute", flush=True)
        files = [Path(file) for file in recording.missing]
        for file in recording.missing:
            record_of(folder, file).unlink(missing_ok=True)
        if _forked(partial(_record, recording.missing, folder), log, 7200.0, 14400.0) not in (0, 1, 5):
            sys.exit(log.read_text())
        recording.missing = []
        recording.read(files)
    if recording.failed:
        print(f"{len(recording.failed)} tests fail without a mistake and are left out: {recording.failed[:5]}")
    return recording


def _change(before: str, after: str) -> tuple[str, str]:
    """Return the changed lines before and after, each as one line."""
    lines = list(difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm=""))[2:]
    removed, added = (" ⏎ ".join(" ".join(line[1:].split()) for line in lines if line[0] == sign) for sign in "-+")
    return removed, added


def _accepted() -> dict[tuple[str, str, str], str]:
    entries = YAML(typ="safe").load(Path(__file__).with_name("accepted.yaml")) or []
    return {(entry["file"], entry["correct"], entry["mutant"]): entry["reason"] for entry in entries}


def _sample(files: list[str], seed: int, count: int) -> Iterator[tuple[Mutant, str, str]]:
    """Yield mistakes drawn by the seed, each with the file's text before and after."""
    texts = {file: Path(file).read_text() for file in files}
    mutants = [mutant for file in files for mutant in mutants_of(file, texts[file])]
    random.Random(seed).shuffle(mutants)
    print(f"{len(mutants)} mistakes can be made in {len(files)} files; seed {seed}", flush=True)
    for mutant in mutants:
        after = mutant.code(texts[mutant.path])
        with suppress(SyntaxError):
            compile(after, mutant.path, "exec")
            yield mutant, texts[mutant.path], after
            count -= 1
        if count == 0:
            return


def _run(tests: list[str]) -> int:
    """Run the tests until one fails. In the child process, in the copy."""
    files = dict.fromkeys(test.partition("::")[0] for test in tests)
    arguments = [*_PLAIN, "-x", "--tb=short", "--timeout=0"]
    return int(pytest.main([*arguments, *files], plugins=[_Chosen(tests)]))


def _parts(path: str, tests: list[str]) -> Iterator[list[str]]:
    """Yield the tests in three parts, those beside the file first: most mistakes are noticed there, and the files of
    the other tests then need not be collected.
    """
    area, name = f"/{path.split('/')[1]}/", f"test_{Path(path).stem}"
    files = list(dict.fromkeys(test.partition("::")[0] for test in tests))
    files.sort(key=lambda file: (name not in file, area not in file))
    for part in (files[:2], files[2:8], files[8:]):
        if part:
            yield [test for test in tests if test.partition("::")[0] in part]


_PASSED = (0, 5)
"""Exit statuses of pytest: all passed; no test ran, as a mistake can rename the cases of a test."""


def _verdict(status: int | None, log: str) -> str:
    if status is None:
        return "timeout"
    if status == 70:
        sys.exit(f"the tests could not be run:\n{log}")
    return "survived" if status in _PASSED else "killed"


def _load() -> None:
    """Load the libraries of the tests, and nothing of this tree."""
    for name in ("hypothesis", "numpy", "pydantic", "ruckig", "scipy.optimize", "typer"):
        import_module(name)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--file", help="a file or a folder of those that `make mutants` draws from")
    parser.add_argument("--seed", type=int, default=random.randrange(10_000), help="seed of the sample")
    parser.add_argument("--count", type=int, help="number of mistakes: 150, or 60 in one file")
    options = parser.parse_args()
    count = options.count or (60 if options.file else 150)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="rtcp-mutants-") as folder:
        copy, log = Path(folder) / "tree", Path(folder) / "log"
        copy.mkdir()
        copy_tree(copy)
        os.chdir(copy)
        sys.path[0] = os.environ["PYTHONPATH"] = str(copy)
        sys.path_importer_cache.clear()
        _load()
        recording = _recorded(log)
        # Python takes two texts of one length and one second for the same, and would run the compiled form of another.
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        sys.dont_write_bytecode = True
        files = [file for target in ([options.file] if options.file else TARGETS) for file in _files(target)]
        results: dict[str, list[str]] = {verdict: [] for verdict in _VERDICTS}
        with suppress(KeyboardInterrupt):
            _judge(_sample(files, options.seed, count), recording, log, results)
        return _report(results)


def _judge(
    sample: Iterable[tuple[Mutant, str, str]], recording: Recording, log: Path, results: dict[str, list[str]]
) -> None:
    """Try each mistake, and add its description to those of its verdict."""
    accepted = _accepted()
    for number, (mutant, before, after) in enumerate(sample, 1):
        begun = time.monotonic()
        correct, wrong = _change(before, after)
        described = f"{mutant.path}:{mutant.line}\n    correct: {correct}\n    mutant:  {wrong}"
        tests, seconds, every = recording.tests(mutant.path, before, statement_at(before, mutant.line), TESTS_S)
        reason = accepted.get((mutant.path, correct, wrong))
        if reason is not None:
            verdict = "accepted"
            described += f"\n    reason:  {reason}"
        elif not tests:
            verdict = "not covered"
        else:
            path = Path(mutant.path)
            path.write_text(after)
            status: int | None = 0
            for part in _parts(mutant.path, tests):
                status = _forked(partial(_run, part), log, 20.0 + 2.0 * seconds, 300.0 + 20.0 * seconds)
                if status not in _PASSED:
                    break
            path.write_text(before)
            verdict = _verdict(status, log.read_text(errors="replace"))
            described += f"\n    tests:   {len(tests)} of {every} that execute the statement"
        results[verdict].append(described)
        spent, kind = time.monotonic() - begun, type(mutant.operator).__name__
        print(f"{number:4} {verdict:11} {spent:5.1f} s  {mutant.path}:{mutant.line} {kind}", flush=True)


def _report(results: dict[str, list[str]]) -> int:
    """Print what no test noticed, and the figures; return 1 if too few were killed."""
    for verdict in ("accepted", "timeout", "not covered", "survived"):
        if results[verdict]:
            print("\n".join([f"\n{verdict}:", *sorted(results[verdict])]))
    counts = {verdict: len(results[verdict]) for verdict in _VERDICTS}
    judged = sum(counts.values()) - counts["accepted"]
    killed = 100.0 * (counts["killed"] + counts["timeout"]) / max(judged, 1)
    figures = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    print(f"\n{figures}: {killed:.1f} % of those not accepted are killed; at least {LEAST_KILLED:.0f} % are needed")
    return int(killed < LEAST_KILLED)


_VERDICTS = ("killed", "timeout", "survived", "not covered", "accepted")

if __name__ == "__main__":
    sys.exit(main())
