"""A gripper with a drive of its own through the whole loop, in simulated time: lease, stops, supervision."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, TypeVar

import pytest

from rtcp.config import default_config, load, load_segment, segment_path
from rtcp.config.model import (
    ArmConfig,
    FeedForwardConfig,
    GripperConfig,
    InputConfig,
    Joint,
    PdoEntry,
    Range,
    SlaveConfig,
)
from rtcp.config.segment import SegmentSlave
from rtcp.control.gripper import DrivenGripper
from rtcp.devices.cia402 import Cia402Drive
from rtcp.ipc import events
from rtcp.ipc.commands import Command, Disable, Enable, Halt, Home, MoveGripper, Reset, SetZero, Shutdown
from rtcp.ipc.events import Event
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import GripperDisabled, NoLease, NotPermitted
from rtcp.ipc.states import State
from rtcp.motion.controllers.gripper import GripperMotion
from rtcp.motion.guards.output_limiter import BACK_RAD_S
from rtcp.testing.simulation import Frame, Simulation
from rtcp.virtual.models import CubemarsDrive

SHIPPED = load(default_config())
PERIOD_S = 0.002
FINGER = Joint("finger", "drive7", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=3.0)
OPEN, CLOSED, START = 1.4, 0.0, 1.0
CONFIG = replace(
    SHIPPED,
    slaves=(*SHIPPED.slaves, SlaveConfig("drive7", SHIPPED.slaves[1].device)),
    cycle=replace(SHIPPED.cycle, period_us=PERIOD_S * 1e6),
    gripper=GripperConfig(joint=FINGER, open_position=OPEN, closed_position=CLOSED),
)
BENT = (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)
SLOT, AXIS = 7, 6
ENABLED = b"\x0f\x00"
EMERGENCY_STOP, ENABLING_SWITCH, TOGGLE = 1 << 9, 1 << 10, 1 << 8
NEUTRAL, BACKWARD, PADDLE_UP = 63, 61, 47

_Event = TypeVar("_Event", bound=Event)


class Hand(Simulation):
    """The arm, enabled, with its gripper at `START`; records its set-points and the outputs of its drive."""

    def __init__(self, config: ArmConfig = CONFIG, start: float = START) -> None:
        segment = load_segment(segment_path(SHIPPED))
        fingers = SegmentSlave("cubemars-orh40", options={"load_inertia": 0.02, "initial_position": start})
        segment = replace(segment, slaves=(*segment.slaves, fingers))
        super().__init__(config, positions=BENT, segment=segment, follow_clock=False)
        self.gripper = self.loop.machine.context.gripper
        model = self.bus.slaves[SLOT].device
        assert self.gripper is not None
        assert isinstance(model, CubemarsDrive)
        self.model = model
        self.setpoints: list[float] = []
        self.sent: list[bytes] = []
        self.object_at: float | None = None
        """Position of a hard object between the fingers, rad; None: there is none."""
        self.object_stiffness, self.object_damping = 2000.0, 20.0
        """Of the object, Nm/rad and Nm s/rad."""
        self.on_frame = self._see
        if config.inputs.enabling_switch is not None:
            self.inputs(put=ENABLING_SWITCH)
        self.hold()
        self.setpoints.clear()

    def _see(self, frame: Frame) -> None:
        self.setpoints.append(self.gripper.state.commanded[0])
        self.sent.append(frame.sent[SLOT])
        if self.object_at is not None:
            mechanics = self.model.mechanics
            inside = max(0.0, self.object_at - mechanics.position)
            damping = self.object_damping * mechanics.velocity if inside else 0.0
            mechanics.external_torque = self.object_stiffness * inside - damping

    @property
    def moving(self) -> bool:
        return self.gripper.motion.moving

    @property
    def controlwords(self) -> set[int]:
        """Controlwords of all drives."""
        return {drive.controlword for drive in self.loop.joints.drives if isinstance(drive, Cia402Drive)}

    @property
    def position(self) -> float:
        """True position of the fingers, rad."""
        return self.model.mechanics.position

    def reports_of(self, kind: type[_Event]) -> list[_Event]:
        return [record.event for record in self.events if isinstance(record.event, kind)]

    def message(self, kind: type[Event]) -> str:
        (event,) = self.reports_of(kind)
        return Names(CONFIG).message(event)

    def shut(self) -> None:
        self.do(MoveGripper(False))

    def open(self) -> None:
        self.do(MoveGripper(True))

    def on_its_way(self) -> None:
        self.shut()
        self.run(0.4)
        assert self.moving
        assert CLOSED + 0.2 < self.position < START - 0.05

    def rest(self, seconds: float = 5.0) -> None:
        assert self.until(lambda: not self.moving, seconds)
        self.run(0.1)

    def inputs(self, clear: int = 0, put: int = 0) -> None:
        assert self.box is not None
        self.box.inputs = self.box.inputs & ~clear | put


def kept_to_its_limits(path: list[float]) -> bool:
    """Whether all set-points keep to the joint's speed and acceleration."""
    speeds = [(b - a) / PERIOD_S for a, b in itertools.pairwise(path)]
    changes = [(b - a) / PERIOD_S for a, b in itertools.pairwise(speeds)]
    return max(map(abs, speeds)) <= FINGER.velocity * 1.0001 and max(map(abs, changes)) <= FINGER.acceleration * 1.01


