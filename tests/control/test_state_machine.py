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
from rtcp.ipc.commands import Disable, Enable, Halt, MoveJoints, Reset, SetDriveMode, Shutdown
from rtcp.ipc.events import (
    Arrived,
    ClockLocked,
    ClockLost,
    ControllerFailed,
    Disabled,
    DisableTimeout,
    DriveFault,
    DriveLeftEnabled,
    DriveModeTimeout,
    EnableTimeout,
    Event,
    GeneratorFailed,
    HomingStillMoving,
    LeaseExpired,
    LeftRange,
    PositionJumped,
    ProcessDataLost,
    Ready,
    ResetDone,
    ResetTimeout,
    ResetWhileMoving,
    ResetWithoutFrames,
    ResetWithoutSlaves,
    SlaveLost,
    Stopped,
    TorqueRemoved,
)
from rtcp.ipc.observer import Observer
from rtcp.ipc.states import DriveMode, State
from rtcp.ipc.stop_reactions import StopReaction, bounds
from rtcp.motion.guards.output_limiter import BACK_RAD_S
from rtcp.motion.state import ArmState, Setpoint

from .rig import (
    _WIRE,
    CONFIG,
    CONTROLWORD,
    COUNTS,
    CSP,
    CST,
    CSV,
    DEBOUNCE_S,
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
    LoopRig,
    move_to,
)

# -- every fault: what it is, what is said, what the drives are told, and the way back ------------------------------


@dataclass(frozen=True)
class Fault:
    """A fault from its cause to its end."""

    name: str
    kind: type[Event]
    axis: int
    says: tuple[str, ...]
    """What its sentence has to name; {word} is the statusword of the joint when it happened."""
    breaks: Callable[[LoopRig], object]
    """From the start of the platform to the cause; the fault follows within 4 s."""
    mend: Callable[[LoopRig], object]


def nothing(rig: LoopRig) -> None:
    """The cause does not last."""


def hears_all(rig: LoopRig) -> None:
    rig.data.deaf.clear()


def drive_fault_while_ready(rig: LoopRig) -> None:
    rig.start().models[1].inject_fault(UNDER_VOLTAGE)


def drive_fault_in_motion(rig: LoopRig) -> None:
    rig.set_in_motion().models[1].inject_fault(UNDER_VOLTAGE)


def drive_that_leaves_by_itself(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: 0}


def drive_that_does_not_enable(rig: LoopRig) -> None:
    rig.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    rig.start().do(Enable())


