"""Three picks by joystick bytes alone (facts, "The experiments"): from the table, from the ground, from the shelf; the
highest item 0.8 m above the ground, the furthest 0.692 m away. In simulated time, on the bus `inprocess`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import hypot, pi

import pytest

from kinematics import InverseKinematics, Pose, forward
from rtcp.config import default_config, load
from rtcp.ipc.commands import Enable, MoveJoints, SetControlMode
from rtcp.ipc.states import ControlMode, State
from rtcp.launch.simulation import Simulation

BASE_ABOVE_GROUND_M = 0.45
NEUTRAL, FORWARD, BACKWARD, LEFT, RIGHT, PADDLE_UP = 63, 62, 61, 59, 55, 47
NEAR_M = 0.004
GRIPPER_OUTPUT = 0x08
ITEMS = {
    "table": (-0.55, -0.20, 0.72 - BASE_ABOVE_GROUND_M),
    "ground": (-0.50, 0.15, 0.05 - BASE_ABOVE_GROUND_M),
    "shelf": (-0.65, 0.2375, 0.80 - BASE_ABOVE_GROUND_M),
}
LEVEL = Pose.from_xyzrpy(-0.5, 0.0, 0.3, 0.0, -pi / 2, 0.0)
"""Where the arm begins: the gripper level, pointing away from the user."""
CONFIG = load(default_config())
CONFIG = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=2000.0))


class Person:
    """Looks at the tool and moves the joystick: nothing else reaches the arm."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.bytes: set[int] = set()
        self.mode = 0

    @property
    def tool(self) -> tuple[float, float, float]:
        assert CONFIG.arm is not None
        return forward(CONFIG.arm, self.simulation.loop.arm.state.actual).position

    def hold(self, code: int, seconds: float) -> None:
        assert self.simulation.box is not None
        self.simulation.box.inputs = self.simulation.box.inputs & ~0xFF | code
        self.bytes.add(code)
        self.simulation.run(seconds)

    def choose(self, mode: int) -> None:
        while self.mode != mode:
            self.hold(PADDLE_UP, 0.05)
            self.hold(NEUTRAL, 0.05)
            self.mode = (self.mode + 1) % 4
        assert self.simulation.loop.operator.joystick_mode == mode

    def bring(self, target: tuple[float, float, float]) -> None:
        self.choose(0)
        self._push(target, ((0, FORWARD, BACKWARD), (1, LEFT, RIGHT)))
        self.choose(1)
        self._push(target, ((2, BACKWARD, FORWARD),))

    def _push(self, target: tuple[float, float, float], ways: tuple[tuple[int, int, int], ...]) -> None:
        for _ in range(400):
            code, far = NEUTRAL, 0.0
            for axis, plus, minus in ways:
                error = target[axis] - self.tool[axis]
                if abs(error) > NEAR_M:
                    # Active low: a direction takes its bit away.
                    code &= plus if error > 0 else minus
                    far = max(far, abs(error)) if far == 0.0 else min(far, abs(error))
            if code == NEUTRAL:
                return
            self.hold(code, 0.1 if far > 0.04 else 0.03)
            if far <= 0.04:
                self.hold(NEUTRAL, 0.35)
        raise AssertionError(f"the tool is at {self.tool}, not at {target}")

    def grip(self, close: bool) -> None:
        self.choose(3)
        self.hold(BACKWARD if close else FORWARD, 0.1)
        self.hold(NEUTRAL, 0.1)


@pytest.fixture
def person() -> Iterator[Person]:
    config = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=2000.0))
    with Simulation(config, seed=1) as simulation:
        assert simulation.until(lambda: simulation.state is State.READY, 5.0)
        simulation.run(0.1)
        simulation.acquire()
        assert simulation.send(Enable()).refusal is None
        assert simulation.until(lambda: simulation.state is State.HOLDING, 5.0)
        assert CONFIG.arm is not None
        start = InverseKinematics(CONFIG.arm).solve_near(LEVEL, (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)).q
        assert start is not None
        assert simulation.send(MoveJoints(tuple(start), 0.5, True)).refusal is None
        assert simulation.until(lambda: simulation.state is State.HOLDING, 20.0)
        assert simulation.send(SetControlMode(ControlMode.JOYSTICK)).refusal is None
        simulation.run(0.1)
        yield Person(simulation)


@pytest.mark.parametrize(
    "where", ["shelf", *(pytest.param(where, marks=pytest.mark.slow) for where in ("table", "ground"))]
)
def test_an_item_is_picked_by_joystick_bytes_alone(person: Person, where: str) -> None:
    item = ITEMS[where]
    person.grip(close=False)
    person.bring(item)
    assert hypot(*(a - b for a, b in zip(person.tool, item, strict=True))) < 0.02
    person.grip(close=True)
    simulation = person.simulation
    assert simulation.box is not None
    assert simulation.box.outputs & GRIPPER_OUTPUT
    person.bring((item[0], item[1], item[2] + 0.1))
    assert person.tool[2] > item[2] + 0.08
    person.hold(NEUTRAL, 0.5)
    assert simulation.state is State.HOLDING


def test_the_items_are_those_of_the_thesis() -> None:
    assert max(z for _, _, z in ITEMS.values()) + BASE_ABOVE_GROUND_M == pytest.approx(0.8)
    assert max(hypot(x, y) for x, y, _ in ITEMS.values()) == pytest.approx(0.692, abs=1e-3)