@pytest.fixture
def with_hand() -> Iterator[Callable[..., Hand]]:
    with ExitStack() as stack:
        yield lambda *args, **kwargs: stack.enter_context(Hand(*args, **kwargs))


@pytest.fixture
def hand(with_hand: Callable[..., Hand]) -> Hand:
    return with_hand()


# -- opening and closing ----------------------------------------------------------------------------------------------


def test_it_closes_and_opens_under_the_lease_and_reports_each_time_where_it_rests(hand: Hand) -> None:
    hand.shut()
    hand.rest()
    assert hand.position == pytest.approx(CLOSED, abs=2e-3)
    hand.open()
    hand.rest()
    assert hand.position == pytest.approx(OPEN, abs=2e-3)
    reported = [(event.axis, event.position, event.holds) for event in hand.reports_of(events.GripperAtRest)]
    assert reported == [(AXIS, pytest.approx(CLOSED), False), (AXIS, pytest.approx(OPEN), False)]
    assert kept_to_its_limits(hand.setpoints)
    assert hand.state is State.HOLDING


def test_the_record_of_a_cycle_has_what_its_drive_measures_and_is_sent(hand: Hand) -> None:
    gripper, drive = hand.gripper, hand.gripper.drive
    drive.velocity, drive.torque, drive.target_position = 0.2, 0.3, 0.9
    values: list[Any] = ["before"] * gripper.at + [None] * len(gripper.fields) + ["behind"]
    gripper.publish(values)
    names = [field.name.removeprefix("gripper_") for field in gripper.fields]
    assert dict(zip(names, values[gripper.at : -1], strict=True)) == {
        "actual_position": drive.position, "actual_velocity": 0.2, "actual_torque": 0.3, "sent_position": 0.9,
        "drive_state": drive.state, "statusword": drive.statusword,
    }  # fmt: skip
    assert drive.statusword != 0
    assert {*values[: gripper.at]} <= {"before"}
    assert values[-1] == "behind"


def test_its_lost_commander_is_waited_for_from_the_loss_on_however_long_the_arm_has_held(
    with_hand: Callable[..., Hand],
) -> None:
    hand = with_hand(replace(CONFIG, stops=replace(CONFIG.stops, power_off_after_s=1.0)))
    hand.run(2.0)
    hand.on_its_way()
    hand.acquire()
    hand.run(0.9)
    assert hand.reports_of(events.LeaseExpired)
    assert hand.state is State.HOLDING
    assert hand.until(lambda: hand.state is State.DISABLING, 0.2)


def test_without_the_lease_it_does_not_begin(hand: Hand) -> None:
    assert hand.send(MoveGripper(False), lease=hand.lease + 1).refusal == NoLease()
    hand.run(0.2)
    assert max(abs(position - START) for position in hand.setpoints) < 1e-4


def test_where_it_already_is_it_reports_so_all_the_same(with_hand: Callable[..., Hand]) -> None:
    hand = with_hand(start=OPEN)
    hand.open()
    hand.run(0.1)
    hand.open()
    hand.run(0.1)
    assert [event.position for event in hand.reports_of(events.GripperAtRest)] == [pytest.approx(OPEN, abs=2e-4)] * 2


def test_it_goes_on_and_ends_well_while_a_joint_homes(hand: Hand) -> None:
    # The search for the next index pulse lasts longer than the gripper's motion.
    hand.models[0].objects[0x6098, 0].value = 34
    hand.models[0].objects[0x6099, 2].value = 150
    hand.on_its_way()
    hand.do(Home(0))
    hand.rest()
    assert hand.state is State.HOMING
    assert hand.position == pytest.approx(CLOSED, abs=2e-3)
    assert [event.position for event in hand.reports_of(events.GripperAtRest)] == [pytest.approx(CLOSED)]
    hand.bring_to(State.HOLDING)
    assert hand.reports_of(events.Homed)
    assert kept_to_its_limits(hand.setpoints)