def drive_that_does_not_disable(rig: LoopRig) -> None:
    rig.data.deaf[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    rig.set_in_motion().do(Disable())


def drive_that_keeps_its_mode(rig: LoopRig) -> None:
    rig.hold().data.deaf[1, MODES_OF_OPERATION] = {CSV: CSP}
    rig.do(SetDriveMode(DriveMode(CSV)))


def drive_whose_fault_lasts(rig: LoopRig) -> None:
    rig.start().models[1].condition.bus_voltage = 10.0
    rig.until(State.FAULT)
    rig.do(Reset())


def voltage_returns(rig: LoopRig) -> None:
    rig.models[1].condition.bus_voltage = 48.0


def joint_that_does_not_come_to_rest(rig: LoopRig) -> None:
    rig.bring_to(State.FAULT)
    # More than its drive can hold, and too heavy to become fast soon.
    turned = rig.models[1].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 2000.0, 0.05, 117.0
    rig.do(Reset())


def joint_that_turns_on_after_its_homing(rig: LoopRig) -> None:
    rig.bring_to(State.HOMING)
    rig.run(0.1)
    turned = rig.models[0].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 1e5, 0.015, 117.0
    rig.do(Halt())


def joint_is_let_go(rig: LoopRig) -> None:
    for model in rig.models:
        turned = model.mechanics
        turned.inertia, turned.velocity, turned.external_torque = 1.0, 0.0, 0.0


def slave_that_leaves_op(rig: LoopRig) -> None:
    rig.set_in_motion().service.lost_slave = 3


def slave_that_does_not_come_back(rig: LoopRig) -> None:
    rig.bring_to(State.RESETTING)


def slaves_come_back(rig: LoopRig) -> None:
    rig.slaves_come_back = True


def frames_stay_away(rig: LoopRig) -> None:
    rig.set_in_motion().data.carries = False


def frames_come_back(rig: LoopRig) -> None:
    rig.data.carries = True


def clock_runs_away(rig: LoopRig) -> None:
    rig.set_in_motion().discipline.locked = False


def clock_is_followed(rig: LoopRig) -> None:
    rig.discipline.locked = True


def joint_is_turned_out_of_its_range(rig: LoopRig) -> None:
    rig.start().do(Enable())
    rig.models[1].mechanics.position = 2.1


def joint_is_turned_back(rig: LoopRig) -> None:
    rig.models[1].mechanics.position = 1.9


def joint_says_it_is_elsewhere(rig: LoopRig) -> None:
    rig.start().do(Enable())
    said = rig.data.input

    def elsewhere(slot: int) -> bytes:
        values = _WIRE.unpack(said(slot))
        return _WIRE.pack(values[0], 1000, *values[2:]) if slot == 2 else said(slot)

    rig.data.input = lambda slot: elsewhere(slot) if slot else said(slot)


def joint_says_where_it_is(rig: LoopRig) -> None:
    del rig.data.input


def generator_refuses(rig: LoopRig) -> None:
    generator = rig.set_in_motion().arm.controllers[MoveJoints]

    def refuse(state: ArmState) -> Setpoint:
        generator.ended = ControllerFailed()
        target = Setpoint(2)
        target.position = list(state.commanded)
        return target

    generator.update = refuse


def generator_works(rig: LoopRig) -> None:
    del rig.arm.controllers[MoveJoints].update


FAULT_STORIES = (
    Fault(
        "a drive fault while ready", DriveFault, 1,
        ("joint2", "in fault", "statusword {word}", "`rtcp reset`"),
        drive_fault_while_ready, nothing,
    ),
    Fault(
        "a drive fault in motion", DriveFault, 1,
        ("joint2", "in fault", "statusword {word}", "`rtcp reset`"),
        drive_fault_in_motion, nothing,
    ),
    Fault(
        "a drive that leaves by itself", DriveLeftEnabled, 1,
        ("joint2", "left Operation Enabled", "statusword {word}", "`rtcp reset`"),
        drive_that_leaves_by_itself, hears_all,
    ),
    Fault(
        "a drive that does not enable", EnableTimeout, 1,
        ("joint2", "did not reach Operation Enabled", "0.2 s", "{word}", "enable_timeout_s in assistive_arm.yaml"),
        drive_that_does_not_enable, hears_all,
    ),
    Fault(
        "a drive that does not disable", DisableTimeout, 1,
        ("joint2", "kept its torque", "statusword {word}", "enable_timeout_s"),
        drive_that_does_not_disable, hears_all,
    ),
    Fault(
        "a drive that keeps its mode", DriveModeTimeout, 1,
        ("joint2", "mode 8", "instead of csv"),
        drive_that_keeps_its_mode, hears_all,
    ),
    Fault(
        "a drive whose fault lasts", ResetTimeout, 1,
        ("joint2", "in fault after the reset", "statusword {word}"),
        drive_whose_fault_lasts, voltage_returns,
    ),
    Fault(
        "a joint that does not come to rest", ResetWhileMoving, 1,
        ("joint2", "still turns", "rad/s", "3 s", "`rtcp disable`"),
        joint_that_does_not_come_to_rest, joint_is_let_go,
    ),
    Fault(
        "a joint that turns on after its homing", HomingStillMoving, 0,
        ("joint1", "still turns", "rad/s", "3 s", "homing", "`rtcp reset`"),
        joint_that_turns_on_after_its_homing, joint_is_let_go,
    ),
    Fault(
        "a slave that does not come back", ResetWithoutSlaves, -1,
        ("reset", "3 s", "not all slaves are back in OP"),
        slave_that_does_not_come_back, slaves_come_back,
    ),
    Fault(
        "a slave that leaves OP", SlaveLost, 3,
        ("slave 3 (drive2)", "left OP", "`rtcp reset`"),
        slave_that_leaves_op, nothing,
    ),
    Fault(
        "frames that stay away", ProcessDataLost, -1,
        ("process data lost", "40 cycles", "bus.lost_cycles in assistive_arm.yaml", "`rtcp reset`"),
        frames_stay_away, frames_come_back,
    ),
    Fault(
        "a clock that runs away", ClockLost, -1,
        ("reference clock", "1 s", "`rtcp reset`"),
        clock_runs_away, clock_is_followed,
    ),
    Fault(
        "a joint that is turned out of its range", LeftRange, 1,
        ("joint2", "left its range", "2.1 rad", "joints[1].position in assistive_arm.yaml"),
        joint_is_turned_out_of_its_range, joint_is_turned_back,
    ),
    Fault(
        "a joint that says it is elsewhere while it is enabled", PositionJumped, 1,
        ("joint2", "jumped from 0 to 0.1 rad", "5 cycles (supervision in assistive_arm.yaml)", "`rtcp reset`"),
        joint_says_it_is_elsewhere, joint_says_where_it_is,
    ),
    Fault(
        "a generator that refuses", GeneratorFailed, -1,
        ("trajectory generator", "`rtcp reset`"),
        generator_refuses, generator_works,
    ),
)  # fmt: skip


class Story:
    """One fault, lived through once: what every test of it looks at."""

    def __init__(self, fault: Fault, rig: LoopRig) -> None:
        self.fault, self.rig = fault, rig
        fault.breaks(rig)
        if rig.state is State.FAULT:
            rig.cycle()
        rig.until(State.FAULT, 4.0)
        self.event, self.said = rig.last, rig.messages[-1]
        self.kept = rig.machine.fault
        self.at = len(rig.log) - 1
        rig.run(0.3)
        fault.mend(rig)
        rig.run(1.0)
        self.mended = len(rig.log)
        rig.do(Reset())
        self.after_reset = self._reach(State.READY)
        rig.run(0.3)
        self.before_enable = len(rig.log)
        self.enable_refusal = rig.send(Enable()).refusal
        self.after_enable = self._reach(State.HOLDING)
        rig.run(0.1)

    def _reach(self, state: State) -> State:
        try:
            self.rig.until(state, 4.0)
        except AssertionError:
            pass
        return self.rig.state


@pytest.fixture(scope="module", params=FAULT_STORIES, ids=lambda fault: fault.name)
def story(request: pytest.FixtureRequest, rig_board: tuple[Blackboard, Observer]) -> Story:
    rig = LoopRig(*rig_board)
    try:
        return Story(request.param, rig)
    finally:
        rig_board[1].release(rig.lease)


def test_every_code_of_a_fault_has_its_story() -> None:
    own = {kind for kind in Event.kinds if kind.__module__ == "rtcp.ipc.events"}
    # No frames return for 3 s is `ProcessDataLost` first.
    assert {fault.kind for fault in FAULT_STORIES} | {ResetWithoutFrames} == {
        kind for kind in own if kind.is_fault and not kind.is_emergency
    }


def test_a_fault_has_its_code_and_its_joint_or_slave(story: Story) -> None:
    assert isinstance(story.event, story.fault.kind)
    place = getattr(story.event, "axis", getattr(story.event, "slave", -1))
    assert (place, story.kept) == (story.fault.axis, story.fault.kind.number)


def test_a_fault_is_one_line_that_names_what_is_wrong_where_and_the_key(story: Story) -> None:
    words = [f"0x{said.statusword:04X}" for said in story.rig.log[story.at].drives]
    named = [part.format(word=words[story.fault.axis] if "{" in part else "") for part in story.fault.says]
    assert [part for part in named if part not in story.said] == []
    assert "\n" not in story.said


def test_no_target_jumps_from_the_first_enabling_over_the_fault_to_the_next(story: Story) -> None:
    assert [story.rig.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


def test_every_drive_with_torque_is_told_to_quick_stop_in_the_cycle_of_the_fault(story: Story) -> None:
    told = [said.controlword for said in story.rig.log[story.at].drives if said.has_torque]
    assert set(told) <= {QUICK_STOP}


def test_in_a_fault_no_speed_and_no_torque_is_sent(story: Story) -> None:
    sent = {(said.speed, said.effort) for cycle in story.rig.log[story.at : story.mended] for said in cycle.drives}
    assert sent == {(0, 0)}


def test_a_fault_stays_when_its_cause_is_gone(story: Story) -> None:
    assert {cycle.state for cycle in story.rig.log[story.at : story.mended]} == {State.FAULT}


def test_nothing_is_enabled_between_a_fault_and_the_next_enable(story: Story) -> None:
    told = {said.controlword for cycle in story.rig.log[story.at : story.before_enable] for said in cycle.drives}
    assert ENABLE_OPERATION not in told


def test_a_reset_after_the_cause_leads_to_ready(story: Story) -> None:
    assert story.after_reset is State.READY


def test_an_enable_after_the_reset_leads_to_holding(story: Story) -> None:
    assert (story.enable_refusal, story.after_enable) == (None, State.HOLDING)


# -- starting -------------------------------------------------------------------------------------------------------


def test_the_slaves_are_asked_for_op_only_when_the_clock_is_followed(rig: LoopRig) -> None:
    asked: list[int] = []
    rig.service.want_op = lambda: asked.append(len(rig.log))
    rig.discipline.locked = False
    rig.run(0.1)
    assert asked == []
    rig.discipline.locked = True
    rig.cycle()
    assert asked == [100]


def test_ready_is_told_when_all_slaves_are_in_op_and_not_before(rig: LoopRig) -> None:
    rig.run(0.1)
    assert (rig.state, rig.kinds) == (State.STARTING, [ClockLocked])
    rig.service.all_op = True
    rig.cycle()
    assert (rig.state, rig.kinds) == (State.READY, [ClockLocked, Ready])


def test_a_slave_that_leaves_op_before_the_machine_is_ready_is_brought_back_without_a_reset(rig: LoopRig) -> None:
    asked: list[int] = []
    rig.service.recover = lambda: asked.append(len(rig.log))
    rig.run(0.01)
    assert asked == []
    rig.service.lost_slave = 2
    rig.cycle()
    assert asked == [10]
    rig.service.lost_slave, rig.service.all_op = 0, True
    rig.cycle()
    assert (asked, rig.state) == ([10], State.READY)


def test_what_is_lost_from_when_all_slaves_are_in_op_is_a_fault_also_before_the_machine_was_ready(rig: LoopRig) -> None:
    rig.models[0].mechanics.position = 0.7
    rig.data.away.add(2)
    rig.run(2 * LOST_CYCLES * PERIOD_S)
    assert rig.state is State.STARTING
    rig.service.all_op = True
    took_s = rig.until(State.FAULT)
    # Cycles before count for nothing. The box was not yet heard: nobody has pressed the emergency stop.
    assert took_s == pytest.approx(LOST_CYCLES * PERIOD_S, abs=1.5 * PERIOD_S)
    rig.run(0.1)
    assert (rig.state, rig.kinds) == (State.FAULT, [ClockLocked, ProcessDataLost])
    rig.data.away.clear()
    rig.do(Reset())
    rig.until(State.READY)
    # Nor were the joints: none of them stands elsewhere than before.
    assert rig.kinds[2:] == [ResetDone]


def test_an_emergency_stop_that_is_pressed_when_the_start_fails_is_heard(rig: LoopRig) -> None:
    rig.data.devices[0].set_input(EMERGENCY_STOP_INPUT, False)
    rig.data.away.add(2)
    rig.service.all_op = True
    rig.until(State.FAULT)
    rig.until(State.EMERGENCY_STOP, 0.1)


# -- enabling -------------------------------------------------------------------------------------------------------


def test_enabling_starts_with_the_target_where_each_joint_stands(rig: LoopRig) -> None:
    for model, position in zip(rig.models, (0.7, -0.4), strict=True):
        model.mechanics.position = position
    rig.hold()
    for axis, position in enumerate((7000, -4000)):
        told = [cycle.drives[axis] for cycle in rig.log if cycle.drives[axis].controlword == ENABLE_OPERATION]
        assert {said.target for said in told} == {position}


def test_a_joint_that_was_turned_by_hand_is_enabled_where_it_stands_then(rig: LoopRig) -> None:
    rig.hold()
    rig.do(Disable())
    rig.until(State.READY)
    rig.run(0.1)
    rig.models[0].mechanics.position = 0.5
    rig.run(0.01)
    before = len(rig.log)
    rig.enable()
    told = [said for cycle in rig.log[before:] if (said := cycle.drives[0]).controlword == ENABLE_OPERATION]
    assert {said.target for said in told} == {5000}


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_just_beyond_its_range_is_enabled_where_it_stands_and_brought_back_gently(
    rig: LoopRig, side: int, mode: int
) -> None:
    rig.models[1].mechanics.position = 2.018 * side
    rig.hold(mode)
    rig.run(1.0)
    said = [cycle.drives[1] for cycle in rig.log if cycle.drives[1].controlword == ENABLE_OPERATION]
    assert abs(said[0].target - said[0].position) <= 1
    assert abs(said[0].position) == 20180
    targets = [drive.target for drive in said]
    for cycles in (1, 4, 16, 64):
        # Both ends are rounded to counts.
        allowed = BACK_RAD_S * cycles * PERIOD_S * COUNTS + 1
        assert max(abs(after - before) for before, after in zip(targets, targets[cycles:], strict=False)) <= allowed
    assert targets[-1] == 20000 * side
    assert max(abs(drive.velocity) for drive in said) < 0.1 * COUNTS
    assert rig.arm.drives[1].position == pytest.approx(2.0 * side, abs=2e-3)


@pytest.mark.parametrize("mode", [CSV, CST])
def test_drives_are_enabled_in_csp_and_take_the_wanted_mode_only_then(rig: LoopRig, mode: int) -> None:
    rig.hold(mode)
    enabling = [cycle.drives[1].mode for cycle in rig.log if cycle.state is State.ENABLING]
    assert set(enabling) == {CSP}
    assert [said.mode_display for said in rig.log[-1].drives] == [mode, mode]


@pytest.mark.parametrize("position", [0.0, 1.2])
def test_the_arm_holds_its_place_through_every_change_of_mode(rig: LoopRig, position: float) -> None:
    # A load that pulls: a mode that began without torque would sag.
    rig.models[0].mechanics.gravity_torque = 15.0
    rig.models[0].mechanics.position = position
    rig.hold()
    rig.run(0.3)
    before = len(rig.log)
    for mode in (CSV, CST, CSP, CST, CSV, CSP):
        rig.do(SetDriveMode(DriveMode(mode)))
        rig.run(0.3)
        assert rig.arm.first_in_another_mode() == -1
    seen = [cycle.drives[0] for cycle in rig.log[before:]]
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
    rig: LoopRig, breaks: Callable[[LoopRig], object], seconds: float
) -> None:
    breaks(rig)
    assert rig.until(State.FAULT) == pytest.approx(seconds, abs=3 * PERIOD_S)


def test_the_time_for_disabling_begins_when_the_arm_stands(rig: LoopRig) -> None:
    drive_that_does_not_disable(rig)
    rig.until(State.FAULT)
    told = [said for cycle in rig.log if (said := cycle.drives[1]).controlword == SWITCH_ON and said.has_torque]
    assert len(told) * PERIOD_S == pytest.approx(ENABLE_TIMEOUT_S, abs=3 * PERIOD_S)


# -- lost frames ----------------------------------------------------------------------------------------------------


def lose(rig: LoopRig, cycles: int) -> None:
    rig.data.carries = False
    rig.run(cycles * PERIOD_S)
    rig.data.carries = True


def test_as_many_lost_cycles_as_are_allowed_do_not_end_a_move(rig: LoopRig) -> None:
    rig.hold()
    rig.move(0.1, 0.1)
    rig.run(0.2)
    lose(rig, LOST_CYCLES - 1)
    rig.until(State.HOLDING)
    assert rig.kinds[-1] is Arrived


def test_lost_cycles_are_made_up_for_by_as_many_good_ones(rig: LoopRig) -> None:
    rig.set_in_motion()
    for _ in range(5):
        lose(rig, LOST_CYCLES - 1)
        rig.run((LOST_CYCLES - 1) * PERIOD_S)
    assert rig.state is State.MOVING


def test_set_points_stand_while_no_frame_comes_back_and_go_on_from_there(rig: LoopRig) -> None:
    rig.set_in_motion()
    before = rig.log[-1].drives[0].target
    lose(rig, LOST_CYCLES - 1)
    assert {cycle.drives[0].target for cycle in rig.log[-LOST_CYCLES + 1 :]} == {before}
    rig.cycle()
    assert 0 < rig.log[-1].drives[0].target - before <= LONGEST_STEP


def test_drives_that_still_hear_are_told_to_stop_for_as_long_as_no_frame_comes_back(rig: LoopRig) -> None:
    frames_stay_away(rig)
    rig.until(State.FAULT)
    at = len(rig.log)
    rig.run(0.5)
    assert {said.controlword for cycle in rig.log[at:] for said in cycle.drives} == {QUICK_STOP}


# -- whatever is lost, in whatever state ----------------------------------------------------------------------------

CAUSES: dict[type[Event], Callable[[LoopRig], object]] = {
    ProcessDataLost: lambda rig: setattr(rig.data, "carries", False),
    SlaveLost: lambda rig: setattr(rig.service, "lost_slave", 2),
    ClockLost: lambda rig: setattr(rig.discipline, "locked", False),
    DriveFault: lambda rig: rig.models[1].inject_fault(UNDER_VOLTAGE),
}
LOST = [
    *((code, state) for code in (ProcessDataLost, SlaveLost)
      for state in (State.READY, State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING)),
    *((ClockLost, state) for state in (State.READY, State.HOLDING, State.MOVING)),
    *((DriveFault, state) for state in (State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING)),
]  # fmt: skip


@pytest.mark.parametrize(("code", "state"), LOST, ids=lambda value: value.name.lower())
def test_what_is_lost_is_that_fault_in_every_state(rig: LoopRig, code: type[Event], state: State) -> None:
    # A drive that is kept from enabling keeps the machine in that state.
    rig.data.deaf[0, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON} if state is State.ENABLING else {}
    rig.bring_to(state)
    CAUSES[code](rig)
    rig.until(State.FAULT, 1.1)
    assert (rig.kinds[-1], rig.machine.fault) == (code, code.number)


def test_a_drive_fault_while_enabling_ends_in_a_fault_that_names_the_joint(rig: LoopRig) -> None:
    rig.bring_to(State.ENABLING).models[1].inject_fault(UNDER_VOLTAGE)
    rig.until(State.FAULT, ENABLE_TIMEOUT_S + 0.01)
    assert rig.messages[-1].startswith("joint2: ")


@pytest.mark.parametrize("code", [DriveFault, SlaveLost])
def test_a_fault_makes_no_target_jump_where_a_joint_was_held_back(rig: LoopRig, code: type[Event]) -> None:
    rig.set_in_motion()
    rig.models[0].mechanics.external_torque = -100.0
    rig.run(0.04)
    lag = rig.log[-1].drives[0].target - rig.log[-1].drives[0].position
    assert lag > 20 * LONGEST_STEP
    CAUSES[code](rig)
    rig.until(State.FAULT)
    rig.models[0].mechanics.external_torque = 0.0
    rig.run(0.5)
    rig.do(Reset())
    rig.until(State.READY)
    rig.enable()
    rig.run(0.2)
    assert rig.longest_step(0) <= LONGEST_STEP


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_a_fault_of_one_drive_brings_the_others_to_rest_under_torque_in_every_mode(rig: LoopRig, mode: int) -> None:
    rig.set_in_motion(mode)
    rig.models[1].inject_fault(UNDER_VOLTAGE)
    rig.until(State.FAULT)
    rig.run(0.5)
    assert rig.models[0].powered
    assert abs(rig.models[0].mechanics.velocity) < 0.001


# -- reset and torque off -------------------------------------------------------------------------------------------


def test_disable_in_a_fault_takes_the_torque_off_and_leaves_the_fault(rig: LoopRig) -> None:
    rig.bring_to(State.FAULT)
    assert [model.powered for model in rig.models] == [True, True]
    rig.do(Disable())
    rig.run(0.05)
    assert [model.powered for model in rig.models] == [False, False]
    assert (rig.state, rig.machine.fault) == (State.FAULT, SlaveLost.number)
    assert rig.kinds[-1] is TorqueRemoved


def test_disable_during_a_reset_ends_it_in_the_fault_that_was(rig: LoopRig) -> None:
    rig.bring_to(State.RESETTING)
    rig.do(Disable())
    rig.slaves_come_back = True
    rig.run(0.5)
    assert (rig.state, rig.machine.fault) == (State.FAULT, SlaveLost.number)
    assert [model.powered for model in rig.models] == [False, False]


def test_the_fault_after_one_whose_torque_was_taken_off_is_a_quick_stop_again(rig: LoopRig) -> None:
    rig.bring_to(State.FAULT)
    rig.do(Disable())
    rig.run(0.05)
    rig.do(Reset())
    rig.until(State.READY)
    rig.enable()
    rig.service.lost_slave = 3
    rig.run(0.1)
    assert rig.state is State.FAULT
    assert [model.powered for model in rig.models] == [True, True]


def slow_quick_stop(rig: LoopRig) -> None:
    """From full speed it takes 1.5 s, at 0.2 rad/s2."""
    for model in rig.models:
        model.objects[0x6085, 0].value = 2000


def test_a_reset_lets_come_to_rest_what_still_moves_before_it_takes_its_torque(rig: LoopRig) -> None:
    slow_quick_stop(rig)
    rig.set_in_motion()
    rig.service.lost_slave = 3
    rig.cycle()
    rig.do(Reset())
    rig.until(State.READY)
    moving = [said for cycle in rig.log for said in cycle.drives if said.has_torque and abs(said.velocity) > 100]
    assert {said.controlword for said in moving} == {ENABLE_OPERATION, QUICK_STOP}


def test_a_reset_is_tried_again_until_the_cause_of_a_drive_fault_is_gone(rig: LoopRig) -> None:
    rig.start().models[1].condition.bus_voltage = 10.0
    rig.until(State.FAULT)
    rig.do(Reset())
    rig.run(0.5)
    assert rig.state is State.RESETTING
    voltage_returns(rig)
    rig.until(State.READY, 0.1)


def test_a_reset_waits_for_the_clock_to_be_followed(rig: LoopRig) -> None:
    clock_runs_away(rig)
    rig.until(State.FAULT)
    rig.do(Reset())
    rig.run(1.0)
    assert rig.state is State.RESETTING
    rig.discipline.locked = True
    rig.until(State.READY, 0.1)


# -- moving, stopping, disabling ------------------------------------------------------------------------------------


def test_a_move_arrives_where_it_was_told_to(rig: LoopRig) -> None:
    rig.hold()
    rig.move(0.05, -0.05)
    rig.until(State.HOLDING)
    rig.run(0.1)
    assert rig.kinds[-1] is Arrived
    assert [drive.position for drive in rig.arm.drives] == pytest.approx([0.05, -0.05], abs=1e-3)


def test_set_points_that_jump_reach_the_drives_in_steps_inside_the_speed_limit(rig: LoopRig) -> None:
    rig.hold()

    def jump(state: ArmState) -> Setpoint:
        target = Setpoint(2)
        target.position = [1.0, -2.5]
        return target

    generator = rig.arm.controllers[MoveJoints]
    generator.update = jump
    rig.run(0.3)
    rig.run(4.0)
    assert all(rig.longest_step(axis) <= LONGEST_STEP for axis in range(2))
    assert min(cycle.drives[1].target for cycle in rig.log) >= -2.0 * COUNTS


def test_a_stop_comes_to_rest_far_before_the_target_and_holds(rig: LoopRig) -> None:
    rig.bring_to(State.STOPPING)
    rig.until(State.HOLDING)
    rig.run(0.1)
    assert rig.kinds[-1] is Stopped
    assert rig.arm.drives[0].position < 0.3
    assert rig.arm.first_moving() == -1


def test_a_lease_that_is_given_up_ends_the_move_in_a_controlled_stop(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.observer.release(rig.lease)
    rig.cycle()
    assert (rig.state, rig.kinds[-1]) == (State.STOPPING, LeaseExpired)
    rig.until(State.HOLDING)
    assert rig.longest_step(0) <= LONGEST_STEP


def test_a_lease_of_another_commander_ends_the_move_too(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.observer.release(rig.lease)
    rig.lease = rig.observer.acquire("another", 3600.0)
    rig.cycle()
    assert (rig.state, rig.kinds[-1]) == (State.STOPPING, LeaseExpired)


def test_disabling_in_motion_takes_the_torque_only_at_standstill(rig: LoopRig) -> None:
    rig.bring_to(State.DISABLING)
    rig.until(State.READY)
    assert rig.kinds[-1] is Disabled
    told = [said for cycle in rig.log for said in cycle.drives if said.has_torque and said.controlword == SWITCH_ON]
    assert told
    assert max(abs(said.velocity) for said in told) <= 0.02 * COUNTS


def test_disabling_while_enabling_is_told_as_done_only_when_no_drive_has_torque(rig: LoopRig) -> None:
    rig.bring_to(State.ENABLING)
    # The moment at which the drives have been told to enable, and do not show it yet.
    rig.wait(lambda: rig.log[-1].drives[0].controlword == ENABLE_OPERATION)
    rig.do(Disable())
    rig.until(State.READY)
    assert [model.powered for model in rig.models] == [False, False]


# -- the end --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "state",
    [
        State.STARTING, State.READY, State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING,
        State.FAULT, State.RESETTING,
    ],
    ids=lambda state: state.name.lower(),
)  # fmt: skip
def test_the_loop_may_end_only_when_no_drive_has_torque(rig: LoopRig, state: State) -> None:
    rig.bring_to(state)
    if state is State.ENABLING:
        # The moment at which the drives have been told to enable, and do not show it yet.
        rig.wait(lambda: rig.log[-1].drives[0].controlword == ENABLE_OPERATION)
    rig.do(Shutdown())
    rig.finish()
    assert [model.powered for model in rig.models] == [False, False]


def test_a_drive_that_falls_into_a_fault_while_enabling_ends_it_at_once(rig: LoopRig) -> None:
    rig.bring_to(State.ENABLING).models[1].inject_fault(UNDER_VOLTAGE)
    rig.until(State.FAULT, 0.1)
    assert rig.kinds[-1] is DriveFault


def test_a_drive_that_does_not_take_the_mode_while_enabling_is_told_with_its_mode(rig: LoopRig) -> None:
    rig.data.deaf[1, MODES_OF_OPERATION] = {8: 3}
    rig.start()
    rig.do(Enable())
    rig.until(State.FAULT)
    assert rig.last == DriveModeTimeout(1, 3, DriveMode.CSP)


def test_closing_in_motion_stops_before_it_disables(rig: LoopRig) -> None:
    rig.bring_to(State.CLOSING)
    rig.finish()
    told = [said for cycle in rig.log for said in cycle.drives if said.has_torque and said.controlword == SWITCH_ON]
    assert told
    assert max(abs(said.velocity) for said in told) <= 0.02 * COUNTS


def test_closing_in_a_fault_lets_come_to_rest_what_ramps_down_before_it_takes_the_torque(rig: LoopRig) -> None:
    slow_quick_stop(rig)
    rig.set_in_motion()
    rig.service.lost_slave = 3
    rig.run(0.01)
    rig.do(Shutdown())
    rig.finish()
    moving = [said for cycle in rig.log for said in cycle.drives if said.has_torque and abs(said.velocity) > 100]
    assert {said.controlword for said in moving} == {ENABLE_OPERATION, QUICK_STOP}


@pytest.mark.parametrize("period_us", [1000.0, 200.0])
def test_closing_without_frames_tells_all_drives_to_stop_for_as_long_as_a_quick_stop_takes(
    rig_board: tuple[Blackboard, Observer], period_us: float
) -> None:
    config = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=period_us))
    rig = LoopRig(*rig_board, config=config)
    try:
        rig.start().run(0.1)
        rig.enable()
        rig.data.carries = False
        rig.do(Shutdown())
        rig.finish()
    finally:
        rig_board[1].release(rig.lease)
    longest_s = max(bound.time_s for bound in bounds(config, StopReaction.QUICK_STOP))
    told = list(takewhile(lambda cycle: {said.controlword for said in cycle.drives} == {QUICK_STOP}, rig.log[::-1]))
    assert longest_s <= len(told) * period_us * 1e-6 <= longest_s + 0.02


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_closing_without_one_of_the_slaves_ends_when_the_joints_of_the_others_stand(rig: LoopRig, mode: int) -> None:
    for model in rig.models:
        model.objects[0x6085, 0].value = 100_000  # as the start-up SDOs of the drive's description set it
    rig.set_in_motion(mode)
    receive = rig.data.receive
    rig.data.receive = lambda: receive() - 3  # type: ignore[method-assign]
    rig.do(Shutdown())
    rig.finish()
    # Whoever ends the loop takes the slaves out of OP then.
    assert [model.powered for model in rig.models] == [True, True]
    assert all(abs(model.mechanics.velocity) < 0.01 for model in rig.models)


