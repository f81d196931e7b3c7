"""Every fault, and every event with a stop reaction, from its cause to the next motion.

A row of `CASES` names the cause, the event and its place, the words of its message, the reaction of the drives and
the state in which it ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import get_args, get_type_hints

import pytest

from rtcp.config.model import StopsConfig
from rtcp.ipc import events
from rtcp.ipc.commands import Disable, Enable, Halt, MoveJoints, Reset, SetDriveMode
from rtcp.ipc.states import DriveMode, State
from rtcp.motion.state import ArmState, Setpoint

from .rig import (
    _WIRE,
    CAUSES,
    CONTROLWORD,
    CSP,
    CSV,
    DEBOUNCE_S,
    ENABLE_OPERATION,
    ENABLE_TIMEOUT_S,
    LONGEST_STEP,
    LOST_CYCLES,
    MODES_OF_OPERATION,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_ON,
    VOLTAGE_OFF,
    LoopRig,
    Step,
    let_go,
    turn,
)

CONTROLWORDS = {"controlled_stop": ENABLE_OPERATION, "quick_stop": QUICK_STOP, "torque_off": VOLTAGE_OFF}
REACTIONS = {key: get_args(hint) for key, hint in get_type_hints(StopsConfig).items() if not key.endswith("_s")}
"""The reactions that each key of `stops` allows."""


@dataclass(frozen=True)
class Case:
    """A row: `cause` begins with the start of the platform, and the event follows within 4 s; `clear` ends the cause.

    `says`: what the message names; {word} is the statusword of the joint then. `place`: axis or slave, -1: none.
    """

    name: str
    kind: type[events.Event]
    place: int
    says: tuple[str, ...]
    cause: Step
    clear: Step = lambda rig: None
    reaction: str = "quick_stop"
    ends_in: State = State.FAULT
    after_s: float | None = None
    """Time from the cause to the event."""
    stops: dict[str, str] = field(default_factory=dict)
    """Stop reactions that differ from the default."""


def understand_all(rig: LoopRig) -> None:
    rig.misunderstood.clear()


def drive_understands(index: int, understood: dict[int, int], begin: Step, command: object = None) -> Step:
    """The second drive receives other values than it is sent, from before the command on."""

    def cause(rig: LoopRig) -> None:
        begin(rig)
        rig.misunderstood[1, index] = understood
        if command is not None:
            rig.do(command)  # type: ignore[arg-type]

    return cause


def drive_fault_lasts(rig: LoopRig) -> None:
    rig.start().models[1].condition.bus_voltage = 10.0
    rig.bring_to(State.FAULT)
    rig.do(Reset())


def voltage_returns(rig: LoopRig) -> None:
    rig.models[1].condition.bus_voltage = 48.0


def joint_turns_during_reset(rig: LoopRig) -> None:
    rig.lead_to(State.FAULT)
    turn(rig, 1, 2000.0, 0.05, 117.0)
    rig.do(Reset())


def joint_turns_after_homing(rig: LoopRig) -> None:
    rig.lead_to(State.HOMING).run(0.1)
    turn(rig, 0, 1e5, 0.015, 117.0)
    rig.do(Halt())


def joint_turned_by_hand(position: float) -> Step:
    return lambda rig: setattr(rig.models[1].mechanics, "position", position)


def joint_out_of_range(rig: LoopRig) -> None:
    rig.start()
    joint_turned_by_hand(2.019)(rig)
    rig.run(0.01)
    rig.do(Enable())
    joint_turned_by_hand(2.021)(rig)


def jumps(at: int, counts: int) -> Step:
    """An input of the second drive shows other counts while it is being enabled."""

    def cause(rig: LoopRig) -> None:
        rig.start().do(Enable())
        sound = rig.data.input

        def false(slot: int) -> bytes:
            values = list(_WIRE.unpack(sound(slot)))
            values[at] = counts
            return _WIRE.pack(*values)

        rig.data.input = lambda index: false(index) if index == 2 else sound(index)  # type: ignore[method-assign]

    return cause


def inputs_are_true(rig: LoopRig) -> None:
    del rig.data.input


def box_cannot_be_read(rig: LoopRig) -> None:
    sound = rig.set_in_motion().data.input
    rig.data.input = lambda index: sound(index) if index else b""  # type: ignore[method-assign]


def generator_fails(rig: LoopRig) -> None:
    generator = rig.set_in_motion().arm.controllers[MoveJoints]

    def fail(state: ArmState) -> Setpoint:
        generator.ended = events.ControllerFailed()
        target = Setpoint(2)
        target.position = list(state.commanded)
        return target

    generator.update = fail  # type: ignore[method-assign]


def generator_works(rig: LoopRig) -> None:
    del rig.arm.controllers[MoveJoints].update


FAULTS = (
    Case("drive fault while ready", events.DriveFault, 1, ("joint2", "in fault", "statusword {word}", "`rtcp reset`"),
         lambda rig: CAUSES["drive_fault"][0](rig.start())),
    Case("drive leaves Operation Enabled", events.DriveLeftEnabled, 1,
         ("joint2", "left Operation Enabled", "statusword {word}", "`rtcp reset`"),
         drive_understands(CONTROLWORD, {ENABLE_OPERATION: 0}, LoopRig.set_in_motion), understand_all),
    Case("drive does not enable", events.EnableTimeout, 1,
         ("joint2", "did not reach Operation Enabled", "0.2 s", "{word}", "enable_timeout_s in assistive_arm.yaml"),
         drive_understands(CONTROLWORD, {ENABLE_OPERATION: SWITCH_ON}, LoopRig.start, Enable()), understand_all,
         after_s=ENABLE_TIMEOUT_S),
    Case("drive does not disable", events.DisableTimeout, 1,
         ("joint2", "kept its torque", "statusword {word}", "enable_timeout_s"),
         drive_understands(CONTROLWORD, {SWITCH_ON: ENABLE_OPERATION}, LoopRig.set_in_motion, Disable()),
         understand_all),
    Case("drive keeps its mode", events.DriveModeTimeout, 1, ("joint2", "mode 8", "instead of csv"),
         drive_understands(MODES_OF_OPERATION, {CSV: CSP}, LoopRig.hold, SetDriveMode(DriveMode.CSV)),
         understand_all, after_s=1.0),
    Case("drive keeps another mode while enabling", events.DriveModeTimeout, 1, ("joint2", "mode 3", "instead of csp"),
         drive_understands(MODES_OF_OPERATION, {CSP: 3}, LoopRig.start, Enable()), understand_all),
    Case("drive fault lasts through the reset", events.ResetTimeout, 1,
         ("joint2", "in fault after the reset", "statusword {word}"), drive_fault_lasts, voltage_returns),
    Case("joint turns during the reset", events.ResetWhileMoving, 1,
         ("joint2", "still turns", "rad/s", "3 s", "`rtcp disable`"), joint_turns_during_reset, let_go),
    Case("joint turns after its homing", events.HomingStillMoving, 0,
         ("joint1", "still turns", "rad/s", "3 s", "homing", "`rtcp reset`"), joint_turns_after_homing, let_go),
    Case("slave does not come back", events.ResetWithoutSlaves, -1, ("reset", "3 s", "not all slaves are back in OP"),
         lambda rig: rig.lead_to(State.RESETTING), lambda rig: setattr(rig, "slaves_come_back", True),
         after_s=3.0 + DEBOUNCE_S),
    Case("joint outside its range while enabling", events.LeftRange, 1,
         ("joint2", "left its range", "2.021 rad", "joints[1].position in assistive_arm.yaml"),
         joint_out_of_range, joint_turned_by_hand(1.9)),
    Case("position jumps while enabling", events.PositionJumped, 1,
         ("joint2", "jumped from 0 to 0.1 rad", "5 cycles (supervision in assistive_arm.yaml)", "`rtcp reset`"),
         jumps(1, 1000), inputs_are_true),
    Case("speed jumps while enabling", events.VelocityJumped, 1,
         ("joint2", "jumped from 0 to 0.6 rad/s", "5 cycles (supervision in assistive_arm.yaml)", "`rtcp reset`"),
         jumps(2, 6000), inputs_are_true),
    Case("driver raises", events.DriverFailed, 1,
    ("slave 1 (io)", "raised an error", "outputs are safe", "`rtcp reset`"),
         box_cannot_be_read, inputs_are_true),
    Case("trajectory generator fails", events.GeneratorFailed, -1, ("trajectory generator", "`rtcp reset`"),
         generator_fails, generator_works),
)  # fmt: skip
STOPS: dict[str, tuple[type[events.Event], int, tuple[str, ...]]] = {
    "lost_frames": (
        events.ProcessDataLost,
        -1,
        ("process data lost", "reached 40", "bus.lost_cycles in assistive_arm.yaml"),
    ),
    "slave_lost": (events.SlaveLost, 3, ("slave 3 (drive2)", "left OP")),
    "drive_fault": (events.DriveFault, 1, ("joint2", "in fault", "statusword {word}")),
    "clock_lost": (events.ClockLost, -1, ("reference clock", "1 s")),
    "emergency_stop": (events.EmergencyStopActivated, -1, ("emergency stop",)),
    "supervision": (events.OverSpeed, 1, ("joint2", "rad/s")),
    "lease_ended": (events.LeaseExpired, -1, ()),
    "enabling_switch": (events.PermissionWithdrawn, -1, ("enabling switch",)),
}
"""For each key of `stops` one of its events, in motion at full speed."""
ENDS = ("lease_ended", "enabling_switch")
"""Keys after whose controlled stop the arm takes commands again."""


def stop_case(key: str, reaction: str) -> Case:
    (kind, place, says), (cause, clear) = STOPS[key], CAUSES[key]
    ends_in = State.EMERGENCY_STOP if key in ("emergency_stop", "supervision") else State.FAULT
    if key in ENDS and reaction == "controlled_stop":
        ends_in = State.HOLDING
    elif ends_in is State.FAULT:
        says = (*says, "`rtcp reset`")
    says = (*says, reaction.replace("_", " "), f"(stops.{key} in assistive_arm.yaml)")
    return Case(
        f"{key}, {reaction}", kind, place, says, lambda rig: cause(rig.set_in_motion()), clear, reaction, ends_in,
        {"clock_lost": 1.0, "lost_frames": LOST_CYCLES * PERIOD_S}.get(key), {key: reaction},
    )  # fmt: skip


CASES = (*FAULTS, *(stop_case(key, reaction) for key, reactions in REACTIONS.items() for reaction in reactions))


def test_every_fault_and_every_key_has_a_case() -> None:
    own = {kind for kind in events.Event.kinds if kind.__module__ == "rtcp.ipc.events"}
    faults = {kind for kind in own if kind.is_fault and not kind.is_emergency}
    # A reset without frames: test_clock_lost.py; without a robot controller: tests/faults/egm.py; a process:
    # test_processes.py; a push towards a box: test_torque_in_boxes.py; a controller: test_wrong_plugins.py; a load in
    # CST: test_compliant_joints.py; positions and speed that disagree: test_measurements.py; an external
    # axis: test_external_axes.py.
    assert faults <= {case.kind for case in CASES} | {
        events.ResetWithoutFrames,
        events.ResetWithoutController,
        events.ProcessFailed,
        events.PushedNear,
        events.PushedNearPartner,
        events.ControllerRaised,
        events.TooHeavyForCst,
        events.VelocityDisagrees,
        events.AxisStillMoving,
        events.AxisNotReplaced,
        events.AxisModeLost,
    }
    assert set(REACTIONS) == {kind.stop_key for kind in own} - {""} == set(STOPS)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=[pytest.mark.interpreted] if case.kind is events.GeneratorFailed else [])
        for case in CASES
    ],
)
def test_an_event_is_reported_takes_its_reaction_and_stays_until_reset_and_enable(
    switch_rig: Callable[..., LoopRig], case: Case
) -> None:
    rig = switch_rig(**case.stops)
    case.cause(rig)
    took_s = rig.wait(lambda: case.kind in rig.kinds, 4.0)
    assert case.after_s is None or took_s == pytest.approx(case.after_s, abs=3 * PERIOD_S)
    at = len(rig.log) - 1

    # What is reported.
    number = rig.kinds.index(case.kind)
    event, message = rig.events[number].event, rig.messages[number]
    assert getattr(event, "axis", getattr(event, "slave", -1)) == case.place
    assert rig.machine.fault == (0 if case.ends_in is State.HOLDING else case.kind.number)
    words = [f"0x{drive.statusword:04X}" for drive in rig.log[at].drives]
    parts = [part.format(word=words[case.place]) if "{" in part else part for part in case.says]
    assert [part for part in parts if part not in message] == []
    assert "\n" not in message

    # What the drives are commanded in the cycle of the event.
    commanded = {drive.controlword for drive in rig.log[at].drives if drive.has_torque}
    assert commanded <= {CONTROLWORDS[case.reaction]}
    assert commanded or not case.stops

    # Where it ends, also when its cause is gone.
    rig.run(0.6)
    if case.stops and not {"lost_frames", "supervision"} & set(case.stops):
        off = case.reaction == "torque_off" or case.ends_in is State.EMERGENCY_STOP
        assert rig.powered[0] is not off
        assert abs(rig.models[0].mechanics.velocity) < 0.001
    case.clear(rig)
    rig.run(0.2)
    assert rig.state is case.ends_in
    ramp = 350 if case.reaction == "controlled_stop" else 0
    assert {cycle.state for cycle in rig.log[at + ramp :]} == {case.ends_in}

    # Recovery: nothing moves or is enabled before the next command.
    if case.ends_in is not State.HOLDING:
        rig.do(Reset())
        rig.bring_to(State.READY)
        rig.run(0.1)
    sent = [drive for cycle in rig.log[at + ramp :] for drive in cycle.drives]
    assert (ENABLE_OPERATION in {drive.controlword for drive in sent}) is (case.ends_in is State.HOLDING)
    if case.ends_in is State.HOLDING:
        assert len({cycle.drives[0].target for cycle in rig.log[at + ramp :]}) == 1
    else:
        assert {(drive.speed, drive.effort) for drive in sent} == {(0, 0)}
        rig.enable()
        rig.wait(lambda: not rig.machine.changing_mode)
    target = [drive.position - 0.1 for drive in rig.arm.drives]
    rig.move(*target)
    rig.run(0.1)
    assert rig.state is State.MOVING
    assert [rig.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]
    # An arm that its reaction stopped has not moved since the fault.
    assert events.MovedSinceFault not in rig.kinds or not case.stops
