"""A reference clock that stops although every frame comes back: the whole loop on the in-process bus."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.commands import MoveJoints, Reset
from rtcp.ipc.events import ClockLost, ResetWithoutFrames
from rtcp.ipc.states import State
from rtcp.realtime.discipline import UNHEARD_CYCLES
from rtcp.testing.simulation import Frame, Simulation

CONFIG = load(default_config())
CONFIG = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=2000.0))
PERIOD_S = 0.002
SLOW_MOVE = MoveJoints((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.05, True)
"""Joint 1 to 1 rad at 0.05 rad/s: longer than any of these tests."""
UNTIL_LOST_S = UNHEARD_CYCLES * PERIOD_S + 1.0
ENABLE_OPERATION, QUICK_STOP = 0x0F, 0x02
FIRST_DRIVE = 1


class Reference:
    """The reference clock in the frames; `stands`: as where its station has lost its address."""

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
    """A moving arm, with either reaction of `stops.clock_lost`."""
    config = replace(CONFIG, stops=replace(CONFIG.stops, clock_lost=request.param))
    with Simulation(config, seed=5) as simulation:
        simulation.hold()
        simulation.do(SLOW_MOVE)
        simulation.run(1.0)
        yield simulation


def test_a_reference_clock_that_stands_stops_the_arm_by_its_reaction_and_a_reset_waits_until_it_moves(
    moving: Simulation,
) -> None:
    words: list[int] = []

    def see(frame: Frame) -> None:
        words.append(struct.unpack_from("<H", frame.sent[FIRST_DRIVE])[0])

    reference = Reference(moving)
    moving.run(0.1)
    assert moving.state is State.MOVING
    reference.stands = True
    moving.run(UNTIL_LOST_S - 0.01)
    assert moving.state is State.MOVING
    moving.on_frame = see
    moving.bring_to(State.FAULT, 0.5)
    moving.run(0.01)
    # Set-points down to standstill, or the drives' own quick stop.
    assert (words.count(ENABLE_OPERATION) > 25) is (moving.config.stops.clock_lost == "controlled_stop")
    assert words[-1] == QUICK_STOP
    assert [type(event.event) for event in moving.events].count(ClockLost) == 1
    assert moving.data.wkc == moving.data.expected_wkc
    moving.do(Reset())
    moving.bring_to(State.FAULT, 4.0)
    # The reset lacks frames, and does not fail by drives in quick stop: none was commanded to reset.
    assert moving.events[-1].event == ResetWithoutFrames()
    moving.do(Reset())
    moving.run(2.0)
    assert moving.state is State.RESETTING
    reference.stands = False
    moving.bring_to(State.READY, 0.5)


def test_a_reference_clock_that_stands_for_a_moment_stops_nothing(moving: Simulation) -> None:
    reference = Reference(moving)
    for _ in range(2):
        reference.stands = True
        moving.run(UNTIL_LOST_S - 0.4)
        reference.stands = False
        moving.run(0.5)
    assert moving.state is State.MOVING
