"""The loop's parts around a small arm of real device models."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer

from .rig import CONFIG, PERIOD_S, LoopRig


@pytest.fixture(scope="module")
def rig_board() -> Iterator[tuple[Blackboard, Observer]]:
    """One for all rigs of a file: making one touches 18 MB of memory."""
    path = Path(f"/dev/shm/rtcp-rig-{os.getpid()}")
    written = Blackboard(path, len(CONFIG.joints), round(PERIOD_S * 1e9))
    observer = Observer(path)
    path.unlink()
    yield written, observer
    observer.close()
    written.close()


@pytest.fixture
def rig(rig_board: tuple[Blackboard, Observer]) -> Iterator[LoopRig]:
    """A rig whose lease is released at the end."""
    made = LoopRig(*rig_board)
    yield made
    rig_board[1].release(made.lease)


@pytest.fixture
def path() -> Iterator[Path]:
    """A blackboard's file in shared memory, removed at the end."""
    made = Path(f"/dev/shm/rtcp-test-{os.getpid()}")
    yield made
    made.unlink(missing_ok=True)


@pytest.fixture
def board(path: Path) -> Iterator[Blackboard]:
    """A blackboard of six joints."""
    made = Blackboard(path, 6, 500_000)
    yield made
    made.close()
