"""The verdicts of a run: what was inconclusive, what was flaky, and which tests were not selected and why.

- A test marked `timing` measures time. If it fails and the host stalled during the test, it is inconclusive.
- A test marked `platform` runs processes in real time. If it fails, it runs once more, unless it measures time. If it
  passes then, it is flaky. A flaky test is listed with the seed and the figures of the host. With `--fail-on-flaky` the
  run fails.
- The last line of the run counts the tests that were not selected.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Generator, Iterable
from typing import Any

import pytest

from tests.host import Host, watched
from tests.leftovers import FoundAtTheEnd

_REASONS = {
    "long": "long, `make test-all` runs them",
    "platform": "on a real platform, `make test` runs them",
}
"""Why tests with a marker are not selected. The first marker that a test has counts."""
_NO_PLATFORM = "without a platform, `make check` runs them"
_OTHER_REASON = "by the options of this run"
_FLAKY_STATUS = 7
"""Exit status of a run with a flaky test, as of pytest-rerunfailures, which does not see the tests of workers."""
MAX_PLATFORM_TESTS = 150
"""At most this many tests of `make test` run on a real platform: simulated time is faster and shows more."""


class Verdicts:
    """A plugin of pytest."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._not_selected: Counter[str] = Counter()
        self._resources = contextlib.ExitStack()
        self._host: Host | None = None
        self.problems: list[str] = []
        """What breaks the rules of the suite; `test_verdicts.py` has a test of it."""

    # -- in the process that runs the tests ---------------------------------------------------------------------

    def pytest_deselected(self, items: Iterable[pytest.Item]) -> None:
        """Count why tests are not selected."""
        on_platforms = self._config.getoption("markexpr").startswith("platform")
        other = _NO_PLATFORM if on_platforms else _OTHER_REASON
        for item in items:
            markers = (reason for name, reason in _REASONS.items() if item.get_closest_marker(name))
            self._not_selected[next(markers, other)] += 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Find what breaks the rules of the suite. Repeat a failed test on a real platform once."""
        names = {item.name.partition("[")[0] for item in items}
        is_whole = self._config.args_source is pytest.Config.ArgsSource.TESTPATHS
        for item in items:
            marker = item.get_closest_marker("long")
            if marker is not None and (not marker.args or (is_whole and marker.args[0].partition("[")[0] not in names)):
                self.problems.append(f"{item.nodeid} is long and needs the name of its short sibling: {marker.args}")
        on_platform = [i for i in items if i.get_closest_marker("platform") and not i.get_closest_marker("long")]
        if (count := len(on_platform)) > MAX_PLATFORM_TESTS:
            self.problems.append(f"{count} tests run on a real platform, allowed are {MAX_PLATFORM_TESTS}")
        for item in items:
            if item.get_closest_marker("platform") and not item.get_closest_marker("timing"):
                item.add_marker(pytest.mark.flaky(reruns=1, rerun_except=[FoundAtTheEnd]))

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Watch the host from the first test on whose verdict may depend on it."""
        if _depends_on_the_host(item):
            self._host = self._host or self._resources.enter_context(watched())
            self._host.reset()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Add the figures of the host to a failure; make it inconclusive where the host can be the reason."""
        report = yield
        if report.failed and self._host is not None and _depends_on_the_host(item):
            figures = self._host.figures()
            report.sections.append(("host", str(figures)))
            report.host = str(figures)  # type: ignore[attr-defined]
            if figures.stalled and item.get_closest_marker("timing") and report.when != "teardown":
                report.outcome, report.inconclusive = "skipped", True  # type: ignore[attr-defined]
                report.longrepr = (str(item.path), 0, f"inconclusive, the host: {figures}")
        return report

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Give the counts to the controller of a distributed run. Let a flaky test fail the run where that is asked."""
        self._resources.close()
        reporter = self._config.pluginmanager.get_plugin("terminalreporter")
        fails = self._config.getoption("fail_on_flaky", False) and session.exitstatus == 0
        if fails and reporter is not None and reporter.stats.get("rerun"):
            session.exitstatus = _FLAKY_STATUS
        if output := getattr(self._config, "workeroutput", None):
            output["not_selected"] = dict(self._not_selected)

    # -- in the process that prints -------------------------------------------------------------------------------

    def pytest_testnodedown(self, node: Any) -> None:
        """Take the counts of a worker: every worker collects all tests."""
        if found := getattr(node, "workeroutput", {}).get("not_selected"):
            self._not_selected = Counter(found)

    def pytest_report_teststatus(self, report: pytest.TestReport) -> tuple[str, str, str] | None:
        """Give inconclusive tests a category of their own."""
        return ("inconclusive", "I", "INCONCLUSIVE") if getattr(report, "inconclusive", False) else None

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """List inconclusive and flaky tests."""
        stats = terminalreporter.stats
        passed = {report.nodeid for report in stats.get("passed", ()) if report.when == "call"}
        flaky = [report for report in stats.get("rerun", ()) if report.nodeid in passed]
        seed = self._config.getoption("randomly_seed", "none")
        for title, reports in (("inconclusive", stats.get("inconclusive", ())), ("flaky", flaky)):
            if reports:
                terminalreporter.section(f"{title}, seed {seed}")
            for report in reports:
                terminalreporter.line(f"{report.nodeid} ({report.when}): {getattr(report, 'host', 'no figures')}")
                if title == "flaky":
                    terminalreporter.line(report.longreprtext)

    def pytest_unconfigure(self) -> None:
        """Print the last line of the run."""
        reporter = self._config.pluginmanager.get_plugin("terminalreporter")
        if reporter is not None and not hasattr(self._config, "workerinput"):
            reasons = [f"{count} {reason}" for reason, count in sorted(self._not_selected.items())]
            reporter.line(f"not selected: {'; '.join(reasons) or 'none'}")


def _depends_on_the_host(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(name) for name in ("platform", "timing"))
