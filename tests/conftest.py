"""Settings of every test: properties are tried with the same values in every run, none has a time limit, none reads
or writes the zero offsets of the arm at this host, and none sees the plug-ins of other installed packages.

A test that fails once in a hundred runs names a mistake to whoever happens to run it. To search on with values of
chance: `HYPOTHESIS_PROFILE=search make test`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Generator, Iterator
from functools import cache
from importlib.metadata import EntryPoints
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from kinematics.compiled import BUILD
from rtcp.config import find
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.schema import arm_schema
from tests.durations import read as durations_of_tests
from tests.stalls import LIMIT_S, Stalls, may_run_in_real_time, watched

_UNHURRIED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same", parent=_UNHURRIED, derandomize=True)
settings.register_profile("search", parent=_UNHURRIED)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Begun in the background by a shell, which has its children ignore Ctrl-C, and so all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)

_installed = find.installed


@cache
def _own(group: str) -> EntryPoints:
    """Return the entry points of this package."""
    return EntryPoints(entry for entry in _installed(group) if entry.dist is not None and entry.dist.name == "rtcp")


find.installed = _own


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option by which `make check` and `make test` leave out long tests."""
    parser.addoption("--longest", type=float, metavar="S", help="leave out what takes longer (durations.txt)")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what only the interpreter allows where the cycle runs compiled; repeat a test in real time, twice at
    most, where the host kept the CPU from it (`_came_late`). The summary lists these.
    """
    longest, durations = config.getoption("longest"), durations_of_tests()
    if longest is not None:
        long = {item for item in items if durations.get(item.nodeid, 0.0) > longest}
        config.hook.pytest_deselected(items=list(long))
        items[:] = [item for item in items if item not in long]
    for item in items:
        if item.get_closest_marker("browser"):
            # Chromium draws in software, on the CPUs that its platform needs.
            item.add_marker(pytest.mark.flaky(reruns=2))
        elif item.get_closest_marker("alone"):
            item.add_marker(pytest.mark.flaky(reruns=2, condition=_came_late))
        if BUILD.is_used and item.get_closest_marker("interpreted"):
            item.add_marker(
                pytest.mark.skip(reason="it does what compiled code does not allow: replace a method, or pickle")
            )


_stalls: list[Stalls] = []
"""The watcher of the host, from the first test in real time on."""


def _host_stalled() -> bool:
    """Whether the host took the CPU away for too long since the test began."""
    return bool(_stalls) and _stalls[0].longest_s > LIMIT_S


_LATE = ("out_of_points", "partner_not_ready", "stream_ended", "lease_expired")
"""Reasons of errors of a client that sent too late for its own motion."""


def _came_late(error: BaseException | None) -> bool:
    """Whether the host can have kept the CPU from a process of the test: the watcher saw it, no watcher could see it,
    or the platform's error says so.
    """
    return not may_run_in_real_time() or _host_stalled() or (isinstance(error, RtcpError) and error.reason in _LATE)


@pytest.fixture(scope="session")
def stalls() -> Iterator[None]:
    """A watcher of the host."""
    with watched() as watcher:
        _stalls.append(watcher)
        yield
        _stalls.clear()


@pytest.fixture(autouse=True)
def host(request: pytest.FixtureRequest) -> None:
    """Count delays of the host from here on, beside a test in real time."""
    if request.node.get_closest_marker("alone"):
        request.getfixturevalue("stalls")
        _stalls[0].reset()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Name the delay in the report of a test that failed."""
    report = yield
    if report.failed and _host_stalled():
        report.sections.append(("the host", f"took the CPU away for {1e3 * _stalls[0].longest_s:.0f} ms"))
    return report


@pytest.fixture(scope="session", autouse=True)
def state_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Directory of zero offsets during the tests, also for the processes that they start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTCP_STATE_DIR", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def path() -> Iterator[Path]:
    """A blackboard's file in shared memory, removed at the end."""
    made = Path(f"/dev/shm/rtcp-test-{os.getpid()}")
    yield made
    made.unlink(missing_ok=True)


@pytest.fixture
def board(path: Path) -> Iterator[Blackboard]:
    """A blackboard of six joints."""
    made = Blackboard(path, arm_schema(6), 500_000)
    yield made
    made.close()
