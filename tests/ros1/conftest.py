"""ROS 1 of Debian in a network namespace of its own: one roscore, which every ROS process of these tests shares.

No test here sees another ROS on this host, nor is seen by it. Without Debian's packages they are skipped with one
sentence; `make test-ros` installs them.
"""

from __future__ import annotations

import itertools
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.ros import ros1_messages
from tests.e2e.conftest import Platform
from tests.leftovers import Leftovers
from tests.waiting import HANG_S, until

CLIENT = Path(__file__).parent / "client.py"


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
            "RTCP_RUNTIME_DIR": str(self.directory),
            "ROS_MASTER_URI": "http://127.0.0.1:11311",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(self.directory),
            "ROS_LOG_DIR": str(self.directory / "log"),
            "ROS_PACKAGE_PATH": "",
        }
        self._begun: list[subprocess.Popen[str]] = []
        self._numbers = itertools.count()
        self.core: subprocess.Popen[str] | None = None

    def enter(self, *command: str | Path) -> list[str]:
        """Return a command that runs in the namespace."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._holder.pid), "--net", *user, "--", *map(str, command)]

    def background(self, *command: str | Path, **environment: str) -> subprocess.Popen[str]:
        """Start a command in the namespace; `end` ends it."""
        log = (self.directory / f"{next(self._numbers)}.log").open("w")
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
                begun.wait(HANG_S)
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


class Client:
    """A client on rospy (`client.py`), which carries out one command after another."""

    def __init__(self, ros: Ros) -> None:
        self._process = subprocess.Popen(
            ros.enter(sys.executable, CLIENT),
            env=ros.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def begin(self, kind: str, **given: Any) -> None:
        """Begin a command."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([kind, given]) + "\n")
        self._process.stdin.flush()

    def result(self) -> dict[str, Any]:
        """Wait for the end of the command; return its result."""
        assert self._process.stdout is not None
        line = next((line for line in self._process.stdout if line.startswith("answer ")), "answer null")
        answer: dict[str, Any] = json.loads(line.removeprefix("answer "))
        return answer

    def command(self, kind: str, **given: Any) -> dict[str, Any]:
        """Carry out a command; return its result."""
        self.begin(kind, **given)
        return self.result()

    def has_answered(self) -> bool:
        """Whether a result waits."""
        return bool(select.select([self._process.stdout], [], [], 0.0)[0])

    def end(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.communicate()


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


@pytest.fixture(scope="session")
def ros(ros_on_the_path: None, leftovers: Leftovers) -> Iterator[Ros]:
    """A namespace with a roscore."""
    made = Ros()
    leftovers.shared.add(str(made.directory))
    try:
        made.start_core()
        yield made
    finally:
        made.end()
        leftovers.shared.discard(str(made.directory))


@pytest.fixture
def client(ros: Ros) -> Iterator[Client]:
    """A client."""
    made = Client(ros)
    yield made
    made.end()


@pytest.fixture(scope="session")
def kept(leftovers: Leftovers) -> Iterator[Platform]:
    """A started platform for the tests of this worker."""
    made = Platform()
    leftovers.shared.add(str(made.directory))
    made.be_patient(2000)
    made.rtcp("start", "--detach")
    yield made
    made.thaw()
    made.end()
    leftovers.shared.discard(str(made.directory))


@pytest.fixture(scope="module")
def platform(kept: Platform) -> Iterator[Platform]:
    """The started platform of this worker, which takes no time between two modules."""
    kept.thaw()
    kept.restore()
    yield kept
    kept.freeze()
