"""Fixtures of the tests of ROS 2; those that need a package are skipped where it is missing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, cast

import pytest

from tests.ros.test_commands import FakeArm

if TYPE_CHECKING:
    from rtcp.ros.ros2_node import Commands


@pytest.fixture
def arm() -> FakeArm:
    return FakeArm()


@pytest.fixture
def commands(arm: FakeArm) -> Iterator[Commands]:
    from rtcp.ros.ros2_node import Commands

    from .node import OPTIONS

    with Commands(OPTIONS, cast(Any, arm.connect)) as made:
        yield made
        made.loop.call_soon_threadsafe(arm.end)
