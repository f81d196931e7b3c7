"""The machine's states, what makes a fault of them and what leads out again: the real classes and the real device
models, cycle by cycle, without a bus and without a clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import ControllerFailed
from rtcp.ipc.machine import Code, Command, State
from rtcp.ipc.messages import FAULTS
from rtcp.ipc.observer import Observer
from rtcp.ipc.stops import Rung, bounds
from rtcp.motion.guards.output_limiter import BACK_RAD_S
from rtcp.motion.state import ArmState, Setpoint

from .bench import (
    _WIRE,
    CONFIG,
    CONTROLWORD,
    COUNTS,
    CSP,
    CST,
    CSV,
    DEBOUNCE_S,
    EMERGENCIES,
    EMERGENCY_STOP_INPUT,
    ENABLE_OPERATION,
    ENABLE_TIMEOUT_S,
    LONGEST_STEP,
    LOST_CYCLES,
    MODES_OF_OPERATION,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_ON,
    UNDER_VOLTAGE,
    Bench,
    move_numbers,
)

# -- every fault: what it is, what is said, what the drives are told, and the way back ------------------------------


@dataclass(frozen=True)
class Fault:
    """A fault from its cause to its end."""

    name: str
    code: Code
    axis: int
    says: tuple[str, ...]
    """What its sentence has to name; {word} is the statusword of the joint when it happened."""
    breaks: Callable[[Bench], object]
    """From the start of the platform to the cause; the fault follows within 4 s."""
    mend: Callable[[Bench], object]


def nothing(bench: Bench) -> None:
    """The cause does not last."""


def hears_all(bench: Bench) -> None:
    bench.data.deaf.clear()


def drive_fault_while_ready(bench: Bench) -> None:
    bench.start().models[1].inject_fault(UNDER_VOLTAGE)


def drive_fault_in_motion(bench: Bench) -> None:
    bench.set_in_motion().models[1].inject_fault(UNDER_VOLTAGE)


def drive_that_leaves_by_itself(bench: Bench) -> None:
    bench.set_in_motion()
    bench.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: 0}


def drive_that_does_not_enable(bench: Bench) -> None:
    bench.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    bench.start().do(Command.ENABLE)


def drive_that_does_not_disable(bench: Bench) -> None:
    bench.data.deaf[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    bench.set_in_motion().do(Command.DISABLE)


def drive_that_keeps_its_mode(bench: Bench) -> None:
    bench.hold().data.deaf[1, MODES_OF_OPERATION] = {CSV: CSP}
    bench.do(Command.MODE, [CSV])


def drive_whose_fault_lasts(bench: Bench) -> None:
    bench.start().models[1].condition.bus_voltage = 10.0
    bench.until(State.FAULT)
    bench.do(Command.RESET)


def voltage_returns(bench: Bench) -> None:
    bench.models[1].condition.bus_voltage = 48.0


def joint_that_does_not_come_to_rest(bench: Bench) -> None:
    bench.bring_to(State.FAULT)
    # More than its drive can hold, and too heavy to become fast soon.
    turned = bench.models[1].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 2000.0, 0.05, 117.0
    bench.do(Command.RESET)


def joint_that_turns_on_after_its_homing(bench: Bench) -> None:
    bench.bring_to(State.HOMING)
    bench.run(0.1)
    turned = bench.models[0].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 1e5, 0.015, 117.0
    bench.do(Command.STOP)


def joint_is_let_go(bench: Bench) -> None:
    for model in bench.models:
        turned = model.mechanics
        turned.inertia, turned.velocity, turned.external_torque = 1.0, 0.0, 0.0


def slave_that_leaves_op(bench: Bench) -> None:
    bench.set_in_motion().service.lost_slave = 3


def slave_that_does_not_come_back(bench: Bench) -> None:
    bench.bring_to(State.RESETTING)


def slaves_come_back(bench: Bench) -> None:
    bench.slaves_come_back = True


def frames_stay_away(bench: Bench) -> None:
    bench.set_in_motion().data.carries = False


def frames_come_back(bench: Bench) -> None:
    bench.data.carries = True


def clock_runs_away(bench: Bench) -> None:
    bench.set_in_motion().discipline.locked = False


def clock_is_followed(bench: Bench) -> None:
    bench.discipline.locked = True


def joint_is_turned_out_of_its_range(bench: Bench) -> None:
    bench.start().do(Command.ENABLE)
    bench.models[1].mechanics.position = 2.1


def joint_is_turned_back(bench: Bench) -> None:
    bench.models[1].mechanics.position = 1.9


def joint_says_it_is_elsewhere(bench: Bench) -> None:
    bench.start().do(Command.ENABLE)
    said = bench.data.input

    def elsewhere(slot: int) -> bytes:
        values = _WIRE.unpack(said(slot))
        return _WIRE.pack(values[0], 1000, *values[2:]) if slot == 2 else said(slot)

    bench.data.input = lambda slot: elsewhere(slot) if slot else said(slot)


def joint_says_where_it_is(bench: Bench) -> None:
    del bench.data.input


def generator_refuses(bench: Bench) -> None:
    generator = bench.set_in_motion().arm.motions.generator

    def refuse(state: ArmState) -> Setpoint:
        generator.ended = ControllerFailed()
        target = Setpoint(2)
        target.position = list(state.commanded)
        return target

    generator.update = refuse


def generator_works(bench: Bench) -> None:
    del bench.arm.motions.generator.update


FAULT_STORIES = (
    Fault(
        "a drive fault while ready", Code.DRIVE_FAULT, 1,
        ("joint2", "in fault", "statusword {word}", "`rtcp reset`"),
        drive_fault_while_ready, nothing,
    ),
    Fault(
        "a drive fault in motion", Code.DRIVE_FAULT, 1,
        ("joint2", "in fault", "statusword {word}", "`rtcp reset`"),
        drive_fault_in_motion, nothing,
    ),
    Fault(
        "a drive that leaves by itself", Code.DRIVE_LEFT_ENABLED, 1,
        ("joint2", "left Operation Enabled", "statusword {word}", "`rtcp reset`"),
        drive_that_leaves_by_itself, hears_all,
    ),
    Fault(
        "a drive that does not enable", Code.ENABLE_STUCK, 1,
        ("joint2", "enabling stuck", "0.2 s", "{word}", "enable_timeout_s in assistive_arm.yaml"),
        drive_that_does_not_enable, hears_all,
    ),
    Fault(
        "a drive that does not disable", Code.DISABLE_STUCK, 1,
        ("joint2", "did not give up its torque within", "statusword {word}", "enable_timeout_s"),
        drive_that_does_not_disable, hears_all,
    ),
    Fault(
        "a drive that keeps its mode", Code.MODE_STUCK, 1,
        ("joint2", "mode 8", "9 was asked"),
        drive_that_keeps_its_mode, hears_all,
    ),
    Fault(
        "a drive whose fault lasts", Code.RESET_STUCK, 1,
        ("joint2", "in fault after reset", "statusword {word}"),
        drive_whose_fault_lasts, voltage_returns,
    ),
    Fault(
        "a joint that does not come to rest", Code.RESET_MOVING, 1,
        ("joint2", "still turns", "rad/s", "3 s", "`rtcp disable`"),
        joint_that_does_not_come_to_rest, joint_is_let_go,
    ),
    Fault(
        "a joint that turns on after its homing", Code.HOMING_RUNNING, 0,
        ("joint1", "still turns", "rad/s", "3 s", "homing", "`rtcp reset`"),
        joint_that_turns_on_after_its_homing, joint_is_let_go,
    ),
    Fault(
        "a slave that does not come back", Code.RESET_STUCK, -1,
        ("reset", "3 s", "not all slaves are back in OP"),
        slave_that_does_not_come_back, slaves_come_back,
    ),
    Fault(
        "a slave that leaves OP", Code.SLAVE_NOT_OP, 3,
        ("slave 3 (drive2)", "left OP", "`rtcp reset`"),
        slave_that_leaves_op, nothing,
    ),
    Fault(
        "frames that stay away", Code.BUS_LOST, -1,
        ("process data lost", "40 cycles", "bus.lost_cycles in assistive_arm.yaml", "`rtcp reset`"),
        frames_stay_away, frames_come_back,
    ),
    Fault(
        "a clock that runs away", Code.CLOCK_LOST, -1,
        ("reference clock", "1 s", "`rtcp reset`"),
        clock_runs_away, clock_is_followed,
    ),
    Fault(
        "a joint that is turned out of its range", Code.LEFT_RANGE, 1,
        ("joint2", "left its range", "2.1 rad", "joints[1].position in assistive_arm.yaml"),
        joint_is_turned_out_of_its_range, joint_is_turned_back,
    ),
    Fault(
        "a joint that says it is elsewhere while it is enabled", Code.POSITION_JUMPED, 1,
        ("joint2", "followed to 0 rad", "0.1 rad", "5 cycles (supervision.cycles in assistive_arm.yaml)",
         "`rtcp reset`"),
        joint_says_it_is_elsewhere, joint_says_where_it_is,
    ),
    Fault(
        "a generator that refuses", Code.GENERATOR, -1,
        ("trajectory generator", "`rtcp reset`"),
        generator_refuses, generator_works,
    ),
)  # fmt: skip


class Story:
    """One fault, lived through once: what every test of it looks at."""

    def __init__(self, fault: Fault, bench: Bench) -> None:
        self.fault, self.bench = fault, bench
        fault.breaks(bench)
        if bench.state is State.FAULT:
            bench.cycle()
        bench.until(State.FAULT, 4.0)
        self.event, self.said = bench.events[-1], bench.said[-1]
        self.kept = bench.behaviour.fault
        self.at = len(bench.log) - 1
        bench.run(0.3)
        fault.mend(bench)
        bench.run(1.0)
        self.mended = len(bench.log)
        bench.do(Command.RESET)
        self.after_reset = self._reach(State.READY)
        bench.run(0.3)
        self.before_enable = len(bench.log)
        self.enable_answer = bench.order(Command.ENABLE)
        self.after_enable = self._reach(State.HOLDING)
        bench.run(0.1)

    def _reach(self, state: State) -> State:
        try:
            self.bench.until(state, 4.0)
        except AssertionError:
            pass
        return self.bench.state


@pytest.fixture(scope="module", params=FAULT_STORIES, ids=lambda fault: fault.name)
def story(request: pytest.FixtureRequest, bench_board: tuple[Blackboard, Observer]) -> Story:
    bench = Bench(*bench_board)
    try:
        return Story(request.param, bench)
    finally:
        bench_board[1].release(bench.lease)


def test_every_code_of_a_fault_has_its_story() -> None:
    assert {fault.code for fault in FAULT_STORIES} == FAULTS - EMERGENCIES


def test_a_fault_has_its_code_and_its_joint_or_slave(story: Story) -> None:
    assert (Code(story.event.code), story.event.axis, story.kept) == (
        story.fault.code,
        story.fault.axis,
        story.event.code,
    )


def test_a_fault_is_one_line_that_names_what_is_wrong_where_and_the_key(story: Story) -> None:
    words = [f"0x{said.statusword:04X}" for said in story.bench.log[story.at].drives]
    named = [part.format(word=words[story.fault.axis] if "{" in part else "") for part in story.fault.says]
    assert [part for part in named if part not in story.said] == []
    assert "\n" not in story.said


def test_no_target_jumps_from_the_first_enabling_over_the_fault_to_the_next(story: Story) -> None:
    assert [story.bench.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


def test_every_drive_with_torque_is_told_to_quick_stop_in_the_cycle_of_the_fault(story: Story) -> None:
    told = [said.controlword for said in story.bench.log[story.at].drives if said.has_torque]
    assert set(told) <= {QUICK_STOP}


def test_in_a_fault_no_speed_and_no_torque_is_sent(story: Story) -> None:
    sent = {(said.speed, said.effort) for cycle in story.bench.log[story.at : story.mended] for said in cycle.drives}
    assert sent == {(0, 0)}


def test_a_fault_stays_when_its_cause_is_gone(story: Story) -> None:
    assert {cycle.state for cycle in story.bench.log[story.at : story.mended]} == {State.FAULT}


def test_nothing_is_enabled_between_a_fault_and_the_next_enable(story: Story) -> None:
    told = {said.controlword for cycle in story.bench.log[story.at : story.before_enable] for said in cycle.drives}
    assert ENABLE_OPERATION not in told


def test_a_reset_after_the_cause_leads_to_ready(story: Story) -> None:
    assert story.after_reset is State.READY


def test_an_enable_after_the_reset_leads_to_holding(story: Story) -> None:
    assert (story.enable_answer.refusal, story.after_enable) == (0, State.HOLDING)


# -- starting -------------------------------------------------------------------------------------------------------


def test_the_slaves_are_asked_for_op_only_when_the_clock_is_followed(bench: Bench) -> None:
    asked: list[int] = []
    bench.service.want_op = lambda: asked.append(len(bench.log))
    bench.discipline.locked = False
    bench.run(0.1)
    assert asked == []
    bench.discipline.locked = True
    bench.cycle()
    assert asked == [100]


def test_ready_is_told_when_all_slaves_are_in_op_and_not_before(bench: Bench) -> None:
    bench.run(0.1)
    assert (bench.state, bench.codes) == (State.STARTING, [Code.DC_LOCKED])
    bench.service.all_op = True
    bench.cycle()
    assert (bench.state, bench.codes) == (State.READY, [Code.DC_LOCKED, Code.READY])


def test_a_slave_that_leaves_op_before_the_machine_is_ready_is_brought_back_without_a_reset(bench: Bench) -> None:
    asked: list[int] = []
    bench.service.recover = lambda: asked.append(len(bench.log))
    bench.run(0.01)
    assert asked == []
    bench.service.lost_slave = 2
    bench.cycle()
    assert asked == [10]
    bench.service.lost_slave, bench.service.all_op = 0, True
    bench.cycle()
    assert (asked, bench.state) == ([10], State.READY)


def test_what_is_lost_from_when_all_slaves_are_in_op_is_a_fault_also_before_the_machine_was_ready(bench: Bench) -> None:
    bench.models[0].mechanics.position = 0.7
    bench.data.away.add(2)
    bench.run(2 * LOST_CYCLES * PERIOD_S)
    assert bench.state is State.STARTING
    bench.service.all_op = True
    took_s = bench.until(State.FAULT)
    # Cycles before count for nothing. The box was not yet heard: nobody has pressed the emergency stop.
    assert took_s == pytest.approx(LOST_CYCLES * PERIOD_S, abs=1.5 * PERIOD_S)
    bench.run(0.1)
    assert (bench.state, bench.codes) == (State.FAULT, [Code.DC_LOCKED, Code.BUS_LOST])
    bench.data.away.clear()
    bench.do(Command.RESET)
    bench.until(State.READY)
    # Nor were the joints: none of them stands elsewhere than before.
    assert bench.codes[2:] == [Code.RESET]


def test_an_emergency_stop_that_is_pressed_when_the_start_fails_is_heard(bench: Bench) -> None:
    bench.data.devices[0].set_input(EMERGENCY_STOP_INPUT, False)
    bench.data.away.add(2)
    bench.service.all_op = True
    bench.until(State.FAULT)
    bench.until(State.EMERGENCY_STOP, 0.1)


# -- enabling -------------------------------------------------------------------------------------------------------


def test_enabling_starts_with_the_target_where_each_joint_stands(bench: Bench) -> None:
    for model, position in zip(bench.models, (0.7, -0.4), strict=True):
        model.mechanics.position = position
    bench.hold()
    for axis, position in enumerate((7000, -4000)):
        told = [cycle.drives[axis] for cycle in bench.log if cycle.drives[axis].controlword == ENABLE_OPERATION]
        assert {said.target for said in told} == {position}


def test_a_joint_that_was_turned_by_hand_is_enabled_where_it_stands_then(bench: Bench) -> None:
    bench.hold()
    bench.do(Command.DISABLE)
    bench.until(State.READY)
    bench.run(0.1)
    bench.models[0].mechanics.position = 0.5
    bench.run(0.01)
    before = len(bench.log)
    bench.enable()
    told = [said for cycle in bench.log[before:] if (said := cycle.drives[0]).controlword == ENABLE_OPERATION]
    assert {said.target for said in told} == {5000}


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_just_beyond_its_range_is_enabled_where_it_stands_and_brought_back_gently(
    bench: Bench, side: int, mode: int
) -> None:
    bench.models[1].mechanics.position = 2.018 * side
    bench.hold(mode)
    bench.run(1.0)
    said = [cycle.drives[1] for cycle in bench.log if cycle.drives[1].controlword == ENABLE_OPERATION]
    assert abs(said[0].target - said[0].position) <= 1
    assert abs(said[0].position) == 20180
    targets = [drive.target for drive in said]
    for cycles in (1, 4, 16, 64):
        # Both ends are rounded to counts.
        allowed = BACK_RAD_S * cycles * PERIOD_S * COUNTS + 1
        assert max(abs(after - before) for before, after in zip(targets, targets[cycles:], strict=False)) <= allowed
    assert targets[-1] == 20000 * side
    assert max(abs(drive.velocity) for drive in said) < 0.1 * COUNTS
    assert bench.arm.drives[1].position == pytest.approx(2.0 * side, abs=2e-3)


@pytest.mark.parametrize("mode", [CSV, CST])
def test_drives_are_enabled_in_csp_and_take_the_wanted_mode_only_then(bench: Bench, mode: int) -> None:
    bench.hold(mode)
    enabling = [cycle.drives[1].mode for cycle in bench.log if cycle.state is State.ENABLING]
    assert set(enabling) == {CSP}
    assert [said.mode_display for said in bench.log[-1].drives] == [mode, mode]


@pytest.mark.parametrize("position", [0.0, 1.2])
def test_the_arm_holds_its_place_through_every_change_of_mode(bench: Bench, position: float) -> None:
    # A load that pulls: a mode that began without torque would sag.
    bench.models[0].mechanics.gravity_torque = 15.0
    bench.models[0].mechanics.position = position
    bench.hold()
    bench.run(0.3)
    before = len(bench.log)
    for mode in (CSV, CST, CSP, CST, CSV, CSP):
        bench.do(Command.MODE, [mode])
        bench.run(0.3)
        assert bench.arm.first_in_another_mode() == -1
    seen = [cycle.drives[0] for cycle in bench.log[before:]]
    assert len({said.target for said in seen}) == 1
    assert max(abs(said.position - round(position * COUNTS)) for said in seen) <= 50


# -- how long things may take ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("breaks", "seconds"),
    [
        (drive_that_does_not_enable, ENABLE_TIMEOUT_S),
        (drive_that_keeps_its_mode, 1.0),
        (clock_runs_away, 1.0),
        (slave_that_does_not_come_back, 3.0 + DEBOUNCE_S),
    ],
)
def test_a_fault_of_patience_comes_when_it_is_over_and_not_before(
    bench: Bench, breaks: Callable[[Bench], object], seconds: float
) -> None:
    breaks(bench)
    assert bench.until(State.FAULT) == pytest.approx(seconds, abs=3 * PERIOD_S)


def test_the_time_for_disabling_begins_when_the_arm_stands(bench: Bench) -> None:
    drive_that_does_not_disable(bench)
    bench.until(State.FAULT)
    told = [said for cycle in bench.log if (said := cycle.drives[1]).controlword == SWITCH_ON and said.has_torque]
    assert len(told) * PERIOD_S == pytest.approx(ENABLE_TIMEOUT_S, abs=3 * PERIOD_S)


# -- lost frames ----------------------------------------------------------------------------------------------------


def lose(bench: Bench, cycles: int) -> None:
    bench.data.carries = False
    bench.run(cycles * PERIOD_S)
    bench.data.carries = True


def test_as_many_lost_cycles_as_are_allowed_do_not_end_a_move(bench: Bench) -> None:
    bench.hold()
    bench.move(0.1, 0.1)
    bench.run(0.2)
    lose(bench, LOST_CYCLES - 1)
    bench.until(State.HOLDING)
    assert bench.codes[-1] is Code.ARRIVED


def test_lost_cycles_are_made_up_for_by_as_many_good_ones(bench: Bench) -> None:
    bench.set_in_motion()
    for _ in range(5):
        lose(bench, LOST_CYCLES - 1)
        bench.run((LOST_CYCLES - 1) * PERIOD_S)
    assert bench.state is State.MOVING


def test_set_points_stand_while_no_frame_comes_back_and_go_on_from_there(bench: Bench) -> None:
    bench.set_in_motion()
    before = bench.log[-1].drives[0].target
    lose(bench, LOST_CYCLES - 1)
    assert {cycle.drives[0].target for cycle in bench.log[-LOST_CYCLES + 1 :]} == {before}
    bench.cycle()
    assert 0 < bench.log[-1].drives[0].target - before <= LONGEST_STEP


def test_drives_that_still_hear_are_told_to_stop_for_as_long_as_no_frame_comes_back(bench: Bench) -> None:
    frames_stay_away(bench)
    bench.until(State.FAULT)
    at = len(bench.log)
    bench.run(0.5)
    assert {said.controlword for cycle in bench.log[at:] for said in cycle.drives} == {QUICK_STOP}


# -- whatever is lost, in whatever state ----------------------------------------------------------------------------

CAUSES: dict[Code, Callable[[Bench], object]] = {
    Code.BUS_LOST: lambda bench: setattr(bench.data, "carries", False),
    Code.SLAVE_NOT_OP: lambda bench: setattr(bench.service, "lost_slave", 2),
    Code.CLOCK_LOST: lambda bench: setattr(bench.discipline, "locked", False),
    Code.DRIVE_FAULT: lambda bench: bench.models[1].inject_fault(UNDER_VOLTAGE),
}
LOST = [
    *((code, state) for code in (Code.BUS_LOST, Code.SLAVE_NOT_OP)
      for state in (State.READY, State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING)),
    *((Code.CLOCK_LOST, state) for state in (State.READY, State.HOLDING, State.MOVING)),
    *((Code.DRIVE_FAULT, state) for state in (State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING)),
]  # fmt: skip


@pytest.mark.parametrize(("code", "state"), LOST, ids=lambda value: value.name.lower())
def test_what_is_lost_is_that_fault_in_every_state(bench: Bench, code: Code, state: State) -> None:
    # A drive that is kept from enabling keeps the machine in that state.
    bench.data.deaf[0, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON} if state is State.ENABLING else {}
    bench.bring_to(state)
    CAUSES[code](bench)
    bench.until(State.FAULT, 1.1)
    assert (bench.codes[-1], bench.behaviour.fault) == (code, code)


def test_a_drive_fault_while_enabling_ends_in_a_fault_that_names_the_joint(bench: Bench) -> None:
    bench.bring_to(State.ENABLING).models[1].inject_fault(UNDER_VOLTAGE)
    bench.until(State.FAULT, ENABLE_TIMEOUT_S + 0.01)
    assert bench.said[-1].startswith("joint2: ")


@pytest.mark.parametrize("code", [Code.DRIVE_FAULT, Code.SLAVE_NOT_OP])
def test_a_fault_makes_no_target_jump_where_a_joint_was_held_back(bench: Bench, code: Code) -> None:
    bench.set_in_motion()
    bench.models[0].mechanics.external_torque = -100.0
    bench.run(0.04)
    lag = bench.log[-1].drives[0].target - bench.log[-1].drives[0].position
    assert lag > 20 * LONGEST_STEP
    CAUSES[code](bench)
    bench.until(State.FAULT)
    bench.models[0].mechanics.external_torque = 0.0
    bench.run(0.5)
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.enable()
    bench.run(0.2)
    assert bench.longest_step(0) <= LONGEST_STEP


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_a_fault_of_one_drive_brings_the_others_to_rest_under_torque_in_every_mode(bench: Bench, mode: int) -> None:
    bench.set_in_motion(mode)
    bench.models[1].inject_fault(UNDER_VOLTAGE)
    bench.until(State.FAULT)
    bench.run(0.5)
    assert bench.models[0].powered
    assert abs(bench.models[0].mechanics.velocity) < 0.001


# -- reset and torque off -------------------------------------------------------------------------------------------


def test_disable_in_a_fault_takes_the_torque_off_and_leaves_the_fault(bench: Bench) -> None:
    bench.bring_to(State.FAULT)
    assert [model.powered for model in bench.models] == [True, True]
    bench.do(Command.DISABLE)
    bench.run(0.05)
    assert [model.powered for model in bench.models] == [False, False]
    assert (bench.state, bench.behaviour.fault) == (State.FAULT, Code.SLAVE_NOT_OP)
    assert bench.codes[-1] is Code.TORQUE_OFF


def test_disable_during_a_reset_ends_it_in_the_fault_that_was(bench: Bench) -> None:
    bench.bring_to(State.RESETTING)
    bench.do(Command.DISABLE)
    bench.slaves_come_back = True
    bench.run(0.5)
    assert (bench.state, bench.behaviour.fault) == (State.FAULT, Code.SLAVE_NOT_OP)
    assert [model.powered for model in bench.models] == [False, False]


def test_the_fault_after_one_whose_torque_was_taken_off_is_a_quick_stop_again(bench: Bench) -> None:
    bench.bring_to(State.FAULT)
    bench.do(Command.DISABLE)
    bench.run(0.05)
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.enable()
    bench.service.lost_slave = 3
    bench.run(0.1)
    assert bench.state is State.FAULT
    assert [model.powered for model in bench.models] == [True, True]


def slow_quick_stop(bench: Bench) -> None:
    """From full speed it takes 1.5 s, at 0.2 rad/s2."""
    for model in bench.models:
        model.objects[0x6085, 0].value = 2000


def test_a_reset_lets_come_to_rest_what_still_moves_before_it_takes_its_torque(bench: Bench) -> None:
    slow_quick_stop(bench)
    bench.set_in_motion()
    bench.service.lost_slave = 3
    bench.cycle()
    bench.do(Command.RESET)
    bench.until(State.READY)
    moving = [said for cycle in bench.log for said in cycle.drives if said.has_torque and abs(said.velocity) > 100]
    assert {said.controlword for said in moving} == {ENABLE_OPERATION, QUICK_STOP}


def test_a_reset_is_tried_again_until_the_cause_of_a_drive_fault_is_gone(bench: Bench) -> None:
    bench.start().models[1].condition.bus_voltage = 10.0
    bench.until(State.FAULT)
    bench.do(Command.RESET)
    bench.run(0.5)
    assert bench.state is State.RESETTING
    voltage_returns(bench)
    bench.until(State.READY, 0.1)


def test_a_reset_waits_for_the_clock_to_be_followed(bench: Bench) -> None:
    clock_runs_away(bench)
    bench.until(State.FAULT)
    bench.do(Command.RESET)
    bench.run(1.0)
    assert bench.state is State.RESETTING
    bench.discipline.locked = True
    bench.until(State.READY, 0.1)


# -- moving, stopping, disabling ------------------------------------------------------------------------------------


def test_a_move_arrives_where_it_was_told_to(bench: Bench) -> None:
    bench.hold()
    bench.move(0.05, -0.05)
    bench.until(State.HOLDING)
    bench.run(0.1)
    assert bench.codes[-1] is Code.ARRIVED
    assert [drive.position for drive in bench.arm.drives] == pytest.approx([0.05, -0.05], abs=1e-3)


def test_set_points_that_jump_reach_the_drives_in_steps_inside_the_speed_limit(bench: Bench) -> None:
    bench.hold()

    def jump(state: ArmState) -> Setpoint:
        target = Setpoint(2)
        target.position = [1.0, -2.5]
        return target

    generator = bench.arm.motions.generator
    generator.update = jump
    bench.run(0.3)
    bench.run(4.0)
    assert all(bench.longest_step(axis) <= LONGEST_STEP for axis in range(2))
    assert min(cycle.drives[1].target for cycle in bench.log) >= -2.0 * COUNTS


def test_a_stop_comes_to_rest_far_before_the_target_and_holds(bench: Bench) -> None:
    bench.bring_to(State.STOPPING)
    bench.until(State.HOLDING)
    bench.run(0.1)
    assert bench.codes[-1] is Code.STOPPED
    assert bench.arm.drives[0].position < 0.3
    assert bench.arm.first_moving() == -1


def test_a_lease_that_is_given_up_ends_the_move_in_a_controlled_stop(bench: Bench) -> None:
    bench.set_in_motion()
    bench.observer.release(bench.lease)
    bench.cycle()
    assert (bench.state, bench.codes[-1]) == (State.STOPPING, Code.LEASE_ENDED)
    bench.until(State.HOLDING)
    assert bench.longest_step(0) <= LONGEST_STEP


def test_a_lease_of_another_commander_ends_the_move_too(bench: Bench) -> None:
    bench.set_in_motion()
    bench.observer.release(bench.lease)
    bench.lease = bench.observer.acquire("another", 3600.0)
    bench.cycle()
    assert (bench.state, bench.codes[-1]) == (State.STOPPING, Code.LEASE_ENDED)


def test_disabling_in_motion_takes_the_torque_only_at_standstill(bench: Bench) -> None:
    bench.bring_to(State.DISABLING)
    bench.until(State.READY)
    assert bench.codes[-1] is Code.DISABLED
    told = [said for cycle in bench.log for said in cycle.drives if said.has_torque and said.controlword == SWITCH_ON]
    assert told
    assert max(abs(said.velocity) for said in told) <= 0.02 * COUNTS


def test_disabling_while_enabling_is_told_as_done_only_when_no_drive_has_torque(bench: Bench) -> None:
    bench.bring_to(State.ENABLING)
    # The moment at which the drives have been told to enable, and do not show it yet.
    bench.wait(lambda: bench.log[-1].drives[0].controlword == ENABLE_OPERATION)
    bench.do(Command.DISABLE)
    bench.until(State.READY)
    assert [model.powered for model in bench.models] == [False, False]


# -- the end --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "state",
    [
        State.STARTING, State.READY, State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING,
        State.FAULT, State.RESETTING,
    ],
    ids=lambda state: state.name.lower(),
)  # fmt: skip
def test_the_loop_may_end_only_when_no_drive_has_torque(bench: Bench, state: State) -> None:
    bench.bring_to(state)
    if state is State.ENABLING:
        # The moment at which the drives have been told to enable, and do not show it yet.
        bench.wait(lambda: bench.log[-1].drives[0].controlword == ENABLE_OPERATION)
    bench.do(Command.SHUTDOWN)
    bench.finish()
    assert [model.powered for model in bench.models] == [False, False]


def test_a_drive_that_falls_into_a_fault_while_enabling_ends_it_at_once(bench: Bench) -> None:
    bench.bring_to(State.ENABLING).models[1].inject_fault(UNDER_VOLTAGE)
    bench.until(State.FAULT, 0.1)
    assert bench.codes[-1] is Code.DRIVE_FAULT


def test_a_drive_that_does_not_take_the_mode_while_enabling_is_told_with_its_mode(bench: Bench) -> None:
    bench.data.deaf[1, MODES_OF_OPERATION] = {8: 3}
    bench.start()
    bench.do(Command.ENABLE)
    bench.until(State.FAULT)
    assert bench.codes[-1] is Code.MODE_STUCK
    assert "shows mode 3, 8 was asked for" in bench.said[-1]


def test_closing_in_motion_stops_before_it_disables(bench: Bench) -> None:
    bench.bring_to(State.CLOSING)
    bench.finish()
    told = [said for cycle in bench.log for said in cycle.drives if said.has_torque and said.controlword == SWITCH_ON]
    assert told
    assert max(abs(said.velocity) for said in told) <= 0.02 * COUNTS


def test_closing_in_a_fault_lets_come_to_rest_what_ramps_down_before_it_takes_the_torque(bench: Bench) -> None:
    slow_quick_stop(bench)
    bench.set_in_motion()
    bench.service.lost_slave = 3
    bench.run(0.01)
    bench.do(Command.SHUTDOWN)
    bench.finish()
    moving = [said for cycle in bench.log for said in cycle.drives if said.has_torque and abs(said.velocity) > 100]
    assert {said.controlword for said in moving} == {ENABLE_OPERATION, QUICK_STOP}


@pytest.mark.parametrize("period_us", [1000.0, 200.0])
def test_closing_without_frames_tells_all_drives_to_stop_for_as_long_as_a_quick_stop_takes(
    bench_board: tuple[Blackboard, Observer], period_us: float
) -> None:
    config = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=period_us))
    bench = Bench(*bench_board, config=config)
    try:
        bench.start().run(0.1)
        bench.enable()
        bench.data.carries = False
        bench.do(Command.SHUTDOWN)
        bench.finish()
    finally:
        bench_board[1].release(bench.lease)
    longest_s = max(bound.time_s for bound in bounds(config, Rung.QUICK_STOP))
    told = list(takewhile(lambda cycle: {said.controlword for said in cycle.drives} == {QUICK_STOP}, bench.log[::-1]))
    assert longest_s <= len(told) * period_us * 1e-6 <= longest_s + 0.02


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_closing_without_one_of_the_slaves_ends_when_the_joints_of_the_others_stand(bench: Bench, mode: int) -> None:
    for model in bench.models:
        model.objects[0x6085, 0].value = 100_000  # as the start-up SDOs of the drive's description set it
    bench.set_in_motion(mode)
    receive = bench.data.receive
    bench.data.receive = lambda: receive() - 3  # type: ignore[method-assign]
    bench.do(Command.SHUTDOWN)
    bench.finish()
    # Whoever ends the loop takes the slaves out of OP then.
    assert [model.powered for model in bench.models] == [True, True]
    assert all(abs(model.mechanics.velocity) < 0.01 for model in bench.models)


def test_closing_ends_after_2_s_where_a_drive_does_not_disable(bench: Bench) -> None:
    bench.data.deaf[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    bench.hold()
    bench.do(Command.SHUTDOWN)
    assert bench.finish() == pytest.approx(2.0, abs=3 * PERIOD_S)


# -- whatever is asked and whatever happens -------------------------------------------------------------------------

COMMANDS = ["enable", "disable", "reset", "stop"]
MISHAPS = ["drive fault", "slave lost", "clock lost"]
DEEDS = st.one_of(
    st.tuples(st.just("run"), st.integers(1, 300)),
    st.tuples(st.just("lose"), st.integers(1, 60)),
    st.tuples(st.just("move"), st.tuples(st.floats(-2.2, 2.2), st.floats(-2.2, 2.2), st.floats(0.05, 0.55))),
    st.tuples(st.just("mode"), st.sampled_from([CSP, CSV, CST])),
    st.tuples(st.sampled_from(COMMANDS), st.none()),
    st.tuples(st.sampled_from(MISHAPS), st.none()),
    st.tuples(st.just("recover"), st.none()),
)


def happen(bench: Bench, deed: str, how: object) -> None:
    if deed == "run":
        bench.run(how * PERIOD_S)
    elif deed == "lose":
        lose(bench, how)
    elif deed == "move":
        bench.order(Command.MOVE, move_numbers(*how[:2], speed=how[2]))
    elif deed == "mode":
        bench.order(Command.MODE, [how])
    elif deed == "drive fault":
        bench.models[1].inject_fault(UNDER_VOLTAGE)
    elif deed == "slave lost":
        bench.service.lost_slave = 3
    elif deed == "clock lost":
        bench.discipline.locked = False
    elif deed == "recover":
        bench.discipline.locked = True
        bench.order(Command.RESET)
        bench.run(0.2)
        bench.order(Command.ENABLE)
        bench.run(0.05)
    else:
        bench.order(Command[deed.upper()])
    bench.cycle()


# A failing example is not shortened: that would take minutes.
@settings(max_examples=15, deadline=None, derandomize=True, phases=[Phase.generate])
@given(deeds=st.lists(DEEDS, min_size=20, max_size=40))
def test_whatever_happens_targets_stay_in_steps_and_only_enable_enables(
    bench_board: tuple[Blackboard, Observer], deeds: list[tuple[str, object]]
) -> None:
    bench = Bench(*bench_board)
    try:
        bench.set_in_motion()
        for deed, how in deeds:
            happen(bench, deed, how)
    finally:
        bench_board[1].release(bench.lease)
    for axis, joint in enumerate(CONFIG.joints):
        assert bench.longest_step(axis) <= LONGEST_STEP
        obeyed = [said.target for cycle in bench.log if (said := cycle.drives[axis]).obeys_target]
        assert all(joint.position.min * COUNTS <= target <= joint.position.max * COUNTS for target in obeyed)
    quiet = (State.READY, State.FAULT, State.RESETTING)
    assert all(
        said.controlword != ENABLE_OPERATION for cycle in bench.log if cycle.state in quiet for said in cycle.drives
    )
    before = {after.state: set() for after in bench.log}
    for earlier, after in pairwise(bench.log):
        before[after.state].add(earlier.state)
    assert before.get(State.ENABLING, set()) <= {State.READY, State.ENABLING}
    assert before.get(State.MOVING, set()) <= {State.HOLDING, State.MOVING}
