"""The table of states, commands and events: what is accepted where, and where it leads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from docs.machine_page import diagram
from rtcp.control.machine import STATES
from rtcp.control.states import ReadyState, Signal, StoppedByLimitState
from rtcp.ipc import commands, events, refusals
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

from .rig import (
    CAUSES,
    CONTROLWORD,
    ENABLE_OPERATION,
    QUICK_STOP,
    SWITCH_ON,
    LoopRig,
    move_to,
)

# The next state for each command and event in each state, written independently of the product; `=`: no change.
# `.`: a command is refused, an event is not tried.
TABLE = """
                 start ready enab  hold  move  stop  limit home  disab fault emerg reset close
enable           .     enab  .     .     .     .     .     .     .     .     .     .     .
disable          .     =     disab disab disab disab disab disab =     =     =     fault .
reset            .     .     .     .     .     .     hold  .     .     reset reset .     .
set_drive_mode   .     =     .     =     .     .     .     .     .     .     .     .     .
set_control_mode .     =     .     =     .     .     .     .     .     .     .     .     .
move_joints      .     .     .     move  =     .     .     .     .     .     .     .     .
run_trajectory   .     .     .     =     =     .     .     .     .     .     .     .     .
run_in_step      .     .     .     =     =     .     .     .     .     .     .     .     .
extend_trajectory . .   .     .     =     .     .     .     .     .     .     .     .
run_lines        .     .     .     =     =     .     .     .     .     .     .     .     .
stream_position  .     .     .     move  =     .     .     .     .     .     .     .     .
open_stream      .     .     .     move  .     .     .     .     .     .     .     .     .
jog              .     .     .     move  =     .     .     .     .     .     .     .     .
move_at_velocity .     .     .     =     =     .     .     .     .     .     .     .     .
apply_torque     .     .     .     =     =     .     .     .     .     .     .     .     .
guide            .     .     .     =     .     .     .     .     .     .     .     .     .
halt             .     =     disab =     stop  =     =     =     =     .     .     .     .
set_output       .     =     =     =     =     =     =     =     .     =     .     .     .
set_channel      .     =     =     =     =     =     =     =     .     .     .     .     .
move_gripper     .     =     .     =     =     =     =     .     .     .     .     .     .
move_axis        .     =     .     =     =     =     =     .     .     .     .     .     .
run_axis         .     =     .     =     =     =     =     .     .     .     .     .     .
home_axis        .     =     .     =     =     =     =     .     .     .     .     .     .
stop_axis        =     =     =     =     =     =     =     =     =     =     =     =     =
set_limits       .     =     .     =     =     .     =     .     .     =     =     .     .
set_speed_override = = =     =     =     =     =     =     =     =     =     =     =
pause            .     .     .     .     =     .     .     .     .     .     .     .     .
resume           .     .     .     .     =     .     .     .     .     .     .     .     .
set_tool         .     =     .     =     .     .     .     .     .     .     .     .     .
set_payload      .     =     .     =     .     .     .     .     .     .     .     .     .
set_zero         .     =     .     .     .     .     .     .     .     .     .     .     .
home             .     .     .     home  .     .     .     .     .     .     .     .     .
shutdown         close close close close close close close close close close close close =
lost_frames      =     fault fault fault fault fault fault fault fault =     =     .     =
slave_lost       .     fault fault fault fault fault fault fault fault =     =     .     =
drive_fault      =     fault fault fault fault fault fault fault fault =     =     .     =
clock_lost       =     fault .     fault fault .     fault fault .     =     =     .     .
emergency_stop   =     =     emerg emerg emerg emerg emerg emerg emerg emerg =     .     =
supervision      .     .     emerg emerg emerg emerg emerg emerg .     =     .     .     .
lease_ended      =     =     =     =     stop  =     =     .     =     =     =     .     =
enabling_switch  =     =     =     =     stop  =     =     .     =     =     =     .     =
"""
_HEAD, *_ROWS = [line.split() for line in TABLE.strip().splitlines()]
_STATES = {
    "start": State.STARTING, "ready": State.READY, "enab": State.ENABLING, "hold": State.HOLDING, "move": State.MOVING,
    "stop": State.STOPPING, "limit": State.STOPPED_BY_LIMIT, "home": State.HOMING, "disab": State.DISABLING,
    "fault": State.FAULT, "emerg": State.EMERGENCY_STOP, "reset": State.RESETTING, "close": State.CLOSING,
}  # fmt: skip
CELLS = {(row[0], _STATES[state]): cell for row in _ROWS for state, cell in zip(_HEAD, row[1:], strict=True)}
COMMANDS: dict[str, commands.Command] = {
    command.name: command
    for command in (
        commands.Enable(), commands.Disable(), commands.Reset(), commands.SetDriveMode(DriveMode.CSP),
        commands.SetControlMode(ControlMode.JOINT), move_to(0.1, 0.1),
        commands.RunTrajectory(0, 1), commands.ExtendTrajectory(1, False), commands.RunLines(0, 1),
        commands.StreamPosition((0.0, 0.0), 0.0), commands.OpenStream(1),
        commands.Jog((0.0, 0.0), JogFrame.JOINTS, 0.2), commands.RunInStep(0, 1, 1, 0, 0, 1, 0.1),
        commands.MoveAtVelocity((0.0, 0.0), 0.2), commands.ApplyTorque((0.0, 0.0), 0.0, 0.0, 0.2), commands.Guide(),
        commands.Halt(),
        commands.SetOutput(5, True), commands.SetChannel(1, 0, 1.0),
        commands.MoveAxis(2, 0.1), commands.RunAxis(2, 0.1, 0.2), commands.HomeAxis(2), commands.StopAxis(2),
        commands.MoveGripper(False), commands.SetLimits(0, 1), commands.SetSpeedOverride(0.5), commands.Pause(),
        commands.Resume(), commands.SetTool(0), commands.SetPayload(0.1),
        commands.SetZero(0, 0.0), commands.Home(0), commands.Shutdown(),
    )
}  # fmt: skip
"""One command of each kind, with valid fields."""
FOR_OTHER_REASONS: dict[type[commands.Command], tuple[type[refusals.Refusal], ...]] = {
    commands.RunTrajectory: (refusals.DamagedRow, refusals.PlanStartsElsewhere),
    commands.RunInStep: (refusals.StartOutOfReach, refusals.WrongState),
    commands.ExtendTrajectory: (refusals.NotOpen,),
    commands.SetChannel: (refusals.ChannelNotSettable,),
    commands.RunLines: (refusals.NoGeometry,),
    commands.MoveAtVelocity: (refusals.WrongControlMode,),
    commands.ApplyTorque: (refusals.WrongControlMode,),
    commands.Resume: (refusals.NotPaused,),
    commands.Guide: (refusals.NoGeometry,),
    commands.SetLimits: (refusals.WrongRowCount,),
    commands.SetPayload: (refusals.MassesUnknown,),
    commands.Reset: (refusals.EmergencyStopPressed,),
    **dict.fromkeys(
        (commands.MoveAxis, commands.RunAxis, commands.HomeAxis, commands.StopAxis), (refusals.UnknownExternalAxis,)
    ),
}
"""Other refusals of `COMMANDS` in states that accept them; tested elsewhere."""


EVENTS: dict[str, type[events.Event]] = {
    "lost_frames": events.ProcessDataLost, "slave_lost": events.SlaveLost, "drive_fault": events.DriveFault,
    "clock_lost": events.ClockLost,
    "emergency_stop": events.EmergencyStopActivated, "supervision": events.OverSpeed,
    "lease_ended": events.LeaseExpired,
    "enabling_switch": events.PermissionWithdrawn,
}  # fmt: skip
"""Event of each key of `stops`."""
ACCEPTED = [(COMMANDS[name], state) for (name, state), cell in CELLS.items() if name in COMMANDS and cell != "."]
HAPPENS = [(name, state) for (name, state), cell in CELLS.items() if name in EVENTS and cell != "."]
RUNNING = sorted(set(State) - {State.OFF})
"""The states of a loop that runs."""


@pytest.fixture
def rig(switch_rig: Callable[..., LoopRig]) -> LoopRig:
    return switch_rig()


def bring_to(rig: LoopRig, state: State) -> None:
    # A drive that does not enable keeps the machine in that state.
    rig.misunderstood[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON} if state is State.ENABLING else {}
    rig.lead_to(state)
    rig.slaves_come_back = False


def leads_to(name: str, state: State) -> State:
    cell = CELLS[name, state]
    return state if cell == "=" else _STATES[cell]


def name_of(value: object) -> str:
    return value if isinstance(value, str) else getattr(value, "name", "").lower()


def test_the_table_has_every_command_and_every_state() -> None:
    own = {kind.name for kind in commands.Command.kinds if kind.__module__ == "rtcp.ipc.commands"}
    assert set(CELLS) == {(name, state) for name in {*own, *EVENTS} for state in RUNNING}
    for command in COMMANDS.values():
        assert command.states == {state for other, state in ACCEPTED if other is command}


@pytest.mark.parametrize(("command", "state"), ACCEPTED, ids=name_of)
def test_a_command_that_is_accepted_leads_to_its_state(rig: LoopRig, command: commands.Command, state: State) -> None:
    bring_to(rig, state)
    refusal = rig.send(command).refusal
    # A state may accept a command that is refused for its fields.
    assert refusal is None or isinstance(refusal, FOR_OTHER_REASONS.get(type(command), ()))
    assert rig.state is (leads_to(command.name, state) if refusal is None else state)
    if isinstance(command, commands.Shutdown):
        rig.finish()
        assert rig.powered == [False, False]


@pytest.mark.parametrize("state", RUNNING, ids=name_of)
def test_every_other_command_is_refused_with_the_states_that_accept_it_and_changes_nothing(
    rig: LoopRig, state: State
) -> None:
    bring_to(rig, state)
    for command in (command for command in COMMANDS.values() if CELLS[command.name, state] == "."):
        refusal = rig.send(command).refusal
        assert refusal == refusals.WrongState(command.number, state)
        message, _, accepting = rig.names.message(refusal).partition(", only in: ")
        assert message == f"{command.name} is not accepted in state {state.words}"
        accepting, _, hint = accepting.partition("; ")
        assert accepting.split(", ") == sorted(accepted.words for accepted in command.states)
        if state in commands.Reset.states:
            assert hint == "`rtcp reset` first"
        elif state is State.READY and State.HOLDING in command.states:
            assert hint == "`rtcp enable` first"
        else:
            assert hint == ("`rtcp disable` first" if command.name == "set_zero" else "")
        assert rig.state is state


@pytest.mark.parametrize(("event", "state"), HAPPENS, ids=name_of)
def test_an_event_leads_to_its_state(rig: LoopRig, event: str, state: State) -> None:
    bring_to(rig, state)
    kind, goal = EVENTS[event], leads_to(event, state)
    before = rig.kinds.count(kind)
    CAUSES[event][0](rig)
    if goal is state:
        rig.run(0.05)
        assert rig.state is state or (state is State.CLOSING and rig.machine.closed)
        return
    rig.bring_to(goal, 1.1)
    assert rig.kinds.count(kind) == before + 1
    words = {drive.controlword for drive in rig.log[-1].drives if drive.has_torque}
    if goal is State.STOPPING:
        assert words == {ENABLE_OPERATION}
        rig.bring_to(State.HOLDING)
    else:
        assert words <= {QUICK_STOP}
        assert rig.machine.fault == kind.number
    if goal is State.EMERGENCY_STOP:
        rig.wait(lambda: rig.joints.first_with_torque() == -1, 2.5)


# -- what is derived from the table ---------------------------------------------------------------------------------

ROOT = Path(__file__).parents[2]


def targets(state: State) -> set[State]:
    return {target for entry in STATES if entry.state is state for target in entry.leads_to.values()}


def reached_from(start: State) -> set[State]:
    reached, left = {start}, [start]
    while left:
        for target in targets(left.pop()) - reached:
            reached.add(target)
            left.append(target)
    return reached


def test_every_state_is_reached_from_the_start_and_leads_to_the_end() -> None:
    assert {entry.state for entry in STATES} == set(RUNNING)
    assert reached_from(State.STARTING) == set(State)
    assert all(State.OFF in reached_from(state) for state in State)


def test_nothing_leads_from_a_fault_or_an_emergency_stop_to_motion_but_through_reset_and_enable() -> None:
    stopped = {State.FAULT, State.EMERGENCY_STOP, State.RESETTING}
    for state in stopped:
        assert targets(state) <= {*stopped, State.CLOSING, State.READY}
    assert [cause for cause, target in ReadyState.leads_to.items() if target is State.ENABLING] == [commands.Enable]
    assert [cause for cause, target in StoppedByLimitState.leads_to.items() if target is State.HOLDING] == [
        commands.Reset
    ]


def test_where_a_lost_clock_may_end_in_a_controlled_stop_set_points_move_the_arm() -> None:
    states = {entry.state for entry in STATES if Signal.STOP_FOR_CLOCK in entry.leads_to}
    assert states == {State.HOLDING, State.MOVING, State.STOPPING}


def test_the_diagram_shows_every_state() -> None:
    assert all(f"{state.name} :" in diagram() for state in State)
