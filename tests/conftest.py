"""What holds for every test: properties are tried with the same values in every run, none has a time limit, none reads
or writes the zero offsets of the arm at this host, and none sees the plug-ins of other installed packages.

A test that fails once in a hundred runs names a mistake to whoever happens to run it. To search on with values of
chance: `HYPOTHESIS_PROFILE=search make test`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoints
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from kinematics.compiled import BUILD
from rtcp.config import find
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.schema import arm_schema

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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave out what only the interpreter allows where the cycle runs compiled; give what runs in real time two further
    tries, because a shared host may take the CPU away for longer than anything allows. The summary lists them.
    """
    for item in items:
        if item.get_closest_marker("alone"):
            item.add_marker(pytest.mark.flaky(reruns=2))
        if BUILD.is_used and item.get_closest_marker("interpreted"):
            item.add_marker(
                pytest.mark.skip(reason="it does what compiled code does not allow: replace a method, or pickle")
            )


@pytest.fixture(scope="session", autouse=True)
def state_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Where zero offsets are kept for as long as the tests run, also by the processes that they start."""
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
