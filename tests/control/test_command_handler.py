"""Checks of a command beside its state: lease, fields, measured values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf, nan

import pytest

from rtcp.config.model import InputsConfig, OutputsConfig
from rtcp.ipc import refusals
from rtcp.ipc.commands import (
    ApplyTorque,
    Command,
    Disable,
    Enable,
    ExtendTrajectory,
    Guide,
    Halt,
    Home,
    HomeAxis,
    Jog,
    MoveAtVelocity,
    MoveAxis,
    MoveGripper,
    MoveJoints,
    OpenStream,
    Pause,
    Reset,
    Resume,
    RunAxis,
    RunInStep,
    RunLines,
    RunTrajectory,
    SetChannel,
    SetControlMode,
    SetDriveMode,
    SetLimits,
    SetOutput,
    SetPayload,
    SetSpeedOverride,
    SetTool,
    SetZero,
    Shutdown,
    StreamPosition,
)
from rtcp.ipc.events import Paused, Resumed, SpeedOverrideChanged
from rtcp.ipc.layout import LEASE_RENEWED_AT
from rtcp.ipc.observer import Answer
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

from .rig import CONFIG, COUNTS, CSP, CST, CSV, PERIOD_S, SPEED, LoopRig, Step, about, move_to, turn

HEARTBEAT = 0x0004
"""Output 3, which is toggled each cycle."""
ANYONE = {"disable", "halt", "pause", "set_speed_override", "shutdown", "stop_axis"}
"""Commands that need no lease: they make the arm safer."""
READY: list[Command] = [
    SetOutput(5, True), SetZero(0, 0.0), Enable(), SetDriveMode(DriveMode.CSP), SetControlMode(ControlMode.JOINT),
    MoveGripper(False), SetLimits(0, 1), SetTool(0), SetPayload(0.1),
]  # fmt: skip
HOLDING: list[Command] = [
    move_to(0.1, 0.1), RunTrajectory(0, 1), RunLines(0, 1), StreamPosition((0.0, 0.0), 0.0), OpenStream(1),
    RunInStep(0, 1, 1, 0, 0, 1, 0.1),
    Jog((0.0, 0.0), JogFrame.JOINTS, 0.2), MoveAtVelocity((0.0, 0.0), 0.2), ApplyTorque((0.0, 0.0), 0.0, 0.0, 0.2),
    Guide(), Home(0), MoveAxis(2, 0.1), RunAxis(2, 0.1, 0.2), HomeAxis(2), SetChannel(1, 0, 1.0), *READY[3:],
]  # fmt: skip
WITH_LEASE: dict[State, list[Command]] = {State.READY: READY, State.HOLDING: HOLDING, State.FAULT: [Reset()]}
"""Commands that need the lease, in a state that accepts them."""


def name_of(value: object) -> str:
    return getattr(value, "name", "").lower()


# -- the lease ------------------------------------------------------------------------------------------------------


def test_only_what_makes_the_arm_safer_needs_no_lease() -> None:
    own = {kind for kind in Command.kinds if kind.__module__ == "rtcp.ipc.commands"}
    assert {kind.name for kind in own if not kind.needs_lease} == ANYONE
    tried = {type(command) for commands in WITH_LEASE.values() for command in commands}
    # `ExtendTrajectory` and `Resume` need a motion, which the end of the lease has stopped.
    assert {kind for kind in own if kind.needs_lease} == tried | {ExtendTrajectory, Resume}


@pytest.mark.parametrize("stream", [0, -1, -(1 << 63)])
def test_a_stream_has_a_number_above_0(rig: LoopRig, stream: int) -> None:
    rig.hold()
    assert rig.send(OpenStream(stream)).refusal == refusals.Malformed(OpenStream.number)
    rig.run(0.1)
    assert rig.state is State.HOLDING


def test_a_number_that_no_refusal_can_hold_is_malformed_and_ends_nothing(rig: LoopRig) -> None:
    rig.hold()
    assert rig.send(SetOutput(1, True, (1 << 63) - 1)).refusal == refusals.Malformed(SetOutput.number)
    rig.run(0.1)
    assert rig.state is State.HOLDING


@pytest.mark.parametrize("state", WITH_LEASE, ids=name_of)
def test_a_command_without_its_lease_is_refused_and_changes_nothing(rig: LoopRig, state: State) -> None:
    rig.lead_to(state)
    rig.fall_silent()
    rig.run(2 * CONFIG.lease_s)
    for lease in (0, 12345, rig.lease):
        for command in WITH_LEASE[state]:
            assert isinstance(rig.send(command, lease=lease).refusal, refusals.NoLease), (command, lease)
            assert rig.state is state


def test_a_renewal_that_lies_far_in_the_future_is_none_and_the_motion_stops(rig: LoopRig) -> None:
    rig.lead_to(State.MOVING)
    rig.fall_silent()
    rig.board.words[LEASE_RENEWED_AT] = rig.now_ns + 60_000_000_000
    rig.bring_to(State.STOPPING, 2 * PERIOD_S)


@pytest.mark.parametrize("command", [Disable(), Halt(), Shutdown()], ids=name_of)
def test_a_command_that_makes_the_arm_safer_is_accepted_from_anyone(rig: LoopRig, command: Command) -> None:
    rig.lead_to(State.MOVING)
    assert rig.send(command, lease=0).refusal is None
    assert rig.state is not State.MOVING


# -- the speed override ---------------------------------------------------------------------------------------------


def speed_overrides(rig: LoopRig) -> list[float]:
    events = (record.event for record in rig.events)
    return [event.fraction for event in events if isinstance(event, SpeedOverrideChanged)]


def test_anyone_lowers_the_speed_override_and_its_raise_takes_the_lease(rig: LoopRig) -> None:
    rig.lead_to(State.MOVING)
    for fraction, lease, refusal in (
        (0.5, 0, None),
        (0.5, 0, None),
        (0.6, 0, refusals.NoLease()),
        (0.6, 12345, refusals.NoLease()),
        (0.6, rig.lease, None),
        (0.01, 12345, None),
    ):
        assert rig.send(SetSpeedOverride(fraction), lease=lease).refusal == refusal
        shown = rig.observer.latest()[0]
        assert shown["speed_override"] == rig.arm.speed_override.fraction
    assert speed_overrides(rig) == [0.5, 0.6, 0.01]
    assert rig.state is State.MOVING


@pytest.mark.parametrize("fraction", [0.0, 0.0099, 1.0001, 2.0, -0.5, nan, inf])
def test_a_speed_override_out_of_its_range_is_refused(rig: LoopRig, fraction: float) -> None:
    rig.start()
    refusal = rig.send(SetSpeedOverride(fraction)).refusal
    assert isinstance(refusal, refusals.SpeedOverrideOutOfRange)
    assert "a fraction of the speed from 0.01 to 1" in rig.names.message(refusal)
    assert rig.arm.speed_override.fraction == 1.0
    assert speed_overrides(rig) == []


def test_a_speed_override_outlasts_a_halt_and_disabling(rig: LoopRig) -> None:
    rig.lead_to(State.MOVING)
    rig.do(SetSpeedOverride(0.3))
    rig.do(Halt())
    rig.bring_to(State.HOLDING)
    rig.do(Disable())
    rig.bring_to(State.READY)
    assert rig.arm.speed_override.fraction == 0.3


# -- pause ----------------------------------------------------------------------------------------------------------


def test_a_paused_motion_rests_on_its_path_and_ends_where_it_was_to(rig: LoopRig) -> None:
    rig.hold()
    rig.do(move_to(0.4, 0.1))
    rig.run(0.3)
    assert rig.send(Pause(), lease=0).refusal is None
    rig.run(1.0)
    rest = list(rig.arm.state.commanded)
    rig.run(1.0)
    assert rig.arm.state.commanded == rest
    assert rig.state is State.MOVING
    assert rig.observer.latest()[0]["speed_override"] == 0.0
    assert rig.send(Pause(), lease=0).refusal is None
    assert rig.send(move_to(0.0, 0.0)).refusal == refusals.MotionPaused()
    rig.do(SetSpeedOverride(0.5))
    assert rig.observer.latest()[0]["speed_override"] == 0.0
    assert rig.send(Resume(), lease=0).refusal == refusals.NoLease()
    assert rig.send(Resume(), lease=12345).refusal == refusals.NoLease()
    rig.do(Resume())
    assert rig.observer.latest()[0]["speed_override"] == 0.5
    rig.bring_to(State.HOLDING, 20.0)
    assert rig.arm.state.commanded == pytest.approx([0.4, 0.1])
    kinds = [type(record.event) for record in rig.events]
    assert (kinds.count(Paused), kinds.count(Resumed)) == (1, 1)


@pytest.mark.parametrize("end", [Halt(), Disable()], ids=name_of)
def test_what_ends_a_paused_motion_ends_its_pause(rig: LoopRig, end: Command) -> None:
    rig.lead_to(State.MOVING)
    rig.do(Pause())
    rig.run(0.5)
    rig.do(end)
    rig.run(0.5)
    assert rig.state is not State.MOVING
    assert rig.arm.speed_override.fraction == 1.0


def test_a_jog_cannot_be_paused(rig: LoopRig) -> None:
    rig.hold()
    rig.do(Jog((0.1, 0.0), JogFrame.JOINTS, 1.0))
    assert rig.send(Pause()).refusal == refusals.NotPausable()
    assert rig.send(Resume()).refusal == refusals.NotPaused()


# -- moves ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "refusal"),
    [
        (move_to(0.0, 2.5), refusals.PositionOutOfRange(1, 2.5, 2.0)),
        (move_to(-3.2, 0.0), refusals.PositionOutOfRange(0, -3.2, -3.1)),
        (move_to(-inf, 0.0), refusals.NotFinite(0, -inf)),
        (move_to(0.1, 0.1, 0.1), refusals.WrongCount(3, 2)),
        (move_to(0.1, 0.1, speed=0.6), refusals.SpeedOutOfRange(0.6, 0.5)),
        (move_to(0.1, 0.1, speed=0.0), refusals.SpeedOutOfRange(0.0, 0.5)),
        (move_to(1.0, 1.0, speed=0.001), refusals.NoTrajectory(0.001, 600.0)),
    ],
    ids=name_of,
)
def test_a_move_that_cannot_be_made_is_refused_with_value_and_limit(
    rig: LoopRig, command: MoveJoints, refusal: refusals.Refusal
) -> None:
    rig.hold()
    assert rig.send(command).refusal == refusal
    assert rig.state is State.HOLDING


def test_a_refused_move_leaves_the_one_under_way_as_it_was(rig: LoopRig) -> None:
    rig.hold()
    rig.move(0.1, 0.1)
    rig.run(0.1)
    rig.send(move_to(0.3, 2.5))
    rig.bring_to(State.HOLDING)
    rig.run(0.1)
    assert [drive.position for drive in rig.arm.drives] == pytest.approx([0.1, 0.1], abs=1e-3)


def test_a_move_in_motion_takes_over_without_a_jump(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.move(-0.1, 0.3)
    rig.bring_to(State.HOLDING)
    rig.run(0.1)
    assert rig.longest_step(0) <= CONFIG.joints[0].velocity * PERIOD_S * COUNTS + 1
    assert [drive.position for drive in rig.arm.drives] == pytest.approx([-0.1, 0.3], abs=1e-3)


def test_the_edge_of_a_range_is_inside_it(rig: LoopRig) -> None:
    rig.hold()
    assert rig.send(move_to(3.1, -2.0, speed=SPEED)).refusal is None


# -- enabling -------------------------------------------------------------------------------------------------------


def standstill(axis: int, velocity: float) -> refusals.Refusal:
    return refusals.NotAtStandstill(axis, about(velocity, rel=0.01))


@pytest.mark.parametrize(
    ("prevent", "refusal"),
    [
        (lambda rig: setattr(rig.service, "all_op", False), refusals.NotInOp()),
        (lambda rig: setattr(rig.discipline, "locked", False), refusals.ClockNotLocked()),
        (lambda rig: setattr(rig.models[1].mechanics, "position", 2.1), refusals.JointOutsideRange(1, 2.1)),
        (lambda rig: setattr(rig.models[1].mechanics, "position", -2.1), refusals.JointOutsideRange(1, -2.1)),
        *(
            (lambda rig, a=axis, v=velocity: turn(rig, a, 1e5, v, 200.0 * v), standstill(axis, velocity))
            for axis in range(2)
            for velocity in (0.05, -0.05)
        ),
    ],
    ids=[
        "a slave is not in OP",
        "the clock is not locked",
        "above the range",
        "below the range",
        *(f"joint {axis + 1} turns {way}" for axis in range(2) for way in ("up", "down")),
    ],
)
def test_nothing_is_enabled_while(rig: LoopRig, prevent: Step, refusal: refusals.Refusal) -> None:
    prevent(rig.start())
    rig.run(0.01)
    assert rig.send(Enable()).refusal == refusal
    assert rig.state is State.READY


# -- modes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [SetDriveMode(DriveMode.CSP), move_to(0.1, 0.1)], ids=name_of)
def test_while_the_drives_change_their_mode_neither_a_move_nor_another_mode_is_accepted(
    rig: LoopRig, command: Command
) -> None:
    rig.hold()
    rig.misunderstood[1, 0x6060] = {CSV: CSP}
    rig.do(SetDriveMode(DriveMode(CSV)))
    assert rig.send(command).refusal == refusals.DriveModeChanging()
    rig.misunderstood.clear()
    rig.run(0.01)
    assert rig.send(command).refusal is None


def test_a_mode_that_is_chosen_while_ready_is_held_in_after_the_next_enable(rig: LoopRig) -> None:
    rig.start()
    rig.do(SetDriveMode(DriveMode(CST)))
    rig.enable()
    rig.run(0.05)
    assert [drive.mode_display for drive in rig.log[-1].drives] == [CST, CST]


# -- outputs, and unknown commands ----------------------------------------------------------------------------------


def test_an_output_reaches_the_terminal(rig: LoopRig) -> None:
    rig.start()
    for number, value in ((5, True), (16, True), (5, False)):
        rig.do(SetOutput(number, value))
    rig.run(0.005)
    assert rig.box.outputs & ~HEARTBEAT == 0x8000


@pytest.mark.parametrize("number", [0, 17, -1])
def test_an_output_that_does_not_exist_is_refused(rig: LoopRig, number: int) -> None:
    rig.start()
    assert rig.send(SetOutput(number, True)).refusal == refusals.UnknownOutput(number, 16)
    rig.run(0.005)
    assert rig.box.outputs & ~HEARTBEAT == 0


def test_without_an_io_box_there_are_no_outputs(new_rig: Callable[..., LoopRig]) -> None:
    io = replace(CONFIG.slaves[0], device=replace(CONFIG.slaves[0].device, kind="generic"))
    slaves = (io, *CONFIG.slaves[1:])
    rig = new_rig(replace(CONFIG, slaves=slaves, inputs=InputsConfig(), outputs=OutputsConfig(), gripper=None))
    assert rig.start().send(SetOutput(1, True)).refusal == refusals.NoOutputs()


def test_outputs_stay_as_they_are_in_a_fault(rig: LoopRig) -> None:
    rig.hold()
    rig.do(SetOutput(6, True))
    rig.service.lost_slave = 3
    rig.run(0.1)
    assert (rig.state, rig.box.outputs & ~HEARTBEAT) == (State.FAULT, 0x0020)


class Unknown(Command):
    """A command that no handler knows."""

    states = frozenset(State)


def test_a_command_without_a_handler_is_refused_with_its_number(rig: LoopRig) -> None:
    rig.start()
    assert rig.send(Unknown()).refusal == refusals.Malformed(Unknown.number)


def test_at_most_one_command_is_taken_a_cycle(rig: LoopRig) -> None:
    rig.hold()
    first = rig.observer.command(rig.lease, move_to(0.1, 0.1))
    second = rig.observer.command(rig.lease, Halt())
    rig.cycle()
    assert rig.observer.answer(first) is not None
    assert rig.state is State.MOVING
    rig.cycle()
    assert rig.observer.answer(second) is not None
    assert rig.state is State.STOPPING


def test_a_stop_is_carried_out_in_the_next_cycle_whatever_waits_in_the_ring(rig: LoopRig) -> None:
    rig.hold()
    rig.do(move_to(0.1, 0.1))
    for _ in range(60):
        rig.observer.command(rig.lease, SetSpeedOverride(1.0))
    rig.observer.command(rig.lease, move_to(-0.1, -0.1))
    stop = rig.observer.stop(Halt)
    rig.cycle()
    assert rig.state is State.STOPPING
    assert rig.observer.stop_answer(Halt, stop) == Answer(None)
    rig.run(1.0)
    assert rig.state is State.HOLDING


def test_a_refused_stop_says_in_which_state(rig: LoopRig) -> None:
    rig.lead_to(State.FAULT)
    stop = rig.observer.stop(Halt)
    rig.cycle()
    assert rig.observer.stop_answer(Halt, stop) == Answer(refusals.WrongState(Halt.number, State.FAULT))
