"""Device files of CiA 402 drives in the standard's units: factors from the scaling, axes, drives of one mode."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from rtcp.config import default_config, load, load_device
from rtcp.config.findings import Finding
from rtcp.config.model import ArmConfig, DeviceDescription
from rtcp.ipc.stop_reactions import StopReaction, bounds
from tests.findings import assert_finds, findings_of, summary

ENTRIES = {
    "rpdo": (("controlword", 0x6040, "uint16"), ("target_position", 0x607A, "int32"),
             ("target_velocity", 0x60FF, "int32"), ("target_torque", 0x6071, "int16"),
             ("modes_of_operation", 0x6060, "int8")),
    "tpdo": (("statusword", 0x6041, "uint16"), ("position", 0x6064, "int32"), ("velocity", 0x606C, "int32"),
             ("torque", 0x6077, "int16"), ("modes_of_operation_display", 0x6061, "int8")),
}  # fmt: skip
CSP = {"index": 0x6060, "sub_index": 0, "type": "int8", "value": 8}
SCALING = {"encoder_increments": 4096, "gear_ratio": 100, "velocity_unit": "rpm", "rated_torque": 0.5}


def pdos(image: str, axis: int = 1, without: tuple[str, ...] = (), **factors: float) -> list[dict[str, Any]]:
    channels = [
        {"index": index + 0x800 * (axis - 1), "sub_index": 0, "type": kind, "name": name}
        | ({"factor": factors[name]} if name in factors else {})
        for name, index, kind in ENTRIES[image]
        if name not in without
    ]
    index = {"rpdo": 0x1600, "tpdo": 0x1A00}[image] + 0x10 * (axis - 1)
    return [{"index": index, "channels": channels, "axis": axis}]


def device(**changes: Any) -> dict[str, Any]:
    made = {"name": "a drive", "kind": "cia402", "vendor_id": 1, "product_id": 2, "scaling": [SCALING],
            "rpdo": pdos("rpdo"), "tpdo": pdos("tpdo"), **changes}  # fmt: skip
    return {key: value for key, value in made.items() if value is not None}


Write = Callable[..., DeviceDescription]
Findings = Callable[..., list[Finding]]


@pytest.fixture
def written(tmp_path: Path) -> Write:
    def write(**changes: Any) -> DeviceDescription:
        file = tmp_path / "drive.yaml"
        file.write_text(yaml.safe_dump(device(**changes)))
        return load_device(file)

    return write


@pytest.fixture
def findings(written: Write) -> Findings:
    return lambda **changes: findings_of(lambda: written(**changes))


TURN = 2 * math.pi


@pytest.mark.parametrize(
    ("scaling", "position", "velocity", "torque"),
    [
        (SCALING, TURN / 409600, TURN / 60 / 100, 0.5e-3 * 100),
        (SCALING | {"feed_constant": 36000}, TURN / 36000, TURN / 60 / 100, 0.5e-3 * 100),
        (SCALING | {"velocity_at": "output"}, TURN / 409600, TURN / 60, 0.5e-3 * 100),
        (SCALING | {"torque_at": "output"}, TURN / 409600, TURN / 60 / 100, 0.5e-3),
        (SCALING | {"velocity_unit": "urpm"}, TURN / 409600, 1e-6 * TURN / 60 / 100, 0.5e-3 * 100),
        (SCALING | {"velocity_unit": "counts/s", "external_gear_ratio": -2}, *2 * (-TURN / 819200,), -1e-3 * 100),
        ({"encoder_increments": 524288, "rated_current": 4, "torque_constant": 2}, *2 * (TURN / 524288,), 8e-3),
    ],
)  # fmt: skip
def test_the_factors_follow_from_what_the_drive_counts_in(
    written: Write, scaling: dict[str, Any], position: float, velocity: float, torque: float
) -> None:
    made = written(scaling=[scaling])
    (_, at, speed, effort, _), (_, shown, moving, measured, _) = (pdo.channels for pdo in (made.rpdo[0], made.tpdo[0]))
    assert [channel.factor for channel in (at, shown)] == [pytest.approx(position)] * 2
    assert [channel.factor for channel in (speed, moving)] == [pytest.approx(velocity)] * 2
    assert [channel.factor for channel in (effort, measured)] == [pytest.approx(torque)] * 2
    assert made.wire_range("target_torque") == (
        pytest.approx(min(-32768 * torque, 32767 * torque)), pytest.approx(max(-32768 * torque, 32767 * torque)),
    )  # fmt: skip


def test_a_factor_that_contradicts_the_scaling_is_refused_with_both(written: Write, findings: Findings) -> None:
    assert written(rpdo=pdos("rpdo", target_torque=0.05)).rpdo[0].channels[3].factor == 0.05
    (finding,) = findings(rpdo=pdos("rpdo", target_torque=0.25))
    expected = "rpdo[0].channels[3].factor: unlike_scaling found=0.25 scaled=0.05"
    assert summary(finding, expected) == expected


def test_factors_of_one_axis_that_would_turn_it_another_way_than_it_shows_are_refused(
    written: Write, findings: Findings
) -> None:
    agree: dict[str, Any] = {"target_position": -1e-4, "position": -1e-4, "target_velocity": -1.0, "velocity": -2.0,
             "target_torque": -0.1, "torque": -0.1}  # fmt: skip
    written(scaling=None, **{image: pdos(image, **agree) for image in ("rpdo", "tpdo")})
    for name, factor, said in (
        ("position", 1e-4, "positions of an axis have the same factor"),
        ("position", -2e-4, "positions of an axis have the same factor"),
        ("target_velocity", 1.0, "factors of an axis have the same sign"),
        ("torque", 0.1, "factors of an axis have the same sign"),
    ):
        differ = {image: pdos(image, **agree | {name: factor}) for image in ("rpdo", "tpdo")}
        (finding,) = findings(scaling=None, **differ)
        assert summary(finding, " found= channel= first= alike=").split(": ")[1] == (
            f"unlike found={factor} channel={name} first=-0.0001 alike={said}"
        )


@pytest.mark.parametrize("index", [0x6072, 0x6080, 0x60E0, 0x60E1])
def test_a_drive_is_not_sent_that_it_may_have_no_torque_or_speed(
    written: Write, findings: Findings, index: int
) -> None:
    outputs = pdos("rpdo", 2)
    outputs[0]["channels"].append({"index": index + 0x800, "sub_index": 0, "type": "uint16", "name": "most", "safe": 0})
    both = {"rpdo": [*pdos("rpdo"), *outputs], "tpdo": [*pdos("tpdo"), *pdos("tpdo", 2)]}
    (finding,) = findings(**both)
    assert summary(finding, " channel=") == "rpdo[1].channels[5].safe: safe_zero channel=most"
    outputs[0]["channels"][-1]["safe"] = 1000
    written(**both)
    del outputs[0]["channels"][-1]["safe"]  # the drive's own value
    written(**both)
    (finding,) = findings(**both, coe=False)  # cannot be read
    assert finding.code == "safe_zero"


def test_each_axis_has_its_own_scaling_or_all_have_one(written: Write) -> None:
    both = {image: [*pdos(image), *pdos(image, 2)] for image in ("rpdo", "tpdo")}
    made = written(**both, scaling=[SCALING, SCALING | {"gear_ratio": 50}])
    assert made.axes == (1, 2)
    ranges = [made.of_axis(axis).wire_range("target_position")[1] for axis in (1, 2)]
    assert ranges[1] == pytest.approx(2 * ranges[0])
    shared = written(**both)
    assert shared.of_axis(1).wire_range("target_position") == shared.of_axis(2).wire_range("target_position")


def test_a_drive_without_a_mode_in_its_pdos_is_set_to_csp_by_a_start_up_sdo(written: Write, findings: Findings) -> None:
    mode = ("modes_of_operation", "modes_of_operation_display")
    without = {image: pdos(image, without=mode) for image in ("rpdo", "tpdo")}
    assert written(**without, sdo=[CSP]).startup(0x6060) == 8
    for sdo in ([], [CSP | {"value": 9}], [CSP | {"index": 0x6860}]):
        (finding,) = findings(**without, sdo=sdo)
        assert finding.text == (
            "found no channel named modes_of_operation; without it the start-up SDO {index: 0x6060, "
            "sub_index: 0, type: int8, value: 8} (CSP) must be in sdo"
        )
    not_shown = {"tpdo": pdos("tpdo", without=mode)}
    assert summary(findings(**not_shown)[0], " value=") == "tpdo: mode_not_shown value=8"
    assert written(**not_shown, sdo=[CSP]).startup(0x6060) == 8


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"scaling": [SCALING | {"external_gear_ratio": 0}]}, "scaling[0].external_gear_ratio: zero"),
        ({"scaling": [SCALING | {"rated_current": 4}]}, "scaling[0]: missing key=torque_constant"),
        ({"scaling": [{"encoder_increments": 4096}], "rpdo": pdos("rpdo", target_torque=1.0)},
         "tpdo[0].channels[3]: missing key=factor"),
        ({"scaling": [SCALING, SCALING]}, "scaling: size found=2"),
        ({"rpdo": [*pdos("rpdo"), *pdos("rpdo", 3)], "tpdo": [*pdos("tpdo"), *pdos("tpdo", 3)]},
         ": axes_with_gap axes=1 and 3"),
        ({"rpdo": [*pdos("rpdo"), *pdos("rpdo", 2, ("target_position",))], "tpdo": [*pdos("tpdo"), *pdos("tpdo", 2)]},
         "rpdo: channels_lacking lacking=a channel named target_position of axis 2"),
        ({"rpdo": [*pdos("rpdo"), *pdos("rpdo", 2)]}, "tpdo: one_direction of= of axis 2"),
    ],
)  # fmt: skip
def test_each_mistake_of_scaling_and_axes_is_named(findings: Findings, changes: dict[str, Any], expected: str) -> None:
    assert expected in [summary(finding, expected) for finding in findings(**changes)]


def arm_with(tmp_path: Path, joint: dict[str, Any], **changes: Any) -> ArmConfig:
    """The shipped arm with three two-axis drives."""
    arm = yaml.safe_load(default_config().read_text())
    io = arm["slaves"][0]
    (tmp_path / "devices").mkdir(exist_ok=True)
    (tmp_path / "devices" / "diewu-io.yaml").write_text(
        (default_config().parent / "devices" / "diewu-io.yaml").read_text()
    )
    both = {image: [*pdos(image), *pdos(image, 2)] for image in ("rpdo", "tpdo")}
    quick = [{"index": 0x6085 + shift, "sub_index": 0, "type": "uint32", "value": 9549} for shift in (0, 0x800)]
    more = {"watchdog_ms": 20, "sdo": quick, **changes}
    (tmp_path / "devices" / "two-axes.yaml").write_text(yaml.safe_dump(device(**both, **more)))
    arm["slaves"] = [io, *({"name": f"drive{i}", "device": "two-axes"} for i in (1, 2, 3))]
    for i, entry in enumerate(arm["joints"]):
        entry |= {"slave": f"drive{i // 2 + 1}", "axis": i % 2 + 1}
    arm["joints"][1] |= joint
    file = tmp_path / "arm.yaml"
    file.write_text(yaml.safe_dump(arm))
    return load(file)


def test_three_drives_of_two_axes_move_six_joints(tmp_path: Path) -> None:
    config = arm_with(tmp_path, {})
    assert [joint.place for joint in config.joints[:3]] == ["drive1", "drive1, axis 2", "drive2"]
    # 9549 rpm/s at the motor, 100 to 1 at the joint
    assert bounds(config, StopReaction.QUICK_STOP)[1].time_s < 0.6


@pytest.mark.parametrize(
    ("joint", "expected"),
    [
        ({"axis": 1}, "joints[1].slave: repeated of=joints[0].slave"),
        ({"axis": 3}, "joints[1].axis: axis found=3"),
        ({"torque": 2000.0, "drive_torque": 2500.0}, "joints[1].torque: beyond_wire found=2000.0"),
    ],
)
def test_a_joint_that_names_a_wrong_axis_or_what_the_drive_cannot_express_is_refused(
    tmp_path: Path, joint: dict[str, Any], expected: str
) -> None:
    assert_finds(lambda: arm_with(tmp_path, joint), expected)


def test_the_shipped_drives_count_as_their_makers_say() -> None:
    folder = default_config().parent / "devices"
    somanet, actuator, both = (
        load_device(folder / f"{name}.yaml", 1000.0)
        for name in ("synapticon-somanet", "myactuator-x6-60", "two-axis-drive")
    )
    assert [entry.factor for entry in somanet.outputs][2:] == [
        pytest.approx(factor) for factor in (0.064, TURN / 52_428_800, TURN / 6000)
    ]
    assert [entry.factor for entry in actuator.inputs][1:4] == [
        pytest.approx(factor) for factor in (TURN / 131_072, TURN / 131_072, 0.01995)
    ]
    assert (both.axes, both.startup(0x6085, 2), both.of_axis(2).outputs[0].index) == ((1, 2), 10430251, 0x6840)
