"""The verdicts of a run, on small suites of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.host import HostFigures
from tests.waiting import until

_CONFTEST = """
import pytest
from tests import verdicts
from tests.host import HostFigures
from tests.leftovers import Leftovers

class Host:
    def reset(self): pass
    def figures(self): return HostFigures(STALL, 0.0, 1.0)

def pytest_configure(config):
    for marker in ("platform", "timing", "long"):
        config.addinivalue_line("markers", marker)
    plugin = verdicts.Verdicts(config)
    plugin._host = Host()
    config.pluginmanager.register(plugin, "verdicts")

@pytest.fixture(autouse=True)
def left():
    table = Leftovers()
    before = table.running()
    yield
    assert not (found := table.end_new(before)), f"left behind: {found}"
"""


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    return tmp_path


def run(suite: Path, test: str, *options: str, stall_s: float = 0.0) -> tuple[int, str]:
    """Run one test file; return the exit status and what was printed."""
    (suite / "conftest.py").write_text(f"STALL = {stall_s}\n{_CONFTEST}")
    (suite / "test_it.py").write_text(f"import subprocess, sys\nfrom pathlib import Path\nimport pytest\n{test}")
    plugins = ("no:cacheprovider", "xdist", "pytest_rerunfailures", "pytest_randomly")
    loaded = [word for plugin in plugins for word in ("-p", plugin)]
    command = [sys.executable, "-m", "pytest", *loaded, "--rootdir", str(suite), str(suite), *options]
    alone = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, env=alone, text=True, capture_output=True, check=False)
    return done.returncode, done.stdout + done.stderr


_TIMED = "@pytest.mark.timing\ndef test_time(): assert False\n"
_FLAKY = """
@pytest.mark.platform
def test_luck():
    here = Path(__file__ + '.ran')
    ran = here.exists()
    here.touch()
    assert ran
"""
_NOT_SELECTED = """
@pytest.mark.long("test_short")
def test_long(): pass
@pytest.mark.platform
def test_other(): pass
def test_short(): pass
"""


def test_a_measurement_that_fails_on_a_stalled_host_is_inconclusive(suite: Path) -> None:
    status, printed = run(suite, _TIMED, stall_s=0.02)
    assert status == 0
    assert "1 inconclusive" in printed
    assert "longest stall 20.0 ms" in printed


def test_a_measurement_that_fails_on_a_quiet_host_fails(suite: Path) -> None:
    assert run(suite, _TIMED)[0] == 1


def test_a_stalled_host_excuses_no_other_test(suite: Path) -> None:
    assert run(suite, _TIMED.replace("timing", "platform"), stall_s=0.02)[0] == 1


def test_a_test_that_passes_at_the_second_try_is_listed_with_seed_and_host(suite: Path) -> None:
    status, printed = run(suite, _FLAKY, "--randomly-seed=7", stall_s=0.02)
    assert status == 0
    assert "flaky, seed 7" in printed
    assert "test_luck (call): longest stall 20.0 ms" in printed


@pytest.mark.parametrize("options", [(), ("--numprocesses", "2")])
def test_a_flaky_test_fails_the_run_on_request(suite: Path, options: tuple[str, ...]) -> None:
    assert run(suite, _FLAKY, "--fail-on-flaky", *options)[0] == 7


def test_what_the_end_of_the_session_finds_fails_the_run_though_its_last_test_runs_again(suite: Path) -> None:
    at_the_end = """
from tests.leftovers import FoundAtTheEnd
@pytest.fixture(scope="session")
def table():
    yield
    ran = Path(__file__ + '.ran')
    is_first = not ran.exists()
    ran.touch()
    if is_first:
        raise FoundAtTheEnd()
@pytest.mark.platform
def test_it(table): pass
"""
    assert run(suite, at_the_end)[0] == 1


def test_a_stalled_host_does_not_excuse_what_a_measurement_leaves(suite: Path) -> None:
    leaves = "@pytest.fixture\ndef left():\n    yield\n    assert False\n@pytest.mark.timing\ndef test_it(left): pass"
    assert run(suite, leaves, stall_s=0.02)[0] == 1


def test_only_tests_on_a_platform_have_a_second_try(suite: Path) -> None:
    assert run(suite, _FLAKY.replace("@pytest.mark.platform\n", ""))[0] == 1


@pytest.mark.parametrize("options", [(), ("--numprocesses", "2")])
def test_the_last_line_counts_what_was_not_selected_and_why(suite: Path, options: tuple[str, ...]) -> None:
    _, printed = run(suite, _NOT_SELECTED, "-m", "not long and not platform", *options)
    assert printed.splitlines()[-1] == (
        "not selected: 1 long, `make test-all` runs them; 1 on a real platform, `make test` runs them"
    )


def test_the_suite_keeps_its_rules(request: pytest.FixtureRequest) -> None:
    assert request.config.pluginmanager.get_plugin("verdicts").problems == []


@pytest.mark.parametrize(
    ("test", "found"),
    [
        ("@pytest.mark.long\ndef test_alone(): pass", "needs the name of its short sibling"),
        ("@pytest.mark.platform\n@pytest.mark.parametrize('n', range(151))\ndef test_many(n): pass", "151 tests run"),
    ],
)
def test_a_broken_rule_of_the_suite_is_found(suite: Path, test: str, found: str) -> None:
    rules = "\ndef test_rules(request):\n    assert not request.config.pluginmanager.get_plugin('verdicts').problems"
    status, printed = run(suite, f"{test}\n{rules}", "-k", "rules")
    assert status == 1
    assert found in printed


def test_a_process_that_a_test_leaves_fails_that_test_and_is_ended(suite: Path) -> None:
    start = "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'], start_new_session=True)"
    status, printed = run(suite, f"def test_leaves():\n    {start}\n\ndef test_after(): pass\n", "-p", "no:randomly")
    assert status == 1
    assert "left behind" in printed
    assert "2 passed, 1 error" in printed


def test_what_a_killed_run_leaves_is_ended() -> None:
    script = """
import os, subprocess
from tests.host import watched
from tests.leftovers import Leftovers
Leftovers()
with watched():
    print(subprocess.Popen(["sleep", "1000"], start_new_session=True).pid, flush=True)
    os.kill(os.getpid(), 9)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    until(lambda: not psutil.pid_exists(int(done.stdout)), "the end of what it left")


def test_stolen_time_counts_as_a_stall() -> None:
    assert HostFigures(0.0, 0.1, 0.0).stalled
    assert not HostFigures(0.004, 0.04, 9.0).stalled
