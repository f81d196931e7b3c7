"""The shipped files, optional keys and other spellings, and changes by commands at a start."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from kinematics.forward import frames
from rtcp.config import ConfigError, default_config, load, load_device, load_segment, segment_path, with_period
from rtcp.config.document import read
from rtcp.config.loader import widen, with_control_mode
from rtcp.config.model import (
    ArmConfig,
    Box,
    CartesianConfig,
    CycleConfig,
    EmergencyStopConfig,
    EthercatBus,
    GripperConfig,
    InputConfig,
    JogConfig,
    Joint,
    KeepOut,
    Kinematics,
    Range,
    StopsConfig,
    SupervisionConfig,
)
from rtcp.config.rules import shoulder_and_reach
from rtcp.config.validation import Checker, allowed, annotation
from rtcp.virtual.models import create
from tests.arm_geometry import box_gaps, own_gap, points
from tests.config.test_mistakes import ARM, BOX, DRIVE, ON_AN_OUTPUT, TORQUE, USER, driven


@pytest.fixture(scope="module")
def shipped() -> ArmConfig:
    return load(default_config())


def edited(*changes: tuple[str, str]) -> ArmConfig:
    """The arm after changes of its file in the working directory."""
    text = Path(ARM).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    Path(ARM).write_text(text)
    return load(Path(ARM))


def rewritten(data: Any) -> ArmConfig:
    Path(ARM).write_text(yaml.safe_dump(data))
    return load(Path(ARM))


# -- the shipped files -------------------------------------------------------------------------------------------------


def test_the_default_configuration_loads_whole(shipped: ArmConfig) -> None:
    assert [slave.name for slave in shipped.slaves] == ["io", *(f"drive{i}" for i in range(1, 7))]
    assert [joint.slave for joint in shipped.joints] == [f"drive{i}" for i in range(1, 7)]
    assert shipped.cycle.period_us == 500
    assert shipped.source == default_config()
    assert shipped.stops == StopsConfig()
    assert segment_path(shipped).is_file()
    with pytest.raises(dataclasses.FrozenInstanceError):
        shipped.joints[0].velocity = 3.0  # type: ignore[misc]


def test_the_drive_is_described_as_the_facts_say(shipped: ArmConfig) -> None:
    drive = shipped.slaves[1].device
    rpdo, tpdo = drive.rpdo[0], drive.tpdo[0]
    assert (rpdo.index, tpdo.index) == (0x1600, 0x1A00)
    assert [(c.index, c.type) for c in rpdo.channels] == [
        (0x6040, "uint16"), (0x607A, "int32"), (0x60FF, "int32"), (0x6071, "int32"), (0x6060, "int8"),
    ]  # fmt: skip
    assert [(c.index, c.type) for c in tpdo.channels] == [
        (0x6041, "uint16"), (0x6064, "int32"), (0x606C, "int32"), (0x6077, "int32"), (0x6061, "int8"),
    ]  # fmt: skip
    assert {c.factor for c in (*rpdo.channels, *tpdo.channels) if c.type == "int32"} == {0.0001}


@pytest.mark.parametrize(
    ("code", "never"),
    [("import rtcp.config.model, rtcp.config.zero", "pydantic"), ("import rtcp.config.model", "ruamel"),
     ("import rtcp.config as c; c.load(c.default_config())", "numpy")],
)  # fmt: skip
def test_the_configuration_loads_only_what_it_needs(code: str, never: str) -> None:
    code = f"import sys; {code}; print({never!r} in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False\n"


def test_the_sections_are_read_into_their_dataclasses(directory: Path) -> None:
    arm = edited(
        ("control_mode: joint ", "control_mode: joystick "), ("frame: base", "frame: tool"),
        ("  cycles: 5", "  cycles: 7"), ("# enabling_switch:", "enabling_switch:"),
        ("lease_ended: controlled_stop", "lease_ended: torque_off"),
    )  # fmt: skip
    assert arm.control_mode == "joystick"
    assert arm.cartesian == CartesianConfig(
        box=Box((-1.2, -1.0, -0.42), (0.8, 1.0, 1.4)),
        keep_out=(
            KeepOut("user", (0.42, -0.35, -0.1), (1.1, 0.35, 0.85)),
            KeepOut("chair", (0.22, -0.6, -0.45), (1.2, 0.6, 0.25)),
        ),
    )
    assert arm.jog == JogConfig(frame="tool")
    assert arm.supervision == SupervisionConfig(cycles=7)
    assert arm.stops == StopsConfig(lease_ended="torque_off")
    assert arm.inputs.enabling_switch == InputConfig(11)
    assert arm.inputs.emergency_stop == EmergencyStopConfig(10, "low")


@pytest.mark.parametrize(
    "key", ["drive_mode", "control_mode", "cartesian", "jog", "supervision", "stops", "inputs", "outputs", "gripper"]
)
def test_each_section_may_be_left_out(directory: Path, key: str) -> None:
    data = read(Path(ARM)).data
    del data[key]
    field = ArmConfig.__dataclass_fields__[key]
    default = field.default_factory() if callable(field.default_factory) else field.default
    assert getattr(rewritten(data), key) == default


@pytest.mark.parametrize(
    "corners",
    [
        "min: [-1, -1, -0.5], max: [1, 1, -0.01]",
        "min: [-1, -1, 0.2], max: [1, 1, 0.3]",
        "min: [0.01, -1, -1], max: [1, 1, 1]",
        "min: [-1, -1, -1], max: [1, -0.01, 1]",
    ],
    ids=["a floor", "a shelf above the shoulder", "a wall", "a wall behind"],
)
def test_a_box_may_stand_close_to_the_base(directory: Path, corners: str) -> None:
    assert len(edited((USER, f"{{name: user, {corners}}}")).cartesian.keep_out) == 2


def test_a_device_may_be_named_by_its_path(directory: Path) -> None:
    Path("elsewhere").mkdir()
    Path(BOX).rename("elsewhere/box.yaml")
    assert edited(("device: diewu-io", "device: elsewhere/box.yaml")).slaves[0].device.kind == "io"


def test_padding_needs_no_name(directory: Path) -> None:
    padding = "\n      - {index: 0, sub_index: 0, type: uint8}"
    Path(DRIVE).write_text(Path(DRIVE).read_text().replace(TORQUE, TORQUE + padding + padding))
    assert [channel.name for channel in load_device(Path(DRIVE)).rpdo[0].channels].count("padding") == 2


def test_numbers_may_be_written_without_a_point_with_exponent_or_in_hexadecimal(directory: Path) -> None:
    arm = edited(("velocity: 0.5", "velocity: 5e-1"), ("jerk: 20.0", "jerk: 20"), ("priority: 80", "priority: 0x50"))
    assert (arm.joints[0].velocity, arm.joints[0].jerk, arm.cycle.priority) == (0.5, 20.0, 80)
    assert isinstance(arm.joints[0].jerk, float)


def test_the_grippers_joint_is_the_axis_after_the_arms(directory: Path) -> None:
    arm = edited(*driven("1.4", "1.4"))
    finger = Joint("finger", "drive7", Range(-0.1, 1.5), 1.0, 4.0, 40.0, 2.0)
    assert arm.gripper == GripperConfig(joint=finger, open_position=1.4, closed_position=0.0)
    assert arm.axes == (*arm.joints, finger)
    assert len(arm.joints) == 6
    assert arm.arm == load(default_config()).arm


@pytest.mark.parametrize("gripper", ["", ON_AN_OUTPUT])
def test_without_a_drive_of_the_gripper_the_axes_are_the_joints(directory: Path, gripper: str) -> None:
    arm = edited((ON_AN_OUTPUT, gripper))
    assert arm.axes == arm.joints


# -- where the arm is and reaches --------------------------------------------------------------------------------------


def geometry_of(data: Any) -> Kinematics:
    part, _ = Checker(Kinematics).check(data["kinematics"])
    assert part is not None
    return part


def inside(point: Sequence[float], box: Box | KeepOut) -> bool:
    return all(low <= c <= high for low, c, high in zip(box.min, point, box.max, strict=True))


def test_the_upright_pose_and_a_quarter_of_a_radian_around_it_are_free(shipped: ArmConfig) -> None:
    assert shipped.cartesian.box is not None
    boxes = [[*box.min, *box.max] for box in shipped.cartesian.keep_out]
    draw = random.Random(4)
    corners = itertools.product((-0.25, 0.25), repeat=5)  # the last joint moves no body
    for q in itertools.chain(corners, ([draw.uniform(-0.25, 0.25) for _ in range(5)] for _ in range(300))):
        assert inside(points([*q, 0.0])[0], shipped.cartesian.box)
        assert min(gap for box in boxes for gap in box_gaps([*q, 0.0], box)) > 0.0, q
        assert own_gap([*q, 0.0]) > 0.0, q


def test_a_pick_is_free_and_the_user_is_not(shipped: ArmConfig) -> None:
    boxes = [[*box.min, *box.max] for box in shipped.cartesian.keep_out]
    for q in ([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0], [0.3, -0.6, 1.2, 0.0, 0.6, 0.0]):
        assert min(own_gap(q), *(gap for box in boxes for gap in box_gaps(q, box))) > 0.0
    assert inside(points([0.0, 0.0, -math.pi / 2, 0.0, 0.0, 0.0])[0], shipped.cartesian.keep_out[0])


def test_no_pose_of_the_arm_is_beyond_its_reach(shipped: ArmConfig) -> None:
    model = shipped.arm
    assert model is not None
    shoulder, reach = shoulder_and_reach(geometry_of(read(default_config()).data))
    draw = random.Random(5)
    assert math.dist(frames(model, [0.0] * 6)[6].position, shoulder) == pytest.approx(reach)
    for _ in range(300):
        poses = frames(model, [draw.uniform(-3, 3) for _ in range(6)])
        assert poses[0].position == pytest.approx(shoulder)
        assert max(math.dist(pose.position, shoulder) for pose in poses) <= reach + 1e-9


def test_the_shoulder_is_found_also_where_the_base_is_tilted(directory: Path) -> None:
    data = read(Path(ARM)).data
    data["kinematics"]["dh"][0].update(alpha=0.4, a=0.2)
    data["kinematics"]["tool"] = {"position": [0.0, 0.0, 0.1]}
    del data["cartesian"]
    shoulder, reach = shoulder_and_reach(geometry_of(data))
    model = rewritten(data).arm
    assert model is not None
    assert frames(model, [1.0, 0, 0, 0, 0, 0])[0].position == pytest.approx(shoulder)
    assert reach == pytest.approx(1.23)


# -- another start -----------------------------------------------------------------------------------------------------


def test_the_cycle_may_be_100_us_to_100_ms() -> None:
    assert allowed(annotation(CycleConfig, ("period_us",))) == "a number from 100 to 100000"


@pytest.mark.parametrize("period_us", [100, 300, 2000, 9999])
def test_the_shipped_arm_accepts_cycles_of_100_us_to_less_than_10_ms(shipped: ArmConfig, period_us: float) -> None:
    assert with_period(shipped, period_us).cycle.period_us == period_us


def test_another_period_is_checked_like_the_files(shipped: ArmConfig) -> None:
    with pytest.raises(ConfigError, match=r"cycle\.period_us: found 99, allowed is a number from 100 to 100000"):
        with_period(shipped, 99)
    message = r"Cubemars ORH: watchdog_ms: found 20 ms, allowed is more than 2 cycles, 20 ms"
    with pytest.raises(ConfigError, match=message):
        with_period(shipped, 10_000)


def test_another_control_mode_is_checked_like_the_file(directory: Path, shipped: ArmConfig) -> None:
    assert with_control_mode(shipped, "joystick").control_mode == "joystick"
    data = read(Path(ARM)).data
    del data["kinematics"], data["cartesian"], data["inputs"]["joystick"]
    bare = rewritten(data)
    assert with_control_mode(bare, "velocity").control_mode == "velocity"
    with pytest.raises(ConfigError, match=r"^control_mode: .* needs the arm's geometry"):
        with_control_mode(bare, "cartesian")


# -- the virtual bus ---------------------------------------------------------------------------------------------------


def with_bus(config: ArmConfig, interface: str, scale: float) -> ArmConfig:
    return replace(config, bus=replace(config.bus, interface=interface, timeout_scale=scale))


def sync_error_limits(config: ArmConfig) -> list[float]:
    entries = [entry for slave in config.slaves for entry in slave.device.sdo]
    return [entry.value for entry in entries if (entry.index, entry.sub_index) == (0x10F1, 2)]


@pytest.mark.parametrize(("interface", "scale"), [("eth0", 25.0), ("virtual", 1.0)])
def test_every_limit_is_the_one_that_is_written(shipped: ArmConfig, interface: str, scale: float) -> None:
    widened = widen(with_bus(shipped, interface, scale))
    assert widened == with_bus(shipped, interface, scale)
    assert (widened.bus.lost_cycles, widened.slaves[1].device.watchdog_ms) == (40, 20.0)
    assert sync_error_limits(widened) == [120.0] * 6


def test_on_the_virtual_bus_limits_that_a_slow_host_exceeds_and_nothing_else_are_scaled(shipped: ArmConfig) -> None:
    widened = widen(with_bus(shipped, "virtual", 10.0))
    assert isinstance(widened.bus, EthercatBus)
    assert (widened.bus.lost_cycles, widened.bus.clock_lost_s) == (400, 5.0)
    assert [slave.device.watchdog_ms for slave in widened.slaves] == [1000.0] + [200.0] * 6
    assert sync_error_limits(widened) == [0.0] * 6
    assert widened.supervision == replace(shipped.supervision, acceleration=10.0 * shipped.supervision.acceleration)
    assert (widened.joints, widened.cycle, widened.lease_s) == (shipped.joints, shipped.cycle, 3.0)
    for slave, before in zip(widened.slaves, shipped.slaves, strict=True):
        others = [entry for entry in slave.device.sdo if entry.index != 0x10F1]
        assert others == [entry for entry in before.device.sdo if entry.index != 0x10F1]


def test_the_scaled_watchdog_stays_within_its_register(shipped: ArmConfig) -> None:
    wide = widen(with_bus(shipped, "virtual", 100.0))
    assert max(slave.device.watchdog_ms for slave in wide.slaves) <= 6000.0


def test_at_power_on_the_virtual_arm_has_its_toggle_at_arm_and_its_emergency_stop_closed(shipped: ArmConfig) -> None:
    slave = load_segment(segment_path(shipped)).slaves[0]
    levels = create(slave.model, **slave.options).inputs  # type: ignore[attr-defined]
    assert levels & 0xFF == 63

    def active(terminal: InputConfig | None) -> bool:
        assert terminal is not None
        return bool(levels >> terminal.number - 1 & 1) == (terminal.active == "high")

    assert active(shipped.inputs.arm_toggle)
    assert not active(shipped.inputs.emergency_stop)