def test_a_stiff_object_that_stops_the_fingers_at_once_is_gripped(hand: Hand) -> None:
    hand.object_at, hand.object_stiffness, hand.object_damping = 0.5, 20000.0, 60.0
    hand.shut()
    hand.rest()
    assert hand.state is State.HOLDING
    assert [rest.holds for rest in hand.reports_of(events.GripperAtRest)] == [True]


def test_what_it_grips_ends_its_way_and_is_no_emergency(hand: Hand) -> None:
    hand.object_at = 0.5
    hand.shut()
    hand.rest()
    hand.run(2.0)
    assert hand.state is State.HOLDING
    (rest,) = hand.reports_of(events.GripperAtRest)
    assert (rest.position, rest.holds) == (pytest.approx(0.5, abs=0.05), True)
    assert hand.message(events.GripperAtRest) == f"finger rests at {rest.position:.6g} rad"
    assert 0.5 * FINGER.torque < abs(hand.gripper.drive.torque) < 1.2 * FINGER.torque
    assert kept_to_its_limits(hand.setpoints[: hand.setpoints.index(rest.position)])
    hand.open()
    hand.rest()
    assert hand.position == pytest.approx(OPEN, abs=2e-3)
    assert hand.state is State.HOLDING


# -- controlled stops -------------------------------------------------------------------------------------------------


def stopped_on_its_way(hand: Hand) -> None:
    """Assert that it stopped within its limits before its target, reported this once, and stays."""
    (rest,) = hand.reports_of(events.GripperAtRest)
    assert CLOSED + 0.1 < rest.position < START - 0.05
    assert not rest.holds
    assert kept_to_its_limits(hand.setpoints)
    hand.setpoints.clear()
    hand.run(1.0)
    assert set(hand.setpoints) == {rest.position}
    assert hand.position == pytest.approx(rest.position, abs=2e-3)


def hold_switch(hand: Hand) -> None:
    hand.inputs(clear=ENABLING_SWITCH)
    hand.run(0.05)
    assert hand.send(MoveGripper(False)).refusal == NotPermitted()
    hand.inputs(put=ENABLING_SWITCH)
    hand.run(0.05)


def nothing(hand: Hand) -> None:
    """There is nothing to prepare, or to undo."""


WITH_SWITCH = replace(CONFIG, inputs=replace(CONFIG.inputs, enabling_switch=InputConfig(11)))
STOPS: dict[str, tuple[Callable[[Hand], object], Callable[[Hand], object], Callable[[Hand], object]]] = {
    "halt": (nothing, lambda hand: hand.send(Halt()), nothing),
    "another holds the lease": (nothing, lambda hand: hand.acquire(), nothing),
    "the lease is not renewed": (lambda hand: hand.fall_silent(), nothing, nothing),
    "the enabling switch is released": (
        hold_switch,
        lambda hand: hand.inputs(clear=ENABLING_SWITCH),
        lambda hand: hand.inputs(put=ENABLING_SWITCH),
    ),
}
"""Preparation, cause of the stop, and what undoes the cause."""


@pytest.mark.parametrize("stop", STOPS)
def test_it_stops_and_stays(with_hand: Callable[..., Hand], stop: str) -> None:
    hand = with_hand(WITH_SWITCH if "switch" in stop else CONFIG)
    prepare, cause, undo = STOPS[stop]
    prepare(hand)
    hand.on_its_way()
    cause(hand)
    hand.rest()
    undo(hand)
    stopped_on_its_way(hand)
    assert hand.state is State.HOLDING


def test_where_a_lost_commander_means_a_quick_stop_it_ends_in_a_fault_with_the_arm(
    with_hand: Callable[..., Hand],
) -> None:
    hand = with_hand(replace(CONFIG, stops=replace(CONFIG.stops, lease_ended="quick_stop")))
    hand.on_its_way()
    hand.acquire()
    hand.bring_to(State.FAULT)
    hand.run(0.2)
    assert len(hand.reports_of(events.LeaseExpired)) == 1
    assert not hand.moving
    assert abs(hand.model.mechanics.velocity) < 0.01
    assert hand.controlwords == {0x0002}


