"""The limits of the joints inside the drives: written at the start, read back, kept by the drives themselves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.config.drive_limits import BEYOND_RANGE_RAD, BEYOND_SUPERVISION, joint_limits, with_limits
from rtcp.config.model import AbsoluteLimits, AbsoluteSupervision, ArmConfig, LimitObject, PdoEntry, Range
from rtcp.control.joint_group import RANGE_MARGIN_RAD
from rtcp.fieldbus.errors import SdoAborted, ValueNotKept
from rtcp.ipc import commands
from rtcp.ipc.states import State
from rtcp.testing import Simulation
from rtcp.virtual.models.cubemars import CubemarsDrive

CONFIG = replace(load(default_config()), zero_offsets=(0.0, 0.25, 0.0, 0.0, -0.5, 0.0))
COUNTS = 1e4
START = (0.0, 0.2, 1.2, 0.0, 0.4, 0.0)


@pytest.fixture
def arm() -> Iterator[Simulation]:
    cycle = replace(CONFIG.cycle, period_us=2000.0)
    with Simulation(replace(CONFIG, cycle=cycle), positions=START) as made:
        made.bring_to(State.READY)
        yield made


def held(model: CubemarsDrive) -> tuple[float, float, float, float]:
    """Lower and upper end, speed and torque limit of a drive."""
    places = ((0x607D, 1), (0x607D, 2), (0x6080, 0), (0x6072, 0))
    low, high, speed, torque = (int(model.objects[place].value) / COUNTS for place in places)
    return low, high, speed, torque


def test_each_drive_holds_the_limits_of_its_joint_by_its_own_zero(arm: Simulation) -> None:
    for model, joint, zero in zip(arm.models, CONFIG.joints, CONFIG.zero_offsets, strict=True):
        speed = joint.velocity * CONFIG.supervision.speed * BEYOND_SUPERVISION
        low, high = joint.position.min - BEYOND_RANGE_RAD + zero, joint.position.max + BEYOND_RANGE_RAD + zero
        assert held(model) == pytest.approx((low, high, speed, joint.drive_torque), abs=1e-4)


def test_the_drives_limits_lie_beyond_what_the_platform_itself_allows() -> None:
    assert BEYOND_RANGE_RAD > RANGE_MARGIN_RAD
    assert BEYOND_SUPERVISION > 1.0


@pytest.mark.interpreted
def test_a_target_beyond_the_range_that_reaches_a_drive_is_not_followed_beyond_its_limit(arm: Simulation) -> None:
    arm.hold()
    joint, model = CONFIG.joints[5], arm.models[5]
    drive = arm.loop.arm.drives[5]
    fields = drive._fields  # type: ignore[attr-defined]
    encode = drive.encode

    def wrong() -> bytes:
        """A defect behind every check of this program: a target far outside the range."""
        encode()
        fields[drive._position_slot] = round(4.0 * COUNTS)  # type: ignore[attr-defined]
        return bytes(drive._pack(*fields))  # type: ignore[attr-defined]

    drive.encode = wrong  # type: ignore[method-assign]
    arm.run(0.02)
    assert int(model.objects[0x607A, 0].value) == round(4.0 * COUNTS)
    for _ in range(20):
        # Without the master's supervision, which would stop the arm long before.
        model.step(0.5)
    assert model.axis.position == pytest.approx(joint.position.max + BEYOND_RANGE_RAD, abs=1e-3)


def test_a_drive_that_lacks_an_object_is_named_once_and_goes_on(arm: Simulation) -> None:
    del arm.models[2].objects._objects[0x6080]
    notes = arm.bus.set_up(4)
    assert [note for note in notes if "0x6080" in note] == [
        "slave 4 (drive3) has no 0x6080:0 (velocity of joint3); it is marked optional and was left out"
    ]
    assert held_position(arm.models[2]) == pytest.approx(
        (CONFIG.joints[2].position.min - BEYOND_RANGE_RAD, CONFIG.joints[2].position.max + BEYOND_RANGE_RAD)
    )


def held_position(model: CubemarsDrive) -> tuple[float, float]:
    low, high = (int(model.objects[0x607D, end].value) / COUNTS for end in (1, 2))
    return low, high


def test_a_drive_that_keeps_another_value_is_refused_with_both(arm: Simulation) -> None:
    entry = arm.models[2].objects[0x6072, 0]
    entry.on_read = lambda read: setattr(read, "value", 370_000)
    with pytest.raises(ValueNotKept) as refused:
        arm.bus.set_up(4)
    error = refused.value
    assert (error.index, error.sub_index, error.wanted, error.found) == (0x6072, 0, "500000", "370000")
    assert "slave 4 (drive3): 0x6072:0 (torque of joint3) was set to 500000" in str(error)


def test_a_limit_beyond_what_the_drive_allows_is_refused(arm: Simulation) -> None:
    arm.models[2].objects[0x6072, 0].maximum = 370_000
    with pytest.raises(SdoAborted) as refused:
        arm.bus.set_up(4)
    assert "0x6072" in str(refused.value)


def test_a_drive_that_comes_back_after_a_new_zero_gets_the_limits_of_that_zero(arm: Simulation) -> None:
    slave = arm.bus.slaves[2]
    arm.bus.note_written(3, 0x607D, 2, round(2.5 * COUNTS).to_bytes(4, "little", signed=True))
    arm.bus.set_up(3)
    assert slave.name == "drive2"
    assert held_position(arm.models[1])[1] == 2.5


def test_a_drive_that_turns_the_other_way_gets_its_ends_exchanged_and_its_own_counts() -> None:
    slave, joint = CONFIG.slaves[1], replace(CONFIG.joints[0], drive_torque=None)
    entries = (
        LimitObject(0x607D, 1, "int32", "position_min"),
        LimitObject(0x607D, 2, "int32", "position_max"),
        LimitObject(0x6080, 0, "uint16", "velocity", factor=-1e-3),
        LimitObject(0x6072, 0, "uint16", "torque"),
    )
    backwards = PdoEntry(0x607A, 0, "int32", "target_position", -1e-3)
    pdo = replace(slave.device.rpdo[0], channels=(backwards,))
    device = replace(slave.device, rpdo=(pdo,), tpdo=(), limits=entries)
    joint = replace(joint, position=replace(joint.position, min=-1.0, max=2.0))
    sdos = list(joint_limits(CONFIG, replace(slave, device=device), joint, 0.5))
    speed = joint.velocity * CONFIG.supervision.speed * BEYOND_SUPERVISION
    assert [(sdo.index, sdo.sub_index, sdo.value) for sdo in sdos] == [
        (0x607D, 1, -2550.0), (0x607D, 2, 550.0), (0x6080, 0, round(speed * 1e3)),
    ]  # fmt: skip


def test_the_drives_limits_leave_room_for_what_absolute_allows_while_the_platform_runs() -> None:
    joint, supervision = CONFIG.joints[0], CONFIG.supervision
    wide = AbsoluteLimits(position=Range(joint.position.min - 0.5, joint.position.max + 0.5), velocity=0.9)
    config = replace(CONFIG, supervision=replace(supervision, absolute=AbsoluteSupervision(speed=2.0)))
    sdos = {
        (sdo.index, sdo.sub_index): sdo.value
        for sdo in joint_limits(config, CONFIG.slaves[1], replace(joint, absolute=wide), 0.0)
    }
    assert sdos[0x607D, 1] == round((joint.position.min - 0.5 - BEYOND_RANGE_RAD) * COUNTS)
    assert sdos[0x607D, 2] == round((joint.position.max + 0.5 + BEYOND_RANGE_RAD) * COUNTS)
    assert sdos[0x6080, 0] == round(0.9 * 2.0 * BEYOND_SUPERVISION * COUNTS)


def test_slaves_that_move_no_joint_get_no_limits() -> None:
    config: ArmConfig = replace(CONFIG, joints=CONFIG.joints[:2], zero_offsets=())
    assert [bool(slave.limits) for slave in with_limits(config)] == [False, True, True, False, False, False, False]


def test_the_arm_moves_to_the_ends_of_its_range_under_the_limits_of_its_drives(arm: Simulation) -> None:
    arm.hold()
    joint = CONFIG.joints[5]
    arm.do(commands.MoveJoints((*START[:5], joint.position.max), joint.velocity, True))
    assert arm.until(lambda: arm.state is State.HOLDING, 20.0)
    assert arm.loop.arm.state.actual[5] == pytest.approx(joint.position.max, abs=0.002)
