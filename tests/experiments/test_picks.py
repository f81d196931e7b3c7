"""Pick and place by joystick bytes alone: from the table, from the ground, from the shelf; the highest item 0.8 m above
the ground, the furthest 0.692 m away, each task in less than a minute. In simulated time, on the bus `inprocess`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import dist, hypot

import pytest

from kinematics import forward
from rtcp.config import default_config, load
from rtcp.ipc.commands import MoveJoints, SetControlMode
from rtcp.ipc.states import ControlMode, State
from rtcp.telemetry.experiments.picks import AIM_S, BASE_ABOVE_GROUND_M, ITEMS, Person, begin_pose, placed_at
from rtcp.testing.simulation import Simulation

GRIPPER_OUTPUT = 0x08
CONFIG = load(default_config())
CONFIG = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=5000.0))


class Joystick:
    """The joystick and the tool of the simulated arm."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.closed_at: tuple[float, float, float] | None = None

    @property
    def tool(self) -> tuple[float, float, float]:
        assert CONFIG.arm is not None
        return forward(CONFIG.arm, self.simulation.loop.arm.state.actual).position

    @property
    def mode(self) -> int:
        return self.simulation.loop.operator.joystick_mode

    def hold(self, code: int, seconds: float) -> None:
        assert self.simulation.box is not None
        self.simulation.box.inputs = self.simulation.box.inputs & ~0xFF | code
        self.simulation.run(seconds)
        if self.closed_at is None and self.simulation.box.outputs & GRIPPER_OUTPUT:
            self.closed_at = self.tool


@pytest.fixture
def joystick() -> Iterator[Joystick]:
    with Simulation(CONFIG, seed=1) as simulation:
        simulation.hold()
        assert CONFIG.arm is not None
        start = begin_pose(CONFIG.arm)
        simulation.do(MoveJoints(start, 0.5, True))
        simulation.bring_to(State.HOLDING, 20.0)
        simulation.do(SetControlMode(ControlMode.JOYSTICK))
        simulation.run(0.1)
        yield Joystick(simulation)


LONG = pytest.mark.long("test_an_item_is_picked_and_placed_by_joystick_bytes_alone")


@pytest.mark.parametrize("where", ["shelf", *(pytest.param(where, marks=LONG) for where in ("table", "ground"))])
def test_an_item_is_picked_and_placed_by_joystick_bytes_alone(joystick: Joystick, where: str) -> None:
    item = ITEMS[where]
    person, begun_ns = Person(joystick), joystick.simulation.now_ns
    assert dist(person.pick(item), item) < 0.02
    assert joystick.closed_at is not None
    assert dist(joystick.closed_at, item) < 0.02
    assert joystick.tool[2] > item[2] + 0.08
    assert dist(person.place(placed_at(item)), placed_at(item)) < 0.02
    assert joystick.tool[2] > item[2] + 0.08
    assert (joystick.simulation.now_ns - begun_ns) * 1e-9 < AIM_S
    assert joystick.simulation.state is State.HOLDING


def test_the_items_are_those_of_the_thesis() -> None:
    assert max(z for _, _, z in ITEMS.values()) + BASE_ABOVE_GROUND_M == pytest.approx(0.8)
    assert max(hypot(x, y) for x, y, _ in ITEMS.values()) == pytest.approx(0.692, abs=1e-3)