def test_it_stops_while_a_joint_homes_when_its_commander_falls_silent(hand: Hand) -> None:
    hand.models[0].objects[0x6098, 0].value = 34
    hand.models[0].objects[0x6099, 2].value = 1
    hand.on_its_way()
    hand.do(Home(0))
    hand.run(0.1)
    hand.acquire()
    hand.run(0.02)
    assert hand.state is State.HOMING
    before, now = (hand.setpoints[at] - hand.setpoints[at + 1] for at in (-10, -2))
    assert now < 0.999 * before
    hand.rest()
    stopped_on_its_way(hand)


def test_a_halt_before_its_first_step_is_a_halt_too(hand: Hand) -> None:
    hand.data.lose(5, heard=True)
    hand.shut()
    hand.do(Halt())
    hand.run(0.5)
    assert max(abs(position - START) for position in hand.setpoints) < 1e-4
    assert [event.position for event in hand.reports_of(events.GripperAtRest)] == [pytest.approx(START, abs=1e-4)]


@pytest.fixture
def by_joystick(with_hand: Callable[..., Hand]) -> Hand:
    """The joystick closes it; nobody holds a lease."""
    hand = with_hand(replace(CONFIG, control_mode="joystick"))
    hand.lease = 0
    for code in [PADDLE_UP, NEUTRAL] * 3:
        hand.inputs(clear=0x3F, put=code)
        hand.run(0.05)
    hand.inputs(clear=0x3F, put=BACKWARD)
    hand.run(0.4)
    assert hand.moving
    return hand


def test_the_joystick_closes_it_without_a_lease(by_joystick: Hand) -> None:
    by_joystick.rest()
    assert by_joystick.position == pytest.approx(CLOSED, abs=2e-3)


@pytest.mark.parametrize(
    ("clear", "code"),
    [(0x3F, NEUTRAL), (0x3F, 0), (0x3F, 1), (0x3F, PADDLE_UP), (TOGGLE, 0)],
    ids=["released", "no code", "another", "paddle", "given to the chair"],
)
def test_it_stops_when_the_joystick_no_longer_closes_it(by_joystick: Hand, clear: int, code: int) -> None:
    by_joystick.inputs(clear=clear, put=code)
    by_joystick.rest()
    by_joystick.inputs(put=TOGGLE)
    stopped_on_its_way(by_joystick)


@pytest.mark.parametrize("command", [Disable, Shutdown])
def test_its_set_point_comes_to_rest_before_its_torque_goes(hand: Hand, command: type[Command]) -> None:
    hand.on_its_way()
    hand.setpoints.clear()
    hand.sent.clear()
    hand.send(command())
    assert hand.until(lambda: hand.state is State.READY or hand.done, 10.0)
    off = next(at for at, sent in enumerate(hand.sent) if sent[:2] != ENABLED)
    assert off > 10
    assert hand.sent[off - 1][2:6] == hand.sent[off - 2][2:6]
    (rest,) = hand.reports_of(events.GripperAtRest)
    assert CLOSED + 0.1 < rest.position < START - 0.05
    assert not hand.model.powered
    assert kept_to_its_limits(hand.setpoints[:off])


# -- faults and emergencies -------------------------------------------------------------------------------------------


def goes_nowhere_by_itself(hand: Hand) -> None:
    """Assert that it reported no rest, and that it stays where it is after reset and enable."""
    assert not hand.moving
    assert hand.reports_of(events.GripperAtRest) == []
    hand.do(Reset())
    hand.bring_to(State.READY)
    here = hand.position
    hand.hold()
    hand.run(1.0)
    assert hand.position == pytest.approx(here, abs=2e-3)


@pytest.mark.parametrize("own", [True, False])
def test_a_fault_of_any_drive_stops_it_and_the_arm(hand: Hand, own: bool) -> None:
    hand.on_its_way()
    (hand.model if own else hand.models[2]).inject_fault(0x7305)
    hand.bring_to(State.FAULT)
    assert hand.message(events.DriveFault).startswith(f"{'finger' if own else 'joint3'}: the drive is in fault")
    hand.run(1.0)
    assert abs(hand.model.mechanics.velocity) < 1e-3 or own
    assert hand.position > CLOSED + 0.1 or own
    goes_nowhere_by_itself(hand)


def test_the_emergency_stop_stops_it(hand: Hand) -> None:
    hand.on_its_way()
    hand.inputs(clear=EMERGENCY_STOP)
    hand.bring_to(State.EMERGENCY_STOP)
    hand.run(1.5)
    assert not hand.model.powered
    assert hand.position > CLOSED + 0.1
    hand.inputs(put=EMERGENCY_STOP)
    hand.run(0.1)
    goes_nowhere_by_itself(hand)


