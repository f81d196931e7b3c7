"""A gripper with a drive in the cycle: the driver, its motion and the model of its drive."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, GripperConfig, Joint, Range, SlaveConfig
from rtcp.control.gripper import DrivenGripper, make_gripper
from rtcp.devices.cia402 import DriveState, TargetState
from rtcp.ipc.events import FollowingError, OverSpeed
from rtcp.virtual.models.cubemars import CubemarsOrh40
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage

ARM = load(default_config())
FINGER = Joint("finger", "drive7", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=3.0)
DRIVEN = replace(
    ARM,
    slaves=(*ARM.slaves, SlaveConfig("drive7", ARM.slaves[1].device)),
    gripper=GripperConfig(joint=FINGER, open_position=1.4, closed_position=0.0),
)
DT = ARM.cycle.period_us * 1e-6


class LoopRig:
    """The gripper and its drive; between its fingers may lie something hard."""

    def __init__(self, config: ArmConfig = DRIVEN, position: float = 1.0) -> None:
        gripper = make_gripper(config)
        assert gripper is not None
        self.gripper: DrivenGripper = gripper
        self.model = CubemarsOrh40(load_inertia=0.02, initial_position=position)
        self.model.set_outputs_valid(True)
        self.model.step(0.2)
        # As the drive's description has it: 0.2 rad for 50 ms are a fault.
        self.model.objects[0x6065, 0].value = 2000
        self._rx = PdoImage.from_assignment(self.model.objects, RX_ASSIGN)
        self._tx = PdoImage.from_assignment(self.model.objects, TX_ASSIGN)
        self._outputs = bytes(self._rx.byte_length)
        self.goal = TargetState.DISABLED
        self.object_at: float | None = None
        self.run(0.02)

    def input(self, index: int) -> bytes:
        assert index == 7
        data = bytearray(self._tx.byte_length)
        self._tx.pack(data)
        return bytes(data)

    def set_output(self, index: int, data: bytes) -> None:
        assert index == 7
        self._outputs = data

    def run(self, seconds: float) -> list[float]:
        """Let time pass as the loop does; return the joint's positions."""
        gripper, mechanics, path = self.gripper, self.model.mechanics, []
        for _ in range(round(seconds / DT)):
            self._rx.unpack(self._outputs)
            inside = 0.0 if self.object_at is None else max(0.0, self.object_at - mechanics.position)
            mechanics.external_torque = 2000.0 * inside - (5.0 * mechanics.velocity if inside else 0.0)
            self.model.step(DT)
            gripper.decode(self)
            gripper.drive.advance(self.goal)
            if gripper.enabled:
                gripper.command()
            else:
                gripper.track_actual()
            gripper.encode(self)
            path.append(mechanics.position)
        return path

    def enabled(self) -> LoopRig:
        self.goal = TargetState.ENABLED
        self.run(0.1)
        assert self.gripper.enabled
        return self


def test_a_gripper_on_an_output_has_no_drive() -> None:
    assert make_gripper(ARM) is None
    assert make_gripper(replace(ARM, gripper=None)) is None


def test_enabling_moves_nothing() -> None:
    rig = LoopRig(position=0.7).enabled()
    assert max(abs(position - 0.7) for position in rig.run(0.5)) < 1e-3


@pytest.mark.parametrize(("close", "goal"), [(True, 0.0), (False, 1.4)])
def test_it_closes_and_opens(close: bool, goal: float) -> None:
    rig = LoopRig().enabled()
    assert rig.gripper.grip(close)
    rig.run(3.0)
    assert rig.model.mechanics.position == pytest.approx(goal, abs=2e-3)


def test_it_counts_from_its_own_zero_offset() -> None:
    rig = LoopRig(replace(DRIVEN, zero_offsets=(*[9.0] * 6, 0.25))).enabled()
    rig.gripper.grip(True)
    rig.run(3.0)
    assert rig.model.mechanics.position == pytest.approx(0.25, abs=2e-3)


def test_it_holds_what_is_hard_without_a_fault_and_lets_go() -> None:
    rig = LoopRig().enabled()
    rig.object_at = 0.5
    rig.gripper.grip(True)
    rig.run(5.0)
    assert rig.gripper.motion.gripped
    assert rig.gripper.enabled
    assert rig.model.mechanics.position == pytest.approx(0.5, abs=0.01)
    held = abs(rig.gripper.drive.torque)
    assert FINGER.torque * 0.5 < held < FINGER.torque * 3
    rig.gripper.grip(False)
    rig.run(3.0)
    assert rig.model.mechanics.position == pytest.approx(1.4, abs=2e-3)


