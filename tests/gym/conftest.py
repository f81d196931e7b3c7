"""Environments of an arm with a cycle of 2 ms, and a platform for the policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rtcp.config import default_config, load, with_period
from rtcp.config.model import ArmConfig
from tests.e2e.conftest import Platform, enabled, kept, shared

__all__ = ["Platform", "enabled", "kept", "shared"]

Make = Callable[..., Any]


@pytest.fixture(scope="session")
def config() -> ArmConfig:
    return with_period(load(default_config()), 2000)


@pytest.fixture
def make(config: ArmConfig) -> Iterator[Make]:
    """Make an environment, which the test's end closes."""
    from rtcp.gym import ArmEnv

    made = []

    def new(action: str, kind: type[ArmEnv] = ArmEnv, **arguments: Any) -> ArmEnv:
        made.append(kind(action, **{"config": config, **arguments}))
        return made[-1]

    yield new
    for environment in made:
        environment.close()
