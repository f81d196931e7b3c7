"""A reference clock that stands although every frame comes back: the whole loop on the in-process bus."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.commands import Enable, MoveJoints, Reset
from rtcp.ipc.events import ClockLost, ResetWithoutFrames
from rtcp.ipc.states import State
from rtcp.launch.simulation import Frame, Simulation
from rtcp.realtime.discipline import UNHEARD_CYCLES

CONFIG = load(default_config())
CONFIG = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=1000.0))
PERIOD_S = 0.001
ONE_TURN = MoveJoints((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.05, True)
"""Joint 1 to 1 rad at 0.05 rad/s: longer than any of these tests."""
UNTIL_LOST_S = UNHEARD_CYCLES * PERIOD_S + 1.0
ENABLE_OPERATION, QUICK_STOP = 0x0F, 0x02
FIRST_DRIVE = 1


class Reference:
    """The reference clock as the frames bring it; where it stands, as a station without its address leaves it."""

    def __init__(self, simulation: Simulation) -> None:
        self._data = simulation.data
        self._receive = simulation.data.receive
        self.stands = False
        simulation.data.receive = self.receive  # type: ignore[method-assign]

    def receive(self) -> int:
        before = self._data.dc_time
        wkc = self._receive()
        if self.stands:
            self._data.dc_time = before
        return wkc


@pytest.fixture(params=["quick_stop", "controlled_stop"])
def moving(request: pytest.FixtureRequest) -> Iterator[Simulation]:
    """An arm on its way, under either reaction of `stops.clock_lost`."""
    config = replace(CONFIG, stops=replace(CONFIG.stops, clock_lost=request.param))
    with Simulation(config, seed=5) as simulation:
        simulation.acquire()
        assert simulation.until(lambda: simulation.state is State.READY, 3.0)
        assert simulation.send(Enable()).refusal is None
        assert simulation.until(lambda: simulation.state is State.HOLDING, 3.0)
        assert simulation.send(ONE_TURN).refusal is None
        simulation.run(1.0)
        yield simulation


def test_a_reference_clock_that_stands_stops_the_arm_by_its_reaction_and_a_reset_waits_until_it_moves(
    moving: Simulation,
) -> None:
    words: list[int] = []

    def see(frame: Frame) -> None:
        words.append(struct.unpack_from("<H", frame.sent[FIRST_DRIVE])[0])

    reference = Reference(moving)
    moving.run(2 * UNTIL_LOST_S)
    assert moving.state is State.MOVING
    reference.stands = True
    moving.run(UNTIL_LOST_S - 0.01)
    assert moving.state is State.MOVING
    moving.on_frame = see
    assert moving.until(lambda: moving.state is State.FAULT, 0.5)
    moving.run(0.01)
    # Down to standstill by the set-points, or at once by the drives.
    assert (words.count(ENABLE_OPERATION) > 50) is (moving.config.stops.clock_lost == "controlled_stop")
    assert words[-1] == QUICK_STOP
    assert [type(event.event) for event in moving.events].count(ClockLost) == 1
    assert moving.data.wkc == moving.data.expected_wkc
    assert moving.send(Reset()).refusal is None
    assert moving.until(lambda: moving.state is State.FAULT, 4.0)
    # No drive was told to reset: that they are stopped by quick stop is not why it did not succeed.
    assert moving.events[-1].event == ResetWithoutFrames()
    assert moving.send(Reset()).refusal is None
    moving.run(2.0)
    assert moving.state is State.RESETTING
    reference.stands = False
    assert moving.until(lambda: moving.state is State.READY, 0.5)


def test_a_reference_clock_that_stands_for_a_moment_stops_nothing(moving: Simulation) -> None:
    reference = Reference(moving)
    for _ in range(3):
        reference.stands = True
        moving.run(UNTIL_LOST_S - 0.4)
        reference.stands = False
        moving.run(0.5)
    assert moving.state is State.MOVING
