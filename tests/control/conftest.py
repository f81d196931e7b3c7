"""The loop's parts around a small arm of real device models."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rtcp.config.model import ArmConfig
from rtcp.control.cycle import record_schema
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer

from .rig import CONFIG, PERIOD_S, SWITCH_INPUT, LoopRig, with_switch


@pytest.fixture(scope="module")
def rig_board() -> Iterator[tuple[Blackboard, Observer]]:
    """One for all rigs of a file: making one touches 18 MB of memory."""
    path = Path(f"/dev/shm/rtcp-rig-{os.getpid()}")
    written = Blackboard(path, record_schema(CONFIG), round(PERIOD_S * 1e9))
    observer = Observer(path)
    path.unlink()
    yield written, observer
    observer.close()
    written.close()


@pytest.fixture
def new_rig(rig_board: tuple[Blackboard, Observer]) -> Iterator[Callable[..., LoopRig]]:
    """Make a rig of a configuration; its lease is released at the end."""
    made: list[LoopRig] = []

    def make(config: ArmConfig = CONFIG, **options: bool) -> LoopRig:
        made.append(LoopRig(*rig_board, config=config, **options))
        return made[-1]

    yield make
    for rig in made:
        rig.release()


@pytest.fixture
def rig(new_rig: Callable[..., LoopRig]) -> LoopRig:
    """A rig of the small arm."""
    return new_rig()


@pytest.fixture
def switch_rig(new_rig: Callable[..., LoopRig]) -> Callable[..., LoopRig]:
    """Make a rig whose enabling switch is held, with stop reactions by key."""

    def make(**stops: str) -> LoopRig:
        made = new_rig(with_switch(**stops))
        made.put(SWITCH_INPUT, True)
        return made

    return make
