"""A segment in a process of its own with its control socket, and raw frames over its cable."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from rtcp.virtual.faults.control import SegmentClient
from rtcp.virtual.protocol import DatagramCommand
from tests.forked import Forked
from tests.virtual.frames import Datagram, build

ROOT = Path(__file__).parents[3]
CHILD = Path(__file__).with_name("raw_child.py")


class Running(NamedTuple):
    """A segment that runs: its process id and its control socket."""

    pid: int
    control: Path

    def client(self) -> SegmentClient:
        return SegmentClient(self.control)


class Traffic(NamedTuple):
    """Instants of the frames sent, and the frames received with their instants; ns."""

    sent: list[int]
    received: list[tuple[int, bytes]]


Exchange = Callable[..., Traffic]
BeginSegment = Callable[..., "subprocess.Popen[str]"]


def start(config: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "rtcp.virtual", "--config", str(config), *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip


@pytest.fixture(scope="session")
def three_slaves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a segment: an IO box and two drives."""
    path = tmp_path_factory.mktemp("segment") / "segment.yaml"
    models = ("diewu-io", "cubemars-orh70", "cubemars-orh40")
    path.write_text("slaves:\n" + "".join(f"  - {{model: {model}}}\n" for model in models), encoding="utf-8")
    return path


@pytest.fixture
def begin_segment(three_slaves: Path) -> Iterator[BeginSegment]:
    """Start a segment of these slaves, or of those of another file, with some options."""
    started: list[subprocess.Popen[str]] = []

    def begin(*options: str, config: Path = three_slaves) -> subprocess.Popen[str]:
        started.append(start(config, *options))
        return started[-1]

    yield begin
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def segment(three_slaves: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """One segment for all tests of a file; each test clears its own faults."""
    control = tmp_path_factory.mktemp("control") / "segment.sock"
    process = Forked("tests.virtual.patient_segment", "--config", str(three_slaves), "--control", str(control))
    try:
        assert process.line()
        yield Running(process.pid, control)
        process.terminate()
        assert (process.output(), process.code) == ("", 0)
    finally:
        process.end()


@pytest.fixture(scope="module")
def exchange(segment: Running) -> Iterator[Exchange]:
    """Send frames one after the other, wait for `answers` frames (default: one each) and `patience_s` longer."""
    with subprocess.Popen(
        [sys.executable, str(CHILD), str(segment.pid), "ecat0"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as child:  # fmt: skip

        def send(frames: Sequence[bytes], answers: int | None = None, patience_s: float = 0.05) -> Traffic:
            expected = len(frames) if answers is None else answers
            query = {"frames": [f.hex() for f in frames], "gap_s": 0.001, "answers": expected, "patience_s": patience_s}
            child.stdin.write(json.dumps(query) + "\n")
            child.stdin.flush()
            reply = json.loads(child.stdout.readline())
            return Traffic(reply["sent"], [(at, bytes.fromhex(frame)) for at, frame in reply["received"]])

        # A segment that has just started can lose the CPU for longer than an answer is worth sending.
        request = build(Datagram(DatagramCommand.BRD, 0, 0, 0, bytes(2)))
        while not send([request], answers=0).received:
            pass
        yield send
        child.stdin.close()
