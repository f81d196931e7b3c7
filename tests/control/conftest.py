"""The loop's parts around a small arm of real device models."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from .rig import CONFIG, SWITCH_INPUT, LoopRig, with_switch


@pytest.fixture
def new_rig() -> Iterator[Callable[..., LoopRig]]:
    """Make a rig of a configuration."""
    with ExitStack() as stack:
        yield lambda config=CONFIG: stack.enter_context(LoopRig(config))


@pytest.fixture
def rig(new_rig: Callable[..., LoopRig]) -> LoopRig:
    """A rig of the small arm."""
    return new_rig()


@pytest.fixture
def switch_rig(new_rig: Callable[..., LoopRig]) -> Callable[..., LoopRig]:
    """Make a rig whose enabling switch is pressed, with stop reactions by key."""

    def make(**stops: str) -> LoopRig:
        made = new_rig(with_switch(**stops))
        made.put(SWITCH_INPUT, True)
        return made

    return make
