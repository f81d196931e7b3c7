"""The ladder of stops: which event takes which rung, where it ends, what it says; cycle by cycle, as test_behaviour."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import get_args, get_type_hints

import pytest

from rtcp.config.model import InputConfig, StopsConfig
from rtcp.control.machine import STATES
from rtcp.control.states import Signal
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import Disable, Halt, Reset, Shutdown
from rtcp.ipc.events import ClockLost, Event, LeaseExpired, MovedSinceFault, PermissionWithdrawn
from rtcp.ipc.names import Names
from rtcp.ipc.observer import Observer
from rtcp.ipc.states import State

from .rig import (
    CONFIG,
    CONTROLWORD,
    CSP,
    CST,
    CSV,
    EMERGENCY_STOP_INPUT,
    ENABLE_OPERATION,
    LONGEST_STEP,
    LOST_CYCLES,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_ON,
    UNDER_VOLTAGE,
    VOLTAGE_OFF,
    LoopRig,
)

SWITCH_INPUT = 10
"""Channel of the enabling switch, from 0."""
WITH_SWITCH = replace(CONFIG, inputs=replace(CONFIG.inputs, enabling_switch=InputConfig(SWITCH_INPUT + 1)))
QUICK_STOP_DECELERATION = 0x6085
CHOICES = {key: get_args(hint) for key, hint in get_type_hints(StopsConfig).items()}
"""The rungs of each key."""
EVERY = [(key, rung) for key, rungs in CHOICES.items() for rung in rungs]
TOLD = {"controlled_stop": ENABLE_OPERATION, "quick_stop": QUICK_STOP, "torque_off": VOLTAGE_OFF}
HARD = ("quick_stop", "torque_off")
ENDS = ("lease_ended", "enabling_switch")
"""Events after whose controlled stop the arm takes commands again."""
FROM_THE_CAUSE_S = 1.1
"""The clock is missed only after 1 s."""


def with_stops(**rungs: str) -> StopsConfig:
    return replace(CONFIG.stops, **rungs)


def take_the_lease(rig: LoopRig) -> None:
    rig.observer.release(rig.lease)


def give_the_lease(rig: LoopRig) -> None:
    rig.lease = rig.observer.acquire("the rig", 3600.0)


def turn_too_fast(rig: LoopRig) -> None:
    # A heavy joint does not mind what its drive wants, for as long as it takes to be seen.
    turned = rig.models[1].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 1e5, 0.9, 0.0


def let_go(rig: LoopRig) -> None:
    turned = rig.models[1].mechanics
    turned.inertia, turned.velocity = 1.0, 0.0


def put(rig: LoopRig, channel: int, level: bool) -> None:
    rig.data.devices[0].set_input(channel, level)


CAUSES: dict[str, tuple[Callable[[LoopRig], object], Callable[[LoopRig], object]]] = {
    "lost_frames": (
        lambda rig: setattr(rig.data, "carries", False),
        lambda rig: setattr(rig.data, "carries", True),
    ),
    "slave_lost": (lambda rig: setattr(rig.service, "lost_slave", 2), lambda rig: None),
    "drive_fault": (lambda rig: rig.models[1].inject_fault(UNDER_VOLTAGE), lambda rig: None),
    "clock_lost": (
        lambda rig: setattr(rig.discipline, "locked", False),
        lambda rig: setattr(rig.discipline, "locked", True),
    ),
    "emergency_stop": (
        lambda rig: put(rig, EMERGENCY_STOP_INPUT, False),
        lambda rig: put(rig, EMERGENCY_STOP_INPUT, True),
    ),
    "supervision": (turn_too_fast, let_go),
    "lease_ended": (take_the_lease, give_the_lease),
    "enabling_switch": (lambda rig: put(rig, SWITCH_INPUT, False), lambda rig: put(rig, SWITCH_INPUT, True)),
}
"""For each key what brings its event about, and what mends it."""


def rig_with(rig_board: tuple[Blackboard, Observer], **rungs: str) -> LoopRig:
    config = replace(WITH_SWITCH, stops=with_stops(**rungs))
    rig = LoopRig(*rig_board, config=config)
    rig.names = Names(config)
    put(rig, SWITCH_INPUT, True)
    return rig


@pytest.fixture
def made(rig_board: tuple[Blackboard, Observer]) -> Iterator[Callable[..., LoopRig]]:
    """Make a rig whose enabling switch is held, with rungs by key."""
    rigs: list[LoopRig] = []

    def make(**rungs: str) -> LoopRig:
        rigs.append(rig_with(rig_board, **rungs))
        return rigs[-1]

    yield make
    rig_board[1].release(rigs[-1].lease)


def kinds_of(key: str) -> set[type[Event]]:
    return {kind for kind in Event.kinds if kind.stop_key == key}


def stop_for(rig: LoopRig, key: str, seconds: float = FROM_THE_CAUSE_S) -> int:
    """Bring an event about; return the place in the log of the cycle that found it."""
    before = len(rig.events)
    CAUSES[key][0](rig)
    rig.wait(lambda: any(type(event.event) in kinds_of(key) for event in rig.events[before:]), seconds)
    return len(rig.log) - 1


# -- the table ------------------------------------------------------------------------------------------------------


def test_every_key_has_an_event_and_every_event_a_key() -> None:
    assert (
        {entry.name for entry in fields(StopsConfig)} == {kind.stop_key for kind in Event.kinds} - {""} == set(CAUSES)
    )


class Lived:
    """An event under one of its rungs, lived through once, from a motion at full speed to the next one."""

    def __init__(self, rig: LoopRig, key: str, rung: str) -> None:
        self.rig, self.key, self.rung = rig.set_in_motion(), key, rung
        self.at = stop_for(rig, key)
        self.said = next(
            sentence
            for event, sentence in zip(rig.events, rig.messages, strict=True)
            if type(event.event) in kinds_of(key)
        )
        rig.run(0.6)
        self.ended_in = rig.state
        self.powered = rig.models[0].powered
        self.velocity = rig.models[0].mechanics.velocity
        CAUSES[key][1](rig)
        rig.run(0.15)
        self.mended = len(rig.log) - 1
        self.then = rig.state
        if self.then is not State.HOLDING:
            rig.do(Reset())
            rig.until(State.READY)
            rig.enable()
        rig.move(0.0, 0.0)
        rig.run(0.2)


@pytest.fixture(scope="module", params=EVERY, ids="-".join)
def lived(request: pytest.FixtureRequest, rig_board: tuple[Blackboard, Observer]) -> Lived:
    key, rung = request.param
    rig = rig_with(rig_board, **{key: rung})
    try:
        return Lived(rig, key, rung)
    finally:
        rig_board[1].release(rig.lease)


def test_an_event_takes_the_rung_of_its_key(lived: Lived) -> None:
    told = {said.controlword for said in lived.rig.log[lived.at].drives if said.has_torque}
    assert told == {TOLD[lived.rung]}


def test_a_stop_is_told_in_one_line_with_its_rung_and_the_key_that_sets_it(lived: Lived) -> None:
    assert f"{lived.rung.replace('_', ' ')}" in lived.said
    assert f"(stops.{lived.key} in assistive_arm.yaml)" in lived.said
    assert "\n" not in lived.said


def test_no_rung_lets_a_target_jump(lived: Lived) -> None:
    assert [lived.rig.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


def test_a_rung_ends_in_its_state(lived: Lived) -> None:
    emergency = lived.key in ("emergency_stop", "supervision")
    soft = lived.key in ENDS and lived.rung == "controlled_stop"
    assert lived.ended_in is (State.EMERGENCY_STOP if emergency else State.HOLDING if soft else State.FAULT)
    if lived.key not in ("lost_frames", "supervision"):
        assert lived.powered is (lived.rung != "torque_off" and not emergency)
        assert abs(lived.velocity) < 0.001


def test_after_a_rung_nothing_moves_by_itself_and_reset_and_enable_go_on(lived: Lived) -> None:
    log, at = lived.rig.log, lived.at
    assert lived.then is lived.ended_in
    if lived.then is State.HOLDING:
        assert log[lived.mended].drives[0].target == log[lived.mended - 150].drives[0].target
    else:
        ramp = 350 if lived.rung == "controlled_stop" else 0
        assert all(
            said.controlword != ENABLE_OPERATION for cycle in log[at + ramp : lived.mended] for said in cycle.drives
        )
    assert lived.rig.state is State.MOVING


def test_a_joint_that_comes_to_rest_by_its_rung_is_not_said_to_stand_elsewhere(lived: Lived) -> None:
    assert MovedSinceFault not in lived.rig.kinds


def test_nor_is_one_whose_drive_ramps_down_slowly(made: Callable[..., LoopRig]) -> None:
    rig = made().set_in_motion()
    for model in rig.models:
        # 0.2 rad/s2.
        model.objects[QUICK_STOP_DECELERATION, 0].value = 2000
    stood = rig.arm.state.actual[0]
    stop_for(rig, "slave_lost")
    rig.run(2.0)
    rig.do(Reset())
    rig.until(State.READY)
    assert rig.arm.state.actual[0] - stood > 0.2
    assert MovedSinceFault not in rig.kinds


@pytest.mark.parametrize("key", ENDS)
@pytest.mark.parametrize("rung", HARD)
def test_an_arm_that_holds_needs_neither_a_lease_nor_the_enabling_switch(
    made: Callable[..., LoopRig], key: str, rung: str
) -> None:
    rig = made(**{key: rung}).hold()
    CAUSES[key][0](rig)
    rig.run(0.2)
    assert rig.state is State.HOLDING
    CAUSES[key][1](rig)


@pytest.mark.parametrize("rung", HARD)
def test_a_homing_whose_commander_falls_silent_takes_the_rung_too(made: Callable[..., LoopRig], rung: str) -> None:
    rig = made(lease_ended=rung).bring_to(State.HOMING)
    rig.run(0.1)
    stop_for(rig, "lease_ended")
    assert rig.state is State.FAULT
    assert {said.controlword for said in rig.log[-1].drives} == {TOLD[rung]}
    give_the_lease(rig)


@pytest.mark.parametrize("code", [LeaseExpired, PermissionWithdrawn], ids=lambda code: code.name.lower())
def test_a_harder_reaction_makes_it_a_fault(code: type[LeaseExpired] | type[PermissionWithdrawn]) -> None:
    soft = Names(CONFIG)
    hard = Names(replace(CONFIG, stops=with_stops(**{code.stop_key: "quick_stop"})))
    assert hard.faults - soft.faults == {code}
    assert hard.message(code()).endswith("then `rtcp reset`")
    assert "reset" not in soft.message(code())


# -- a controlled stop that ends in a fault -------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.MOVING, State.STOPPING, State.DISABLING], ids=lambda state: state.name.lower())
def test_for_a_lost_clock_the_arm_comes_to_rest_under_its_limits_before_it_is_a_fault(
    made: Callable[..., LoopRig], state: State
) -> None:
    rig = made(clock_lost="controlled_stop")
    # So slow that it is still on its way to rest a second later.
    rig.arm.limits.acceleration[:] = [0.2, 0.2]
    rig.arm.limits.jerk[:] = [2.0, 2.0]
    rig.hold()
    rig.move(1.8, 1.8)
    rig.run(2.0)
    CAUSES["clock_lost"][0](rig)
    rig.run(0.7)
    if state is not State.MOVING:
        rig.do(Halt() if state is State.STOPPING else Disable())
    assert rig.state is state
    rig.wait(lambda: ClockLost in rig.kinds)
    at = len(rig.log)
    on_the_way = State.DISABLING if state is State.DISABLING else State.STOPPING
    assert (rig.state, rig.machine.fault) == (on_the_way, ClockLost.number)
    rig.until(State.FAULT)
    ramp = rig.log[at:-1]
    assert {said.controlword for cycle in ramp for said in cycle.drives} == {ENABLE_OPERATION}
    assert rig.arm.first_moving() == -1
    assert rig.kinds.count(ClockLost) == 1
    assert rig.machine.fault == ClockLost.number
    rig.run(0.2)
    # Whoever asked for no torque has none.
    assert [model.powered for model in rig.models] == [state is not State.DISABLING] * 2


def test_a_clock_that_is_lost_while_the_torque_is_taken_ends_without_torque(made: Callable[..., LoopRig]) -> None:
    rig = made(clock_lost="controlled_stop").hold()
    CAUSES["clock_lost"][0](rig)
    rig.run(0.98)
    rig.data.deaf[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    rig.do(Disable())
    rig.until(State.FAULT, 0.05)
    rig.run(0.1)
    assert rig.kinds.count(ClockLost) == 1
    assert (rig.machine.fault, [model.powered for model in rig.models]) == (ClockLost.number, [False, False])


def test_an_arm_that_stands_goes_into_the_fault_of_a_lost_clock_at_once(made: Callable[..., LoopRig]) -> None:
    rig = made(clock_lost="controlled_stop").hold()
    stop_for(rig, "clock_lost")
    assert rig.state is State.FAULT
    assert {said.controlword for said in rig.log[-1].drives} == {QUICK_STOP}


def test_disabled_on_the_way_to_the_fault_of_a_lost_clock_the_arm_ends_there_without_torque(
    made: Callable[..., LoopRig],
) -> None:
    rig = made(clock_lost="controlled_stop").set_in_motion()
    stop_for(rig, "clock_lost")
    rig.do(Disable())
    rig.until(State.FAULT)
    rig.run(0.1)
    assert (rig.machine.fault, [model.powered for model in rig.models]) == (ClockLost.number, [False, False])


@pytest.mark.parametrize("key", ["lost_frames", "drive_fault", "emergency_stop"])
def test_what_is_worse_ends_the_controlled_stop_for_a_lost_clock(made: Callable[..., LoopRig], key: str) -> None:
    rig = made(clock_lost="controlled_stop").set_in_motion()
    stop_for(rig, "clock_lost")
    stop_for(rig, key)
    assert rig.state is (State.EMERGENCY_STOP if key == "emergency_stop" else State.FAULT)
    assert rig.machine.fault in {kind.number for kind in kinds_of(key)}
    rig.run(0.5)
    assert rig.machine.fault in {kind.number for kind in kinds_of(key)}


def test_where_a_lost_clock_may_end_in_a_controlled_stop_set_points_move_the_arm() -> None:
    assert {one.state for one in STATES if Signal.STOP_FOR_CLOCK in one.leads_to} == {
        State.HOLDING,
        State.MOVING,
        State.STOPPING,
    }


# -- the way out ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rung", HARD)
def test_a_press_while_the_loop_is_ending_takes_its_rung(made: Callable[..., LoopRig], rung: str) -> None:
    rig = made(emergency_stop=rung).set_in_motion()
    rig.do(Shutdown())
    at = stop_for(rig, "emergency_stop")
    assert {said.controlword for said in rig.log[at].drives} == {TOLD[rung]}
    rig.finish()
    assert [model.powered for model in rig.models] == [False, False]


@pytest.mark.parametrize("rung", HARD)
def test_frames_that_stay_away_while_the_loop_is_ending_take_their_rung(
    made: Callable[..., LoopRig], rung: str
) -> None:
    rig = made(lost_frames=rung).bring_to(State.CLOSING)
    rig.data.carries = False
    rig.finish()
    assert {said.controlword for cycle in rig.log[-20:] for said in cycle.drives} == {TOLD[rung]}


# -- hold -----------------------------------------------------------------------------------------------------------

HELD_IN = [
    *((state, mode) for mode in (CSP, CSV, CST)
      for state in (State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING, State.STOPPED_BY_LIMIT)),
    (State.HOMING, CSP),
]  # fmt: skip


@pytest.mark.parametrize(("state", "mode"), HELD_IN, ids=lambda value: getattr(value, "name", str(value)).lower())
def test_a_cycle_with_a_wrong_working_counter_sends_the_last_targets_again(
    made: Callable[..., LoopRig], state: State, mode: int
) -> None:
    rig = made()
    if mode == CSP:
        rig.bring_to(state)
    else:
        rig.hold(mode)
        if state is not State.HOLDING:
            rig.move(1.8, 1.8)
            rig.run(0.6)
        if state is State.STOPPED_BY_LIMIT:
            rig.arm.limits.high[0] = rig.arm.state.commanded[0] + 0.3
            rig.until(State.STOPPED_BY_LIMIT)
        elif state in (State.STOPPING, State.DISABLING):
            rig.do(Halt() if state is State.STOPPING else Disable())
            rig.run(0.05)
    assert rig.state is state
    sent = [rig.data.output(slot) for slot in (1, 2)]
    # One slave's part of the counter is missing: all others have heard.
    rig.data.expected_wkc -= 1
    for _ in range(LOST_CYCLES - 1):
        rig.cycle()
        assert [rig.data.output(slot) for slot in (1, 2)] == sent
        assert rig.state is state
    rig.cycle()
    assert rig.state is State.FAULT
    assert {said.controlword for said in rig.log[-1].drives} == {QUICK_STOP}
    assert [(said.speed, said.effort) for said in rig.log[-1].drives] == [(0, 0), (0, 0)]


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_set_points_go_on_after_held_cycles_without_a_jump(made: Callable[..., LoopRig], mode: int) -> None:
    rig = made().set_in_motion(mode)
    at = len(rig.log)
    expected = rig.data.expected_wkc
    for _ in range(4):
        rig.data.expected_wkc = expected - 1
        rig.run((LOST_CYCLES - 1) * PERIOD_S)
        rig.data.expected_wkc = expected
        rig.run(0.1)
    assert rig.state is State.MOVING
    assert max(abs(said.velocity) for cycle in rig.log[at:] for said in cycle.drives) < 5000
    assert [rig.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


@pytest.mark.parametrize("ends", ["stop", "lease"])
def test_a_move_that_is_stopped_before_a_frame_came_for_it_never_begins(
    made: Callable[..., LoopRig], ends: str
) -> None:
    rig = made().hold()
    rig.data.carries = False
    rig.move(1.0, 1.0)
    if ends == "stop":
        rig.do(Halt())
    else:
        take_the_lease(rig)
        rig.cycle()
    rig.data.carries = True
    rig.run(0.5)
    if ends == "lease":
        give_the_lease(rig)
    assert rig.state is State.HOLDING
    assert {said.target for cycle in rig.log[-500:] for said in cycle.drives} == {0}


# -- torque off -----------------------------------------------------------------------------------------------------


def test_torque_off_is_disable_voltage_from_operation_enabled_without_the_ramp_of_disabling(
    made: Callable[..., LoopRig],
) -> None:
    rig = made(slave_lost="torque_off").set_in_motion()
    stop_for(rig, "slave_lost")
    rig.run(3 * PERIOD_S)
    assert [model.powered for model in rig.models] == [False, False]
    assert set(rig.words(0)[-2:]) == {ENABLE_OPERATION, VOLTAGE_OFF}


def test_a_drive_that_does_not_hear_the_torque_off_is_told_for_as_long_as_the_fault_lasts(
    made: Callable[..., LoopRig],
) -> None:
    rig = made(slave_lost="torque_off").set_in_motion()
    rig.data.deaf[1, CONTROLWORD] = {VOLTAGE_OFF: ENABLE_OPERATION}
    stop_for(rig, "slave_lost")
    rig.run(0.3)
    rig.data.deaf.clear()
    rig.run(0.01)
    assert [model.powered for model in rig.models] == [False, False]
