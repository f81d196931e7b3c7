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


class GripperRig:
    """The gripper and its drive."""

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

    def enabled(self) -> GripperRig:
        self.goal = TargetState.ENABLED
        self.run(0.1)
        assert self.gripper.enabled
        return self


def test_a_gripper_on_an_output_has_no_drive() -> None:
    assert make_gripper(ARM) is None
    assert make_gripper(replace(ARM, gripper=None)) is None


def test_enabling_moves_nothing() -> None:
    rig = GripperRig(position=0.7).enabled()
    assert max(abs(position - 0.7) for position in rig.run(0.5)) < 1e-3


def test_it_counts_from_its_own_zero_offset() -> None:
    rig = GripperRig(replace(DRIVEN, zero_offsets=(*[9.0] * 6, 0.25))).enabled()
    rig.gripper.grip(True)
    rig.run(3.0)
    assert rig.model.mechanics.position == pytest.approx(0.25, abs=2e-3)


def test_it_takes_no_order_without_torque() -> None:
    rig = GripperRig(position=0.7)
    assert not rig.gripper.grip(True)
    rig.enabled()
    assert rig.run(0.5)[-1] == pytest.approx(0.7, abs=1e-3)


def test_enabled_out_of_a_quick_stop_it_stands_where_it_came_to_rest() -> None:
    rig = GripperRig().enabled()
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
    rig = GripperRig().enabled()
    rig.gripper.grip(True)
    rig.run(0.5)
    rig.gripper.track_actual()
    assert not rig.gripper.motion.moving


@pytest.mark.parametrize(
    ("position", "outside"), [(-0.11, False), (-0.13, True), (1.51, False), (1.53, True), (0.5, False)]
)
def test_outside_its_range_it_is_not_to_be_enabled(position: float, outside: bool) -> None:
    rig = GripperRig(position=position)
    assert rig.gripper.outside is outside
    assert rig.gripper.drive.target_position == min(max(rig.gripper.drive.position, -0.1), 1.5)


BEYOND = [(kind, sign * wrong) for kind, wrong in ((FollowingError, 0.16), (OverSpeed, 1.51)) for sign in (1, -1, nan)]
LIMITS = {FollowingError: DRIVEN.supervision.following_error, OverSpeed: 1.5 * FINGER.velocity}


@pytest.mark.parametrize(("kind", "wrong"), BEYOND)
def test_what_is_beyond_a_limit_for_too_long_is_found_but_no_distance_of_what_it_holds(
    kind: type[FollowingError] | type[OverSpeed], wrong: float
) -> None:
    gripper = make_gripper(DRIVEN)
    assert gripper is not None
    gripper.motion.latch(0.5)
    gripper.drive.position = 0.5 + (wrong if kind is FollowingError else 0.0)
    gripper.drive.velocity = wrong if kind is OverSpeed else 0.0
    gripper.motion.gripped = True
    if kind is FollowingError:
        assert [gripper.beyond_limits() for _ in range(100)] == [None] * 100
        gripper.motion.gripped = False
    *before, found = [gripper.beyond_limits() for _ in range(DRIVEN.supervision.cycles)]
    assert before == [None] * (DRIVEN.supervision.cycles - 1)
    assert found is not None
    assert (type(found), found.axis, found.limit) == (kind, 6, LIMITS[kind])
