"""The oracle of the sessions: it shares no code with the product, and its distances are those of the product."""

from __future__ import annotations

import ast
from collections.abc import Callable
from itertools import pairwise
from math import cos, sin
from pathlib import Path
from random import Random

import pytest

from kinematics.capsules import Placed as ProductPlaced
from kinematics.capsules import capsules, distance, with_every_tool
from kinematics.forward import frames
from kinematics.pose import Pose
from rtcp.config.loader import load
from rtcp.config.model import ArmConfig
from rtcp.motion.guards.neighbours import reach_of
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Limits
from rtcp.testing import sessions
from rtcp.testing.sessions.checker import Bounds, reading_of
from rtcp.testing.sessions.oracle import Placed, Shape, apart, in_world
from tests.sessions.oracle import configuration
from tests.two_tools import two_tools

PRODUCT = ("kinematics", "rtcp.control", "rtcp.devices", "rtcp.fieldbus", "rtcp.motion")
POSES = 300
TOLERANCE_M = 1e-4


@pytest.mark.parametrize("name", ["oracle", "mechanics"])
def test_the_oracle_imports_nothing_of_the_product_that_it_checks(name: str) -> None:
    # The modules themselves may be compiled.
    tree = ast.parse((Path(sessions.__file__).parent / f"{name}.py").read_text())
    imported = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported += [name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names]
    assert imported
    assert [name for name in imported if name.startswith(PRODUCT)] == []


ARMS: dict[str, Callable[[Path], ArmConfig]] = {
    "default": lambda directory: configuration(),
    "two tools": lambda directory: load(two_tools(directory)),
}


def places(config: ArmConfig, seed: int) -> list[list[float]]:
    random, bounds = Random(seed), Bounds.configured(config)
    return [[random.uniform(a, b) for a, b in zip(bounds.low, bounds.high, strict=True)] for _ in range(POSES)]


@pytest.mark.parametrize("name", ARMS)
def test_bodies_are_as_far_from_boxes_and_from_each_other_as_the_product_says(name: str, tmp_path: Path) -> None:
    config = ARMS[name](tmp_path)
    bounds, reading = Bounds.configured(config), reading_of(config)
    for model, workspace in zip(config.models, reading.workspaces, strict=True):
        assert workspace is not None
        assert list(workspace.reach) == pytest.approx(reach_of(model))
        zones = Zones(model, Limits(config), config.cartesian.clearance)
        depths = []
        for q in places(config, 1):
            depths.append(workspace.deepest(bounds, q))
            assert depths[-1] == pytest.approx(-zones.distance(frames(model, q))[0], abs=TOLERANCE_M)
        assert min(depths) < 0.0 < max(depths)


@pytest.mark.parametrize("name", ARMS)
def test_the_bodies_of_two_arms_in_a_cell_are_as_far_apart_as_the_product_says(name: str, tmp_path: Path) -> None:
    config = ARMS[name](tmp_path)
    shape, model = Shape(config.models, None, 0.0), with_every_tool(config.models)
    position, rpy = (-0.9, 0.2, 0.1), (0.3, -0.2, 2.5)
    first, second = ProductPlaced(capsules(model)), ProductPlaced(capsules(model))
    distances = []
    for a, b in pairwise(places(config, 2)):
        first.place(frames(model, a))
        second.place(frames(model, b), Pose.from_xyzrpy(*position, *rpy))
        distances.append(apart(shape.placed(a), in_world(shape.placed(b), position, rpy)))
        assert distances[-1] == pytest.approx(distance(first, second)[0], abs=TOLERANCE_M)
    assert min(distances) < 0.0 < max(distances)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-4, 0.7])
def test_parallel_bodies_and_bodies_without_length_have_a_distance(turn: float) -> None:
    rod = Placed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1)
    above = Placed((0.2, 0.0, 0.5), (cos(turn), sin(turn), 0.0), 0.1)
    ball = Placed((0.5, 0.4, 0.0), (0.0, 0.0, 0.0), 0.1)
    assert apart([rod], [above]) == pytest.approx(0.3)
    assert apart([rod], [ball]) == apart([ball], [rod]) == pytest.approx(0.2)
    assert apart([ball], [ball]) == pytest.approx(-0.2)