def test_closing_ends_after_2_s_where_a_drive_does_not_disable(rig: LoopRig) -> None:
    rig.data.deaf[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    rig.hold()
    rig.do(Shutdown())
    assert rig.finish() == pytest.approx(2.0, abs=3 * PERIOD_S)


# -- whatever is asked and whatever happens -------------------------------------------------------------------------

COMMANDS = {"enable": Enable(), "disable": Disable(), "reset": Reset(), "halt": Halt()}
MISHAPS = ["drive fault", "slave lost", "clock lost"]
DEEDS = st.one_of(
    st.tuples(st.just("run"), st.integers(1, 300)),
    st.tuples(st.just("lose"), st.integers(1, 60)),
    st.tuples(st.just("move"), st.tuples(st.floats(-2.2, 2.2), st.floats(-2.2, 2.2), st.floats(0.05, 0.55))),
    st.tuples(st.just("mode"), st.sampled_from([CSP, CSV, CST])),
    st.tuples(st.sampled_from(sorted(COMMANDS)), st.none()),
    st.tuples(st.sampled_from(MISHAPS), st.none()),
    st.tuples(st.just("recover"), st.none()),
)


def happen(rig: LoopRig, deed: str, how: object) -> None:
    if deed == "run":
        rig.run(how * PERIOD_S)
    elif deed == "lose":
        lose(rig, how)
    elif deed == "move":
        rig.send(move_to(*how[:2], speed=how[2]))
    elif deed == "mode":
        rig.send(SetDriveMode(DriveMode(how)))
    elif deed == "drive fault":
        rig.models[1].inject_fault(UNDER_VOLTAGE)
    elif deed == "slave lost":
        rig.service.lost_slave = 3
    elif deed == "clock lost":
        rig.discipline.locked = False
    elif deed == "recover":
        rig.discipline.locked = True
        rig.send(Reset())
        rig.run(0.2)
        rig.send(Enable())
        rig.run(0.05)
    else:
        rig.send(COMMANDS[deed])
    rig.cycle()


# A failing example is not shortened: that would take minutes.
@settings(max_examples=15, deadline=None, derandomize=True, phases=[Phase.generate])
@given(deeds=st.lists(DEEDS, min_size=20, max_size=40))
def test_whatever_happens_targets_stay_in_steps_and_only_enable_enables(
    rig_board: tuple[Blackboard, Observer], deeds: list[tuple[str, object]]
) -> None:
    rig = LoopRig(*rig_board)
    try:
        rig.set_in_motion()
        for deed, how in deeds:
            happen(rig, deed, how)
    finally:
        rig_board[1].release(rig.lease)
    for axis, joint in enumerate(CONFIG.joints):
        assert rig.longest_step(axis) <= LONGEST_STEP
        obeyed = [said.target for cycle in rig.log if (said := cycle.drives[axis]).obeys_target]
        assert all(joint.position.min * COUNTS <= target <= joint.position.max * COUNTS for target in obeyed)
    quiet = (State.READY, State.FAULT, State.RESETTING)
    assert all(
        said.controlword != ENABLE_OPERATION for cycle in rig.log if cycle.state in quiet for said in cycle.drives
    )
    before = {after.state: set() for after in rig.log}
    for earlier, after in pairwise(rig.log):
        before[after.state].add(earlier.state)
    assert before.get(State.ENABLING, set()) <= {State.READY, State.ENABLING}
    assert before.get(State.MOVING, set()) <= {State.HOLDING, State.MOVING}
