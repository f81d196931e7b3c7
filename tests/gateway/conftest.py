"""A fake loop behind a gateway's process, or behind its methods in this process; one for the tests of a file."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.client import ControlClient
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from rtcp.ipc.session import Session
from tests.gateway.fake_loop import FakeLoop, RunningLoop
from tests.gateway.fake_platform import FakePlatform, fake_platform


@pytest.fixture(scope="module")
def directory() -> Iterator[Path]:
    # Short: a control socket's path has 107 bytes at most.
    made = Path(tempfile.mkdtemp(prefix="rtcp-gateway-", dir="/tmp"))
    yield made
    blackboard_file(made).unlink(missing_ok=True)
    shutil.rmtree(made)


@pytest.fixture(scope="module")
def served_loop(directory: Path) -> Iterator[FakeLoop]:
    config = load(default_config())
    Session(config, "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
    (directory / "started.json").write_text("{}")
    made = RunningLoop(blackboard_file(directory))
    reading, writing = os.pipe()
    gateway = subprocess.Popen(
        [sys.executable, "-m", "rtcp.gateway.server", "--directory", str(directory), "--ready-fd", str(writing)],
        pass_fds=(writing,),
        env={**os.environ, "RTCP_STATE_DIR": str(directory / "state")},
    )
    os.close(writing)
    try:
        with open(reading) as pipe:
            assert pipe.readline()
        yield made
    finally:
        gateway.terminate()
        gateway.wait()
        made.end()


@pytest.fixture
def loop(served_loop: FakeLoop) -> FakeLoop:
    served_loop.clear()
    return served_loop


@pytest.fixture
def client(directory: Path, loop: FakeLoop) -> Iterator[ControlClient]:
    with ControlClient("a test", control_socket(directory)) as made:
        yield made


@pytest.fixture(scope="module")
def platform(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakePlatform]:
    """The methods of the gateway; the arm stands at the module's `Q`."""
    options = getattr(request.module, "OPTIONS", {})
    with fake_platform(tmp_path_factory.mktemp("arm"), request.module.Q, **options) as made:
        yield made


@pytest.fixture
def arm(
    request: pytest.FixtureRequest, platform: FakePlatform, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> FakePlatform:
    """The same, holding at `Q` with nothing received, and a state directory of the test's own."""
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    platform.reset(request.module.Q)
    return platform
