"""A blackboard; a gateway's process in front of a played loop."""

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
from tests.runtime.bench import CONFIG, PERIOD_S, Bench
from tests.runtime.played_loop import Loop

from rtcp.config import default_config, load
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.client import ControlClient
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from rtcp.ipc.session import Session


@pytest.fixture(scope="module")
def bench_board() -> Iterator[tuple[Blackboard, Observer]]:
    """One for all benches of a file: to make one, 16 MB of memory are touched."""
    path = Path(f"/dev/shm/rtcp-bench-{os.getpid()}")
    written = Blackboard(path, len(CONFIG.joints), round(PERIOD_S * 1e9))
    observer = Observer(path)
    path.unlink()
    yield written, observer
    observer.close()
    written.close()


@pytest.fixture
def bench(bench_board: tuple[Blackboard, Observer]) -> Iterator[Bench]:
    """A bench whose lease is given back."""
    made = Bench(*bench_board)
    yield made
    bench_board[1].release(made.lease)


@pytest.fixture
def path() -> Iterator[Path]:
    made = Path(f"/dev/shm/rtcp-test-{os.getpid()}")
    yield made
    made.unlink(missing_ok=True)


@pytest.fixture
def board(path: Path) -> Iterator[Blackboard]:
    made = Blackboard(path, 6, 500_000)
    yield made
    made.close()


@pytest.fixture(scope="module")
def gateway_directory() -> Iterator[Path]:
    # Short: a control socket's path has 107 bytes at most.
    made = Path(tempfile.mkdtemp(prefix="rtcp-gateway-", dir="/tmp"))
    yield made
    blackboard_file(made).unlink(missing_ok=True)
    shutil.rmtree(made)


@pytest.fixture(scope="module")
def gateway_loop(gateway_directory: Path) -> Iterator[Loop]:
    directory = gateway_directory
    config = load(default_config())
    Session(config, "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
    (directory / "started.json").write_text("{}")
    made = Loop(blackboard_file(directory))
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
def gateway_client(gateway_directory: Path, gateway_loop: Loop) -> Iterator[ControlClient]:
    gateway_loop.clear()
    with ControlClient("a test", control_socket(gateway_directory)) as made:
        yield made
