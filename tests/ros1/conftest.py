"""ROS 1 of Debian in a network namespace of its own: a roscore, which every ROS process of these tests shares.

No test here sees another ROS on this host, nor is seen by it. Without Debian's packages they are skipped with one
sentence; `make test-ros` installs them.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.ros import ros1_messages
from tests.e2e.conftest import Platform

CLIENT = Path(__file__).parent / "client.py"
PATIENCE_S = 120.0
"""Time limit, s, that only keeps a broken node from hanging the tests."""


def until(met: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    """Wait until `met` returns a true value; return it."""
    end = time.monotonic() + patience_s
    while not (answer := met()):
        assert time.monotonic() < end, f"{what} did not come within {patience_s:g} s"
        time.sleep(0.05)
    return answer


class Ros:
    """A network namespace with a roscore, and the processes that run in it.

    It lives as long as the process that holds it, which is a child of the tests; namespaces of a user of their own let
    an ordinary user do it too.
    """

    def __init__(self) -> None:
        self.directory = Path(tempfile.mkdtemp(prefix="rtcp-ros-", dir="/tmp"))
        unshare = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--user", "--map-root-user"]
        self._holder = subprocess.Popen(
            [*unshare, "sh", "-c", "ip link set lo up && echo up && exec cat"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._holder.stdout is not None
        assert self._holder.stderr is not None
        if self._holder.stdout.readline() != "up\n":
            pytest.skip(f"no network namespace can be made here: {self._holder.stderr.read().strip()}")
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": "http://127.0.0.1:11311",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(self.directory),
            "ROS_LOG_DIR": str(self.directory / "log"),
            "ROS_PACKAGE_PATH": "",
        }
        self._begun: list[subprocess.Popen[str]] = []
        self.core: subprocess.Popen[str] | None = None

    def enter(self, *command: str | Path) -> list[str]:
        """Return a command that runs in the namespace."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._holder.pid), "--net", *user, "--", *map(str, command)]

    def background(self, *command: str | Path, **environment: str) -> subprocess.Popen[str]:
        """Start a command in the namespace; `end` ends it."""
        log = (self.directory / f"{len(self._begun)}.log").open("w")
        begun = subprocess.Popen(
            self.enter(*command), env=self.environment | environment, stdout=log, stderr=subprocess.STDOUT, text=True
        )
        log.close()
        self._begun.append(begun)
        return begun

    def run(self, *command: str | Path, check: bool = True, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run a command in the namespace."""
        done = subprocess.run(
            self.enter(*command), env=self.environment | environment, capture_output=True, text=True, check=False
        )
        assert not check or done.returncode == 0, f"{command} -> {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    def logs(self) -> str:
        """Return what the commands in the background have written."""
        return "".join(path.read_text() for path in sorted(self.directory.glob("*.log")))

    def begin_client(self, kind: str, **given: Any) -> subprocess.Popen[str]:
        """Start a client on rospy (`client.py`), whose output is a pipe."""
        return subprocess.Popen(
            self.enter(sys.executable, CLIENT, kind, json.dumps(given)),
            env=self.environment, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def start_core(self) -> None:
        """Start a roscore and wait until it answers."""
        self.core = self.background("/usr/bin/roscore")
        until(lambda: self.run("/usr/bin/rosnode", "list", check=False).returncode == 0, "the roscore")

    def kill_core(self) -> None:
        """Kill roscore and its children, as the loss of its machine would."""
        assert self.core is not None
        for pid in [*self._children(self.core.pid), self.core.pid]:
            os.kill(pid, signal.SIGKILL)
        self.core.wait()

    @staticmethod
    def _children(pid: int) -> list[int]:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]

    def stop(self, begun: subprocess.Popen[str], number: signal.Signals = signal.SIGTERM) -> None:
        """End one process that was started here, and wait for its end."""
        if begun.poll() is None:
            begun.send_signal(number)
            try:
                begun.wait(30)
            except subprocess.TimeoutExpired:
                begun.kill()
                begun.wait()
        if begun in self._begun:
            self._begun.remove(begun)

    def end(self) -> None:
        """End everything."""
        for begun in reversed(list(self._begun)):
            self.stop(begun)
        self._holder.stdin.close()
        self._holder.wait()
        shutil.rmtree(self.directory, ignore_errors=True)


def begin_node(ros: Ros, platform: Platform, *arguments: str) -> subprocess.Popen[str]:
    """Start `rtcp ros` in the namespace."""
    environment = {name: value for name, value in platform.environment.items() if name.startswith("RTCP_")}
    return ros.background(sys.executable, "-m", "rtcp.cli", "ros", *arguments, **environment)


def command(ros: Ros, kind: str, **given: Any) -> dict[str, Any]:
    """Run a command of a client on rospy; return its result."""
    said = ros.run(sys.executable, CLIENT, kind, json.dumps(given)).stdout
    (line,) = (line for line in said.splitlines() if line.startswith("answer "))
    answer: dict[str, Any] = json.loads(line.removeprefix("answer "))
    return answer


def is_at(arm: Platform, goal: list[float]) -> bool:
    """Whether the arm rests there; a stream is open for up to a second longer."""
    status = arm.status()
    return bool(status["state"] == "holding" and status["joints"]["actual_position"] == pytest.approx(goal, abs=2e-3))


@pytest.fixture(scope="session")
def ros_on_the_path() -> None:
    """ROS 1 and our generated messages can be imported."""
    if problem := ros1_messages.missing():
        pytest.skip(problem)
    ros1_messages.make_importable()


@pytest.fixture(scope="module")
def ros(ros_on_the_path: None) -> Iterator[Ros]:
    """A namespace with a roscore for the tests of a module."""
    made = Ros()
    try:
        made.start_core()
        yield made
    finally:
        made.end()


@pytest.fixture(scope="module")
def platform() -> Iterator[Platform]:
    """A started platform on its virtual segment, with the tolerances of a shared host."""
    made = Platform()
    made.be_patient(2000)
    made.rtcp("start", "--detach")
    yield made
    made.end()
