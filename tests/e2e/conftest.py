"""A whole platform on its virtual segment: real processes, a real socket, real frames."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.find import default_config
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import control_socket, segment_control
from rtcp.ipc.session import read_processes
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.arms import replace_drives, slaves_of
from tests.leftovers import Leftovers
from tests.two_tools import add_tools
from tests.waiting import HANG_S, until

HERE = Path(__file__).parent
WIRE = HERE / "wire.py"
PERIOD_US = 4000
"""Cycle of a platform under test, us: the platforms of four tests side by side keep it."""
OTHER_ARM = os.environ.get("RTCP_TEST_ARM", "")
"""Arm of `tests.drive_esi.ARMS` that the tests run with in place of the shipped one."""
SLAVES = slaves_of(OTHER_ARM) if OTHER_ARM else 7
CUBEMARS = pytest.mark.other_arms()
"""Mark of a test of process data or objects of the shipped arm's drives."""
FULL_CIA402 = pytest.mark.other_arms("two-axis", "synapticon")
"""Mark of a test for which MyActuator's drives lack modes or objects: they have CSP alone, and no homing."""
SEVEN_SLAVES = pytest.mark.other_arms("myactuator", "synapticon")
"""Mark of a test that names slaves which an arm of three drives lacks."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests that do not apply to another arm."""
    markers = [(item, item.get_closest_marker("other_arms")) for item in items]
    left_out = [item for item, marker in markers if OTHER_ARM and marker is not None and OTHER_ARM not in marker.args]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]


