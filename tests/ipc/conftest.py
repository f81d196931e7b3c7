"""A blackboard of its own for each test."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.blackboard import Blackboard


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
