"""Settings of every test: the verdicts, the directories of a test, leftover processes, and the values of properties.

Properties are tried with the same values in every run. `HYPOTHESIS_PROFILE=search make test` tries other values.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoints
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadFileScheduling

from kinematics.compiled import BUILD
from rtcp.config import find
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.schema import arm_schema
from tests.leftovers import FoundAtTheEnd, Leftovers
from tests.samples import THOROUGH
from tests.verdicts import Verdicts

_UNHURRIED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.register_profile("same", parent=_UNHURRIED, derandomize=True, max_examples=100 if THOROUGH else 10)
settings.register_profile("search", parent=_UNHURRIED)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell that starts the tests in the background lets them, and every process that they start, ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)

_installed = find.installed


@cache
def _own(group: str) -> EntryPoints:
    """Return the entry points of this package: no test sees the plug-ins of other installed packages."""
    return EntryPoints(entry for entry in _installed(group) if entry.dist is not None and entry.dist.name == "rtcp")


find.installed = _own


def pytest_configure(config: pytest.Config) -> None:
    """Add the plugin that judges the tests."""
    config.pluginmanager.register(Verdicts(config), "verdicts")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that only the interpreter allows where the cycle runs compiled."""
    for item in items:
        if BUILD.is_used and item.get_closest_marker("interpreted"):
            item.add_marker(
                pytest.mark.skip(reason="it does what compiled code does not allow: replace a method, or pickle")
            )


class _Files(LoadFileScheduling):
    """Gives a file to one worker, and all files with a browser to the same one: no two browsers run at a time."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return "tests/panel" if file.startswith("tests/panel/") else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling | None:
    """Distribute the tests by file where `--dist loadfile` says so."""
    return _Files(config, log) if config.getoption("dist") == "loadfile" else None


# -- every test has directories of its own, and leaves no process behind ------------------------------------------

_numbers = count()


@pytest.fixture(scope="session")
def leftovers() -> Iterator[Leftovers]:
    """The process table. At the end of the session no process of a test may be left."""
    table = Leftovers()
    yield table
    if left := table.end_all():
        raise FoundAtTheEnd(f"left by the fixtures of modules or of the session: {left}")


@pytest.fixture(autouse=True)
def _own_directories(
    leftovers: Leftovers, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Runtime directory and state directory of this test alone; fails the test if it leaves a process behind."""
    base = tmp_path_factory.getbasetemp() / f"rtcp{next(_numbers)}"
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(base / "run"))
    monkeypatch.setenv("RTCP_STATE_DIR", str(base / "state"))
    before = leftovers.running()
    yield
    assert not (left := leftovers.end_new(before)), f"this test left processes behind: {left}"


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
