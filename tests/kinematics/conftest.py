"""The arms that the tests share."""

from __future__ import annotations

import pytest

from kinematics.model import ArmModel
from tests.kinematics import arms


@pytest.fixture(scope="session")
def assistive() -> ArmModel:
    return arms.assistive()


@pytest.fixture(scope="session")
def irb120() -> ArmModel:
    return arms.irb120()


@pytest.fixture(scope="session")
def ur5() -> ArmModel:
    return arms.ur5()


@pytest.fixture(scope="session", params=[arms.assistive, arms.irb120], ids=["assistive", "irb120"])
def either(request: pytest.FixtureRequest) -> ArmModel:
    """Both arms, one after the other."""
    return request.param()


@pytest.fixture(scope="session", params=arms.GEOMETRIES)
def geometry(request: pytest.FixtureRequest) -> str:
    """The name of a geometry of joints 1 to 3."""
    return request.param
