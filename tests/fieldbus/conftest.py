from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

CHILD = Path(__file__).with_name("master_child.py")
MODELS = ("diewu-io", *("cubemars-orh70",) * 3, "cubemars-orh60", "cubemars-orh50", "cubemars-orh40")


class Segment:
    """A virtual segment in a process of its own, and masters that are started against it."""

    def __init__(self, file: Path, count: int) -> None:
        file.write_text("slaves:\n" + "".join(f"  - model: {model}\n" for model in MODELS[:count]))
        self.count = count
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rtcp.virtual", "--config", str(file)], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the segment did not start"
        self.pid = json.loads(line)["pid"]

    def master(
        self, scenario: str, *, receive_fraction: float = 0.3, promiscuous: bool = False, **arguments
    ) -> dict:  # fmt: skip
        """Run a scenario of `master_child`; return its answer, empty where it was killed."""
        question = {"scenario": scenario, "pid": self.pid, "count": self.count, "arguments": arguments,
                    "receive_fraction": receive_fraction, "promiscuous": promiscuous}  # fmt: skip
        done = subprocess.run(
            [sys.executable, str(CHILD), json.dumps(question)],
            stdout=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
        return json.loads(done.stdout) if done.stdout else {}

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def start_segment(tmp_path):
    running: list[Segment] = []

    def start(count: int) -> Segment:
        running.append(Segment(tmp_path / f"segment{len(running)}.yaml", count))
        return running[-1]

    yield start
    for segment in running:
        segment.end()


@pytest.fixture
def segment(start_segment) -> Segment:
    """An IO box and two drives."""
    return start_segment(3)
