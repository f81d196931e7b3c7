"""A slave that comes back never moves by itself: what goes over the bus to its drive until reset and enable."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.commands import Halt, MoveJoints, Reset
from rtcp.ipc.events import MovedSinceFault
from rtcp.ipc.names import Names
from rtcp.ipc.states import State
from rtcp.testing.simulation import Frame, Simulation
from rtcp.virtual.protocol import AlState

CONFIG = load(default_config())
CONFIG = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=1000.0))
BENT = [0.0, -0.3, 1.2, 0.0, 0.9, 0.0]
SLAVE = 4
"""Position of the drive of joint 3, which is lost and comes back."""
AXIS = 2
TURNED_TO = 1.05
"""Position of the joint after the loss of supply, rad."""
EMERGENCY_STOP_INPUT = 9
"""Channel of the box, from 0."""
OUTPUTS = struct.Struct("<Hiiib")
"""Controlword, target position, target velocity, target torque, mode."""
ENABLE_OPERATION, QUICK_STOP = 0x0F, 0x02
ENABLED = (0x27, 0x6F)
"""Operation Enabled and its mask (CiA 402-2, object 0x6041)."""
SYNC_MANAGER_WATCHDOG = 0x001B
FULL_SPEED = MoveJoints((1.0, -0.3, 1.2, 0.0, 0.9, 0.0), 0.5, True)


class Seen:
    """Outputs and inputs of one drive, cycle by cycle."""

    def __init__(self, simulation: Simulation) -> None:
        self.cycles: list[tuple[State, tuple[int, ...], int, int]] = []
        """State of the machine, outputs, received statusword and position."""
        self._simulation = simulation
        simulation.on_frame = self._see

    def _see(self, frame: Frame) -> None:
        statusword, position = struct.unpack_from("<Hi", frame.received[SLAVE - 1])
        sent = OUTPUTS.unpack(frame.sent[SLAVE - 1])
        self.cycles.append((self._simulation.state, sent, statusword, position))


@pytest.fixture(params=["holding", "moving"])
def arm(request: pytest.FixtureRequest) -> Iterator[Simulation]:
    with Simulation(CONFIG, seed=3, positions=BENT, follow_clock=False) as simulation:
        simulation.hold()
        if request.param == "moving":
            simulation.do(FULL_SPEED)
        simulation.run(0.5)
        yield simulation


def bring_back(simulation: Simulation) -> None:
    """Do what the watcher does: acknowledge, SAFE-OP, OP."""
    bus, slave = simulation.bus, simulation.bus.slaves[SLAVE - 1]
    bus.acknowledge(SLAVE)
    for state in (AlState.SAFE_OP, AlState.OP):
        if slave.state < state:
            bus.request_state(state, [SLAVE])
    assert simulation.until(lambda: (slave.state, slave.error) == (AlState.OP, False), 0.1)


def out_of_op(simulation: Simulation) -> None:
    """It leaves OP on its watchdog, and is brought back."""
    simulation.bus.drop(SLAVE, AlState.SAFE_OP, SYNC_MANAGER_WATCHDOG)
    simulation.bring_to(State.FAULT, 1.0)
    simulation.run(0.3)
    bring_back(simulation)


def without_supply(simulation: Simulation) -> None:
    """It loses its supply, is turned by hand, starts anew and is brought back."""
    bus = simulation.bus
    bus.request_state(AlState.INIT, [SLAVE])
    simulation.bring_to(State.FAULT, 1.0)
    simulation.run(0.3)
    bus.restart(SLAVE)
    simulation.models[AXIS].mechanics.position = TURNED_TO
    bus.set_up(SLAVE)
    bring_back(simulation)


def enabled_by_itself(simulation: Simulation) -> None:
    """It comes back in Operation Enabled, which a drive that follows the standard does not."""
    without_supply(simulation)
    simulation.run(0.4)
    model = simulation.models[AXIS]
    model.objects[0x6060, 0].value = 8
    for word in (0x06, 0x07, 0x0F):
        model.objects[0x6040, 0].value = word
        model.step(0.001)
    assert int(model.objects[0x6041, 0].value) & ENABLED[1] == ENABLED[0]


@pytest.mark.parametrize("comes_back", [out_of_op, without_supply, enabled_by_itself], ids=lambda step: step.__name__)
def test_a_drive_that_comes_back_is_sent_its_own_position_and_no_enable_until_reset_and_enable(
    arm: Simulation, comes_back: Callable[[Simulation], None]
) -> None:
    comes_back(arm)
    seen = Seen(arm)
    arm.run(0.5)
    assert {state for state, *_ in seen.cycles} == {State.FAULT}
    words = {sent[0] for _, sent, _, _ in seen.cycles}
    assert ENABLE_OPERATION not in words
    assert {sent[2:4] for _, sent, _, _ in seen.cycles} == {(0, 0)}
    # A target follows from the answer two frames before: it was decoded, and sent with the next.
    pairs = zip(seen.cycles[2:], seen.cycles, strict=False)
    assert all(abs(sent[1] - position) <= 20 for (_, sent, _, _), (_, _, _, position) in pairs)
    assert all(status & ENABLED[1] != ENABLED[0] for _, _, status, _ in seen.cycles[5:])
    stood = seen.cycles[-1][3]
    assert all(abs(position - stood) <= 20 for *_, position in seen.cycles[5:])


def test_after_reset_and_enable_it_is_enabled_where_it_stands(arm: Simulation) -> None:
    without_supply(arm)
    arm.run(0.2)
    seen = Seen(arm)
    arm.do(Reset())
    arm.bring_to(State.READY, 4.0)
    arm.run(0.1)
    assert ENABLE_OPERATION not in {sent[0] for _, sent, _, _ in seen.cycles}
    arm.hold()
    arm.run(0.2)
    targets = {sent[1] for _, sent, _, _ in seen.cycles if sent[0] == ENABLE_OPERATION}
    assert all(abs(target - 10500) <= 20 for target in targets)
    assert targets


# -- reports of another position ------------------------------------------------------------------------------------


def moved(simulation: Simulation) -> list[str]:
    """The messages about joints that stand elsewhere than at the fault."""
    names = Names(CONFIG)
    return [names.message(record.event) for record in simulation.events if isinstance(record.event, MovedSinceFault)]


def reset(simulation: Simulation) -> None:
    simulation.do(Reset())
    simulation.bring_to(State.READY, 4.0)


def press(simulation: Simulation) -> None:
    """Press the emergency stop until the slaves are parked, then release it."""
    assert simulation.box is not None
    simulation.box.set_input(EMERGENCY_STOP_INPUT, False)
    simulation.bring_to(State.EMERGENCY_STOP, 1.0)
    simulation.run(1.0)
    simulation.box.set_input(EMERGENCY_STOP_INPUT, True)


@pytest.mark.parametrize("pressed", [False, True])
def test_a_joint_that_comes_back_at_another_position_is_reported_with_both_when_the_reset_is_done(
    arm: Simulation, pressed: bool
) -> None:
    without_supply(arm)
    arm.run(0.2)
    if pressed:
        # The position at the emergency stop is not that at the fault.
        press(arm)
    assert not moved(arm)
    reset(arm)
    (message,) = moved(arm)
    assert message.startswith("joint3 stands at 1.05 rad, at the fault it stood at 1.2")
    assert "its drive lost its zero; check that before `rtcp enable`" in message
    # `rtcp status` shows the last event.
    assert type(arm.events[-1].event) is MovedSinceFault
    # It is reported once, and nothing is refused: the joint may have been turned by hand.
    arm.hold()
    out_of_op(arm)
    reset(arm)
    assert len(moved(arm)) == 1


@pytest.mark.parametrize("comes_back", [out_of_op, press], ids=lambda step: step.__name__)
def test_a_joint_that_comes_back_where_it_stood_is_not_reported(
    arm: Simulation, comes_back: Callable[[Simulation], None]
) -> None:
    comes_back(arm)
    reset(arm)
    assert not moved(arm)


@pytest.mark.parametrize("arm", ["moving"], indirect=True)
def test_a_joint_that_moved_when_its_supply_was_lost_is_reported_where_it_cannot_have_run_on_to(
    arm: Simulation,
) -> None:
    arm.send(Halt())
    arm.bring_to(State.HOLDING, 2.0)
    arm.do(MoveJoints((0.0, -0.3, 2.4, 0.0, 0.9, 0.0), 0.5, True))
    arm.run(1.6)
    assert arm.loop.arm.state.actual_velocity[AXIS] > 0.4
    stood = arm.loop.arm.state.actual[AXIS]
    without_supply(arm)
    reset(arm)
    (message,) = moved(arm)
    assert message.startswith("joint3 stands at 1.05 rad")
    assert stood - TURNED_TO > 0.55


@pytest.mark.parametrize("arm", ["moving"], indirect=True)
def test_joints_that_run_on_while_nothing_is_heard_are_not_reported(arm: Simulation) -> None:
    arm.data.lose(400, heard=False)
    arm.bring_to(State.FAULT, 1.0)
    arm.run(0.5)
    reset(arm)
    assert not moved(arm)