@pytest.mark.parametrize("holds", [False, True])
def test_its_following_error_is_supervised_but_not_that_of_what_it_holds(hand: Hand, holds: bool) -> None:
    if holds:
        hand.object_at = 0.5
        hand.shut()
        hand.rest()
        hand.object_at = None
    # Just more than the drive can hold: it yields slowly.
    hand.model.mechanics.external_torque = 19.6
    beyond = 0
    while hand.state is State.HOLDING and beyond < 2 * CONFIG.supervision.cycles:
        hand.cycle()
        error = hand.gripper.drive.position - hand.gripper.state.commanded[0]
        beyond += abs(error) > CONFIG.supervision.following_error
    if holds:
        assert hand.state is State.HOLDING
    else:
        assert (hand.state, beyond) == (State.EMERGENCY_STOP, CONFIG.supervision.cycles)
        assert hand.message(events.FollowingError).startswith("finger")


def test_too_fast_while_the_loop_closes_it_is_stopped_by_the_drives(hand: Hand) -> None:
    hand.on_its_way()
    hand.send(Shutdown())
    # The loop notices it before the limit inside the drive.
    hand.model.mechanics.external_torque = -22.0
    assert hand.until(lambda: bool(hand.reports_of(events.OverSpeed)), 1.0)
    hand.run(0.01)
    assert hand.controlwords == {0x0002}


def disabled(hand: Hand) -> Hand:
    hand.do(Disable())
    hand.bring_to(State.READY)
    return hand


def test_disabled_it_is_not_to_be_moved(hand: Hand) -> None:
    assert disabled(hand).send(MoveGripper(False)).refusal == GripperDisabled()


def test_that_it_says_to_be_elsewhere_while_it_is_being_enabled_is_a_fault_that_names_its_joint(hand: Hand) -> None:
    disabled(hand)
    hand.do(Enable())
    hand.model.mechanics.position += 0.1
    hand.bring_to(State.FAULT)
    assert hand.message(events.PositionJumped).startswith("finger jumped from 1 to")


def test_outside_its_range_it_returns_to_the_edge_gently_while_it_is_enabled(
    with_hand: Callable[..., Hand],
) -> None:
    hand = with_hand(start=1.515)
    assert [event.axis for event in hand.reports_of(events.ReturningToRange)] == [AXIS]
    targets = [int.from_bytes(sent[2:6], "little", signed=True) for sent in hand.sent if sent[:2] == ENABLED]
    assert (targets[0], targets[-1]) == (pytest.approx(15150, abs=2), 15000)
    assert max(abs(b - a) for a, b in itertools.pairwise(targets)) <= BACK_RAD_S * PERIOD_S * 1e4 + 1


def test_further_outside_it_is_not_enabled(hand: Hand) -> None:
    disabled(hand).model.mechanics.position = 1.53
    hand.run(0.1)
    refusal = hand.send(Enable()).refusal
    assert refusal is not None
    assert Names(CONFIG).message(refusal).startswith("finger stands at 1.53 rad")


def test_it_counts_from_its_own_zero_offset(with_hand: Callable[..., Hand]) -> None:
    hand = with_hand(replace(CONFIG, zero_offsets=(*[0.0] * 6, 0.25)))
    hand.shut()
    hand.rest()
    assert hand.position == pytest.approx(0.25, abs=2e-3)


def test_its_zero_is_set_and_the_loop_says_where_it_stands_then(hand: Hand) -> None:
    disabled(hand)
    zero = hand.gripper.drive.zero
    hand.do(SetZero(AXIS, zero + START - 0.2))
    event = hand.reports_of(events.ZeroSet)[-1]
    assert (event.axis, event.position) == (AXIS, pytest.approx(0.2, abs=2e-3))
    hand.run(0.1)
    assert hand.gripper.drive.position == pytest.approx(0.2, abs=2e-3)


def test_feed_forward_of_the_arm_leaves_an_offset_of_the_grippers_drive_as_it_is() -> None:
    device = CONFIG.slaves[-1].device
    first, *others = device.rpdo
    offset = PdoEntry(0x60B2, 0, "int16", "torque_offset", safe=3.0)
    device = replace(device, rpdo=(replace(first, channels=(*first.channels, offset)), *others))
    slaves = (*CONFIG.slaves[:-1], replace(CONFIG.slaves[-1], device=device))
    config = replace(CONFIG, slaves=slaves, feed_forward=FeedForwardConfig(gravity=1.0), joints=(FINGER,))
    drive = DrivenGripper(config, GripperMotion(FINGER, OPEN, CLOSED, PERIOD_S), AXIS).drive
    assert drive.encode()[-2:] == b"\x03\x00"
