"""The ladder of stops: which event takes which rung, where it ends, what it says; cycle by cycle, as test_behaviour."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import get_args, get_type_hints

import pytest

from rtcp.config.model import InputConfig, StopsConfig
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import TABLE, Code, Command, Event, State
from rtcp.ipc.messages import Sentences
from rtcp.ipc.observer import Observer
from rtcp.ipc.stops import KEYS

from .bench import (
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
    Bench,
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


def take_the_lease(bench: Bench) -> None:
    bench.observer.release(bench.lease)


def give_the_lease(bench: Bench) -> None:
    bench.lease = bench.observer.acquire("the bench", 3600.0)


def turn_too_fast(bench: Bench) -> None:
    # A heavy joint does not mind what its drive wants, for as long as it takes to be seen.
    turned = bench.models[1].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 1e5, 0.9, 0.0


def let_go(bench: Bench) -> None:
    turned = bench.models[1].mechanics
    turned.inertia, turned.velocity = 1.0, 0.0


def put(bench: Bench, channel: int, level: bool) -> None:
    bench.data.devices[0].set_input(channel, level)


CAUSES: dict[str, tuple[Callable[[Bench], object], Callable[[Bench], object]]] = {
    "lost_frames": (
        lambda bench: setattr(bench.data, "carries", False),
        lambda bench: setattr(bench.data, "carries", True),
    ),
    "slave_lost": (lambda bench: setattr(bench.service, "lost_slave", 2), lambda bench: None),
    "drive_fault": (lambda bench: bench.models[1].inject_fault(UNDER_VOLTAGE), lambda bench: None),
    "clock_lost": (
        lambda bench: setattr(bench.discipline, "locked", False),
        lambda bench: setattr(bench.discipline, "locked", True),
    ),
    "emergency_stop": (
        lambda bench: put(bench, EMERGENCY_STOP_INPUT, False),
        lambda bench: put(bench, EMERGENCY_STOP_INPUT, True),
    ),
    "supervision": (turn_too_fast, let_go),
    "lease_ended": (take_the_lease, give_the_lease),
    "enabling_switch": (lambda bench: put(bench, SWITCH_INPUT, False), lambda bench: put(bench, SWITCH_INPUT, True)),
}
"""For each key what brings its event about, and what mends it."""


def bench_with(bench_board: tuple[Blackboard, Observer], **rungs: str) -> Bench:
    config = replace(WITH_SWITCH, stops=with_stops(**rungs))
    bench = Bench(*bench_board, config=config)
    bench.sentences = Sentences(config)
    put(bench, SWITCH_INPUT, True)
    return bench


@pytest.fixture
def made(bench_board: tuple[Blackboard, Observer]) -> Iterator[Callable[..., Bench]]:
    """Make a bench whose enabling switch is held, with rungs by key."""
    benches: list[Bench] = []

    def make(**rungs: str) -> Bench:
        benches.append(bench_with(bench_board, **rungs))
        return benches[-1]

    yield make
    bench_board[1].release(benches[-1].lease)


def codes_of(key: str) -> set[Code]:
    return {code for code, named in KEYS.items() if named == key}


def stop_for(bench: Bench, key: str, seconds: float = FROM_THE_CAUSE_S) -> int:
    """Bring an event about; return the place in the log of the cycle that found it."""
    before = len(bench.events)
    CAUSES[key][0](bench)
    bench.wait(lambda: any(event.code in codes_of(key) for event in bench.events[before:]), seconds)
    return len(bench.log) - 1


# -- the table ------------------------------------------------------------------------------------------------------


def test_every_key_has_an_event_and_every_event_a_key() -> None:
    assert {entry.name for entry in fields(StopsConfig)} == set(KEYS.values()) == set(CAUSES)


class Lived:
    """An event under one of its rungs, lived through once, from a motion at full speed to the next one."""

    def __init__(self, bench: Bench, key: str, rung: str) -> None:
        self.bench, self.key, self.rung = bench.set_in_motion(), key, rung
        self.at = stop_for(bench, key)
        self.said = next(
            sentence for event, sentence in zip(bench.events, bench.said, strict=True) if event.code in codes_of(key)
        )
        bench.run(0.6)
        self.ended_in = bench.state
        self.powered = bench.models[0].powered
        self.velocity = bench.models[0].mechanics.velocity
        CAUSES[key][1](bench)
        bench.run(0.15)
        self.mended = len(bench.log) - 1
        self.then = bench.state
        if self.then is not State.HOLDING:
            bench.do(Command.RESET)
            bench.until(State.READY)
            bench.enable()
        bench.move(0.0, 0.0)
        bench.run(0.2)


@pytest.fixture(scope="module", params=EVERY, ids="-".join)
def lived(request: pytest.FixtureRequest, bench_board: tuple[Blackboard, Observer]) -> Lived:
    key, rung = request.param
    bench = bench_with(bench_board, **{key: rung})
    try:
        return Lived(bench, key, rung)
    finally:
        bench_board[1].release(bench.lease)


def test_an_event_takes_the_rung_of_its_key(lived: Lived) -> None:
    told = {said.controlword for said in lived.bench.log[lived.at].drives if said.has_torque}
    assert told == {TOLD[lived.rung]}


def test_a_stop_is_told_in_one_line_with_its_rung_and_the_key_that_sets_it(lived: Lived) -> None:
    assert f"{lived.rung.replace('_', ' ')}" in lived.said
    assert f"(stops.{lived.key} in assistive_arm.yaml)" in lived.said
    assert "\n" not in lived.said


def test_no_rung_lets_a_target_jump(lived: Lived) -> None:
    assert [lived.bench.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


def test_a_rung_ends_in_its_state(lived: Lived) -> None:
    emergency = lived.key in ("emergency_stop", "supervision")
    soft = lived.key in ENDS and lived.rung == "controlled_stop"
    assert lived.ended_in is (State.EMERGENCY_STOP if emergency else State.HOLDING if soft else State.FAULT)
    if lived.key not in ("lost_frames", "supervision"):
        assert lived.powered is (lived.rung != "torque_off" and not emergency)
        assert abs(lived.velocity) < 0.001


def test_after_a_rung_nothing_moves_by_itself_and_reset_and_enable_go_on(lived: Lived) -> None:
    log, at = lived.bench.log, lived.at
    assert lived.then is lived.ended_in
    if lived.then is State.HOLDING:
        assert log[lived.mended].drives[0].target == log[lived.mended - 150].drives[0].target
    else:
        ramp = 350 if lived.rung == "controlled_stop" else 0
        assert all(
            said.controlword != ENABLE_OPERATION for cycle in log[at + ramp : lived.mended] for said in cycle.drives
        )
    assert lived.bench.state is State.MOVING


def test_a_joint_that_comes_to_rest_by_its_rung_is_not_said_to_stand_elsewhere(lived: Lived) -> None:
    assert Code.STANDS_ELSEWHERE not in lived.bench.codes


def test_nor_is_one_whose_drive_ramps_down_slowly(made: Callable[..., Bench]) -> None:
    bench = made().set_in_motion()
    for model in bench.models:
        # 0.2 rad/s2.
        model.objects[QUICK_STOP_DECELERATION, 0].value = 2000
    stood = bench.arm.state.actual[0]
    stop_for(bench, "slave_lost")
    bench.run(2.0)
    bench.do(Command.RESET)
    bench.until(State.READY)
    assert bench.arm.state.actual[0] - stood > 0.2
    assert Code.STANDS_ELSEWHERE not in bench.codes


@pytest.mark.parametrize("key", ENDS)
@pytest.mark.parametrize("rung", HARD)
def test_an_arm_that_holds_needs_neither_a_lease_nor_the_enabling_switch(
    made: Callable[..., Bench], key: str, rung: str
) -> None:
    bench = made(**{key: rung}).hold()
    CAUSES[key][0](bench)
    bench.run(0.2)
    assert bench.state is State.HOLDING
    CAUSES[key][1](bench)


@pytest.mark.parametrize("rung", HARD)
def test_a_homing_whose_commander_falls_silent_takes_the_rung_too(made: Callable[..., Bench], rung: str) -> None:
    bench = made(lease_ended=rung).bring_to(State.HOMING)
    bench.run(0.1)
    stop_for(bench, "lease_ended")
    assert bench.state is State.FAULT
    assert {said.controlword for said in bench.log[-1].drives} == {TOLD[rung]}
    give_the_lease(bench)


@pytest.mark.parametrize("code", [Code.LEASE_ENDED, Code.NOT_PERMITTED], ids=lambda code: code.name.lower())
def test_a_harder_end_is_a_fault_in_the_status_and_a_controlled_one_is_none(code: Code) -> None:
    soft = Sentences(CONFIG)
    hard = Sentences(replace(CONFIG, stops=with_stops(**{KEYS[code]: "quick_stop"})))
    assert hard.faults - soft.faults == {code}
    assert hard.event(code, -1, 0.0, 0.0).endswith("`rtcp reset` goes on")
    assert "reset" not in soft.event(code, -1, 0.0, 0.0)


# -- a controlled stop that ends in a fault -------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.MOVING, State.STOPPING, State.DISABLING], ids=lambda state: state.name.lower())
def test_for_a_lost_clock_the_arm_comes_to_rest_under_its_limits_before_it_is_a_fault(
    made: Callable[..., Bench], state: State
) -> None:
    bench = made(clock_lost="controlled_stop")
    # So slow that it is still on its way to rest a second later.
    bench.arm.limits.acceleration[:], bench.arm.limits.jerk[:] = [0.2, 0.2], [2.0, 2.0]
    bench.hold()
    bench.move(1.8, 1.8)
    bench.run(2.0)
    CAUSES["clock_lost"][0](bench)
    bench.run(0.7)
    if state is not State.MOVING:
        bench.do(Command.STOP if state is State.STOPPING else Command.DISABLE)
    assert bench.state is state
    bench.wait(lambda: Code.CLOCK_LOST in bench.codes)
    at = len(bench.log)
    on_the_way = State.DISABLING if state is State.DISABLING else State.STOPPING
    assert (bench.state, bench.behaviour.fault) == (on_the_way, Code.CLOCK_LOST)
    bench.until(State.FAULT)
    ramp = bench.log[at:-1]
    assert {said.controlword for cycle in ramp for said in cycle.drives} == {ENABLE_OPERATION}
    assert bench.arm.first_moving() == -1
    assert bench.codes.count(Code.CLOCK_LOST) == 1
    assert bench.behaviour.fault is Code.CLOCK_LOST
    bench.run(0.2)
    # Whoever asked for no torque has none.
    assert [model.powered for model in bench.models] == [state is not State.DISABLING] * 2


def test_a_clock_that_is_lost_while_the_torque_is_taken_ends_without_torque(made: Callable[..., Bench]) -> None:
    bench = made(clock_lost="controlled_stop").hold()
    CAUSES["clock_lost"][0](bench)
    bench.run(0.98)
    bench.data.deaf[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    bench.do(Command.DISABLE)
    bench.until(State.FAULT, 0.05)
    bench.run(0.1)
    assert bench.codes.count(Code.CLOCK_LOST) == 1
    assert (bench.behaviour.fault, [model.powered for model in bench.models]) == (Code.CLOCK_LOST, [False, False])


def test_an_arm_that_stands_goes_into_the_fault_of_a_lost_clock_at_once(made: Callable[..., Bench]) -> None:
    bench = made(clock_lost="controlled_stop").hold()
    stop_for(bench, "clock_lost")
    assert bench.state is State.FAULT
    assert {said.controlword for said in bench.log[-1].drives} == {QUICK_STOP}


def test_disabled_on_the_way_to_the_fault_of_a_lost_clock_the_arm_ends_there_without_torque(
    made: Callable[..., Bench],
) -> None:
    bench = made(clock_lost="controlled_stop").set_in_motion()
    stop_for(bench, "clock_lost")
    bench.do(Command.DISABLE)
    bench.until(State.FAULT)
    bench.run(0.1)
    assert (bench.behaviour.fault, [model.powered for model in bench.models]) == (Code.CLOCK_LOST, [False, False])


@pytest.mark.parametrize("key", ["lost_frames", "drive_fault", "emergency_stop"])
def test_what_is_worse_ends_the_controlled_stop_for_a_lost_clock(made: Callable[..., Bench], key: str) -> None:
    bench = made(clock_lost="controlled_stop").set_in_motion()
    stop_for(bench, "clock_lost")
    stop_for(bench, key)
    assert bench.state is (State.EMERGENCY_STOP if key == "emergency_stop" else State.FAULT)
    assert bench.behaviour.fault in codes_of(key)
    bench.run(0.5)
    assert bench.behaviour.fault in codes_of(key)


def test_where_a_lost_clock_may_end_in_a_controlled_stop_set_points_move_the_arm() -> None:
    assert {state for state, row in TABLE.items() if Event.WAVERS in row.left_by} == {
        State.HOLDING,
        State.MOVING,
        State.STOPPING,
    }


# -- the way out ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rung", HARD)
def test_a_press_while_the_loop_is_ending_takes_its_rung(made: Callable[..., Bench], rung: str) -> None:
    bench = made(emergency_stop=rung).set_in_motion()
    bench.do(Command.SHUTDOWN)
    at = stop_for(bench, "emergency_stop")
    assert {said.controlword for said in bench.log[at].drives} == {TOLD[rung]}
    bench.finish()
    assert [model.powered for model in bench.models] == [False, False]


@pytest.mark.parametrize("rung", HARD)
def test_frames_that_stay_away_while_the_loop_is_ending_take_their_rung(made: Callable[..., Bench], rung: str) -> None:
    bench = made(lost_frames=rung).bring_to(State.CLOSING)
    bench.data.carries = False
    bench.finish()
    assert {said.controlword for cycle in bench.log[-20:] for said in cycle.drives} == {TOLD[rung]}


# -- hold -----------------------------------------------------------------------------------------------------------

HELD_IN = [
    *((state, mode) for mode in (CSP, CSV, CST)
      for state in (State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING, State.STOPPED_BY_LIMIT)),
    (State.HOMING, CSP),
]  # fmt: skip


@pytest.mark.parametrize(("state", "mode"), HELD_IN, ids=lambda value: getattr(value, "name", str(value)).lower())
def test_a_cycle_with_a_wrong_working_counter_sends_the_last_targets_again(
    made: Callable[..., Bench], state: State, mode: int
) -> None:
    bench = made()
    if mode == CSP:
        bench.bring_to(state)
    else:
        bench.hold(mode)
        if state is not State.HOLDING:
            bench.move(1.8, 1.8)
            bench.run(0.6)
        if state is State.STOPPED_BY_LIMIT:
            bench.arm.limits.high[0] = bench.arm.state.commanded[0] + 0.3
            bench.until(State.STOPPED_BY_LIMIT)
        elif state in (State.STOPPING, State.DISABLING):
            bench.do(Command.STOP if state is State.STOPPING else Command.DISABLE)
            bench.run(0.05)
    assert bench.state is state
    sent = [bench.data.output(slot) for slot in (1, 2)]
    # One slave's part of the counter is missing: all others have heard.
    bench.data.expected_wkc -= 1
    for _ in range(LOST_CYCLES - 1):
        bench.cycle()
        assert [bench.data.output(slot) for slot in (1, 2)] == sent
        assert bench.state is state
    bench.cycle()
    assert bench.state is State.FAULT
    assert {said.controlword for said in bench.log[-1].drives} == {QUICK_STOP}
    assert [(said.speed, said.effort) for said in bench.log[-1].drives] == [(0, 0), (0, 0)]


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_set_points_go_on_after_held_cycles_without_a_jump(made: Callable[..., Bench], mode: int) -> None:
    bench = made().set_in_motion(mode)
    at = len(bench.log)
    expected = bench.data.expected_wkc
    for _ in range(4):
        bench.data.expected_wkc = expected - 1
        bench.run((LOST_CYCLES - 1) * PERIOD_S)
        bench.data.expected_wkc = expected
        bench.run(0.1)
    assert bench.state is State.MOVING
    assert max(abs(said.velocity) for cycle in bench.log[at:] for said in cycle.drives) < 5000
    assert [bench.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


@pytest.mark.parametrize("ends", ["stop", "lease"])
def test_a_move_that_is_stopped_before_a_frame_came_for_it_never_begins(made: Callable[..., Bench], ends: str) -> None:
    bench = made().hold()
    bench.data.carries = False
    bench.move(1.0, 1.0)
    if ends == "stop":
        bench.do(Command.STOP)
    else:
        take_the_lease(bench)
        bench.cycle()
    bench.data.carries = True
    bench.run(0.5)
    if ends == "lease":
        give_the_lease(bench)
    assert bench.state is State.HOLDING
    assert {said.target for cycle in bench.log[-500:] for said in cycle.drives} == {0}


# -- torque off -----------------------------------------------------------------------------------------------------


def test_torque_off_is_disable_voltage_from_operation_enabled_without_the_ramp_of_disabling(
    made: Callable[..., Bench],
) -> None:
    bench = made(slave_lost="torque_off").set_in_motion()
    stop_for(bench, "slave_lost")
    bench.run(3 * PERIOD_S)
    assert [model.powered for model in bench.models] == [False, False]
    assert set(bench.words(0)[-2:]) == {ENABLE_OPERATION, VOLTAGE_OFF}


def test_a_drive_that_does_not_hear_the_torque_off_is_told_for_as_long_as_the_fault_lasts(
    made: Callable[..., Bench],
) -> None:
    bench = made(slave_lost="torque_off").set_in_motion()
    bench.data.deaf[1, CONTROLWORD] = {VOLTAGE_OFF: ENABLE_OPERATION}
    stop_for(bench, "slave_lost")
    bench.run(0.3)
    bench.data.deaf.clear()
    bench.run(0.01)
    assert [model.powered for model in bench.models] == [False, False]
