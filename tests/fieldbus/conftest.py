from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.fieldbus.terminals import write_segment
from tests.forked import Forked, answer_of

CHILD = "tests.fieldbus.master_child"
WATCHER = "tests.fieldbus.watcher_child"
MODELS = ("diewu-io", *("cubemars-orh70",) * 3, "cubemars-orh60", "cubemars-orh50", "cubemars-orh40")


class Segment:
    """A virtual segment in a process of its own, and masters that are started against it."""

    def __init__(
        self, file: Path, slaves: int | Sequence[str], program: str = "rtcp.virtual", clock_bits: Sequence[int] = ()
    ) -> None:
        """Start it with the first `slaves` of the arm, or with these of `terminals`."""
        if isinstance(slaves, int):
            bits = clock_bits or [64] * slaves
            lines = [f"  - {{model: {MODELS[n]}, clock_bits: {bits[n]}}}\n" for n in range(slaves)]
            file.write_text("slaves:\n" + "".join(lines))
            self.count = slaves
        else:
            write_segment(file, *slaves)
            self.count = len(slaves)
        # Short: a Unix socket's path has 107 bytes at most.
        self.directory = Path(tempfile.mkdtemp(prefix="rtcp-segment-", dir="/tmp"))
        self.control = self.directory / "segment.sock"
        self.process = Forked(program, "--config", str(file), "--control", str(self.control))
        line = self.process.line()
        assert line, "the segment did not start"
        self.pid = json.loads(line)["pid"]

    def master(
        self,
        scenario: str,
        *,
        receive_fraction: float = 0.3,
        promiscuous: bool = False,
        child: str = CHILD,
        **arguments: object,
    ) -> dict[str, Any]:
        """Run a scenario of `child`; return its answer, empty where it was killed."""
        question = {"scenario": scenario, "pid": self.pid, "count": self.count, "arguments": arguments,
                    "receive_fraction": receive_fraction, "promiscuous": promiscuous}  # fmt: skip
        return answer_of(child, json.dumps(question)) or {}

    def end(self) -> None:
        self.process.end()
        shutil.rmtree(self.directory, ignore_errors=True)


StartSegment = Callable[..., Segment]
"""Starts a `Segment` of these slaves."""


@pytest.fixture
def start_segment(tmp_path: Path) -> Iterator[StartSegment]:
    running: list[Segment] = []

    def start(slaves: int | Sequence[str], **more: Any) -> Segment:
        running.append(Segment(tmp_path / f"segment{len(running)}.yaml", slaves, **more))
        return running[-1]

    yield start
    for segment in running:
        segment.end()


@pytest.fixture
def segment(start_segment: StartSegment) -> Segment:
    """An IO box and two drives."""
    return start_segment(3)