class Platform:
    """A platform in a runtime directory of its own, used by the commands of a user."""

    def __init__(self) -> None:
        # Short, and in memory: a control socket's path has 107 bytes at most.
        self.directory = Path(tempfile.mkdtemp(prefix="rtcp-e2e-", dir="/tmp"))
        self.environment = {
            **os.environ,
            "RTCP_RUNTIME_DIR": str(self.directory),
            "RTCP_STATE_DIR": str(self.directory / "state"),
            "COLUMNS": "100",
        }
        self._begun: list[subprocess.Popen[str]] = []

    def be_patient(self, lost_ms: int, period_us: int = PERIOD_US) -> None:
        """Use the shipped configuration, but take `lost_ms` without frames (20 to 2000) for a fault, and begin at 0.

        For tests of what the platform does: a shared host at times takes the CPU away for longer than is shipped.
        """
        mine = self.directory / "config"
        shutil.copytree(default_config().parent, mine)
        file = mine / "assistive_arm.yaml"
        text = file.read_text()
        for old, new in {
            # 20 ms of lost cycles, as the drives' watchdog, both times the same factor.
            "lost_cycles: 40 ": f"lost_cycles: {max(1, round(20_000 / period_us))} ",
            "timeout_scale: 100 ": f"timeout_scale: {lost_ms / 20:g} ",
            "period_us: 500": f"period_us: {period_us}",
        }.items():
            assert old in text
            text = text.replace(old, new)
        file.write_text(text)
        segment = mine / "segment.yaml"
        segment.write_text(re.sub(r", initial_position: [-0-9.]+", "", segment.read_text()))
        self.environment["RTCP_CONFIG"] = str(file)
        if OTHER_ARM:
            replace_drives(mine, OTHER_ARM)

    def rtcp(
        self, *arguments: str, check: int | None = 0, answers: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run `rtcp` with `arguments`, and `answers` at its input; assert its exit code unless `check` is None."""
        done = subprocess.run(
            [sys.executable, "-m", "rtcp.cli", *arguments],
            env=self.environment,
            text=True,
            input=answers,
            capture_output=True,
            check=False,
        )
        if check is not None:
            assert done.returncode == check, (
                f"{arguments} -> {done.returncode}\n{done.stdout}\n{done.stderr}\n{self.logs()}"
            )
        assert "Traceback" not in done.stdout + done.stderr, done.stdout + done.stderr
        return done

    def background(self, *arguments: str) -> subprocess.Popen[str]:
        """Start `rtcp` with `arguments`; what a failed test leaves running is ended by `restore`."""
        begun = subprocess.Popen(
            [sys.executable, "-m", "rtcp.cli", *arguments],
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self._begun.append(begun)
        return begun

    def end_commands(self) -> None:
        """Kill the commands in the background that still run, so that none holds the arm in the next test."""
        while self._begun:
            begun = self._begun.pop()
            if begun.poll() is None:
                begun.kill()
                begun.communicate()

    def call(self, verb: str, /, **arguments: Any) -> dict[str, Any]:
        """Call a method over the control socket; faster than a start of `rtcp` by half a second."""
        with ControlClient("the tests", control_socket(self.directory)) as client:
            answer: dict[str, Any] = client.call(verb, arguments, timeout_s=60.0)
            return answer

    def status(self) -> dict[str, Any]:
        """Return what `rtcp status --json` prints."""
        return self.call("status")

    def events(self, since: int = 0) -> list[str]:
        """Return the names of the loop's events after the number `since`, oldest first."""
        return [event["name"] for event in self.call("events", since=since)["events"]]

    def last_event(self) -> int:
        """Return the number of the last event."""
        return max((int(event["number"]) for event in self.call("events")["events"]), default=0)

    def restore(self) -> None:
        """Start the ended processes, clear the faults, and move the arm to 0; mode joint, csp, disabled."""
        self.end_commands()
        if not all(lives(pid) for pid in self.pids().values()):
            self.rtcp("stop", check=None)
            self.rtcp("start", "--detach")
        with SegmentClient(segment_control(self.directory)) as segment:
            segment.clear()
        if self.status()["state"] == "emergency_stop":
            # After an emergency stop the slaves return to OP only after a reset.
            self.call("reset")
        found = self.until(
            lambda status: (
                all(slave["state"] == "OP" for slave in status["slaves"])
                and status["state"] not in ("moving", "stopping")
                and status["dc"]["locked"]
                and not status["lease"]["holder"]
            ),
            "OP, rest, a followed clock and a free lease",
        )
        if found["state"] in ("fault", "stopped_by_limit"):
            self.call("reset")
        self.call("mode", name="joint")
        self.call("mode", name="csp")
        if max(map(abs, found["joints"]["actual_position"])) > 1e-3:
            self.call("enable")
            self.call("move_joints", q=[0.0] * 6)
        self.call("disable")

    def until(self, met: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        """Ask for the status until `met`, and return that status."""
        last: dict[str, Any] = {}

        def is_met() -> bool:
            last.update(self.status())
            return met(last)

        try:
            until(is_met, what, interval_s=0.05)
        except AssertionError as never:
            raise AssertionError(f"{never}: {last}\n{self.logs()}") from None
        return last

    def until_moving(self, far_rad: float = 0.05) -> dict[str, Any]:
        """Wait until the first joint moves and is more than `far_rad` from 0.

        The distance and not the speed: where a host takes cycles away the motion takes longer, and its speed is less.
        """
        return self.until(
            lambda status: status["state"] == "moving" and abs(status["joints"]["actual_position"][0]) > far_rad,
            "motion",
        )

    def pass_cycles(self, count: int) -> None:
        """Wait until the loop has run so many cycles."""
        end = self.status()["cycles"] + count
        self.until(lambda status: status["cycles"] >= end, f"{count} cycles")

    def wire(self, *arguments: str) -> str:
        """Run `tests.e2e.wire` in the segment's namespace."""
        segment = self.pids()["segment"]
        done = subprocess.run(
            [sys.executable, str(WIRE), str(segment), *arguments], text=True, capture_output=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    @contextlib.contextmanager
    def capture(self, path: Path) -> Iterator[None]:
        """Write the frames that reach and leave the segment meanwhile to a file; assert that none was lost."""
        segment = str(self.pids()["segment"])
        sniffer = subprocess.Popen(
            [sys.executable, str(WIRE), segment, "capture", str(path)], stdout=subprocess.PIPE, text=True
        )
        assert sniffer.stdout is not None
        assert sniffer.stdout.readline() == "ready\n"
        try:
            yield
        finally:
            sniffer.send_signal(signal.SIGTERM)
            lost, _ = sniffer.communicate()
            assert (sniffer.returncode, lost) == (0, "0\n")

    def al_states(self) -> list[int]:
        """Return the AL status of every slave, read with frames of the tests' own."""
        return [int(word) for word in json.loads(self.wire("al"))]

    def freeze(self) -> None:
        """Stop the processes of the platform, so that a platform which waits for its next tests takes no time."""
        self.end_commands()
        for pid in self.pids().values():
            _signal(pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Continue the processes of the platform; `restore` clears the fault that a long pause has been."""
        for pid in self.pids().values():
            _signal(pid, signal.SIGCONT)
        if all(lives(pid) for pid in self.pids().values()):
            self.pass_cycles(250)  # in which the loop notices the pause

    def pids(self) -> dict[str, int]:
        """Return the process ids that the platform wrote down."""
        return {name: int(pid) for name, pid in vars(read_processes(self.directory)).items()}

    def logs(self) -> str:
        """Return what the processes wrote."""
        return "\n".join(f"== {path.name}\n{path.read_text()[-2000:]}" for path in self.directory.glob("*.log"))

    def end(self) -> None:
        """Stop whatever runs and remove the directory."""
        self.end_commands()
        self.rtcp("stop", check=None)
        shutil.rmtree(self.directory, ignore_errors=True)


def lives(pid: int) -> bool:
    """Whether a process lives and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def gone(pid: int) -> None:
    """Wait until a process has ended with all its threads: its first thread alone is a zombie some ms earlier."""
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        assert select.select([process], [], [], HANG_S)[0], f"process {pid} does not end"
    finally:
        os.close(process)


def kill(pid: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Send a signal to a process and wait for its end."""
    os.kill(pid, number)
    gone(pid)


def _signal(pid: int, number: signal.Signals) -> None:
    if lives(pid):  # 0 where the platform has ended: that would be the group of this process
        os.kill(pid, number)


@pytest.fixture
def platform() -> Iterator[Platform]:
    """A platform that is not started."""
    made = Platform()
    yield made
    made.end()


@pytest.fixture(scope="session")
def kept(leftovers: Leftovers) -> Iterator[Platform]:
    """The started platform of this worker; its cycle is `PERIOD_US`, and its arm has two tools."""
    made = Platform()
    leftovers.shared.add(str(made.directory))
    try:
        made.be_patient(2000)
        add_tools(made.directory / "config")
        made.rtcp("start", "--detach")
        yield made
        made.thaw()
    finally:
        made.end()
        leftovers.shared.discard(str(made.directory))


@pytest.fixture(scope="module")
def shared(kept: Platform) -> Iterator[Platform]:
    """The started platform of this worker for the tests of a module, which restore it."""
    kept.thaw()
    kept.restore()
    yield kept
    kept.freeze()


@pytest.fixture
def running(shared: Platform) -> Iterator[Platform]:
    """The shared platform, started again where the test before broke it, the arm disabled at 0."""
    shared.restore()
    yield shared
    shared.end_commands()


@pytest.fixture
def enabled(shared: Platform, request: pytest.FixtureRequest) -> Iterator[Platform]:
    """The shared platform, in CSP, enabled; disabled afterwards. A test that is repeated begins at 0, as at first."""
    if getattr(request.node, "execution_count", 1) > 1:
        shared.restore()
    if shared.status()["state"] in ("fault", "emergency_stop"):
        shared.call("reset")
    shared.call("mode", name="csp")
    shared.call("enable")
    yield shared
    shared.end_commands()
    with contextlib.suppress(RtcpError):
        shared.call("disable")