def test_it_takes_no_order_without_torque() -> None:
    rig = LoopRig(position=0.7)
    assert not rig.gripper.grip(True)
    rig.enabled()
    assert rig.run(0.5)[-1] == pytest.approx(0.7, abs=1e-3)


def test_a_stop_on_its_way_holds_it_there() -> None:
    rig = LoopRig().enabled()
    rig.gripper.grip(True)
    rig.run(0.5)
    rig.gripper.stop()
    rig.run(0.5)
    here = rig.model.mechanics.position
    assert 0.1 < here < 0.9
    assert rig.run(0.5)[-1] == pytest.approx(here, abs=1e-3)


def test_after_a_fault_on_its_way_it_goes_nowhere_by_itself() -> None:
    rig = LoopRig().enabled()
    rig.gripper.grip(True)
    rig.run(0.5)
    rig.model.inject_fault(0x7305)
    rig.goal = TargetState.QUICK_STOPPED
    rig.run(0.5)
    assert rig.gripper.drive.state is DriveState.FAULT
    here = rig.model.mechanics.position
    rig.goal = TargetState.RESET
    rig.run(0.2)
    rig.enabled()
    assert rig.run(0.5)[-1] == pytest.approx(here, abs=2e-3)


def test_enabled_out_of_a_quick_stop_it_stands_where_it_came_to_rest() -> None:
    rig = LoopRig().enabled()
    rig.model.objects[0x605A, 0].value = 6
    rig.gripper.grip(True)
    rig.run(0.5)
    rig.goal = TargetState.QUICK_STOPPED
    rig.run(0.5)
    assert rig.gripper.drive.state is DriveState.QUICK_STOP_ACTIVE
    here = rig.model.mechanics.position
    rig.enabled()
    path = rig.run(0.5)
    assert max(abs(position - here) for position in path) < 2e-3


def test_a_joint_that_is_enabled_while_others_are_not_rests() -> None:
    rig = LoopRig().enabled()
    rig.gripper.grip(True)
    rig.run(0.5)
    rig.gripper.track_actual()
    assert not rig.gripper.motion.moving


@pytest.mark.parametrize(
    ("position", "outside"), [(-0.11, False), (-0.13, True), (1.51, False), (1.53, True), (0.5, False)]
)
def test_outside_its_range_it_is_not_to_be_enabled(position: float, outside: bool) -> None:
    rig = LoopRig(position=position)
    assert rig.gripper.outside is outside
    assert rig.gripper.drive.target_position == min(max(rig.gripper.drive.position, -0.1), 1.5)


@pytest.mark.parametrize("wrong", [0.16, -0.16, nan])
def test_how_far_it_is_from_its_set_point_counts_but_for_what_it_holds(wrong: float) -> None:
    gripper = make_gripper(DRIVEN)
    assert gripper is not None
    gripper.motion.latch(0.5)
    gripper.drive.position = 0.5 + wrong
    gripper.motion.gripped = True
    assert [gripper.beyond_limits() for _ in range(100)] == [None] * 100
    gripper.motion.gripped = False
    *before, found = [gripper.beyond_limits() for _ in range(DRIVEN.supervision.cycles)]
    assert before == [None] * (DRIVEN.supervision.cycles - 1)
    assert found is not None
    assert (type(found), found.axis, found.limit) == (FollowingError, 6, DRIVEN.supervision.following_error)


@pytest.mark.parametrize("wrong", [1.51, -1.51, nan])
def test_a_speed_beyond_its_limit_counts_whatever_it_holds(wrong: float) -> None:
    gripper = make_gripper(DRIVEN)
    assert gripper is not None
    gripper.motion.gripped = True
    gripper.drive.velocity = wrong
    *before, found = [gripper.beyond_limits() for _ in range(DRIVEN.supervision.cycles)]
    assert before == [None] * (DRIVEN.supervision.cycles - 1)
    assert found is not None
    assert (type(found), found.axis, found.limit) == (OverSpeed, 6, 1.5 * FINGER.velocity)
    gripper.drive.velocity = 1.49
    assert gripper.beyond_limits() is None


def test_disabled_on_its_way_it_stands_and_stays_when_enabled_again() -> None:
    rig = LoopRig().enabled()
    rig.gripper.grip(True)
    rig.run(0.5)
    rig.goal = TargetState.DISABLED
    rig.run(1.0)
    here = rig.model.mechanics.position
    rig.enabled()
    assert rig.run(0.5)[-1] == pytest.approx(here, abs=2e-3)
